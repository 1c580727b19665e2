"""The samples of a recording that identification may use, and the whole periods they make up."""

import math
from dataclasses import dataclass

import numpy as np

from tdhil.identify.faults.left_out import good_samples
from tdhil.recording.recording import FloatArray, Recording, Segment

_LEAST_SHARE = 0.6        # of a period's samples that must be there
_LONGEST_GAP = 0.1        # of the shortest cycle of the excitation


@dataclass(frozen=True)
class Samples:
    """N usable samples: fresh, finite; torque less its offset. (N,) each, time rising."""

    time_s: FloatArray
    speed_rad_s: FloatArray
    torque_nm: FloatArray

    def between(self, start_s: float, end_s: float) -> "Samples":
        """Samples with start ≤ time < end."""
        first, last = np.searchsorted(self.time_s, (start_s, end_s), side="left")
        return Samples(self.time_s[first:last], self.speed_rad_s[first:last], self.torque_nm[first:last])

    def __len__(self) -> int:
        return len(self.time_s)


@dataclass(frozen=True)
class Stretch:
    """The usable whole periods of one segment, one Samples each; ``index`` (P,) counts from the segment's start."""

    segment: Segment
    periods: tuple[Samples, ...]
    index: tuple[int, ...]


def usable_samples(recording: Recording) -> Samples:
    """Drop what is stale, stuck, a spike or not a number, and subtract the torque that was reported at standstill.

    Nothing is copied that need not be: where every sample is good, and no offset is known, these are the recording's
    own arrays.
    """
    good = good_samples(recording)
    every = bool(np.all(good))
    time, speed, torque = (
        np.asarray(signal if every else signal[good], dtype=np.float64)
        for signal in (recording.time_s, recording.speed_rad_s, recording.torque_nm)
    )
    if recording.torque_offset_nm != 0.0:
        torque = torque - recording.torque_offset_nm if every else np.subtract(
            torque, recording.torque_offset_nm, out=torque
        )
    return Samples(time, speed, torque)


def excited_window(segment: Segment) -> tuple[float, float]:
    """From the end of settling to the end of the segment, s."""
    return segment.start_s + segment.settle_periods * segment.period_s, segment.end_s


def stretches(samples: Samples, segments: tuple[Segment, ...]) -> tuple[Stretch, ...]:
    """Cut every segment into whole periods; a period with holes in it is left out."""
    found = []
    interval = usual_interval(samples.time_s)
    for segment in segments:
        if not segment.lines_hz or not (segment.period_s > 0.0 and math.isfinite(segment.period_s)):
            continue
        start, end = excited_window(segment)
        last_time = float(samples.time_s[-1]) if len(samples) else start
        end = min(end, last_time + interval)
        whole = max(0, math.floor((end - start) / segment.period_s + 1e-6))
        longest_gap = max(_LONGEST_GAP / max(segment.lines_hz), 3.0 * interval)
        kept, index = [], []
        for number in range(whole):
            begin = start + number * segment.period_s
            period = samples.between(begin - 1e-9, begin + segment.period_s - 1e-9)
            if _is_whole(period, begin, segment.period_s, interval, longest_gap):
                kept.append(period)
                index.append(number + segment.settle_periods)
        found.append(Stretch(segment, tuple(kept), tuple(index)))
    return tuple(found)


def usual_interval(time_s: FloatArray) -> float:
    """Median time between samples (N,), s."""
    return float(np.median(np.diff(time_s), overwrite_input=True)) if len(time_s) > 1 else math.inf


def _is_whole(period: Samples, begin_s: float, length_s: float, interval_s: float, longest_gap_s: float) -> bool:
    if len(period) < max(_LEAST_SHARE * length_s / interval_s, 8):
        return False
    edges = np.concatenate(([begin_s], period.time_s, [begin_s + length_s]))
    return float(np.max(np.diff(edges))) <= longest_gap_s
