"""Gains of the drive's speed loop, from the ramp of the setpoint between the levels of stage 2.

The setpoint r is known except for its end: it stays at the lower level, rises by the same step in every cycle, and
stays at the upper level. A PI loop gives the torque

    T = T_0 + K_p (r − ω) + K_i ∫(r − ω) dt,

which is linear in T_0, K_p and K_i for a given number of steps. The number of steps with the least residual is used. If
the speed report has a lag τ, r and T are filtered with the same lag, which keeps the equation valid. A drive with
another law (a filter of the setpoint, a ramp generator) has residuals larger than the scatter of the levels, and gives
no gains.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tdhil.estimation.samples import Samples, usual_interval
from tdhil.recording import FloatArray, Level, Recording

_SAME_TIME_S = 1e-6       # s; closer times count as equal, because the log rounds them
_FEWEST = 20              # fewest samples of either level, and of the ramp between
_LAW_HOLDS = 2.0          # residual over the scatter of the levels: with a larger one the loop is not a PI loop
_VALLEY_S = 0.05          # s; a ramp that is longer or shorter by 0.07 s has ten times the scatter
_SEEN_SHARE = 0.1
"""Least relative standard deviation of a gain. On the simulated drives the gains are 4 % low on average, with a
scatter of 5 % (rounding of speed to 1 rpm, speed filters of 20 ms)."""
_CLEAR_SHARE = 0.3        # relative standard deviation beyond which a gain is not determined


@dataclass(frozen=True)
class SpeedLoop:
    """Gains of a speed loop: K_p, N·m·s/rad, and its standard deviation; K_i, N·m/rad."""

    gain_nm_s_rad: float
    gain_sd_nm_s_rad: float
    integral_gain_nm_rad: float


def speed_loop(recording: Recording, samples: Samples, speed_lag_s: float) -> SpeedLoop | None:
    """Return the loop that followed the ramp of stage 2; None without such a ramp, or if a PI loop does not fit."""
    ends = _ends(recording)
    if ends is None:
        return None
    low, high = ends
    part = samples.between(low.start_s, high.end_s)
    before = int(np.count_nonzero(part.time_s <= low.end_s + _SAME_TIME_S))
    after = int(np.count_nonzero(part.time_s < high.start_s - _SAME_TIME_S))
    if min(before, after - before, len(part) - after) < _FEWEST:
        return None
    interval_s = usual_interval(part.time_s)
    start, end = (float(np.mean(x)) for x in (part.speed_rad_s[:before], part.speed_rad_s[after:]))
    torque = lagged(part.torque_nm, interval_s, speed_lag_s)
    widths = np.diff(part.time_s)
    number = np.arange(len(part)) - before + 1
    rising = lagged(np.maximum(number, 0.0), interval_s, speed_lag_s)

    def fitted(steps: int) -> tuple[float, FloatArray, FloatArray]:
        """Return residual, (T_0, gains) and design for a setpoint that rises in ``steps`` steps: one rise less a
        later one.
        """
        later = np.append(np.zeros(steps), rising[:-steps])
        error = start + (end - start) * (rising - later) / steps - part.speed_rad_s
        integral = np.append(0.0, np.cumsum(0.5 * (error[1:] + error[:-1]) * widths))
        design = np.column_stack([np.ones(len(part)), error, integral])
        gains = np.linalg.lstsq(design, torque, rcond=None)[0]
        return float(np.sum((torque - design @ gains) ** 2)), gains, design

    stride = max(1, round(_VALLEY_S / interval_s))
    rest, gains, design = fitted(_least(lambda steps: fitted(steps)[0], 3, after - before, stride))
    variance = rest / (len(part) - design.shape[1])
    gain, integral_gain = float(gains[1]), float(gains[2])
    still_torque, still_speed = (
        0.5 * float(np.var(x[:before]) + np.var(x[after:])) for x in (torque, part.speed_rad_s)
    )
    still = still_torque + gain**2 * max(still_speed, recording.speed_resolution_rad_s**2 / 12.0)
    if not (gain > 0.0 and integral_gain > 0.0 and variance <= _LAW_HOLDS**2 * still):
        return None
    sd = math.hypot(math.sqrt(variance * float(np.linalg.inv(design.T @ design)[1, 1])), _SEEN_SHARE * gain)
    return SpeedLoop(gain, sd, integral_gain) if sd <= _CLEAR_SHARE * gain else None


def _least(of: Callable[[int], float], first: int, last: int, stride: int) -> int:
    """Return the minimum of ``of``: on a grid of this stride, then between its neighbours there."""
    best = min(range(first, last + 1, stride), key=of)
    return min(range(max(first, best - stride), min(last, best + stride) + 1), key=of) if stride > 1 else best


def _ends(recording: Recording) -> tuple[Level, Level] | None:
    """Return the levels at both ends of the first ramp."""
    if not recording.ramps or not recording.stages:
        return None
    ramp = recording.ramps[0]
    low = next((one for one in recording.levels if abs(one.end_s - ramp.start_s) < _SAME_TIME_S), None)
    high = next((one for one in recording.levels if abs(one.start_s - ramp.end_s) < _SAME_TIME_S), None)
    return (low, high) if low is not None and high is not None else None


def lagged(signal: FloatArray, interval_s: float, lag_s: float) -> FloatArray:
    """Return the signal behind a first-order lag, from sample to sample; its delay is that of the lag."""
    if not lag_s > 0.0:
        return signal
    keep = math.exp(-interval_s / lag_s)
    found = signal.copy()
    for i in range(1, len(signal)):
        found[i] = keep * found[i - 1] + (1.0 - keep) * 0.5 * (signal[i] + signal[i - 1])
    return found
