"""Limits, excitation and bench data of a run, from rig.yaml and the command line."""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import Any

from profiles import MessageCode
from tdhil.config import Rig, RunOptions, require_limits, rig_model, simulated_default_rig
from tdhil.errors import UsageError
from tdhil.recording import LagPrior, Pipe
from tdhil.runner import ExcitationRequest, MachineLimits

# ---------------------------------------------------------------------------------------------------------------------
# Limits of the embedded simulated rig if plant.yaml adds a drill string and rig.yaml names no limits.
#
# The default limits (`tdhil.config.rig`) belong to the light default rig. They are too low to bring a string to speed
# or to rest in reasonable time. The limits here follow from the torque limit of the simulated drive.


TORQUE_SHARE, PROBE_SHARE = 0.5, 0.25
"""Shares of the simulated drive's torque limit. This limit also replaces the make-up torque of the joints."""
TIME_S = 1800.0
QUICK_STOP_RAD_S2 = 1.0
RAMP_S = 40.0
"""Time in which the whole torque would be released, s."""


def suited(rig: Rig | None, plant: Any) -> Rig | None:
    """Return ``rig``. If ``plant`` (`sim_bus.params.RigParams`) has a string and ``rig`` no limits, it gets limits for
    it. What the file states stays.
    """
    if plant is None or (rig is not None and rig.limits is not None):
        return rig
    from sim_bus.plant import PLANTS

    if not PLANTS[plant.plant.kind].winds_up:
        return rig
    most_nm = plant.drive.torque_limit_nm
    data = simulated_default_rig(rig).model_dump(by_alias=True)
    make_up_nm = (None if rig is None else rig.make_up_torque_nm) or most_nm
    ramp_nm_s = None if rig is None else rig.torque_ramp_nm_s
    torque_nm = TORQUE_SHARE * min(most_nm, make_up_nm)
    data["limits"] |= {
        "torque_nm": torque_nm,
        "probe_torque_nm": min(PROBE_SHARE * most_nm, torque_nm),
        "time_s": TIME_S,
        "quick_stop_rad_s2": QUICK_STOP_RAD_S2,
    }
    data |= {
        "load": data["load"] | {"kind": "string"},
        "make_up_torque_nm": make_up_nm,
        "torque_ramp_nm_s": ramp_nm_s or TORQUE_SHARE * most_nm / RAMP_S,
    }
    bench = rig_model().model_validate(data)
    if rig is not None:
        bench._file, bench._lines = rig._file, rig._lines
    return bench


# ---------------------------------------------------------------------------------------------------------------------

ASSUMED_TORQUE_SCALE_REL_SD = 0.03
"""Assumed standard uncertainty of a real drive's torque scale if none is stated: inverters know it to a few percent."""

UNKNOWN_LAG_SD_SHARE = 0.1
"""Standard deviation, as a share, of a lag that is stated without one."""


def bench_of(simulated: bool, rig: Rig | None, highest_speed_rad_s: float | None = None) -> Rig:
    """Return the bench for this peer. A real one needs the limits of rig.yaml, a simulated one has its own.

    ``highest_speed_rad_s``: of this run. Raises PreflightRefused without limits, UsageError if it is not within them.
    """
    bench = simulated_default_rig(rig) if simulated else rig
    limits = require_limits(bench)
    assert bench is not None
    if highest_speed_rad_s is None:
        return bench
    if not limits.speed_min_rad_s < highest_speed_rad_s <= limits.speed_max_rad_s:
        raise UsageError(
            f"{highest_speed_rad_s:.4g} rad/s is not within the limits of the rig, {limits.speed_min_rad_s:g} to "
            f"{limits.speed_max_rad_s:g} rad/s", where="--highest-speed", next_step="Choose a speed between them",
            entry=MessageCode.VALUE_NOT_ALLOWED)
    return bench.model_copy(update={"limits": limits.model_copy(update={"speed_max_rad_s": highest_speed_rad_s})})


def machine_limits(
    bench: Rig, *, accept_no_watchdog: bool = False, accept_shared_watchdog: bool = False,
    accept_wider: Collection[str] = (), accept_speed_unit: bool = False, rig_speed_max_rad_s: float = 0.0,
) -> MachineLimits:
    """Return the guard's limits. Raises PreflightRefused if the rig has none.

    ``rig_speed_max_rad_s``: the rig's own highest speed, if ``bench`` has a lower one for this run.
    The overrides belong to one run and its command line. No file of the bench can set them.
    """
    limits = require_limits(bench)
    pipe = pipe_of(bench)
    return MachineLimits(
        speed_min_rad_s=limits.speed_min_rad_s,
        speed_max_rad_s=limits.speed_max_rad_s,
        torque_nm=limits.torque_nm,
        time_s=limits.time_s,
        quick_stop_rad_s2=limits.quick_stop_rad_s2,
        watchdog_s=limits.watchdog_s,
        temperature_c=limits.temperature_c,
        probe_torque_nm=limits.probe_torque_nm,
        probe_travel_rad=limits.probe_travel_rad,
        allow_reverse=bench.allow_reverse,
        load=bench.load.kind,
        wave_impedance_nm_s_rad=0.0 if pipe is None else pipe.impedance_nm_s_rad,
        echo_s=0.0 if pipe is None else 2.0 * pipe.delay_s,
        torque_ramp_nm_s=bench.torque_ramp_nm_s or 0.0,
        accept_no_watchdog=accept_no_watchdog,
        accept_shared_watchdog=accept_shared_watchdog,
        accept_wider=frozenset(accept_wider),
        accept_speed_unit=accept_speed_unit,
        rig_speed_max_rad_s=rig_speed_max_rad_s,
    )


def excitation_request(options: RunOptions, bench: Rig | None = None) -> ExcitationRequest:
    """Return the request for stage 5, with the filter time that the ``bench`` states for the drive."""
    return ExcitationRequest(
        kind=options.excitation,
        mode=options.mode,
        frequency_hz=options.frequency_hz,
        amplitude_rad_s=options.amplitude_rad_s,
        offset_rad_s=options.offset_rad_s,
        periods=options.periods,
        realisations=options.realisations,
        confidence=options.confidence,
        tolerance=options.tolerance if options.given("tolerance") else None,
        max_time_s=options.max_time_s,
        impedance=options.impedance,
        string_nm_s_rad=options.string_impedance_nm_s_rad,
        reference_filter_s=0.0 if bench is None else bench.drive_data.reference_filter_s or 0.0,
    )


def stated_lags(
    speed_lag_s: float | None, speed_lag_sd_s: float | None, torque_lag_s: float | None, torque_lag_sd_s: float | None,
    source: str,
) -> LagPrior:
    """Return stated reporting lags with their source. A standard deviation that isn't stated is a tenth of the lag."""
    def deviation(lag_s: float | None, stated_s: float | None) -> float:
        if lag_s is None:
            return 0.0
        return stated_s if stated_s is not None else UNKNOWN_LAG_SD_SHARE * lag_s

    known = speed_lag_s is not None or torque_lag_s is not None
    return LagPrior(
        speed_lag_s, deviation(speed_lag_s, speed_lag_sd_s), torque_lag_s, deviation(torque_lag_s, torque_lag_sd_s),
        source if known else "",
    )


def lag_prior(bench: Rig) -> LagPrior:
    """Return the reporting lags that rig.yaml states."""
    data = bench.drive_data
    return stated_lags(
        data.speed_lag_s, data.speed_lag_sd_s, data.torque_lag_s, data.torque_lag_sd_s, "rig.yaml"
    )


def facts(bench: Rig) -> dict[str, Any]:
    """Return the facts of the bench that a Recording needs."""
    scale = bench.drive_data.torque_scale_rel_sd
    return {
        "gear_ratio": bench.gear.ratio,
        "torque_scale_rel_sd": ASSUMED_TORQUE_SCALE_REL_SD if scale is None else scale,
        "lag_prior": lag_prior(bench),
        "has_drill_string": bench.load.kind == "string",
        "pipe": pipe_of(bench),
    }


def pipe_of(bench: Rig) -> Pipe | None:
    """Return the drill pipe, referred to the motor shaft; None if rig.yaml does not give its sizes."""
    load, i = bench.load, bench.gear.ratio
    if load.length_m is None or load.outer_diameter_m is None or load.inner_diameter_m is None:
        return None
    section_m4 = math.pi / 32.0 * (load.outer_diameter_m**4 - load.inner_diameter_m**4)
    return Pipe(
        inertia_kg_m2=STEEL_DENSITY_KG_M3 * section_m4 * load.length_m / i**2,
        stiffness_nm_rad=STEEL_SHEAR_MODULUS_PA * section_m4 / load.length_m / i**2,
        rel_sd=load.tolerance,
        source="rig.yaml",
    )


STEEL_DENSITY_KG_M3, STEEL_SHEAR_MODULUS_PA = 7850.0, 79.3e9
