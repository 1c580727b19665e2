"""Hopeless data, recognised before anything is fitted to them: each with what is wrong and what would mend it.

In the order of the questions: are these samples; can the excitation have been so, and was it sampled fast enough
(`declared`); did anything move; did a limit shape it (`clipped`)? What the lines help to tell (a wrong period, a wrong
sign, a shaft that stood still) is asked later, in `line_faults`.
"""

import math

import numpy as np

from tdhil.estimation.result import Refused
from tdhil.estimation.samples import Samples, excited_window
from tdhil.identify.faults.clipped import LIMIT_SHARE, check_limited
from tdhil.identify.faults.declared import check_declared
from tdhil.recording.recording import Excitation, FloatArray, Recording

_LEAST_SAMPLES = 64
_STALE_SHARE = 0.5
_LONGEST_S = 7.0 * 86400.0
_HUGE = 1e15            # rad/s or N·m: no machine; squares of it, and of its ratios, are still numbers
_MOTIONLESS = 2.0       # steps of a signal within which it hasn't changed
_TINY = 1e-12           # of a signal's size, or of its unit: below it is the arithmetic's own


def check_samples(recording: Recording) -> None:
    """Raise Refused unless the samples can be used at all: shapes, time stamps, numbers and freshness."""
    count = int(np.size(recording.time_s))
    others = (recording.speed_rad_s, recording.torque_nm, recording.fresh, recording.limited)
    if any(np.shape(other) != (count,) for other in others) or np.ndim(recording.time_s) != 1:
        raise Refused("the signals differ in length", "record time, speed and torque of the same samples")
    if count < _LEAST_SAMPLES:
        raise Refused(f"{count} samples are too few to identify anything", "record whole periods of the excitation")
    signals = (recording.time_s, recording.speed_rad_s, recording.torque_nm)
    flags = (recording.fresh, recording.limited)
    if any(signal.dtype.kind not in "fiu" for signal in signals) or any(flag.dtype.kind != "b" for flag in flags):
        raise Refused("the signals are not numbers", "look for a decoding fault")
    time = recording.time_s
    if not np.all(np.isfinite(time)) or np.any(time[1:] <= time[:-1]):
        raise Refused("the time stamps do not rise throughout", "repair the clock or the order of the samples")
    if float(time[-1]) - float(time[0]) > _LONGEST_S:
        raise Refused(
            f"the time spans {float(time[-1]) - float(time[0]):.3g} s, more than a week",
            "check the unit of the time stamps",
        )
    if not np.isfinite(recording.torque_offset_nm):
        raise Refused("the torque offset is not a number", "measure the torque at standstill again")
    fresh = recording.fresh
    finite = np.isfinite(recording.speed_rad_s)
    finite &= np.isfinite(recording.torque_nm)
    fresh_count = int(np.count_nonzero(fresh))
    bad = 1.0 - np.count_nonzero(finite & fresh) / fresh_count if fresh_count else 0.0
    if bad > LIMIT_SHARE:
        raise Refused(f"{bad:.0%} of the samples are not numbers", "look for a decoding or wiring fault")
    stale = 1.0 - fresh_count / count
    if stale > 1.0 - _STALE_SHARE:
        raise Refused(f"{stale:.0%} of the samples brought nothing new", "lower the cycle rate or repair the bus")
    for name, signal in (("speed", recording.speed_rad_s), ("torque", recording.torque_nm)):
        largest = max(abs(float(np.max(signal, where=finite, initial=0.0))),
                      abs(float(np.min(signal, where=finite, initial=0.0))))
        if largest > _HUGE:
            raise Refused(f"the {name} reaches {largest:.2g}, which no machine does", "look for a decoding fault")
    _check_known(recording)


def _check_known(recording: Recording) -> None:
    """Raise Refused for what the recording says besides its samples."""
    prior = recording.lag_prior
    lags = [lag for lag in (prior.speed_lag_s, prior.torque_lag_s) if lag is not None]
    sizes = (prior.speed_lag_sd_s, prior.torque_lag_sd_s, prior.skew_sd_s, recording.speed_resolution_rad_s,
             recording.torque_resolution_nm, recording.torque_scale_rel_sd, *lags)
    limit = recording.torque_limit_nm
    if not all(math.isfinite(size) and size >= 0.0 for size in sizes) or (limit is not None and math.isnan(limit)):
        raise Refused(
            "a resolution, lag, limit or standard deviation that goes with the recording is no usable number",
            "check how the recording was made",
        )


def check_motion(recording: Recording, excitation: Excitation, samples: Samples) -> None:
    """Raise Refused for no motion, or motion that a limit shaped."""
    check_declared(excitation, samples)
    windows = [excited_window(segment) for segment in excitation.segments]
    parts = [(segment, part) for segment, window in zip(excitation.segments, windows, strict=True)
             if len(part := samples.between(*window))]
    if not _moved([part.speed_rad_s for _, part in parts], recording.speed_resolution_rad_s):
        raise Refused("the speed did not change", "excite with more amplitude, and check that the shaft can turn")
    if not _moved([part.torque_nm for _, part in parts], recording.torque_resolution_nm):
        raise Refused("the torque did not change", "excite with more amplitude, and check the torque signal")
    check_limited(recording, windows, parts, excitation.kind)


def _moved(parts: list[FloatArray], quantum: float) -> bool:
    """Did the signal leave the noise of its rounding, and of the arithmetic, within any one segment?"""
    for part in parts:
        high, low = float(np.max(part)), float(np.min(part))
        if high - low > max(_MOTIONLESS * quantum, _TINY * max(abs(high), abs(low), 1.0)):
            return True
    return False
