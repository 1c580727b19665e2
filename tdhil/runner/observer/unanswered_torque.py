"""Reported speeds that do not answer the torque, where the balance of momentum bounds too little. Pure.

Each rule takes every point of the run and returns what it finds. Above a drill string the load is not known, so these
rules ask for more than a balance: a torque at its limit, a speed that stays the same, a shaft that does not yield.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Protocol

from drivers import Command, Mode
from tdhil.runner.observer.contradiction import Contradiction, Signal
from tdhil.runner.observer.points import Point
from tdhil.runner.observer.shaft_bounds import ShaftBounds
from tdhil.runner.settings import MachineLimits

AT_LIMIT_SHARE = 0.9
"""Share of the torque limit from which on the torque counts as being at it."""

HELD_S = 1.5
"""A shaft that moved before and is reported to stand still for so long, in spite of a speed setpoint and a torque at
its limit, is held or not seen."""

STRAINED_S, STRAINED_SHARE = 5.0, 0.1
"""Time for which the torque may stay at its limit while the reported speed is within this share of the speed limit of
the commanded one. A speed control that has its speed needs no such torque."""

FLAT_S, FLAT_LIMIT_S, FLAT_LAGS = 1.0, 1.5, 3.0
"""A reported speed that stays within its own noise is lost in two cases. In torque mode the commanded torque should
have moved it for the first time, s, beyond so many lags. Or the torque stands at its limit for the second time, s:
nothing controls the speed then, and only a load that equals the limit to the last newton metre would keep it."""

FLAT_MOVES = 12.0
"""How many times its noise a speed must have been moved, by the bounds of J and of the string's impedance. A string
that swings keeps a healthy speed within its noise against 5.6 times that (`benchmarks/healthy_runs.py`)."""

YIELD_S, SMOOTH_S = 4.0, 0.4
"""Time over which the stop commands a yield, and length of the means that are compared, s."""

YIELD_MOVES, YIELD_STILL = 3.0, 1.0
"""Least commanded speed, as multiples of the noise of the reported one and of the speed of standstill."""

YIELD_LEFT, YIELD_STANDS = 0.05, 0.25
"""A shaft with trapped torque follows a commanded yield, since the string pulls it. It does not follow if the reported
speed stays within the first share of the range of the commanded speed, and below the second share of its mean."""

YIELD_HELD = 1.5
"""Static friction T_s holds a shaft while the torque stays within a range of 2 T_s. The torque that first moved the
shaft is T_s and what its ramp added meanwhile. A shaft may stand within this multiple of that torque."""

STANDSTILLS = 4.0
"""A speed of so many times the speed of standstill is clearly not zero."""


@dataclass(frozen=True, slots=True)
class PointInRun:
    """A point with what the run knows at it. ``points``: the latest ones, with this one at the end."""

    point: Point
    command: Command
    block_s: float
    points: deque[Point]
    bounds: ShaftBounds
    noise_rad_s: float                 # of the point's speed
    moved: bool                        # the shaft was reported to move before
    stopping: bool                     # a quick stop was requested


class UnansweredTorque(Protocol):
    """A rule: `see` takes each point and returns what does not fit, if so."""

    def see(self, now: PointInRun) -> Contradiction | None:
        """Take one point."""
        ...


def rules(limits: MachineLimits, still_rad_s: float, lag_s: float, point_s: float) -> tuple[UnansweredTorque, ...]:
    """Return the rules for a shaft with these limits; ``still_rad_s``: the speed of standstill, rad/s."""
    always: tuple[UnansweredTorque, ...] = (HeldShaft(limits, still_rad_s),)
    if not limits.winds_up:
        return always
    return (
        TorqueAtLimit(limits, still_rad_s), FlatSpeed(limits, still_rad_s, lag_s),
        IgnoredYield(still_rad_s, lag_s, point_s), *always,
    )


def _strained(point: Point, limits: MachineLimits) -> bool:
    return abs(point.torque) >= AT_LIMIT_SHARE * limits.torque_nm


class HeldShaft:
    """Standstill is reported in spite of a speed setpoint and all the torque there is, of a shaft that moved."""

    def __init__(self, limits: MachineLimits, still_rad_s: float) -> None:
        self._limits = limits
        self._still_rad_s = still_rad_s
        self._held_s = 0.0

    def see(self, now: PointInRun) -> Contradiction | None:
        """Take one point."""
        point, command = now.point, now.command
        asked = command.mode is Mode.SPEED and abs(command.speed_rad_s) > STANDSTILLS * self._still_rad_s
        held = now.moved and asked and _strained(point, self._limits) and abs(point.speed) <= self._still_rad_s
        self._held_s = self._held_s + now.block_s if held else 0.0
        if self._held_s < HELD_S:
            return None
        return Contradiction(
            frozenset({Signal.SPEED}),
            f"the drive reports standstill for {self._held_s:.1f} s while {point.torque:.0f} N·m, its torque limit,"
            f" act and {command.speed_rad_s:.2f} rad/s are commanded",
            "Is the shaft held (brake, stuck pipe), or is the speed signal lost? Look at the shaft", point.time_s,
        )


class TorqueAtLimit:
    """A torque at its limit although the reported speed is the commanded one; for the time before J is known."""

    def __init__(self, limits: MachineLimits, still_rad_s: float) -> None:
        self._limits = limits
        self._still_rad_s = still_rad_s
        self._strained_s = 0.0

    def see(self, now: PointInRun) -> Contradiction | None:
        """Take one point."""
        point, command = now.point, now.command
        apart = abs(point.speed - command.speed_rad_s)
        near = command.mode is Mode.SPEED and apart <= STRAINED_SHARE * self._limits.speed_max_rad_s
        turns = abs(point.speed) > STANDSTILLS * self._still_rad_s
        strained = _strained(point, self._limits) and near and turns and not now.bounds.known    # else (1) shows it
        self._strained_s = self._strained_s + now.block_s if strained else 0.0
        if self._strained_s < STRAINED_S:
            return None
        return Contradiction(
            frozenset({Signal.SPEED, Signal.TORQUE}),
            f"the torque has been at its limit for {STRAINED_S:g} s ({point.torque:.0f} N·m) while the reported speed"
            f" stays at {point.speed:.2f} rad/s, near the commanded {command.speed_rad_s:.2f} rad/s",
            "Check the encoder and its cable. Is the load as large as the torque limit?", point.time_s,
        )


class FlatSpeed:
    """A reported speed that stays within its noise while torque should have moved it."""

    def __init__(self, limits: MachineLimits, still_rad_s: float, lag_s: float) -> None:
        self._limits = limits
        self._still_rad_s = still_rad_s
        self._lag_s = lag_s
        self._since_s: float | None = None
        self._low = self._high = self._least = self._most = self._began = self._moved = self._seen_s = 0.0
        self._strained_s = 0.0

    def see(self, now: PointInRun) -> Contradiction | None:
        """Take one point."""
        point = now.point
        for_s = self._unanswered_s(now)
        if for_s <= 0.0 or abs(point.speed) <= STANDSTILLS * self._still_rad_s:
            return None
        return Contradiction(
            frozenset({Signal.SPEED}),
            f"the reported speed has stayed at {point.speed:.2f} rad/s to within its noise for {for_s:.1f} s, while"
            f" the torque went to {point.torque:.0f} N·m, which moves this shaft",
            "Check the encoder and its cable. Is the load as large as the torque limit?", point.time_s,
        )

    def _unanswered_s(self, now: PointInRun) -> float:
        """Return for how long the speed has not answered, s; 0: it may well have."""
        point, command, noise_rad_s = now.point, now.command, 2.0 * now.noise_rad_s
        torque = command.torque_nm if command.mode is Mode.TORQUE else point.torque
        low, high = min(self._low, point.speed), max(self._high, point.speed)
        if self._since_s is None or high - low > noise_rad_s:
            self._since_s = self._seen_s = point.time_s
            self._low = self._high = point.speed
            self._least = self._most = self._began = torque
            self._moved = self._strained_s = 0.0
            return 0.0
        took_s, self._seen_s = point.time_s - self._seen_s, point.time_s
        self._low, self._high = low, high
        self._least, self._most = min(self._least, torque), max(self._most, torque)
        self._strained_s = self._strained_s + took_s if _strained(point, self._limits) else 0.0
        for_s = point.time_s - self._since_s
        if command.mode is Mode.SPEED:
            self._began, self._least, self._most, self._moved = torque, torque, torque, 0.0
            return for_s if self._strained_s >= FLAT_LIMIT_S else 0.0
        self._moved += took_s * (torque - self._began)
        if not now.bounds.known or for_s < FLAT_S + FLAT_LAGS * self._lag_s:
            return 0.0
        moves = FLAT_MOVES * noise_rad_s
        by_inertia = abs(self._moved) / now.bounds.inertia_high
        by_string = (self._most - self._least) / now.bounds.string_nm_s_rad
        return for_s if min(by_inertia, by_string) >= moves else 0.0


class IgnoredYield:
    """A shaft that stands while the stop commands it to yield to the string, with more torque than friction takes."""

    def __init__(self, still_rad_s: float, lag_s: float, point_s: float) -> None:
        self._still_rad_s = still_rad_s
        self._lag_s = lag_s
        self._point_s = point_s
        self._seen: deque[tuple[float, float, float]] = deque()      # time, commanded speed, reported speed

    def see(self, now: PointInRun) -> Contradiction | None:
        """Take one point."""
        seen, point, command = self._seen, now.point, now.command
        if not (now.stopping and command.mode is Mode.SPEED):
            seen.clear()
            return None
        seen.append((point.time_s, command.speed_rad_s, point.speed))
        while point.time_s - seen[0][0] > YIELD_S:
            seen.popleft()
        if point.time_s - seen[0][0] < YIELD_S - 2.0 * self._point_s:
            return None
        # The latest command has not been answered yet, and what changes from cycle to cycle is torque noise.
        until_s = point.time_s - 2.0 * self._lag_s
        told = _means([(time_s, one) for time_s, one, _ in seen if time_s <= until_s], SMOOTH_S)
        went = [one for _, _, one in seen]
        mean = math.fsum(abs(one) for one in told) / max(1, len(told))
        told_range, went_range = max(told) - min(told), max(went) - min(went)
        noise = max(now.noise_rad_s, YIELD_LEFT * told_range)
        clear = max(YIELD_STILL * self._still_rad_s, YIELD_MOVES * noise)
        stands = math.fsum(abs(one) for one in went) / len(went) <= YIELD_STANDS * mean
        torques = [one.torque for one in now.points if point.time_s - one.time_s <= YIELD_S]
        held = max(torques) - min(torques) <= YIELD_HELD * now.bounds.breakaway_nm
        if held or not stands or mean <= clear or went_range > noise:
            return None
        return Contradiction(
            frozenset({Signal.SPEED}),
            f"the stop commands the shaft to yield to the drill string, with {min(told):.2f} to {max(told):.2f} rad/s"
            f" within {YIELD_S:g} s, and the reported speed stays at {point.speed:.2f} rad/s",
            "Check the encoder and its cable. Is the shaft held by a brake?", point.time_s,
        )


def _means(values: list[tuple[float, float]], over_s: float) -> list[float]:
    """Return the means of (time, value) over blocks of this length, s."""
    blocks: dict[int, list[float]] = {}
    for time_s, value in values:
        blocks.setdefault(math.floor((time_s - values[0][0]) / over_s), []).append(value)
    return [math.fsum(block) / len(block) for block in blocks.values()]
