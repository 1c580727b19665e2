"""Rules for reported speeds that do not respond to the torque, if the momentum balance bounds too little. Pure.

Each rule evaluates every point of the run and returns a contradiction. Above a drill string the load is unknown, so
these rules need stronger evidence than a balance: a torque at its limit, a constant speed, a shaft that does not yield.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from drivers import Command, Mode
from profiles.quantities import in_nm
from tdhil.runner.observer.contradiction import Contradiction, Signal
from tdhil.runner.observer.points import Point
from tdhil.runner.observer.shaft_bounds import BREAKAWAY, SLOW_SHARE, ShaftBounds
from tdhil.runner.settings import MachineLimits

AT_LIMIT_SHARE = 0.9      # of the torque limit, from which the torque is at its limit

HELD_S = 1.5
"""Time, s, after which a shaft that moved before is blocked or not measured: it is reported at standstill in spite
of a speed setpoint and a torque at its limit."""

STRAINED_S, STRAINED_SHARE = 5.0, 0.1
"""Time, s, for which the torque may stay at its limit while the reported speed is within this share of the speed
limit of the commanded one. A speed loop at its setpoint does not need such a torque."""

FLAT_S, FLAT_LIMIT_S, FLAT_LAGS = 1.0, 1.5, 3.0
"""A reported speed that stays within its own noise is lost in two cases. First case: in torque mode the commanded
torque should have moved it for FLAT_S, beyond FLAT_LAGS lags. Second case: the torque stays at its limit for
FLAT_LIMIT_S. The speed is then not controlled, and would be constant only under a load exactly equal to the limit.
Without a string it counts at low speed, if less torque moved the shaft, until the momentum balance knows J."""

FLAT_SHARE, LOADED_SHARE = 0.02, 0.75
"""Share of the speed limit: a coarser report needs longer, as the shaft may be heavy. Share of the torque limit: if
friction at low speed may exceed it, the load may be as large as the limit."""

FLAT_MOVES = 12.0
"""Least expected change of the speed, as a multiple of its noise, by the bounds of J and of the string's impedance.
An oscillating string keeps a healthy speed within its noise up to 5.6 times that (`benchmarks/healthy_runs.py`)."""

VARIED_S, VARIED_MOVES = 5.0, 6.0
"""Least time of a constant speed above a string, s, in which the torque varies about a constant load. Second value:
least range of the speed that this variation gives J and the string's impedance, as a multiple of the noise.

It is for a torque that goes up and down as a multisine does, whose impulse never leaves the range of possible loads. No
load varies as the commanded torque does for so long. Healthy speeds did not stay within their noise for this time
(decision 0098)."""

BEYOND_S, BEYOND_LAGS = 1.0, 2.0   # s, lags: longest time for which torque drives a shaft beyond its setpoint

YIELD_S, SMOOTH_S = 4.0, 0.4       # s; time for which the stop commands a yield, and length of the compared means

YIELD_MOVES, YIELD_STILL = 3.0, 1.0
"""Least commanded speed, as a multiple of the noise of the reported speed and of the standstill speed."""

YIELD_LEFT, YIELD_STANDS = 0.05, 0.25
"""A shaft with trapped torque follows a commanded yield, because the string pulls it. It does not follow if the
reported speed stays within the first share of the range of the commanded speed, and below the second share of its
mean."""

YIELD_HELD = 1.5
"""Range of torque in which static friction T_s may hold a shaft: 2 T_s. The torque that first moved the shaft is T_s
and the rise of its ramp meanwhile. A shaft may stand within this multiple of that torque."""

STANDSTILLS = 4.0
"""Multiple of the standstill speed from which a speed is clearly not zero."""


@dataclass(frozen=True, slots=True)
class PointInRun:
    """Point with the knowledge of the run. ``points``: the latest ones, this one last."""

    point: Point
    command: Command
    block_s: float
    points: deque[Point]
    bounds: ShaftBounds
    noise_rad_s: float                 # noise of the point's speed
    moved: bool                        # True if motion of the shaft was reported before
    stopping: bool                     # True if a quick stop was requested


class UnansweredTorque(Protocol):
    """Rule: `see` evaluates each point and returns a contradiction or None."""

    def see(self, now: PointInRun) -> Contradiction | None:
        """Evaluate one point."""
        ...


def rules(limits: MachineLimits, still_rad_s: float, lag_s: float, point_s: float) -> tuple[UnansweredTorque, ...]:
    """Return the rules for a shaft with these limits; ``still_rad_s``: speed that counts as standstill, rad/s."""
    held = HeldShaft(limits, still_rad_s)
    if limits.has_drill_string:
        return (TorqueAtLimitNearSetpoint(limits, still_rad_s), FlatSpeedAboveString(limits, still_rad_s, lag_s), held,
                IgnoredYield(still_rad_s, lag_s, point_s))
    return (TorqueAtLimitBeyondSetpoint(limits, still_rad_s, lag_s), FlatSpeedWithoutString(limits, still_rad_s), held)


_ENCODER_OR_LOAD = "Check the encoder and its cable. Is the load as large as the torque limit?"


def _strained(point: Point, limits: MachineLimits) -> bool:
    return abs(point.torque) >= AT_LIMIT_SHARE * limits.torque_nm


class HeldShaft:
    """Rule: a shaft that moved is reported at standstill, in spite of a speed setpoint and torque at its limit."""

    def __init__(self, limits: MachineLimits, still_rad_s: float) -> None:
        self._limits = limits
        self._still_rad_s = still_rad_s
        self._held_s = 0.0

    def see(self, now: PointInRun) -> Contradiction | None:
        """Evaluate one point."""
        point, command = now.point, now.command
        asked = command.mode is Mode.SPEED and abs(command.speed_rad_s) > STANDSTILLS * self._still_rad_s
        held = now.moved and asked and _strained(point, self._limits) and abs(point.speed) <= self._still_rad_s
        self._held_s = self._held_s + now.block_s if held else 0.0
        if self._held_s < HELD_S:
            return None
        return Contradiction(
            frozenset({Signal.SPEED}),
            f"the drive reports standstill for {self._held_s:.1f} s while {in_nm(point.torque)}, its torque limit,"
            f" act and {command.speed_rad_s:.2f} rad/s are commanded",
            "Is the shaft held (brake, stuck pipe), or is the speed signal lost? Look at the shaft", point.time_s,
        )


class _TorqueAtLimit:
    """Rule: speed control needs no torque at its limit there. It counts until J is known; then the balance finds it."""

    _where: str                                     # reported speed, relative to the commanded one

    def __init__(self, limits: MachineLimits, still_rad_s: float, longest_s: float) -> None:
        self._limits = limits
        self._least_rad_s = STANDSTILLS * still_rad_s
        self._longest_s = longest_s
        self._strained_s = 0.0

    def see(self, now: PointInRun) -> Contradiction | None:
        """Evaluate one point."""
        point, command = now.point, now.command
        found = (command.mode is Mode.SPEED and _strained(point, self._limits) and not now.bounds.known
                 and self._contradicts(now))
        self._strained_s = self._strained_s + now.block_s if found else 0.0
        if self._strained_s < self._longest_s:
            return None
        return Contradiction(
            frozenset({Signal.SPEED, Signal.TORQUE}),
            f"the torque has been at its limit for {self._longest_s:g} s ({in_nm(point.torque)}) while the reported"
            f" speed stays at {point.speed:.2f} rad/s, {self._where} the commanded"
            f" {command.speed_rad_s:.2f} rad/s",
            _ENCODER_OR_LOAD, point.time_s,
        )

    def _contradicts(self, now: PointInRun) -> bool:
        """Return whether speed control would not need this torque at this speed."""
        raise NotImplementedError


class TorqueAtLimitNearSetpoint(_TorqueAtLimit):
    """Rule for a drill string: the torque is at its limit while the reported speed is the commanded one."""

    _where = "near"

    def __init__(self, limits: MachineLimits, still_rad_s: float) -> None:
        super().__init__(limits, still_rad_s, STRAINED_S)

    def _contradicts(self, now: PointInRun) -> bool:
        speed = now.point.speed
        near = abs(speed - now.command.speed_rad_s) <= STRAINED_SHARE * self._limits.speed_max_rad_s
        return near and abs(speed) > self._least_rad_s


class TorqueAtLimitBeyondSetpoint(_TorqueAtLimit):
    """Rule without a string: torque at its limit drives a shaft on that is beyond the commanded speed already."""

    _where = "beyond"

    def __init__(self, limits: MachineLimits, still_rad_s: float, lag_s: float) -> None:
        super().__init__(limits, still_rad_s, max(BEYOND_S, BEYOND_LAGS * lag_s))

    def _contradicts(self, now: PointInRun) -> bool:
        speed, torque = now.point.speed, now.point.torque
        beyond = math.copysign(1.0, torque) * (speed - now.command.speed_rad_s)
        return now.moved and speed * torque > 0.0 and beyond > self._least_rad_s


class _FlatSpeed:
    """Rule: a reported speed stays within its noise while torque should have moved it."""

    def __init__(self, limits: MachineLimits, least_rad_s: float) -> None:
        """``least_rad_s``: speed below which the rule does not count, rad/s."""
        self._limits = limits
        self._least_rad_s = least_rad_s
        self._since_s: float | None = None
        self._low = self._high = self._seen_s = self._strained_s = 0.0

    def see(self, now: PointInRun) -> Contradiction | None:
        """Evaluate one point."""
        point = now.point
        low, high = min(self._low, point.speed), max(self._high, point.speed)
        if self._since_s is None or high - low > 2.0 * now.noise_rad_s:
            self._since_s = self._seen_s = point.time_s
            self._low = self._high = point.speed
            self._strained_s = 0.0
            self._begin(now)
            return None
        took_s, self._seen_s = point.time_s - self._seen_s, point.time_s
        self._low, self._high = low, high
        self._strained_s = self._strained_s + took_s if _strained(point, self._limits) else 0.0
        for_s = point.time_s - self._since_s
        if not self._contradicts(now, for_s, took_s) or abs(point.speed) <= self._least_rad_s:
            return None
        return Contradiction(
            frozenset({Signal.SPEED}),
            f"the reported speed has stayed at {point.speed:.2f} rad/s to within its noise for {for_s:.1f} s, while"
            f" the torque went to {in_nm(point.torque)}, which moves this shaft",
            _ENCODER_OR_LOAD, point.time_s,
        )

    def _begin(self, now: PointInRun) -> None:
        """Begin with the first point of a constant speed."""

    def _contradicts(self, now: PointInRun, for_s: float, took_s: float) -> bool:
        """Return whether the torque should have moved the shaft. ``took_s``: time since the point before, s."""
        raise NotImplementedError


class FlatSpeedAboveString(_FlatSpeed):
    """Rule for a drill string: the torque moves J and the string, for each load that is possible, or is at its limit.

    For a torque that rises or falls, the load is a torque that acted within a lag after the speed became flat. The
    torque of the first point alone may be the end of a pulse that the speed has answered already. For a torque that
    goes up and down, the load is constant (`VARIED_S`).
    """

    def __init__(self, limits: MachineLimits, still_rad_s: float, lag_s: float) -> None:
        super().__init__(limits, STANDSTILLS * still_rad_s)                    # below: `HeldShaft`
        self._lag_s = lag_s
        self._least = self._most = self._load_low = self._load_high = self._impulse_nms = self._from_s = 0.0
        self._varied = _ConstantLoad(0.0, lag_s)

    def _begin(self, now: PointInRun) -> None:
        """Begin the range and the impulse of the torque anew."""
        torque_nm = _acting(now)
        self._from_s, self._impulse_nms = now.point.time_s, 0.0
        self._least = self._most = self._load_low = self._load_high = torque_nm
        self._varied = _ConstantLoad(torque_nm, self._lag_s)

    def _contradicts(self, now: PointInRun, for_s: float, took_s: float) -> bool:
        point, torque_nm = now.point, _acting(now)
        if now.command.mode is Mode.SPEED:
            self._begin(now)
            return self._strained_s >= FLAT_LIMIT_S
        self._least, self._most = min(self._least, torque_nm), max(self._most, torque_nm)
        self._impulse_nms += took_s * torque_nm
        counted_s = point.time_s - self._from_s
        self._varied.add(took_s, torque_nm, counted=counted_s > FLAT_LAGS * self._lag_s)
        if counted_s <= self._lag_s:
            self._load_low, self._load_high = min(self._load_low, torque_nm), max(self._load_high, torque_nm)
        if not now.bounds.known or for_s < FLAT_S + FLAT_LAGS * self._lag_s:
            return False
        inertia, string = now.bounds.inertia_high, now.bounds.string_nm_s_rad
        unbalanced_nms = max(
            0.0, self._impulse_nms - counted_s * self._load_high, counted_s * self._load_low - self._impulse_nms)
        moves = min(unbalanced_nms / inertia, (self._most - self._least) / string)
        varied = self._varied.range_rad_s(inertia, string) if self._varied.time_s >= VARIED_S else 0.0
        noise_rad_s = 2.0 * now.noise_rad_s
        return moves >= FLAT_MOVES * noise_rad_s or varied >= VARIED_MOVES * noise_rad_s


class _ConstantLoad:
    """Range of the reported speed of a shaft with a constant load, from the torque. Sums weighted by time."""

    # J ω' = T − L − ζ ω with a constant load L. Without the string J ω is ∫T dt less a straight line, so that the
    # deviation of ∫T dt from its best line is the least change that any L allows. Without J, ω is (T − L)/ζ. The
    # smaller range counts. T passes the filter of the reported speed first. A range is that of a sine with this rms.
    _RANGE_PER_RMS = 2.0 * math.sqrt(2.0)

    def __init__(self, torque_nm: float, lag_s: float) -> None:
        self._lag_s = lag_s
        self._filtered_nm = torque_nm
        self._impulse_nms = self.time_s = 0.0
        self._products = np.zeros((4, 4))                  # of 1, time, impulse, torque

    def add(self, took_s: float, torque_nm: float, *, counted: bool) -> None:
        """Add the torque that acted for ``took_s``. ``counted``: the filter has forgotten the torque before."""
        self._filtered_nm += took_s / (took_s + self._lag_s) * (torque_nm - self._filtered_nm)
        if counted:
            self._impulse_nms += took_s * self._filtered_nm
            self.time_s += took_s
            row = np.array((1.0, self.time_s, self._impulse_nms, self._filtered_nm))
            self._products += took_s * np.outer(row, row)

    def range_rad_s(self, inertia_kg_m2: float, string_nm_s_rad: float) -> float:
        """Return the least range of the speed, rad/s. At least two points are counted."""
        means = self._products / self.time_s
        (time2, by_time, _), (_, impulse2, _), (_, _, torque2) = means[1:, 1:] - np.outer(means[0, 1:], means[0, 1:])
        deviation_nms = math.sqrt(max(0.0, impulse2 - by_time * by_time / time2))
        return self._RANGE_PER_RMS * min(
            deviation_nms / inertia_kg_m2, math.sqrt(max(0.0, torque2)) / string_nm_s_rad)


class FlatSpeedWithoutString(_FlatSpeed):
    """Rule without a string: a slow shaft that less torque moved stays flat with the torque at its limit."""

    def __init__(self, limits: MachineLimits, still_rad_s: float) -> None:
        super().__init__(limits, still_rad_s)

    def _contradicts(self, now: PointInRun, for_s: float, took_s: float) -> bool:
        limits, moved_nm = self._limits, BREAKAWAY * now.bounds.breakaway_nm
        slow = abs(now.point.speed) <= SLOW_SHARE * limits.speed_max_rad_s
        if now.command.mode is not Mode.SPEED or not slow or now.bounds.known or not now.moved:
            return False
        if now.stopping or moved_nm > LOADED_SHARE * limits.torque_nm:          # in a stop `Runaway` has a slower rule
            return False
        coarse = 2.0 * now.noise_rad_s / (FLAT_SHARE * limits.speed_max_rad_s)
        return self._strained_s >= FLAT_LIMIT_S * max(1.0, coarse)


def _acting(now: PointInRun) -> float:
    """Return the torque on the shaft, N·m: in torque mode the commanded one, which no report can falsify."""
    return now.command.torque_nm if now.command.mode is Mode.TORQUE else now.point.torque


class IgnoredYield:
    """Rule: a shaft stands still while the stop commands a yield to the string, with more torque than friction."""

    def __init__(self, still_rad_s: float, lag_s: float, point_s: float) -> None:
        self._still_rad_s = still_rad_s
        self._lag_s = lag_s
        self._point_s = point_s
        self._seen: deque[tuple[float, float, float]] = deque()      # time, commanded speed, reported speed

    def see(self, now: PointInRun) -> Contradiction | None:
        """Evaluate one point."""
        seen, point, command = self._seen, now.point, now.command
        if not (now.stopping and command.mode is Mode.SPEED):
            seen.clear()
            return None
        seen.append((point.time_s, command.speed_rad_s, point.speed))
        while point.time_s - seen[0][0] > YIELD_S:
            seen.popleft()
        if point.time_s - seen[0][0] < YIELD_S - 2.0 * self._point_s:
            return None
        # the response to the latest command is still missing, and changes from cycle to cycle are torque noise
        until_s = point.time_s - 2.0 * self._lag_s
        before = [(time_s, one) for time_s, one, _ in seen if time_s <= until_s]
        blocks: dict[int, list[float]] = {}
        for time_s, one in before:
            blocks.setdefault(math.floor((time_s - before[0][0]) / SMOOTH_S), []).append(one)
        commanded = [math.fsum(block) / len(block) for block in blocks.values()]
        if not commanded:              # the lag is longer than half of what is kept
            return None
        went = [one for _, _, one in seen]
        mean = math.fsum(abs(one) for one in commanded) / len(commanded)
        commanded_range, went_range = max(commanded) - min(commanded), max(went) - min(went)
        noise = max(now.noise_rad_s, YIELD_LEFT * commanded_range)
        clear = max(YIELD_STILL * self._still_rad_s, YIELD_MOVES * noise)
        stands = math.fsum(abs(one) for one in went) / len(went) <= YIELD_STANDS * mean
        torques = [one.torque for one in now.points if point.time_s - one.time_s <= YIELD_S]
        held = max(torques) - min(torques) <= YIELD_HELD * now.bounds.breakaway_nm
        if held or not stands or mean <= clear or went_range > noise:
            return None
        return Contradiction(
            frozenset({Signal.SPEED}),
            f"the stop commands the shaft to yield to the drill string, with {min(commanded):.2f} to"
            f" {max(commanded):.2f} rad/s within {YIELD_S:g} s, and the reported speed stays at {point.speed:.2f}"
            " rad/s",
            "Check the encoder and its cable. Is the shaft held by a brake?", point.time_s,
        )
