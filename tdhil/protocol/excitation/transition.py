"""From one speed to another without a step of acceleration, with its feed-forward torque."""

import math
from dataclasses import dataclass

from tdhil.run.excitation.reference import DriveMode, MachineLimits, PlanRefused, RigGuess

_SHORTEST_S = 2.0
_TORQUE_SHARE = 0.5   # of what the limit leaves above friction: a transition is in no hurry


@dataclass(frozen=True)
class Transition:
    """Half a cosine: v(t) = v0 + (v1 − v0)(1 − cos(π t / D)) / 2, and T = J v̇ + B v + T_c."""

    from_rad_s: float
    to_rad_s: float
    duration_s: float
    guess: RigGuess

    @property
    def peak_acceleration_rad_s2(self) -> float:
        return math.pi * abs(self.to_rad_s - self.from_rad_s) / (2.0 * self.duration_s)

    def reference(self, t_s: float) -> tuple[float, float]:
        """Speed (rad/s) and feed-forward torque (N·m), ``t_s`` after its start; the end's steady values afterwards."""
        if t_s >= self.duration_s:
            return self.to_rad_s, self.guess.steady_torque_nm(self.to_rad_s)
        rate = math.pi / self.duration_s
        half = 0.5 * (self.to_rad_s - self.from_rad_s)
        t = max(t_s, 0.0)
        speed = self.from_rad_s + half * (1.0 - math.cos(rate * t))
        acceleration = half * rate * math.sin(rate * t)
        return speed, self.guess.inertia_kg_m2 * acceleration + self.guess.steady_torque_nm(speed)


def make_transition(
    from_rad_s: float, to_rad_s: float, limits: MachineLimits, guess: RigGuess, mode: DriveMode = "torque"
) -> Transition:
    """The quickest calm transition: at most half of the torque that friction leaves, and never under 2 s.

    Raises PlanRefused if friction alone takes the torque.
    """
    friction = max(abs(guess.steady_torque_nm(from_rad_s)), abs(guess.steady_torque_nm(to_rad_s)))
    room = _TORQUE_SHARE * (limits.usable_torque_nm - friction) / guess.torque_swing_factor(mode)
    if room <= 0.0:
        raise PlanRefused(
            f"torque limit: friction takes {friction:g} N·m of the {limits.usable_torque_nm:g} N·m that a plan may use"
        )
    needed = math.pi * abs(to_rad_s - from_rad_s) * guess.inertia_kg_m2 / (2.0 * room)
    if mode == "speed":
        needed = max(needed, math.pi * abs(to_rad_s - from_rad_s) / (2.0 * limits.acceleration_rad_s2))
    return Transition(from_rad_s, to_rad_s, max(_SHORTEST_S, needed), guess)
