"""How often the interval covers on records without periodic excitation, and what plain least squares would have said.

    python benchmarks/record_route_coverage.py [--seeds 200] [--first 0] [--only field] [--lag-prior]

Six kinds of record on three plants, then plants whose filters are not the model's: two poles, moving averages, a pure
delay. The simulator (tests/estimation/record_bench.py) shares no code with the estimator. Per row: runs that gave a
number, misses with the lower 99 % bound of their rate, bias, scatter, median half-width, and the bias of least squares
of torque on [α, ω, 1] at the raw rate and over 0.1 s.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from tdhil.estimation.identification import identify
from tdhil.estimation.result import Identification, Options
from tdhil.recording.recording import LagPrior, Recording
from tests.estimation.record_bench import FIELD, HEAVY, MOTIONS, SERVO, Machine, Report, simulate

GROUP = 20
OTHERS = (
    Machine("two poles", 60.0, 4.0, 40.0, Report((0.20, 0.07)), Report((0.10,)), 15.0, 400.0),
    Machine("averages", 180.0, 12.0, 70.0, Report((), 0.40), Report((), 0.16), 10.0, 700.0, load_sd=6.0),
    Machine("avg + lag", 104.0, 8.0, 60.0, Report((0.10,), 0.50), Report((0.15,)), 8.0, 400.0),
    Machine("delay", 104.0, 8.0, 60.0, Report((), 0.0, 0.25), Report((0.05,)), 8.0, 400.0),
    Machine("matched", 104.0, 8.0, 60.0, Report((0.15,)), Report((0.15,)), 8.0, 400.0),
)
PLAN = [(machine, motion) for machine in (FIELD, SERVO, HEAVY) for motion in (*MOTIONS, "foreign")]
PLAN += [(machine, motion) for machine in OTHERS for motion in ("speed steps", "torque pulses", "foreign")]


def least_squares(recording: Recording, step_s: float) -> float:
    """Slope of torque on [α, ω, 1], α the difference over ``step_s`` (0: of neighbours)."""
    time_s, speed, torque = recording.time_s, recording.speed_rad_s, recording.torque_nm
    if step_s > 0.0:
        edges = np.searchsorted(time_s, np.arange(time_s[0], time_s[-1], step_s))
        edges = np.unique(edges)
        area = np.concatenate([[0.0], np.cumsum(0.5 * (torque[1:] + torque[:-1]) * np.diff(time_s))])
        length = np.diff(time_s[edges])
        alpha, middle = np.diff(speed[edges]) / length, 0.5 * (speed[edges][1:] + speed[edges][:-1])
        torque = np.diff(area[edges]) / length
    else:
        alpha, middle = np.gradient(speed, time_s), speed
    columns = np.stack([alpha, middle, np.ones_like(alpha)], axis=1)
    return float(np.linalg.lstsq(columns, torque, rcond=None)[0][0])


def lower_bound(misses: int, runs: int) -> float:
    """One-sided 99 % bound of a rate (Clopper and Pearson)."""
    from scipy.stats import beta

    return float(beta.ppf(0.01, misses, runs - misses + 1)) if misses else 0.0


def row(machine: Machine, motion: str, found: list[Identification], recordings: list[Recording], took_s: float) -> bool:
    """Prints it; does the interval cover?"""
    truth = machine.inertia
    told = [one.inertia for one in found if one.inertia is not None]
    misses = sum(not one.low <= truth <= one.high for one in told)
    error = np.array([one.value / truth - 1.0 for one in told]) if told else np.array([np.nan])
    half = np.array([0.5 * (one.high - one.low) / truth for one in told]) if told else np.array([np.nan])
    bound = lower_bound(misses, len(told))
    naive = [100.0 * np.mean([least_squares(r, step) / truth - 1.0 for r in recordings]) for step in (0.0, 0.1)]
    print(f"{machine.name:<10}{motion:<14}{len(told):>4}/{len(found):<4}{misses:>4}{misses / max(1, len(told)):>7.1%}"
          f"{bound:>7.1%}{100 * error.mean():>+8.2f}{100 * error.std():>7.2f}{100 * np.median(half):>7.2f}"
          f"{naive[0]:>+8.0f}{naive[1]:>+7.0f}{took_s / len(found):>7.2f}", flush=True)
    for reason, count in Counter(one.reason for one in found if one.inertia is None).most_common():
        print(f"{'':<24}{count:>4} × {reason}", flush=True)
    return bound <= 0.05


def main() -> int:
    """0 if no row's miss rate is above 5 % beyond doubt."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--only", default="", help="rows whose plant and motion contain this")
    parser.add_argument("--lag-prior", action="store_true", help="state the lags of one-pole filters, 5 %% sd")
    asked = parser.parse_args()
    print("plant     motion        told     misses  rate  bound  bias %     sd  half %   ls raw   0.1 s   s each")
    good = True
    for machine, motion in PLAN:
        if asked.only not in f"{machine.name} {motion}":
            continue
        prior = None
        if asked.lag_prior:
            reports = (machine.speed_report, machine.torque_report)
            lags = [report.poles[0] if report.poles else 0.0 for report in reports]
            prior = LagPrior(lags[0], 0.05 * lags[0], lags[1], 0.05 * lags[1], "the drive")
        found: list[Identification] = []
        kept: list[Recording] = []
        took_s = 0.0
        for first in range(asked.first, asked.first + asked.seeds, GROUP):
            seeds = list(range(first, min(first + GROUP, asked.first + asked.seeds)))
            recordings = simulate(machine, motion, seeds, prior=prior)
            begun_s = time.perf_counter()
            found += [identify(one, Options()) for one in recordings]
            took_s += time.perf_counter() - begun_s
            kept += recordings if len(kept) < GROUP else []
        good &= row(machine, motion, found, kept, took_s)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
