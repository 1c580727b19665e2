"""What a bend of friction does at the lines: the speed's true wave over a period, through the bend, and its lines.

The lines of the reported speed, W_k, divided by its report's filter, are those of the shaft's speed,

    ω(t) = ω̄ + Re Σ_k W_k/F_w(s_k) e^(jω_k t),

which keeps repeating with the segment's period. Friction follows it at once, so that c g(ω(t)) has the lines

    G_k = 2/N Σ_n g(ω(t_n)) e^(−jω_k t_n)    and the mean    ḡ,

and the drive reports them through the torque's filter: T_k = F_T (J s + B) W_k/F_w + c F_T G_k. Only F_T/F_w can be
seen in the first term; the second is a correction, for which the filters that fit are good enough.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tdhil.estimation.frequency_domain import signal_filters
from tdhil.estimation.frequency_domain.spectrum import ComplexArray, PeriodLines
from tdhil.identify.bent.bends import Bend
from tdhil.recording.recording import FloatArray, Segment

_POINTS = 16      # to a cycle of the fastest line


@dataclass(frozen=True)
class Wave:
    """One segment: ``lines_hz`` (K,) rising or not, ``speed`` (K,) complex as reported, its mean, and its period."""

    lines_hz: tuple[float, ...]
    speed: ComplexArray
    mean: float
    period_s: float

    @cached_property
    def _s(self) -> ComplexArray:
        """(K,)."""
        return 2j * math.pi * np.asarray(self.lines_hz)

    @cached_property
    def _turned(self) -> ComplexArray:
        """e^(jω_k t_n), (N, K): each line makes a whole number of turns in a period."""
        turns = np.round(np.asarray(self.lines_hz) * self.period_s)
        count = _POINTS * int(max(turns.max(), 1.0))
        turned: ComplexArray = np.exp(2j * math.pi / count * np.multiply.outer(np.arange(count), turns))
        return turned

    def over_period(self, phi: FloatArray) -> FloatArray:
        """The shaft's own speed behind the report ``phi`` (6,) (`reports`), (N,) rad/s."""
        found: FloatArray = self.mean + (self._turned @ (self.speed / signal_filters.filters(phi, self._s)[0])).real
        return found

    def through(self, bend: Bend, phi: FloatArray) -> tuple[ComplexArray, float]:
        """F_T G (K,) and ḡ."""
        torque = bend.over(self.over_period(phi))
        lines = torque @ self._turned.conj() * (2.0 / len(torque))
        return signal_filters.filters(phi, self._s)[1] * lines, float(torque.mean())


def wave_of(fit: PeriodLines, segment: Segment) -> Wave:
    """Of all its periods together."""
    return Wave(fit.lines_hz, fit.speed.mean(axis=0), float(fit.speed_mean.mean()), segment.period_s)
