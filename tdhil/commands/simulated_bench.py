"""Limits of the embedded simulated rig where a plant.yaml hangs a drill string on it and no rig.yaml names any.

The usual ones (`tdhil.config.rig`) are those of the default rig, which is light: with them a string is neither moved to
speed nor brought to rest in reasonable time. These follow from the simulated drive's own torque limit.
"""

from __future__ import annotations

from typing import Any

from tdhil.config.rig import Rig, simulated_default_rig

TORQUE_SHARE, PROBE_SHARE = 0.5, 0.25
"""Of the simulated drive's torque limit, which also stands for the make-up torque of the string's joints."""
TIME_S = 1800.0
QUICK_STOP_RAD_S2 = 1.0
RAMP_S = 40.0
"""All of the torque would be let go in so long."""


def suited(rig: Rig | None, plant: Any) -> Rig | None:
    """``rig`` as it is, unless ``plant`` (`sim_bus.params.RigParams`) has a string and ``rig`` has no limits."""
    if plant is None or plant.plant.kind == "rigid" or (rig is not None and rig.limits is not None):
        return rig
    most_nm = plant.drive.torque_limit_nm
    data = simulated_default_rig(rig).model_dump(by_alias=True)
    data["limits"] |= {
        "torque_nm": TORQUE_SHARE * most_nm,
        "probe_torque_nm": PROBE_SHARE * most_nm,
        "time_s": TIME_S,
        "quick_stop_rad_s2": QUICK_STOP_RAD_S2,
    }
    data |= {"load": "string", "make_up_torque_nm": most_nm, "torque_ramp_nm_s": TORQUE_SHARE * most_nm / RAMP_S}
    bench = Rig.model_validate(data)
    if rig is not None:
        bench._file, bench._lines = rig._file, rig._lines
    return bench
