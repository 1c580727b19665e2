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

import numpy as np

from tdhil.identify.bent.bends import Bend
from tdhil.identify.lines import reports
from tdhil.identify.lines.spectrum import ComplexArray, PeriodLines
from tdhil.record.recording import FloatArray, Segment

_POINTS = 16      # to a cycle of the fastest line


@dataclass(frozen=True)
class Wave:
    """One segment: ``lines_hz`` (K,) rising or not, ``speed`` (K,) complex as reported, its mean, and its period."""

    lines_hz: tuple[float, ...]
    speed: ComplexArray
    mean: float
    period_s: float

    @property
    def _turns(self) -> FloatArray:
        """Cycles of each line in a period, (K,) whole numbers."""
        return np.round(np.asarray(self.lines_hz) * self.period_s)

    def _angles(self) -> FloatArray:
        """(N, K)."""
        turns = self._turns
        count = _POINTS * int(max(turns.max(), 1.0))
        angles: FloatArray = 2.0 * math.pi / count * np.multiply.outer(np.arange(count), turns)
        return angles

    def over_period(self, phi: FloatArray) -> FloatArray:
        """The shaft's own speed behind the report ``phi`` (6,) (`reports`), (N,) rad/s."""
        s = 2j * math.pi * np.asarray(self.lines_hz)
        true = self.speed / filters(phi, s)[0]
        angles = self._angles()
        found: FloatArray = self.mean + np.cos(angles) @ true.real - np.sin(angles) @ true.imag
        return found

    def through(self, bend: Bend, phi: FloatArray) -> tuple[ComplexArray, float]:
        """F_T G (K,) and ḡ."""
        torque = bend.over(self.over_period(phi))
        angles = self._angles()
        lines = (torque @ np.cos(angles) - 1j * (torque @ np.sin(angles))) * (2.0 / len(torque))
        s = 2j * math.pi * np.asarray(self.lines_hz)
        return filters(phi, s)[1] * lines, float(torque.mean())


def wave_of(fit: PeriodLines, segment: Segment) -> Wave:
    """Of all its periods together."""
    return Wave(fit.lines_hz, fit.speed.mean(axis=0), float(fit.speed_mean.mean()), segment.period_s)


def filters(phi: FloatArray, s: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """F_w and F_T, (K,) each; ``phi`` (6,) as in `reports`, whose ratio F_T/F_w these have."""
    x, y = phi[reports.SPEED_LAG] * s, phi[reports.TORQUE_LAG] * s
    speed = 1.0 / (1.0 + x + phi[reports.SPEED_SHAPE] * x * x)
    torque = np.exp(-phi[reports.SKEW] * s) / (1.0 + y + phi[reports.TORQUE_SHAPE] * y * y)
    u = float(phi[reports.AVERAGE])
    average = np.sinc(np.abs(s) * math.sqrt(abs(u)) / (2.0 * math.pi))
    return (speed, torque * average) if u > 0.0 else (speed * average, torque)
