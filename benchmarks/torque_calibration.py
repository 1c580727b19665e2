"""Random simulated drives through the whole path of a torque calibration: two runs each, then `tdhil calibrate torque`.

    python benchmarks/torque_calibration.py [--runs 200] [--first 1] [--logs FOLDER] [--only-logs] [--out rows.jsonl]
                                            [--jobs 1]

Every drive has a torque scale that is wrong by up to ±8 % (uniform), a body of 5 to 100 % of its inertia, and random
lags and friction; the friction of the run with the body is its own. Logs are kept in ``--logs`` and used again. Rows
are kept in ``--out``, so that a study can be stopped, continued and added to. A case takes some 25 s of processor time:
two runs of the whole path, and the joint fit. ``--jobs`` cases run beside each other.

Prints a line for each drive and, at the end, over all rows of ``--out``, how often the intervals of the calibration
factor and of J cover the truth, how wide they are, which line of the budget is the largest, and what was refused. The
exit code is 1 where a figure misses what is asked of it.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections import Counter
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import yaml

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.in_processes import in_processes  # noqa: E402
from benchmarks.kept_rows import kept_rows  # noqa: E402

LARGEST_SCALE_ERROR = 0.08
ASSUMED_HALF_WIDTH = 0.0392
"""Share of J: half-width at 95 % of the 2 % (1 sd) that tdhil assumes for a torque scale."""
LEAST_COVERED, MOST_COVERED = 0.93, 0.99
WIDEST_HALF_BODY, WIDEST_EQUAL_BODY = 0.012, 0.009


@dataclass(frozen=True)
class RandomDrive:
    """One drive of the study. ``plant``: its plant.yaml without the body; ``scale``: reported over true torque."""

    seed: int
    inertia_kg_m2: float
    added_kg_m2: float
    scale: float
    plant: dict[str, Any]
    plant_with: dict[str, Any]


def random_drive(seed: int) -> RandomDrive:
    """The drive of this seed."""
    rng = np.random.default_rng([28, seed])
    inertia = float(np.exp(rng.uniform(np.log(50.0), np.log(200.0))))
    share = float(rng.uniform(0.05, 1.0))
    scale = 1.0 + float(rng.uniform(-LARGEST_SCALE_ERROR, LARGEST_SCALE_ERROR))
    shaft = {
        "inertia_kg_m2": inertia, "viscous_nm_s_rad": float(rng.uniform(2.0, 15.0)),
        "coulomb_nm": float(rng.uniform(20.0, 80.0)),
    }
    reporting = {
        "speed_lag_s": float(rng.uniform(0.0, 0.6)), "torque_lag_s": float(rng.uniform(0.0, 0.3)),
        "torque_scale": scale,
    }
    grown = {
        **shaft, "added_inertia_kg_m2": share * inertia,
        "viscous_nm_s_rad": shaft["viscous_nm_s_rad"] * float(rng.uniform(1.0, 1.3)),
        "coulomb_nm": shaft["coulomb_nm"] * float(rng.uniform(1.0, 1.3)),
    }
    return RandomDrive(
        seed, inertia, share * inertia, scale,
        {"plant": shaft, "reporting": reporting}, {"plant": grown, "reporting": reporting},
    )


def recorded(drive: RandomDrive, folder: Path) -> tuple[Path, Path]:
    """The two logs of this drive; made where they are not there yet."""
    paths = folder / f"{drive.seed}-without.mcap", folder / f"{drive.seed}-with.mcap"
    for number, (path, plant) in enumerate(zip(paths, (drive.plant, drive.plant_with), strict=True)):
        if path.exists():
            continue
        file, fresh = path.with_suffix(".yaml"), path.with_suffix(".new")
        file.write_text(yaml.safe_dump(plant), encoding="utf-8")
        command = [sys.executable, "-m", "tdhil", "identify", "--simulate", "--rate", "100", "--plant", str(file),
                   "--seed", str(2 * drive.seed + number), "--log", str(fresh), "--json"]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        if not fresh.exists():
            print(f"{path.name}: {done.stderr[-300:]}", flush=True)
            continue
        fresh.rename(path)
    return paths


def calibrated(drive: RandomDrive, paths: tuple[Path, Path]) -> dict[str, Any]:
    """The document of `tdhil calibrate torque`, with the exit code."""
    command = [sys.executable, "-m", "tdhil", "calibrate", "torque", *map(str, paths),
               "--added", repr(drive.added_kg_m2), "--added-sd", "0", "--json"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    document: dict[str, Any] = json.loads(done.stdout) if done.stdout.strip() else {"error": done.stderr[-300:]}
    return document | {"exit_code": done.returncode}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--logs", type=Path, default=Path("torque-calibration-logs"))
    parser.add_argument("--only-logs", action="store_true", help="record, and calibrate nothing yet")
    parser.add_argument("--out", type=Path, help="JSON lines: rows of earlier parts are read, new ones appended")
    parser.add_argument("--jobs", type=int, default=1, help="cases beside each other")
    asked = parser.parse_args()
    asked.logs.mkdir(parents=True, exist_ok=True)
    seeds, logs = range(asked.first, asked.first + asked.runs), asked.logs.resolve()
    if asked.only_logs:
        for seed, _ in zip(seeds, in_processes(partial(recorded_case, logs=logs), seeds, asked.jobs), strict=True):
            print(f"{seed}: recorded", flush=True)
        return 0
    rows = kept_rows(asked.out, "seed", seeds, partial(case, logs=logs), lambda row: None, asked.jobs)
    return summary([CalibrationRow(**row) for row in rows])


def recorded_case(seed: int, logs: Path) -> tuple[Path, Path]:
    """The two logs of a seed; made where they are not there yet."""
    return recorded(random_drive(seed), logs)


def case(seed: int, logs: Path) -> dict[str, Any]:
    """The row of a seed: recorded where needed, calibrated, held against the truth, and printed."""
    drive = random_drive(seed)
    return asdict(judged(drive, calibrated(drive, recorded(drive, logs))))


@dataclass(frozen=True)
class CalibrationRow:
    """Result for one drive. Half-widths are shares of the value; None: refused. ``largest``: line of J's budget."""

    seed: int
    share: float
    verdict: str
    covers_scale: bool | None
    covers_inertia: bool | None
    half_width: float | None
    largest: str = ""


def judged(drive: RandomDrive, document: dict[str, Any]) -> CalibrationRow:
    """Held against the truth, and printed."""
    share = drive.added_kg_m2 / drive.inertia_kg_m2
    verdict = str(document.get("verdict", document.get("error", "no document")))
    scale, inertia = document.get("calibration_factor"), document.get("inertia_kg_m2")
    if not scale or not inertia:
        row = CalibrationRow(drive.seed, share, verdict, None, None, None)
    else:
        half = 0.5 * (inertia["high"] - inertia["low"]) / inertia["value"]
        largest = max(document["budget"], key=lambda line: float(line["of_inertia"]))["source"]
        row = CalibrationRow(
            drive.seed, share, verdict, scale["low"] <= 1.0 / drive.scale <= scale["high"],
            inertia["low"] <= drive.inertia_kg_m2 <= inertia["high"], half,
            str(largest).replace(f"{drive.seed}-", ""),
        )
        errors = scale["value"] * drive.scale - 1.0, inertia["value"] / drive.inertia_kg_m2 - 1.0
        print(f"{drive.seed:4d} J_a/J {share:4.2f} κ {errors[0]:+.2%} J {errors[1]:+.2%} ± {half:.2%} "
              f"{'' if row.covers_scale and row.covers_inertia else 'MISSED '}{verdict}", flush=True)
        return row
    print(f"{drive.seed:4d} J_a/J {share:4.2f} {verdict}: {document.get('reason', '')}", flush=True)
    return row


def summary(rows: list[CalibrationRow]) -> int:
    """The figures at the end; 1 where one misses what is asked."""
    told = [row for row in rows if row.half_width is not None]
    wrong = 0
    for name, covered in (("κ", [row.covers_scale for row in told]), ("J", [row.covers_inertia for row in told])):
        share = sum(map(bool, covered)) / max(len(covered), 1)
        print(f"{name}: {sum(map(bool, covered))} of {len(covered)} cover ({share:.1%}; "
              f"{LEAST_COVERED:.0%} to {MOST_COVERED:.0%} asked)")
        wrong |= len(rows) >= 200 and not LEAST_COVERED <= share <= MOST_COVERED
    for least, widest in ((0.5, WIDEST_HALF_BODY), (0.9, WIDEST_EQUAL_BODY)):
        widths = [row.half_width for row in told if row.share >= least and row.half_width is not None]
        if widths:
            print(f"J_a ≥ {least:g} J: median half-width {median(widths):.2%} of {len(widths)} (at most {widest:.1%})")
            wrong |= median(widths) > widest
    for source, count in Counter(row.largest for row in told if row.share >= 0.5).most_common():
        print(f"J_a ≥ 0.5 J: largest line of the budget of J: {source} ({count})")
    refused = [row for row in rows if row.half_width is None]
    wide = [row for row in told if (row.half_width or 0.0) > ASSUMED_HALF_WIDTH]
    print(f"{len(refused)} refused; {len(wide)} told though wider than ±{ASSUMED_HALF_WIDTH:.1%}")
    return int(wrong or bool(wide))


if __name__ == "__main__":
    sys.exit(main())
