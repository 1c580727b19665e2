"""Intervals: every value that the data don't contradict, whatever the structure of the reporting filters.

The profile P(x) = min over all other parameters of −2 ln L, the filters' shapes κ among them, follows the valley in
which inertia and lags make up for each other. The interval is {x: P(x) ≤ P_min + (i t)²}: t is Student's quantile for
as many degrees of freedom as the scatter was measured with, i ≥ 1 how much more the parameter scatters over time than
the noise model says (`moments`).
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from tdhil.estimation.frequency_domain.inference import profile_edge, student_quantile
from tdhil.estimation.frequency_domain.optimiser import Fit
from tdhil.estimation.result import Estimate
from tdhil.estimation.time_domain.equation import SPEED_LAG, SPEED_SHAPE, TORQUE_LAG, TORQUE_SHAPE, evaluate
from tdhil.estimation.time_domain.fit import Problem, covariance, minimise
from tdhil.identify.record_route.moments import sandwich
from tdhil.recording.recording import FloatArray

_LEAST_DOF = 3.0
_SHAPE_STARTS = ((0.02, 0.02), (0.3, 0.1), (0.1, 0.3))


@dataclass(frozen=True)
class Spread:
    """Of one parameter: sd of the quadratic approximation, the sandwich's factor on it, the quantile.

    ``lean``: how far the other direction of regression would put the value (see `direction_gap`).
    """

    sd: float
    factor: float
    quantile: float
    lean: float


def spread(problem: Problem, fit: Fit, scores: FloatArray, index: int, confidence: float) -> Spread:
    """How uncertain a parameter is; ``scores`` of the blocks of time at this fit (`moments`)."""
    found, _ = covariance(problem, fit.theta, problem.free)
    at = problem.free.index(index)
    sd = math.sqrt(max(float(found[at, at]), 0.0))
    direction = np.zeros(len(fit.theta))
    direction[list(problem.free)] = found[at]
    blocks = sandwich(scores, direction)
    share = _shares(problem, fit.theta, direction)
    dof = 2.0 * share - len(problem.free)
    factor = math.sqrt(blocks.variance) / sd if sd > 0.0 else 1.0
    if factor > 1.0:
        dof = min(dof, blocks.count)
    lean = float(direction_gap(problem, fit.theta) @ direction)
    return Spread(sd, max(factor, 1.0), student_quantile(confidence, max(dof, _LEAST_DOF)), lean)


def direction_gap(problem: Problem, theta: FloatArray) -> FloatArray:
    """The score's shift, (10,), if all noise were in the speed instead of the torque.

    Least squares makes the residual e orthogonal to ∂G W, the speed as reported. If the noise moved the speed, T/G
    is the clean signal, W + e/G, and the normal equations gain Σ 2 Re(∂ln G* |e|²/v). The truth lies between.
    """
    bins = problem.bins
    found = evaluate(theta, bins)
    weight = np.where(bins.hertz > 0.0, 2.0, 1.0) * np.abs(found.error) ** 2 / problem.variance
    tone, nothing = np.zeros_like(bins.speed), np.zeros_like(bins.bend)
    tone[:, 0] = 1.0
    steady = replace(bins, speed=tone, torque=tone * found.gain[:, None], level=0.0 * bins.level, bend=nothing)
    logs = -evaluate(theta, steady).slopes / found.gain[:, None]
    return np.asarray((logs.real * weight[:, None]).sum(axis=0), dtype=np.float64)


def with_shapes(problem: Problem, stated: tuple[int, ...]) -> Problem:
    """The same with the filters' structure free, but for a lag that was stated: that is a one-pole filter's."""
    shapes = [shape for lag, shape in ((SPEED_LAG, SPEED_SHAPE), (TORQUE_LAG, TORQUE_SHAPE)) if lag not in stated]
    return replace(problem, free=(*problem.free, *shapes))


def best_shapes(problem: Problem, near: Fit) -> Fit:
    """The lowest of some descents from the one-pole fit."""
    fits = [near]
    for shapes in _SHAPE_STARTS:
        start = near.theta.copy()
        for index, value in zip((SPEED_SHAPE, TORQUE_SHAPE), shapes, strict=True):
            if index in problem.free:
                start[index] = value
        fits.append(minimise(problem, start))
    return min(fits, key=lambda fit: fit.objective)


def profile(problem: Problem, best: Fit, index: int, reach: float, step: float) -> Estimate:
    """Where the profile has risen by reach² on either side of ``best``; a bound, or ±inf, if it never does."""

    def refit(start: FloatArray, value: float) -> Fit:
        return minimise(problem, start, {index: value})

    low, high = (profile_edge(refit, problem.box, best, index, side * step, reach**2) for side in (-1.0, 1.0))
    return Estimate(float(best.theta[index]), low, high)


def _shares(problem: Problem, theta: FloatArray, direction: FloatArray) -> float:
    """On how many bins the parameter rests: (Σ c)²/Σ c² of their shares in its variance."""
    _, slopes = problem.stacked(theta)
    count = len(problem.bins)
    pulled = (slopes @ direction) ** 2
    each = pulled[:count] + pulled[count : 2 * count]
    return float(np.sum(each) ** 2 / max(float(np.sum(each**2)), 1e-300))
