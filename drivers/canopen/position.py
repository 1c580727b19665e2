"""The motor shaft's angle as the drive counts it (CiA 402: 6064h, 608Fh), apart from the unit of its speed.

6064h counts in units that its owner may have changed (gear 6091h, feed 6092h, unit 60A8h), and 608Fh is left at 1/1 by
drives that don't use it. Where either is so nothing is known of a turn, and the drive counts as one without an angle.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from drivers.angle import Unwrapped
from drivers.canopen.pdo import RPM, bits_of, decode_value
from drivers.canopen.sdo import Objects, name
from drivers.clock import Clock
from drivers.drive import PositionReading
from drivers.errors import CommunicationLost, ObjectRefused
from drivers.preflight import PreflightTable
from profiles.canopen import CanopenProfile, Position

TURN_RAD = 60.0 * RPM
FEWEST_COUNTS = 16
"""Of 608Fh for one turn: fewer is no encoder, but an object that nobody has set."""
ANSWER_S = 0.1
WATCHDOG_SHARE = 0.15
"""An answer is waited for so long at most, or this share of the watchdog's time."""
_ENCODER, _GEAR, _FEED, _UNIT = 0x608F, 0x6091, 0x6092, 0x60A8
_INCREMENTS = (0x0000_0000, 0x00B5_0000)
"""60A8h where one count of 6064h is one increment (CiA 303-2: B5h)."""
_TITLE = "angle of the motor"
_ASKED = "whether the shaft turns as fast as the drive says is asked of the operator"


class AngleObject(NamedTuple):
    """An object that counts the angle, and what it counts in."""

    entry: Position
    rad_per_count: float
    where: str

    @property
    def wraps_rad(self) -> float | None:
        """The angle after which it starts over, rad."""
        counts = self.entry.wrap_counts
        if counts is None:
            counts = None if self.entry.type == "f32" else float(1 << bits_of(self.entry.type))
        return None if counts is None else counts * self.rad_per_count

    def unwrapped(self, limit_rad_s: float) -> Unwrapped:
        """What counts its readings on, of a shaft with this speed limit."""
        return Unwrapped(self.wraps_rad, limit_rad_s)

    def read(self, objects: Objects, clock: Clock, watchdog_s: float) -> PositionReading | None:
        """Ask once, in a part of the watchdog's time; None without a good answer."""
        entry, begun_s = self.entry, clock.now_s()
        with objects.answered_within(min(ANSWER_S, WATCHDOG_SHARE * watchdog_s) if watchdog_s else ANSWER_S):
            try:
                counts = decode_value(entry.type, objects.read_bytes(entry.index, entry.sub), self.where)
            except (CommunicationLost, ObjectRefused):
                return None
        half_s = 0.5 * (clock.now_s() - begun_s)
        return PositionReading(begun_s + half_s, half_s, counts * self.rad_per_count, self.wraps_rad, self.where)


def find_angle(table: PreflightTable, objects: Objects, profile: CanopenProfile) -> AngleObject | None:
    """What the profile says, or the standard's objects where the drive has them and a turn is known; else a note."""
    entry = profile.position
    if entry is None:
        table.note(_TITLE, f"not told by this drive: {_ASKED}", "profile, position")
        return None
    where = name(entry.index, entry.sub)
    try:
        decode_value(entry.type, objects.read_bytes(entry.index, entry.sub), where)
        counts = entry.counts_per_turn or _standard_counts(objects)
    except ObjectRefused as error:
        table.note(_TITLE, f"not told: {error.what}; {_ASKED}", error.where or where)
        return None
    table.note(_TITLE, f"{counts:.10g} counts a turn, held against the speed in stage 2", where)
    return AngleObject(entry, TURN_RAD / counts, where)


def _standard_counts(objects: Objects) -> float:
    """Counts of 6064h for one turn of the motor, by 608Fh. Raises ObjectRefused where that can't be told."""
    for index in (_GEAR, _FEED):
        over, under = objects.read_if_there(index, 1), objects.read_if_there(index, 2)
        if over is not None and under is not None and over != under:
            raise ObjectRefused(f"positions are scaled by {over}/{under}", where=name(index))
    unit = objects.read_if_there(_UNIT)
    if unit is not None and unit not in _INCREMENTS:
        raise ObjectRefused(f"positions are counted in unit {unit:08X}h", where=name(_UNIT))
    increments, turns = objects.read(_ENCODER, 1), objects.read(_ENCODER, 2)
    counts = increments / turns if turns else 0.0
    if not (math.isfinite(counts) and counts >= FEWEST_COUNTS):
        raise ObjectRefused(f"{increments}/{turns} is no number of increments for a turn", where=name(_ENCODER))
    return counts
