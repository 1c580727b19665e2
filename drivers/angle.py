"""The motor shaft's angle as one number that goes on counting: a drive's counter starts over, this doesn't."""

from __future__ import annotations

import math

OVERSPEED = 2.0
"""Times the speed limit: a shaft that turns faster than this may turn by more than half a wrap unnoticed."""


def longest_gap_s(wraps_rad: float | None, limit_rad_s: float) -> float:
    """Return the longest time between two readings that leaves no doubt about the turns, s; inf: any."""
    if wraps_rad is None or limit_rad_s <= 0.0:
        return math.inf
    return 0.5 * wraps_rad / (OVERSPEED * limit_rad_s)


class Unwrapped:
    """The angle since the first reading, rad.

    Between two readings the shaft turns by less than half of ``wraps_rad`` (None: the counter never starts over). After
    a gap longer than `longest_gap_s` the turns are not known: that reading gives None, and the angle goes on from it,
    right but for whole wraps.
    """

    def __init__(self, wraps_rad: float | None, limit_rad_s: float) -> None:
        self._wraps_rad = wraps_rad
        self.longest_gap_s = longest_gap_s(wraps_rad, limit_rad_s)
        self._last: tuple[float, float] | None = None      # control time, angle as the drive counts it
        self._angle_rad = 0.0

    def take(self, time_s: float, counted_rad: float) -> float | None:
        """One reading, at control time; the angle, or None where the turns since the reading before are not known."""
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
