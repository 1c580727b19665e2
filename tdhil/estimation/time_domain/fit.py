"""Weighted least squares over the bins: −2 ln L for a given noise, within bounds, with priors.

A bin's residual is a circular complex number of variance v: it adds 2|e|²/v; at frequency zero it is real and adds
e²/v.
"""

from dataclasses import dataclass

import numpy as np

from tdhil.estimation.frequency_domain.model import GaussianPrior
from tdhil.estimation.frequency_domain.optimiser import Box, Fit
from tdhil.estimation.frequency_domain.signal_filters import LAG_BOUND_S, SKEW_BOUND_S
from tdhil.estimation.time_domain.equation import (
    INERTIA,
    MOST_SHAPE,
    PARAMETERS,
    SKEW,
    SPEED_LAG,
    SPEED_SHAPE,
    TORQUE_LAG,
    TORQUE_SHAPE,
    VISCOUS,
    evaluate,
)
from tdhil.estimation.time_domain.windows import Bins
from tdhil.recording.recording import FloatArray

_TOLERANCE = 1e-9


@dataclass(frozen=True)
class Problem:
    """The equations, their noise, what is known beforehand, and which parameters are free."""

    bins: Bins
    variance: FloatArray
    priors: tuple[GaussianPrior, ...]
    free: tuple[int, ...]
    box: Box

    def stacked(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Real residuals (R,) whose sum of squares is −2 ln L, and their slopes (R, 10)."""
        found = evaluate(theta, self.bins)
        factor = np.where(self.bins.hertz > 0.0, np.sqrt(2.0), 1.0) / np.sqrt(self.variance)
        error, slopes = found.error * factor, found.slopes * factor[:, None]
        known = np.array([(theta[p.index] - p.mean) / p.sd for p in self.priors])
        rows = np.zeros((len(self.priors), PARAMETERS))
        for row, prior in enumerate(self.priors):
            rows[row, prior.index] = 1.0 / prior.sd
        return np.concatenate([error.real, error.imag, known]), np.concatenate([slopes.real, slopes.imag, rows])

    def equations(self) -> int:
        """Real equations, priors included."""
        return int(np.sum(np.where(self.bins.hertz > 0.0, 2, 1))) + len(self.priors)


def box(inertia: float, middle_rad_s: float, torque_nm: float, priors: tuple[GaussianPrior, ...]) -> Box:
    """Lags in [0, 2] s, |skew| ≤ 1 s, κ in [0, ½], J ≥ 0; wider where a prior says so."""
    low, high, scale = np.full(PARAMETERS, -np.inf), np.full(PARAMETERS, np.inf), np.full(PARAMETERS, torque_nm)
    low[INERTIA], low[[SPEED_LAG, TORQUE_LAG, SPEED_SHAPE, TORQUE_SHAPE]] = 0.0, 0.0
    high[[SPEED_LAG, TORQUE_LAG]], high[[SPEED_SHAPE, TORQUE_SHAPE]] = LAG_BOUND_S, MOST_SHAPE
    low[SKEW], high[SKEW] = -SKEW_BOUND_S, SKEW_BOUND_S
    for prior in priors:
        high[prior.index] = max(high[prior.index], prior.mean + 6.0 * prior.sd)
    scale[INERTIA], scale[VISCOUS] = inertia, inertia * middle_rad_s
    scale[[SPEED_LAG, TORQUE_LAG, SKEW]], scale[[SPEED_SHAPE, TORQUE_SHAPE]] = (0.1, 0.1, 0.05), 0.25
    return Box(low, high, scale)


def minimise(problem: Problem, start: FloatArray, held: dict[int, float] | None = None) -> Fit:
    """One descent from ``start``; what is not free, or held, keeps its value."""
    from scipy.optimize import least_squares

    held = held or {}
    free = np.array([index for index in problem.free if index not in held])
    full = np.array(start, dtype=np.float64)
    for index, value in held.items():
        full[index] = value
    limits = problem.box
    low, high, scale = limits.low[free], limits.high[free], limits.scale[free]
    latest: list[tuple[bytes, FloatArray]] = []

    def at(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        theta = full.copy()
        theta[free] = x
        return problem.stacked(theta)

    def residuals(x: FloatArray) -> FloatArray:
        error, slopes = at(x)
        latest[:] = [(x.tobytes(), slopes)]
        return error

    def jacobian(x: FloatArray) -> FloatArray:
        slopes = latest[0][1] if latest and latest[0][0] == x.tobytes() else at(x)[1]
        return slopes[:, free]

    inset = 1e-9 * scale
    begin = np.clip(full[free], low + inset, high - inset)
    found = least_squares(residuals, begin, jac=jacobian, bounds=(low, high), x_scale=scale, xtol=_TOLERANCE,
                          ftol=_TOLERANCE, gtol=_TOLERANCE, max_nfev=60)
    full[free] = found.x
    return Fit(full, float(2.0 * found.cost))


def covariance(problem: Problem, theta: FloatArray, free: tuple[int, ...]) -> tuple[FloatArray, FloatArray]:
    """Of the free parameters in the quadratic approximation (F, F), and the leverage of every bin (M,)."""
    _, slopes = problem.stacked(theta)
    scale = problem.box.scale[list(free)]
    u, sizes, vt = np.linalg.svd(slopes[:, list(free)] * scale, full_matrices=False)
    kept = sizes > 1e-10 * max(float(sizes[0]), 1e-300)
    inverse = vt[kept].T / sizes[kept]
    found = (inverse @ inverse.T) * np.outer(scale, scale)
    rows = np.sum(u[:, kept] ** 2, axis=1)
    count = len(problem.bins)
    each = np.where(problem.bins.hertz > 0.0, 0.5, 1.0)
    return found, each * (rows[:count] + rows[count : 2 * count])

