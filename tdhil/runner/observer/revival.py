"""Test whether a speed signal still follows the shaft after a contradiction. Pure."""

from __future__ import annotations

from collections import deque

from tdhil.runner.observer.points import STALE_S

BEFORE_S, KEPT_SHARE, FALL, RAMP_SLACK = 2.0, 0.9, 2.0, 1.2
"""A speed had not fallen if it kept this share (KEPT_SHARE) of its value BEFORE_S (s) before a contradiction. Under
a quick stop it falls by at most FALL times the stop's rate. RAMP_SLACK is the factor for a ramp already in progress."""

ALIVE_S = 1.0
"""Time after a contradiction, s, at least, from which a speed is followed again."""

ALIVE_LAGS = 3.0          # multiple of the longest lag, at least, for the same time

ALIVE_SHARE = 0.25
"""Share of a live speed: it has kept this share until then, and comes down no faster than this share of the quick
stop's time. A lost encoder reports zero by then."""


class Revival:
    """Test of a speed after a contradiction: a live signal decreases as a shaft does under a quick stop.

    Either it had not fallen before the contradiction, and falls no faster than twice the quick stop's rate. Or it is
    still not zero at ``from_s``, when every lag has ended, and decreases gradually from there. A lost signal falls at
    once, a frozen one never.
    """

    def __init__(self, steady: bool, from_s: float, stop_rad_s2: float, still_rad_s: float) -> None:
        self._from_s = from_s
        self._stop_rad_s2 = stop_rad_s2
        self._still_rad_s = still_rad_s
        self._first: tuple[float, float] | None = None         # time, speed
        self._start: tuple[float, float] | None = None         # time, speed at ``from_s``
        self._last: deque[tuple[float, float]] = deque(maxlen=4)
        self._steady = steady          # no fall before the contradiction, except along the ramp of the stop
        self.alive = False
        self.falling = False
        """True while the speed comes down as under a quick stop."""

    def see(self, time_s: float, speed_rad_s: float) -> None:
        """Evaluate one point."""
        speed = abs(speed_rad_s)
        if self._first is None:
            self._first = time_s, speed
        self._last.append((time_s, speed))
        fell, took_s = self._last[0][1] - speed, time_s - self._last[0][0]
        if fell > FALL * self._stop_rad_s2 * took_s + 2.0 * self._still_rad_s:
            self._steady = False
        first_s, first = self._first
        braked = ALIVE_SHARE * self._stop_rad_s2 * (time_s - first_s - ALIVE_S)
        turned = first > 4.0 * self._still_rad_s       # a signal that is zero from the beginning does not decrease
        self.falling = self._steady and turned and speed <= max(first - braked, 0.0) + 2.0 * self._still_rad_s
        if self._start is None and time_s >= self._from_s:
            self._start = time_s, speed if speed >= ALIVE_SHARE * self._first[1] else 0.0
        if self.alive or speed > 2.0 * self._still_rad_s:
            return
        self.alive = (self._steady and self._came_down(self._first, time_s)) or (
            self._start is not None and self._came_down(self._start, time_s)
        )

    def is_fresh(self, now_s: float) -> bool:
        """Return whether the signal is still received."""
        return bool(self._last) and now_s - self._last[-1][0] <= STALE_S

    def _came_down(self, since: tuple[float, float], now_s: float) -> bool:
        start_s, start = since
        return start > 4.0 * self._still_rad_s and now_s - start_s >= ALIVE_SHARE * start / self._stop_rad_s2
