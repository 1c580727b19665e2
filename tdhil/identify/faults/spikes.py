"""Single samples that can't be: a value far from both its neighbours, on the same side. A bit that fell over, a frame
of another object, a pulse on the wire.

The usual step from sample to sample is the mean |Δx|, noise and motion together. Of Gaussian noise a step of 25 times
that doesn't occur, and motion doesn't go there and back within three samples.
"""

import numpy as np

from tdhil.recording.recording import BoolArray, FloatArray, Recording

_FAR = 25.0       # usual steps
_QUANTA = 6.0     # and at least so many of the signal's resolution: at rest the usual step may be next to nothing
_MOST = 0.02      # of the samples: more are no spikes but another signal
_BLOCK = 262144   # samples worked on at once


def spikes(recording: Recording) -> BoolArray | None:
    """(N,) True at a spike of speed or torque; None if there is none."""
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
        # of infinite neighbours the step is no number; they are left out, here as in the whole
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
