"""Standstill by the reported speed, and by the position where the drive has one."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from drivers.drive import PositionReading

STANDSTILL_RAD_S = 0.2
"""Highest speed that counts as standstill, rad/s: a larger speed is motion to anyone beside the shaft."""
STANDSTILL_ANGLE_RAD_S = 0.1
"""Most that a shaft at standstill may turn by its position, rad/s: 3 degrees in half a second. A drive that holds a
shaft, and a string that unwinds behind it, move it by less."""
NOISE_RAD_S, NOISE_COUNTS = 0.05, 3
"""Noise of a reported speed at standstill: rad/s, or counts if they are more."""
WINDOW_S = 0.5
"""Time over which the position is compared, s."""


def standstill_limit_rad_s(count_rad_s: float, counts: int = NOISE_COUNTS) -> float:
    """Return the highest reported speed that counts as standstill, rad/s, for a count of ``count_rad_s``."""
    return min(max(NOISE_RAD_S, counts * count_rad_s), STANDSTILL_RAD_S)


class PositionSource(NamedTuple):
    """Position of a drive. ``read`` returns None without an answer, and raises nothing."""

    rad_per_count: float
    read: Callable[[], PositionReading | None]


class StandstillTest:
    """Test of one reading after the other. ``count_rad_s``: None if the unit of the reported speed is unknown.

    A speed signal can be lost and report zero, so the position must stand too, where the drive has one. If a count of
    the speed is larger than `STANDSTILL_RAD_S`, or unknown, only zero counts as standstill. ``find_position`` is called
    once, with the first speed that counts.
    """

    def __init__(self, count_rad_s: float | None, find_position: Callable[[], PositionSource | None]) -> None:
        self._count_rad_s = count_rad_s
        self._coarse = count_rad_s is None or count_rad_s > STANDSTILL_RAD_S
        self._find_position = find_position
        self._position: PositionSource | None = None
        self._sought = False
        self._since: PositionReading | None = None

    def near_zero(self, counts: int) -> bool:
        """Return whether a reported speed, in counts, and the position show standstill. May raise TdhilError."""
        count_rad_s = self._count_rad_s
        most_rad_s = 0.0 if self._coarse or count_rad_s is None else standstill_limit_rad_s(count_rad_s)
        if abs(counts) * (count_rad_s or 1.0) > most_rad_s:
            self._since = None
            return False
        if not self._sought:
            found = self._find_position()
            # A position with a count of more than the whole allowance shows nothing.
            fine = found is not None and found.rad_per_count <= STANDSTILL_ANGLE_RAD_S * WINDOW_S
            self._position, self._sought = found if fine else None, True
        return self._position is None or self._stands(self._position)

    def _stands(self, position: PositionSource) -> bool:
        """Return whether the position moved by at most `STANDSTILL_ANGLE_RAD_S`; False without a reading."""
        now = position.read()
        if now is None:
            return False
        since, self._since = self._since, self._since or now
        if since is None:
            return True
        turned, time_s = now.position_rad - since.position_rad, now.time_s - since.time_s
        if now.wraps_rad is not None:
            turned = math.remainder(turned, now.wraps_rad)
        stands = abs(turned) <= STANDSTILL_ANGLE_RAD_S * max(time_s, WINDOW_S) + 2.0 * position.rad_per_count
        if time_s >= WINDOW_S or not stands:
            self._since = now
        return stands

    def remarks(self) -> tuple[str, ...]:
        """Return a remark if the reported speed alone cannot show standstill."""
        if not self._coarse or not self._sought:
            return ()
        why = (
            "the unit of the reported speed is unknown" if self._count_rad_s is None else
            f"one count of the reported speed is {self._count_rad_s:.3g} rad/s, and standstill is at most"
            f" {STANDSTILL_RAD_S:g} rad/s"
        )
        then = (
            "There is no position to compare. Check by sight that the shaft stands still" if self._position is None else
            f"The position was compared, too: at most {STANDSTILL_ANGLE_RAD_S:g} rad/s"
        )
        return (f"{why}: tdhil accepted only a reported speed of zero. {then}",)
