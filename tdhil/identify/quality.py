"""Hopeless data, recognised before anything is fitted to them: each with what is wrong and what would mend it."""

import math
from dataclasses import dataclass

import numpy as np

from tdhil.identify.samples import Samples, excited_window
from tdhil.record.recording import BoolArray, FloatArray, Recording

_LEAST_SAMPLES = 64
_LIMIT_SHARE = 0.005      # of the excited samples that may be at a limit: they bend the line fit by about as much
_AT_LIMIT = 0.98          # of the torque limit counts as at it
_FLAT_SHARE = 0.10        # of the samples exactly at the extreme: clamped, unless rounding explains it
_FLAT_FACTOR = 3.0
_STALE_SHARE = 0.5


@dataclass(frozen=True)
class Refusal:
    """Why there can be no number, and what to do about it; a sentence each."""

    reason: str
    advice: str


def refuse_samples(recording: Recording) -> Refusal | None:
    """Shapes, time stamps, numbers and freshness: what must hold before samples can be used at all."""
    count = len(recording.time_s)
    others = (recording.speed_rad_s, recording.torque_nm, recording.fresh, recording.limited)
    if any(np.shape(other) != (count,) for other in others) or np.ndim(recording.time_s) != 1:
        return Refusal("the signals differ in length", "record time, speed and torque of the same samples")
    if count < _LEAST_SAMPLES:
        return Refusal(f"{count} samples are too few to identify anything", "record whole periods of the excitation")
    time = recording.time_s
    if not np.all(np.isfinite(time)) or np.any(np.diff(time) <= 0.0):
        return Refusal("the time stamps do not rise throughout", "repair the clock or the order of the samples")
    if not np.isfinite(recording.torque_offset_nm):
        return Refusal("the torque offset is not a number", "measure the torque at standstill again")
    fresh = recording.fresh
    finite = np.isfinite(recording.speed_rad_s) & np.isfinite(recording.torque_nm)
    bad = float(np.mean(~finite[fresh])) if np.any(fresh) else 0.0
    if bad > _LIMIT_SHARE:
        return Refusal(f"{bad:.0%} of the samples are not numbers", "look for a decoding or wiring fault")
    if np.mean(fresh) < _STALE_SHARE:
        return Refusal(
            f"{float(np.mean(~fresh)):.0%} of the samples brought nothing new", "lower the cycle rate or repair the bus"
        )
    return None


def refuse_motion(recording: Recording, samples: Samples) -> Refusal | None:
    """No excitation, no motion, or motion that a limit shaped."""
    excitation = recording.excitation
    if excitation is None or not excitation.segments:
        return Refusal(
            "there was no periodic excitation, so acceleration, friction and lags can't be told apart",
            "run a multisine about two mean speeds",
        )
    inside = np.zeros(len(samples), dtype=np.bool_)
    limited_inside = np.zeros(len(recording.time_s), dtype=np.bool_)
    for segment in excitation.segments:
        if not _sound(segment.start_s, segment.end_s, segment.period_s, *segment.lines_hz):
            return Refusal("a segment's times or lines are not usable numbers", "check how the recording was made")
        start, end = excited_window(segment)
        inside |= (samples.time_s >= start) & (samples.time_s < end)
        limited_inside |= (recording.time_s >= start) & (recording.time_s < end)
    if not np.any(inside):
        return Refusal("the excitation ended before its first period after settling", "let the excitation run longer")
    speed, torque = samples.speed_rad_s[inside], samples.torque_nm[inside]
    if np.ptp(speed) <= 2.0 * recording.speed_resolution_rad_s:
        return Refusal("the speed did not change", "excite with more amplitude, and check that the shaft can turn")
    if np.ptp(torque) <= 2.0 * recording.torque_resolution_nm:
        return Refusal("the torque did not change", "excite with more amplitude, and check the torque signal")
    return _refuse_limited(recording, speed, torque, limited_inside, excitation.kind)


def _refuse_limited(
    recording: Recording, speed: FloatArray, torque: FloatArray, inside: BoolArray, kind: str
) -> Refusal | None:
    advice = "use less amplitude, or more torque if the machine allows it"
    flagged = float(np.mean(recording.limited[inside]))
    if flagged > _LIMIT_SHARE:
        return Refusal(f"the drive was at an internal limit for {flagged:.1%} of the excitation", advice)
    limit = recording.torque_limit_nm
    if limit is not None and limit > 0.0:
        reported = torque + recording.torque_offset_nm
        saturated = float(np.mean(np.abs(reported) >= _AT_LIMIT * limit))
        if saturated > _LIMIT_SHARE:
            reason = f"the torque was at its limit of {limit:g} N·m for {saturated:.1%} of the excitation"
            return Refusal(reason, advice)
    if kind != "step":
        for name, signal, quantum in (
            ("torque", torque, recording.torque_resolution_nm),
            ("speed", speed, recording.speed_resolution_rad_s),
        ):
            share = _flat_share(signal, quantum)
            if share is not None:
                return Refusal(f"the {name} is cut off flat for {share:.1%} of the excitation", advice)
    return None


def _flat_share(signal: FloatArray, quantum: float) -> float | None:
    """Share of samples exactly at the greatest or least value, if rounding of a smooth wave can't explain it.

    A sine of amplitude A rounded to q spends arccos(1 − q/A)/π of its time within q of its crest.
    """
    amplitude = 0.5 * float(np.ptp(signal))
    natural = math.acos(max(-1.0, 1.0 - quantum / amplitude)) / math.pi
    share = max(float(np.mean(signal == signal.max())), float(np.mean(signal == signal.min())))
    return share if share > max(_FLAT_SHARE, _FLAT_FACTOR * natural) else None


def _sound(*values: float) -> bool:
    return all(math.isfinite(value) for value in values) and values[2] > 0.0
