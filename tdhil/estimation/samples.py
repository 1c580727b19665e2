"""Selection of the samples of a recording for identification, and their whole periods."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from profiles import CodedText, MessageCode
from tdhil.recording import BoolArray, FloatArray, IntArray, Recording, Segment, Stage

LONGEST_LAG_S = 0.5
"""Longest plausible time constant of a reported speed or torque, s."""

# ---------------------------------------------------------------------------------------------------------------------
# Feedback that is frozen without a mark of it: the same value repeats while the motion must change it.
#
# A smooth wave rounded to q rests on one value about its crests: x ≈ A − A ω² t²/2 stays within q for 2 √(2q/A)/ω. A
# run of equal values is frozen if it is several times as long as that at the slowest line, and longer than a gap that a
# period may have. Two kinds of constant value are other faults, reported elsewhere: at the extreme (clipped), and speed
# at zero (standstill).


_NATURAL = 3.0            # times the duration of a rounded crest
_SHARE_OF_CYCLE = 0.1     # share of the fastest line's cycle
_LEAST_SAMPLES = 8        # shortest run of equal values that is examined. A choice: rounding makes shorter ones
_LOOKED_AT = 200_000      # samples used to find the smallest step
_PERIODIC = ("multisine", "sine")


def frozen(recording: Recording) -> BoolArray | None:
    """Return (N,) True where a sample repeats a frozen value within the excitation; None if there is none."""
    excitation = recording.excitation
    if excitation is None or excitation.kind not in _PERIODIC:
        return None
    found: BoolArray | None = None
    for segment in excitation.segments:
        if not segment.lines_hz or not min(segment.lines_hz) > 0.0:
            continue
        first, last = (int(i) for i in np.searchsorted(recording.time_s, (segment.start_s, segment.end_s)))
        for begin, end in _rests(recording, segment, first, last):
            if found is None:
                found = np.zeros(len(recording.time_s), dtype=np.bool_)
            found[begin + 1 : end] = True
    return found


def _rests(recording: Recording, segment: Segment, first: int, last: int) -> list[tuple[int, int]]:
    """Return the stretches [begin, end) of sample numbers in which a signal is constant for too long."""
    time = recording.time_s[first:last]
    if last - first < 2 * _LEAST_SAMPLES:
        return []
    fresh = recording.fresh[first:last]
    chosen = None if bool(np.all(fresh)) else np.flatnonzero(fresh)
    if chosen is not None and len(chosen) < 2 * _LEAST_SAMPLES:
        return []
    if chosen is not None:
        time = time[chosen]
    found = []
    for signal, quantum, is_speed in (
        (recording.speed_rad_s, recording.speed_resolution_rad_s, True),
        (recording.torque_nm, recording.torque_resolution_nm, False),
    ):
        part = signal[first:last] if chosen is None else signal[first:last][chosen]
        step = _step(part, quantum)
        # longest time that this signal may stay at one value, s; infinite if its amplitude is near its resolution
        amplitude, longest_s = 0.5 * float(np.nanmax(part) - np.nanmin(part)), math.inf
        if np.isfinite(amplitude) and amplitude > 2.0 * step:
            natural = 2.0 * float(np.sqrt(2.0 * step / amplitude)) / (2.0 * np.pi * min(segment.lines_hz))
            longest_s = max(_NATURAL * natural, _SHARE_OF_CYCLE / max(segment.lines_hz))
        for begin, end in _long_runs(time, part, longest_s):
            value = float(part[begin])
            still = is_speed and abs(value) <= 2.0 * step
            if still or value in (float(np.nanmax(part)), float(np.nanmin(part))):
                continue
            found.append((first + (begin if chosen is None else int(chosen[begin])),
                          first + (end if chosen is None else int(chosen[end - 1]) + 1)))
    return found


def _step(signal: FloatArray, quantum: float) -> float:
    """Return the declared resolution, or the smallest step in the data, whichever is coarser."""
    steps = np.abs(np.diff(signal[:_LOOKED_AT]))
    steps = steps[steps > 0.0]
    seen = float(np.min(steps)) if len(steps) else 0.0
    return max(seen, quantum) if np.isfinite(quantum) else seen


def edges_of_runs(signal: FloatArray | BoolArray) -> IntArray:
    """Return the first index of each run of equal values, then the length of the signal, (runs + 1,)."""
    return np.concatenate([[0], np.flatnonzero(signal[1:] != signal[:-1]) + 1, [len(signal)]])


def _long_runs(time: FloatArray, signal: FloatArray, longest_s: float) -> list[tuple[int, int]]:
    """Return the runs [begin, end) of equal values that last longer than ``longest_s`` and have enough samples."""
    edges = edges_of_runs(signal)
    many = np.flatnonzero(np.diff(edges) >= _LEAST_SAMPLES)
    begins, ends = edges[many], edges[many + 1]
    lasting = time[ends - 1] - time[begins] > longest_s
    return list(zip(begins[lasting].tolist(), ends[lasting].tolist(), strict=True))


# ---------------------------------------------------------------------------------------------------------------------
# Spikes: single samples far from both neighbours, on the same side. Causes: a bit error, a frame of another object, an
# impulse on the wire.
#
# The usual step from sample to sample is the mean |Δx|, of noise and motion together. Gaussian noise does not produce a
# step of 25 times that, and motion does not go there and back within three samples.


_FAR = 25.0       # times the usual step
_QUANTA = 6.0     # times the resolution of the signal, at least: at standstill the usual step may be nearly 0
_MOST = 0.02      # largest share of spikes: more of them are not spikes but another signal
_BLOCK = 262144   # samples worked on at once


def spikes(recording: Recording) -> BoolArray | None:
    """Return (N,) True at a spike of speed or torque; None if there is none."""
    found: BoolArray | None = None
    for signal, quantum in (
        (recording.speed_rad_s, recording.speed_resolution_rad_s),
        (recording.torque_nm, recording.torque_resolution_nm),
    ):
        at = _of(signal, quantum)
        if at is not None:
            found = at if found is None else found | at
    return found


def _of(signal: FloatArray, quantum: float) -> BoolArray | None:
    if len(signal) < 3:
        return None
    starts = range(0, len(signal) - 2, _BLOCK)
    total, count = 0.0, 0
    for first in starts:
        part = np.asarray(signal[first : first + _BLOCK + 2], dtype=np.float64)
        # a step between infinite neighbours is not a number; both are left out, here and in the whole signal
        finite = np.isfinite(part)
        step = np.abs(np.diff(part[finite]))
        total, count = total + float(np.sum(step)), count + len(step)
    limit = max(_FAR * total / count, _QUANTA * quantum) if count else np.inf
    found: BoolArray | None = None
    for first in starts:
        part = np.asarray(signal[first : first + _BLOCK + 2], dtype=np.float64)
        if not np.all(np.isfinite(part)):
            part = np.where(np.isfinite(part), part, 0.0)
        step = np.diff(part)
        if not len(step) or max(float(np.max(step)), -float(np.min(step))) <= limit or limit <= 0.0:
            continue
        up, down = step > limit, step < -limit
        here = (up[:-1] & down[1:]) | (down[:-1] & up[1:])
        if np.any(here):
            if found is None:
                found = np.zeros(len(signal), dtype=np.bool_)
            found[first + 1 : first + 1 + len(here)] |= here
    if found is None or np.count_nonzero(found) > _MOST * len(signal):
        return None
    return found


# ---------------------------------------------------------------------------------------------------------------------
# Samples that are not measurements although no flag marks them, and the warnings about them.


def good_samples(recording: Recording) -> BoolArray:
    """Return (N,) True where a sample is fresh, finite, not a spike and not frozen."""
    good: BoolArray = np.isfinite(recording.time_s)
    good &= recording.fresh
    good &= np.isfinite(recording.speed_rad_s)
    good &= np.isfinite(recording.torque_nm)
    for bad in (spikes(recording), frozen(recording)):
        if bad is not None:
            good &= ~bad
    return good


def log_warnings(recording: Recording) -> tuple[str, ...]:
    """Return the warnings of the log about its samples: lost ones, and ones that brought nothing new."""
    found = []
    if not recording.complete:
        found.append(CodedText("the log ended before the run did: partial data", MessageCode.PARTIAL_DATA))
    stale = float((~recording.fresh).mean())
    if stale > 0.01:
        found.append(CodedText(f"{100 * stale:.1f} % of the samples were stale and left out",
                               MessageCode.STALE_SAMPLES))
    return tuple(found)


def left_out_warnings(recording: Recording) -> tuple[str, ...]:
    """Return a sentence for each kind of fault whose samples were left out, except stale ones, which have a flag."""
    said = []
    finite = np.isfinite(recording.speed_rad_s)
    finite &= np.isfinite(recording.torque_nm)
    odd = int(np.count_nonzero(recording.fresh & ~finite))
    if odd:
        said.append(CodedText(f"{_samples(odd)} not a number, and left out", MessageCode.SAMPLES_LEFT_OUT))
    jumps = spikes(recording)
    if jumps is not None:
        said.append(CodedText(
            f"{_samples(int(np.count_nonzero(jumps)))} a spike far from its neighbours, and left out",
            MessageCode.SAMPLES_LEFT_OUT))
    stuck = frozen(recording)
    if stuck is not None:
        first = int(np.argmax(stuck))
        last = first + int(np.argmin(np.append(stuck[first:], False)))
        run = first - 1 + np.flatnonzero(recording.fresh[first - 1 : last])
        at, length = float(recording.time_s[first]), float(np.ptp(recording.time_s[run]))
        names = [name for name, signal in (("speed", recording.speed_rad_s), ("torque", recording.torque_nm))
                 if len(np.unique(signal[run])) == 1]
        said.append(CodedText(
            f"the reported {' and '.join(names or ['speed or torque'])} did not change for {length:.3g} s, first at "
            f"{at:.6g} s. tdhil left out {100.0 * float(np.mean(stuck)):.1f} % of the samples",
            MessageCode.SAMPLES_LEFT_OUT,
        ))
    return tuple(said)


def _samples(count: int) -> str:
    return "1 sample was" if count == 1 else f"{count} samples were each"


# ---------------------------------------------------------------------------------------------------------------------

_LEAST_SHARE = 0.6        # least share of a period's samples
LONGEST_GAP = 0.1        # longest gap, as a share of the shortest cycle of the excitation


@dataclass(frozen=True)
class Samples:
    """N usable samples: fresh and finite, torque without its offset; (N,) each, time rising."""

    time_s: FloatArray
    speed_rad_s: FloatArray
    torque_nm: FloatArray

    def between(self, start_s: float, end_s: float) -> "Samples":
        """Return the samples with start ≤ time < end."""
        first, last = np.searchsorted(self.time_s, (start_s, end_s), side="left")
        return Samples(self.time_s[first:last], self.speed_rad_s[first:last], self.torque_nm[first:last])

    def __len__(self) -> int:
        return len(self.time_s)


@dataclass(frozen=True)
class Stretch:
    """Usable whole periods of one segment, one Samples each; ``index`` (P,) counts from the start of the segment."""

    segment: Segment
    periods: tuple[Samples, ...]
    index: tuple[int, ...]


def usable_samples(recording: Recording) -> Samples:
    """Return the samples without stale, frozen, spiked and non-finite ones, with torque less its offset at standstill.

    If every sample is good and no offset is known, these are the arrays of the recording, without a copy.
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


ALL_TIME = ((-math.inf, math.inf),)      # s; span of a whole recording


def angle_readings(
    recording: Recording, spans: Sequence[tuple[float, float]] = ALL_TIME
) -> tuple[FloatArray, FloatArray] | None:
    """Return time (N,), s, and reported angle (N,), rad, of all readings; None if the drive reports no angle.

    ``spans``: begin and end of the times that count, s, in their order and without overlap. If every sample of the
    recording has an angle, these are its arrays, without a copy.
    """
    angle = recording.position_rad
    if angle is None:
        return None
    times: list[FloatArray] = []
    turned: list[FloatArray] = []
    for part in (slice(*np.searchsorted(recording.time_s, span)) for span in spans):
        known = np.isfinite(angle[part]) & recording.fresh[part]
        for found, signal in ((times, recording.time_s[part]), (turned, angle[part])):
            found.append(np.asarray(signal if np.all(known) else signal[known], dtype=np.float64))
    return (times[0], turned[0]) if len(times) == 1 else (np.concatenate(times), np.concatenate(turned))


def acquisitions(recording: Recording) -> tuple[Stage, ...]:
    """Return stage 5, which gives J; () for a recording without stages."""
    return tuple(stage for stage in recording.stages if stage.name == "acquire")


def excited_window(segment: Segment) -> tuple[float, float]:
    """Return the span from the end of settling to the end of the segment, s."""
    return segment.start_s + segment.settle_periods * segment.period_s, segment.end_s


def stretches(samples: Samples, segments: tuple[Segment, ...]) -> tuple[Stretch, ...]:
    """Return the whole periods of every segment; a period with gaps is left out."""
    found = []
    interval = usual_interval(samples.time_s)
    for segment in segments:
        if not segment.lines_hz or not (segment.period_s > 0.0 and math.isfinite(segment.period_s)):
            continue
        start, end = excited_window(segment)
        longest_gap = max(LONGEST_GAP / max(segment.lines_hz), 3.0 * interval)
        last_time = float(samples.time_s[-1]) if len(samples) else start
        # a recording may end a little early, by no more than the longest allowed gap
        end = min(end, last_time + longest_gap)
        whole = max(0, math.floor((end - start) / segment.period_s + 1e-6))
        kept, index = [], []
        for number in range(whole):
            begin = start + number * segment.period_s
            period = samples.between(begin - 1e-9, begin + segment.period_s - 1e-9)
            if len(period) < max(_LEAST_SHARE * segment.period_s / interval, 8):
                continue
            edges = np.concatenate(([begin], period.time_s, [begin + segment.period_s]))
            if float(np.max(np.diff(edges))) <= longest_gap:
                kept.append(period)
                index.append(number + segment.settle_periods)
        found.append(Stretch(segment, tuple(kept), tuple(index)))
    return tuple(found)


def thinned(period: Samples, blocks: int) -> Samples:
    """Return means over blocks of equally many samples; the samples themselves if there are few."""
    size = len(period) // blocks
    if size < 2:
        return period
    starts = np.arange(0, len(period), size)
    counts = np.diff(np.append(starts, len(period)))
    return Samples(*(np.add.reduceat(signal, starts) / counts
                     for signal in (period.time_s, period.speed_rad_s, period.torque_nm)))


def usual_interval(time_s: FloatArray) -> float:
    """Return the median time between samples (N,), s."""
    return float(np.median(np.diff(time_s), overwrite_input=True)) if len(time_s) > 1 else math.inf


# ---------------------------------------------------------------------------------------------------------------------
# Stick-slip of the bit: a repeating oscillation with a swing as large as that of a bit between 0 and twice its speed.


STICK_SLIP_REGULAR = 0.6
"""Least autocorrelation, after one period, of a repeating oscillation."""

STICK_SLIP_SHARE = 0.9
"""Downhole speed swing over mean speed, from which a repeating oscillation is stick-slip. A bit that stands still in
each period swings by the mean speed or more. Simulated strings of 1,000 to 5,000 m with bit noise of 200 to 1,500
N·m: 1.04 and more, computed from 0.5 s means, if the bit sticks. The margin is for the lag of the reported torque."""

SHORTEST_SWING_S = 1.5    # s; shortest period of a string's oscillation


def downhole_swing_rad_s(torque_swing_nm: float, impedance_nm_s_rad: float, delay_s: float, period_s: float) -> float:
    """Return the amplitude of the speed at the lower end of a pipe, from that of the torque at its upper end.

    The upper end hardly moves. The waves up and down then add to ω_b = −j sin(ΩT) τ/ζ at the lower end, T the pipe's
    travel time. If ΩT is above π/2, the oscillation is not that of the lowest mode, and the upper bound τ/ζ is
    returned.
    """
    return math.sin(min(2.0 * math.pi * delay_s / period_s, 0.5 * math.pi)) * torque_swing_nm / impedance_nm_s_rad


def repeats(signal: FloatArray, step_s: float) -> tuple[float, float]:
    """Return the time after which a signal repeats, s, and the autocorrelation there: the first of its highest
    peaks.
    """
    x = signal - signal.mean()
    count = len(x)
    alike = np.zeros(count // 2 + 1)
    for lag in range(len(alike)):
        early, late = x[: count - lag], x[lag:]
        scale = math.sqrt(float(early @ early) * float(late @ late))
        alike[lag] = float(early @ late) / scale if scale > 0.0 else 0.0
    dips = np.flatnonzero(alike < 0.0)
    first = max(int(dips[0]) if len(dips) else len(alike), math.ceil(SHORTEST_SWING_S / step_s))
    if first >= len(alike) or np.max(alike[first:]) <= 0.0:
        return 0.0, 0.0
    high = first + int(np.flatnonzero(alike[first:] >= 0.9 * np.max(alike[first:]))[0])
    fallen = np.flatnonzero(alike[high:] < 0.0)
    best = high + int(np.argmax(alike[high : high + int(fallen[0]) if len(fallen) else None]))
    return best * step_s, max(0.0, float(alike[best]))
