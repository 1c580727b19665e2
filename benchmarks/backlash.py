"""Backlash of the coupling: found or not, its angle, and J.

    python benchmarks/backlash.py [--rows 200 | --clean] [--first 0] [--step 1] [--out rows.jsonl]

A row is one seed of the bench in `tests/estimation/angle_bench.py`: stages 2 to 5 of a run, whose drive reports the
angle in 8,192 counts. Batches of 10 seeds share one rig, drawn from the batch's number: lags, noise, rounding, the
load's share of J (0.35 to 0.8) and its friction, below the torque at which it would not reverse. The play is 3, 6, 20
or 60 counts; the closed coupling oscillates at 40 to 200 rad/s with a damping ratio of 0.1 to 0.9.

`--clean`: 500 rows of rigs without backlash. A fifth each is rigid, has Stribeck friction, has torque over the angle,
has an elastic coupling, and has the load's friction of the rows with backlash behind an elastic coupling.

Required of each play by itself: at least 95 % of its rows are found. Required of all rows: at least 95 % of the
intervals of the play, where its size is known, and of J cover; at most 10 % have no J, and at most 10 % of the plays
found have no size. No backlash is found on a clean rig. The exit code is 1 otherwise.
"""

from __future__ import annotations

import math
import sys
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from kept_rows import numbered_rows

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.shares import met  # noqa: E402
from tdhil.estimation import identify  # noqa: E402
from tdhil.recording import Recording  # noqa: E402
from tests.estimation.angle_bench import COUNTS, RATED_NM, OverAngle, run_over_angle  # noqa: E402
from tests.estimation.shaft_bench import Rig  # noqa: E402
from tests.estimation.stages_bench import Play  # noqa: E402

TRUE_KG_M2 = 104.0
COULOMB_NM, VISCOUS_NM_S = 60.0, 8.0
BATCH = 10
PLAYS = (3, 6, 20, 60)          # counts
CLEAN = ("rigid", "stribeck", "harmonics", "elastic", "elastic")
DECELERATION_RAD_S2 = 1.0       # that the motion surely has; the load's friction stays below it
LEAST_SHARE = 0.95              # of the rows: found, play, J; issue 29
MOST_OPEN = 0.10                # of the rows without J, and of plays found without a size; a choice
COUNT_RAD = 2.0 * math.pi / COUNTS


def rig_of(batch: int, clean: bool) -> tuple[OverAngle, str]:
    """Return bench and kind of a batch."""
    rng = np.random.default_rng([batch, 295])
    servo = bool(batch % 2)     # a servo drive: short lags, and the angle in every cycle
    lags = (0.02, 0.01) if servo else (rng.uniform(0.2, 0.6), rng.uniform(0.05, 0.25))
    kind = CLEAN[batch % len(CLEAN)] if clean else f"{PLAYS[batch % len(PLAYS)]} counts"
    share = rng.uniform(0.35, 0.8)
    load = share * TRUE_KG_M2
    most_nm = min(DECELERATION_RAD_S2 * load, 0.8 * COULOMB_NM)
    viscous = rng.uniform(0.0, 0.5) * VISCOUS_NM_S
    coulomb = max(rng.uniform(0.1, 0.8) * most_nm - 5.0 * viscous, 2.0)
    angle = 0.0 if clean else PLAYS[batch % len(PLAYS)] * COUNT_RAD
    play = Play(angle, load, coulomb, viscous, natural=rng.uniform(40.0, 200.0), ratio=rng.uniform(0.1, 0.9))
    order, torque_nm = int(rng.choice([1, 6, 36])), float(rng.choice([0.01, 0.03, 0.1])) * RATED_NM
    rig = Rig(
        coulomb=COULOMB_NM, viscous=VISCOUS_NM_S, speed_poles=(lags[0],), torque_poles=(lags[1],),
        speed_quantum=rng.choice([0.001, 0.0105]), torque_quantum=rng.choice([0.4, 1.0]), load_sd=rng.uniform(1.0, 5.0),
        harmonics=((order, torque_nm, rng.uniform(-math.pi, math.pi)),) if kind == "harmonics" else (),
    )
    return OverAngle(
        rig=rig, every=1 if servo else 5, static=rng.uniform(5.0, 30.0) if kind == "stribeck" else 0.0,
        play=play if kind == "elastic" or not clean else None), kind


@lru_cache(maxsize=2)
def batch_of(batch: int, clean: bool) -> tuple[Recording, ...]:
    """Return the recordings of a batch."""
    return tuple(run_over_angle(rig_of(batch, clean)[0], [BATCH * batch + k for k in range(BATCH)]))


def judged(number: int, clean: bool) -> dict[str, Any]:
    """Return the row of a number."""
    bench, kind = rig_of(number // BATCH, clean)
    found = identify(batch_of(number // BATCH, clean)[number % BATCH])
    row: dict[str, Any] = {"row": number, "kind": kind, "servo": bench.every == 1, "verdict": found.verdict.value,
                           "model": found.model, "known": found.backlash is not None, "found": bool(found.backlash)}
    if bench.play is not None:
        row["share"] = bench.play.inertia / TRUE_KG_M2
    if found.backlash and bench.play is not None and (angle := found.backlash[0].play_rad) is not None:
        row |= {f"play_{side}": getattr(angle, side) / COUNT_RAD for side in ("low", "value", "high")}
        row["covers_play"] = angle.low <= bench.play.angle <= angle.high
    if found.inertia is not None:
        row |= {"error": found.inertia.value / TRUE_KG_M2 - 1.0, "covers": found.inertia.low <= TRUE_KG_M2
                <= found.inertia.high, "half": 0.5 * (found.inertia.high - found.inertia.low) / TRUE_KG_M2}
    return row


def show(row: dict[str, Any]) -> None:
    """Print one row."""
    play = f"{row['play_value']:6.2f} ({row['play_low']:.2f} to {row['play_high']:.2f})" if "play_low" in row else "-"
    inertia = f"{100 * row['error']:+6.2f} % ±{100 * row['half']:.2f} %" if "error" in row else "-"
    print(f"{row['row']:>4} {row['kind']:<10} share {row.get('share', 0.0):.2f}  play {play:<28} J {inertia:<18} "
          f"{row['verdict']}", flush=True)


def kept(rows: list[dict[str, Any]], clean: bool) -> bool:
    """Print the rows by kind. Return whether they meet the requirements."""
    print("\nkind        rows found | play covers | J: told  mean error  median half-width  covers")
    for kind in sorted({row["kind"] for row in rows}):
        own = [row for row in rows if row["kind"] == kind]
        seen, told = [row for row in own if "covers_play" in row], [row for row in own if "error" in row]
        error = float(np.mean([row["error"] for row in told])) if told else math.nan
        half = float(np.median([row["half"] for row in told])) if told else math.nan
        print(f"{kind:<11} {len(own):>4} {sum(row['found'] for row in own):>5} | "
              f"{sum(row['covers_play'] for row in seen):>4} of {len(seen):<4}| {len(told):>7} {100 * error:+9.2f} % "
              f"±{100 * half:.2f} % {sum(row['covers'] for row in told):>12}")
    print("required:")
    told, found = [row for row in rows if "error" in row], [row for row in rows if row["found"]]
    good = [met("J covers", sum(row["covers"] for row in told), len(told), least=LEAST_SHARE),
            met("without J", len(rows) - len(told), len(rows), most=MOST_OPEN)]
    if clean:
        return all([*good, met("found on clean rigs", len(found), len(rows), most=0.0)])
    for kind in sorted({row["kind"] for row in rows}):
        of_kind = [row["found"] for row in rows if row["kind"] == kind]
        good.append(met(f"{kind} found", sum(of_kind), len(of_kind), least=LEAST_SHARE))
    seen = [row for row in rows if "covers_play" in row]
    return all([*good, met("play covers", sum(row["covers_play"] for row in seen), len(seen), least=LEAST_SHARE),
                met("found without a size", len(found) - len(seen), len(found), most=MOST_OPEN)])


def main() -> int:
    """Run the study; 0 if the requirements are met."""
    rows, clean = numbered_rows(__doc__ or "", 200, 500, judged, show)
    return 0 if kept(rows, clean) else 1


if __name__ == "__main__":
    sys.exit(main())
