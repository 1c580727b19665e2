"""PDOs of the drive: configuration by SDO (CiA 301, 14xxh to 1Axxh) and a compiled fast path for the data.

::

    COB-ID (sub 1)     bit 31: 1 = PDO does not exist · bit 30: no RTR (TPDO) · bit 29: must be 0 · bits 0..10 CAN-ID
    type (sub 2)       0 at the next SYNC after a change · 1..240 every n-th SYNC · 254, 255 by event

The order of a mapping is that of CiA 301: bit 31 set, count 0, entries, count, bit 31 cleared. Every other order is
refused (`sim_bus.mapping`).
"""

from collections.abc import Callable

from canopen.sdo import SdoAbortedError

from sim_bus import objects as od
from sim_bus.mapping import LAST_DUMMY, EntryList, MappedData, Setter
from sim_bus.objects import FORMATS, ObjectStore, key_of

INVALID = 1 << 31
NO_REMOTE = 1 << 30
EXTENDED = 1 << 29
ENTRIES = 8
"""Number of entries of one PDO."""


class Pdo:
    """Configuration of one PDO; a subclass compiles it."""

    receives = False

    def __init__(self, store: ObjectStore, communication: int, mapping: int, on_change: Callable[[], None]) -> None:
        self.store = store
        self.cob_id = INVALID
        self.transmission = 255
        self._on_change = on_change
        live, hooks = store.live, store.hooks
        live[key_of(communication, 1)] = lambda: self.cob_id
        live[key_of(communication, 2)] = lambda: self.transmission
        hooks[key_of(communication, 1)] = self._set_cob_id
        hooks[key_of(communication, 2)] = self._set_transmission
        self.mapping = EntryList(store, mapping, ENTRIES, locked=self._locked, check=self._check,
                                 changed=self._set_count)
        self._communication, self._mapping = communication, mapping

    @property
    def valid(self) -> bool:
        """True if the PDO exists: bit 31 of its COB-ID is clear."""
        return not self.cob_id & INVALID

    @property
    def can_id(self) -> int:
        """CAN identifier of the PDO."""
        return self.cob_id & 0x7FF

    @property
    def synchronous(self) -> bool:
        """True if the PDO acts at SYNC."""
        return self.transmission <= 240

    def clear(self) -> None:
        """Disable the PDO and empty its mapping."""
        self.cob_id, self.mapping.count = INVALID, 0
        self.compile()

    def load(self) -> None:
        """Load the defaults of the object dictionary."""
        default = self.store.default
        count, *entries = [default(key_of(self._mapping, sub)) for sub in range(ENTRIES + 1)]
        self.mapping.load(entries, count)
        self.transmission = default(key_of(self._communication, 2))
        self.cob_id = default(key_of(self._communication, 1))
        self.compile()
        self._on_change()

    def compile(self) -> None:
        """Build the fast path from the mapping."""
        raise NotImplementedError

    def _set_cob_id(self, value: int) -> None:
        if value & EXTENDED or value & 0x1FFFF800 or not value & (INVALID | 0x7FF):
            raise SdoAbortedError(od.ABORT_VALUE)
        if self.valid and not value & INVALID and value & 0x7FF != self.can_id:
            raise SdoAbortedError(od.ABORT_VALUE)      # an existing PDO must be switched off to get another ID
        self.cob_id = value
        self.compile()
        self._on_change()

    def _set_transmission(self, value: int) -> None:
        if 240 < value < 254:
            raise SdoAbortedError(od.ABORT_VALUE)
        self.transmission = value
        self.compile()
        self._on_change()

    def _locked(self, sub: int, value: int) -> bool:
        return self.valid and bool(sub or value != self.mapping.count)

    def _set_count(self) -> None:
        if sum(entry & 0xFF for entry in self.mapping.used) > 64:
            raise SdoAbortedError(od.ABORT_PDO_TOO_LONG)
        self.compile()

    def _check(self, entry: int) -> None:
        if entry >> 16 <= LAST_DUMMY:
            variable = self.store.variable(entry >> 16, entry >> 8 & 0xFF)
            mappable = self.receives and variable.data_type in FORMATS and entry & 0xFF == len(variable)
        else:
            mappable = self.store.mappable(entry, receives=self.receives)
        if not mappable:
            raise SdoAbortedError(od.ABORT_NOT_MAPPABLE)


class ReceivePdo(Pdo):
    """PDO from host to drive. ``setters``: direct write functions; other objects are written through the store."""

    receives = True

    def __init__(self, store: ObjectStore, number: int, setters: dict[int, Setter], on_change: Callable[[], None],
                 on_short: Callable[[], None]) -> None:
        self._fast = setters
        self._data = MappedData(store, ())
        self._on_short = on_short
        self._latched: bytes | bytearray | None = None
        self._acts_at_sync = False
        super().__init__(store, 0x1400 + number, 0x1600 + number, on_change)

    def compile(self) -> None:
        self._data = MappedData(self.store, self.mapping.used, self._fast)
        self._acts_at_sync = self.synchronous
        self._latched = None

    def receive(self, data: bytes | bytearray) -> None:
        """Take a frame: it acts now, or at the next SYNC."""
        if len(data) < self._data.size:
            self._on_short()
        elif self._acts_at_sync:
            self._latched = data
        else:
            self._data.act(data)

    def on_sync(self) -> None:
        """Let the latched frame act."""
        data = self._latched
        if data is not None:
            self._latched = None
            self._data.act(data)


class TransmitPdo(Pdo):
    """PDO from drive to host."""

    def __init__(self, store: ObjectStore, number: int, on_change: Callable[[], None]) -> None:
        self.inhibit_us = 0
        self.event_us = 0
        self._data = MappedData(store, ())
        self._syncs = 0
        self._sent = b""
        self._sent_us = 0
        self._no_remote = False
        communication = 0x1800 + number
        super().__init__(store, communication, 0x1A00 + number, on_change)
        store.hooks[key_of(communication, 3)] = self._set_inhibit
        store.hooks[key_of(communication, 5)] = self._set_event

    def keep_no_remote(self) -> None:
        """Refuse a COB-ID with bit 30 = 0 from now on, as some drives do; the delivered one has the bit set."""
        self._no_remote = True
        delivered = self.store.default(key_of(self._communication, 1))
        self.store.set_default(self._communication, 1, delivered | NO_REMOTE)
        self.load()

    def _set_cob_id(self, value: int) -> None:
        if self._no_remote and not value & NO_REMOTE:
            raise SdoAbortedError(od.ABORT_VALUE)
        super()._set_cob_id(value)

    def compile(self) -> None:
        self._data = MappedData(self.store, self.mapping.used)
        self._syncs = 0
        self._sent = b""

    def pack(self) -> bytes:
        """Return the frame's data at this instant."""
        return self._data.pack()

    def at_sync(self) -> bytes | None:
        """Return the frame to send at this SYNC, if any."""
        every = self.transmission
        if every == 1:
            return self.pack()
        if every > 240:
            return None
        self._syncs += 1
        if every and self._syncs < every:
            return None
        self._syncs = 0
        data = self.pack()
        if every == 0 and data == self._sent:
            return None
        self._sent = data
        return data

    def on_event(self, now_us: int) -> bytes | None:
        """Return the frame to send by event: changed data (not within the inhibit time), or the event timer ran out."""
        since = now_us - self._sent_us
        if self._sent and since < self.inhibit_us:
            return None
        data = self.pack()
        if data == self._sent and not (self.event_us and since >= self.event_us):
            return None
        self._sent, self._sent_us = data, now_us
        return data

    def _set_inhibit(self, value: int) -> None:
        if self.valid:
            raise SdoAbortedError(od.ABORT_STATE)
        self.inhibit_us = 100 * value

    def _set_event(self, value: int) -> None:
        self.event_us = 1000 * value
