"""Detection of changes: differences of two results, and changes in a history, without the shared torque scale.

Pure: numbers in, numbers out. The terminal, a page and a web service use these same functions.

**Model of a result.** An inverter's torque is right except for a factor. The factor is the same in every run on that
drive, and multiplies J, viscous and Coulomb friction. With the true value θ,

    ln x_k = ln θ_k + s_d(k) + e_k,    s_d ~ N(0, σ_s²) once for each drive d,    e_k ~ N(0, σ_k²) for each run.

The interval ``low`` to ``high`` (repeatability) is that of e_k alone; σ_k is half its width in ln x over the normal
quantile of its confidence. A part of it (unstated filters, for example) is the same in runs on one rig. It counts as
independent here, which makes the intervals of differences wider, not narrower. Quantities that the torque scale does
not multiply (lags) or that may be zero (skew) are treated in the same way without logarithm, with s = 0.

**A difference** of two results on one drive has s in both: it cancels, and the variance is σ_a² + σ_b². On two drives
it is σ_a² + σ_b² + σ_s,a² + σ_s,b².

**A history.** x = ln x_k is normal about μ·1 + δ·h. Here h is 0 before a step and 1 from the step on, or 1 between two
places (a change that ends again), or rises evenly with time from 0 to 1 (drift); μ has a flat prior. The covariance is
Σ = κ² diag(σ_k²) + Σ_d σ_s² 1_d 1_dᵀ. The factor κ
allows for intervals that are too narrow or too wide for the scatter between runs. Results are averaged over κ and over
the size of the change, δ ~ N(0, τ²). With P = Σ⁻¹ − Σ⁻¹1(1ᵀΣ⁻¹1)⁻¹1ᵀΣ⁻¹, which eliminates μ, a = hᵀPh and b = hᵀPx,

    ln p(x | κ, none) = −½ (ln|Σ| + ln 1ᵀΣ⁻¹1 + xᵀPx) + const
    p(x | κ, h, τ) / p(x | κ, none) = (1 + τ²a)^−½ exp(½ τ²b² / (1 + τ²a)),

because the change adds τ²hhᵀ to the covariance (Sherman and Morrison, and the matrix determinant lemma). Bayes' rule
over none, a step, two steps and drift (`_PRIOR`, evenly over the places) gives the probabilities. If the prior is
right, "no change" has less than 10 % in at most 1 of 9 histories without a change (Markov's inequality). The share
measured by ``benchmarks/trend_power.py`` is 0 to 1.5 %.

Σ is diagonal but for one column per drive, Σ = D + UUᵀ, so Σ⁻¹ = W − WU(I + UᵀWU)⁻¹UᵀW with W = D⁻¹ (Woodbury). For
the steps, hᵀΣ⁻¹h and hᵀΣ⁻¹x are sums over the results after the step, and for two steps differences of such sums. So
the time grows with the number of results, not with its cube. Pairs of steps are searched at up to `_PAIRED` places.

One step, two opposite steps, or drift is searched at a time. After a step, both sides are searched again. Without the
pair, a change that ends again would count as scatter: one step does not explain it. Then each step is placed again
between its neighbours, because the first was placed while the others were in the data.

**The size of a step** is its posterior between the neighbouring steps, over κ, τ and place j, with 0 for no change:

    p(δ | x) = p_0 δ_0 + (1 − p_0) Σ w_κτj N(δ; m, v),    m = τ²b_j / (1 + τ²a_j),    v = τ² / (1 + τ²a_j),
    w_κτj ∝ p(κ) p(x | κ, h_j, τ),    p_0 = p(none | x) / (p(none | x) + p(step | x)).

The most probable place is also the place where chance makes the step large, and a step is only reported if it is large
enough to be seen. A flat prior of δ at the most probable place therefore gives sizes that are too large. The size of a
drift is the same, without the sum over places.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from statistics import NormalDist, median
from typing import Final

import numpy as np

from tdhil.recording import FloatArray, IntArray

ALARM: Final = 0.1
"""Limit for a change: it is reported if the probability of "no change" is below this."""
LEAST: Final = 4
"""Least number of results in a history. Fewer can be compared in pairs."""

_NORMAL: Final = NormalDist()       # the quantile of tdhil.estimation would load that whole package: 0.4 s
_SPREAD: Final = ((0.5, 0.10), (0.7, 0.20), (1.0, 0.40), (1.4, 0.15), (2.0, 0.10), (2.8, 0.05))     # κ, its prior
_SIZES: Final = (2.0, 4.0, 8.0, 16.0, 32.0)            # τ in units of the median σ_k, each as likely
_PASSES: Final = 8          # most searches for the places of several steps; two to three suffice
_LEAST_SHARE: Final = 1e-6  # least weight of a component of a mixture, in units of the greatest
_EXACT: Final = 1e-6        # resolution of a quantile of a mixture, in units of the least standard deviation
_TINY: Final = 1e-300       # probabilities that are all zero by underflow stay zero
_PRIOR: Final = {"none": 0.5, "step": 0.2, "pair": 0.1, "drift": 0.2}
_PAIRED: Final = 128        # most places for a pair of steps; `_placed` then finds the exact ones


@dataclass(frozen=True)
class Measured:
    """One result: ``low`` to ``high`` at ``confidence`` is the repeatability alone.

    ``scale_rel_sd``: relative standard uncertainty of the torque scale, 0 for quantities without torque. ``drive``: the
    drive with this scale; None: unknown, which counts as different from any other. ``time``: any rising measure of
    time.
    """

    value: float
    low: float
    high: float
    confidence: float = 0.95
    scale_rel_sd: float = 0.0
    drive: str | None = None
    time: float = 0.0


@dataclass(frozen=True)
class Difference:
    """Difference of two results. ``change`` with its interval is a share of the first if ``relative``, else absolute.

    ``probability``: that the true change has the sign of ``change``. ``shared_scale``: the torque scale is the same in
    both results and cancels.
    """

    change: float
    low: float
    high: float
    confidence: float
    relative: bool
    shared_scale: bool
    probability: float

    @property
    def differs(self) -> bool:
        """True if the interval excludes zero."""
        return self.low > 0.0 or self.high < 0.0


def difference(before: Measured, after: Measured, confidence: float = 0.95) -> Difference:
    """Return the change between two results, with its probability. Raises ValueError for invalid intervals."""
    relative = all(min(one.value, one.low) > 0.0 for one in (before, after))
    shared = before.drive is not None and before.drive == after.drive
    (x_a, sd_a), (x_b, sd_b) = (_on_scale(one, relative) for one in (before, after))
    variance = sd_a**2 + sd_b**2
    if not shared:
        variance += sum((one.scale_rel_sd * (1.0 if relative else abs(one.value))) ** 2 for one in (before, after))
    sd = math.sqrt(variance)
    return _size(x_b - x_a, sd, confidence, relative, shared)


@dataclass(frozen=True)
class ChangePoint:
    """A step between result ``at - 1`` and result ``at``. ``probability``: that of any step in the examined stretch;
    ``here``: probability of this place, given a step. ``change``: median and interval of the size, over all places of
    this step, and with 0 for no change.
    """

    at: int
    probability: float
    here: float
    change: Difference


@dataclass(frozen=True)
class History:
    """Statement on a history. ``none``, ``step`` (one or two) and ``drift`` add up to one.

    ``changes`` and ``drift_change`` are empty unless "no change" is excluded. ``drift_change``: from the first result
    to the last.
    """

    none: float
    step: float
    drift: float
    changes: tuple[ChangePoint, ...]
    drift_change: Difference | None
    relative: bool

    @property
    def changed(self) -> bool:
        """True if "no change" is excluded."""
        return self.none < ALARM


def history(results: Sequence[Measured], confidence: float = 0.95) -> History:
    """Look for a step or a drift. Raises ValueError for fewer than `LEAST` results, or times that fall."""
    if len(results) < LEAST:
        raise ValueError(f"{len(results)} results: a history needs {LEAST}")
    time = np.array([one.time for one in results])
    if np.any(np.diff(time) < 0.0):
        raise ValueError("results must be in the order of their times")
    relative = all(min(one.value, one.low) > 0.0 for one in results)
    x, sd = (np.array(column) for column in zip(*(_on_scale(one, relative) for one in results), strict=True))
    if not np.all(sd > 0.0):
        raise ValueError("an interval of no width")
    drives = list(dict.fromkeys(one.drive for one in results if one.drive is not None))
    shared, own = np.zeros((len(results), len(drives))), np.zeros(len(results))
    for row, one in enumerate(results):
        size = one.scale_rel_sd * (1.0 if relative else one.value)
        if one.drive is None:
            own[row] = size
        else:
            shared[row, drives.index(one.drive)] = size
    known = _Series(x, sd, shared, own, time)
    whole = _evidence(known)
    drifts = whole.none < ALARM and whole.drift > whole.step
    found = [] if drifts or whole.none >= ALARM else _placed(known, _steps(known, 0))
    changes = tuple(ChangePoint(one.at, one.probability, one.here, one.size.change(confidence, relative))
                    for one in found)
    return History(
        whole.none, whole.step, whole.drift, changes,
        whole.drift_size.change(confidence, relative) if drifts else None, relative,
    )


def _on_scale(one: Measured, relative: bool) -> tuple[float, float]:
    """Return the logarithm of the value with its standard deviation, or the value itself with its own."""
    if not one.low <= one.high or not 0.0 < one.confidence < 1.0:
        raise ValueError(f"no interval: {one.low:g} to {one.high:g} at {one.confidence:g}")
    quantile = _NORMAL.inv_cdf(0.5 + 0.5 * one.confidence)
    if relative:
        return math.log(one.value), (math.log(one.high) - math.log(one.low)) / (2.0 * quantile)
    return one.value, (one.high - one.low) / (2.0 * quantile)


@dataclass(frozen=True)
class _Series:
    """Results of a history. ``x``, ``sd``, ``own``, ``time``: (n,), ``shared``: (n, drives).

    Standard deviations that the torque scales cause: ``shared`` is U with a column for each drive; ``own`` is that of
    results of an unknown drive, which share their scale with no other.
    """

    x: FloatArray
    sd: FloatArray
    shared: FloatArray
    own: FloatArray
    time: FloatArray

    def part(self, where: slice) -> _Series:
        return _Series(*(values[where] for values in (self.x, self.sd, self.shared, self.own, self.time)))


@dataclass(frozen=True)
class _Inverse:
    """Σ⁻¹ for one κ: ``weight`` W (n,), ``scaled`` WU (n, drives), ``inner`` (I + UᵀWU)⁻¹, and ``log_det`` of Σ⁻¹."""

    weight: FloatArray
    scaled: FloatArray
    inner: FloatArray
    log_det: float

    @classmethod
    def of(cls, known: _Series, spread: float) -> _Inverse:
        weight = 1.0 / ((spread * known.sd) ** 2 + known.own**2)
        scaled = weight[:, None] * known.shared
        capacitance = np.eye(scaled.shape[1]) + known.shared.T @ scaled
        log_det = float(np.log(weight).sum() - np.linalg.slogdet(capacitance)[1])
        inner: FloatArray = np.asarray(np.linalg.inv(capacitance), dtype=np.float64)
        return cls(weight, scaled, inner, log_det)

    def times(self, columns: FloatArray) -> FloatArray:
        """Return Σ⁻¹ times columns (n, m)."""
        found: FloatArray = self.weight[:, None] * columns - self.scaled @ (self.inner @ (self.scaled.T @ columns))
        return found


@dataclass(frozen=True)
class _SizePosterior:
    """Posterior of a size: 0 with probability ``zero``, else a mixture of normal distributions.

    ``share``, ``mean``, ``sd``: (components,).
    """

    zero: float
    share: FloatArray
    mean: FloatArray
    sd: FloatArray

    @classmethod
    def of(cls, zero: float, log_share: FloatArray, mean: FloatArray, variance: FloatArray) -> _SizePosterior:
        """Return the mixture of components of any shape. Those without influence on an interval are left out."""
        share = np.exp(log_share - log_share.max())
        kept = share > _LEAST_SHARE
        return cls(zero, (1.0 - zero) * share[kept] / share[kept].sum(), mean[kept], np.sqrt(variance[kept]))

    def below(self, size: float) -> float:
        """Return the probability of a smaller size."""
        components = zip(*(each.tolist() for each in (self.share, self.mean, self.sd)), strict=True)
        return self.zero * (size > 0.0) + float(
            sum(share * _NORMAL.cdf((size - mean) / sd) for share, mean, sd in components))

    def quantile(self, probability: float) -> float:
        """Return the size that is not exceeded with this probability, by bisection."""
        if 0.0 <= probability - self.below(0.0) <= self.zero:
            return 0.0
        reach = -_NORMAL.inv_cdf(0.5 * min(probability, 1.0 - probability))
        low, high = float((self.mean - reach * self.sd).min()), float((self.mean + reach * self.sd).max())
        while high - low > _EXACT * float(self.sd.min()):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self.below(middle) < probability else (low, middle)
        return 0.5 * (low + high)

    def change(self, confidence: float, relative: bool) -> Difference:
        """Return the median with the interval of equal tails."""
        out = math.expm1 if relative else float
        middle, low, high = (out(self.quantile(0.5 + side * confidence)) for side in (0.0, -0.5, 0.5))
        negative = self.below(0.0)
        return Difference(middle, low, high, confidence, relative, True, max(negative, 1.0 - self.zero - negative))


@dataclass(frozen=True)
class _ChangeEvidence:
    none: float
    step: float                 # one step, or two
    drift: float
    places: FloatArray          # probability of each place of a single step: before result 1, 2, …
    pair: tuple[int, int] | None        # most probable places of two steps, if they are more probable than one
    step_size: _SizePosterior
    drift_size: _SizePosterior


@dataclass(frozen=True)
class _Sums:
    """Sums over the results from each place on, and 0 at the end, of the parts of hᵀΣ⁻¹h, hᵀΣ⁻¹1 and hᵀΣ⁻¹x.

    ``weight``, ``ones``, ``of_x``: (n + 1,), ``scaled``: (n + 1, drives).
    """

    weight: FloatArray
    scaled: FloatArray
    ones: FloatArray
    of_x: FloatArray

    @classmethod
    def of(cls, inverse: _Inverse, ones: FloatArray, of_x: FloatArray) -> _Sums:
        return cls(*(np.append(np.cumsum(one[::-1], axis=0)[::-1], np.zeros_like(one[:1]), axis=0)
                     for one in (inverse.weight, inverse.scaled, ones, of_x)))

    def between(self, first: IntArray, last: IntArray, inner: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return hᵀΣ⁻¹h, hᵀΣ⁻¹1 and hᵀΣ⁻¹x of changes from result ``first`` to before result ``last``: (m,) each."""
        weight, scaled, ones, of_x = (
            one[first] - one[last] for one in (self.weight, self.scaled, self.ones, self.of_x))
        return weight - np.sum((scaled @ inner) * scaled, axis=1), ones, of_x


def _pairs(n: int) -> tuple[IntArray, IntArray]:
    """Return first and last place of all pairs of steps among at most `_PAIRED` places, none at an end."""
    stride = -(-n // _PAIRED)
    at = np.arange(stride, n, stride)
    first, last = np.triu_indices(len(at), 1)
    return at[first], at[last]


def _evidence(known: _Series, *, pairs: bool = True) -> _ChangeEvidence:
    n, time = len(known.x), known.time
    x = known.x - known.x.mean()                               # P takes out any constant; a small x is more exact
    span = time[-1] - time[0]
    rise = (time - time[0]) / span if span > 0.0 else np.arange(n) / (n - 1.0)
    sizes = median(known.sd) * np.array(_SIZES)                # np.median loads numpy.ma: 40 ms
    squares = sizes[:, None] ** 2                              # τ²
    first, last = _pairs(n) if pairs else (np.zeros(0, dtype=int), np.zeros(0, dtype=int))
    begins, ends = np.append(np.arange(1, n), first), np.append(np.full(n - 1, n), last)
    logs, each_log, means, variances = [], [], [], []
    for spread, prior in _SPREAD:
        inverse = _Inverse.of(known, spread)
        ones, of_x, of_rise = inverse.times(np.column_stack((np.ones(n), x, rise))).T
        total = float(ones.sum())
        misfit = float(x @ of_x - of_x.sum() ** 2 / total)
        logs.append(math.log(prior) + 0.5 * (inverse.log_det - math.log(total) - misfit))
        of_steps = _Sums.of(inverse, ones, of_x).between(begins, ends, inverse.inner)
        own, level, of_own = (np.append(*both) for both in zip(
            of_steps, (rise @ of_rise, rise @ ones, rise @ of_x), strict=True))       # hᵀΣ⁻¹h, hᵀΣ⁻¹1, hᵀΣ⁻¹x
        a = own - level**2 / total
        b = of_own - level * of_x.sum() / total
        gain = 1.0 + squares * a
        each_log.append(logs[-1] - math.log(len(sizes)) + 0.5 * (squares * b**2 / gain - np.log(gain)))
        means.append(squares * b / gain)
        variances.append(squares / gain)
    # (κ, τ, shape): p(x, κ, τ | shape of the change), all multiplied by the same factor; the last shape is the drift
    by_size, mean, variance = (np.array(values) for values in (each_log, means, variances))
    highest = max(*logs, float(by_size.max()))
    each = np.exp(by_size - highest).sum(axis=(0, 1))
    p_none = _PRIOR["none"] * sum(math.exp(one - highest) for one in logs)
    p_steps = _PRIOR["step"] * each[: n - 1] / (n - 1.0)
    p_pairs = _PRIOR["pair"] * each[n - 1 : -1] / max(len(first), 1)
    p_drift = _PRIOR["drift"] * float(each[-1])
    p_step, p_pair = float(p_steps.sum()), float(p_pairs.sum())
    whole = p_none + p_step + p_pair + p_drift
    step_size, drift_size = (
        _SizePosterior.of(p_none / max(p_none + p_change, _TINY), by_size[..., shapes], mean[..., shapes],
                          variance[..., shapes])
        for shapes, p_change in ((slice(n - 1), p_step), (-1, p_drift)))
    best = int(np.argmax(p_pairs)) if p_pair > p_step else None
    return _ChangeEvidence(
        p_none / whole, (p_step + p_pair) / whole, p_drift / whole, p_steps / max(p_step, _TINY),
        None if best is None else (int(first[best]), int(last[best])), step_size, drift_size,
    )


@dataclass(frozen=True)
class _FoundStep:
    at: int
    probability: float
    here: float
    size: _SizePosterior


def _steps(known: _Series, first: int) -> list[_FoundStep]:
    """Return the steps of one stretch, in their order. ``first``: number of its first result."""
    if len(known.x) < LEAST:
        return []
    found = _evidence(known)
    if found.none >= ALARM or found.step <= found.drift:
        return []
    new = [_most_probable(found, 0, found.step)]
    if found.pair is not None:                 # a pair is searched at some places only
        new = _placed(known, [replace(new[0], at=at) for at in found.pair])
    ends = [0, *(one.at for one in new), len(known.x)]
    parts = [_steps(known.part(slice(begin, end)), first + begin) for begin, end in pairwise(ends)]
    placed = [replace(one, at=first + one.at) for one in new]
    return [*parts[0], *(step for one, part in zip(placed, parts[1:], strict=True) for step in (one, *part))]


def _most_probable(found: _ChangeEvidence, first: int, probability: float) -> _FoundStep:
    """Return the step of a stretch. ``first``: number of its first result."""
    at = int(np.argmax(found.places)) + 1
    return _FoundStep(first + at, probability, float(found.places[at - 1]), found.step_size)


def _placed(known: _Series, found: Sequence[_FoundStep]) -> list[_FoundStep]:
    """Return the steps, each with its place searched again between its neighbours, until no place changes."""
    steps = list(found)
    for _ in range(_PASSES):
        before = [one.at for one in steps]
        for k, one in enumerate(steps):
            start = steps[k - 1].at if k else 0
            end = steps[k + 1].at if k + 1 < len(steps) else len(known.x)
            steps[k] = _most_probable(
                _evidence(known.part(slice(start, end)), pairs=False), start, one.probability)
        if [one.at for one in steps] == before:
            break
    return steps


def _size(mean: float, sd: float, confidence: float, relative: bool, shared: bool = True) -> Difference:
    half = _NORMAL.inv_cdf(0.5 + 0.5 * confidence) * sd
    out = math.expm1 if relative else float
    probability = _NORMAL.cdf(abs(mean) / sd) if sd > 0.0 else 1.0 if mean else 0.5
    return Difference(out(mean), out(mean - half), out(mean + half), confidence, relative, shared, probability)
