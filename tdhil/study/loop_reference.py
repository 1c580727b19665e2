"""What the loop is asked to follow, in rad/s: sine with offset (equation 8), step (equation 9), chirp, multisine."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tdhil.study.settings import LoopSettings

FloatArray = NDArray[np.float64]


class Reference(Protocol):
    """A speed for every time; ``period_s`` is None where nothing repeats."""

    @property
    def period_s(self) -> float | None: ...

    def at(self, time_s: FloatArray) -> FloatArray: ...


@dataclass(frozen=True)
class Sine:
    """w(t) = A sin(2πf t) + offset (equation 8; the paper's w_t is 2πf)."""

    offset_rad_s: float
    amplitude_rad_s: float
    frequency_hz: float

    @property
    def period_s(self) -> float:
        return 1.0 / self.frequency_hz

    def at(self, time_s: FloatArray) -> FloatArray:
        return self.offset_rad_s + self.amplitude_rad_s * np.sin(2.0 * pi * self.frequency_hz * time_s)


@dataclass(frozen=True)
class Step:
    """w(t) = A0 before, A1 from ``at_s`` on (equation 9, whose step is at zero)."""

    before_rad_s: float
    after_rad_s: float
    at_s: float
    period_s: None = None

    def at(self, time_s: FloatArray) -> FloatArray:
        return np.where(time_s < self.at_s, self.before_rad_s, self.after_rad_s)


@dataclass(frozen=True)
class Chirp:
    """w(t) = offset + A sin(2π(f0 t + (f1 − f0) t²/(2T))): the frequency goes linearly from f0 to f1 within T."""

    offset_rad_s: float
    amplitude_rad_s: float
    begin_hz: float
    end_hz: float
    duration_s: float
    period_s: None = None

    def at(self, time_s: FloatArray) -> FloatArray:
        rate = (self.end_hz - self.begin_hz) / (2.0 * self.duration_s)
        cycles = self.begin_hz * time_s + rate * time_s**2
        return self.offset_rad_s + self.amplitude_rad_s * np.sin(2.0 * pi * cycles)


@dataclass(frozen=True)
class Multisine:
    """w(t) = offset + (A/M) Σ sin(2πk f t + φ_k), k = 1…n, with Schroeder's phases φ_k = −π k(k−1)/n for a low crest.

    M is the sum's own peak, so that the speed stays within offset ± A. (M. R. Schroeder, IEEE Trans. Inf. Theory 16,
    1970, p. 85.)
    """

    offset_rad_s: float
    amplitude_rad_s: float
    frequency_hz: float
    lines: int = 4

    @property
    def period_s(self) -> float:
        return 1.0 / self.frequency_hz

    def at(self, time_s: FloatArray) -> FloatArray:
        fine = np.arange(4096 * self.lines) / (4096 * self.lines * self.frequency_hz)
        return self.offset_rad_s + self.amplitude_rad_s / float(np.abs(self._sum(fine)).max()) * self._sum(time_s)

    def _sum(self, time_s: FloatArray) -> FloatArray:
        total = np.zeros_like(time_s)
        for line in range(1, self.lines + 1):
            total += np.sin(2.0 * pi * line * self.frequency_hz * time_s - pi * line * (line - 1) / self.lines)
        return total


def reference_of(run: LoopSettings) -> Reference:
    """What ``run`` asks for. The step goes from the offset to offset + amplitude at a quarter of the period (3.4.3)."""
    if run.signal == "step":
        return Step(run.offset_rad_s, run.offset_rad_s + run.amplitude_rad_s, 0.25 / run.frequency_hz)
    if run.signal == "chirp":
        return Chirp(run.offset_rad_s, run.amplitude_rad_s, run.frequency_hz, run.chirp_end_hz, run.duration_s)
    if run.signal == "multisine":
        return Multisine(run.offset_rad_s, run.amplitude_rad_s, run.frequency_hz)
    return Sine(run.offset_rad_s, run.amplitude_rad_s, run.frequency_hz)
