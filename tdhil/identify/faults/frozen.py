"""Feedback that stuck while it was called fresh: the same value again and again where the motion says it must change.

A smooth wave rounded to q rests on one value about its crests: x ≈ A − A ω² t²/2 stays within q for 2 √(2q/A)/ω. A run
of equal values several times as long as that, at the slowest line, and longer than a hole that a period may have, is no
wave. Two kinds of rest are other faults and are told elsewhere: at the extreme (clipped), and of the speed at zero
(the shaft stands still).
"""

import numpy as np

from tdhil.recording.recording import BoolArray, FloatArray, Recording, Segment

_NATURAL = 3.0            # times as long as a rounded crest
_SHARE_OF_CYCLE = 0.1     # of the fastest line's
_LEAST_SAMPLES = 8
_LOOKED_AT = 200_000      # samples, for the smallest step
_PERIODIC = ("multisine", "sine")


def frozen(recording: Recording) -> BoolArray | None:
    """(N,) True where a sample repeats its stuck predecessor, within the excitation; None if there is none."""
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
    """Stretches [begin, end) of sample numbers in which a signal stands still for too long."""
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
        for begin, end in _long_runs(time, part, _longest(part, step, segment)):
            value = float(part[begin])
            still = is_speed and abs(value) <= 2.0 * step
            if still or value in (float(np.nanmax(part)), float(np.nanmin(part))):
                continue
            found.append((first + (begin if chosen is None else int(chosen[begin])),
                          first + (end if chosen is None else int(chosen[end - 1]) + 1)))
    return found


def _step(signal: FloatArray, quantum: float) -> float:
    """The declared resolution, or the smallest step that occurs, whichever is coarser."""
    steps = np.abs(np.diff(signal[:_LOOKED_AT]))
    steps = steps[steps > 0.0]
    seen = float(np.min(steps)) if len(steps) else 0.0
    return max(seen, quantum) if np.isfinite(quantum) else seen


def _longest(signal: FloatArray, step: float, segment: Segment) -> float:
    """How long this signal may rest on one value, s; infinite for one that has no amplitude to speak of."""
    amplitude = 0.5 * float(np.nanmax(signal) - np.nanmin(signal))
    if not (np.isfinite(amplitude) and amplitude > 2.0 * step):
        return float("inf")
    natural = 2.0 * float(np.sqrt(2.0 * step / amplitude)) / (2.0 * np.pi * min(segment.lines_hz))
    return max(_NATURAL * natural, _SHARE_OF_CYCLE / max(segment.lines_hz))


def _long_runs(time: FloatArray, signal: FloatArray, longest_s: float) -> list[tuple[int, int]]:
    """Runs [begin, end) of equal values that last longer than ``longest_s`` and have some samples."""
    ends = np.flatnonzero(signal[1:] != signal[:-1])      # the last sample of every run but the last
    first, last = (int(ends[0]), int(ends[-1])) if len(ends) else (len(signal) - 1, -1)
    between = [(int(ends[k]) + 1, int(ends[k + 1]) + 1) for k in np.flatnonzero(np.diff(ends) >= _LEAST_SAMPLES)]
    return [(begin, end) for begin, end in ((0, first + 1), *between, (last + 1, len(signal)))
            if end - begin >= _LEAST_SAMPLES and time[end - 1] - time[begin] > longest_s]
