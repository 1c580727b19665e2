r"""From runs to equations: the record seen through smooth windows, at frequencies one window length apart.

A window w of compact support times e^(−st) is a test function. Integrating by parts moves every derivative onto it, so
that for any polynomial H (and any H smooth over the window's own bandwidth)

    ∫ w e^(−st) H(d/dt) x dt = Σ_n H⁽ⁿ⁾(s)/n! · X_n,     X_n = (−1)ⁿ ∫ w⁽ⁿ⁾ e^(−st) x dt.

No noise is differentiated, initial conditions don't matter, time stamps are used as they are (trapezoidal rule), and
the noise at frequencies 1/(length of the window) apart is nearly uncorrelated. The windows of one run overlap in their
tapers only and add up to one.
"""

import math
from dataclasses import dataclass

import numpy as np

from tdhil.estimation.samples import Samples
from tdhil.estimation.time_domain.taylor import ORDERS, ComplexArray
from tdhil.identify.record_route.stretches import Run
from tdhil.identify.record_route.tapers import flat_top
from tdhil.recording.recording import BoolArray, FloatArray

_LONGEST_S = 60.0
_TAPER_S = 6.0
_TAPER_SHARE = 0.25
_MOST_BINS = 400          # a window
_RATE_SHARE = 0.2         # of the sampling rate: the highest frequency used
_CHUNK = 64
_LEAST_SAMPLES = 32


@dataclass(frozen=True)
class Window:
    """Where a window lies in its run: tapers of ``taper_s`` at both ends, ``hop_s`` from one window to the next."""

    run: Run
    start_s: float
    hop_s: float
    taper_s: float
    number: int

    @property
    def length_s(self) -> float:
        return self.hop_s + self.taper_s

    def part(self, begin_s: float, end_s: float) -> Samples:
        """The run's samples between two times from the window's start."""
        return self.run.samples.between(self.start_s + begin_s, self.start_s + end_s)

    def shape(self, time: FloatArray) -> FloatArray:
        """The window and its first three derivatives at times from its start, (N, 4)."""
        return flat_top(time, self.length_s, self.taper_s)


@dataclass(frozen=True)
class Bins:
    """M equations. ``s`` = 2πj f (M,); ``speed``, ``torque`` (M, 4): X_n; ``level`` (M, 2): ∫φ turning forward, back.

    ``bend`` (M,): ∫φ ω|ω|; ``energy`` (M,): ∫w², s, by which the noise power of a bin grows; ``window`` (M,): which.
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
        """Those of a mask (M,)."""
        return Bins(self.s[keep], self.speed[keep], self.torque[keep], self.level[keep], self.bend[keep],
                    self.energy[keep], self.window[keep])


def joined(parts: list[Bins]) -> Bins:
    """One after the other."""
    if not parts:
        none, empty = np.zeros(0, dtype=np.complex128), np.zeros(0)
        wide = np.zeros((0, ORDERS), dtype=np.complex128)
        return Bins(none, wide, wide, np.zeros((0, 2), dtype=np.complex128), none, empty, empty)
    return Bins(*(np.concatenate([getattr(part, name) for part in parts])
                  for name in ("s", "speed", "torque", "level", "bend", "energy", "window")))


def windows(found: tuple[Run, ...]) -> tuple[Window, ...]:
    """All windows of all runs, in the order of time."""
    placed: list[Window] = []
    for run in found:
        length = run.length_s
        taper = min(_TAPER_S, _TAPER_SHARE * length)
        count = max(1, math.ceil((length - taper) / _LONGEST_S))
        hop = (length - taper) / count
        for number in range(count):
            window = Window(run, float(run.samples.time_s[0]) + number * hop, hop, taper, len(placed))
            if len(window.part(0.0, hop + taper)) >= _LEAST_SAMPLES:
                placed.append(window)
    return tuple(placed)


def measure(window: Window) -> Bins:
    """Every frequency of a window."""
    part = window.part(0.0, window.length_s)
    time = part.time_s - window.start_s
    highest = min(_RATE_SHARE * len(time) / float(time[-1] - time[0]), _MOST_BINS / window.hop_s)
    frequencies = np.arange(math.floor(highest * window.hop_s) + 1) / window.hop_s
    s = np.asarray(2j * math.pi * frequencies, dtype=np.complex128)
    return seen_through(window, part, window.shape(time), s)


def seen_through(window: Window, part: Samples, shape: FloatArray, s: ComplexArray) -> Bins:
    """The samples ``part`` (N) through ``shape`` (N, 4), a test function and its derivatives, at ``s`` (M,)."""
    time, speed, torque = part.time_s - window.start_s, part.speed_rad_s, part.torque_nm
    step = np.empty_like(time)
    step[1:-1] = 0.5 * (time[2:] - time[:-2])
    step[0], step[-1] = 0.5 * (time[1] - time[0]), 0.5 * (time[-1] - time[-2])
    weights = shape * np.array([1.0, -1.0, 1.0, -1.0]) * step[:, None]
    columns = np.concatenate(
        [weights * speed[:, None], weights * torque[:, None], weights[:, :1],
         weights[:, :1] * (speed * np.abs(speed))[:, None]],
        axis=1,
    )
    seen = np.concatenate([
        np.exp(np.outer(-s[first : first + _CHUNK], time)) @ columns for first in range(0, len(s), _CHUNK)
    ])
    level = np.zeros((len(s), 2), dtype=np.complex128)
    level[:, 0 if window.run.direction > 0.0 else 1] = seen[:, 8]
    energy = np.full(len(s), float(np.sum(shape[:, 0] ** 2 * step)))
    return Bins(s, seen[:, :4], seen[:, 4:8], level, seen[:, 9], energy, np.full(len(s), float(window.number)))
