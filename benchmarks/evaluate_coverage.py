"""Coverage of the damping that `tdhil evaluate` measures, and its wrong verdicts, on rigs from 30 to 3,000 kg·m².

    python benchmarks/evaluate_coverage.py --rigs 100 --out evaluate.jsonl       # ten seconds of CPU a rig
    python benchmarks/evaluate_coverage.py --first 40 --rigs 20 --out evaluate.jsonl

``--out`` keeps each rig as one line of JSON. Rigs that are in the file already are not repeated, and the figures at the
end are over all lines of the file. So the study may be stopped and continued.

Each rig: an inertia at random, friction of a bench of that size, a soft controller at random for the machine and string
of the reference case. The simulated drive, which shares no code with tdhil, turns the shaft, with the reports' lags,
noise and resolution. The host believes J, lag and friction with errors of the size of their uncertainty. The string's
loop is what `tdhil evaluate` runs, cycle by cycle, over the course that it plans.

The truth is the damping of the poles of the meant machine on its string, and so is the prediction: every "differs" is
wrong. Promised: 93 % of the intervals cover the damping, and at most 5 % of the verdicts are "differs". Exit 1 if not.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.kept_rows import kept_rows
from benchmarks.virtual_string import MEANT, MODES_HZ, SETTLE_S, STRING
from sim_bus.inverter import Inverter
from sim_bus.params import DriveParams, RigParams
from sim_bus.plant import Params
from tdhil.soft_torque import (
    EvaluationCase,
    EvaluationRefused,
    HostLoop,
    IdentifiedRig,
    Interval,
    Phase,
    Prediction,
    RigWindow,
    Search,
    TuneCase,
    evaluate,
    least_damping,
    lowest_turning,
    program_for,
    tuned_controller,
)

RATE_HZ = 50.0
MEANT_J = Interval(1500.0, 1440.0, 1560.0)
TORQUE_PER_INERTIA = 25.0
"""Torque limit of a bench, N·m for each kg·m²."""


def prepared(number: int) -> tuple[EvaluationCase, RigParams, float]:
    """Return the case as believed, the true rig, and the true damping."""
    random = np.random.default_rng([53, number])
    inertia = float(np.exp(random.uniform(np.log(30.0), np.log(3000.0))))
    size = min(1.0, inertia / 104.0)
    coulomb, viscous = 60.0 * size, 8.0 * size
    softness, factor = float(random.uniform(0.15, 0.5)), float(random.uniform(0.7, 1.0))
    law = tuned_controller(STRING, 1500.0, softness, factor * MODES_HZ[0])
    own = TuneCase(STRING, MEANT, MEANT_J)
    drives = [MEANT.with_inertia(one) for one in own.inertias(5)]
    dampings = [least_damping(own, drive, law, MODES_HZ) for drive in drives]
    cures = lowest_turning(STRING, [(drive, law) for drive in drives], "stuck", Search(highest_rpm=150.0))
    assert all(one is not None for one in cures)
    cure = Interval(float(cures[2] or 0.0), min(one or 0.0 for one in cures), max(one or 0.0 for one in cures))
    believed = IdentifiedRig(inertia * (1.0 + 0.002 * float(random.standard_normal())), viscous,
                             coulomb * (1.0 + 0.03 * float(random.standard_normal())),
                             0.40 + 0.005 * float(random.standard_normal()))
    case = EvaluationCase(STRING, MEANT, law, believed,
                          Prediction("soft", cure, Interval(dampings[2], min(dampings), max(dampings)), MODES_HZ), 0.01)
    limit = TORQUE_PER_INERTIA * inertia + coulomb
    truth = RigParams(
        plant=Params(inertia_kg_m2=inertia, viscous_nm_s_rad=viscous, coulomb_nm=coulomb),
        drive=DriveParams(rated_torque_nm=limit, torque_limit_nm=limit, speed_limit_rpm=400.0,
                          speed_gain_nm_s_rad=4.0 * inertia, speed_integral_gain_nm_rad=3.0 * inertia))
    return case, truth, dampings[2]


def judged(number: int) -> dict[str, Any]:
    """Return what `evaluate` found on one rig: a line of the file."""
    case, truth, damping = prepared(number)
    row: dict[str, Any] = {"rig": number, "inertia_kg_m2": truth.plant.inertia_kg_m2, "true": damping}
    limit = truth.drive.torque_limit_nm
    try:
        program = program_for(case, RigWindow(0.3, 40.0, limit, 0.2))
    except EvaluationRefused as refused:
        return row | {"outcome": "refused", "reason": str(refused)}
    inverter = Inverter(truth, np.random.default_rng([number, 7]))
    period_s = 1.0 / RATE_HZ
    host = HostLoop(STRING, MEANT, case.law, case.rig, program, period_s, limit)
    count, step_s = inverter.steps(period_s)
    inverter.control.speed(program.start_rad_s)
    for _ in range(round(SETTLE_S / period_s) * count):
        inverter.step(step_s)
    torque = case.rig.coulomb_nm + case.rig.viscous_nm_s_rad * program.start_rad_s
    host.begin(program.start_rad_s, torque)
    rows = []
    while host.phase is not Phase.DONE:
        inverter.control.torque(torque)
        torque = host.step(len(rows) * period_s, inverter.reporting.speed_rad_s)
        rows.append(host.row)
        for _ in range(count):
            inverter.step(step_s)
    found = evaluate(np.array(rows), case, program)
    seen = found.damping_interval
    return row | {
        "outcome": found.outcome.value, "reason": found.why, "unknown_nm": found.unknown_rms_nm,
        "critical_rpm": None if found.critical_rpm is None else [found.critical_rpm.low, found.critical_rpm.high],
        "predicted_rpm": [case.prediction.cure_rpm.low, case.prediction.cure_rpm.high],
        "damping": None if seen is None else [seen.value, seen.low, seen.high]}


def words(row: dict[str, Any]) -> str:
    """Return one rig in a line."""
    seen = row.get("damping")
    said = "no damping" if seen is None else f"damping {seen[0]:.3f} ({seen[1]:.3f} to {seen[2]:.3f})"
    missed = "" if seen is None or seen[1] <= row["true"] <= seen[2] else "  OUTSIDE"
    return (f"{row['rig']:4d} J {row['inertia_kg_m2']:6.0f}  {row['outcome']:12s} {said}, true {row['true']:.3f}"
            f"{missed}  {row['reason'] if row['outcome'] != 'as_predicted' else ''}")


def main() -> int:
    """Judge rig by rig."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rigs", type=int, default=100, help="how many")
    parser.add_argument("--first", type=int, default=0, help="number of the first rig")
    parser.add_argument("--out", type=Path, help="file that keeps the rigs that are done, one line of JSON each")
    asked = parser.parse_args()
    begun = time.process_time()
    rows = kept_rows(asked.out, "rig", range(asked.first, asked.first + asked.rigs), judged,
                     lambda row: print(words(row), flush=True))
    ran = [row for row in rows if row["outcome"] != "refused"]
    measured = [row for row in ran if row["damping"] is not None]
    if not measured:
        return 1
    covered = float(np.mean([row["damping"][1] <= row["true"] <= row["damping"][2] for row in measured]))
    wrong = float(np.mean([row["outcome"] == "differs" for row in ran]))
    width = float(np.median([row["damping"][2] - row["damping"][1] for row in measured]))
    print(f"{len(rows)} rigs, {len(rows) - len(ran)} refused before motion, {len(measured)} with a damping")
    print(f"damping within its interval: {100 * covered:.1f} % (promised 93 %); width {width:.3f} in the median")
    print(f"'differs' where nothing does: {100 * wrong:.1f} % of {len(ran)} (promised at most 5 %); "
          f"{time.process_time() - begun:.0f} s of CPU")
    return int(covered < 0.93 or wrong > 0.05)


if __name__ == "__main__":
    sys.exit(main())
