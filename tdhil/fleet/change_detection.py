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

**A history.** x = ln x_k is normal about μ·1 + δ·h. Here h is 0 before a step and 1 from the step on, or rises evenly
with time from 0 to 1 (drift); μ has a flat prior. The covariance is Σ = κ² diag(σ_k²) + Σ_d σ_s² 1_d 1_dᵀ. The factor κ
allows for intervals that are too narrow or too wide for the scatter between runs. Results are averaged over κ and over
the size of the change, δ ~ N(0, τ²). With P = Σ⁻¹ − Σ⁻¹1(1ᵀΣ⁻¹1)⁻¹1ᵀΣ⁻¹, which eliminates μ, a = hᵀPh and b = hᵀPx,

    ln p(x | κ, none) = −½ (ln|Σ| + ln 1ᵀΣ⁻¹1 + xᵀPx) + const
    p(x | κ, h, τ) / p(x | κ, none) = (1 + τ²a)^−½ exp(½ τ²b² / (1 + τ²a)),

because the change adds τ²hhᵀ to the covariance (Sherman and Morrison, and the matrix determinant lemma). Bayes' rule
over none (½), a step (¼, evenly over its places) and drift (¼) gives the probabilities. If the prior is right, "no
change" has less than 10 % in at most 1 of 9 histories without a change (Markov's inequality). The share measured by
``benchmarks/trend_power.py`` is 0 to 1.5 %.

Σ is diagonal but for one column per drive, Σ = D + UUᵀ, so Σ⁻¹ = W − WU(I + UᵀWU)⁻¹UᵀW with W = D⁻¹ (Woodbury). For
the steps, hᵀΣ⁻¹h and hᵀΣ⁻¹x are sums over the results after the step. So the time grows with the number of results,
not with its cube: 1000 results take about 0.03 s.

One step or drift is searched at a time. After a step, both sides are searched again. Then each step is placed again
between its neighbours, because the first was placed while the others were in the data. The sizes are estimated with all
steps together: H has one column for each step, so that each segment between steps has its own level. (HᵀPH)⁻¹HᵀPx are
the sizes, and (HᵀPH)⁻¹ is their covariance. The size of one step is the difference of the two levels beside it. A
second step that was found does not falsify it; one that was missed does. Sizes are averaged over κ, as above.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist, median
from typing import Final

import numpy as np

from tdhil.recording import FloatArray

ALARM: Final = 0.1
"""Limit for a change: it is reported if the probability of "no change" is below this."""
LEAST: Final = 4
"""Least number of results in a history. Fewer can be compared in pairs."""

_NORMAL: Final = NormalDist()       # the quantile of tdhil.estimation would load that whole package: 0.4 s
_SPREAD: Final = ((0.5, 0.10), (0.7, 0.20), (1.0, 0.40), (1.4, 0.15), (2.0, 0.10), (2.8, 0.05))     # κ, its prior
_SIZES: Final = (2.0, 4.0, 8.0, 16.0, 32.0)            # τ in units of the median σ_k, each as likely
_PASSES: Final = 8          # most searches for the places of several steps; two to three suffice
_PRIOR: Final = {"none": 0.5, "step": 0.25, "drift": 0.25}


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
    ``here``: probability of this place, given a step. ``change`` as in `Difference`.
    """

    at: int
    probability: float
    here: float
    change: Difference


@dataclass(frozen=True)
class History:
    """Statement on a history. ``none``, ``step`` and ``drift`` add up to one. ``changes`` and ``drift_change`` are
    empty unless "no change" is excluded. ``drift_change``: from the first result to the last.
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
    sizes = _sizes(known, [one.at for one in found])
    changes = tuple(ChangePoint(one.at, one.probability, one.here, _size(mean, deviation, confidence, relative))
                    for one, (mean, deviation) in zip(found, sizes, strict=True))
    return History(
        whole.none, whole.step, whole.drift, changes,
        _size(whole.drift_size, whole.drift_sd, confidence, relative) if drifts else None, relative,
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
class _ChangeEvidence:
    none: float
    step: float
    drift: float
    places: FloatArray          # probability of each place of a step: before result 1, 2, …
    drift_size: float
    drift_sd: float


def _after(values: FloatArray) -> FloatArray:
    """Return the sums of the rows after each row but the last: those of a step before result 1, 2, …"""
    return np.cumsum(values[::-1], axis=0)[-2::-1]


def _evidence(known: _Series) -> _ChangeEvidence:
    n, time = len(known.x), known.time
    x = known.x - known.x.mean()                               # P takes out any constant; a small x is more exact
    span = time[-1] - time[0]
    rise = (time - time[0]) / span if span > 0.0 else np.arange(n) / (n - 1.0)
    sizes = median(known.sd) * np.array(_SIZES)                # np.median loads numpy.ma: 40 ms
    weights, ratios, means, variances = [], [], [], []
    for spread, prior in _SPREAD:
        inverse = _Inverse.of(known, spread)
        weight, scaled = inverse.weight, inverse.scaled
        ones, of_x, of_rise = inverse.times(np.column_stack((np.ones(n), x, rise))).T
        total = float(ones.sum())
        misfit = float(x @ of_x - of_x.sum() ** 2 / total)
        weights.append(math.log(prior) + 0.5 * (inverse.log_det - math.log(total) - misfit))
        tails = _after(scaled)
        own = np.append(_after(weight) - np.sum((tails @ inverse.inner) * tails, axis=1), rise @ of_rise)       # hᵀΣ⁻¹h
        level = np.append(_after(ones), rise @ ones)                                                    # hᵀΣ⁻¹1
        a = own - level**2 / total
        b = np.append(_after(of_x), rise @ of_x) - level * of_x.sum() / total
        gain = 1.0 + np.outer(sizes**2, a)
        log_ratio = -0.5 * np.log(gain) + 0.5 * np.outer(sizes**2, b**2) / gain
        top = log_ratio.max(axis=0)
        ratios.append(top + np.log(np.exp(log_ratio - top).mean(axis=0)))
        means.append(b[-1] / a[-1])
        variances.append(1.0 / a[-1])
    # p(x | model), averaged over κ; all of them multiplied by the same factor
    base = max(weights)
    none = sum(math.exp(one - base) for one in weights)
    by_spread = np.array([weight - base + ratio for weight, ratio in zip(weights, ratios, strict=True)])
    top = by_spread.max(axis=0)
    log_each = top + np.log(np.exp(by_spread - top).sum(axis=0))
    highest = max(math.log(none), float(log_each.max()))
    each = np.exp(log_each - highest)
    p_none = _PRIOR["none"] * math.exp(math.log(none) - highest)
    p_steps = _PRIOR["step"] * each[:-1] / (n - 1.0)
    p_drift = _PRIOR["drift"] * float(each[-1])
    whole = p_none + float(p_steps.sum()) + p_drift
    posterior = np.exp(by_spread[:, -1] - log_each[-1])        # posterior of κ, with a drift
    drift_size, drift_sd = _averaged(posterior, np.array(means), np.array(variances))
    places = p_steps / max(float(p_steps.sum()), 1e-300)
    return _ChangeEvidence(
        p_none / whole, float(p_steps.sum()) / whole, p_drift / whole, places, drift_size, drift_sd,
    )


def _averaged(posterior: FloatArray, means: FloatArray, variances: FloatArray) -> tuple[float, float]:
    """Return mean and standard deviation of a size, averaged over κ: (κ,) each."""
    mean = float(posterior @ means)
    return mean, math.sqrt(max(float(posterior @ (variances + means**2)) - mean**2, 0.0))


def _sizes(known: _Series, places: Sequence[int]) -> list[tuple[float, float]]:
    """Return size and standard deviation of each step, estimated with all steps of the history together.

    ``places``: number of the first result behind each step, rising. The level of each segment has a flat prior. The
    steps share the posterior of κ.
    """
    if not places:
        return []
    n, x = len(known.x), known.x
    design = np.column_stack((np.ones(n), (np.arange(n)[:, None] >= np.array(places)).astype(float)))
    logs, means, variances = [], [], []
    for spread, prior in _SPREAD:
        inverse = _Inverse.of(known, spread)
        solved = inverse.times(design)
        normal = design.T @ solved
        covariance = np.linalg.inv(normal)
        levels = covariance @ (solved.T @ x)
        rest = x - design @ levels
        misfit = float(rest @ inverse.times(rest[:, None])[:, 0])
        logs.append(math.log(prior) + 0.5 * (inverse.log_det - np.linalg.slogdet(normal)[1] - misfit))
        means.append(levels[1:])
        variances.append(np.diag(covariance)[1:])
    posterior = np.exp(np.array(logs) - max(logs))
    posterior /= posterior.sum()
    return [_averaged(posterior, mean, variance)
            for mean, variance in zip(np.array(means).T, np.array(variances).T, strict=True)]


@dataclass(frozen=True)
class _FoundStep:
    at: int
    probability: float
    here: float


def _steps(known: _Series, first: int) -> list[_FoundStep]:
    """Return the steps of one stretch, in their order. ``first``: number of its first result."""
    if len(known.x) < LEAST:
        return []
    found = _evidence(known)
    if found.none >= ALARM or found.step <= found.drift:
        return []
    at = int(np.argmax(found.places)) + 1
    point = _FoundStep(first + at, found.step, float(found.places[at - 1]))
    before = _steps(known.part(slice(at)), first)
    after = _steps(known.part(slice(at, None)), first + at)
    return [*before, point, *after]


def _placed(known: _Series, found: Sequence[_FoundStep]) -> list[_FoundStep]:
    """Return the steps, each with its place searched again between its neighbours, until no place changes.

    The first steps were placed while the later ones were still in the data. A wrong place falsifies the sizes beside
    it.
    """
    steps = list(found)
    for _ in range(_PASSES):
        before = [one.at for one in steps]
        for k, one in enumerate(steps):
            start = steps[k - 1].at if k else 0
            end = steps[k + 1].at if k + 1 < len(steps) else len(known.x)
            if end - start >= LEAST:
                seen = _evidence(known.part(slice(start, end)))
                at = int(np.argmax(seen.places)) + 1
                steps[k] = _FoundStep(start + at, one.probability, float(seen.places[at - 1]))
        if [one.at for one in steps] == before:
            break
    return steps


def _size(mean: float, sd: float, confidence: float, relative: bool, shared: bool = True) -> Difference:
    half = _NORMAL.inv_cdf(0.5 + 0.5 * confidence) * sd
    out = math.expm1 if relative else float
    probability = _NORMAL.cdf(abs(mean) / sd) if sd > 0.0 else 1.0 if mean else 0.5
    return Difference(out(mean), out(mean - half), out(mean + half), confidence, relative, shared, probability)
