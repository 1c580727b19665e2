"""Torque pulses and coast-down: changes from one speed to another and back, with steady speed between them.

A pulse is a step of net torque, ΔT for some seconds, up or down. Between two pulses the shaft is held at a steady
speed, so the momentum balance from one steady speed to the next needs no knowledge of any lag. Changes of full height
alternate with half ones, and strong pulses with weaker ones, which spreads their information over frequency.

Coast-down switches the torque off at the upper speed, and friction brings the shaft to the lower one. Of J, B and T_c,
J dω/dt = −B ω − T_c gives only the ratios: with all three multiplied by a factor, the shaft coasts in the same way. The
torque of a powered ramp up determines J, so every coast is paired with a ramp, and the ramps differ in steepness.

For any error of the rough inertia within its stated one, the speed stays within the window. In torque mode this
includes the speed that the guard predicts (`Guard.foresight_s`) while the torque acts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

from tdhil.runner.excitation.reference import (
    DriveMode,
    ExcitationKind,
    MotionLimits,
    PlanRefused,
    RigGuess,
    excitation_kind,
)

CALM_S = 3.5              # s; steady time at every speed: the momentum balance needs 2 s or more after the lags
TOTAL_S = 210.0           # s; about the duration of the usual multisine
_LEAST_CHANGES = 6         # least number of speed changes
_MOST_S = 12.0            # s; longest speed change, for a heavy shaft
_LEAST_S = 0.5            # s; shortest speed change
_SHARES = (1.0, 0.6)      # shares of the steepest change: pulses of two strengths
_HEIGHTS = (0.0, 1.0, 0.5, 1.0)     # steady speeds in turn, from 0 (the lowest) to 1 (the highest)
_TOPS = (1.0, 0.6, 0.8)             # upper speeds of the coasts in turn; equal ones would excite few frequencies
_SLACK = 1.1              # margin on the prediction of the guard, because reports are noisy
_TORQUE_SHARE = 0.9       # share of the torque between friction and limit


@dataclass(frozen=True)
class SpeedChange:
    """Change from one steady speed to the next in ``duration_s``, which is approximate if ``coasting`` (no torque)."""

    from_rad_s: float
    to_rad_s: float
    duration_s: float
    guess: RigGuess
    coasting: bool = False

    @property
    def acceleration_rad_s2(self) -> float:
        return (self.to_rad_s - self.from_rad_s) / self.duration_s

    def reference(self, t_s: float) -> tuple[float, float]:
        """Return speed (rad/s) and feed-forward torque (N·m) ``t_s`` after the start; steady values after the end."""
        if t_s >= self.duration_s:
            return self.to_rad_s, self.guess.steady_torque_nm(self.to_rad_s)
        rate = self.acceleration_rad_s2
        speed = self.from_rad_s + rate * max(t_s, 0.0)
        return speed, self.guess.steady_torque_nm(speed) + self.guess.inertia_kg_m2 * rate


@dataclass(frozen=True)
class SpeedChangeKind(ExcitationKind):
    """Excitation by changes from one steady speed to another.

    ``ways``: yields changes without end, from the lowest and the highest speed, rad/s, the largest acceleration of a
    powered change, rad/s², and the rough rig. The first change begins at the lowest speed.
    """

    ways: Callable[[float, float, float, RigGuess], Iterator[SpeedChange]] = field(kw_only=True)


@dataclass(frozen=True)
class SpeedChangePlan:
    """Motion of stage 5: steady speed ``start_rad_s``, then every speed change with `CALM_S` of steady speed."""

    kind: str
    mode: DriveMode
    start_rad_s: float
    ways: tuple[SpeedChange, ...]
    speed_min_rad_s: float
    speed_max_rad_s: float
    torque_min_nm: float
    torque_max_nm: float
    limits: MotionLimits
    guess: RigGuess

    @property
    def duration_s(self) -> float:
        return CALM_S + sum(way.duration_s + CALM_S for way in self.ways)

    def plain(self) -> dict[str, Any]:
        """Return its motion as plain data."""
        return {
            "segments": [],
            "ways": [
                {"from_rad_s": way.from_rad_s, "to_rad_s": way.to_rad_s, "duration_s": way.duration_s,
                 "coasting": way.coasting}
                for way in self.ways
            ],
        }

    def parts(self) -> list[tuple[str, str]]:
        """Return (place, text) for display."""
        ways = f"{len(self.ways)} ways up and down, each with {CALM_S:g} s of calm behind it"
        return [(f"{self.speed_min_rad_s:.3g} to {self.speed_max_rad_s:.3g} rad/s", ways)]

    def lines(self) -> list[tuple[float, float]]:
        """Return an empty list: the motion has no spectral lines."""
        return []


def plan_speed_changes(
    kind: str,
    limits: MotionLimits,
    guess: RigGuess,
    mode: DriveMode,
    amplitude_rad_s: float | None = None,
    offset_rad_s: float | None = None,
    swings: int | None = None,
    time_s: float | None = None,
) -> SpeedChangePlan:
    """Return a plan of ``swings`` speed changes, or of as many as fit into ``time_s``. Raises PlanRefused.

    ``amplitude_rad_s``: half of the difference between the upper and the lower speed; ``offset_rad_s``: their mean.
    """
    asked = speed_change_kind(kind)
    if asked.needs_torque_mode and mode != "torque":
        raise PlanRefused(f"{kind} needs a drive in torque mode: {asked.why_torque_mode}")
    room = _SpeedRoom(limits, guess, mode)
    low, high, rate = room.swing(amplitude_rad_s, offset_rad_s)
    endless = asked.ways(low, high, rate, guess)
    total = TOTAL_S if time_s is None else time_s
    if swings is not None:
        ways = list(islice(endless, swings))
    else:
        ways, taken = [], CALM_S
        for way in endless:
            taken += way.duration_s + CALM_S
            if taken > total and (len(ways) >= _LEAST_CHANGES or time_s is not None):
                break
            ways.append(way)
    if len(ways) < _LEAST_CHANGES:
        needed = CALM_S + sum(way.duration_s + CALM_S for way in islice(_again(ways, endless), _LEAST_CHANGES))
        raise PlanRefused(
            f"time: {len(ways)} ways up and down are too few to identify the inertia, {_LEAST_CHANGES} take "
            f"{needed:.0f} s",
            f"Give --max-time {math.ceil(needed)}s or more, --periods {_LEAST_CHANGES} or more, or remove both",
        )
    torques = [torque for way in ways if not way.coasting for torque in (way.reference(0.0)[1],
               way.reference(0.999999 * way.duration_s)[1])]
    lowest = min(torques) if all(not way.coasting for way in ways) else min(0.0, *torques)
    return SpeedChangePlan(kind, mode, low, tuple(ways), low, high, lowest, max(torques), limits, guess)


def speed_change_kind(name: str) -> SpeedChangeKind:
    """Return the kind of that name with changes of speed. Raises PlanRefused if it is not one."""
    kind = excitation_kind(name)
    if not isinstance(kind, SpeedChangeKind):
        raise PlanRefused(f"{name} is a periodic excitation")
    return kind


def _again(ways: list[SpeedChange], rest: Iterator[SpeedChange]) -> Iterator[SpeedChange]:
    yield from ways
    yield from rest


def _pulses(low: float, high: float, rate: float, guess: RigGuess) -> Iterator[SpeedChange]:
    """Yield changes up and down between the steady speeds; the strength differs from round to round."""
    at, number = low, 0
    while True:
        number += 1
        to = low + _HEIGHTS[number % len(_HEIGHTS)] * (high - low)
        share = _SHARES[(number // len(_HEIGHTS)) % len(_SHARES)]
        yield SpeedChange(at, to, max(_LEAST_S, abs(to - at) / (share * rate)), guess)
        at = to


def _coasts(low: float, high: float, rate: float, guess: RigGuess) -> Iterator[SpeedChange]:
    """Yield powered changes up, of different steepness, and coasts down without torque, in turn."""
    number = 0
    while True:
        share = _SHARES[number % len(_SHARES)]
        top = low + _TOPS[number % len(_TOPS)] * (high - low)
        yield SpeedChange(low, top, max(_LEAST_S, (top - low) / (share * rate)), guess)
        yield SpeedChange(top, low, coasting_s(top, low, guess), guess, coasting=True)
        number += 1


def coasting_s(from_rad_s: float, to_rad_s: float, guess: RigGuess) -> float:
    """Return the time of a coast to a lower speed, s: (J/B) ln(T(ω₀)/T(ω₁)), or (J/T_c) Δω for B → 0.

    Raises PlanRefused if there is almost no friction.
    """
    upper, lower = guess.steady_torque_nm(from_rad_s), guess.steady_torque_nm(to_rad_s)
    if not (lower > 0.0 and upper > 0.0):
        raise PlanRefused("coast-down: the friction is too low to slow the shaft down; use --excitation pulses")
    mean = upper if math.isclose(upper, lower, rel_tol=1e-9) else (upper - lower) / math.log(upper / lower)
    return guess.inertia_kg_m2 * (from_rad_s - to_rad_s) / mean


PULSES = SpeedChangeKind(ways=_pulses)
COAST_DOWN = SpeedChangeKind(
    ways=_coasts,
    needs_torque_mode=True,
    why_torque_mode="a shaft under speed control never coasts",
    with_string=False,
)


class _SpeedRoom:
    """Lower and upper speed, and the largest acceleration between them, within the limits."""

    def __init__(self, limits: MotionLimits, guess: RigGuess, mode: DriveMode) -> None:
        self._limits, self._guess = limits, guess
        # In the worst case the shaft is lighter than estimated, and a change goes further by this share.
        self._beyond = guess.speed_swing_factor(mode) - 1.0
        self._torque_factor = guess.torque_swing_factor(mode)
        self._foresight_s = limits.foresight_s if mode == "torque" else 0.0

    def swing(self, amplitude_rad_s: float | None, offset_rad_s: float | None) -> tuple[float, float, float]:
        low, high = self._limits.usable_low_rad_s, self._limits.usable_high_rad_s
        friction = self._guess.steady_torque_nm(high)
        torque = _TORQUE_SHARE * (self._limits.usable_torque_nm - max(friction, 0.0)) / self._torque_factor
        if torque <= 0.0:
            raise PlanRefused(
                f"torque limit: steady friction leaves nothing of the {self._limits.usable_torque_nm:g} N·m "
                "that a plan may use"
            )
        rate = min(torque / self._guess.inertia_kg_m2, 0.9 * self._limits.acceleration_rad_s2)
        # The prediction of the guard may take a fifth of the window at either end. A lighter shaft gets less torque.
        rate = min(rate, (high - low) / 5.0 / self._foresight_s) if self._foresight_s > 0.0 else rate
        ahead = _SLACK * rate * self._foresight_s
        largest = (high - low - 2.0 * ahead) / (1.0 + 2.0 * self._beyond)
        span = largest if amplitude_rad_s is None else 2.0 * amplitude_rad_s
        if not (math.isfinite(span) and span > 0.0):
            raise PlanRefused(f"amplitude must be positive, not {0.5 * span:g} rad/s")
        span = min(span, _MOST_S * rate) if amplitude_rad_s is None else span
        least, most = low + ahead + span * self._beyond, high - ahead - span * (1.0 + self._beyond)
        if least > most * (1.0 + 1e-9) + 1e-9:
            raise PlanRefused(
                f"speed window: an amplitude of {0.5 * span:g} rad/s does not fit; {0.5 * largest:.3g} rad/s would fit"
            )
        bottom = least if offset_rad_s is None else offset_rad_s - 0.5 * span
        if not least - 1e-9 <= bottom <= most + 1e-9:
            raise PlanRefused(
                f"speed window: changes of {0.5 * span:.3g} rad/s about {offset_rad_s:g} rad/s do not fit; "
                f"about {least + 0.5 * span:.3g} to {most + 0.5 * span:.3g} rad/s they would fit"
            )
        return bottom, bottom + span, rate
