"""The host's slow control of the mean speed in torque mode. Pure: time and speed are handed in.

A host loop as fast as a drive's own would ring or diverge behind a reported-speed lag τ_w of 0.4 s. With the
plant 1/(J s + B), the lag 1/(1 + τ_w s) and

    T = K_p e + K_i ∫e dt        K_p = J ω_b,  K_i = K_p ω_b / 4,  ω_b = 0.2 / τ_w

the crossing is at about ω_b, where the lag costs atan(0.2) = 11° and the integral atan(1/4) = 14°: some 65° of
phase are left, and 45° if the lag is four times what was assumed.
"""

from tdhil.run.excitation import RigGuess
from tdhil.run.settings import ControlAssumptions


class MeanSpeedControl:
    """PI with clamping anti-windup; the torque it may add is bounded by ``authority_nm``."""

    def __init__(self, model: RigGuess, authority_nm: float, assumptions: ControlAssumptions) -> None:
        bandwidth_rad_s = 0.2 / assumptions.largest_speed_lag_s
        self._kp = model.inertia_kg_m2 * bandwidth_rad_s
        self._ki = self._kp * bandwidth_rad_s / 4.0
        self._authority_nm = authority_nm
        self._integral_nm = 0.0

    def update(self, error_rad_s: float, dt_s: float) -> float:
        """Torque to add, N·m, for the speed error (wanted minus reported) of this cycle."""
        integral = self._integral_nm + self._ki * error_rad_s * dt_s
        torque = self._kp * error_rad_s + integral
        if abs(torque) > self._authority_nm:
            torque = self._authority_nm if torque > 0.0 else -self._authority_nm
            # Held while at the bound, unless the error leads away from it.
            if (error_rad_s > 0.0) == (torque > 0.0):
                return torque
        self._integral_nm = integral
        return torque
