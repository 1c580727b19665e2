"""Tests (1) and (2) of the observer: reported speed against reported torque. Pure."""

from __future__ import annotations

import math
from collections import deque

from profiles.quantities import in_nm
from tdhil.runner.observer.contradiction import Contradiction, Signal
from tdhil.runner.observer.points import AROUND_S, IN_A_ROW, SLOPE_S, Point
from tdhil.runner.observer.shaft_bounds import ShaftBounds
from tdhil.runner.settings import MachineLimits

SHORT_WINDOWS_S = (0.25, 0.5, 1.0, 2.0)
"""Windows of (1) in which lags hide more than an error of J, s."""

WINDOWS_S = (*SHORT_WINDOWS_S, 3.0, 4.0)
"""All windows of (1), s. Short ones detect a jump; long ones detect a report that stops following, or that follows with
another scale: the lags hide less of a longer change. A sensor whose scale halves at low speed, in speed mode, is found
by the window of 3 s (`benchmarks/lying_reports.py`, 2147). On 51 healthy rigs those of 3 and 4 s reach 0.37 of the
bound once J is known, no more than that of 2 s (`benchmarks/healthy_runs.py`)."""

ROUGH_RATIO = 2.0
"""Ratio of the bounds of a known J from which only the short windows count. In a long window the error of J adds up. On
healthy seed 1471 stage 2 gives 406 to 933 for 2010 kg·m², and the window of 3 s stopped the run."""

LIGHTEST_SHARE = 0.5
"""Least share of the motor in the inertia, if a part of the load hangs on a compliant shaft."""

LIGHTER_SHARE = 0.02
"""Share of the inertia: an imbalance that a reduction by this share explains may be a lost load."""

STEEPEST = 0.9
"""Factor on the acceleration of (2). The inertia in (2) is far below the likeliest one. Above a noisy bit a healthy
shaft reaches 0.6 of the bound, elsewhere 0.3 (`benchmarks/healthy_runs.py`)."""

HIDDEN_SHARE = 0.25
"""Torque beyond the reported one, as a share of the limit. In speed mode the drive may command torque pulses that
are too short for the lag of their report."""

MEMORY_S = 3.0
"""Time during which an earlier torque affects the reported slope, s: six of the longest plausible lags."""


class MomentumBalance:
    """Test of the points of a run against the bounds of its shaft. ``point_s``: time between two points."""

    def __init__(self, limits: MachineLimits, lag_s: float, point_s: float, torque_count_nm: float) -> None:
        self._limits = limits
        self._lag_s = lag_s
        self._point_s = point_s
        self._torque_count_nm = torque_count_nm
        self.restart()

    def restart(self) -> None:
        """Reset the counts of failed tests."""
        self._failed = [0] * (len(WINDOWS_S) + 1)

    def see(self, points: deque[Point], known: ShaftBounds, noise_rad_s: float) -> Contradiction | None:
        """Return the contradiction at the last of these points, if there is one; ``noise_rad_s``: of a point's
        speed.
        """
        if not known.testable:
            return None
        now, found = points[-1], None
        if known.inertia_low > 0.0 and self._fails(0, self._too_steep(points, known, noise_rad_s)):
            before = min(points, key=lambda one: abs(now.time_s - SLOPE_S - one.time_s))
            found = _contradiction(now, before, known, lighter=True)
        around = math.ceil(AROUND_S / self._point_s)
        last = len(points) - 1
        surplus, both = known.surplus(now), (known.inertia_low, known.inertia_high)
        rough = known.known and known.inertia_high > ROUGH_RATIO * known.inertia_low
        for number, window_s in enumerate(SHORT_WINDOWS_S if rough else WINDOWS_S, 1):
            back = max(around, round(window_s / self._point_s))
            if back > last:
                break
            start, after = points[last - back], points[min(last, last - back + around)]
            share = self._imbalance((start, after, now), known, both, noise_rad_s, surplus)
            if self._fails(number, share) and found is None:
                lightest = (LIGHTER_SHARE * known.inertia_low,)
                lighter = self._imbalance((start, after, now), known, lightest, noise_rad_s, surplus) <= 1.0
                found = _contradiction(now, start, known, lighter=lighter)
        return found

    def _fails(self, number: int, share: float) -> bool:
        """Count a failed test, and return whether enough tests in a row have failed."""
        self._failed[number] = self._failed[number] + 1 if share > 1.0 else 0
        return self._failed[number] >= IN_A_ROW

    def _too_steep(self, points: deque[Point], known: ShaftBounds, noise_rad_s: float) -> float:
        """Return the slope of the reported speed over what (2) allows; 0 if it is clearly allowed."""
        limits, now = self._limits, points[-1]
        blur_rad_s2 = 2.0 * noise_rad_s / SLOPE_S
        if abs(now.slope) <= self._clear_rad_s2(now, known) + blur_rad_s2:
            return 0.0                 # within the noise, or explained by the torque of this moment alone
        recent = [point for point in points if now.time_s - point.time_s <= MEMORY_S]
        if now.time_s - points[0].time_s < MEMORY_S:
            least_nm, most_nm = -limits.torque_nm, limits.torque_nm
        else:
            least_nm = min([point.torque_least for point in recent])
            most_nm = max([point.torque_most for point in recent])
        fastest = max([abs(point.speed) for point in recent])
        if limits.has_drill_string:            # above a string the rough inertia has a wide interval already
            load_low, load_high = recent[0].load_low, recent[0].load_high
            lightest = known.inertia_low
        else:
            load_high = known.friction(fastest, 0.0)[1]
            load_low, lightest = -load_high, LIGHTEST_SHARE * known.inertia_low
        most_nm = most_nm - load_low if now.slope > 0.0 else load_high - least_nm
        most = STEEPEST * max(0.0, most_nm) / lightest
        return abs(now.slope) / (most + blur_rad_s2)

    def _clear_rad_s2(self, now: Point, known: ShaftBounds) -> float:
        """Return the slope that the torque of this moment allows. Friction and the earlier torque only allow more.

        Returns 0 above a string, whose load may take the whole torque.
        """
        limits = self._limits
        if limits.has_drill_string:
            return 0.0
        torque_nm = min(now.torque_most if now.slope > 0.0 else -now.torque_least, limits.torque_nm)
        return STEEPEST * max(0.0, torque_nm) / (LIGHTEST_SHARE * known.inertia_low)

    def _imbalance(
        self, window: tuple[Point, Point, Point], known: ShaftBounds, inertias: tuple[float, ...], noise_rad_s: float,
        surplus_nm: tuple[float, float],
    ) -> float:
        """Return the imbalance of (1) over the allowed one, for the J that explains most of it.

        (1) is linear in J, so the bounds of J suffice. ``window``: its start, `AROUND_S` after it, and its end.
        ``surplus_nm``: least and greatest torque that accelerates the shaft at the end.
        """
        (start, after, now), lag_s = window, self._lag_s
        change = now.speed - start.speed
        impulse = now.impulse - start.impulse
        window_s = now.time_s - start.time_s
        friction_low, friction_high = now.friction_low - start.friction_low, now.friction_high - start.friction_high
        if self._limits.has_drill_string:
            swing = known.string_nm_s_rad * (abs(change) + abs(now.slope_high - now.slope_low) * lag_s) * window_s
            friction_low, friction_high = start.load_low * window_s - swing, start.load_high * window_s + swing
        rough = now.rough - start.rough + self._torque_count_nm * window_s
        surplus_low, surplus_high = surplus_nm
        was_surplus_low, was_surplus_high = known.surplus(after)
        now_low, now_high, after_low, after_high = now.torque_low, now.torque_high, after.torque_low, after.torque_high
        opposed, was_opposed = now_high - surplus_high, after_high - was_surplus_high
        too_low = too_high = math.inf
        for inertia in inertias:
            imbalance = inertia * change - impulse
            # Torque that accelerates the shaft, N·m, at both ends: by the slope, and by the torque less friction.
            by_slope_low, by_slope_high = inertia * now.slope_low, inertia * now.slope_high
            was_by_slope_low, was_by_slope_high = inertia * after.slope_low, inertia * after.slope_high
            rate_low, rate_high = min(by_slope_low, surplus_low), max(by_slope_high, surplus_high)
            from_low, from_high = min(was_by_slope_low, was_surplus_low), max(was_by_slope_high, was_surplus_high)
            torque_low, torque_high = min(now_low, by_slope_low + opposed), max(now_high, by_slope_high + opposed)
            was_low = min(after_low, was_by_slope_low + was_opposed)
            was_high = max(after_high, was_by_slope_high + was_opposed)
            faster, slower = max(0.0, rate_high - from_low), min(0.0, rate_low - from_high)
            more, less = max(0.0, torque_high - was_low), min(0.0, torque_low - was_high)
            room = rough + inertia * noise_rad_s
            below = room + lag_s * (faster - less)
            above = room + lag_s * (more - slower)
            too_low = min(too_low, -(imbalance + friction_high) / below)
            too_high = min(too_high, (imbalance + friction_low) / above)
        return max(too_low, too_high)


def _contradiction(now: Point, start: Point, known: ShaftBounds, *, lighter: bool) -> Contradiction:
    """Describe the contradiction. A smaller inertia explains a speed that rises with the torque, but not a lost
    speed.
    """
    lighter = lighter and abs(now.speed) > abs(start.speed) and now.speed * max(start.torque, now.torque) > 0.0
    went = (
        f"within {now.time_s - start.time_s:.2g} s the reported speed went from {start.speed:.2f} to"
        f" {now.speed:.2f} rad/s at {in_nm(start.torque)} to {in_nm(now.torque)}"
    )
    if lighter:
        what = f"the speed changes faster than this shaft ({known.words}) allows: {went}"
        helps = "Was the load lost? Check the coupling, and the encoder and its cable"
    else:
        what = (
            f"reported speed and torque contradict each other: {went}, which this shaft ({known.words})"
            " does not do"
        )
        helps = (
            "Check the encoder and its cable, and whether a brake or a changed torque scale acts. Do not rely on"
            " the reported speed"
        )
    return Contradiction(frozenset({Signal.SPEED, Signal.TORQUE}), what, helps, now.time_s, lighter)
