"""Coverage and time of runs that end by the scatter, on the default simulated rig; and of runs of a fixed length.

    python benchmarks/tolerance_coverage.py --tolerance 0.01 [--runs 500] [--first 1] [--processes 1] [--fixed 145]

Every run goes through the five stages by the protocol's own code, over the simulated inverter without a bus, in
stepped time, and is identified as `tdhil identify` does. ``--fixed SECONDS`` plans for that time instead. Prints a line
for each run and, at the end: how often the interval covers, with an exact 99 % interval of that share; how often it is
as tight as asked for; and the time of stage 5. The exit code is 1 if the miss rate is above its bound beyond chance.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import TypeVar

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np

from tests.runner.inverter_runs import TRUE_KG_M2, run

T = TypeVar("T")

def bounds(hits: int, count: int, confidence: float = 0.99) -> tuple[float, float]:
    """Clopper and Pearson's exact interval of a share."""
    from scipy.stats import beta

    tail = 0.5 * (1.0 - confidence)
    low = float(beta.ppf(tail, hits, count - hits + 1)) if hits else 0.0
    return low, float(beta.ppf(1.0 - tail, hits + 1, count - hits)) if hits < count else 1.0


def over_seeds(run: Callable[..., T], asked: argparse.Namespace) -> Iterator[T]:
    """Yield ``run(seed, tolerance=…, fixed_s=…)`` for each seed that was requested, in their order."""
    one = partial(run, tolerance=asked.tolerance, fixed_s=asked.fixed)
    seeds = range(asked.first, asked.first + asked.runs)
    if asked.processes <= 1:
        yield from map(one, seeds)
        return
    with ProcessPoolExecutor(asked.processes) as pool:
        yield from pool.map(one, seeds)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--tolerance", type=float, default=0.01)
    parser.add_argument("--fixed", type=float, metavar="SECONDS", help="plan for this time instead of a tolerance")
    parser.add_argument("--runs", type=int, default=500)
    parser.add_argument("--first", type=int, default=1, help="the first seed")
    parser.add_argument("--processes", type=int, default=1)
    asked = parser.parse_args()
    begun, found = time.monotonic(), []
    for one in over_seeds(run, asked):
        found.append(one)
        print(f"{one.seed:>5} {one.value:9.3f} {one.low:9.3f} {one.high:9.3f} ±{100 * one.half:5.3f} % "
              f"{'yes' if one.covers else 'NO ':<3} {one.acquire_s:6.0f} s  {one.extensions}  {one.note}", flush=True)
    good = [one for one in found if one.value == one.value]
    covered, met = sum(one.covers for one in good), sum(one.half <= asked.tolerance for one in good)
    low, high = bounds(covered, len(good))
    half, took = np.array([one.half for one in good]), np.array([one.acquire_s for one in good])
    errors = np.array([one.value / TRUE_KG_M2 - 1.0 for one in good])
    miss_low, _ = bounds(len(good) - covered, len(good))
    print(f"{len(good)} of {len(found)} gave a number; bias {100 * errors.mean():+.4f} %, RMSE "
          f"{100 * np.sqrt(np.mean(errors**2)):.3f} %, mean half-width {100 * half.mean():.3f} %")
    print(f"covered {covered} of {len(good)}: {covered / len(good):.4f} (99 %: {low:.4f} to {high:.4f})")
    extended = np.mean([one.extensions > 0 for one in good])
    print(f"as tight as ±{100 * asked.tolerance:g} %: {met / len(good):.3f}; extended {extended:.3f}")
    early, late = np.quantile(took, (0.05, 0.95))
    print(f"stage 5 took {took.mean():.0f} s (5 % to 95 %: {early:.0f} to {late:.0f} s); "
          f"{time.monotonic() - begun:.0f} s of computing")
    return 0 if len(good) == len(found) and miss_low <= 0.05 else 1


if __name__ == "__main__":
    sys.exit(main())
