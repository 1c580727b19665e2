"""Limits of an excitation, rough rig for its plan, and references of speed and torque."""

import math
from dataclasses import dataclass, field
from typing import Literal

from tdhil.config import EXCITATIONS, load
from tdhil.runner.excitation.speed_loop import SpeedFollowing

DriveMode = Literal["torque", "speed"]

TORQUE_RESERVE = 0.15   # share of the torque limit that a plan leaves to the speed control
SPEED_MARGIN = 0.03     # share of the speed window that a plan keeps free at either end, for drift


USUAL_STEP = "Change --amplitude, --offset, --frequency or the limits"


class PlanRefused(ValueError):
    """The requested motion does not fit. The message names the limit, the required and the available value.

    ``next_step``: advice which option to change.
    """

    def __init__(self, what: str, next_step: str = USUAL_STEP) -> None:
        super().__init__(what)
        self.next_step = next_step


@dataclass(frozen=True)
class ExcitationKind:
    """Properties of an excitation before it is planned; `tdhil.config.registry` lists them by name.

    There are two families: `PeriodicKind` has spectral lines, `SpeedChangeKind` goes from one steady speed to another.
    ``needs_torque_mode``: it is not possible under the drive's speed control; ``why_torque_mode`` is the reason.
    ``with_string``: it is permitted with a drill string on the shaft.
    """

    needs_torque_mode: bool = False
    why_torque_mode: str = ""
    with_string: bool = True

    @property
    def adaptive(self) -> bool:
        """Return whether a tolerance can end the excitation, by the scatter from period to period."""
        return False


def excitation_kind(name: str) -> ExcitationKind:
    """Return the kind of that name. Raises PlanRefused if there is none."""
    if name not in EXCITATIONS:
        raise PlanRefused(f"unknown excitation {name!r}; choose one of {', '.join(EXCITATIONS)}")
    found: ExcitationKind = load(EXCITATIONS, name)
    return found


@dataclass(frozen=True)
class MotionLimits:
    """Limits of a planned motion: the window that the shaft must not leave, rad/s, and the largest torque, N·m.

    The machine's own limits, which the guard enforces, are `tdhil.runner.settings.MachineLimits`.

    ``foresight_s``: prediction time of the guard. In torque mode it keeps speed + foresight·acceleration below the
    window's upper end, because reports are late; the plan keeps this free. ``acceleration_rad_s2``: limit of the
    drive's own speed ramp, if stage 2 has shown one (speed mode only). ``least_torque_nm``: least torque in torque
    mode, if braking torque is not available.
    """

    speed_low_rad_s: float
    speed_high_rad_s: float
    torque_limit_nm: float
    foresight_s: float = 0.0
    acceleration_rad_s2: float = math.inf
    least_torque_nm: float = -math.inf

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


SAME_RIG = 0.5
"""Permitted difference of the rough inertia from an identified one, unless the uncertainty is larger."""


@dataclass(frozen=True)
class RigGuess:
    """Rough model of the rig: T = inertia·dω/dt + viscous·ω + coulomb, forward rotation.

    ``inertia_rel_error``: possible error of the inertia as a share (0.2 = ±20 %); the plan keeps room for it.
    ``following``: response of the shaft to a speed setpoint; None: unknown.
    """

    inertia_kg_m2: float
    viscous_nm_s_rad: float = 0.0
    coulomb_nm: float = 0.0
    inertia_rel_error: float = 0.2
    following: SpeedFollowing | None = None

    def __post_init__(self) -> None:
        if not (math.isfinite(self.inertia_kg_m2) and self.inertia_kg_m2 > 0.0):
            raise PlanRefused(f"rough inertia must be positive, not {self.inertia_kg_m2:g} kg·m²")
        if not (math.isfinite(self.viscous_nm_s_rad) and math.isfinite(self.coulomb_nm)):
            raise PlanRefused("rough friction must be finite")
        if not 0.0 <= self.inertia_rel_error < 0.9:
            raise PlanRefused(f"relative error of the rough inertia must be in [0, 0.9): {self.inertia_rel_error:g}")

    def excludes(self, inertia_kg_m2: float) -> bool:
        """Return whether this rough inertia excludes an inertia that another run identified."""
        open_by = 1.0 + max(SAME_RIG, 3.0 * self.inertia_rel_error)
        return not 1.0 / open_by <= self.inertia_kg_m2 / inertia_kg_m2 <= open_by

    def steady_torque_nm(self, speed_rad_s: float) -> float:
        """Return the torque that holds a steady speed, N·m."""
        return self.coulomb_nm + self.viscous_nm_s_rad * speed_rad_s

    def speed_swing_factor(self, mode: DriveMode) -> float:
        """Return the worst ratio of real to planned speed amplitude: in torque mode a lighter shaft moves further."""
        return 1.0 / (1.0 - self.inertia_rel_error) if mode == "torque" else 1.05

    def torque_swing_factor(self, mode: DriveMode) -> float:
        """Return the worst ratio of real to planned torque amplitude: in speed mode a heavier shaft needs more."""
        return 1.0 if mode == "torque" else 1.0 / (1.0 - self.inertia_rel_error)


# ---------------------------------------------------------------------------------------------------------------------
# Reference of one segment, evaluated once a cycle.


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
        """Return the feed-forward torque that holds the mean speed, N·m."""
        return self._mean_torque_nm

    @property
    def start_speed_rad_s(self) -> float:
        """Return the speed at t = 0, rad/s, at which a transition to the segment ends."""
        return self.reference(0.0)[0]

    def reference(self, t_s: float) -> tuple[float, float]:
        """Return speed (rad/s) and feed-forward torque (N·m), ``t_s`` seconds after the segment's start."""
        speed = self.offset_rad_s
        torque = self._mean_torque_nm
        for omega, phase, amplitude, in_phase, quadrature in self._lines:
            argument = omega * t_s + phase
            cosine = math.cos(argument)
            speed += amplitude * cosine
            torque += in_phase * cosine - quadrature * math.sin(argument)
        return speed, torque


# ---------------------------------------------------------------------------------------------------------------------
# A transition between two speeds without a step of acceleration, with its feed-forward torque.


_SHORTEST_S = 2.0         # s; shortest transition
_TORQUE_SHARE = 0.5   # share of the torque above friction that a transition uses


@dataclass(frozen=True)
class Transition:
    """Transition by half a cosine: v(t) = v0 + (v1 − v0)(1 − cos(π t / D)) / 2, and T = J v̇ + B v + T_c."""

    from_rad_s: float
    to_rad_s: float
    duration_s: float
    guess: RigGuess

    def reference(self, t_s: float) -> tuple[float, float]:
        """Return speed (rad/s) and feed-forward torque (N·m) ``t_s`` after the start; steady values after the end."""
        if t_s >= self.duration_s:
            return self.to_rad_s, self.guess.steady_torque_nm(self.to_rad_s)
        rate = math.pi / self.duration_s
        half = 0.5 * (self.to_rad_s - self.from_rad_s)
        t = max(t_s, 0.0)
        speed = self.from_rad_s + half * (1.0 - math.cos(rate * t))
        acceleration = half * rate * math.sin(rate * t)
        return speed, self.guess.inertia_kg_m2 * acceleration + self.guess.steady_torque_nm(speed)


def make_transition(
    from_rad_s: float, to_rad_s: float, limits: MotionLimits, guess: RigGuess, mode: DriveMode = "torque"
) -> Transition:
    """Return the quickest transition with at most half of the torque above friction, and of at least 2 s.

    Raises PlanRefused if friction needs the whole usable torque.
    """
    friction = max(abs(guess.steady_torque_nm(from_rad_s)), abs(guess.steady_torque_nm(to_rad_s)))
    room = _TORQUE_SHARE * (limits.usable_torque_nm - friction) / guess.torque_swing_factor(mode)
    if room <= 0.0:
        raise PlanRefused(
            f"torque limit: friction needs {friction:g} N·m of the {limits.usable_torque_nm:g} N·m that a plan may use"
        )
    needed = math.pi * abs(to_rad_s - from_rad_s) * guess.inertia_kg_m2 / (2.0 * room)
    if mode == "speed":
        needed = max(needed, math.pi * abs(to_rad_s - from_rad_s) / (2.0 * limits.acceleration_rad_s2))
    return Transition(from_rad_s, to_rad_s, max(_SHORTEST_S, needed), guess)
