"""A virtual string on a simulated drive against the same machine with a real one: critical speed by critical speed.

    python benchmarks/virtual_string.py                # some minutes
    python benchmarks/virtual_string.py --only a=0.25 --seeds 3

The machine of the reference case (J 1500, 3,000 m of 5 inch pipe, 374 kg·m²). *Real*: the simulator's own string under
the simulated drive's speed loop, which shares no code with ours; critical is the lowest set speed at which a bit that
is about to break away ends turning within 60 s. *Virtual*: a rigid shaft, the simulated drive in torque mode under the
host's loop, with the reports' lags, noise and quanta, by the course that `tdhil evaluate` takes. Where the rig is not
as it is believed to be, that is named. Exit 1 if a difference is above what is promised: 3 rpm, 6 if believed wrongly.
"""

from __future__ import annotations

import argparse
import sys
import time

import numpy as np

from sim_bus.inverter import Inverter
from sim_bus.params import DriveParams, ReportingParams, RigParams
from sim_bus.plant import Params
from sim_bus.plant.drill_string import StringParams
from tdhil.soft_torque import (
    RPM,
    BottomEnd,
    EvaluationCase,
    HostLoop,
    IdentifiedRig,
    Interval,
    Phase,
    PipeSection,
    Prediction,
    SpeedController,
    SpeedProgram,
    StringFile,
    TopDrive,
    evaluate,
    string_of,
)

BIT = {"friction": "stribeck", "static_nm": 5000.0, "coulomb_nm": 2500.0, "stribeck_speed_rad_s": 2.5,
       "viscous_nm_s_rad": 20.0, "inertia_kg_m2": 374.0}
STRING = string_of(StringFile(
    sections=(PipeSection(length_m=3000.0, outer_diameter_m=0.127, inner_diameter_m=0.1086),), bottom=BottomEnd(**BIT)))
MEANT = TopDrive(1500.0, 8.0, 60.0, (0.020, 0.010, 0.003))
MODES_HZ = (0.1299, 0.567, 1.079)
CONTROLLERS = {       # law, set speeds from and to, least damping
    "a=0.25": (SpeedController(1186.0, 999.3), 45.0, 79.0, 0.226),
    "a=0.35": (SpeedController(847.1, 705.1), 38.0, 66.0, 0.140),
    "stiff": (SpeedController(20286.0, 26454.0), 168.0, 218.0, 0.036),
}
SETTLE_S = 20.0


def params(law: SpeedController, *, real: bool, lags_s: tuple[float, float] = (0.40, 0.15)) -> RigParams:
    """Return parameters of the simulated drive: with a string, or a rigid shaft."""
    drive = DriveParams(rated_torque_nm=20_000, torque_limit_nm=30_000, speed_limit_rpm=250,
                        speed_gain_nm_s_rad=law.gain_nm_s_rad, speed_integral_gain_nm_rad=law.integral_nm_rad)
    shaft = {"inertia_kg_m2": 1500.0, "viscous_nm_s_rad": 8.0, "coulomb_nm": 60.0}
    plant = StringParams(**shaft, length_m=3000.0, bottom=BIT) if real else Params(**shaft)
    return RigParams(plant=plant, drive=drive,
                     reporting=ReportingParams(speed_lag_s=lags_s[0], torque_lag_s=lags_s[1]))


def really_turns(law: SpeedController, set_rpm: float, seed: int) -> bool:
    """Return whether a bit near breakaway turns after 60 s, below a top that turns at full speed."""
    inverter = Inverter(params(law, real=True), np.random.default_rng(seed))
    control, speed = inverter.control, set_rpm * RPM
    control.speed(speed)
    control.reference = control.filtered_rad_s = speed
    control._integral = inverter._lagged_nm = control.demand_nm = BIT["static_nm"] + 60.0 + 8.0 * speed
    cells = len(inverter.state.down_nm)
    inverter.state = inverter.state._replace(
        speed_rad_s=speed, down_nm=np.full(cells, BIT["static_nm"]), up_nm=np.full(cells, -BIT["static_nm"]))
    stuck_s = time_s = 0.0
    while time_s < 60.0 and time_s - stuck_s < 15.0:
        inverter.step(0.002)
        time_s += 0.002
        if inverter.state.bottom_speed_rad_s == 0.0:
            stuck_s = time_s
    return time_s - stuck_s >= 15.0


def real_critical(law: SpeedController, low_rpm: float, high_rpm: float, seed: int) -> float:
    """To 0.5 rpm."""
    while high_rpm - low_rpm > 0.5:
        middle = 0.5 * (low_rpm + high_rpm)
        low_rpm, high_rpm = (low_rpm, middle) if really_turns(law, middle, seed) else (middle, high_rpm)
    return high_rpm


def virtual(
    name: str, rate_hz: float, seed: int, *, lags_s: tuple[float, float] = (0.40, 0.15),
    believed: IdentifiedRig | None = None,
    torque_scale: float = 1.0,
) -> tuple[float | None, float | None, str]:
    """Critical speed in rpm, damping and verdict by the course of `tdhil evaluate`."""
    law, start, highest, damping = CONTROLLERS[name]
    rig = believed or IdentifiedRig(1500.0, 8.0, 60.0, lags_s[0])
    inverter = Inverter(params(SpeedController(6000.0, 4000.0), real=False, lags_s=lags_s), np.random.default_rng(seed))
    program, period_s = SpeedProgram(start * RPM, highest * RPM), 1.0 / rate_hz
    host = HostLoop(STRING, MEANT, law, rig, program, period_s, 30_000.0)
    count, step_s = inverter.steps(period_s)
    inverter.control.speed(program.start_rad_s)
    for _ in range(round(SETTLE_S / period_s) * count):
        inverter.step(step_s)
    torque = 60.0 + 8.0 * program.start_rad_s
    host.begin(program.start_rad_s, torque)
    rows = []
    while host.phase is not Phase.DONE:
        inverter.control.torque(torque_scale * torque)
        torque = host.step(len(rows) * period_s, inverter.reporting.speed_rad_s)
        rows.append(host.row)
        for _ in range(count):
            inverter.step(step_s)
    one = Interval(0.5 * (start + highest), start, highest)
    case = EvaluationCase(STRING, MEANT, law, rig, Prediction(name, one, Interval(*[damping] * 3), MODES_HZ))
    found = evaluate(np.array(rows), case, program)
    return None if found.critical_rpm is None else found.critical_rpm.value, found.damping, found.outcome.value


def main() -> int:
    """Every controller in every circumstance; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=tuple(CONTROLLERS))
    parser.add_argument("--seeds", type=int, default=1)
    asked = parser.parse_args()
    circumstances = [
        ("50 Hz", 3.0, {"rate_hz": 50.0}),
        ("100 Hz", 3.0, {"rate_hz": 100.0}),
        ("lags 20/10 ms, 50 Hz", 3.0, {"rate_hz": 50.0, "lags_s": (0.02, 0.01)}),
        ("lag believed 0.45 s", 6.0, {"rate_hz": 100.0, "believed": IdentifiedRig(1500.0, 8.0, 60.0, 0.45)}),
        ("lag believed 0.35 s", 6.0, {"rate_hz": 100.0, "believed": IdentifiedRig(1500.0, 8.0, 60.0, 0.35)}),
        ("F_c believed 30 N·m less", 6.0, {"rate_hz": 100.0, "believed": IdentifiedRig(1500.0, 8.0, 30.0, 0.40)}),
        ("torque 0.98 of commanded", 6.0, {"rate_hz": 100.0, "torque_scale": 0.98}),
    ]
    failed = 0
    for name, (law, start, highest, damping) in CONTROLLERS.items():
        if asked.only not in (None, name):
            continue
        real = real_critical(law, start, highest, 1)
        print(f"{name}: real string {real:.1f} rpm, damping by theory {damping:.3f}", flush=True)
        for label, most_rpm, how in circumstances:
            for seed in range(1, asked.seeds + 1):
                began_s = time.perf_counter()
                critical, found, outcome = virtual(name, seed=seed, **how)
                off = critical is None or abs(critical - real) > most_rpm
                failed += off
                said = "none" if critical is None else f"{critical:6.1f} rpm, {critical - real:+5.1f}"
                shown = "-" if found is None else f"{found:.3f}"
                print(f"  {label:26} {said}, damping {shown}, {outcome}{'  TOO FAR' if off else ''}"
                      f"   ({time.perf_counter() - began_s:.0f} s)", flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
