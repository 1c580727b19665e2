"""Least squares by Levenberg and Marquardt's damped Gauss-Newton steps, within bounds, with some parameters held.

This is an own implementation, because the profile of an interval needs hundreds of small descents, each from a good
start: the set-up of a general solver takes longer than their few steps. The tests compare with
`scipy.optimize.least_squares`.

A step solves (AᵀA + λ diag AᵀA) δ = −Aᵀ r for the parameters that are free and do not push against a bound. A parameter
that would leave its bounds is set to the bound, and the others are solved again. (If it were only cut, the others would
fit the step without the cut: λ would rise until the step ends before the bound, and the next step would be no better.)
λ falls with every success and rises with every failure. A start that is a minimum stays unchanged bit for bit; any
other start moves.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from tdhil.estimation.frequency_domain import signal_filters
from tdhil.estimation.frequency_domain.likelihood import Likelihood
from tdhil.estimation.frequency_domain.shafts import INERTIA, VISCOUS
from tdhil.recording import BoolArray, FloatArray

At = Callable[[FloatArray], tuple[FloatArray, Callable[[], FloatArray]]]
"""Function from parameters to residuals r, and to a function for their slopes A."""

_MOST_STEPS = 200         # steps of a fit, at most
_MOST_TRIES = 12          # damping values of a step, at most
_SMALL_GAIN = 1e-6        # of −2 ln L, absolute; at the edge of an interval −2 ln L has risen by about 4
_SMALL_STEP = 1e-9        # of the natural scale
_CREEPING, _LOOKED_BACK = 0.01, 20         # of −2 ln L, gained in so many steps: less is the floor of a flat valley
_FAR, _LOOKS_TO_TELL = 5.0, 4              # of −2 ln L above the goal after twice as many steps; checks for a trend


@dataclass(frozen=True)
class Fit:
    """Parameters, and the sum of squares there."""

    theta: FloatArray
    objective: float


@dataclass(frozen=True)
class Box:
    """Bounds and natural scales of theta, (P,) each."""

    low: FloatArray
    high: FloatArray
    scale: FloatArray


def descend(at: At, start: FloatArray, free: BoolArray, box: Box, goal: float = math.inf) -> Fit:
    """Descend from ``start`` (P,); only ``free`` (P,) parameters move. Arithmetic that overflows ends the descent.

    ``goal``: value to go below; if it stays far off, the descent ends.
    """
    theta = np.where(free, np.clip(start, box.low, box.high), start)
    r, slopes = at(theta)
    cost = float(r.dot(r))
    damping = 1e-3
    every = np.flatnonzero(free)
    lowest, highest, scales = box.low[every], box.high[every], box.scale[every]
    bounds = list(zip(lowest.tolist(), highest.tolist(), strict=True))
    course = [cost]
    for number in range(_MOST_STEPS):
        if number and number % _LOOKED_BACK == 0:
            course.append(cost)
            if _leads_nowhere(course, goal):
                break
        moving, here, least, most, scale = every, theta[every], lowest, highest, scales
        scaled = slopes()[:, every] * scales
        downhill = -r.dot(scaled)
        moves = [x > low if pull < 0.0 else x < high if pull > 0.0 else True
                 for x, (low, high), pull in zip(here.tolist(), bounds, downhill.tolist(), strict=True)]
        if not all(moves):
            if not any(moves):
                break
            moving, here, downhill, scaled = every[moves], here[moves], downhill[moves], scaled[:, moves]
            least, most, scale = lowest[moves], highest[moves], scales[moves]
        normal = scaled.T.dot(scaled)
        size = normal.diagonal().copy()
        size[size <= 0.0] = 1.0
        floor, several = 1e-14 * max(size.tolist()), len(moving) + 1
        gain = 0.0
        for _ in range(_MOST_TRIES):
            damped = normal.copy()
            damped.reshape(-1)[::several] += damping * size + floor
            trial = theta.copy()
            trial[moving] = there = _within(least, most, here, scale, damped, downhill)
            tried, slopes = at(trial)
            trial_cost = float(tried.dot(tried))
            if trial_cost < cost:
                gain = cost - trial_cost
                break
            damping *= 8.0
            if max(map(abs, ((there - here) / scale).tolist())) < _SMALL_STEP:
                break
        if gain <= 0.0:
            break
        theta, r, cost = trial, tried, trial_cost
        damping = max(damping / 10.0, 1e-9)
        if gain < _SMALL_GAIN * max(1.0, 1e-3 * cost):
            break
    return Fit(theta, cost)


def _leads_nowhere(course: Sequence[float], goal: float) -> bool:
    """Return whether a descent has ended, or will end above ``goal``. ``course``: its values at regular checks.

    Along the floor of a flat valley the gain falls by the same share from check to check; the first check is left out.
    """
    if course[-2] - course[-1] < _CREEPING:
        return True
    if len(course) < _LOOKS_TO_TELL:
        return len(course) > 2 and course[-1] > goal + _FAR
    before, last = course[-3] - course[-2], course[-2] - course[-1]
    return course[-1] > goal and last < before and course[-1] - last * last / (before - last) > goal


def _within(
    least: FloatArray, most: FloatArray, here: FloatArray, scale: FloatArray, matrix: FloatArray, right: FloatArray
) -> FloatArray:
    """Return ``here`` plus the step x of matrix x = right, in units of ``scale``; parameters stop at their bounds."""
    there = here + _solved(matrix, right) * scale
    held = outside = (there < least) | (there > most)
    while True in outside.tolist():
        there = np.minimum(np.maximum(there, least), most)
        free = ~held
        go, stay = np.flatnonzero(free), np.flatnonzero(held)
        if not len(go):
            break
        rows = go[:, None]
        rest = right[go] - matrix[rows, stay].dot((there[stay] - here[stay]) / scale[stay])
        there[go] = here[go] + _solved(matrix[rows, go], rest) * scale[go]
        outside = free & ((there < least) | (there > most))
        held = held | outside
    return there


def _solved(matrix: FloatArray, right: FloatArray) -> FloatArray:
    try:
        return np.asarray(np.linalg.solve(matrix, right), dtype=np.float64)
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.lstsq(matrix, right, rcond=None)[0], dtype=np.float64)


# ---------------------------------------------------------------------------------------------------------------------
# Start values: rough sizes, and linear least squares for shafts with first-order lags; then the best of many descents.


# τ_w, τ_T, d as start values besides those of linear least squares: the field rig's, and its mirror image
_STARTS = ((0.40, 0.15, 0.0), (0.15, 0.40, 0.0))   # s; lags of speed and torque, and time offset
_SKEWS = (-0.2, -0.1, -0.05, -0.02, 0.0, 0.02, 0.05, 0.1, 0.2)   # s; start values of the time offset
_PROPOSALS = 3            # best start values of the search that are fitted
_NO_LAG, _SOME_LAG = 0.1, 0.6      # rad at the fastest line
_EQUAL_POLES, _NEAR_EQUAL = 0.25, 0.1      # ρ of two equal poles, and the distance that counts as equal
_FOR_ONE_POLE = 4.0 ** (1.0 / 3.0)         # delay of two equal poles that replace one pole, over the delay of that pole
_BY_AVERAGE = 12.0 * (0.5 * _FOR_ONE_POLE**2 - 1.0) / (_FOR_ONE_POLE**2 - 1.0)    # u over the rise of delay²

Fixed = dict[int, float]


@dataclass(frozen=True)
class Apart:
    """Condition for separate solutions (P,): the least decrease of −2 ln L for which they are preferred."""

    stands: Callable[[FloatArray], bool]
    gain: float


def box(problem: Likelihood, rough_inertia: float) -> Box:
    """Return the bounds of theta; wider if a prior requires it."""
    low, high = problem.model.bounds(rough_inertia, problem.s)
    for prior in problem.priors:
        high[prior.index] = max(high[prior.index], prior.mean + 6.0 * prior.sd)
    return Box(low, high, problem.model.scales(rough_inertia, problem.s))


def rough_inertia_of(problem: Likelihood) -> float:
    """Return |T|/(ω|W|) of the lowest line: the right size of J, for any lags."""
    first = problem.owner == 0
    ratio = np.abs(problem.torque[first]) / np.maximum(np.abs(problem.speed[first] * problem.s[0]), 1e-300)
    return float(np.median(ratio))


def minimise(
    problem: Likelihood, limits: Box, start: FloatArray, fixed: Fixed, goal: float = math.inf
) -> Fit:
    """Descend from the start, and again from beside a lag of zero; the parameters in ``fixed`` keep these values.

    At a lag of zero a descent stops, even without a minimum: a short lag whose delay the skew compensates acts only by
    its square, ln F = −ln(1 + τ s) + τ s = τ² s²/2 − …, and its slope is zero at τ = 0.
    """
    fit = _descent(problem, limits, start, fixed, goal)
    for begin in _beside_no_lag(problem, fit.theta, fixed):
        other = _descent(problem, limits, begin, fixed, goal)
        fit = other if other.objective < fit.objective else fit
    return fit


def _descent(
    problem: Likelihood, limits: Box, start: FloatArray, fixed: Fixed, goal: float = math.inf
) -> Fit:
    free = np.ones(len(start), dtype=np.bool_)
    begin = np.array(start, dtype=np.float64)
    for index, value in fixed.items():
        free[index], begin[index] = False, value
    return descend(problem.at, begin, free, limits, goal)


def _beside_no_lag(problem: Likelihood, theta: FloatArray, fixed: Fixed) -> Iterator[FloatArray]:
    """Yield start values with a moderate lag instead of nearly none, and the skew that compensates its delay."""
    at, fastest = problem.model.at, float(np.max(np.abs(problem.s)))
    if at(signal_filters.SKEW) in fixed:
        return
    for lag, shape, sign in (
        (signal_filters.SPEED_LAG, signal_filters.SPEED_SHAPE, 1.0),
        (signal_filters.TORQUE_LAG, signal_filters.TORQUE_SHAPE, -1.0),
    ):
        if at(lag) in fixed or theta[at(lag)] * fastest > _NO_LAG:
            continue
        begin = theta.copy()
        begin[at(lag)] = _SOME_LAG / fastest
        begin[at(shape)] = 0.0
        begin[at(signal_filters.SKEW)] += sign * (begin[at(lag)] - theta[at(lag)])
        yield begin


def other_poles(problem: Likelihood, theta: FloatArray, fixed: Fixed) -> Iterator[FloatArray]:
    """Yield starts with two equal poles in one report that has one pole or two different ones, and with one pole
    instead of two.

    In the series of the logarithm the third term of one pole is 2 τ³, that of two equal poles τ³/2. Two poles are
    therefore equivalent if their delay is 4^(1/3) times that of the one. An average (u/12) compensates the difference
    of the second terms, τ² to τ²/2, and the skew that of the delay. Between the two lies a ridge, which a descent from
    the old delay does not cross.
    """
    at, fastest = problem.model.at, float(np.max(np.abs(problem.s)))
    for lag, shape, sign in (
        (at(signal_filters.SPEED_LAG), at(signal_filters.SPEED_SHAPE), 1.0),
        (at(signal_filters.TORQUE_LAG), at(signal_filters.TORQUE_SHAPE), -1.0),
    ):
        if lag in fixed or shape in fixed or theta[lag] * fastest <= _NO_LAG:
            continue
        two = abs(float(theta[shape]) - _EQUAL_POLES) <= _NEAR_EQUAL
        begin = theta.copy()
        begin[shape] = 0.0 if two else _EQUAL_POLES
        if two or theta[shape] < _EQUAL_POLES:
            begin[lag] *= _FOR_ONE_POLE ** (-1.0 if two else 1.0)
            begin[at(signal_filters.SKEW)] += sign * (begin[lag] - theta[lag])
            alike = begin.copy()
            alike[at(signal_filters.AVERAGE)] += sign * _BY_AVERAGE * (begin[lag] ** 2 - theta[lag] ** 2)
            yield alike
        yield begin


def best_fit(
    problem: Likelihood, limits: Box, fixed: Fixed, starts: Iterable[FloatArray], apart: Apart | None = None,
    known: Sequence[Fit] = (),
) -> Fit:
    """Return the `lowest` of several descents, of those beside no lag from the lowest of them, and of the ``known``
    fits.
    """
    fits = [*known, *(_descent(problem, limits, start, fixed) for start in starts)]
    best = min(fits, key=lambda fit: fit.objective)
    fits += [_descent(problem, limits, start, fixed) for start in _beside_no_lag(problem, best.theta, fixed)]
    return lowest(fits, apart)


def lowest(fits: Sequence[Fit], apart: Apart | None = None) -> Fit:
    """Return the first of the lowest fits, so that the same data give the same bits; fits ``apart`` must gain more."""
    best = min(fits, key=lambda fit: fit.objective)
    if apart is None or not apart.stands(best.theta):
        return best
    others = [fit for fit in fits if not apart.stands(fit.theta)]
    other = min(others, key=lambda fit: fit.objective, default=best)
    return best if other.objective - best.objective > apart.gain else other


def rigid_starts(problem: Likelihood) -> list[FloatArray]:
    """Return the most promising of the linear proposals, and two guesses."""
    proposals = sorted(_proposals(problem), key=problem.objective)
    return proposals[:_PROPOSALS] + [_start(problem, lags) for lags in _STARTS]


def rigid_rivals(theta: FloatArray) -> list[FloatArray]:
    """Return starts at which the lag of a rigid shaft and the lag of its speed report are exchanged.

    (J s + B)(1 + τ_w s) = (B τ_w s + B)(1 + (J/B) s): shaft and report cannot be separated if both J/B and τ_w are
    plausible lags of a report. A fit has this alternative, and so has an interval.
    """
    inertia, viscous, lag = theta[INERTIA], theta[VISCOUS], theta[2 + signal_filters.SPEED_LAG]
    if viscous <= 0.0 or inertia > 1.2 * signal_filters.LAG_BOUND_S * viscous:
        return []
    rival = theta.copy()
    rival[INERTIA], rival[2 + signal_filters.SPEED_LAG] = viscous * max(lag, 1e-3), inertia / viscous
    return [rival]


def _start(problem: Likelihood, lags: tuple[float, float, float]) -> FloatArray:
    """Return J and B for given lags by linear least squares: G/filters = J s + B."""
    phi = np.zeros(signal_filters.COUNT)
    phi[[signal_filters.SPEED_LAG, signal_filters.TORQUE_LAG, signal_filters.SKEW]] = lags
    seen = problem.torque / (signal_filters.FilterRatio(phi, problem.s).value[problem.owner] * problem.speed)
    s = problem.s[problem.owner]
    weight = np.abs(problem.speed)
    inertia = float(np.sum(weight * seen.imag * s.imag) / np.sum(weight * s.imag**2))
    viscous = float(np.sum(weight * seen.real) / np.sum(weight))
    if inertia <= 0.0:
        inertia = rough_inertia_of(problem)
    theta = np.concatenate([np.zeros(problem.model.mechanical), phi])
    theta[INERTIA], theta[VISCOUS] = inertia, viscous
    return theta


def _proposals(problem: Likelihood) -> list[FloatArray]:
    """Return start values by linear least squares: for a given skew, first-order lags make the equation linear.

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
        lags = np.clip([speed_lag, torque_lag], 0.0, signal_filters.LAG_BOUND_S)
        found.append(_start(problem, (float(lags[0]), float(lags[1]), skew)))
    return found
