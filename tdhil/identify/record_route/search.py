"""Which bins to believe, how loud their noise is, and the fit: each needs the others, so a few rounds of all three.

A bin counts where the torque that the speed explains stands clear of the residual. Where it doesn't, the direction of
the regression would matter: least squares of torque on speed errs by the share of the noise in the speed, the other
way round by the share in the torque. And frequencies end where the longer lag turns the phase by more than about a
radian: beyond that the structure of the filter, which nobody knows, is no longer told by its mean and its spread.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from tdhil.estimation.frequency_domain.model import GaussianPrior
from tdhil.estimation.frequency_domain.optimiser import Fit
from tdhil.estimation.time_domain.equation import (
    BACK,
    FORWARD,
    INERTIA,
    PARAMETERS,
    SKEW,
    SPEED_LAG,
    TORQUE_LAG,
    VISCOUS,
    evaluate,
)
from tdhil.estimation.time_domain.fit import Problem, box, covariance, minimise
from tdhil.estimation.time_domain.windows import Bins
from tdhil.identify.record_route import noise
from tdhil.recording.recording import BoolArray, FloatArray

_STARTS = ((0.0, 0.0, 0.0), (0.40, 0.15, 0.0), (0.15, 0.40, 0.0), (0.1, 0.1, 0.0))
_ROUNDS = 5
_CLEAR = 20.0            # power of what is explained over the residual's
_NARROW = 0.05           # of the frequency: where excitation is lines, what stands beside one need not stand clear
_PHASE = 1.2             # rad
_LEAST_BINS = 8
_ENOUGH_BINS = 40        # that the phase rule leaves in any case, if they are clear
_LEAST_LAG_S = 1e-3
_ABOUT_AS_WELL = 9.0     # of −2 ln L
_UNSEEN = 0.1            # standard deviations that friction as large as the whole torque would show: it is not seen


@dataclass(frozen=True)
class Found:
    """The problem as it stands in the end, its fit, and of all bins those that stand clear."""

    problem: Problem
    fit: Fit
    clear: int


def search(bins: Bins, priors: tuple[GaussianPrior, ...], torque_span_nm: float) -> Found | None:
    """None where too few bins stand clear of the noise. Filters are taken as one pole each."""
    inertia = _rough(bins)
    if inertia is None:
        return None
    levels = tuple(index for index, column in ((FORWARD, 0), (BACK, 1)) if np.any(bins.level[:, column]))
    free = (INERTIA, VISCOUS, SPEED_LAG, TORQUE_LAG, SKEW, *levels)
    limits = box(inertia, 1.0, torque_span_nm, priors)
    every = Problem(bins, noise.guessed(bins, inertia).variance, priors, free, limits)
    keep = _worth_a_look(every, inertia)
    problem = _part(every, keep)
    fit = min((minimise(problem, _start(inertia, lags, priors)) for lags in _STARTS), key=lambda one: one.objective)
    clear = len(bins)
    for _ in range(_ROUNDS):
        _, leverage = covariance(problem, fit.theta, free)
        taken = np.zeros(len(bins))
        taken[keep] = leverage
        found = evaluate(_levelled(every, fit.theta, _unseen_levels(problem, fit.theta)), bins)
        every = replace(every, variance=noise.from_residuals(bins, found.error, taken).variance)
        explained, _ = noise.smoothed(bins.hertz, np.abs(found.gain * bins.speed[:, 0]) ** 2 / bins.energy, _NARROW)
        stands = explained * bins.energy > _CLEAR * every.variance
        clear = int(np.count_nonzero(stands))
        if clear < _LEAST_BINS:
            return None
        keep = stands & (bins.hertz <= _highest(_plain(problem, fit), bins.hertz[stands]))
        problem = _part(every, keep)
        fit = minimise(problem, fit.theta)
    if unseen := _unseen_levels(problem, fit.theta):
        problem = replace(problem, free=tuple(index for index in problem.free if index not in unseen))
        fit = minimise(problem, _levelled(every, fit.theta, unseen))
    return Found(problem, fit, clear)


def _unseen_levels(problem: Problem, theta: FloatArray) -> tuple[int, ...]:
    """A constant friction shows at frequency zero and next to it alone; without those bins its value is anything.

    What is then left of it in the others is the arithmetic's, and following it would leave everything open.
    """
    _, slopes = problem.stacked(theta)
    weight = np.linalg.norm(slopes, axis=0) * problem.box.scale
    return tuple(index for index in (FORWARD, BACK) if index in problem.free and weight[index] < _UNSEEN)


def _levelled(every: Problem, theta: FloatArray, unseen: tuple[int, ...]) -> FloatArray:
    """The same with the levels that no chosen bin sees as frequency zero has them, all else given."""
    if not unseen:
        return theta
    still = every.bins.chosen(every.bins.hertz == 0.0)
    found = theta.copy()
    found[list(unseen)] = 0.0
    at = evaluate(found, still)
    found[list(unseen)] = np.linalg.lstsq(-at.slopes[:, list(unseen)].real, at.error.real, rcond=None)[0]
    return found


def _plain(problem: Problem, fit: Fit) -> FloatArray:
    """Without lags, where that does about as well: lags that are alike cancel, and would be found anywhere."""
    without = minimise(problem, fit.theta, {SPEED_LAG: 0.0, TORQUE_LAG: 0.0})
    return without.theta if without.objective - fit.objective <= _ABOUT_AS_WELL else fit.theta


def _part(every: Problem, keep: BoolArray) -> Problem:
    return replace(every, bins=every.bins.chosen(keep), variance=every.variance[keep])


def _rough(bins: Bins) -> float | None:
    """|T|/(ω|W|) over the lower part of the frequencies."""
    low = (bins.hertz > 0.0) & (bins.hertz <= np.quantile(bins.hertz, 0.2)) if len(bins) else np.zeros(0, dtype=bool)
    accelerated = float(np.sum(np.abs(bins.s[low] * bins.speed[low, 0]) ** 2))
    driven = float(np.sum(np.abs(bins.torque[low, 0]) ** 2))
    found = math.sqrt(driven / accelerated) if accelerated > 0.0 else 0.0
    return found if 0.0 < found < math.inf else None


def _worth_a_look(every: Problem, inertia: float) -> BoolArray:
    """For the first fit: where torque and acceleration stand above their noise at the highest frequencies."""
    bins = every.bins
    moved, _ = noise.smoothed(bins.hertz, np.abs(inertia * bins.s * bins.speed[:, 0]) ** 2 / bins.energy, _NARROW)
    keep = np.asarray(moved * bins.energy > _CLEAR * every.variance)
    return keep if np.count_nonzero(keep) >= _ENOUGH_BINS else np.ones(len(bins), dtype=np.bool_)


def _highest(theta: FloatArray, clear_hz: FloatArray) -> float:
    lag = max(float(theta[SPEED_LAG]), float(theta[TORQUE_LAG]), _LEAST_LAG_S)
    enough = float(np.sort(clear_hz)[min(_ENOUGH_BINS, len(clear_hz)) - 1])
    return max(_PHASE / (2.0 * math.pi * lag), enough)


def _start(inertia: float, lags: tuple[float, float, float], priors: tuple[GaussianPrior, ...]) -> FloatArray:
    theta = np.zeros(PARAMETERS)
    theta[INERTIA], theta[SPEED_LAG : SKEW + 1] = inertia, lags
    for prior in priors:
        theta[prior.index] = prior.mean
    return theta
