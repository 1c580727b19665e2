"""Least squares by Levenberg and Marquardt's damped Gauss-Newton steps, within bounds, some parameters held.

Written out because the profile of an interval asks for hundreds of small descents, each from a good start: a general
solver's set-up costs more than the few steps that they take. scipy's `least_squares` is the oracle in the tests.

A step solves (AᵀA + λ diag AᵀA) δ = −Aᵀ r for the parameters that are free and do not push against a bound, and is cut
at the bounds. λ falls with every success and rises with every failure; a start that is no minimum moves, one that is
stays bit for bit.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tdhil.recording.recording import BoolArray, FloatArray

Linearised = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
Residuals = Callable[[FloatArray], FloatArray]

_MOST_STEPS = 200
_MOST_TRIES = 12
_SMALL_GAIN = 1e-6        # of −2 ln L, absolute: an interval's edge is where it has risen by about 4
_SMALL_STEP = 1e-9        # of the natural scale


@dataclass(frozen=True)
class Fit:
    """The parameters and the sum of squares there."""

    theta: FloatArray
    objective: float


@dataclass(frozen=True)
class Box:
    """Bounds and natural scales of theta, (P,) each."""

    low: FloatArray
    high: FloatArray
    scale: FloatArray


def descend(linearised: Linearised, residuals: Residuals, start: FloatArray, free: BoolArray, box: Box) -> Fit:
    """From ``start`` (P,) down; only ``free`` (P,) parameters move. Arithmetic that overflows ends the descent."""
    theta = np.where(free, np.clip(start, box.low, box.high), start)
    r, a = linearised(theta)
    cost = float(r @ r)
    damping = 1e-3
    for _ in range(_MOST_STEPS):
        gradient = a.T @ r
        stuck = (theta <= box.low) & (gradient > 0.0) | (theta >= box.high) & (gradient < 0.0)
        moving = np.flatnonzero(free & ~stuck)
        if len(moving) == 0:
            break
        scaled = a[:, moving] * box.scale[moving]
        normal, pull = scaled.T @ scaled, scaled.T @ r
        size = np.diag(normal).copy()
        size[size <= 0.0] = 1.0
        gain = 0.0
        for _ in range(_MOST_TRIES):
            step = _solved(normal + np.diag(damping * size + 1e-14 * size.max()), -pull)
            trial = theta.copy()
            trial[moving] = np.clip(
                theta[moving] + step * box.scale[moving], box.low[moving], box.high[moving]
            )
            tried = residuals(trial)
            trial_cost = float(tried @ tried)
            if trial_cost < cost:
                gain = cost - trial_cost
                break
            damping *= 8.0
            if float(np.max(np.abs(step))) < _SMALL_STEP:
                break
        if gain <= 0.0:
            break
        theta = trial
        damping = max(damping / 10.0, 1e-9)
        r, a = linearised(theta)
        cost = float(r @ r)
        if gain < _SMALL_GAIN * max(1.0, 1e-3 * cost):
            break
    return Fit(theta, cost)


def _solved(matrix: FloatArray, right: FloatArray) -> FloatArray:
    try:
        return np.asarray(np.linalg.solve(matrix, right), dtype=np.float64)
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.lstsq(matrix, right, rcond=None)[0], dtype=np.float64)
