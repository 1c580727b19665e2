"""Mapping of cyclic data in a simulated drive, on any bus: its entries as objects, and compiled access to the values.

::

    mapping entry      index << 16 | subindex << 8 | bits · index 0 is a gap, 1 to 7 a dummy of that data type

The order of writing is that of CiA 301: count 0, entries, count. Every other order is refused.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from struct import Struct

from canopen.sdo import SdoAbortedError

from sim_bus.objects import ABORT_STATE, ABORT_TOO_HIGH, FORMATS, ObjectStore, key_of

LAST_DUMMY = 0x0007
Setter = Callable[[int], None]


class EntryList:
    """Count and entries of a mapping or an assignment, as the objects ``index``:0 and on.

    ``locked`` returns whether a write (subindex, value) is refused in the present state. ``check`` raises an SDO abort
    for a wrong entry. ``changed`` is called with the new count in place, and may refuse it.
    """

    def __init__(self, store: ObjectStore, index: int, size: int, *, locked: Callable[[int, int], bool],
                 check: Callable[[int], None], changed: Callable[[], None]) -> None:
        self.entries, self.count = [0] * size, 0
        self._locked, self._check, self._changed = locked, check, changed
        for sub in range(size + 1):
            self._bind(store, key_of(index, sub), sub)

    def _bind(self, store: ObjectStore, key: int, sub: int) -> None:
        store.live[key] = lambda: self.entries[sub - 1] if sub else self.count
        store.hooks[key] = lambda value: self._write(sub, value)

    @property
    def used(self) -> list[int]:
        """Return the entries up to the count."""
        return self.entries[:self.count]

    def load(self, entries: Sequence[int], count: int) -> None:
        """Set entries and count from the drive's side."""
        self.entries, self.count = [*entries, *[0] * (len(self.entries) - len(entries))], count

    def _write(self, sub: int, value: int) -> None:
        if not sub and value > len(self.entries):
            raise SdoAbortedError(ABORT_TOO_HIGH)
        if self._locked(sub, value) or (sub and self.count):
            raise SdoAbortedError(ABORT_STATE)
        if sub:
            if value:
                self._check(value)
            self.entries[sub - 1] = value
            return
        for entry in self.entries[:value]:
            self._check(entry)
        before, self.count = self.count, value
        try:
            self._changed()
        except SdoAbortedError:
            self.count = before
            raise


class MappedData:
    """Data with these entries. ``setters``: direct write functions; other objects are written through the store."""

    def __init__(self, store: ObjectStore, entries: Sequence[int], setters: Mapping[int, Setter] | None = None) -> None:
        self._store = store
        keys = [entry >> 8 for entry in entries if entry >> 16]
        formats = [
            FORMATS[store.variable(entry >> 16, entry >> 8 & 0xFF).data_type] if entry >> 16
            else f"{(entry & 0xFF) // 8}x" for entry in entries
        ]
        self._struct = Struct("<" + "".join(formats))
        self._getters = [store.getter(key) for key in keys]
        given = setters or {}
        self._setters = [
            _discard if key >> 8 <= LAST_DUMMY else given.get(key) or partial(self._write, key) for key in keys
        ]

    @property
    def size(self) -> int:
        """Length of the data, bytes."""
        return self._struct.size

    def pack(self) -> bytes:
        """Return the data at this instant."""
        return self._struct.pack(*[getter() for getter in self._getters])

    def act(self, data: bytes | bytearray) -> None:
        """Write the values into their objects."""
        for setter, value in zip(self._setters, self._struct.unpack_from(data), strict=True):
            setter(value)

    def _write(self, key: int, value: int) -> None:
        """Write a value. A value out of range is dropped, because cyclic data cannot be refused."""
        try:
            self._store.write(key, value)
        except SdoAbortedError:
            return


def _discard(_value: int) -> None:
    """Discard the value of a dummy entry."""
