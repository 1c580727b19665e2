"""Checks that refuse unusable data before any fit. Each refusal states the fault and the remedy.

The order: usable samples (`check_samples`) and other data (`check_known`); a possible excitation that was sampled fast
enough (`check_declared`); motion; no limit that shaped the motion (`check_limited`). Checks that need the spectral
lines (wrong period, wrong sign, standstill) follow in `excitation_checks`.
"""

import math
from itertools import pairwise

import numpy as np

from profiles import MessageCode
from tdhil.config import has_plateaus
from tdhil.estimation.result import Refused
from tdhil.estimation.samples import Samples, excited_window, usual_interval
from tdhil.recording import Excitation, FloatArray, Recording, Segment

# ---------------------------------------------------------------------------------------------------------------------
# Motion shaped by a limit: the drive's flag, torque at its limit, and flat tops without a declared limit.
#
# A flat top is many samples at exactly the greatest (or least) value of a segment, and few just below it. The crest of
# a smooth wave, rounded to q, looks similar. For a sine of amplitude A, the share √(2q/A)/π is at the crest, and 0.41
# of that one step below. For a crest as flat as x⁴, which a low-crest multisine may have, the ratio is 0.19. It is 0.1
# if the crest has a dip of one step. Noise of the size of q makes the share at the extreme smaller than the share one
# step below. Therefore two thresholds apply. If samples near the top scatter by noise, or leave the top steeply, three
# times the share of the step below is suspect. Otherwise twenty times is suspect. A clipped top below these thresholds
# loses less than about one step, or is within the noise, so its effect is negligible. The effect of a top that lasts
# one or two samples each time is negligible too: with few samples in a period, at the same instants in each period, the
# crest occurs at one value once a period.


LIMIT_SHARE = 0.005       # largest share of excited samples at a limit; that share biases the line fit by about as much
AT_LIMIT = 0.98           # share of the torque limit that counts as at the limit
_LEAST_FLAT = 5           # fewest samples of a flat top
_NOISY_RATIO, _SMOOTH_RATIO = 3.0, 20.0    # share at the extreme over that one step below: above it a top is suspect
_NOISY = 0.8              # steps; samples within _NEAR of the top are noisy if their mean second difference is larger
_NEAR = 4.5               # steps from the top; on a slow crest the second difference is one step or none
_PILE = 0.01              # share at the extreme below which nothing is checked
_LASTS = 3.0              # least mean number of samples of one stay at the extreme
_APART = 5                # samples; stays at the extreme with a larger distance are separate ones
_STEP = 1.5               # steps below the extreme that count as one step below
_LOOKED_AT = 50_000       # samples checked, at most
_ADVICE = "use less amplitude, or more torque if the machine allows it"


def check_limited(
    recording: Recording, windows: list[tuple[float, float]], parts: list[tuple[Segment, Samples]], kind: str
) -> None:
    """Raise Refused by the drive's flag and limit over all the excitation, then by each segment's shape."""
    flags = [recording.limited[slice(*np.searchsorted(recording.time_s, window))] for window in windows]
    count = sum(len(flag) for flag in flags)
    flagged = sum(int(np.count_nonzero(flag)) for flag in flags) / count if count else 0.0
    if flagged > LIMIT_SHARE:
        raise Refused(f"the drive was at an internal limit for {100 * flagged:.1f} % of the excitation", _ADVICE,
                      entry=MessageCode.SIGNAL_CLIPPED)
    limit = recording.torque_limit_nm
    if limit is not None and limit > 0.0:
        above, below = AT_LIMIT * limit - recording.torque_offset_nm, -AT_LIMIT * limit - recording.torque_offset_nm
        hits = sum(
            int(np.count_nonzero(part.torque_nm >= above) + np.count_nonzero(part.torque_nm <= below))
            for _, part in parts
        )
        saturated = hits / sum(len(part) for _, part in parts)
        if saturated > LIMIT_SHARE:
            reason = f"the torque was at its limit of {limit:g} N·m for {100 * saturated:.1f} % of the excitation"
            raise Refused(reason, _ADVICE)
    if has_plateaus(kind):
        return
    for segment, part in parts:
        for name, signal, quantum in (
            ("torque", part.torque_nm, recording.torque_resolution_nm),
            ("speed", part.speed_rad_s, recording.speed_resolution_rad_s),
        ):
            share = flat_share(signal, quantum)
            if share is not None:
                where = f"about {segment.offset_rad_s:.3g} rad/s"
                raise Refused(
                    f"the {name} is cut off flat for {100 * share:.1f} % of the excitation {where}",
                    f"{_ADVICE}; or widen the range in which the {name} is reported",
                    entry=MessageCode.SIGNAL_CLIPPED,
                )


def flat_share(signal: FloatArray, quantum: float) -> float | None:
    """Return the share of the samples (N,) exactly at the greatest or least value; None if a rounded wave explains
    it.
    """
    if len(signal) < 8 * _LEAST_FLAT:
        return None
    found = [share for top in (float(np.max(signal)), float(np.min(signal)))
             if (share := _pile(signal, top, quantum)) is not None]
    return max(found, default=None)


def _pile(signal: FloatArray, top: float, quantum: float) -> float | None:
    there = np.flatnonzero(signal == top)
    at = len(there)
    share = at / len(signal)
    if at < _LEAST_FLAT or share < _PILE or at < _LASTS * (1 + np.count_nonzero(np.diff(there) > _APART)):
        return None
    reach = float(np.ptp(signal))
    distance = np.abs(signal - top)
    rest = distance[distance > 1e-9 * reach]
    # resolution: declared, or the distance to the next value that occurs (nearly 0 for values that are not rounded)
    step = max(quantum, float(np.min(rest)) if len(rest) else 0.0)
    below = int(np.count_nonzero(rest <= _STEP * step))
    near = np.flatnonzero((distance[1:-1] > 1e-9 * reach) & (distance[1:-1] <= _NEAR * step))[:_LOOKED_AT] + 1
    wobble = np.abs(signal[near - 1] - 2.0 * signal[near] + signal[near + 1])
    noisy = len(near) == 0 or float(np.mean(wobble)) >= _NOISY * step
    return share if at > (_NOISY_RATIO if noisy else _SMOOTH_RATIO) * max(below, 1) else None


# ---------------------------------------------------------------------------------------------------------------------
# Check of the declared excitation against the samples: is it possible, and was it sampled fast enough?
#
# The lines of a period are fitted together. They must therefore be different whole multiples of 1/period, and a period
# must have more samples than unknowns. A line at or above half the sample rate appears at another frequency (aliasing),
# where it cannot be separated from a real line.


_WHOLE = 2e-3             # cycles a period by which a line may differ from a whole number
_NYQUIST = 0.9            # line frequency over half the sample rate, at most: nearer to 1 a line is too near its image
SAMPLED_SHARE = 0.5 * _NYQUIST    # line frequency / sample rate, from which a line is refused
_SECONDS_NOT = 100.0      # sample interval over the need of the lines: beyond it a wrong unit of time is more likely


def aliased(highest_hz: float, interval_s: float) -> bool:
    """Return whether samples ``interval_s`` apart cannot separate a spectral line from its image."""
    return highest_hz * interval_s >= SAMPLED_SHARE


def least_samples(lines: int) -> int:
    """Return the fewest samples a period for these spectral lines: twice the unknowns (two a line, and a mean)."""
    return 2 * (2 * lines + 1)


def too_few_a_period(lines: int, period_s: float, interval_s: float) -> bool:
    """Return whether a period has too few samples for its spectral lines."""
    return period_s / interval_s < least_samples(lines)


def check_declared(excitation: Excitation, samples: Samples) -> None:
    """Raise Refused for impossible segments, segments outside the record, or lines that the sampling cannot
    separate.
    """
    for number, segment in enumerate(excitation.segments, start=1):
        _check_segment(segment, f"segment {number}")
    ordered = sorted(excitation.segments, key=lambda segment: segment.start_s)
    for before, after in pairwise(ordered):
        if after.start_s < before.end_s - 0.01 * before.period_s:
            raise Refused(
                f"two segments overlap: one lasts until {before.end_s:g} s, the next starts at {after.start_s:g} s",
                "correct the times of the segments", entry=MessageCode.EXCITATION_MISDECLARED,
            )
    inside = [samples.between(*excited_window(segment)) for segment in excitation.segments]
    if not any(len(part) for part in inside):
        raise Refused(
            f"no sample lies within the excitation after settling: the record lasts from {samples.time_s[0]:g} to "
            f"{samples.time_s[-1]:g} s",
            "let the excitation run longer, or correct the times of its segments and the unit of time",
            entry=MessageCode.EXCITATION_MISDECLARED,
        )
    for segment, part in zip(excitation.segments, inside, strict=True):
        interval = usual_interval(part.time_s)
        fastest = max(segment.lines_hz)
        if len(part) < 2 or not np.isfinite(interval):
            continue
        if aliased(fastest, interval):
            slow = fastest * interval > _SECONDS_NOT
            raise Refused(
                f"aliased: at one sample every {interval:.3g} s, a line at {fastest:g} Hz looks like a slower one",
                "check the unit of the time stamps" if slow else
                f"sample at {math.ceil(fastest / SAMPLED_SHARE):d} Hz or faster, or excite with lower lines",
                entry=MessageCode.TOO_FEW_SAMPLES,
            )
        if too_few_a_period(len(segment.lines_hz), segment.period_s, interval):
            raise Refused(
                f"{segment.period_s / interval:.0f} samples a period are too few for {len(segment.lines_hz)} lines",
                "sample faster, or excite with fewer lines", entry=MessageCode.TOO_FEW_SAMPLES,
            )


def _check_segment(segment: Segment, name: str) -> None:
    numbers = (segment.start_s, segment.end_s, segment.period_s, segment.offset_rad_s, *segment.lines_hz)
    advice = "check how the recording was made"
    if not all(math.isfinite(number) for number in numbers) or segment.settle_periods < 0:
        raise Refused(f"{name}: its times or lines are not usable numbers", advice,
                      entry=MessageCode.EXCITATION_MISDECLARED)
    if not segment.lines_hz or segment.period_s <= 0.0 or segment.end_s <= segment.start_s:
        raise Refused(f"{name}: it has no lines, no period or no length", advice,
                      entry=MessageCode.EXCITATION_MISDECLARED)
    cycles = [line * segment.period_s for line in segment.lines_hz]
    whole = [round(one) for one in cycles]
    off = max(abs(one - near) / max(1.0, near) for one, near in zip(cycles, whole, strict=True))
    if min(whole) < 1 or off > _WHOLE:
        raise Refused(
            f"{name}: its lines are not whole multiples of 1/period (period {segment.period_s:g} s)",
            "declare the period and the lines that were run, in s and Hz",
            entry=MessageCode.EXCITATION_MISDECLARED,
        )
    if len(set(whole)) < len(whole):
        raise Refused(f"{name}: it declares the same line twice", "declare each line once",
                      entry=MessageCode.EXCITATION_MISDECLARED)


# ---------------------------------------------------------------------------------------------------------------------

_LEAST_SAMPLES = 64       # fewest samples of a record
_STALE_SHARE = 0.5        # least share of fresh samples
_LONGEST_S = 7.0 * 86400.0   # s; a week, the limit of a record
_HUGE = 1e15            # rad/s or N·m: no machine reaches it; squares of it, and of its ratios, can still be computed
_MOTIONLESS = 2.0       # resolution steps within which a signal has not changed
_TINY = 1e-12           # share of a signal's size, or of its unit, below which a change is rounding of the arithmetic


def check_samples(recording: Recording) -> None:
    """Raise Refused unless the samples can be used at all: shapes, time stamps, numbers and freshness."""
    count = int(np.size(recording.time_s))
    others = (recording.speed_rad_s, recording.torque_nm, recording.fresh, recording.limited)
    if any(np.shape(other) != (count,) for other in others) or np.ndim(recording.time_s) != 1:
        raise Refused("the signals differ in length", "record time, speed and torque of the same samples",
                      entry=MessageCode.DATA_UNUSABLE)
    if count < _LEAST_SAMPLES:
        raise Refused(f"{count} samples are too few to identify anything", "record whole periods of the excitation",
                      entry=MessageCode.TOO_FEW_SAMPLES)
    signals = (recording.time_s, recording.speed_rad_s, recording.torque_nm)
    flags = (recording.fresh, recording.limited)
    if any(signal.dtype.kind not in "fiu" for signal in signals) or any(flag.dtype.kind != "b" for flag in flags):
        raise Refused("the signals are not numbers", "look for a decoding fault", entry=MessageCode.DATA_UNUSABLE)
    time = recording.time_s
    if not np.all(np.isfinite(time)) or np.any(time[1:] <= time[:-1]):
        raise Refused("the time stamps do not rise throughout", "repair the clock or the order of the samples",
                      entry=MessageCode.DATA_UNUSABLE)
    if float(time[-1]) - float(time[0]) > _LONGEST_S:
        raise Refused(
            f"the time spans {float(time[-1]) - float(time[0]):.3g} s, more than a week",
            "check the unit of the time stamps", entry=MessageCode.DATA_UNUSABLE,
        )
    if not np.isfinite(recording.torque_offset_nm):
        raise Refused("the torque offset is not a number", "measure the torque at standstill again",
                      entry=MessageCode.DATA_UNUSABLE)
    fresh = recording.fresh
    finite = np.isfinite(recording.speed_rad_s)
    finite &= np.isfinite(recording.torque_nm)
    fresh_count = int(np.count_nonzero(fresh))
    bad = 1.0 - np.count_nonzero(finite & fresh) / fresh_count if fresh_count else 0.0
    if bad > LIMIT_SHARE:
        raise Refused(f"{100 * bad:.0f} % of the samples are not numbers", "look for a decoding or wiring fault",
                      entry=MessageCode.DATA_UNUSABLE)
    stale = 1.0 - fresh_count / count
    if stale > 1.0 - _STALE_SHARE:
        raise Refused(f"{100 * stale:.0f} % of the samples brought nothing new",
                      "lower the cycle rate or repair the bus", entry=MessageCode.DATA_UNUSABLE)
    for name, signal in (("speed", recording.speed_rad_s), ("torque", recording.torque_nm)):
        largest = max(abs(float(np.max(signal, where=finite, initial=0.0))),
                      abs(float(np.min(signal, where=finite, initial=0.0))))
        if largest > _HUGE:
            raise Refused(f"the {name} reaches {largest:.2g}, which no machine does", "look for a decoding fault",
                          entry=MessageCode.DATA_UNUSABLE)


def check_known(recording: Recording) -> None:
    """Raise Refused for invalid data of the recording other than its samples."""
    prior = recording.lag_prior
    lags = [lag for lag in (prior.speed_lag_s, prior.torque_lag_s) if lag is not None]
    sizes = (prior.speed_lag_sd_s, prior.torque_lag_sd_s, prior.skew_sd_s, recording.speed_resolution_rad_s,
             recording.torque_resolution_nm, recording.torque_scale_rel_sd, *lags)
    limit = recording.torque_limit_nm
    if not all(math.isfinite(size) and size >= 0.0 for size in sizes) or (limit is not None and math.isnan(limit)):
        raise Refused(
            "a resolution, lag, limit or standard deviation of the recording is not a usable number",
            "check how the recording was made", entry=MessageCode.DATA_UNUSABLE,
        )


def check_motion(recording: Recording, excitation: Excitation, samples: Samples) -> None:
    """Raise Refused for no motion, or for motion that a limit shaped."""
    check_declared(excitation, samples)
    windows = [excited_window(segment) for segment in excitation.segments]
    parts = [(segment, part) for segment, window in zip(excitation.segments, windows, strict=True)
             if len(part := samples.between(*window))]
    if not _moved([part.speed_rad_s for _, part in parts], recording.speed_resolution_rad_s):
        raise Refused("the speed did not change", "excite with more amplitude, and check that the shaft can turn",
                      entry=MessageCode.NO_EXCITATION)
    if not _moved([part.torque_nm for _, part in parts], recording.torque_resolution_nm):
        raise Refused("the torque did not change", "excite with more amplitude, and check the torque signal",
                      entry=MessageCode.NO_EXCITATION)
    check_limited(recording, windows, parts, excitation.kind)


def _moved(parts: list[FloatArray], quantum: float) -> bool:
    """Return whether a signal changed, within any one segment, by more than its rounding and that of the arithmetic."""
    for part in parts:
        high, low = float(np.max(part)), float(np.min(part))
        if high - low > max(_MOTIONLESS * quantum, _TINY * max(abs(high), abs(low), 1.0)):
            return True
    return False
