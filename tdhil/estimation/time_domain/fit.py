"""Weighted least squares over the bins: −2 ln L for a given noise, within bounds, with priors.

The residual of a bin is a circular complex number of variance v, and adds 2|e|²/v. At frequency zero it is real, and
adds e²/v.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from tdhil.estimation.frequency_domain import (
    LAG_BOUND_S,
    SHAPE_BOUND,
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
# Noise at each frequency, from the residuals of the fit.
#
# Load disturbance, torque noise and speed noise behind the inverse filters add up to a residual whose power per bin is
# energy·S(f), with a smooth S. S is the mean of |e|²/energy over neighbouring frequencies. Each residual is scaled by
# 1/(1 − leverage), because a fit of few equations leaves less than the noise.


_WIDTH = 0.35         # of the frequency: width of the mean, on either side
_NEIGHBOURS = 8       # fewest neighbours on either side
_TOP_SHARE = 0.2      # share of the bins, the highest frequencies: there a recording moves least


@dataclass(frozen=True)
class BinNoise:
    """Noise of the bins: ``variance`` (M,) of every residual, and ``count`` (M,), the number of bins averaged for
    it.
    """

    variance: FloatArray
    count: FloatArray


def smoothed(hertz: FloatArray, power: FloatArray, width: float = _WIDTH) -> tuple[FloatArray, FloatArray]:
    """Return the mean of ``power`` over neighbouring frequencies, and the number averaged; (M,) each, any order.

    ``width``: distance of the farthest neighbours, as a share of the frequency; the default suits noise.
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
    """Return the noise estimated from residuals with these leverages."""
    power = np.abs(error) ** 2 / (bins.energy * np.maximum(1.0 - leverage, 0.05))
    mean, count = smoothed(bins.hertz, power)
    floor = 1e-12 * float(np.max(np.abs(bins.torque[:, 0]) ** 2 / bins.energy)) if len(bins) else 0.0
    return BinNoise(bins.energy * np.maximum(mean, max(floor, 1e-300)), count)


def guessed(bins: Bins, inertia: float) -> BinNoise:
    """Return the noise before any fit: white noise in both signals as at the highest frequencies, and 3 % of the
    torque.
    """
    top = bins.hertz >= (1.0 - _TOP_SHARE) * float(np.max(bins.hertz))
    floors = [float(np.median(np.abs(x[top, 0]) ** 2 / bins.energy[top])) for x in (bins.torque, bins.speed)]
    share, count = smoothed(bins.hertz, (0.03 * np.abs(bins.torque[:, 0])) ** 2 / bins.energy)
    power = floors[0] + np.abs(inertia * bins.s) ** 2 * floors[1] + share
    return BinNoise(bins.energy * np.maximum(power, 1e-300), count)


# ---------------------------------------------------------------------------------------------------------------------

# Plausible values of unstated lags: about a second at most, as in the frequency domain. `shared_lag` limits the common
# lag of both reports by a quarter of its prior, beyond what the middle of the frequencies can show. A recording without
# planned excitation shows lags far less than a multisine, and must still cover two long lags that differ by a few
# percent.


_TOLERANCE = 1e-9         # relative, of objective, parameters and gradient
_PLAUSIBLE_S = 1.0        # s; standard deviation of an unknown lag
_SHARED = 0.5         # of the residual


@dataclass(frozen=True)
class FitProblem:
    """Equations, their noise, the priors, and the free parameters."""

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

    def stacked(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return real residuals (R,) whose sum of squares is −2 ln L, and their slopes (R, 10)."""
        found = evaluate(theta, self.bins)
        factor = np.where(self.bins.hertz > 0.0, np.sqrt(2.0), 1.0) / np.sqrt(self.variance)
        error, slopes = found.error * factor, found.slopes * factor[:, None]
        known = np.array([(theta[p.index] - p.mean) / p.sd for p in self.priors])
        rows = np.zeros((len(self.priors), PARAMETERS))
        for row, prior in enumerate(self.priors):
            rows[row, prior.index] = 1.0 / prior.sd
        of_lags, slopes_of_lags = np.zeros(0), np.zeros((0, PARAMETERS))
        if self._unseen_s is not None:      # the prior on unstated lags
            speed_lag_s, torque_lag_s = float(theta[SPEED_LAG]), float(theta[TORQUE_LAG])
            value, by_speed, by_torque = shared_lag(speed_lag_s, torque_lag_s, self._unseen_s)
            of_lags = np.array([_SHARED * value, speed_lag_s / _PLAUSIBLE_S, torque_lag_s / _PLAUSIBLE_S])
            slopes_of_lags = np.zeros((3, PARAMETERS))
            slopes_of_lags[0, SPEED_LAG], slopes_of_lags[0, TORQUE_LAG] = _SHARED * by_speed, _SHARED * by_torque
            slopes_of_lags[1, SPEED_LAG] = slopes_of_lags[2, TORQUE_LAG] = 1.0 / _PLAUSIBLE_S
        return (
            np.concatenate([error.real, error.imag, known, of_lags]),
            np.concatenate([slopes.real, slopes.imag, rows, slopes_of_lags]),
        )

    def equations(self) -> int:
        """Return the number of real equations, priors included."""
        return int(np.sum(np.where(self.bins.hertz > 0.0, 2, 1))) + len(self.priors)


def box(inertia: float, middle_rad_s: float, torque_nm: float, priors: tuple[GaussianPrior, ...]) -> Box:
    """Return the bounds: lags in [0, 2] s, |skew| ≤ 1 s, κ in [0, ½], J ≥ 0; wider if a prior requires it."""
    low, high, scale = np.full(PARAMETERS, -np.inf), np.full(PARAMETERS, np.inf), np.full(PARAMETERS, torque_nm)
    low[INERTIA], low[[SPEED_LAG, TORQUE_LAG, SPEED_SHAPE, TORQUE_SHAPE]] = 0.0, 0.0
    high[[SPEED_LAG, TORQUE_LAG]], high[[SPEED_SHAPE, TORQUE_SHAPE]] = LAG_BOUND_S, SHAPE_BOUND
    low[SKEW], high[SKEW] = -SKEW_BOUND_S, SKEW_BOUND_S
    for prior in priors:
        high[prior.index] = max(high[prior.index], prior.mean + 6.0 * prior.sd)
    scale[INERTIA], scale[VISCOUS] = inertia, inertia * middle_rad_s
    scale[[SPEED_LAG, TORQUE_LAG, SKEW]], scale[[SPEED_SHAPE, TORQUE_SHAPE]] = (0.1, 0.1, 0.05), 0.25
    return Box(low, high, scale)


def minimise(problem: FitProblem, start: FloatArray, held: dict[int, float] | None = None) -> Fit:
    """Minimise once from ``start``. Parameters that are not free, or held, keep their value."""
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
    """Return the covariance of the free parameters (F, F), by the quadratic approximation, and each bin's leverage
    (M,).
    """
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
# Selection of the bins, their noise, and the fit. Each needs the others, so a few rounds are made.
#
# A bin is used if the torque explained by speed is clear of the residual. Otherwise the direction of the regression
# would matter: least squares of torque on speed errs by the share of noise in the speed, the reverse regression by the
# share in the torque. Frequencies end where the longer lag turns the phase by more than about a radian: up to there,
# mean and spread describe any filter. At higher frequencies the unknown structure matters, but half of the information
# on the lags is there, and most filters have one or two poles. After the first fit the band is therefore widened three
# times; the wider one is used if its model holds (`solve`).


_STARTS = ((0.0, 0.0, 0.0), (0.40, 0.15, 0.0), (0.15, 0.40, 0.0), (0.1, 0.1, 0.0))
"""Start values of speed lag, torque lag and time offset, s: none; those that explain the paper's field slopes; the same
exchanged; equal ones, in whose valley the lags cancel."""
_ROUNDS = 5               # rounds of reweighting
_NO_LAG = 0.1            # rad at the highest frequency, below which a lag has no effect
CLEAR = 20.0            # least power that the speed explains, over that of the residual
NARROW = 0.05           # of the frequency: width of the mean; with lines, bins beside a line need not be clear
_PHASE, _WIDE_PHASE = 1.2, 3.0     # rad; largest phase of the lags in the narrow and in the wide band
LEAST_BINS = 8           # fewest frequencies above the noise for the fit
_ENOUGH_BINS = 40        # clear bins that the phase rule keeps in any case
_LEAST_LAG_S = 1e-3       # s; a shorter lag counts as this one
_ABOUT_AS_WELL = 9.0     # of −2 ln L: a smaller difference counts as an equal fit
_UNSEEN = 0.1            # sd by which friction as large as the whole torque would show: with less it is unobservable


@dataclass(frozen=True)
class FoundFit:
    """Final problem, its fit, and the clear ones of all bins; ``keep``: the bins that were used."""

    problem: FitProblem
    fit: Fit
    clear: int
    keep: BoolArray


def search(bins: Bins, priors: tuple[GaussianPrior, ...], torque_span_nm: float) -> tuple[FoundFit, ...]:
    """Return the fits in a wide and in a narrow band, in this order; none if too few bins are clear of the noise.

    Each filter has one pole.
    """
    inertia = _rough(bins)
    if inertia is None:
        return ()
    levels = tuple(index for index, column in ((FORWARD, 0), (BACK, 1)) if np.any(bins.level[:, column]))
    free = (INERTIA, VISCOUS, SPEED_LAG, TORQUE_LAG, SKEW, *levels)
    limits = box(inertia, 1.0, torque_span_nm, priors)
    every = FitProblem(bins, guessed(bins, inertia).variance, priors, free, limits)
    # bins for the first fit: torque and acceleration above their noise at the highest frequencies
    moved, _ = smoothed(bins.hertz, np.abs(inertia * bins.s * bins.speed[:, 0]) ** 2 / bins.energy, NARROW)
    keep = np.asarray(moved * bins.energy > CLEAR * every.variance)
    if np.count_nonzero(keep) < _ENOUGH_BINS:
        keep = np.ones(len(bins), dtype=np.bool_)
    problem = _part(every, keep)
    fit = min((minimise(problem, _start(inertia, lags, priors)) for lags in _STARTS), key=lambda one: one.objective)
    narrow = _settled(every, keep, fit, _PHASE)
    if narrow is None:
        return ()
    wide = _settled(every, narrow.keep, narrow.fit, _WIDE_PHASE)
    return (narrow,) if wide is None or len(wide.problem.bins) <= len(narrow.problem.bins) else (wide, narrow)


def _settled(every: FitProblem, keep: BoolArray, fit: Fit, phase: float) -> FoundFit | None:
    """Return the fit after some rounds from ``fit`` with the bins ``keep`` (M,); None if too few bins are clear."""
    bins, free = every.bins, every.free
    problem = _part(every, keep)
    clear = len(bins)
    for _ in range(_ROUNDS):
        _, leverage = covariance(problem, fit.theta, free)
        taken = np.zeros(len(bins))
        taken[keep] = leverage
        found = evaluate(_levelled(every, fit.theta, _unseen_levels(problem, fit.theta)), bins)
        every = replace(every, variance=from_residuals(bins, found.error, taken).variance)
        explained, _ = smoothed(bins.hertz, np.abs(found.gain * bins.speed[:, 0]) ** 2 / bins.energy, NARROW)
        stands = explained * bins.energy > CLEAR * every.variance
        clear = int(np.count_nonzero(stands))
        if clear < LEAST_BINS:
            return None
        keep = stands & (bins.hertz <= _highest(_plain(problem, fit), bins.hertz[stands], phase))
        problem = _part(every, keep)
        starts = [fit.theta]
        # At zero lag a descent stops, even without a minimum: the skew compensates the delay of a short lag, and the
        # remaining term, its square, has no slope there. A descent that reached zero with the first guess of the noise
        # may leave it with the estimated noise, from the first lags.
        fastest = float(np.max(np.abs(problem.bins.s)))
        if SKEW in problem.free and min(fit.theta[SPEED_LAG], fit.theta[TORQUE_LAG]) * fastest < _NO_LAG:
            for lags in _STARTS[1:]:
                starts.append(fit.theta.copy())
                starts[-1][[SPEED_LAG, TORQUE_LAG, SKEW]] = lags
        fit = min((minimise(problem, start) for start in starts), key=lambda one: one.objective)
    if unseen := _unseen_levels(problem, fit.theta):
        problem = replace(problem, free=tuple(index for index in problem.free if index not in unseen))
        fit = minimise(problem, _levelled(every, fit.theta, unseen))
    return FoundFit(problem, fit, clear, keep)


def _unseen_levels(problem: FitProblem, theta: FloatArray) -> tuple[int, ...]:
    """Return the friction levels that the bins do not show. Constant friction shows only at and near frequency zero.

    Its traces in the other bins are rounding errors; a fit to them would leave all parameters open.
    """
    _, slopes = problem.stacked(theta)
    weight = np.linalg.norm(slopes, axis=0) * problem.box.scale
    return tuple(index for index in (FORWARD, BACK) if index in problem.free and weight[index] < _UNSEEN)


def _levelled(every: FitProblem, theta: FloatArray, unseen: tuple[int, ...]) -> FloatArray:
    """Return theta with the unobservable friction levels set from frequency zero, all other parameters fixed."""
    if not unseen:
        return theta
    still = every.bins.chosen(every.bins.hertz == 0.0)
    found = theta.copy()
    found[list(unseen)] = 0.0
    at = evaluate(found, still)
    found[list(unseen)] = np.linalg.lstsq(-at.slopes[:, list(unseen)].real, at.error.real, rcond=None)[0]
    return found


def _plain(problem: FitProblem, fit: Fit) -> FloatArray:
    """Return theta without lags if the fit is about as good: equal lags cancel, and could have any value."""
    without = minimise(problem, fit.theta, {SPEED_LAG: 0.0, TORQUE_LAG: 0.0})
    return without.theta if without.objective - fit.objective <= _ABOUT_AS_WELL else fit.theta


def _part(every: FitProblem, keep: BoolArray) -> FitProblem:
    return replace(every, bins=every.bins.chosen(keep), variance=every.variance[keep])


def _rough(bins: Bins) -> float | None:
    """Return |T|/(ω|W|) over the lower part of the frequencies."""
    low = (bins.hertz > 0.0) & (bins.hertz <= np.quantile(bins.hertz, 0.2)) if len(bins) else np.zeros(0, dtype=bool)
    accelerated = float(np.sum(np.abs(bins.s[low] * bins.speed[low, 0]) ** 2))
    driven = float(np.sum(np.abs(bins.torque[low, 0]) ** 2))
    found = math.sqrt(driven / accelerated) if accelerated > 0.0 else 0.0
    return found if 0.0 < found < math.inf else None


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
