"""The motor shaft's angle as one unwrapped number, although the drive's counter wraps."""

from __future__ import annotations

import math

NO_ANGLE = "tdhil asks the operator to confirm the speed of the shaft"
"""Consequence of a missing or unknown angle."""

OVERSPEED = 2.0
"""Multiple of the speed limit. A shaft above this speed may turn by more than half a wrap undetected."""


def longest_gap_s(wraps_rad: float | None, limit_rad_s: float) -> float:
    """Return the longest time between two readings with a known number of turns, s; inf if there is no limit."""
    if wraps_rad is None or limit_rad_s <= 0.0:
        return math.inf
    return 0.5 * wraps_rad / (OVERSPEED * limit_rad_s)


class Unwrapped:
    """The angle since the first reading, rad.

    Between two readings the shaft turns by less than half of ``wraps_rad`` (None: the counter never wraps). After a gap
    longer than `longest_gap_s` the number of turns is unknown: that reading gives None, and the angle continues from
    it, correct except for whole wraps.
    """

    def __init__(self, wraps_rad: float | None, limit_rad_s: float) -> None:
        self._wraps_rad = wraps_rad
        self.longest_gap_s = longest_gap_s(wraps_rad, limit_rad_s)
        self._last: tuple[float, float] | None = None      # control time, angle as the drive counts it
        self._angle_rad = 0.0

    def take(self, time_s: float, counted_rad: float) -> float | None:
        """Take one reading at control time. Return the angle, or None if the turns since the last reading are
        unknown.
        """
        if not math.isfinite(counted_rad):
            return None
        last, self._last = self._last, (time_s, counted_rad)
        if last is None:
            return self._angle_rad
        moved_rad = counted_rad - last[1]
        if self._wraps_rad is not None:
            moved_rad -= self._wraps_rad * round(moved_rad / self._wraps_rad)
        self._angle_rad += moved_rad
        return self._angle_rad if time_s - last[0] <= self.longest_gap_s else None
