"""Process data: PDO mapping 1600h to 1607h and 1A00h to 1A07h, assignment 1C12h and 1C13h, and the fast path."""

from collections.abc import Callable
from struct import Struct

from canopen.objectdictionary import datatypes
from canopen.sdo import SdoAbortedError

from sim_bus import objects as od
from sim_bus.ethercat.sii import PdoEntry, SiiPdo
from sim_bus.objects import FORMATS, ObjectStore, key_of

PDOS, ENTRIES, SIZE_LIMIT = 8, 8, 64
"""Number of PDOs in one direction, entries of a PDO, bytes of one direction."""

_GAPS = {8: "x", 16: "xx", 32: "xxxx"}
"""Formats of an entry without an object (index 0), by bits."""

DEFAULT_OUTPUTS = (0x60400010, 0x60600008, 0x00000008, 0x60710010, 0x60FF0020)
DEFAULT_INPUTS = (0x60410010, 0x60610008, 0x00000008, 0x60770010, 0x606C0020, 0x60640020)


class _Numbers:
    """Count and entries of a mapping or an assignment; written as count 0, entries, count (ETG.1000.6)."""

    def __init__(self, store: ObjectStore, index: int, name: str, *, bits: int, entries: tuple[int, ...], size: int,
                 check: Callable[[int], None], done: Callable[[], None]) -> None:
        self.entries, self.count = [*entries, *[0] * (size - len(entries))], len(entries)
        self._check, self._done = check, done
        wide = datatypes.UNSIGNED32 if bits == 32 else datatypes.UNSIGNED16
        for sub in (*range(1, size + 1), 0):            # a record begins with a member other than 0
            store.add(index, sub, wide if sub else datatypes.UNSIGNED8, writable=True, mappable=False, name=name)
            self._bind(store, key_of(index, sub), sub)

    @property
    def used(self) -> list[int]:
        """Return the entries up to the count."""
        return self.entries[:self.count]

    def _bind(self, store: ObjectStore, key: int, sub: int) -> None:
        store.live[key] = lambda: self.entries[sub - 1] if sub else self.count
        store.hooks[key] = lambda value: self._write(sub, value)

    def _write(self, sub: int, value: int) -> None:
        if not sub and value > len(self.entries):
            raise SdoAbortedError(od.ABORT_TOO_HIGH)
        if sub and self.count:
            raise SdoAbortedError(od.ABORT_STATE)
        for entry in (value,) if sub else self.entries[:value]:
            self._check(entry)
        if sub:
            self.entries[sub - 1] = value
            return
        before, self.count = self.count, value
        try:
            self._done()
        except SdoAbortedError:
            self.count = before
            raise


class ProcessData:
    """One direction: mappings and their assignment to a SyncManager. ``writable``: in the present state. ``usual``: the
    PDO that is assigned and filled as delivered.
    """

    def __init__(self, store: ObjectStore, *, outputs: bool, writable: Callable[[], bool], usual: int) -> None:
        self._store, self.outputs, self._writable, self._usual = store, outputs, writable, usual
        self.first, self.manager, kind = (0x1600, 2, "Receive") if outputs else (0x1A00, 3, "Transmit")
        default = tuple(one for one in (DEFAULT_OUTPUTS if outputs else DEFAULT_INPUTS)
                        if not one >> 16 or one >> 16 in store.object_dictionary)
        self._mappings = [
            _Numbers(store, number, f"{kind} PDO {number - self.first + 1} mapping", bits=32, size=ENTRIES,
                     entries=default if number == usual else (), check=self._check_entry, done=self.compile)
            for number in range(self.first, self.first + PDOS)
        ]
        self._assigned = _Numbers(store, 0x1C10 + self.manager, f"SyncManager {self.manager} PDO assignment", bits=16,
                                  size=PDOS, entries=(usual,), check=self._check_pdo, done=self.compile)
        self._compile()

    @property
    def size(self) -> int:
        """Length of the process data, bytes."""
        return self._struct.size

    def pack(self) -> bytes:
        """Return the inputs at this instant."""
        return self._struct.pack(*[getter() for getter in self._getters])

    def unpack(self, data: bytes) -> list[tuple[int, float]]:
        """Return the keys of the outputs with their values."""
        return list(zip(self._keys, self._struct.unpack_from(data), strict=True))

    def delivered(self) -> SiiPdo:
        """Return the PDO of the delivered assignment, for the EEPROM."""
        mapping = self._mappings[self._usual - self.first].used
        entries = [PdoEntry(one >> 16, one >> 8 & 0xFF, self._kind(one), one & 0xFF) for one in mapping]
        return SiiPdo(self._usual, self.manager, entries)

    def compile(self) -> None:
        """Build the fast path of the assigned PDOs. Refused outside PRE-OPERATIONAL."""
        self._check_state()
        self._compile()

    def _compile(self) -> None:
        entries = [entry for pdo in self._assigned.used if pdo for entry in self._mappings[pdo - self.first].used]
        if sum(entry & 0xFF for entry in entries) > 8 * SIZE_LIMIT:
            raise SdoAbortedError(od.ABORT_PDO_TOO_LONG)
        formats = [FORMATS[self._kind(entry)] if entry >> 16 else _GAPS[entry & 0xFF] for entry in entries]
        self._struct = Struct("<" + "".join(formats))
        self._keys = [entry >> 8 for entry in entries if entry >> 16]
        self._getters = [self._getter(key) for key in self._keys]

    def _kind(self, entry: int) -> int:
        return self._store.variable(entry >> 16, entry >> 8 & 0xFF).data_type or 0 if entry >> 16 else 0

    def _getter(self, key: int) -> Callable[[], float]:
        return self._store.live.get(key) or (lambda: self._store.number(key))

    def _check_state(self) -> None:
        if not self._writable():
            raise SdoAbortedError(od.ABORT_STATE)

    def _check_pdo(self, pdo: int) -> None:
        self._check_state()
        if pdo and not self.first <= pdo < self.first + PDOS:
            raise SdoAbortedError(od.ABORT_VALUE)

    def _check_entry(self, entry: int) -> None:
        """Check an entry: an object that can be mapped in this direction, or a gap, with its length."""
        self._check_state()
        gap = not entry >> 16
        if not (not entry or entry in _GAPS if gap else self._store.mappable(entry, receives=self.outputs)):
            raise SdoAbortedError(od.ABORT_NOT_MAPPABLE)
