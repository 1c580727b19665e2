"""Response of the shaft to its setpoint under the drive's speed control: two poles, a zero, and the drive's own ramp.

A speed loop with integral action has about H(s) = (1 + b s)/(1 + a₁ s + a₂ s²) from setpoint to speed: flat at low
frequency, often a little above one near its bandwidth, falling beyond it. The report adds its lag. H is fitted to the
ramp between the two mean speeds of stage 2, at the cycle rate of the run. It is used to plan, and to bound the effect
of slow sampling of a stepped setpoint on J (`tdhil.estimation.setpoint_sampling`). J itself is not computed from H.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tdhil.recording import FloatArray

_GRID_S = 0.02            # s; step of the simulated loop
_STARTS = ((1.0, 1.0, 0.3), (0.2, 0.6, 0.1), (0.1, 0.15, 0.01))    # starting values of b, a1, a2 for the fit
_LEAST_S, _MOST_S = 1e-3, 5.0   # s; bounds of the loop's time constants in the fit
_GOOD = 0.05              # largest rms residual of a usable fit, share of the change
_HELD_BACK = 1.12         # ratio of reported to commanded time from 20 to 80 %, above which the drive has its own ramp


@dataclass(frozen=True)
class SpeedFollowing:
    """Response of the shaft's speed to its setpoint; the report adds ``speed_lag_s``."""

    zero_s: float
    first_s: float
    second_s2: float
    speed_lag_s: float = 0.0

    def reported(self, hertz: FloatArray) -> NDArray[np.complex128]:
        """Return the complex gain to the reported speed, (K,)."""
        s = 2j * np.pi * np.asarray(hertz, dtype=np.float64)
        gain: NDArray[np.complex128] = self.shaft(hertz) / (1.0 + self.speed_lag_s * s)
        return gain

    def shaft(self, hertz: FloatArray) -> NDArray[np.complex128]:
        """Return the complex gain to the shaft's speed, (K,)."""
        s = 2j * np.pi * np.asarray(hertz, dtype=np.float64)
        gain: NDArray[np.complex128] = (1.0 + self.zero_s * s) / (1.0 + self.first_s * s + self.second_s2 * s * s)
        return gain


def fit_following(
    time_s: FloatArray,
    setpoint_rad_s: FloatArray,
    reported_rad_s: FloatArray,
    speed_lag_s: float = 0.0,
    ramp_rad_s2: float = math.inf,
) -> SpeedFollowing | None:
    """Fit one change of setpoint with steady ends, (N,) each. Return None if the model does not fit.

    ``ramp_rad_s2``: acceleration limit of the drive's own ramp, which acts on the setpoint first.
    """
    from scipy.optimize import least_squares

    begin, change = float(setpoint_rad_s[0]), float(setpoint_rad_s[-1] - setpoint_rad_s[0])
    if len(time_s) < 16 or change == 0.0:
        return None
    grid = np.arange(float(time_s[0]), float(time_s[-1]) + _GRID_S, _GRID_S)
    # A setpoint holds until the next one.
    at = np.clip(np.searchsorted(time_s, grid, side="right") - 1, 0, len(time_s) - 1)
    wanted, rate = (setpoint_rad_s[at] - begin) / change, ramp_rad_s2 / abs(change)
    if not math.isinf(rate):           # 1/s
        ramped, now = np.empty_like(wanted), float(wanted[0])
        for index, target in enumerate(wanted.tolist()):
            now += max(-rate * _GRID_S, min(rate * _GRID_S, target - now))
            ramped[index] = now
        wanted = ramped
    seen = (reported_rad_s - begin) / change

    def left(logs: FloatArray) -> FloatArray:
        zero, first, second = (float(x) for x in np.exp(logs))
        error: FloatArray = np.interp(time_s, grid, _response(wanted, zero, first, second, speed_lag_s)) - seen
        return error

    bounds = (np.log([_LEAST_S, _LEAST_S, _LEAST_S**2]), np.log([_MOST_S, _MOST_S, _MOST_S**2]))
    fits = [least_squares(left, np.log(start), bounds=bounds, max_nfev=60) for start in _STARTS]
    best = min(fits, key=lambda fit: float(fit.cost))
    if math.sqrt(2.0 * float(best.cost) / len(time_s)) > _GOOD:
        return None
    zero, first, second = (float(x) for x in np.exp(best.x))
    return SpeedFollowing(zero, first, second, speed_lag_s)


def held_back_to(
    time_s: FloatArray, setpoint_rad_s: FloatArray, reported_rad_s: FloatArray
) -> float | None:
    """Return the acceleration limit of the drive's own ramp, rad/s²; None if it kept up with the setpoint."""
    begin, change = float(setpoint_rad_s[0]), float(setpoint_rad_s[-1] - setpoint_rad_s[0])
    if change == 0.0:
        return None

    def between(signal: FloatArray) -> float:
        share = (signal - begin) / change
        passed = [float(time_s[np.flatnonzero(share >= level)[0]]) if np.any(share >= level) else math.inf
                  for level in (0.2, 0.8)]
        return passed[1] - passed[0]

    asked, took = between(setpoint_rad_s), between(reported_rad_s)
    if not (math.isfinite(took) and took > _HELD_BACK * asked > 0.0):
        return None
    return 0.6 * abs(change) / took


def _response(wanted: FloatArray, zero: float, first: float, second: float, lag: float) -> FloatArray:
    """Return the response of H and the lag on the grid, by the bilinear transform.

    Two filters in transposed direct form II, as in scipy.signal, which would take a second to load.
    """
    k = 2.0 / _GRID_S
    scale = 1.0 + first * k + second * k * k
    b0, b1, b2 = (1.0 + zero * k) / scale, 2.0 / scale, (1.0 - zero * k) / scale
    a1, a2 = (2.0 - 2.0 * second * k * k) / scale, (1.0 - first * k + second * k * k) / scale
    report = 1.0 + lag * k
    gain, back = 1.0 / report, (1.0 - lag * k) / report
    nearer = further = kept = 0.0
    late = []
    for x in wanted.tolist():
        y = nearer + b0 * x
        nearer = further + b1 * x - a1 * y
        further = b2 * x - a2 * y
        z = kept + gain * y
        kept = gain * y - back * z
        late.append(z)
    return np.array(late)
