"""What an excitation must stay within, and what is known of the rig when it is planned."""

import math
from dataclasses import dataclass
from typing import Literal

from tdhil.run.excitation.speed_loop import Following

DriveMode = Literal["torque", "speed"]

TORQUE_RESERVE = 0.15   # share of the torque limit that a plan leaves to the speed control
SPEED_MARGIN = 0.03     # share of the speed window kept free at either end, for what drifts


USUAL_STEP = "Change --amplitude, --offset, --frequency or the limits"


class PlanRefused(ValueError):
    """The wished motion doesn't fit; the message names the limit, what was needed, and what there is.

    ``next_step``: which option would change that.
    """

    def __init__(self, what: str, next_step: str = USUAL_STEP) -> None:
        super().__init__(what)
        self.next_step = next_step


@dataclass(frozen=True)
class MachineLimits:
    """The window that the shaft must not leave, rad/s, and the greatest torque either way, N·m.

    ``foresight_s``: in torque mode the guard holds speed + foresight·acceleration below the window's upper end, since
    what is reported is old; the plan must keep that free too. ``acceleration_rad_s2``: what the drive's own speed ramp
    lets through, where it was seen to hold the shaft back (speed mode only).
    """

    speed_low_rad_s: float
    speed_high_rad_s: float
    torque_limit_nm: float
    foresight_s: float = 0.0
    acceleration_rad_s2: float = math.inf

    def __post_init__(self) -> None:
        values = (self.speed_low_rad_s, self.speed_high_rad_s, self.torque_limit_nm)
        if not all(math.isfinite(value) for value in values):
            raise PlanRefused("speed window and torque limit must be finite numbers")
        if self.speed_low_rad_s >= self.speed_high_rad_s:
            raise PlanRefused(
                f"speed window is empty: {self.speed_low_rad_s:g} to {self.speed_high_rad_s:g} rad/s"
            )
        if self.torque_limit_nm <= 0.0:
            raise PlanRefused(f"torque limit must be positive, not {self.torque_limit_nm:g} N·m")

    @property
    def width_rad_s(self) -> float:
        return self.speed_high_rad_s - self.speed_low_rad_s

    @property
    def usable_low_rad_s(self) -> float:
        return self.speed_low_rad_s + SPEED_MARGIN * self.width_rad_s

    @property
    def usable_high_rad_s(self) -> float:
        return self.speed_high_rad_s - SPEED_MARGIN * self.width_rad_s

    @property
    def usable_torque_nm(self) -> float:
        return (1.0 - TORQUE_RESERVE) * self.torque_limit_nm


@dataclass(frozen=True)
class RigGuess:
    """A rough rig: T = inertia·dω/dt + viscous·ω + coulomb, forward rotation.

    ``inertia_rel_error`` is how wrong the inertia may be (0.2 = a fifth either way); the plan keeps room for it.
    ``following``: how the shaft follows a speed setpoint, where that was seen.
    """

    inertia_kg_m2: float
    viscous_nm_s_rad: float = 0.0
    coulomb_nm: float = 0.0
    inertia_rel_error: float = 0.2
    following: Following | None = None

    def __post_init__(self) -> None:
        if not (math.isfinite(self.inertia_kg_m2) and self.inertia_kg_m2 > 0.0):
            raise PlanRefused(f"rough inertia must be positive, not {self.inertia_kg_m2:g} kg·m²")
        if not (math.isfinite(self.viscous_nm_s_rad) and math.isfinite(self.coulomb_nm)):
            raise PlanRefused("rough friction must be finite")
        if not 0.0 <= self.inertia_rel_error < 0.9:
            raise PlanRefused(f"relative error of the rough inertia must be in [0, 0.9): {self.inertia_rel_error:g}")

    def steady_torque_nm(self, speed_rad_s: float) -> float:
        """Torque that holds a steady speed, N·m."""
        return self.coulomb_nm + self.viscous_nm_s_rad * speed_rad_s

    def speed_swing_factor(self, mode: DriveMode) -> float:
        """Real swing of speed over the planned one, at worst: in torque mode a lighter shaft swings further."""
        return 1.0 / (1.0 - self.inertia_rel_error) if mode == "torque" else 1.05

    def torque_swing_factor(self, mode: DriveMode) -> float:
        """Real swing of torque over the planned one, at worst: in speed mode a heavier shaft needs more."""
        return 1.0 if mode == "torque" else 1.0 / (1.0 - self.inertia_rel_error)
