"""Acceptance on the simulator, changed in one thing at a time: how often it is named right, and the false alarms.

    python benchmarks/acceptance.py [--runs 500] [--changed 100] [--jobs 2] [--out rows.jsonl]

``--runs`` drives are as expected, then each change is run ``--changed`` times, in stepped time; about 5 s of processor
time each. Rows are kept in ``--out``, so that the study can be stopped and continued. Wanted: what is off is named
right in 95 %, false alarms are at most 1 %. A run that ends early is not right: if nothing is changed, it counts as an
alarm. The exit code is 1 where a rate misses this beyond what chance allows (one side, 95 %).

Another drive shows by its rated torque: all that comes from the torque has one factor, above 1 (torque scale) or below
(another drive); and by its identity. The simulated drive reports its gains and its identity without an error, so these
are expected only where they are changed.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

for library in ("OPENBLAS", "OMP", "MKL"):
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.called_here import called_here  # noqa: E402
from benchmarks.cross_check_alarms import rate_bounds  # noqa: E402
from benchmarks.kept_rows import kept_rows  # noqa: E402

EXPECT = ("inertia=104±15%", "coulomb=60±12", "viscous=8±3", "speed-lag=150ms±100ms", "torque-lag=150ms±100ms",
          "torque-limit=400±10")
GAINS = ("gain=300±30", "integral-gain=300±30")
LEAST_NAMED, MOST_ALARMS = 0.95, 0.01
ENDED = "ended early"


@dataclass(frozen=True)
class Change:
    """One thing that is not as expected. ``named``: words of the cause; ``expect``: further expected values.

    The rest are sections of plant.yaml.
    """

    named: str = ""
    plant: dict[str, float] = field(default_factory=dict)
    reporting: dict[str, float] = field(default_factory=dict)
    drive: dict[str, float] = field(default_factory=dict)
    expect: tuple[str, ...] = ()


CHANGES = {
    "nothing": Change(),
    "inertia": Change("moment of inertia", plant={"inertia_kg_m2": 150.0}),
    "Coulomb friction": Change("Coulomb friction", plant={"coulomb_nm": 100.0}),
    "speed filter": Change("lag of the reported speed", reporting={"speed_lag_s": 0.45}),
    "torque scale": Change("another torque scale", reporting={"torque_scale": 1.3}),
    "torque limit": Change("torque limit", drive={"torque_limit_nm": 300.0}),
    "viscous friction": Change("viscous friction", plant={"viscous_nm_s_rad": 16.0}),
    "torque filter": Change("lag of the reported torque", reporting={"torque_lag_s": 0.45}),
    "another drive": Change("another rated torque", reporting={"torque_scale": 0.7}),
    "gain": Change("gain P of the drive", drive={"speed_gain_nm_s_rad": 450.0}, expect=GAINS),
    "integral gain": Change("integral gain I", drive={"speed_integral_gain_nm_rad": 450.0}, expect=GAINS),
    "another profile": Change("profile of the drive", expect=("profile=maxon/epos4",)),
}


def run(name: str, seed: int, folder: Path) -> dict[str, Any]:
    """One run of a change: its verdict, and what is off."""
    change = CHANGES[name]
    plant = folder / "plant.yaml"
    plant.write_text(json.dumps({                                                       # JSON is YAML
        "plant": {"inertia_kg_m2": 104.0, "viscous_nm_s_rad": 8.0, "coulomb_nm": 60.0} | change.plant,
        "reporting": {"speed_lag_s": 0.15} | change.reporting, "drive": change.drive,
    }), encoding="utf-8")
    arguments = ["identify", "--simulate", "--seed", str(seed), "--rate", "50", "--json", "--plant", str(plant),
                 "--log", str(folder / "run.mcap")]
    for text in (*EXPECT, *change.expect):
        arguments += ["--expect", text]
    here = called_here(arguments)
    found = here.document.get("acceptance") or {"verdict": ENDED, "off": []}
    if change.named:
        right = len(found["off"]) == 1 and change.named in found["off"][0]
    else:
        right = found["verdict"] not in ("fail", ENDED)
    return {"case": f"{name} {seed}", "change": name, "exit_code": here.code, "verdict": found["verdict"],
            "off": found["off"], "right": right, "said": "" if here.document else here.said[-300:]}


def work(case: str) -> dict[str, Any]:
    """One case, in a folder of its own."""
    name, seed = case.rsplit(" ", 1)
    with tempfile.TemporaryDirectory() as folder:
        return run(name, int(seed), Path(folder))


def show(row: dict[str, Any]) -> None:
    """Print a run that is not judged right."""
    if not row["right"]:
        print(f"{row['case']:<24} exit {row['exit_code']} {row['verdict']} {row['off']} {row['said']}", flush=True)


def summary(rows: Sequence[dict[str, Any]]) -> bool:
    """Print the rates; True if each is as good as wanted, or may be by chance."""
    good = True
    for name, change in CHANGES.items():
        mine = [row for row in rows if row["change"] == name]
        if not mine:
            continue
        right = sum(row["right"] for row in mine)
        ended = sum(row["verdict"] == ENDED for row in mine)
        low, high = rate_bounds(right, len(mine))
        if change.named:
            print(f"{name}: named right in {right} of {len(mine)} (at least {100.0 * low:.1f} %), {ended} ended early")
            good = good and high >= LEAST_NAMED
        else:
            passed = sum(row["verdict"] == "pass" for row in mine)
            print(f"as expected: {len(mine) - right} false alarms of {len(mine)} "
                  f"(at most {100.0 * (1.0 - low):.2f} %), {passed} pass, {ended} ended early")
            good = good and 1.0 - high <= MOST_ALARMS
    return good


def main() -> int:
    """Run what `--out` does not have, and print the rates."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=500, help="drives that are as expected (500)")
    parser.add_argument("--changed", type=int, default=100, help="drives of each change (100)")
    parser.add_argument("--jobs", type=int, default=1, help="processes (1)")
    parser.add_argument("--out", type=Path, help="results as JSON lines; cases that stand there are not run again")
    asked = parser.parse_args()
    cases = [f"{name} {100_000 * k + seed}" for k, name in enumerate(CHANGES)
             for seed in range(asked.changed if k else asked.runs)]
    wanted = set(cases)
    rows = kept_rows(asked.out, "case", cases, work, show, asked.jobs)
    return 0 if summary([row for row in rows if row["case"] in wanted]) else 1


if __name__ == "__main__":
    sys.exit(main())
