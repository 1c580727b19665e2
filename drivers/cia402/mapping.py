"""Mapping of cyclic data (CiA 301, 1600h and 1A00h): its entries, and the values at their places in the data.

The PDOs of CANopen and the process data of EtherCAT have the same entries. Only the parameters around them differ:
COB-ID and transmission type there, the assignment to a sync manager here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from struct import Struct
from typing import Any, TypeVar

from drivers.cia402.objects import Objects, name
from drivers.cia402.process_data import CONTROLWORD, LAYOUTS, STATUSWORD, bits_of
from drivers.errors import PreflightRefused
from drivers.preflight import PreflightTable
from profiles.cia402 import ObjectType, Position

T = TypeVar("T")
Mapped = tuple[int, int, int]
"""Index, sub-index and bits of a mapped object; index 0 is a gap."""
_BY_BITS: dict[int, ObjectType] = {8: "i8", 16: "i16", 32: "i32"}


def mapping_entry(mapped: Mapped) -> int:
    """Convert an object to the u32 of a mapping parameter (CiA 301: index, subindex, length in bits)."""
    index, subindex, bits = mapped
    return index << 16 | subindex << 8 | bits


def mapped_object(entry: int) -> Mapped:
    """Convert the u32 of a mapping parameter to its object."""
    return entry >> 16, entry >> 8 & 0xFF, entry & 0xFF


def angle_object(position: Position | None) -> Mapped | None:
    """Return the object of the motor's angle."""
    return None if position is None else (position.index, position.sub, bits_of(position.type))


def with_angle(
    table: PreflightTable, position: Position | None, work: Callable[[Position | None], T]
) -> tuple[T, str]:
    """Map with the angle, or without it if the drive refuses that. Return the result of ``work``, and a text on it.

    Raises PreflightRefused.
    """
    try:
        return work(position), "as wanted"
    except PreflightRefused as error:
        if position is None:
            raise
        done, refused = work(None), error
    table.note("angle in the cycle", f"not mapped ({refused.what}); it is read on request only", refused.where)
    return done, "as wanted, without the angle"


def read_entries(objects: Objects, index: int) -> list[int]:
    """Return the entries of a mapping or an assignment; entries beyond the count are ignored."""
    return [objects.read(index, 1 + k) for k in range(objects.read(index, 0))]


def write_entries(objects: Objects, index: int, entries: Sequence[int], bits: int = 32) -> None:
    """Write a mapping or an assignment in the order of the standard: empty it, fill it, set its count."""
    objects.write(index, 0, 0, 8)
    for position, entry in enumerate(entries, start=1):
        objects.write(index, position, entry, bits)
    objects.write(index, 0, len(entries), 8)


class CyclicLayout:
    """Places of some objects in cyclic data. ``size``: length of the data, bytes.

    ``mapped`` (kept in ``content``): content of the data, in its order. ``wanted``: the objects whose values are packed
    and unpacked; None, and an object that is not mapped on whole bytes, have no place. ``kinds``: types that do not
    follow from the length.
    """

    def __init__(
        self, mapped: Sequence[Mapped], wanted: Sequence[Mapped | None],
        kinds: Mapping[Mapped, ObjectType] | None = None,
    ) -> None:
        self._at: dict[Mapped, int] = {}
        self.content = tuple(mapped)
        bits = 0
        for one in mapped:
            if one[0] and bits % 8 == 0:
                self._at.setdefault(one, bits // 8)
            bits += one[2]
        self.size = (bits + 7) // 8
        placed = sorted((one for one in {*wanted} if one in self._at), key=self._at.__getitem__)
        self._packed = [wanted.index(one) for one in placed]
        self._unpacked = [placed.index(one) if one in placed else None for one in wanted]
        self._in_order = placed == [*wanted]
        known: dict[Mapped, ObjectType] = {CONTROLWORD: "u16", STATUSWORD: "u16", **(kinds or {})}
        layout, end = "<", 0
        for one in placed:
            value = LAYOUTS[known.get(one) or _BY_BITS[one[2]]]
            layout += f"{self._at[one] - end}x" + value.format.lstrip("<")
            end = self._at[one] + value.size
        self._struct = Struct(layout + f"{self.size - end}x")

    def missing(self, needed: Sequence[Mapped]) -> list[str]:
        """Return the names of those objects that have no place."""
        return [name(index, sub) for index, sub, bits in needed if (index, sub, bits) not in self._at]

    def pack(self, values: Sequence[int]) -> bytes:
        """Return the data with these values of the wanted objects; all other bits are 0."""
        return self._struct.pack(*map(values.__getitem__, self._packed))

    def unpack(self, data: bytes) -> tuple[Any, ...]:
        """Return the values of the wanted objects, in counts; None for an object without a place."""
        found = self._struct.unpack_from(data)
        if self._in_order:                 # as in each TPDO1, for which each cycle waits
            return found
        return tuple(None if number is None else found[number] for number in self._unpacked)
