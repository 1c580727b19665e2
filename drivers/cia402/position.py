"""The motor shaft's angle as the drive counts it (CiA 402: 6064h, 608Fh), independent of the unit of its speed.

6064h counts in units that the owner may have changed (gear 6091h, feed 6092h, unit 60A8h). Drives that do not use 608Fh
leave it at 1/1. In both cases the counts of a turn are unknown, and the drive counts as one without an angle.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from drivers.angle import NO_ANGLE, Unwrapped
from drivers.cia402.objects import Objects, name
from drivers.cia402.polling import answer_time_s
from drivers.cia402.process_data import bits_of, decode_value
from drivers.clock import Clock
from drivers.drive import PositionReading
from drivers.errors import CommunicationLost, ObjectRefused
from drivers.preflight import PreflightTable
from profiles.cia402 import Cia402Profile, Position
from profiles.quantities import RAD_S_PER_RPM

TURN_RAD = 60.0 * RAD_S_PER_RPM
FEWEST_COUNTS = 16
"""Least counts of 608Fh for one turn. A lower value is not an encoder, but an object that was never set."""
_ENCODER, _GEAR, _FEED, _UNIT = 0x608F, 0x6091, 0x6092, 0x60A8
_INCREMENTS = (0x0000_0000, 0x00B5_0000)
"""Values of 60A8h for which one count of 6064h is one increment (CiA 303-2: B5h)."""
_TITLE, _SCALE = "angle of the motor", "the scale of the position"


class AngleObject(NamedTuple):
    """An object that counts the angle, with its unit."""

    entry: Position
    rad_per_count: float
    where: str

    @property
    def wraps_rad(self) -> float | None:
        """The angle at which the count wraps, rad."""
        counts = self.entry.wrap_counts
        if counts is None:
            counts = None if self.entry.type == "f32" else float(1 << bits_of(self.entry.type))
        return None if counts is None else counts * self.rad_per_count

    def unwrapped(self, limit_rad_s: float) -> Unwrapped:
        """Return the unwrapping counter for a shaft with this speed limit."""
        return Unwrapped(self.wraps_rad, limit_rad_s)

    def read(self, objects: Objects, clock: Clock, watchdog_s: float) -> PositionReading | None:
        """Read the angle once, within a part of the watchdog's time; None without a valid answer."""
        entry, begun_s = self.entry, clock.now_s()
        with objects.answered_within(answer_time_s(watchdog_s)):
            try:
                counts = decode_value(entry.type, objects.read_bytes(entry.index, entry.sub), self.where)
            except (CommunicationLost, ObjectRefused):
                return None
        half_s = 0.5 * (clock.now_s() - begun_s)
        return PositionReading(begun_s + half_s, half_s, counts * self.rad_per_count, self.wraps_rad, self.where)


def find_angle(table: PreflightTable, objects: Objects, profile: Cia402Profile) -> AngleObject | None:
    """Return the profile's angle object, or the standard's if the counts of a turn are known; else add a note."""
    entry = profile.position
    if entry is None:
        table.note(_TITLE, f"not reported by this drive; {NO_ANGLE}", "profile, position")
        return None
    where = name(entry.index, entry.sub)
    try:
        decode_value(entry.type, objects.read_bytes(entry.index, entry.sub), where)
        counts = entry.counts_per_turn or _standard_counts(objects)
    except ObjectRefused as error:
        table.note(_TITLE, f"not available: {error.what}; {NO_ANGLE}", error.where or where)
        return None
    table.note(_TITLE, f"{counts:.10g} counts per turn, compared with the speed in stage 2", where)
    return AngleObject(entry, TURN_RAD / counts, where)


def _scale(objects: Objects, index: int, sub: int = 0) -> int | None:
    """Return a scale of the position; None if the drive does not have the object."""
    try:
        return objects.rely_on_value(_SCALE, index, sub)
    except ObjectRefused:
        return None


def _standard_counts(objects: Objects) -> float:
    """Return the counts of 6064h for one turn of the motor, by 608Fh. Raises ObjectRefused if they are unknown."""
    for index in (_GEAR, _FEED):
        over, under = _scale(objects, index, 1), _scale(objects, index, 2)
        if over is not None and under is not None and over != under:
            raise ObjectRefused(f"positions are scaled by {over}/{under}", where=name(index))
    unit = _scale(objects, _UNIT)
    if unit is not None and unit not in _INCREMENTS:
        raise ObjectRefused(f"positions are counted in unit {unit:08X}h", where=name(_UNIT))
    increments, turns = (objects.rely_on_value(_SCALE, _ENCODER, sub) for sub in (1, 2))
    counts = increments / turns if turns else 0.0
    if not (math.isfinite(counts) and counts >= FEWEST_COUNTS):
        raise ObjectRefused(f"{increments}/{turns} is not a number of increments per turn", where=name(_ENCODER))
    return counts
