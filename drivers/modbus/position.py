"""The motor shaft's angle as a drive on Modbus counts it, independent of the unit of its speed."""

from __future__ import annotations

from typing import NamedTuple

from drivers.angle import NO_ANGLE
from drivers.drive import PositionReading
from drivers.errors import CommunicationLost, PreflightRefused
from drivers.modbus import pdu
from drivers.modbus.access import RegisterAccess
from drivers.modbus.codec import WordOrder, from_words, register_name
from drivers.modbus.cycle import rad_per_count
from drivers.modbus.pdu import RegisterRefused
from drivers.preflight import PreflightTable
from profiles.modbus import ModbusProfile, Position

_TITLE = "angle of the motor"
_WIDTHS = {"u16": 16, "i16": 16, "u32": 32, "i32": 32}


class AngleRegister(NamedTuple):
    """The register that counts the angle."""

    entry: Position
    order: WordOrder

    @property
    def rad_per_count(self) -> float:
        """One count, rad."""
        return rad_per_count(self.entry)

    @property
    def wraps_rad(self) -> float:
        """The angle at which the count wraps, rad."""
        return (self.entry.wrap_counts or float(1 << _WIDTHS[self.entry.register_.type])) * self.rad_per_count

    def read(self, access: RegisterAccess, timeout_s: float) -> PositionReading | None:
        """Read the angle in one transaction; None without a valid reply."""
        register = self.entry.register_
        function = pdu.READ_HOLDING if register.table == "holding" else pdu.READ_INPUT
        where = register_name(register)
        try:
            answer = access.once(pdu.read(function, register.address, register.count), timeout_s, where)
        except (CommunicationLost, RegisterRefused):
            return None                # the next cycle reports a lost line
        half_s = 0.5 * (answer.received_s - answer.sent_s)
        counts = from_words(answer.words, register.type, self.order)
        return PositionReading(answer.sent_s + half_s, half_s, counts * self.rad_per_count, self.wraps_rad, where)


def find_angle(table: PreflightTable, access: RegisterAccess, profile: ModbusProfile) -> AngleRegister | None:
    """Return the profile's angle register if the drive gives it; add a note in any case."""
    entry = profile.position
    if entry is None:
        table.note(_TITLE, f"not reported by this drive; {NO_ANGLE}", "profile, position")
        return None
    where = register_name(entry.register_)
    try:
        access.read(entry.register_)
    except PreflightRefused as error:
        table.note(_TITLE, f"not reported: {error.what}; {NO_ANGLE}", where)
        return None
    table.note(_TITLE, f"{entry.counts_per_turn:.10g} counts per turn, compared with the speed in stage 2", where)
    return AngleRegister(entry, profile.line.word_order)
