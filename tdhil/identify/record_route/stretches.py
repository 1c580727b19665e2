"""Which parts of a record the equation holds in: turning one way, without holes.

Coulomb friction is constant only while the sense of rotation is. What is reported as speed lags behind: ω = ω_rep +
τ ω_rep' behind a first-order lag, so a report that dies away may come from a shaft that already stands. Near every stop
or reversal the samples before it are left out for as long as the longest lag may hide it.

A long record at a high rate is averaged over groups of neighbouring samples first. Both signals pass the same average
over the same instants, and what both share cancels in torque over speed; the frequencies used lie far below the rate.
"""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from tdhil.estimation.samples import Samples
from tdhil.recording.recording import BoolArray, FloatArray

_MOST_SAMPLES = 200_000
_LEAST_RATE_HZ = 50.0
_STILL_SHARE = 0.04       # of the highest speed: below it the shaft may stand
_STILL_QUANTA = 3.0
_GAP_STEPS = 4.5          # missing samples in a row that a straight line bridges
_GAP_S = 0.05
_LEAST_SAMPLES = 32


@dataclass(frozen=True)
class Run:
    """N samples while the shaft turns one way; ``direction`` is +1 or −1."""

    samples: Samples
    direction: float

    @property
    def length_s(self) -> float:
        return float(self.samples.time_s[-1] - self.samples.time_s[0])


def thinned(samples: Samples) -> Samples:
    """At most some 200 000 samples, never below 50 Hz: means over groups of neighbours, their time included."""
    count = len(samples)
    length = float(samples.time_s[-1] - samples.time_s[0])
    rate = count / length if length > 0.0 else 0.0
    group = int(min(count / _MOST_SAMPLES, rate / _LEAST_RATE_HZ))
    if group < 2:
        return samples
    whole = count // group * group

    def mean(signal: FloatArray) -> FloatArray:
        return np.asarray(signal[:whole].reshape(-1, group).mean(axis=1), dtype=np.float64)

    # The time's first value is taken off: a mean of large stamps would round
    start = float(samples.time_s[0])
    return Samples(mean(samples.time_s - start) + start, mean(samples.speed_rad_s), mean(samples.torque_nm))


def runs(samples: Samples, speed_quantum: float, hidden_s: float) -> tuple[Run, ...]:
    """The usable runs; ``hidden_s``: how long before a stop the reported speed may still show motion."""
    if len(samples) < _LEAST_SAMPLES:
        return ()
    time, speed = samples.time_s, samples.speed_rad_s
    still = max(_STILL_SHARE * float(np.max(np.abs(speed))), _STILL_QUANTA * speed_quantum)
    moving = np.abs(speed) > still
    moving &= ~_before_stops(time, moving, hidden_s)
    sign = np.where(moving, np.sign(speed), 0.0)
    interval = float(np.median(np.diff(time)))
    longest = max(_GAP_STEPS * interval, _GAP_S)
    breaks = (np.diff(sign) != 0.0) | (np.diff(time) > longest)
    edges = np.concatenate([[0], np.flatnonzero(breaks) + 1, [len(time)]])
    found = []
    for first, last in pairwise(edges.tolist()):
        if sign[first] != 0.0 and last - first >= _LEAST_SAMPLES:
            part = Samples(time[first:last], speed[first:last], samples.torque_nm[first:last])
            found.append(Run(part, float(sign[first])))
    return tuple(found)


def _before_stops(time: FloatArray, moving: BoolArray, hidden_s: float) -> BoolArray:
    """True for the samples within ``hidden_s`` before the motion is seen to end."""
    ends = time[np.flatnonzero(moving[:-1] & ~moving[1:]) + 1]
    if len(ends) == 0:
        return np.zeros(len(time), dtype=np.bool_)
    following = np.searchsorted(ends, time)
    until = np.where(following < len(ends), ends[np.minimum(following, len(ends) - 1)] - time, math.inf)
    return np.asarray(until <= hidden_s, dtype=np.bool_)
