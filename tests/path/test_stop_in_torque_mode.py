"""Drive that ignores the change to speed mode at the stop, and whose quick stop coasts in torque mode.

The true shaft is read from the trace: friction stops it, and the drive is disabled at standstill only.
"""

from itertools import pairwise
from pathlib import Path

import pytest
import yaml

from profiles.library import profile_path
from tests.path.path_runs import HELD, QUICK, Shaft, identify
from tests.rigs import STRING, limits_text, plant_file, rig_file

EXAMPLES = Path(__file__).parents[2] / "examples"
RAMP_NM_S, TORQUE_NM, SPEED_RAD_S = 100.0, 4000.0, 10.0
LIMITS = limits_text(speed_min_rad_s=2.0, speed_max_rad_s=SPEED_RAD_S, torque_nm=TORQUE_NM, probe_torque_nm=2000.0,
                     probe_travel_rad=60.0)
KEEPS_MODE = ("--fault", "mode-not-followed@hold")


def stopped(folder, generic, *arguments):
    """Run with a drive of the generic profile whose quick stop coasts in torque mode."""
    text = profile_path(generic).read_text(encoding="utf-8").replace(f"name: {generic}", "name: own/lets-go")
    text = text.replace("decelerates_in_torque_mode: true", "decelerates_in_torque_mode: false")
    text = text.replace("eds: cia402.eds", "eds: null")
    profile, trace = folder / "lets-go.yaml", folder / "shaft.csv"
    profile.write_text(text, encoding="utf-8")
    done = identify(folder, "--simulate", "--profile", profile, "--seed", 3, "--trace", trace, *KEEPS_MODE, *arguments)
    assert done.code == 6, done.err                    # row 32 of the fault table: no other cause ended the run
    assert done.document["error"]["code"] == "TDH-601"
    assert "stayed in torque mode" in done.document["error"]["message"]
    assert done.document["rehearsal"]["verdict"] == "pass"
    assert "the shaft is at standstill" in done.document["stop"]
    shaft = Shaft.read(trace)
    shaft.assert_never_let_go()
    assert shaft.state[-1] == "switch on disabled"
    return shaft


BUSES = [
    pytest.param("generic/cia402", id="canopen"),
    pytest.param("generic/modbus", id="modbus"),
]


@pytest.mark.parametrize("generic", BUSES)
def test_friction_stops_the_shaft_before_the_drive_is_disabled(tmp_path, generic):
    shaft = stopped(tmp_path, generic, *QUICK, "--periods", 3)
    shaft.assert_at_rest()
    assert not shaft.events("state: quick stop active"), "its quick stop would have disabled it"


@pytest.mark.heavy
@pytest.mark.parametrize("generic", BUSES)
def test_the_torque_of_a_string_comes_down_on_the_ramp(tmp_path, generic):
    """Bit and mud load the string, so that it is twisted while it turns."""
    rig = rig_file(tmp_path, "rate_hz: 50\n", LIMITS, STRING.replace("400", f"{RAMP_NM_S}"))
    rough = yaml.safe_load((EXAMPLES / "plant_two_mass.yaml").read_text(encoding="utf-8"))
    rough["plant"]["bottom"] |= {"coulomb_nm": 800.0, "viscous_nm_s_rad": 60.0}
    plant = plant_file(tmp_path, yaml.safe_dump(rough))
    shaft = stopped(tmp_path, generic, "--rig", rig, "--plant", plant, "--periods", 3)
    off = max(k for k, state in enumerate(shaft.state) if state in HELD)
    seconds = [k for k in range(off) if k == 0 or int(shaft.time_s[k]) > int(shaft.time_s[k - 1])]
    torques = [float(shaft.torque_nm[k]) for k in seconds]
    begun = max(k for k, torque in enumerate(torques) if torque > 4.0 * 0.02 * TORQUE_NM)
    ramp = torques[begun - 2:begun + 2]
    # Checked every second, since the torque of the simulated drive has noise.
    assert all(0.0 < before - after < 1.7 * RAMP_NM_S for before, after in pairwise(ramp)), ramp
    last = shaft.time_s > shaft.time_s[off] - 1.0
    held = [state in HELD for state in shaft.state]
    assert abs(shaft.torque_nm[last & held].mean()) < 0.02 * TORQUE_NM
    # It yields to the string no faster than a release.
    assert shaft.speed_rad_s.min() > -0.1 * SPEED_RAD_S
    assert abs(shaft.speed_rad_s[off:]).max() < 0.05
