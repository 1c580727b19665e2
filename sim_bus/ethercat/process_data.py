"""Process data: PDO mapping 1600h to 1603h and 1A00h to 1A03h, assignment 1C12h and 1C13h, and the fast path.

Both are writable in PRE-OPERATIONAL only, as ETG.1000.6 has it: count 0, entries, count.
"""

from collections.abc import Callable
from struct import Struct

from canopen.objectdictionary import datatypes
from canopen.sdo import SdoAbortedError

from sim_bus.canopen import objects as od
from sim_bus.canopen.objects import ObjectStore, key_of
from sim_bus.ethercat.sii import Pdo, PdoEntry

PDOS, ENTRIES = 4, 8
OUTPUTS_LIMIT = 64
"""Most bytes of the process data of one direction."""

_FORMATS = {
    datatypes.INTEGER8: "b", datatypes.UNSIGNED8: "B", datatypes.INTEGER16: "h", datatypes.UNSIGNED16: "H",
    datatypes.INTEGER32: "i", datatypes.UNSIGNED32: "I", datatypes.REAL32: "f",
}
_GAP = {8: "x", 16: "xx", 32: "xxxx"}
"""Formats of an entry without an object (index 0), by bits."""

DEFAULT_OUTPUTS = (0x60400010, 0x60600008, 0x00000008, 0x60710010, 0x60FF0020)
DEFAULT_INPUTS = (0x60410010, 0x60610008, 0x00000008, 0x60770010, 0x606C0020, 0x60640020)


class ProcessData:
    """One direction: PDO mappings and their assignment to a SyncManager. ``writable``: in the state of the slave."""

    def __init__(self, store: ObjectStore, *, outputs: bool, writable: Callable[[], bool]) -> None:
        self._store, self.outputs, self._writable = store, outputs, writable
        self.first, self.manager = (0x1600, 2) if outputs else (0x1A00, 3)
        default = DEFAULT_OUTPUTS if outputs else DEFAULT_INPUTS
        self._counts = [len(default)] + [0] * (PDOS - 1)
        self._entries = [[*default, *[0] * (ENTRIES - len(default))]] + [[0] * ENTRIES for _ in range(PDOS - 1)]
        self._assigned, self._assigned_count = [self.first] + [0] * (PDOS - 1), 1
        for number in range(PDOS):
            name = f"{'Receive' if outputs else 'Transmit'} PDO {number + 1} mapping"
            self._bind(self.first + number, datatypes.UNSIGNED32, name, number)
        self._bind_assignment()
        self.compile()

    def compile(self) -> None:
        """Builds the fast path of what is assigned."""
        entries = [entry for one in self._assigned[:self._assigned_count] if one for entry in self._of(one)]
        formats = []
        for entry in entries:
            known = entry >> 16 and self._store.variable(entry >> 16, entry >> 8 & 0xFF).data_type
            formats.append(_FORMATS[known] if known else _GAP[entry & 0xFF])
        self._struct = Struct("<" + "".join(formats))
        self.keys = [entry >> 8 for entry in entries if entry >> 16]
        getters = self._store.live
        self._getters = [getters.get(key) or self._stored(key) for key in self.keys]

    @property
    def size(self) -> int:
        """Bytes of the process data."""
        return self._struct.size

    def pack(self) -> bytes:
        """The inputs at this instant."""
        return self._struct.pack(*[getter() for getter in self._getters])

    def unpack(self, data: bytes) -> tuple[float, ...]:
        """The values of the outputs, in the order of `keys`."""
        return self._struct.unpack_from(data)

    def delivered(self) -> list[Pdo]:
        """PDOs as the EEPROM tells them."""
        found = []
        for entry in self._of(self.first):
            index, subindex = entry >> 16, entry >> 8 & 0xFF
            kind = self._store.variable(index, subindex).data_type if index else 0
            found.append(PdoEntry(index, subindex, kind or 0, entry & 0xFF))
        return [Pdo(self.first, self.manager, found)]

    def _of(self, pdo: int) -> list[int]:
        number = pdo - self.first
        return self._entries[number][:self._counts[number]]

    def _stored(self, key: int) -> Callable[[], float]:
        return lambda: self._store.number(key)

    def _bind(self, index: int, kind: int, name: str, number: int) -> None:
        add, live, hooks = self._store.add, self._store.live, self._store.hooks
        for sub in (*range(1, ENTRIES + 1), 0):      # a record begins with a member other than 0
            add(index, sub, kind if sub else datatypes.UNSIGNED8, writable=True, mappable=False, name=name)
            live[key_of(index, sub)] = self._reader(number, sub)
            hooks[key_of(index, sub)] = self._writer(number, sub)

    def _reader(self, number: int, sub: int) -> Callable[[], float]:
        return lambda: self._entries[number][sub - 1] if sub else self._counts[number]

    def _writer(self, number: int, sub: int) -> Callable[[int], None]:
        def write(value: int) -> None:
            self._check_state()
            if sub:
                if self._counts[number]:
                    raise SdoAbortedError(od.ABORT_STATE)
                self._check(value)
                self._entries[number][sub - 1] = value
                return
            if value > ENTRIES:
                raise SdoAbortedError(od.ABORT_TOO_HIGH)
            for entry in self._entries[number][:value]:
                self._check(entry)
            self._counts[number] = value
            self.compile()

        return write

    def _bind_assignment(self) -> None:
        index, add = 0x1C10 + self.manager, self._store.add
        name = f"SyncManager {self.manager} PDO assignment"

        def write(sub: int, value: int) -> None:
            self._check_state()
            if sub:
                if self._assigned_count:
                    raise SdoAbortedError(od.ABORT_STATE)
                if value and not self.first <= value < self.first + PDOS:
                    raise SdoAbortedError(od.ABORT_VALUE)
                self._assigned[sub - 1] = value
                return
            bits = sum(entry & 0xFF for one in self._assigned[:value] if one for entry in self._of(one))
            if value > PDOS:
                raise SdoAbortedError(od.ABORT_TOO_HIGH)
            if bits > 8 * OUTPUTS_LIMIT:
                raise SdoAbortedError(od.ABORT_PDO_TOO_LONG)
            self._assigned_count = value
            self.compile()

        for sub in (*range(1, PDOS + 1), 0):
            kind = datatypes.UNSIGNED16 if sub else datatypes.UNSIGNED8
            add(index, sub, kind, writable=True, mappable=False, name=name)
            self._store.live[key_of(index, sub)] = self._assignment(sub)
            self._store.hooks[key_of(index, sub)] = lambda value, sub=sub: write(sub, value)

    def _assignment(self, sub: int) -> Callable[[], float]:
        return lambda: self._assigned[sub - 1] if sub else self._assigned_count

    def _check_state(self) -> None:
        if not self._writable():
            raise SdoAbortedError(od.ABORT_STATE)

    def _check(self, entry: int) -> None:
        """An entry names an object that can be mapped in this direction, or a gap, with its length."""
        index, subindex, bits = entry >> 16, entry >> 8 & 0xFF, entry & 0xFF
        if not index:
            if entry and bits not in _GAP:
                raise SdoAbortedError(od.ABORT_NOT_MAPPABLE)
            return
        variable = self._store.variable(index, subindex)
        able = variable.pdo_mappable and (variable.writable if self.outputs else variable.readable)
        if not able or variable.data_type not in _FORMATS or bits != len(variable):
            raise SdoAbortedError(od.ABORT_NOT_MAPPABLE)
