"""The reference of one segment, evaluated once a cycle."""

import math
from dataclasses import dataclass, field

from tdhil.run.excitation.reference import RigGuess


@dataclass(frozen=True)
class PeriodicReference:
    """Speed and feed-forward torque about one mean speed, from the segment's start.

    speed(t)  = offset + Σ a_k cos(ω_k t + φ_k)
    torque(t) = T_c + B·offset + Re Σ (J jω_k + B) a_k e^(j(ω_k t + φ_k))
              = T_c + B·offset + Σ (B a_k cos(ω_k t + φ_k) − J ω_k a_k sin(ω_k t + φ_k))
    """

    offset_rad_s: float
    period_s: float
    lines_hz: tuple[float, ...]
    amplitudes_rad_s: tuple[float, ...]
    phases_rad: tuple[float, ...]
    guess: RigGuess
    _lines: tuple[tuple[float, float, float, float, float], ...] = field(init=False, repr=False, compare=False)
    _mean_torque_nm: float = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        lines = []
        for hertz, amplitude, phase in zip(self.lines_hz, self.amplitudes_rad_s, self.phases_rad, strict=True):
            omega = 2.0 * math.pi * hertz
            lines.append(
                (
                    omega,
                    phase,
                    amplitude,
                    self.guess.viscous_nm_s_rad * amplitude,
                    self.guess.inertia_kg_m2 * omega * amplitude,
                )
            )
        object.__setattr__(self, "_lines", tuple(lines))
        object.__setattr__(self, "_mean_torque_nm", self.guess.steady_torque_nm(self.offset_rad_s))

    @property
    def mean_torque_nm(self) -> float:
        """Feed-forward torque that holds the mean speed, N·m."""
        return self._mean_torque_nm

    @property
    def start_speed_rad_s(self) -> float:
        """Speed at t = 0, where a transition must have brought the shaft."""
        return self.reference(0.0)[0]

    def reference(self, t_s: float) -> tuple[float, float]:
        """Speed (rad/s) and feed-forward torque (N·m), ``t_s`` seconds after the segment's start."""
        speed = self.offset_rad_s
        torque = self._mean_torque_nm
        for omega, phase, amplitude, in_phase, quadrature in self._lines:
            argument = omega * t_s + phase
            cosine = math.cos(argument)
            speed += amplitude * cosine
            torque += in_phase * cosine - quadrature * math.sin(argument)
        return speed, torque
