"""Detection of acceleration against a quick stop, in two independent ways. Pure."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from drivers import Sample
from profiles.quantities import in_nm
from tdhil.runner.observer.contradiction import Contradiction, Signal
from tdhil.runner.observer.points import STALE_S, Point
from tdhil.runner.observer.shaft_bounds import ShaftBounds
from tdhil.runner.observer.torque_following import TORQUE_SHARE
from tdhil.runner.observer.unanswered_torque import AT_LIMIT_SHARE, STANDSTILLS
from tdhil.runner.settings import MachineLimits

UNANSWERED_S, UNANSWERED_SHARE = 8.0, 0.05
"""A reported speed does not respond to the stop if it changes by at most this share in this time, s, under a braking
torque at its limit. A shaft with such a slow response would take minutes to stop."""

PUSHING_S, PUSHING_SHARE = 1.0, 0.1
"""A torque that acts in the direction of motion for this time, s, after a quick stop and after every reporting lag,
drives the shaft. The share of the torque limit applies if the reported speed is in doubt or never showed a motion."""

DOUBTED_SHARE = 0.5
"""Share of the torque limit that, with a report in doubt, is more than a quick stop needs in the direction of
motion.
"""

IMPULSE_SHARE = 0.3
"""Uncertainty of the speed from the impulse, as a share of the speed at which the stop began."""

FASTER_SHARE, FASTER_S, FASTER_BRAKED_S = 0.1, 0.4, 1.0
"""Acceleration under a quick stop: least rise of the speed, as a share of the speed limit, and its least duration,
s. The last duration applies while the reported torque brakes the shaft. A slipping encoder may report a higher speed
for a moment."""

REPEATED_S = 0.3
"""Time, s, for which speed and torque repeat to the last digit before the torque of this time is in doubt. If the
reports then go on, they were late: this torque did not act after the quick stop, and its impulse does not count."""

INVERTED_S, INVERTED_SHARE = 2.0, 0.3
"""Time, s, and relative tolerance of an inverted sign: the speed rises as a reported torque of the opposite sign
explains, within this share and the bounds of J."""


@dataclass(frozen=True, slots=True)
class Belief:
    """Present trust in the reports."""

    doubt: Contradiction | None
    reports_trusted: bool                   # True if a report of standstill counts
    comes_down: bool                   # True if a speed in doubt has decreased as under a quick stop
    moved: bool                        # True if motion of the shaft was reported
    rate_rad_s: float | None           # speed from the position
    demand_nm: float | None            # demanded torque


class Runaway:
    """Detection of acceleration against a quick stop. ``still_rad_s``: speed that counts as standstill."""

    def __init__(self, limits: MachineLimits, still_rad_s: float) -> None:
        self._limits = limits
        self._still_rad_s = still_rad_s
        self.begun = False
        self._slowest_rad_s = self._slowest_angle_rad_s = math.inf
        self._before: Point | None = None
        self.start_rad_s = 0.0
        self._by_impulse_rad_s: float | None = None
        self._before_repeats_rad_s: float | None = None
        self._repeated_s = 0.0
        self._pushing_s = self._pushed_nm = 0.0
        self._apart_nm_s = self._took_s = self._impulse_nms = 0.0
        self._for_s = self._unanswered_s = self._unanswered_rad_s = 0.0
        self._speed_above_s = self._angle_above_s = 0.0
        self._seen_s: float | None = None
        self._recent: deque[Point] = deque()
        self._inverted = self._brakes = False
        self._inertia_known = True

    def begin(self, speed_rad_s: float) -> None:
        """Note that a quick stop was requested, from this speed."""
        self.begun = True
        self.start_rad_s = speed_rad_s

    def unanswered(self, point: Point) -> Contradiction | None:
        """Return the contradiction of a speed that does not change under a braking torque at its limit. Call it
        before `see`.
        """
        if not self.begun or self._before is None or point.time_s <= self._before.time_s:
            return None
        braking_nm = -point.torque * math.copysign(1.0, point.speed)
        opposes = braking_nm >= AT_LIMIT_SHARE * self._limits.torque_nm
        changed = abs(point.speed - self._unanswered_rad_s) > UNANSWERED_SHARE * abs(point.speed)
        turns = abs(point.speed) > STANDSTILLS * self._still_rad_s
        if changed or not opposes or not turns:
            self._unanswered_s, self._unanswered_rad_s = 0.0, point.speed
        else:
            self._unanswered_s += point.time_s - self._before.time_s
        if self._unanswered_s < UNANSWERED_S:
            return None
        return Contradiction(
            frozenset({Signal.SPEED}),
            f"the reported speed stays at {point.speed:.2f} rad/s while {in_nm(point.torque)}, the torque limit, brake"
            f" the shaft for {self._unanswered_s:.0f} s",
            "Check the encoder and its cable. Do not rely on the reported speed", point.time_s,
        )

    def see(self, point: Point, known: ShaftBounds, belief: Belief) -> None:
        """Evaluate one point of a stop."""
        if not self.begun:
            return
        before, self._before = self._before, point
        if before is None or point.time_s <= before.time_s:
            self._by_impulse_rad_s = self.start_rad_s if math.isfinite(known.inertia_high) else None
            self._before_repeats_rad_s = self._by_impulse_rad_s
            return
        self._for_s += point.time_s - before.time_s
        self._impulse_nms += point.impulse - before.impulse
        if self._for_s >= PUSHING_S:
            self._slowest_rad_s = min(self._slowest_rad_s, abs(point.speed))
        self._inertia_known = known.known
        self._see_inverted(point, known)
        took_s = point.time_s - before.time_s
        if point.speed == before.speed and point.torque == before.torque:
            self._repeated_s += took_s
        else:
            if self._repeated_s >= REPEATED_S:
                self._by_impulse_rad_s = self._before_repeats_rad_s
            self._repeated_s, self._before_repeats_rad_s = 0.0, self._by_impulse_rad_s
        if self._by_impulse_rad_s is not None:
            # the torque of a string is too uncertain, except for a torque near the limit
            counts = not self._limits.has_drill_string or abs(point.torque) >= DOUBTED_SHARE * self._limits.torque_nm
            held = abs(point.speed) <= point.still and abs(point.torque) <= known.friction(0.0, point.still)[1]
            counts = counts and not (held and belief.reports_trusted)     # static friction balances it
            self._by_impulse_rad_s += counts * (point.impulse - before.impulse) / known.likely_inertia
        # Torque in the direction of the last motion beyond all friction. If motion was never reported, friction is
        # unknown and any torque counts.
        least = known.pushing_nm
        if belief.doubt is not None:
            least = min(least, DOUBTED_SHARE * self._limits.torque_nm)
        if not belief.reports_trusted:
            least = PUSHING_SHARE * self._limits.torque_nm
        elif not belief.moved:       # static friction may balance a small remaining torque
            least = DOUBTED_SHARE * (self._limits.probe_torque_nm or self._limits.torque_nm)
        turning = belief.rate_rad_s if belief.rate_rad_s and belief.doubt is not None else self.start_rad_s
        if self._limits.has_drill_string and belief.reports_trusted:
            turning = point.speed      # the string may have reversed the shaft
        forward = 1.0 if turning >= 0.0 else -1.0
        pushes = (forward * point.torque if belief.moved else abs(point.torque)) > least
        self._pushing_s = self._pushing_s + took_s if pushes else 0.0
        self._pushed_nm = point.torque
        self._brakes = -forward * point.torque > least
        self._apart_nm_s += took_s * abs(point.torque - belief.demand_nm) if belief.demand_nm is not None else 0.0
        self._took_s += took_s

    def _see_inverted(self, point: Point, known: ShaftBounds) -> None:
        """Detect a speed that rises as a reported torque of the opposite sign explains.

        With an unknown J, a braking torque at its limit must have acted all the time: no shaft rises against that.
        """
        recent = self._recent
        recent.append(point)
        while point.time_s - recent[0].time_s > INVERTED_S:
            recent.popleft()
        start, self._inverted = recent[0], False
        window_s = point.time_s - start.time_s
        change = abs(point.speed) - abs(start.speed)
        least = FASTER_SHARE * self._limits.speed_max_rad_s
        if self._limits.has_drill_string or window_s < 0.9 * INVERTED_S or change < least:
            return
        forward = math.copysign(1.0, point.speed)
        pushed_nms = -forward * (point.impulse - start.impulse)
        if not known.known:
            self._inverted = pushed_nms >= AT_LIMIT_SHARE * self._limits.torque_nm * window_s
            return
        usual_nm = 0.5 * math.fsum(known.friction(point.speed, 0.0))
        expected_nms = pushed_nms - forward * usual_nm * window_s
        least_nms, most_nms = known.inertia_low * change, known.inertia_high * change
        slack_nms = INVERTED_SHARE * abs(pushed_nms)
        self._inverted = least_nms - slack_nms <= expected_nms <= most_nms + slack_nms

    def seen(self, belief: Belief, sample: Sample) -> str:
        """Return the evidence of acceleration in words if two ways agree; else ''."""
        if not self.begun or self._for_s < PUSHING_S:
            return ""
        limit = self._limits.speed_max_rad_s
        more = FASTER_SHARE * limit
        if self._limits.has_drill_string:
            # A released string turns back. Its torque is removed only if the shaft exceeds its limit.
            self._slowest_rad_s = self._slowest_angle_rad_s = limit
        faster = more + max(self._slowest_rad_s, IMPULSE_SHARE * abs(self.start_rad_s))
        doubt = belief.doubt
        # the inertia of a shaft that lost load is unknown, but its reported speed is used
        lighter = doubt is not None and doubt.lighter
        in_vain = (not belief.reports_trusted and not lighter and not belief.comes_down) or (
            not belief.moved and not self._limits.has_drill_string
        )
        by_speed = by_position = ""
        took_s = 0.0 if self._seen_s is None else min(sample.time_s - self._seen_s, STALE_S)
        self._seen_s = sample.time_s
        above = belief.reports_trusted and abs(sample.speed_rad_s) > faster
        self._speed_above_s = self._speed_above_s + took_s if above else 0.0
        enough_s = FASTER_BRAKED_S if self._brakes else FASTER_S
        if in_vain:
            by_speed = "the reported speed does not follow the torque"
        elif self._speed_above_s >= enough_s:
            by_speed = f"the reported speed rose to {sample.speed_rad_s:.2f} rad/s"
        rate = belief.rate_rad_s
        if rate is not None:
            self._slowest_angle_rad_s = min(self._slowest_angle_rad_s, abs(rate))
            above = abs(rate) > more + max(self._slowest_angle_rad_s, IMPULSE_SHARE * abs(self.start_rad_s))
            self._angle_above_s = self._angle_above_s + took_s if above else 0.0
            if self._angle_above_s >= enough_s:
                by_position = f"the position moves at {rate:.2f} rad/s"
        by_torque = "" if lighter else self._by_torque(belief.reports_trusted, more)
        # The speed of a shaft that lost load, or of one before stage 2 has ended, is used, also if only the sign of the
        # torque is wrong.
        if (lighter or not self._inertia_known) and self._inverted and abs(sample.speed_rad_s) > limit:
            by_speed = by_speed or f"the reported speed rose to {sample.speed_rad_s:.2f} rad/s"
            by_torque = "it rises as the reported torque with the opposite sign accounts for"
        ways = [one for one in (by_speed, by_position, by_torque) if one]
        return "; ".join(ways) if len(ways) >= 2 else ""

    def _by_torque(self, reports_trusted: bool, more_rad_s: float) -> str:
        """Return the evidence from the torque alone. A torque that does not follow the demanded one gives none."""
        if self._apart_nm_s > TORQUE_SHARE * self._limits.torque_nm * self._took_s:
            return ""
        if self._unanswered_s >= UNANSWERED_S:
            return f"{in_nm(self._pushed_nm)} for {self._unanswered_s:.0f} s have stopped any such shaft"
        # above a string the stop begins with a ramp of the setpoint, which may accelerate the shaft until it has ended
        ramp_s = self._limits.speed_max_rad_s / self._limits.quick_stop_rad_s2
        pushes = not self._limits.has_drill_string or (reports_trusted and self._for_s >= ramp_s)
        if self._pushing_s >= PUSHING_S and pushes:
            return f"{in_nm(self._pushed_nm)} push the shaft on"
        # rig.yaml states a rate that the torque limit can give: this impulse stops the shaft from its speed limit
        spent = abs(self._impulse_nms) > (1.0 + FASTER_SHARE) * ramp_s * self._limits.torque_nm
        if spent and not (reports_trusted or self._inertia_known or self._limits.has_drill_string):
            return f"{self._impulse_nms:.0f} N·m·s since the quick stop reverse a shaft from its speed limit"
        by_impulse = self._by_impulse_rad_s
        if by_impulse is not None and self._beyond(by_impulse, more_rad_s, reports_trusted):
            return f"the torque since the quick stop accounts for {by_impulse:.2f} rad/s"
        return ""

    def _beyond(self, by_impulse_rad_s: float, more_rad_s: float, reports_trusted: bool) -> bool:
        """Return whether the torque alone drives the shaft beyond its limit or, with a speed in doubt, beyond zero."""
        start = abs(self.start_rad_s)
        forward = by_impulse_rad_s * (1.0 if self.start_rad_s >= 0.0 else -1.0)
        if reports_trusted or self._limits.has_drill_string:
            return abs(by_impulse_rad_s) > max(start, self._limits.speed_max_rad_s) + more_rad_s
        slack = IMPULSE_SHARE * start + more_rad_s
        return forward > start + slack or forward < -slack
