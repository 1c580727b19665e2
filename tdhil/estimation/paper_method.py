"""The paper's method: T = J α + b by least squares (equations 7 and 16), in the form that reproduces its field slopes.

α is the difference of the reported speed over 0.1 s, the torque is averaged over the same 0.1 s. For a sine of ω rad/s,
reported with the lags τ_w and τ_T, the slope tends to

    J (1 + ω² τ_w τ_T)/(1 + ω² τ_T²) + B (τ_w − τ_T)/(1 + ω² τ_T²),

which is 107, 118, 137 and 186 kg·m² at 0.1, 0.3, 0.5 and 1 Hz for J = 104. The slope is reported, but is never used as
J. At the raw rate (difference of neighbouring samples, torque of the later one) noise and rounding of the speed divide
the slope by 1 + var(noise of α)/var(α): it depends on the sampling rate, and becomes far too small.
"""

from collections.abc import Iterable

import numpy as np

from tdhil.estimation.result import LineFit, PaperEstimate
from tdhil.estimation.samples import Samples
from tdhil.recording import FloatArray

STEP_S = 0.1              # s; interval of the acceleration (Xu 2026)
_SHORTEST = 0.7     # shortest step, as a share of the interval: a gap before the last sample may shorten it
_LONGEST = 1.5            # of this interval: a longer one has a gap
_BLOCK = 65536      # samples worked on at once

Pairs = tuple[FloatArray, FloatArray]


def paper_estimate(parts: tuple[Samples, ...]) -> PaperEstimate | None:
    """Return both fits over all parts together; None if the speed never changes or there are too few steps."""
    # block by block, the backward difference of the speed with the torque at the end of the interval
    raw = ((np.diff(part.speed_rad_s[block]) / np.diff(part.time_s[block]), part.torque_nm[block][1:])
           for part in parts for block in (slice(k, k + _BLOCK + 1) for k in range(0, len(part) - 1, _BLOCK)))
    first, second = _fit_blocks(map(_steps, parts)), _fit_blocks(raw)
    return None if first is None or second is None else PaperEstimate(stepped=first, raw_rate=second)


def _fit_blocks(blocks: Iterable[Pairs]) -> LineFit | None:
    """Return `line_fit` over blocks of (α, torque), each read once. Moments about means are combined after Chan et al.

    With d the difference of two parts' means, the moments about the common one are those about their own plus
    d² n₁ n₂/(n₁ + n₂). R² is (Σ a t)²/(Σ a² Σ t²), which is 1 − Σ (t − slope a)²/Σ t² at the least-squares slope.
    """
    count, alpha_mean, torque_mean = 0, 0.0, 0.0
    power = cross = total = 0.0
    for alpha, torque in blocks:
        own = len(alpha)
        if own == 0:
            continue
        alpha_own, torque_own = float(np.mean(alpha)), float(np.mean(torque))
        a, t = alpha - alpha_own, torque - torque_own
        further_a, further_t, both = alpha_own - alpha_mean, torque_own - torque_mean, count + own
        share = count * own / both
        power += float(a @ a) + further_a * further_a * share
        cross += float(a @ t) + further_a * further_t * share
        total += float(t @ t) + further_t * further_t * share
        alpha_mean += further_a * own / both
        torque_mean += further_t * own / both
        count = both
    if count < 3 or power <= 0.0 or not np.isfinite(power):
        return None
    slope = cross / power
    r2 = slope * cross / total if total > 0.0 else 0.0
    return LineFit(inertia_kg_m2=slope, intercept_nm=torque_mean - slope * alpha_mean, r2=r2)


def line_fit(alpha: FloatArray, torque: FloatArray) -> LineFit | None:
    """Ordinary least squares of torque (N·m) on angular acceleration (rad/s²)."""
    if len(alpha) < 3:
        return None
    a, t = alpha - alpha.mean(), torque - torque.mean()
    power = float(a @ a)
    if power <= 0.0 or not np.isfinite(power):
        return None
    slope = float(a @ t) / power
    total = float(t @ t)
    r2 = 1.0 - float(np.sum((t - slope * a) ** 2)) / total if total > 0.0 else 0.0
    return LineFit(inertia_kg_m2=slope, intercept_nm=float(torque.mean() - slope * alpha.mean()), r2=r2)


def _steps(part: Samples) -> Pairs:
    """Yield steps of 0.1 s, one after the other, from sample to nearest sample, with the trapezoidal mean of the
    torque.
    """
    time = part.time_s
    if len(time) < 3:
        return np.zeros(0), np.zeros(0)
    marks = np.arange(time[0], time[-1] + 0.5 * STEP_S, STEP_S)
    right = np.clip(np.searchsorted(time, marks), 1, len(time) - 1)
    nearest = np.where(marks - time[right - 1] <= time[right] - marks, right - 1, right)
    nearest = np.unique(nearest)
    impulse = _impulse(part)
    length = np.diff(time[nearest])
    good = (length >= _SHORTEST * STEP_S) & (length <= _LONGEST * STEP_S)
    alpha = np.diff(part.speed_rad_s[nearest])[good] / length[good]
    return alpha, np.diff(impulse[nearest])[good] / length[good]


def _impulse(part: Samples) -> FloatArray:
    """Return the trapezoidal integral of the torque from the first sample to each, (N,), N·m·s, in a single array."""
    time, torque = part.time_s, part.torque_nm
    total = np.zeros(len(time))
    for first in range(0, len(time) - 1, _BLOCK):
        last = min(first + _BLOCK, len(time) - 1)
        mean = 0.5 * (torque[first + 1 : last + 1] + torque[first:last])
        total[first + 1 : last + 1] = mean * np.diff(time[first : last + 1])
    return np.cumsum(total, out=total)
