"""Comparison of the reported position with the integral of the reported speed. Pure."""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

from tdhil.runner.observer.points import IN_A_ROW

ANGLE_SHARE = 0.1
"""Relative tolerance of the angle against the reported speed, as `speed_check.TOLERANCE`."""

MOVED_RAD = 0.5
"""Change of position, rad, that shows rotation of the shaft, and not only twist of a string or a coupling."""

ANGLE_WINDOW_S = (0.5, 2.0)
"""Least and longest window of the comparison, s."""


SLOWEST_FILTER_S = 5.0
"""Longest lag of a filter of the reported speed, s: drives filter their displays over a few seconds at most."""


class Way(NamedTuple):
    """Integral of the reported speed, rad; number of its stretch without a gap; speed at its end, rad/s."""

    stretch: int
    way_rad: float
    speed_rad_s: float


class PositionWay:
    """Reported angle beside the integral of the reported speed."""

    def __init__(self, lag_s: float, count_rad_s: float, still_rad_s: float) -> None:
        self._lag_s = lag_s
        self._still_rad_s = still_rad_s
        self._count_rad_s = count_rad_s
        self.count_rad, self.gap_s = 0.0, math.inf
        self.ratio: float | None = None
        self.heard_s = -math.inf
        self.moved = False
        self.restart()

    def restart(self) -> None:
        self._seen: deque[tuple[float, float, Way]] = deque()
        self._apart = 0
        self._rate_known = True
        self._rate_rad_s: float | None = None
        self._rate_over_s = ANGLE_WINDOW_S[0]

    @property
    def rate_rad_s(self) -> float | None:
        """Speed from the angle over the last half second, rad/s; None with too few positions."""
        if not self._rate_known:
            self._rate_known, self._rate_rad_s = True, self._rate()
        return self._rate_rad_s

    def _rate(self) -> float | None:
        if len(self._seen) < 2:
            return None
        backwards = reversed(self._seen)
        last = first = next(backwards)
        for one in backwards:
            if last[0] - one[0] > 1.01 * ANGLE_WINDOW_S[0]:
                break
            first = one
        took_s = last[0] - first[0]
        if took_s < 0.4 * ANGLE_WINDOW_S[0]:
            return None
        self._rate_over_s = took_s
        return (last[1] - first[1]) / took_s

    @property
    def repeats(self) -> bool:
        """Return whether the last two positions are the same."""
        return len(self._seen) >= 2 and self._seen[-1][1] == self._seen[-2][1]

    @property
    def blur_rad_s(self) -> float:
        """Return the uncertainty of this speed due to one count of the position, rad/s."""
        return self.count_rad / min(self._rate_over_s, ANGLE_WINDOW_S[0])

    def see(self, position_rad: float, time_s: float, way: Way, noise_rad_s: float) -> str | None:
        """Return the contradiction between position and speed in words; None without one."""
        seen = self._seen
        if seen and time_s <= seen[-1][0]:
            return None
        if time_s - self.heard_s > self.gap_s:
            self.restart()
            seen = self._seen
        self.heard_s = time_s
        seen.append((time_s, position_rad, way))
        self._rate_known = False
        self.moved = self.moved or abs(position_rad - seen[0][1]) > max(10.0 * self.count_rad, MOVED_RAD)
        while time_s - seen[0][0] > ANGLE_WINDOW_S[1]:
            seen.popleft()
        first = seen[0]
        took_s = time_s - first[0]
        if took_s < ANGLE_WINDOW_S[0] or self.ratio is None or way.stretch < 0 or way.stretch != first[2].stretch:
            return None
        turned, reported = position_rad - first[1], self.ratio * (way.way_rad - first[2].way_rad)
        apart = abs(turned - reported) > self._allowed_rad(0.0, turned, reported, took_s, noise_rad_s)
        if apart:                      # this is rare: only then the lag is added, because finding it takes all speeds
            speeds = [one[2].speed_rad_s for one in seen]
            late = abs(self.ratio) * self._lag_s * (max(speeds) - min(speeds))
            apart = abs(turned - reported) > self._allowed_rad(late, turned, reported, took_s, noise_rad_s)
        self._apart = self._apart + 1 if apart else 0
        if self._apart < IN_A_ROW:
            return None
        words = (
            f"reported position and reported speed contradict each other: within {took_s:.1f} s the position moved by"
            f" {turned:.2f} rad, and the reported speed accounts for {reported:.2f} rad"
        )
        # A speed with the lag τ that rises by Δω misses τ Δω.
        change_rad_s = self.ratio * (way.speed_rad_s - first[2].speed_rad_s)
        lag_s = (turned - reported) / change_rad_s if change_rad_s != 0.0 else 0.0
        if self._lag_s < lag_s <= SLOWEST_FILTER_S:
            words += f". A filter of the reported speed with a lag of {lag_s:.1f} s would explain this"
        return words

    def _allowed_rad(
        self, late_rad: float, turned_rad: float, reported_rad: float, took_s: float, noise_rad_s: float
    ) -> float:
        """Return the largest allowed difference of the two angles, rad; ``late_rad``: the part due to the lag of the
        speed.
        """
        return (
            late_rad + 2.0 * self.count_rad + ANGLE_SHARE * max(abs(turned_rad), abs(reported_rad))
            + took_s * (0.5 * self._count_rad_s + 0.1 * noise_rad_s + self._still_rad_s)
        )
