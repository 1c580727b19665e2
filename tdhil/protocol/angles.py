"""The angle that a drive counts, held against the speed that it reports. Pure: it is shown both, and reckons.

Over one stretch the shaft's true way stands in the drive's angle, and in the integral of its reported speed as well,
however unsteady it turns. Their ratio is that of the true unit of speed to the one that the profile has. A reported
speed that lags is late by the same way at both ends of a stretch whose ends are equally fast.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from drivers.drive import PositionReading, Sample

WINDOW_S = 0.25
"""The angle's own speed is that over so long, at least."""
LEAST_WINDOW = 3
"""Readings between which it is taken, at least."""
SEEN_FASTER = 12.0
"""An angle that starts over is followed up to a shaft so many times faster than it is believed to be."""
EXACT = 0.03
"""A ratio counts once it is known this well, as a share of itself, …"""
LEAST_S = 2.0
"""… over no less time than this."""
STOOD_RAD = 8.2
"""An angle that hasn't changed over so much reported way (1.3 turns: even a counter of turns would) stands still."""


class Ratio(NamedTuple):
    """True way over reported way of a stretch, and how far it may be off for counts and time."""

    value: float
    half_width: float


@dataclass(frozen=True)
class _Point:
    time_s: float
    angle_rad: float
    way_rad: float


class Angles:
    """Of one drive over one run; `restart` begins a new stretch."""

    def __init__(self) -> None:
        self.where = ""
        self.count_rad: float | None = None        # the smallest step seen: one count is no more than that
        self.blind = False                         # the readings came too seldom for an angle that starts over
        self._way_rad = 0.0                        # by the reported speed
        self._before: Sample | None = None
        self._last: _Point | None = None
        self._raw_rad = 0.0
        self._recent: list[_Point] = []
        self._first: _Point | None = None          # of this stretch
        self._changed: _Point | None = None        # where the count changed first in this stretch, and last
        self._changed_last: _Point | None = None

    def restart(self) -> None:
        """A new stretch begins with the next reading; what a count is stays known."""
        self._first = self._changed = self._changed_last = None
        self.blind = False

    def saw(self, sample: Sample) -> None:
        """One cycle's reported speed."""
        if not sample.fresh:
            return
        if self._before is not None:
            mean = 0.5 * (self._before.speed_rad_s + sample.speed_rad_s)
            self._way_rad += mean * (sample.time_s - self._before.time_s)
        self._before = sample

    def read(self, reading: PositionReading, believed_rad_s: float) -> None:
        """One reading; ``believed_rad_s``: how fast the shaft would be, were the unit of speed right."""
        self.where = reading.where
        last, angle = self._last, reading.position_rad
        if last is not None:
            step = angle - self._raw_rad
            wraps = reading.wraps_rad
            if wraps is not None:
                step -= wraps * round(step / wraps)
                farthest = SEEN_FASTER * abs(believed_rad_s) * (reading.time_s - last.time_s)
                self.blind = self.blind or farthest > 0.5 * wraps
            angle = last.angle_rad + step
            if step != 0.0:
                self.count_rad = abs(step) if self.count_rad is None else min(self.count_rad, abs(step))
        self._raw_rad = reading.position_rad
        point = self._last = _Point(reading.time_s, angle, self._way_rad)
        self._recent.append(point)
        while len(self._recent) > LEAST_WINDOW + 1 and point.time_s - self._recent[1].time_s >= WINDOW_S:
            del self._recent[0]
        if self._first is None:
            self._first = point
        elif last is not None and angle != last.angle_rad:
            self._changed = self._changed or point
            self._changed_last = point

    def speed_rad_s(self) -> tuple[float, float] | None:
        """By the angle alone, how fast the shaft has been just now: at least, at most (magnitudes); None too early."""
        recent = self._recent
        if self.count_rad is None or len(recent) <= LEAST_WINDOW or self.blind:
            return None
        took_s = recent[-1].time_s - recent[0].time_s
        if took_s < 0.99 * WINDOW_S:
            return None
        turned = abs(recent[-1].angle_rad - recent[0].angle_rad)
        return max(0.0, turned - self.count_rad) / took_s, (turned + self.count_rad) / took_s

    def ratio(self) -> Ratio | None:
        """Of this stretch; None while that is not known well enough."""
        first, last = self._first, self._last
        if first is None or last is None or self.blind or last.time_s - first.time_s < LEAST_S:
            return None
        way = abs(last.way_rad - first.way_rad)
        count = self.count_rad
        start, end = self._changed, self._changed_last
        if start is None or end is None:
            # Not one count: standing still, if it ever counted as finely as that, or over the whole of a turn.
            return Ratio(0.0, 0.0) if way > (STOOD_RAD if count is None else min(STOOD_RAD, 5.0 * count)) else None
        way_rad = end.way_rad - start.way_rad
        turned = end.angle_rad - start.angle_rad
        spent_s = end.time_s - start.time_s
        if spent_s < 0.9 * LEAST_S or turned == 0.0 or count is None:
            return None
        # At a change the angle is known to one count, and to what it moves between two readings.
        between = abs(turned) * self._every_s() / spent_s
        half = 2.0 * min(count, between) / abs(turned)
        if half > EXACT:
            return None
        if abs(way_rad) < 1e-3 * abs(turned):
            way_rad = 1e-3 * turned
        value = turned / way_rad
        return Ratio(value, half * abs(value))

    def _every_s(self) -> float:
        recent = self._recent
        return (recent[-1].time_s - recent[0].time_s) / max(1, len(recent) - 1)
