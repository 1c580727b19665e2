"""Weighted least squares over the bins: −2 ln L for a given noise, within bounds, with priors.

A bin's residual is a circular complex number of variance v: it adds 2|e|²/v; at frequency zero it is real and adds
e²/v.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from tdhil.estimation.frequency_domain import (
    LAG_BOUND_S,
    SKEW_BOUND_S,
    Box,
    Fit,
    GaussianPrior,
    shared_lag,
)
from tdhil.estimation.time_domain.equation import (
    BACK,
    FORWARD,
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
from tdhil.estimation.time_domain.taylor import ComplexArray
from tdhil.estimation.time_domain.windows import Bins
from tdhil.recording import BoolArray, FloatArray

# ---------------------------------------------------------------------------------------------------------------------
# How loud the noise is at each frequency, from what the fit leaves over.
#
# Load disturbance, torque noise and speed noise behind the inverse filters add up to a residual whose power per bin
# is energy·S(f), S smooth. S is the mean of |e|²/energy over neighbouring frequencies, each residual scaled up by
# what the fit has taken from it, 1/(1 − leverage): a fit of few equations always leaves less than the noise.


_WIDTH = 0.35         # of the frequency, either way
_NEIGHBOURS = 8       # either way, at least
_TOP_SHARE = 0.2      # of the bins, the highest: where a record moves least


@dataclass(frozen=True)
class BinNoise:
    """``variance`` (M,) of every bin's residual, and ``count`` (M,): over how many bins it was averaged."""

    variance: FloatArray
    count: FloatArray


def smoothed(hertz: FloatArray, power: FloatArray, width: float = _WIDTH) -> tuple[FloatArray, FloatArray]:
    """Mean of ``power`` over neighbouring frequencies, and over how many; (M,) each, any order.

    ``width``: how far neighbours reach, of the frequency; for what is as smooth as noise, unless told otherwise.
    """
    order = np.argsort(hertz, kind="stable")
    f = hertz[order]
    rank = np.arange(len(f))
    first = np.minimum(np.searchsorted(f, f * (1.0 - width), side="left"), rank - _NEIGHBOURS)
    last = np.maximum(np.searchsorted(f, f * (1.0 + width), side="right"), rank + _NEIGHBOURS + 1)
    first, last = np.maximum(first, 0), np.minimum(last, len(f))
    total = np.concatenate([[0.0], np.cumsum(power[order])])
    mean, count = np.empty(len(f)), np.empty(len(f))
    count[order] = last - first
    mean[order] = (total[last] - total[first]) / (last - first)
    return mean, count


def from_residuals(bins: Bins, error: ComplexArray, leverage: FloatArray) -> BinNoise:
    """The noise that residuals with these leverages speak of."""
    power = np.abs(error) ** 2 / (bins.energy * np.maximum(1.0 - leverage, 0.05))
    mean, count = smoothed(bins.hertz, power)
    floor = 1e-12 * float(np.max(np.abs(bins.torque[:, 0]) ** 2 / bins.energy)) if len(bins) else 0.0
    return BinNoise(bins.energy * np.maximum(mean, max(floor, 1e-300)), count)


def guessed(bins: Bins, inertia: float) -> BinNoise:
    """Before any fit: white noise in both signals as at the highest frequencies, and 3 % of the torque."""
    top = bins.hertz >= (1.0 - _TOP_SHARE) * float(np.max(bins.hertz))
    floors = [float(np.median(np.abs(x[top, 0]) ** 2 / bins.energy[top])) for x in (bins.torque, bins.speed)]
    share, count = smoothed(bins.hertz, (0.03 * np.abs(bins.torque[:, 0])) ** 2 / bins.energy)
    power = floors[0] + np.abs(inertia * bins.s) ** 2 * floors[1] + share
    return BinNoise(bins.energy * np.maximum(power, 1e-300), count)


# ---------------------------------------------------------------------------------------------------------------------

# Plausible values of unstated lags: about a second at most, as in the frequency domain; and what both share
# is held against `shared_lag`'s prior, at a quarter of it, beyond what the middle of the frequencies can see. A record
# without a plan sees far less of lags than a multisine does, and two long ones that are unlike by a few percent
# must still be covered.


_TOLERANCE = 1e-9         # of objective, parameters and gradient, relative
_PLAUSIBLE_S = 1.0        # s; standard deviation of a lag that nothing is known of
_SHARED = 0.5         # of the residual


@dataclass(frozen=True)
class FitProblem:
    """The equations, their noise, the priors, and the free parameters."""

    bins: Bins
    variance: FloatArray
    priors: tuple[GaussianPrior, ...]
    free: tuple[int, ...]
    box: Box

    @cached_property
    def _unseen_s(self) -> float | None:
        """Scale, s, of the prior on the reports' common lag (`shared_lag`); None where a lag was stated."""
        moving = self.bins.hertz[self.bins.hertz > 0.0]
        if any(prior.index in (SPEED_LAG, TORQUE_LAG) for prior in self.priors) or not len(moving):
            return None
        return 1.0 / (2.0 * math.pi * float(np.median(moving)))

    def _of_lags(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the prior on unstated lags: residuals and slopes."""
        if self._unseen_s is None:
            return np.zeros(0), np.zeros((0, PARAMETERS))
        speed_lag_s, torque_lag_s = float(theta[SPEED_LAG]), float(theta[TORQUE_LAG])
        rows = np.zeros((3, PARAMETERS))
        value, by_speed, by_torque = shared_lag(speed_lag_s, torque_lag_s, self._unseen_s)
        rows[0, SPEED_LAG], rows[0, TORQUE_LAG] = _SHARED * by_speed, _SHARED * by_torque
        rows[1, SPEED_LAG] = rows[2, TORQUE_LAG] = 1.0 / _PLAUSIBLE_S
        return np.array([_SHARED * value, speed_lag_s / _PLAUSIBLE_S, torque_lag_s / _PLAUSIBLE_S]), rows

    def stacked(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Real residuals (R,) whose sum of squares is −2 ln L, and their slopes (R, 10)."""
        found = evaluate(theta, self.bins)
        factor = np.where(self.bins.hertz > 0.0, np.sqrt(2.0), 1.0) / np.sqrt(self.variance)
        error, slopes = found.error * factor, found.slopes * factor[:, None]
        known = np.array([(theta[p.index] - p.mean) / p.sd for p in self.priors])
        rows = np.zeros((len(self.priors), PARAMETERS))
        for row, prior in enumerate(self.priors):
            rows[row, prior.index] = 1.0 / prior.sd
        of_lags, slopes_of_lags = self._of_lags(theta)
        return (
            np.concatenate([error.real, error.imag, known, of_lags]),
            np.concatenate([slopes.real, slopes.imag, rows, slopes_of_lags]),
        )

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


def minimise(problem: FitProblem, start: FloatArray, held: dict[int, float] | None = None) -> Fit:
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


def covariance(problem: FitProblem, theta: FloatArray, free: tuple[int, ...]) -> tuple[FloatArray, FloatArray]:
    """Return the covariance of the free parameters (F, F), quadratic, and the leverage of every bin (M,)."""
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


# ---------------------------------------------------------------------------------------------------------------------
# Which bins to believe, how loud their noise is, and the fit: each needs the others, so a few rounds of all three.
#
# A bin counts where the torque that the speed explains stands clear of the residual. Where it doesn't, the direction
# of the regression would matter: least squares of torque on speed errs by the share of the noise in the speed, the
# other way round by the share in the torque. And frequencies end where the longer lag turns the phase by more than
# about a radian: up to there any filter is described by its mean and its spread. Beyond, the unknown structure counts;
# but half of the information on the lags stands there, and most filters have one pole or two. So from that fit the
# band is widened to three times as far, used where the wider one holds (`solve`).


_STARTS = ((0.0, 0.0, 0.0), (0.40, 0.15, 0.0), (0.15, 0.40, 0.0), (0.1, 0.1, 0.0))
_ROUNDS = 5               # of weighting again
_NO_LAG = 0.1            # rad at the highest frequency
_CLEAR = 20.0            # power of what is explained over the residual's
_NARROW = 0.05           # of the frequency: where excitation is lines, what stands beside one need not stand clear
_PHASE, _WIDE_PHASE = 1.2, 3.0     # rad
_LEAST_BINS = 8           # frequencies above the noise that the fit needs
_ENOUGH_BINS = 40        # that the phase rule leaves in any case, if they are clear
_LEAST_LAG_S = 1e-3       # s; a lag counts as no shorter
_ABOUT_AS_WELL = 9.0     # of −2 ln L
_UNSEEN = 0.1            # standard deviations that friction as large as the whole torque would show: it is not seen


@dataclass(frozen=True)
class FoundFit:
    """The problem as it stands in the end, its fit, and of all bins those that stand clear; ``keep``: what was used."""

    problem: FitProblem
    fit: Fit
    clear: int
    keep: BoolArray


def search(bins: Bins, priors: tuple[GaussianPrior, ...], torque_span_nm: float) -> tuple[FoundFit, ...]:
    """Fit in a wide band and in a narrow one, in this order; none where too few bins stand clear of the noise.

    Filters are taken as one pole each.
    """
    inertia = _rough(bins)
    if inertia is None:
        return ()
    levels = tuple(index for index, column in ((FORWARD, 0), (BACK, 1)) if np.any(bins.level[:, column]))
    free = (INERTIA, VISCOUS, SPEED_LAG, TORQUE_LAG, SKEW, *levels)
    limits = box(inertia, 1.0, torque_span_nm, priors)
    every = FitProblem(bins, guessed(bins, inertia).variance, priors, free, limits)
    keep = _worth_a_look(every, inertia)
    problem = _part(every, keep)
    fit = min((minimise(problem, _start(inertia, lags, priors)) for lags in _STARTS), key=lambda one: one.objective)
    narrow = _settled(every, keep, fit, _PHASE)
    if narrow is None:
        return ()
    wide = _settled(every, narrow.keep, narrow.fit, _WIDE_PHASE)
    return (narrow,) if wide is None or len(wide.problem.bins) <= len(narrow.problem.bins) else (wide, narrow)


def _settled(every: FitProblem, keep: BoolArray, fit: Fit, phase: float) -> FoundFit | None:
    """After some rounds from ``fit``, of the bins ``keep`` (M,); None where too few bins stand clear of the noise."""
    bins, free = every.bins, every.free
    problem = _part(every, keep)
    clear = len(bins)
    for _ in range(_ROUNDS):
        _, leverage = covariance(problem, fit.theta, free)
        taken = np.zeros(len(bins))
        taken[keep] = leverage
        found = evaluate(_levelled(every, fit.theta, _unseen_levels(problem, fit.theta)), bins)
        every = replace(every, variance=from_residuals(bins, found.error, taken).variance)
        explained, _ = smoothed(bins.hertz, np.abs(found.gain * bins.speed[:, 0]) ** 2 / bins.energy, _NARROW)
        stands = explained * bins.energy > _CLEAR * every.variance
        clear = int(np.count_nonzero(stands))
        if clear < _LEAST_BINS:
            return None
        keep = stands & (bins.hertz <= _highest(_plain(problem, fit), bins.hertz[stands], phase))
        problem = _part(every, keep)
        fits = [minimise(problem, start) for start in _starts_from(problem, fit.theta)]
        fit = min(fits, key=lambda one: one.objective)
    if unseen := _unseen_levels(problem, fit.theta):
        problem = replace(problem, free=tuple(index for index in problem.free if index not in unseen))
        fit = minimise(problem, _levelled(every, fit.theta, unseen))
    return FoundFit(problem, fit, clear, keep)


def _starts_from(problem: FitProblem, theta: FloatArray) -> Iterator[FloatArray]:
    """Theta, and where it has no lag to speak of on one signal the first lags once more.

    At no lag descents stand still, a minimum or not: the skew takes a short lag's delay back, and its square, which is
    left, has no slope there. What the first guess of the noise led there, the noise that was found may lead away again.
    """
    yield theta
    fastest = float(np.max(np.abs(problem.bins.s)))
    if SKEW in problem.free and min(theta[SPEED_LAG], theta[TORQUE_LAG]) * fastest < _NO_LAG:
        for lags in _STARTS[1:]:
            start = theta.copy()
            start[[SPEED_LAG, TORQUE_LAG, SKEW]] = lags
            yield start


def _unseen_levels(problem: FitProblem, theta: FloatArray) -> tuple[int, ...]:
    """A constant friction shows at frequency zero and next to it alone; without those bins its value is anything.

    What is then left of it in the others is the arithmetic's, and following it would leave everything open.
    """
    _, slopes = problem.stacked(theta)
    weight = np.linalg.norm(slopes, axis=0) * problem.box.scale
    return tuple(index for index in (FORWARD, BACK) if index in problem.free and weight[index] < _UNSEEN)


def _levelled(every: FitProblem, theta: FloatArray, unseen: tuple[int, ...]) -> FloatArray:
    """The same with the levels that no chosen bin sees as frequency zero has them, all else given."""
    if not unseen:
        return theta
    still = every.bins.chosen(every.bins.hertz == 0.0)
    found = theta.copy()
    found[list(unseen)] = 0.0
    at = evaluate(found, still)
    found[list(unseen)] = np.linalg.lstsq(-at.slopes[:, list(unseen)].real, at.error.real, rcond=None)[0]
    return found


def _plain(problem: FitProblem, fit: Fit) -> FloatArray:
    """Without lags, where that does about as well: lags that are alike cancel, and would be found anywhere."""
    without = minimise(problem, fit.theta, {SPEED_LAG: 0.0, TORQUE_LAG: 0.0})
    return without.theta if without.objective - fit.objective <= _ABOUT_AS_WELL else fit.theta


def _part(every: FitProblem, keep: BoolArray) -> FitProblem:
    return replace(every, bins=every.bins.chosen(keep), variance=every.variance[keep])


def _rough(bins: Bins) -> float | None:
    """|T|/(ω|W|) over the lower part of the frequencies."""
    low = (bins.hertz > 0.0) & (bins.hertz <= np.quantile(bins.hertz, 0.2)) if len(bins) else np.zeros(0, dtype=bool)
    accelerated = float(np.sum(np.abs(bins.s[low] * bins.speed[low, 0]) ** 2))
    driven = float(np.sum(np.abs(bins.torque[low, 0]) ** 2))
    found = math.sqrt(driven / accelerated) if accelerated > 0.0 else 0.0
    return found if 0.0 < found < math.inf else None


def _worth_a_look(every: FitProblem, inertia: float) -> BoolArray:
    """For the first fit: where torque and acceleration stand above their noise at the highest frequencies."""
    bins = every.bins
    moved, _ = smoothed(bins.hertz, np.abs(inertia * bins.s * bins.speed[:, 0]) ** 2 / bins.energy, _NARROW)
    keep = np.asarray(moved * bins.energy > _CLEAR * every.variance)
    return keep if np.count_nonzero(keep) >= _ENOUGH_BINS else np.ones(len(bins), dtype=np.bool_)


def _highest(theta: FloatArray, clear_hz: FloatArray, phase: float) -> float:
    lag = max(float(theta[SPEED_LAG]), float(theta[TORQUE_LAG]), _LEAST_LAG_S)
    enough = float(np.sort(clear_hz)[min(_ENOUGH_BINS, len(clear_hz)) - 1])
    return max(phase / (2.0 * math.pi * lag), enough)


def _start(inertia: float, lags: tuple[float, float, float], priors: tuple[GaussianPrior, ...]) -> FloatArray:
    theta = np.zeros(PARAMETERS)
    theta[INERTIA], theta[SPEED_LAG : SKEW + 1] = inertia, lags
    for prior in priors:
        theta[prior.index] = prior.mean
    return theta
