"""Every shipped profile, worn by the embedded simulator, through the five stages or their speed-mode variant.

    python benchmarks/every_profile.py [--seeds 20] [--first 1] [--profiles g120] [--max-time 60]

Every seed is `tdhil identify --simulate --profile NAME --seed N` in this process and in stepped time. A row is a
profile: verdicts, how many of the 95 % intervals miss the inertia with the exact (Clopper-Pearson) 99 % bounds of the
miss rate, mean and worst error, and the median half-width. A row fails if a run ends in trouble or with another verdict
than valid or valid_wide, if the mean is off by more than 2 %, or if the lower bound of the miss rate is above 5 %.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from statistics import fmean, median
from typing import Any

from profiles.library import load_profile, profile_names
from tdhil.cli.main import main as tdhil

TRUE_KG_M2 = 104.0
GOOD = ("valid", "valid_wide")
MOST_OFF = 0.02


def bounds(misses: int, count: int) -> tuple[float, float]:
    """Clopper and Pearson's, 99 % either side."""
    from scipy.stats import beta

    low = 0.0 if misses == 0 else float(beta.ppf(0.01, misses, count - misses + 1))
    high = 1.0 if misses == count else float(beta.ppf(0.99, misses + 1, count - misses))
    return low, high


def run(profile: str, seed: int, folder: Path, options: list[str]) -> dict[str, Any]:
    """One run's document."""
    out, err = io.StringIO(), io.StringIO()
    arguments = ["identify", "--simulate", "--json", "--profile", profile, "--seed", str(seed),
                 "--log", str(folder / "run.mcap"), *options]
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = tdhil(arguments)
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 1
    try:
        document: dict[str, Any] = json.loads(out.getvalue())
    except json.JSONDecodeError:
        document = {"error": {"message": err.getvalue()[-500:]}}
    document["exit_code"] = code
    return document


def measure(profile: str, seeds: range, options: list[str], *, every: bool) -> bool:
    """Prints one row; False if it is not good."""
    begun_s = time.process_time()
    errors, halves, misses, troubles = [], [], 0, []
    verdicts: Counter[str] = Counter()
    if load_profile(profile).watchdog.kind == "none":
        options = [*options, "--accept-no-watchdog"]
    for seed in seeds:
        with tempfile.TemporaryDirectory() as folder:
            document = run(profile, seed, Path(folder), options)
        error = document.get("error")
        if error:
            troubles.append(f"seed {seed}: exit {document['exit_code']}: {error['message']}")
            continue
        verdicts[document["verdict"]] += 1
        inertia = document.get("inertia_kg_m2")
        if document["verdict"] not in GOOD or inertia is None:
            troubles.append(f"seed {seed}: {document['verdict']}: {document.get('reason')}")
            continue
        errors.append(inertia["value"] / TRUE_KG_M2 - 1.0)
        halves.append(0.5 * (inertia["high"] - inertia["low"]) / inertia["value"])
        misses += not inertia["low"] <= TRUE_KG_M2 <= inertia["high"]
        if every:
            print(f"  seed {seed}: {inertia['value']:.2f} [{inertia['low']:.2f}, {inertia['high']:.2f}]", flush=True)
    took_s = time.process_time() - begun_s
    found = ", ".join(f"{count} {name}" for name, count in verdicts.most_common())
    low, high = bounds(misses, len(errors)) if errors else (0.0, 1.0)
    good = bool(errors) and not troubles and low <= 0.05 and abs(fmean(errors)) <= MOST_OFF
    if errors:
        worst = max(errors, key=abs)
        print(f"{profile:<24} {found:<24} {misses:>2} of {len(errors)} missed ({100 * low:4.1f} to {100 * high:4.1f} %)"
              f"  error {100 * fmean(errors):+5.2f} %, worst {100 * worst:+5.2f} %"
              f"  half-width {100 * median(halves):4.2f} %  {took_s:.0f} s", flush=True)
    for trouble in troubles:
        print(f"{profile:<24} {trouble}", flush=True)
    return good


def main() -> int:
    """Prints the table; 0 if every row is good."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--seeds", type=int, default=20, help="of each profile")
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--profiles", default="", help="only those whose name holds this")
    parser.add_argument("--every", action="store_true", help="a line for every seed, too")
    parser.add_argument("--max-time", default=None, help="of stage 5 (default: as identify has it)")
    asked = parser.parse_args()
    os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"))
    options = [] if asked.max_time is None else ["--max-time", asked.max_time]
    seeds = range(asked.first, asked.first + asked.seeds)
    # The simulated EtherCAT drive wears no profile but its own.
    names = [name for name in profile_names() if asked.profiles in name
             and (load_profile(name).bus != "ethercat" or name == "generic/cia402-ethercat")]
    good = [measure(name, seeds, options, every=asked.every) for name in names]
    return 0 if all(good) and good else 1


if __name__ == "__main__":
    sys.exit(main())
