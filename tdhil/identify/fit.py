"""Minimise −2 ln L from several starts, within bounds, with parameters held fixed where asked."""

from dataclasses import dataclass

import numpy as np

from tdhil.identify.likelihood import LAG_BOUND_S, SKEW_BOUND_S, Likelihood
from tdhil.identify.rigid import INERTIA, SKEW, SPEED_LAG, TORQUE_LAG, VISCOUS, SpeedReport, impedance
from tdhil.record.recording import FloatArray

# τ_w, τ_T, d to start from besides what linear least squares proposes: the field rig's, and its mirror image
_STARTS = ((0.40, 0.15, 0.0), (0.15, 0.40, 0.0))
_SKEWS = (-0.2, -0.1, -0.05, -0.02, 0.0, 0.02, 0.05, 0.1, 0.2)
_PROPOSALS = 3
_TOLERANCE = 1e-8
_AVERAGE_CYCLES = 0.4   # a moving average of 2τ has a zero at 1/2τ: lines must stay well below it


@dataclass(frozen=True)
class Fit:
    """The best parameters theta = (J, B, τ_w, τ_T, d) and their −2 ln L."""

    theta: FloatArray
    objective: float


@dataclass(frozen=True)
class Box:
    """Bounds and natural scales of theta, (5,) each."""

    low: FloatArray
    high: FloatArray
    scale: FloatArray


def box(problem: Likelihood, rough_inertia: float) -> Box:
    """Lags in [0, 2] s, |skew| ≤ 0.3 s, J > 0; wider where a prior says so."""
    low = np.array([1e-6 * rough_inertia, -np.inf, 0.0, 0.0, -SKEW_BOUND_S])
    high = np.array([1e6 * rough_inertia, np.inf, LAG_BOUND_S, LAG_BOUND_S, SKEW_BOUND_S])
    if problem.report is SpeedReport.MOVING_AVERAGE:
        highest = float(np.max(np.abs(problem.s))) / (2.0 * np.pi)
        high[SPEED_LAG] = min(LAG_BOUND_S, _AVERAGE_CYCLES / highest)
    for prior in problem.priors:
        high[prior.index] = max(high[prior.index], prior.mean + 6.0 * prior.sd)
    middle = float(np.median(np.abs(problem.s)))
    return Box(low, high, np.array([rough_inertia, rough_inertia * middle, 0.1, 0.1, 0.05]))


def rough_inertia_of(problem: Likelihood) -> float:
    """|T|/(ω|W|) of the lowest line: the right size, whatever the lags."""
    first = problem.owner == 0
    ratio = np.abs(problem.torque[first]) / np.maximum(np.abs(problem.speed[first] * problem.s[0]), 1e-300)
    return float(np.median(ratio))


def minimise(problem: Likelihood, limits: Box, start: FloatArray, fixed: dict[int, float] | None = None) -> Fit:
    """One descent; the parameters in ``fixed`` keep their value."""
    from scipy.optimize import least_squares

    held = fixed or {}
    free = np.array([index for index in range(len(start)) if index not in held])
    full = np.array(start, dtype=np.float64)
    for index, value in held.items():
        full[index] = value

    def residuals(x: FloatArray) -> FloatArray:
        theta = full.copy()
        theta[free] = x
        return problem.residuals(theta)

    def jacobian(x: FloatArray) -> FloatArray:
        theta = full.copy()
        theta[free] = x
        return problem.jacobian(theta)[:, free]

    low, high = limits.low[free], limits.high[free]
    inset = 1e-9 * limits.scale[free]
    begin = np.clip(full[free], low + inset, high - inset)
    found = least_squares(
        residuals,
        begin,
        jac=jacobian,
        bounds=(low, high),
        x_scale=limits.scale[free],
        xtol=_TOLERANCE,
        ftol=_TOLERANCE,
        gtol=_TOLERANCE,
        max_nfev=100,
    )
    theta = full.copy()
    theta[free] = found.x
    return Fit(theta, float(2.0 * found.cost))


def best_fit(problem: Likelihood, limits: Box, fixed: dict[int, float] | None = None, near: Fit | None = None) -> Fit:
    """The lowest of several descents; the first of equals, so that the same data give the same bits.

    ``near``: the fit of a kindred problem, tried besides one proposal instead of all of them.
    """
    proposals = sorted(_proposals(problem, limits), key=problem.objective)
    starts = proposals[:_PROPOSALS] if near is None else [near.theta, *proposals[:1]]
    if near is None:
        starts += [_start(problem, lags) for lags in _STARTS]
    fits = [minimise(problem, limits, start, fixed) for start in starts]
    return min(fits, key=lambda fit: fit.objective)


def _start(problem: Likelihood, lags: tuple[float, float, float]) -> FloatArray:
    """With the lags given, J and B follow from the lines by linear least squares: G/filters = J s + B."""
    theta = np.array([1.0, 0.0, *lags])
    theta[INERTIA], theta[VISCOUS] = 0.0, 1.0
    filters = impedance(theta, problem.s, problem.report)[problem.owner]
    seen = problem.torque / (filters * problem.speed)
    s = problem.s[problem.owner]
    weight = np.abs(problem.speed)
    inertia = float(np.sum(weight * seen.imag * s.imag) / np.sum(weight * s.imag**2))
    viscous = float(np.sum(weight * seen.real) / np.sum(weight))
    if inertia <= 0.0:
        inertia = rough_inertia_of(problem)
    theta[[INERTIA, VISCOUS, SPEED_LAG, TORQUE_LAG, SKEW]] = (inertia, viscous, *lags)
    return theta


def _proposals(problem: Likelihood, limits: Box) -> list[FloatArray]:
    """Starts by linear least squares: for a given skew, first-order lags make the equation linear.

    With T' = T e^(ds):  T' = (J τ_w) s² W + (J + B τ_w) s W + B W − τ_T s T', four real unknowns, each equation divided
    by its standard deviation. J and τ_w follow from a = J τ_w and b = J + B τ_w, hence B τ_w² − b τ_w + a = 0, smaller
    root.
    """
    found = []
    s = problem.s[problem.owner]
    w = problem.speed
    ratio = np.bincount(problem.owner, weights=np.abs(problem.torque / w)) / problem.segments
    weight = problem.root_periods / np.sqrt(problem.variance(ratio.astype(np.complex128)))[problem.owner]
    for skew in _SKEWS:
        shifted = problem.torque * np.exp(skew * s)
        columns = np.stack([s * s * w, s * w, w, -s * shifted], axis=1) * weight[:, None]
        target = shifted * weight
        both = np.concatenate([columns.real, columns.imag])
        scale = np.maximum(np.linalg.norm(both, axis=0), 1e-300)
        x = np.linalg.lstsq(both / scale, np.concatenate([target.real, target.imag]), rcond=1e-10)[0] / scale
        a, b, viscous, torque_lag = (float(value) for value in x)
        root = b * b - 4.0 * viscous * a
        denominator = b + np.sign(b) * np.sqrt(max(root, 0.0))
        speed_lag = 2.0 * a / denominator if denominator != 0.0 else 0.0
        lags = np.clip([speed_lag, torque_lag, skew], limits.low[SPEED_LAG:], limits.high[SPEED_LAG:])
        found.append(_start(problem, (float(lags[0]), float(lags[1]), float(lags[2]))))
    return found
