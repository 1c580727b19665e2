"""Faults of the signals of a recording that leaves J open: inverted sign, frozen signal, signal cut off with noise on
it.

A constant torque gives a nearly constant acceleration, and a constant speed needs a nearly constant torque. If a signal
stays constant while its partner (the acceleration, or the torque) varies as in the whole recording, the signal is not
that of the shaft. A drive at a true torque limit, a steady speed and coasting have no such variation.
"""

from dataclasses import dataclass

import numpy as np

from profiles import MessageCode
from tdhil.estimation.result import Refused
from tdhil.estimation.samples import Samples, edges_of_runs
from tdhil.recording import BoolArray, FloatArray

_BLOCK_S, _BLOCK_SAMPLES = 0.1, 5    # s and samples; least length of a block over which signals are averaged
_FEWEST = 5               # fewest blocks of a fault
_FLAT_SHARE = 0.02        # of the recording; a shorter plateau at an extreme is not judged
_VARIES = 0.3             # of the partner's spread in the whole recording, from which it varies
_MOVES = 0.04             # of the highest speed; below it the shaft may be at standstill
_SIGMAS = 6.0             # standard deviations of the noise within which a plateau lies, on either side
_NARROW = 0.1             # of the signal's span; a wider plateau is noise
_TOP = 0.995              # quantile that stands for the extreme: single samples may be beyond the plateau
_STUCK_S, _STUCK_RUNS = 1.0, 20.0    # s, and times the usual run of equal values: a longer run may be frozen
_OPPOSES = -0.3           # correlation of torque and acceleration, below which the torque opposes the acceleration


@dataclass(frozen=True)
class _BlockMeans:
    """Means over B blocks of ``size`` samples."""

    size: int
    speed: FloatArray
    torque: FloatArray
    rate: FloatArray

    def disproved(self, inside: BoolArray, partner: FloatArray) -> float | None:
        """Return the share of blocks in a plateau ``inside`` (N,) if the partner varies there, other than by friction
        with the speed; else None.
        """
        whole = inside[: self.size * len(partner)].reshape(-1, self.size).mean(axis=1) > 0.9
        whole[1:-1] &= whole[:-2] & whole[2:]      # the rate of a block contains its neighbours
        whole &= np.abs(self.speed) > _MOVES * np.max(np.abs(self.speed))
        if np.count_nonzero(whole) < _FEWEST:
            return None
        by_speed = np.stack([np.ones(np.count_nonzero(whole)), self.speed[whole]], axis=1)
        left = partner[whole] - by_speed @ np.linalg.lstsq(by_speed, partner[whole], rcond=None)[0]
        return float(np.mean(whole)) if _spread(left) > _VARIES * _spread(partner) else None


def refuse_faulty_signals(samples: Samples, speed_quantum: float, torque_quantum: float) -> None:
    """Raise Refused with the fault of a signal, if one is found."""
    length = float(samples.time_s[-1] - samples.time_s[0])
    size = max(_BLOCK_SAMPLES, round(_BLOCK_S * len(samples) / length))
    count = len(samples) // size
    if count < 4 * _FEWEST:
        return
    time, speed, torque = (signal[: size * count].reshape(count, size).mean(axis=1)
                           for signal in (samples.time_s, samples.speed_rad_s, samples.torque_nm))
    blocks = _BlockMeans(size, speed, torque, np.gradient(speed, time))
    for name, unit, other, signal, quantum, partner in (
        ("torque", "N·m", "acceleration", samples.torque_nm, torque_quantum, blocks.rate),
        ("speed", "rad/s", "torque", samples.speed_rad_s, speed_quantum, blocks.torque),
    ):
        edges = edges_of_runs(signal)
        counts = np.diff(edges)
        inner = (signal[edges[:-1]] > signal.min()) & (signal[edges[:-1]] < signal.max())
        for first in edges[:-1][inner & (counts >= _STUCK_RUNS * np.median(counts))].tolist():
            last = int(edges[np.searchsorted(edges, first) + 1]) - 1
            lasted = float(samples.time_s[last] - samples.time_s[first])
            inside = np.zeros(len(signal), dtype=np.bool_)
            inside[first : last + 1] = True
            if lasted >= _STUCK_S and blocks.disproved(inside, partner) is not None:
                raise Refused(
                    f"the reported {name} was frozen at {signal[first]:.4g} {unit} for {lasted:.3g} s, from "
                    f"{samples.time_s[first]:.6g} s on, while the {other} changed",
                    "look for a fault of the signal or of the bus, and use a part of the record without it",
                    entry=MessageCode.DATA_UNUSABLE)
        noise = float(np.median(np.abs(np.diff(signal, 2)))) / (0.6745 * 6.0**0.5)
        width = _SIGMAS * max(noise, quantum)
        if width > _NARROW * np.ptp(signal):
            continue
        for extreme in (float(np.quantile(signal, _TOP)), float(np.quantile(signal, 1.0 - _TOP))):
            inside = np.abs(signal - extreme) <= width
            share = blocks.disproved(inside, partner)
            if share is not None and share > _FLAT_SHARE:
                raise Refused(
                    f"the reported {name} is cut off at about {np.median(signal[inside]):.3g} {unit} for "
                    f"{100 * share:.0f} % of the record, while the {other} changed",
                    f"widen the range of the recorded {name}, or use less amplitude", entry=MessageCode.SIGNAL_CLIPPED)
    opposed = float(np.corrcoef(blocks.torque, blocks.rate)[0, 1]) < _OPPOSES
    if opposed and float(blocks.torque @ blocks.speed) < 0.0:
        raise Refused("the torque opposes the accelerations and the rotation: the sign of torque or speed is inverted",
                      "count torque as positive if it accelerates the shaft in positive direction",
                      entry=MessageCode.SIGNALS_SWAPPED)


def _spread(values: FloatArray) -> float:
    low, high = np.quantile(values, (0.05, 0.95))
    return float(high - low)
