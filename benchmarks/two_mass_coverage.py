"""Two masses and the distributed string: bias, scatter and coverage of J_r, J_L, k and J_r + J_L.

    python benchmarks/two_mass_coverage.py [--seeds 200] [--plant two-mass|string] [--lags known|estimated|both]
                                           [--model auto|two-mass|string] [--noise 1.0] [--first 1]

The plants and their time series are of tests/estimation/compliant_bench.py, which shares no code with the estimator:
1500 and 374 kg·m², k 473 N·m/rad, c 23.2 N·m·s/rad (or 2300 m of drill pipe between the two), 240 s, 11 lines from 0.05
to 0.9 Hz, reporting lags 0.40 and 0.15 s, a noise that puts the Cramér-Rao bounds where the notes have them. Every
recording goes through `identify`. ``--noise`` scales the noise; lags known: stated to 1 % (1 sd), and as
wrong as that.

Prints, for each quantity: bias and root mean square error, the median half-width, misses, and the lower 99 % bound of
the miss rate (Clopper and Pearson), which must not be above 5 %. The exit code is 1 if one is.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np

from tdhil.estimation import Identification, Options, identify
from tdhil.recording.recording import LagPrior, Recording
from tests.estimation.compliant_bench import Noise, Pipe, TwoMass, run

PLANTS = {"two-mass": (TwoMass(), 4), "string": (Pipe(), 8)}      # with the periods to settle
LAGS_S, LAG_REL_SD = (0.40, 0.15), 0.01
AT_ONCE = 25
MOST_MISSES = 0.05


def stated(seed: int) -> LagPrior:
    """Return a manual's statement of the lags, with a random error of its own deviation."""
    wrong = np.random.default_rng([seed, 1]).standard_normal(2)
    return LagPrior(LAGS_S[0] * (1.0 + LAG_REL_SD * wrong[0]), LAGS_S[0] * LAG_REL_SD,
                    LAGS_S[1] * (1.0 + LAG_REL_SD * wrong[1]), LAGS_S[1] * LAG_REL_SD, "the manual")


def recordings(plant: str, seeds: range, known: bool, scale: float) -> Iterator[Recording]:
    body, settle = PLANTS[plant]
    usual = Noise()
    noise = Noise(scale * usual.load_nm, scale * usual.sensor_rad_s, scale * usual.torque_nm,
                  min(scale, 1.0) * usual.quantum_rad_s, min(scale, 1.0) * usual.quantum_nm)
    for first in range(0, len(seeds), AT_ONCE):
        some = list(seeds[first : first + AT_ONCE])
        for seed, found in zip(some, run(body, some, noise=noise, lags_s=LAGS_S, settle=settle), strict=True):
            yield replace(found, lag_prior=stated(seed)) if known else found


def quantities(found: Identification) -> dict[str, tuple[float, float, float]]:
    shaft = found.compliant
    every = {"J_r": found.inertia}
    if shaft is not None:
        every |= {"J_L": shaft.load_inertia, "k": shaft.stiffness_nm_rad, "J_r + J_L": shaft.total_inertia}
    return {name: (one.value, one.low, one.high) for name, one in every.items() if one is not None}


def miss_bound(misses: int, of: int) -> float:
    from scipy.stats import beta

    return float(beta.ppf(0.01, misses, of - misses + 1)) if misses else 0.0


def study(plant: str, lags: str, seeds: range, model: str, scale: float) -> bool:
    """One table; True if every miss rate may be 5 %."""
    body, _ = PLANTS[plant]
    truth = {"J_r": body.motor, "J_L": body.load, "k": body.stiffness, "J_r + J_L": body.total}
    seen: dict[str, list[tuple[float, float, float]]] = {name: [] for name in truth}
    stood: Counter[str] = Counter()
    begun = time.monotonic()
    for recording in recordings(plant, seeds, lags == "known", scale):
        found = identify(recording, Options(model=model))
        stood[f"{found.model} {found.verdict.value}"] += 1
        for name, values in quantities(found).items():
            seen[name].append(values)
    took = time.monotonic() - begun
    asked = f"{plant}, lags {lags}, --model {model}, noise × {scale:g}"
    print(f"\n{asked}: {len(seeds)} seeds in {took:.0f} s; {dict(stood)}")
    print(f"{'':>10} {'bias':>8} {'RMSE':>8} {'worst':>8} {'± median':>9} {'missed':>12} {'99 % bound':>11}")
    good = True
    for name, rows in seen.items():
        if not rows:
            print(f"{name:>10}  never given")
            continue
        value, low, high = np.array(rows).T
        error = value / truth[name] - 1.0
        misses = int(np.sum((truth[name] < low) | (truth[name] > high)))
        bound = miss_bound(misses, len(rows))
        good &= bound <= MOST_MISSES
        half = float(np.median(high - low)) / 2.0 / truth[name]
        print(f"{name:>10} {error.mean():>+8.2%} {np.sqrt(np.mean(error**2)):>8.2%} {np.abs(error).max():>8.2%} "
              f"{half:>9.2%} {misses:>5} of {len(rows):>3} {bound:>11.1%}", flush=True)
    return good


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--plant", choices=(*PLANTS, "both"), default="both")
    parser.add_argument("--lags", choices=("known", "estimated", "both"), default="both")
    parser.add_argument("--model", choices=("auto", "two-mass", "string"), default="auto")
    parser.add_argument("--noise", type=float, default=1.0)
    asked = parser.parse_args()
    seeds = range(asked.first, asked.first + asked.seeds)
    plants = list(PLANTS) if asked.plant == "both" else [asked.plant]
    lags = ["known", "estimated"] if asked.lags == "both" else [asked.lags]
    good = [study(plant, lag, seeds, asked.model, asked.noise) for plant in plants for lag in lags]
    return 0 if all(good) else 1


if __name__ == "__main__":
    sys.exit(main())
