"""The plan that is chosen against the best of many random ones of the same length, by the interval that the estimator
would give: is there a better choice of lines, amplitudes and mean speeds, and by how much?

    python benchmarks/plan_against_random.py [--random 200] [--plants field heavy ...] [--judged 12]

A random plan has lines and amplitudes at random, phased at random, about two mean speeds at random, as large as the
limits allow. Like any plan it has no line above what lags of unknown structure allow (`highest_line_hz`), unless
``--beyond`` lets it. All are rated by the information bound; the interval itself is worked out for the best of them.
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import replace

import numpy as np

from tdhil.recording import LagPrior
from tdhil.runner import ControlAssumptions, DesignKnowledge, Guard
from tdhil.runner.design import NoiseDensity, choose, expected_half_width
from tdhil.runner.design.choice import highest_line_hz, relative_sd
from tdhil.runner.excitation import (
    MotionLimits,
    Plan,
    PlanRefused,
    PlanRequest,
    RigGuess,
    Shape,
    make_plan,
    unit_peak,
)
from tdhil.studies.coverage.plants import FLEET, CoveragePlant

CONFIDENCE = 0.95
GOAL = 1.10
"""Half-width of the chosen plan over that of the best random one."""

HIGHEST_HARMONIC = 12
BEYOND_HZ = 3.0


def machine(plant: CoveragePlant) -> tuple[MotionLimits, RigGuess, DesignKnowledge]:
    """A plant as stages 2 and 3 would show it."""
    limits = MotionLimits(*plant.window_rad_s, plant.torque_limit_nm, Guard.foresight_s(ControlAssumptions()))
    noise = plant.noise
    known = DesignKnowledge(
        NoiseDensity(2.0 * noise.load_nm**2 * noise.load_time_s, noise.sensor_rad_s**2 * plant.step_s,
                     noise.load_time_s),
        LagPrior(),
    )
    return limits, RigGuess(plant.inertia_kg_m2, plant.viscous_nm_s_rad, plant.coulomb_nm), known


def random_plan(
    rng: np.random.Generator, limits: MotionLimits, guess: RigGuess, length_s: float, highest_hz: float
) -> Plan | None:
    """One of at most this length; None where it doesn't fit."""
    count = int(rng.integers(3, 8))
    harmonics = tuple(sorted({1, *map(int, rng.choice(np.arange(2, HIGHEST_HARMONIC + 1), count - 1, replace=False))}))
    slope = rng.uniform(0.3, 2.5)
    amplitudes = tuple(float(harmonic**-slope * rng.uniform(0.5, 1.5)) for harmonic in harmonics)
    shape = unit_peak(Shape(harmonics, amplitudes, tuple(map(float, rng.uniform(0.0, 2.0 * math.pi, len(harmonics))))))
    reach = math.exp(rng.uniform(math.log(0.3), 0.0))
    wish = PlanRequest(
        shape=shape, frequency_hz=reach * highest_hz / harmonics[-1],
        offset_share=float(rng.uniform(0.15, 0.45)),
    )
    try:
        plan = make_plan(limits, guess, wish)
        one = plan.segments[0]
        between = plan.duration_s - sum(segment.duration_s for segment in plan.segments)
        whole = math.floor((length_s - between) / (len(plan.segments) * one.reference.period_s))
        return plan.with_counted(whole - one.settle_periods) if whole - one.settle_periods >= 3 else None
    except PlanRefused:
        return None


def compare(
    plant: CoveragePlant, number: int, judged: int, seed: int, beyond: bool
) -> tuple[float, float, float]:
    """Half-widths of the chosen plan and of the best random one, and their common length."""
    limits, guess, known = machine(plant)
    theta = known.theta(guess)
    chosen = choose(limits, guess, PlanRequest(), known, CONFIDENCE)
    rng = np.random.default_rng(seed)
    highest_hz = BEYOND_HZ if beyond else highest_line_hz(max(known.speed_lag_s, known.torque_lag_s))
    found: list[tuple[float, int, Plan]] = []
    for index in range(number):
        plan = random_plan(rng, limits, guess, chosen.plan.duration_s, highest_hz)
        if plan is not None:
            found.append((relative_sd(plan, theta, known.noise, known.prior), index, plan))
    widths = [
        expected_half_width(plan, theta, known.noise, known.prior, CONFIDENCE) for _, _, plan in sorted(found)[:judged]
    ]
    return chosen.half_width, min(widths, default=math.inf), chosen.plan.duration_s


def main() -> int:
    """A line for each plant; 0 if the chosen plan is within the goal on all."""
    plants = {plant.name: replace(plant) for plant in FLEET}
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--random", type=int, default=200, help="plans at random, for each plant")
    parser.add_argument("--judged", type=int, default=12, help="of them, whose interval is worked out")
    parser.add_argument("--plants", nargs="+", choices=tuple(plants), default=list(plants)[:10])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--beyond", action="store_true", help=f"random lines up to {BEYOND_HZ:g} Hz")
    asked = parser.parse_args()
    worst = 0.0
    for name in asked.plants:
        chosen, best, length_s = compare(plants[name], asked.random, asked.judged, asked.seed, asked.beyond)
        worst = max(worst, chosen / best)
        print(f"{name:>16} {length_s:5.0f} s  chosen ±{100 * chosen:.2f} %  best of {asked.random} random"
              f" ±{100 * best:.2f} %  ratio {chosen / best:.2f}", flush=True)
    print(f"worst ratio {worst:.2f}, goal {GOAL:.2f}")
    return 0 if worst <= GOAL else 1


if __name__ == "__main__":
    sys.exit(main())
