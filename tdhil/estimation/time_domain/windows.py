r"""Equations from runs: the recording through smooth windows, at frequencies one inverse window length apart.

A window w of compact support times e^(−st) is a test function. Integration by parts moves every derivative to it. For
any polynomial H (and any H smooth over the window's own bandwidth)

    ∫ w e^(−st) H(d/dt) x dt = Σ_n H⁽ⁿ⁾(s)/n! · X_n,     X_n = (−1)ⁿ ∫ w⁽ⁿ⁾ e^(−st) x dt.

No noise is differentiated, and initial conditions have no effect. The actual time stamps are used (trapezoidal rule, on
a cubic spline through the samples if a taper has few of them). The noise at frequencies 1/(length of the window) apart
is nearly uncorrelated. The windows of one run overlap only in their tapers, and add up to one.
"""

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from tdhil.estimation.samples import Samples
from tdhil.estimation.spectrum import unit_waves
from tdhil.estimation.time_domain.taylor import ORDERS, ComplexArray, flat_top
from tdhil.recording import BoolArray, FloatArray

# ---------------------------------------------------------------------------------------------------------------------
# Parts of a recording in which the equation holds: rotation in one direction, without gaps.
#
# Coulomb friction is constant only in one direction of rotation. The reported speed lags: ω = ω_rep + τ ω_rep' for a
# first-order lag, so a reported speed that decays may come from a shaft at standstill. Before every stop or reversal
# the samples are left out for as long as the longest lag may hide it.
#
# A long recording at a high rate is first averaged over groups of neighbouring samples. Both signals have the same
# average over the same instants, which cancels in torque over speed. The frequencies used are far below the rate.


_MOST_SAMPLES = 200_000   # most samples of a recording that are used: more are averaged in groups
_LEAST_RATE_HZ = 50.0     # Hz; least rate after this averaging
_STILL_SHARE = 0.04       # of the highest speed: below it the shaft may be at standstill
STILL_QUANTA = 3.0        # quanta of the speed below which the shaft stands still
_GAP_STEPS = 4.5          # missing samples in a row that a straight line bridges
_GAP_S = 0.05             # s; a shorter interval is no gap
_LEAST_SAMPLES_OF_STRETCH = 32   # fewer samples make no stretch


@dataclass(frozen=True)
class OneWayStretch:
    """N samples while the shaft turns in one direction; ``direction`` is +1 or −1."""

    samples: Samples
    direction: float

    @property
    def length_s(self) -> float:
        return float(self.samples.time_s[-1] - self.samples.time_s[0])


def thinned(samples: Samples, most: int = _MOST_SAMPLES) -> Samples:
    """Return at most some 200 000 samples, never below 50 Hz: means over groups of neighbours, their time included."""
    count = len(samples)
    length = float(samples.time_s[-1] - samples.time_s[0])
    rate = count / length if length > 0.0 else 0.0
    group = int(min(count / most, rate / _LEAST_RATE_HZ))
    if group < 2:
        return samples
    whole = count // group * group

    def mean(signal: FloatArray) -> FloatArray:
        return np.asarray(signal[:whole].reshape(-1, group).mean(axis=1), dtype=np.float64)

    # the first time is subtracted, because a mean of large time stamps would round
    start = float(samples.time_s[0])
    return Samples(mean(samples.time_s - start) + start, mean(samples.speed_rad_s), mean(samples.torque_nm))


def runs(samples: Samples, speed_quantum: float, hidden_s: float) -> tuple[OneWayStretch, ...]:
    """Return the usable runs. ``hidden_s``: time before a stop during which the reported speed may still show
    motion.
    """
    if len(samples) < _LEAST_SAMPLES_OF_STRETCH:
        return ()
    time, speed = samples.time_s, samples.speed_rad_s
    still = max(_STILL_SHARE * float(np.max(np.abs(speed))), STILL_QUANTA * speed_quantum)
    moving = np.abs(speed) > still
    ends = time[np.flatnonzero(moving[:-1] & ~moving[1:]) + 1]
    if len(ends):      # samples shortly before the end of reported motion
        following = np.searchsorted(ends, time)
        until = np.where(following < len(ends), ends[np.minimum(following, len(ends) - 1)] - time, math.inf)
        moving &= ~(until <= hidden_s)
    sign = np.where(moving, np.sign(speed), 0.0)
    interval = float(np.median(np.diff(time)))
    longest = max(_GAP_STEPS * interval, _GAP_S)
    breaks = (np.diff(sign) != 0.0) | (np.diff(time) > longest)
    edges = np.concatenate([[0], np.flatnonzero(breaks) + 1, [len(time)]])
    found = []
    for first, last in pairwise(edges.tolist()):
        if sign[first] != 0.0 and last - first >= _LEAST_SAMPLES_OF_STRETCH:
            part = Samples(time[first:last], speed[first:last], samples.torque_nm[first:last])
            found.append(OneWayStretch(part, float(sign[first])))
    return tuple(found)


# ---------------------------------------------------------------------------------------------------------------------

_LONGEST_S = 60.0         # s; longest window
_TAPER_S = 6.0            # s; longest taper of a window
_TAPER_SHARE = 0.25       # of the stretch: longest taper
_MOST_BINS = 400          # most bins of a window
_RATE_SHARE = 0.2         # of the sampling rate: the highest frequency used
_OF_TAPER = 100           # samples of a taper: with fewer the sums with a window's third derivative are not integrals
_COINCIDENT = 0.3         # of the usual interval: a spline through closer samples would oscillate
_CHUNK = 64               # frequencies at once
_LEAST_SAMPLES = 32       # fewest samples of a window


@dataclass(frozen=True)
class TaperWindow:
    """Place of a window in its run: tapers of ``taper_s`` at both ends, ``hop_s`` from one window to the next.

    ``finer``: samples of the run for each recorded sample.
    """

    run: OneWayStretch
    start_s: float
    hop_s: float
    taper_s: float
    number: int
    finer: int = 1

    @property
    def length_s(self) -> float:
        return self.hop_s + self.taper_s

    def part(self, begin_s: float, end_s: float) -> Samples:
        """Return the samples of the run between two times from the start of the window, s."""
        return self.run.samples.between(self.start_s + begin_s, self.start_s + end_s)

    def shape(self, time: FloatArray) -> FloatArray:
        """Return the window and its first three derivatives at times from its start, (N, 4)."""
        return flat_top(time, self.length_s, self.taper_s)


@dataclass(frozen=True)
class Bins:
    """M equations. ``s`` = 2πj f (M,); ``speed``, ``torque`` (M, 4): X_n; ``level`` (M, 2): ∫φ turning forward, back.

    ``bend`` (M, 4): X_n of ω|ω|; ``energy`` (M,): ∫w², s, factor of a bin's noise power; ``window`` (M,): index of its
    window.
    """

    s: ComplexArray
    speed: ComplexArray
    torque: ComplexArray
    level: ComplexArray
    bend: ComplexArray
    energy: FloatArray
    window: FloatArray

    @property
    def hertz(self) -> FloatArray:
        return np.asarray(self.s.imag / (2.0 * math.pi), dtype=np.float64)

    def __len__(self) -> int:
        return len(self.s)

    def chosen(self, keep: BoolArray) -> "Bins":
        """Return the bins of a mask (M,)."""
        return Bins(self.s[keep], self.speed[keep], self.torque[keep], self.level[keep], self.bend[keep],
                    self.energy[keep], self.window[keep])


def joined(parts: list[Bins]) -> Bins:
    """Return all bins of the parts, one part after the other."""
    if not parts:
        none, empty = np.zeros(0, dtype=np.complex128), np.zeros(0)
        wide = np.zeros((0, ORDERS), dtype=np.complex128)
        return Bins(none, wide, wide, np.zeros((0, 2), dtype=np.complex128), wide, empty, empty)
    return Bins(*(np.concatenate([getattr(part, name) for part in parts])
                  for name in ("s", "speed", "torque", "level", "bend", "energy", "window")))


def place_windows(found: tuple[OneWayStretch, ...]) -> tuple[TaperWindow, ...]:
    """Return all windows of all runs, in order of time."""
    placed: list[TaperWindow] = []
    for run in found:
        length = run.length_s
        taper = min(_TAPER_S, _TAPER_SHARE * length)
        count = max(1, math.ceil((length - taper) / _LONGEST_S))
        hop = (length - taper) / count
        finer = math.ceil(_OF_TAPER * length / (taper * len(run.samples)))
        fine, samples = run, run.samples
        if finer > 1:
            from scipy.interpolate import CubicSpline

            # on an even grid; in the band that is used the error of a spline is 0.5 % at most, equal for both signals
            start, step = float(samples.time_s[0]), np.diff(samples.time_s)
            knots = np.concatenate([[True], step >= _COINCIDENT * np.median(step)])
            both = np.column_stack([samples.speed_rad_s, samples.torque_nm])[knots]
            even = np.linspace(0.0, float(samples.time_s[knots][-1]) - start, finer * (len(samples) - 1) + 1)
            splines = CubicSpline(samples.time_s[knots] - start, both)(even)
            fine = replace(run, samples=Samples(even + start, splines[:, 0], splines[:, 1]))
        for number in range(count):
            window = TaperWindow(run, float(run.samples.time_s[0]) + number * hop, hop, taper, len(placed))
            if len(window.part(0.0, hop + taper)) >= _LEAST_SAMPLES:
                placed.append(replace(window, run=fine, finer=finer))
    return tuple(placed)


def measure(window: TaperWindow) -> Bins:
    """Return the bins of a window at all its frequencies.

    These are multiples of one frequency, so that e^(−j(ω_m + ω_k) t) = e^(−jω_m t) e^(−jω_k t): the waves of the first
    frequencies serve all others, if the signals are turned by ω_m before.
    """
    part = window.part(0.0, window.length_s)
    time, speed, torque = part.time_s - window.start_s, part.speed_rad_s, part.torque_nm
    rate = len(time) / window.finer / float(time[-1] - time[0])
    highest = min(_RATE_SHARE * rate, _MOST_BINS / window.hop_s)
    s = np.asarray(2j * math.pi * np.arange(math.floor(highest * window.hop_s) + 1) / window.hop_s, dtype=np.complex128)
    step = np.empty_like(time)
    step[1:-1] = 0.5 * (time[2:] - time[:-2])
    step[0], step[-1] = 0.5 * (time[1] - time[0]), 0.5 * (time[-1] - time[-2])
    shape = window.shape(time)
    weights = shape * np.array([1.0, -1.0, 1.0, -1.0]) * step[:, None]
    columns = np.concatenate(
        [weights * speed[:, None], weights * torque[:, None], weights[:, :1],
         weights * (speed * np.abs(speed))[:, None]],
        axis=1,
    )
    waves = unit_waves(np.outer(-s.imag[:_CHUNK], time))
    seen = np.concatenate([
        waves[: len(s) - first] @ (unit_waves(-s.imag[first] * time)[:, None] * columns)
        for first in range(0, len(s), _CHUNK)
    ])
    level = np.zeros((len(s), 2), dtype=np.complex128)
    level[:, 0 if window.run.direction > 0.0 else 1] = seen[:, 8]
    energy = np.full(len(s), float(np.sum(shape[:, 0] ** 2 * step)))
    return Bins(s, seen[:, :4], seen[:, 4:8], level, seen[:, 9:13], energy, np.full(len(s), float(window.number)))
