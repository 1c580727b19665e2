"""Stopping rule of stage 5: the cost of deciding by the scatter, and of deciding by the interval itself.

By the scatter. A pilot of n₀ periods at each mean speed is run. Its scatter (never its value of J) gives the expected
width of the interval and the necessary number of periods. These are run, and the scatter is analysed again. In Gaussian
data the means and the scatter about them are independent. So, given the number of periods N, the error of J̄ has the
same distribution as with an N fixed beforehand, N(0, σ²/N). Only the scatter is selected: if the pilot's s₀² is small,
N is small and s₀² keeps a large share of the pooled s². With t the quantile, the interval covers with

    P = E[2 Φ(t s/σ) − 1],   s² = (ν₀ s₀² + ν₁ s₁²)/(ν₀ + ν₁),   ν₁ = ν₀ (N − 1),   N = N(s₀²),

(N in pilots, s₀²/σ² = χ²/ν₀ and s₁²/σ² = χ²/ν₁ independent). P is below the confidence by some tenths of a percent,
most if N is between one and two pilots. `working_confidence` corrects this for the rule N = 1 if s₀² ≤ r σ², else
N = a s₀²/(r σ²), for any r and a: it returns the confidence whose quantile makes the minimum of P over r and a equal to
the requested one. Both expectations are sums over equally likely values. Further analyses follow if the first extension
was not enough; they are rare, with ν doubled: in simulation, three of them change P by less than 0.0003. ν₀ is that of
one line's variance. J depends on several lines and on B, so the true ν₀ is larger, and the correction slightly too
large.

By the interval. It also depends on the residuals: another set of lags may be excluded, or just not. So when the scatter
suffices, the interval itself is checked. If it is still too wide, one more extension and another check follow. To keep
an interval only if it is narrow is a selection by the data. But the run's interval is one of several, and its
probability of a miss is at most that any of them misses, for every way of selection. This is P(I₁ misses) + P(I₂ misses
and I₁ doesn't) + … . The k-th term gets α_k = 0.7·0.3^(k − 1) α, and the sum is α. If the k-th interval misses, the
(k − 1)-th mostly does too, because it holds a share r of the same data: an interval misses if the signed root z of its
likelihood ratio at the true J is too large. Such roots of growing data have normal increments, so the correlation of
z_k and z_(k − 1) is √r (alpha spending, Lan and DeMets). An extension after an interval is at most three times as long
as all data before it: r ≥ ¼ is assumed. This widens the interval by a few percent in most runs, and by a sixth in runs
with a second check. If the extension were at most as long (r ≥ ½), a second check would cost an eighth, but runs with
lags that are separated late would need a third and a fourth check, which cost far more.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import lru_cache
from itertools import product
from typing import Any

import numpy as np

from tdhil.estimation import (
    measure_levels,
    period_lines,
    pooled_lines,
    stretches,
    tie_viscous,
    usable_samples,
)
from tdhil.estimation.frequency_domain import LEAST_NU
from tdhil.recording import FloatArray, Recording
from tdhil.runner.design.prediction import (
    Evidence,
    FittedRigid,
    fit,
    half_width,
    longer,
    noise_free,
    whole_periods,
)

LOOKS = 4                 # largest number of extensions
FIRST_SHARE = 0.7         # share of the remaining miss probability that the next checked interval uses
MOST_BEHIND = 3.0         # longest extension after an interval, multiple of all data before it: r ≥ ¼
AIM = 0.7                 # probability that one extension is enough; another one costs little more time
MARGIN = 1.05             # an interval is 4 % (1 sd) wider or narrower than its scatter predicts, by the residuals
_WORTH_SHARE = 0.1        # excess over the interval at the end of the time, as a share, that is not worth more time
_THRESHOLDS = (0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.25, 1.5, 2.0)   # candidates of r
_MARGINS = (1.0, 1.3)     # candidates of a
_PILOTS, _EXTENSIONS = 128, 32   # equally likely scatters of a pilot and of an extension over which a rule is rated


@dataclass(frozen=True)
class Stopping:
    """Stopping rule of one run. `working`: confidences of the intervals, so that ``confidence`` holds at the end.

    ``reachable``: the tolerance is expected to be reached in ``allowed_s``. If not, ``advice`` states what would help.
    ``by_interval``: the scatter of a rigid shaft is no criterion here; the interval itself is checked.
    """

    tolerance: float
    confidence: float
    pilot_dof: float
    pilot_periods: int
    expected_periods: int
    allowed_s: float
    reachable: bool
    advice: str = ""
    by_interval: bool = False

    def working(self, seen: int) -> float:
        """Return the confidence of the interval that is checked after ``seen`` others."""
        return interval_confidence(self.confidence, self.pilot_dof, seen)

    def plain(self) -> dict[str, Any]:
        """Return it as plain data for the run's configuration."""
        return asdict(self)


def interval_confidence(confidence: float, pilot_dof: float, seen: int) -> float:
    """Return the confidence for computing the interval that is checked after ``seen`` others."""
    return working_confidence(spent_confidence(confidence, seen), pilot_dof)


@lru_cache(maxsize=64)
def spent_confidence(confidence: float, seen: int) -> float:
    """Return the confidence of the interval checked after ``seen`` others, for a known scatter (above)."""
    from scipy.special import ndtr, ndtri

    spent = FIRST_SHARE * (1.0 - FIRST_SHARE) ** seen * (1.0 - confidence)
    if seen == 0:
        return 1.0 - spent
    before = float(ndtri(0.5 + 0.5 * spent_confidence(confidence, seen - 1)))
    root = math.sqrt(1.0 / (1.0 + MOST_BEHIND))
    nodes, weights = np.polynomial.legendre.leggauss(64)

    def newly(edge: float) -> float:
        """Return the probability that |z_k| is above ``edge`` while |z_(k − 1)| is within its own limit."""
        z = edge + 4.0 * (nodes + 1.0)
        inside = ndtr((before - root * z) / math.sqrt(1.0 - root**2)) - ndtr(
            (-before - root * z) / math.sqrt(1.0 - root**2)
        )
        return float(8.0 * np.sum(weights * inside * np.exp(-0.5 * z * z)) / math.sqrt(2.0 * math.pi))

    low, high = 0.0, float(-ndtri(0.5 * spent))
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if newly(middle) > spent else (low, middle)
    return float(2.0 * ndtr(high) - 1.0)


@lru_cache(maxsize=16)
def working_confidence(confidence: float, pilot_dof: float) -> float:
    """Return the confidence for computing intervals so that they cover with ``confidence`` after the analyses.

    ``pilot_dof``: real degrees of freedom of a line's variance after the pilot.
    """
    rules = _rules(pilot_dof)
    low, high = confidence, 1.0 - 0.2 * (1.0 - confidence)
    for _ in range(24):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if _worst(rules, middle) >= confidence else (middle, high)
    return high


def worst_coverage(working: float, pilot_dof: float) -> float:
    """Return the least P over the rules above, for intervals computed with the confidence ``working``."""
    return _worst(_rules(pilot_dof), working)


def _worst(rules: list[tuple[FloatArray, FloatArray]], working: float) -> float:
    from scipy.special import ndtr, stdtrit

    return min(
        float(np.mean(2.0 * ndtr(stdtrit(dof, 0.5 + 0.5 * working)[:, None] * root) - 1.0)) for dof, root in rules
    )


def _rules(dof: float) -> list[tuple[FloatArray, FloatArray]]:
    """Return, for every r and a, degrees of freedom at the end (PILOTS,), and s/σ (PILOTS, EXTENSIONS)."""
    from scipy.special import gammaincinv

    s0 = gammaincinv(0.5 * dof, _equally_likely(_PILOTS)) * 2.0 / dof
    found = []
    for r, a in product(_THRESHOLDS, _MARGINS):
        pilots = np.where(s0 <= r, 1.0, np.maximum(a * s0 / r, 1.0))
        added = dof * (pilots - 1.0)
        sums = 2.0 * gammaincinv(0.5 * np.maximum(added, 1e-6)[:, None], _equally_likely(_EXTENSIONS)[None, :])
        pooled = (dof * s0[:, None] + np.where(added[:, None] > 0.0, sums, 0.0)) / (dof + added)[:, None]
        found.append((dof + added, np.sqrt(pooled)))
    return found


def _equally_likely(count: int) -> FloatArray:
    return (np.arange(count) + 0.5) / count


def aimed_scatter(dof: float, added: float) -> float:
    """Return the factor by which the pooled variance rises at most with probability AIM: (ν₀ + ν₁ F)/(ν₀ + ν₁)."""
    if added <= 0.0:
        return 1.0
    from scipy.special import fdtri

    return float((dof + added * fdtri(added, dof, AIM)) / (dof + added))


def least_scale(half_width: Callable[[float], float], tolerance: float, most: float) -> tuple[float, float, bool]:
    """Return the necessary length of the run: (scale, half-width with it, whether it suffices); 1 ≤ scale ≤ ``most``.

    ``half_width(scale)`` falls about as √(a/scale + b); b is the part that the unknown lag structure leaves for any
    duration. If the time is not enough, the scale is that above which almost nothing is gained.
    """
    now = half_width(1.0)
    if now <= tolerance or most <= 1.0:
        return 1.0, now, now <= tolerance
    end = half_width(most)
    enough = end <= tolerance
    if not enough and not math.isfinite(end):
        return most, end, False
    target = tolerance if enough else (1.0 + _WORTH_SHARE) * end
    if now <= target:
        return 1.0, now, enough
    low, high = (1.0, now), (most, end)
    for _ in range(4):
        scale = _between(low, high, target)
        found = half_width(scale)
        if found <= target:
            high = (scale, found)
        else:
            low = (scale, found)
        if high[0] <= 1.05 * low[0] or (found <= target and found >= 0.97 * target):
            break
    return high[0], high[1], enough


def _between(low: tuple[float, float], high: tuple[float, float], target: float) -> float:
    """Return the scale at which √(a/scale + b) through both points equals the target, away from the ends."""
    (x0, h0), (x1, h1) = low, high
    share = 0.5
    if math.isfinite(h0) and h0 > h1:
        inverse = 1.0 / x1 + (1.0 / x0 - 1.0 / x1) * (target**2 - h1**2) / (h0**2 - h1**2)
        scale = 1.0 / inverse
        share = (scale - x0) / (x1 - x0)
    return x0 + (x1 - x0) * min(max(share, 0.05), 0.95)


# ---------------------------------------------------------------------------------------------------------------------
# Interim analysis of the scatter: present width of the interval, and necessary extension.


@dataclass(frozen=True)
class Look:
    """Result of an interim analysis: J's relative half-width now, and after ``scale`` times as many periods.

    ``enough``: the tolerance is met then (now, if ``scale`` is 1). ``at_last``: the whole extension may be at the
    present mean speed, without a return to the others. The analysis does not use the value of J, except for an effect
    of second order through the lines' weights: a factor on the torque changes nothing here.
    """

    periods: float
    half_width_now: float
    scale: float
    half_width_then: float
    enough: bool
    at_last: bool = False


def look(
    recording: Recording,
    confidence: float,
    tolerance: float,
    most_scale: float,
    pilot_dof: float,
    most_at_last: float = 1.0,
) -> Look | None:
    """Analyse the data acquired so far; None if the estimator would refuse them."""
    evidence = evidence_of(recording)
    fitted = None if evidence is None else fit(evidence, confidence)
    return None if evidence is None or fitted is None else _look(
        evidence, fitted, confidence, tolerance, most_scale, pilot_dof, most_at_last
    )


def _look(
    evidence: Evidence,
    fitted: FittedRigid,
    confidence: float,
    tolerance: float,
    most_scale: float,
    pilot_dof: float,
    most_at_last: float,
) -> Look:
    explained = noise_free(evidence, fitted)
    dof = max(pilot_dof, 2.0 * evidence.lines[0].nu)
    periods = whole_periods(evidence.lines)

    def width(scale: float, at_last: bool = False) -> float:
        return half_width(longer(explained, scale, aimed_scatter(dof, dof * (scale - 1.0)), at_last), confidence)

    now = width(1.0)
    scale, then, enough = least_scale(lambda x: now if x == 1.0 else width(x, True), tolerance, most_at_last)
    if enough and scale > 1.0:
        return Look(periods, now, scale, then, True, at_last=True)
    scale, then, enough = least_scale(lambda x: now if x == 1.0 else width(x), tolerance, most_scale)
    return Look(periods, now, scale, then, enough)


def evidence_of(recording: Recording) -> Evidence | None:
    """Return lines and operating points as identification will use them; None without enough whole periods."""
    excitation = recording.excitation
    if excitation is None or not excitation.segments:
        return None
    samples = usable_samples(recording)
    cut = stretches(samples, excitation.segments)
    fits = tuple(period_lines(stretch, samples) for stretch in cut)
    levels = measure_levels(cut, fits, samples, recording.levels, 0.0)
    constraint = tie_viscous(levels)
    pooled = pooled_lines(fits, constraint.slope if constraint is not None else 0.0, levels.warming.own)
    lines = tuple(line for line in pooled if line.excited and line.nu >= LEAST_NU)
    return Evidence(lines, levels, recording.lag_prior) if lines else None
