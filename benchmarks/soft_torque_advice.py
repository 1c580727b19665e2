"""The advice of `tdhil tune` on random rigs and strings, judged by an independent simulator under bit noise.

    python benchmarks/soft_torque_advice.py                # 200 rigs, about 50 minutes of one core
    python benchmarks/soft_torque_advice.py --first 40 --rigs 20 --out advice.jsonl

``--out`` keeps each rig as one line of JSON. Rigs that are in the file already are not repeated, and the figures at the
end are over all lines of the file. So the study may be stopped and continued.

Each rig: a string, a top drive, a bit and present gains at random. `tune` sees them as stated, with their tolerances.
The truth is another one within these tolerances. A chain of masses and springs (tests/soft_torque/chain_in_time.py,
which shares no code with tdhil) simulates the truth under noise with the recommended, the stiff and the present gains.
Exit 1 if a promise is missed: at or below the present and the stiff gains in 98 % of the rigs (to the resolution of
both searches), below 85 % of the stiff ones in the median, margins kept by 95 % of the truths, and 93 % of the critical
speeds within the stated interval.
"""

from __future__ import annotations

import argparse
import sys
import time
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.kept_rows import kept_rows
from tdhil.soft_torque import (
    BottomEnd,
    Interval,
    PipeSection,
    Search,
    SpeedController,
    StringFile,
    TopDrive,
    TuneCase,
    draw_truths,
    loop_margins,
    string_modes_hz,
    string_of,
    tune,
)
from tests.soft_torque.chain_in_time import lowest_turning_of_chain

PIPES_M = ((0.1016, 0.0848), (0.127, 0.1086), (0.1397, 0.1214), (0.1492, 0.1297))
RESOLUTION = 1.06
"""Both searches step by 3 %."""
HIGHEST_RPM = 300.0
"""Speed that stands in a ratio for one that was not found up to 240 rpm."""


def rig(seed: int) -> TuneCase:
    """A rig, as stated."""
    random = np.random.default_rng(seed)
    outer, inner = PIPES_M[int(random.integers(len(PIPES_M)))]
    coulomb = float(random.uniform(1000.0, 4000.0))
    bottom = BottomEnd(
        inertia_kg_m2=float(random.uniform(100.0, 600.0)), friction="stribeck", coulomb_nm=coulomb,
        static_nm=coulomb * float(random.uniform(1.4, 2.2)), stribeck_speed_rad_s=float(random.uniform(1.5, 4.0)),
        viscous_nm_s_rad=float(random.uniform(5.0, 40.0)))
    length = float(random.uniform(1000.0, 5500.0))
    pipe = PipeSection(length_m=length, outer_diameter_m=outer, inner_diameter_m=inner)
    string = string_of(StringFile(sections=(pipe,), bottom=bottom))
    inertia = float(np.exp(random.uniform(np.log(500.0), np.log(4000.0))))
    drive = TopDrive(inertia, 8.0, 60.0, tuple(random.uniform((0.008, 0.004, 0.001), (0.03, 0.015, 0.005)).tolist()))
    half = float(random.uniform(0.01, 0.08))
    stiffness = float(np.exp(random.uniform(np.log(1.0), np.log(12.0))))
    present = SpeedController(inertia * stiffness, inertia * stiffness * float(random.uniform(0.2, 1.3)))
    return TuneCase(string, drive, Interval(inertia, inertia * (1.0 - half), inertia * (1.0 + half)), present=present,
                    seed=seed + 1)


def judged(number: int) -> dict[str, Any]:
    """Return what became of the advice for one rig: a line of the file. An infinite speed is None."""
    case = rig(number)
    tuning = tune(case, Search())
    truth = draw_truths(case.string, case.drive, case.inertia_kg_m2, count=1, seed=90_000 + number,
                        lag_tolerance=case.lag_tolerance, present=case.present)[0]
    advice = tuning.advice
    taken = tuning.by_kind(advice.kind or advice.compared_with)
    stiff, present = tuning.by_kind("stiff"), tuning.by_kind("present")
    assert taken is not None and taken.cure is not None and taken.controller is not None
    laws = [one.controller for one in (taken, stiff, present) if one is not None and one.controller is not None]
    line, bit = truth.string.lines[0], truth.string.bit
    assert len(laws) == 3 and bit is not None
    polar = line.inertia_kg_m / 7850.0
    speeds = lowest_turning_of_chain(
        length_m=line.length_m, polar_m4=polar, shear_pa=1.0 / (line.compliance_rad_nm_m * polar), density=7850.0,
        drag=line.drag_nm_s_rad_m, bottom_inertia=truth.string.bottom_inertia_kg_m2,
        bottom_viscous=truth.string.bottom_viscous_nm_s_rad, coulomb_nm=bit.coulomb_nm, static_nm=bit.static_nm,
        stribeck_rad_s=bit.stribeck_speed_rad_s, noise_nm=bit.noise_nm,
        noise_correlation_s=bit.noise_correlation_s, inertia=truth.drive.inertia_kg_m2,
        viscous=truth.drive.viscous_nm_s_rad, dry_nm=truth.drive.coulomb_nm, lags_s=truth.drive.inner_lags_s,
        laws=[(law.gain_nm_s_rad, law.integral_nm_rad, law.compensated_kg_m2, law.derivative_filter_s)
              for law in laws],
        seed=number, period_s=1.0 / string_modes_hz(truth.string)[0])
    low, high = taken.cure.interval(0.03 * (taken.cure.median or 0.0))
    failed = case.required.failed(loop_margins(truth.drive, taken.controller, truth.string))
    return {
        "rig": number, "taken": taken.kind, "length_m": line.length_m, "inertia_kg_m2": case.drive.inertia_kg_m2,
        "rpm": [float(one) if one < inf else None for one in speeds], "interval_rpm": [low, high],
        "below": bool(speeds[0] <= RESOLUTION * min(speeds[1], speeds[2])),
        "covered": bool(low <= speeds[0] <= (inf if high is None else high)),
        "kept": not failed or taken.kind == "present",
        "over_stiff": float(min(speeds[0], HIGHEST_RPM) / min(speeds[1], HIGHEST_RPM)),
    }


def words(row: dict[str, Any]) -> str:
    """Return one rig in a line."""
    tuned, stiff, present = (f"{inf if one is None else one:5.0f}" for one in row["rpm"])
    low, high = row["interval_rpm"]
    return (f"{row['rig']:4d} {row['taken']:12s} L {row['length_m']:5.0f} J {row['inertia_kg_m2']:5.0f} "
            f"tuned {tuned} ({low:4.0f}-{inf if high is None else high:4.0f}) stiff {stiff} present {present}"
            f"{'' if row['below'] else '  ABOVE'}{'' if row['covered'] else '  OUTSIDE'}"
            f"{'' if row['kept'] else '  THIN'}")


def main() -> int:
    """Judge rig by rig."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rigs", type=int, default=200, help="how many")
    parser.add_argument("--first", type=int, default=0, help="number of the first rig")
    parser.add_argument("--out", type=Path, help="file that keeps the rigs that are done, one line of JSON each")
    asked = parser.parse_args()
    begun = time.process_time()
    rows = kept_rows(asked.out, "rig", range(asked.first, asked.first + asked.rigs), judged,
                     lambda row: print(words(row), flush=True))
    if not rows:
        return 0
    missed = False
    for key, name, wanted in (("below", "at or below present and stiff", 0.98),
                              ("kept", "margins kept by the truth", 0.95),
                              ("covered", "critical speed within its interval", 0.93)):
        share = float(np.mean([row[key] for row in rows]))
        missed |= share < wanted
        print(f"{name}: {100 * share:.1f} % of {len(rows)} (promised {100 * wanted:.0f} %)")
    median = float(np.median([row["over_stiff"] for row in rows]))
    print(f"median of tuned over stiff: {median:.2f} (promised below 0.85); {time.process_time() - begun:.0f} s of CPU")
    return int(missed or median >= 0.85)


if __name__ == "__main__":
    sys.exit(main())
