"""A periodic motion before it is scaled: lines with relative amplitudes and phases, and the peaks they add up to."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tdhil.run.excitation.speed_loop import Following

_GRID = 1024


@dataclass(frozen=True)
class Shape:
    """Deviation of speed from its mean, per unit: sum of amplitude·cos(2π harmonic t / period + phase).

    Scaled so that its greatest deviation from the mean is 1; ``harmonics`` count whole cycles per period.
    """

    harmonics: tuple[int, ...]
    amplitudes: tuple[float, ...]
    phases_rad: tuple[float, ...]

    def deviation(self, phase_rad: float = 0.0) -> NDArray[np.float64]:
        """(1024,) deviation over one period; every line turned on by ``phase_rad`` of its own argument."""
        return self._wave(np.asarray(self.amplitudes, dtype=np.complex128), phase_rad)

    def foreseen_deviation(self, period_s: float, foresight_s: float) -> NDArray[np.float64]:
        """(1024,) deviation + foresight·its rate over one period: Re Σ (1 + jω_k t_f) a_k e^(j(ω_k t + φ_k))."""
        omega = 2.0 * np.pi * np.asarray(self.harmonics, dtype=np.float64) / period_s
        return self._wave((1.0 + 1j * omega * foresight_s) * np.asarray(self.amplitudes), 0.0)

    def torque_deviation(self, period_s: float, inertia_kg_m2: float, viscous_nm_s_rad: float) -> NDArray[np.float64]:
        """(1024,) torque over one period, N·m per rad/s of peak speed: Re Σ (J jω_k + B) a_k e^(j(ω_k t + φ_k))."""
        omega = 2.0 * np.pi * np.asarray(self.harmonics, dtype=np.float64) / period_s
        return self._wave((viscous_nm_s_rad + 1j * omega * inertia_kg_m2) * np.asarray(self.amplitudes), 0.0)

    def followed(self, period_s: float, following: Following) -> "Shape":
        """What the shaft makes of it, as a setpoint under the drive's speed control."""
        gains = following.shaft(np.asarray(self.harmonics, dtype=np.float64) / period_s)
        return Shape(
            self.harmonics,
            tuple(float(a) for a in np.asarray(self.amplitudes) * np.abs(gains)),
            tuple(float(phase) for phase in np.asarray(self.phases_rad) + np.angle(gains)),
        )

    def steepness(self, period_s: float) -> NDArray[np.float64]:
        """(1024,) acceleration over one period, 1/s: rad/s² per rad/s of peak speed."""
        return self.torque_deviation(period_s, 1.0, 0.0)

    def shifted(self, share: float) -> "Shape":
        """The same motion begun ``share`` of a period later."""
        turned = tuple(
            float((phase + 2.0 * np.pi * harmonic * share) % (2.0 * np.pi))
            for harmonic, phase in zip(self.harmonics, self.phases_rad, strict=True)
        )
        return Shape(self.harmonics, self.amplitudes, turned)

    def _wave(self, weights: NDArray[np.complex128], phase_rad: float) -> NDArray[np.float64]:
        turns = 2.0 * np.pi * np.arange(_GRID) / _GRID
        arguments = np.outer(turns, self.harmonics) + np.asarray(self.phases_rad) + phase_rad
        wave: NDArray[np.float64] = (np.exp(1j * arguments) @ weights).real
        return wave


def unit_peak(shape: Shape) -> Shape:
    """The shape scaled so that its greatest deviation is 1."""
    peak = float(np.max(np.abs(shape.deviation())))
    return Shape(shape.harmonics, tuple(a / peak for a in shape.amplitudes), shape.phases_rad)


def begun_at_rest(shape: Shape, period_s: float, inertia_kg_m2: float, viscous_nm_s_rad: float) -> Shape:
    """The same motion begun where its torque passes its mean.

    A ramp that ends there without acceleration hands over without a step of torque: next to nothing has to settle.
    """
    torque = shape.torque_deviation(period_s, inertia_kg_m2, viscous_nm_s_rad)
    start = int(np.argmin(np.abs(torque)))
    return shape.shifted(start / _GRID)
