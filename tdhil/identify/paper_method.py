"""The paper's method: T = J α + b by least squares (equations 7 and 16), in the form that reproduces its field slopes.

α is the difference of the reported speed over 0.1 s, the torque is averaged over the same 0.1 s. With a sine of ω rad/s
reported through lags τ_w and τ_T its slope tends to

    J (1 + ω² τ_w τ_T)/(1 + ω² τ_T²) + B (τ_w − τ_T)/(1 + ω² τ_T²),

which is 107, 118, 137 and 186 kg·m² at 0.1, 0.3, 0.5 and 1 Hz for J = 104: it is shown, and never taken for J. At the
raw rate (difference of neighbouring samples, torque of the later one) noise and rounding of the speed divide the slope
by 1 + var(noise of α)/var(α): it depends on the sampling rate, and collapses.
"""

import numpy as np

from tdhil.identify.identification import LineFit, PaperEstimate
from tdhil.identify.samples import Samples
from tdhil.record.recording import FloatArray

STEP_S = 0.1
_SHORTEST = 0.7     # of a step: a gap before the last sample may cut it
_LONGEST = 1.5


def paper_estimate(parts: tuple[Samples, ...]) -> PaperEstimate | None:
    """Both fits over all parts together; None if the speed never changes or there are too few steps."""
    stepped = [_steps(part) for part in parts]
    raw = [_raw(part) for part in parts]
    first = line_fit(*_joined(stepped))
    second = line_fit(*_joined(raw))
    return None if first is None or second is None else PaperEstimate(stepped=first, raw_rate=second)


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


def _steps(part: Samples) -> tuple[FloatArray, FloatArray]:
    """Adjoining steps of 0.1 s: from the sample nearest to each tenth to the next; trapezoidal mean of the torque."""
    time = part.time_s
    if len(time) < 3:
        return np.zeros(0), np.zeros(0)
    marks = np.arange(time[0], time[-1] + 0.5 * STEP_S, STEP_S)
    right = np.clip(np.searchsorted(time, marks), 1, len(time) - 1)
    nearest = np.where(marks - time[right - 1] <= time[right] - marks, right - 1, right)
    nearest = np.unique(nearest)
    impulse = np.concatenate(([0.0], np.cumsum(0.5 * (part.torque_nm[1:] + part.torque_nm[:-1]) * np.diff(time))))
    length = np.diff(time[nearest])
    good = (length >= _SHORTEST * STEP_S) & (length <= _LONGEST * STEP_S)
    alpha = np.diff(part.speed_rad_s[nearest])[good] / length[good]
    return alpha, np.diff(impulse[nearest])[good] / length[good]


def _raw(part: Samples) -> tuple[FloatArray, FloatArray]:
    """Backward difference of the speed, with the torque at the interval's end."""
    if len(part) < 2:
        return np.zeros(0), np.zeros(0)
    return np.diff(part.speed_rad_s) / np.diff(part.time_s), part.torque_nm[1:]


def _joined(pairs: list[tuple[FloatArray, FloatArray]]) -> tuple[FloatArray, FloatArray]:
    if not pairs:
        return np.zeros(0), np.zeros(0)
    return np.concatenate([pair[0] for pair in pairs]), np.concatenate([pair[1] for pair in pairs])
