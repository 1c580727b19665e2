"""Objects of a drive's object dictionary: read, write, change and restore. Each bus implements the transfer.

The names are those of CiA 301: index, sub-index, little-endian bytes. CANopen and EtherCAT (CoE) share them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from drivers.errors import ObjectRefused, PreflightRefused
from drivers.undo_journal import UndoJournal, Undos

MAPPING_FIRST, MAPPING_LAST = 0x1400, 0x1C1F
"""Objects of PDOs (CiA 301: 1400h to 1BFFh) and of their assignment to sync managers (ETG.1000.6: 1C10h to 1C1Fh)."""
NO_OBJECT = "the watchdog of the process data (register 0420h)"
"""Name of a setting that is no object: only EtherCAT has one."""


class Objects(ABC):
    """The drive's object dictionary, as integers and bytes.

    Raises ObjectRefused when the drive refuses a transfer and CommunicationLost when it doesn't answer.
    """

    def __init__(self) -> None:
        self._undos = Undos()
        self._changed: set[tuple[int, int]] = set()
        self._mapping: list[str] = []                  # mapping objects written since the last `on_restore`
        self.journal: UndoJournal | None = None        # records each change before it is made
        # bytes of each object as last read back, or as found if they were right
        self.stands: dict[tuple[int, int], bytes] = {}
        # title and bytes of each setting that tdhil relies on and never writes, as found before motion
        self.relied_on: dict[tuple[int, int], tuple[str, bytes]] = {}

    @contextmanager
    def answered_within(self, answer_s: float) -> Iterator[None]:
        """Send each request once and wait at most ``answer_s`` of wall time: a shaft may be turning meanwhile."""
        yield

    @abstractmethod
    def read_bytes(self, index: int, subindex: int = 0) -> bytes:
        """Return the bytes of an object."""

    @abstractmethod
    def write_bytes(self, index: int, subindex: int, data: bytes, shown: str = "") -> None:
        """Write raw bytes. ``shown`` is the value for messages."""

    def read(self, index: int, subindex: int = 0, *, signed: bool = False) -> int:
        return int.from_bytes(self.read_bytes(index, subindex), "little", signed=signed)

    def read_if_there(self, index: int, subindex: int = 0, *, signed: bool = False) -> int | None:
        """Return the value, or None if the drive does not have the object."""
        try:
            return self.read(index, subindex, signed=signed)
        except ObjectRefused:
            return None

    def rely_on(self, title: str, index: int, subindex: int = 0) -> bytes:
        """Return the bytes of a setting that must not change during the run: a scale, a filter, a required value."""
        data = self.read_bytes(index, subindex)
        self.relied_on[index, subindex] = title, data
        return data

    def rely_on_value(self, title: str, index: int, subindex: int = 0) -> int:
        """Return an unsigned number, as `rely_on`."""
        return int.from_bytes(self.rely_on(title, index, subindex), "little")

    def write(self, index: int, subindex: int, value: int, bits: int) -> None:
        if MAPPING_FIRST <= index <= MAPPING_LAST:
            self._mapping.append(name(index))
        self.write_bytes(index, subindex, _encoded(value, bits, name(index, subindex)), str(value))

    def change(self, index: int, subindex: int, value: int, bits: int) -> int:
        """Write a value, remember the former one, and return the value read back."""
        signed = value < 0
        before = self.read_bytes(index, subindex)
        if int.from_bytes(before, "little", signed=signed) != value:
            after = _encoded(value, bits, name(index, subindex))
            self._note_change(index, subindex, before, after)
            self.write_bytes(index, subindex, after, str(value))
        back = self.stands[index, subindex] = self.read_bytes(index, subindex)
        return int.from_bytes(back, "little", signed=signed)

    def change_bytes(self, index: int, subindex: int, data: bytes) -> bytes:
        """Write the bytes of an object of any type, remember the former ones, and return the bytes read back."""
        before = self.read_bytes(index, subindex)
        if before != data:
            self._note_change(index, subindex, before, data)
            self.write_bytes(index, subindex, data)
        back = self.stands[index, subindex] = self.read_bytes(index, subindex)
        return back

    def _note_change(self, index: int, subindex: int, before: bytes, after: bytes) -> None:
        """Register the restore, and record the former value in case this host dies."""
        where = name(index, subindex)
        if self.journal is not None:
            self.journal.changing(where, before, after)
        if (index, subindex) not in self._changed:
            self._changed.add((index, subindex))

            def give_back() -> None:
                try:
                    self.write_bytes(index, subindex, before, str(int.from_bytes(before, "little")))
                except ObjectRefused:
                    if self.read_bytes(index, subindex) != before:     # the change may have been refused, too
                        raise
                if self.journal is not None:
                    self.journal.given_back(where)

            self._undos.add([where], give_back)
            self._mapping = []

    def check_stands(self) -> None:
        """Refuse a drive in which a setting that was made or relied on has changed since. Raises PreflightRefused."""
        wanted = {key: data for key, (_, data) in self.relied_on.items()} | self.stands
        for (index, subindex), data in wanted.items():
            found = self.read_bytes(index, subindex)
            if found != data:
                was, is_now = (int.from_bytes(one, "little") for one in (data, found))
                raise PreflightRefused(f"the value changed from {was} to {is_now} when the bus was started anew",
                                       where=name(index, subindex), next_step="Start again")

    def on_restore(self, undo: Callable[[], None]) -> None:
        """Register ``undo``, which `restore` calls.

        Its names in messages are the mapping objects that `write` gets before the next undo; without any, `NO_OBJECT`.
        """
        self._mapping = []
        self._undos.add(self._mapping, undo)

    @property
    def changed(self) -> tuple[str, ...]:
        """Return the names of the settings that `restore` would give back, with one name for the whole PDO mapping."""
        found = sorted({one for names in self._undos.names for one in names or (NO_OBJECT,)})
        mapping = [one for one in found if one != NO_OBJECT and MAPPING_FIRST <= place(one)[0] <= MAPPING_LAST]
        others = tuple(one for one in found if one not in mapping)
        return (*others, f"the PDO mapping ({', '.join(mapping)})") if mapping else others

    def restore(self) -> tuple[str, ...]:
        """Undo every change, the last one first. Return the changes that could not be restored."""
        self._changed.clear()
        self._mapping = []
        return self._undos.restore(lambda: self.changed)


def _encoded(value: int, bits: int, where: str) -> bytes:
    try:
        return value.to_bytes(bits // 8, "little", signed=value < 0)
    except OverflowError as error:
        raise ObjectRefused(f"{value} is outside the range of {bits} bits", where=where) from error


def place(where: str) -> tuple[int, int]:
    """Return (index, subindex) of a name written by `name`. Raises ValueError."""
    index, _, subindex = where.partition(":")
    return int(index.removesuffix("h"), 16), int(subindex or 0)


def name(index: int, subindex: int = 0) -> str:
    """Return an object's name for messages: 6040h, 1016h:1."""
    return f"{index:04X}h:{subindex}" if subindex else f"{index:04X}h"
