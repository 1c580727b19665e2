"""Process data: PDO mapping 1600h to 1607h and 1A00h to 1A07h, assignment 1C12h and 1C13h, and the fast path."""

from collections.abc import Callable, Mapping

from canopen.objectdictionary import datatypes
from canopen.sdo import SdoAbortedError

from sim_bus import objects as od
from sim_bus.ethercat.sii import SiiPdo
from sim_bus.mapping import EntryList, MappedData, Setter
from sim_bus.objects import ObjectStore

PDOS, ENTRIES, SIZE_LIMIT = 8, 8, 64
"""Number of PDOs in one direction, entries of a PDO, bytes of one direction."""

GAPS = (8, 16, 32)
"""Lengths of an entry without an object (index 0), bits."""

DEFAULT_OUTPUTS = (0x60400010, 0x60600008, 0x00000008, 0x60710010, 0x60FF0020)
DEFAULT_INPUTS = (0x60410010, 0x60610008, 0x00000008, 0x60770010, 0x606C0020, 0x60640020)


class ProcessData:
    """One direction: mappings and their assignment to a SyncManager. ``writable``: in the present state. ``usual``: the
    PDO that is assigned and filled as delivered.
    """

    def __init__(self, store: ObjectStore, *, outputs: bool, writable: Callable[[], bool], usual: int,
                 setters: Mapping[int, Setter] | None = None) -> None:
        self._store, self.outputs, self._writable, self._usual, self._setters = store, outputs, writable, usual, setters
        self.first, self.manager, kind = (0x1600, 2, "Receive") if outputs else (0x1A00, 3, "Transmit")
        self._mappings = [
            self._list(number, f"{kind} PDO {number - self.first + 1} mapping", datatypes.UNSIGNED32, ENTRIES)
            for number in range(self.first, self.first + PDOS)
        ]
        self._assigned = self._list(0x1C10 + self.manager, f"SyncManager {self.manager} PDO assignment",
                                    datatypes.UNSIGNED16, PDOS)
        default = [one for one in (DEFAULT_OUTPUTS if outputs else DEFAULT_INPUTS)
                   if not one >> 16 or one >> 16 in store.object_dictionary]
        self._mappings[usual - self.first].load(default, len(default))
        self._assigned.load([usual], 1)
        self.compile()

    def _list(self, index: int, name: str, data_type: int, size: int) -> EntryList:
        for sub in (*range(1, size + 1), 0):            # a record begins with a member other than 0
            kind = data_type if sub else datatypes.UNSIGNED8
            self._store.add(index, sub, kind, writable=True, mappable=False, name=name)
        check = self._check_entry if data_type == datatypes.UNSIGNED32 else self._check_pdo
        return EntryList(self._store, index, size, locked=lambda sub, value: not self._writable(), check=check,
                         changed=self.compile)

    def delivered(self) -> SiiPdo:
        """Return the PDO of the delivered assignment, for the EEPROM."""
        mapping = self._mappings[self._usual - self.first].used
        return SiiPdo(self._usual, self.manager, [(one, self._kind(one)) for one in mapping])

    def compile(self) -> None:
        """Build the fast path of the assigned PDOs."""
        entries = [entry for pdo in self._assigned.used if pdo for entry in self._mappings[pdo - self.first].used]
        if sum(entry & 0xFF for entry in entries) > 8 * SIZE_LIMIT:
            raise SdoAbortedError(od.ABORT_PDO_TOO_LONG)
        self.data = MappedData(self._store, entries, self._setters)

    def _kind(self, entry: int) -> int:
        return self._store.variable(entry >> 16, entry >> 8 & 0xFF).data_type or 0 if entry >> 16 else 0

    def _check_pdo(self, pdo: int) -> None:
        if pdo and not self.first <= pdo < self.first + PDOS:
            raise SdoAbortedError(od.ABORT_VALUE)

    def _check_entry(self, entry: int) -> None:
        """Check an entry: an object that can be mapped in this direction, or a gap, with its length."""
        gap = not entry >> 16
        if not (not entry or entry in GAPS if gap else self._store.mappable(entry, receives=self.outputs)):
            raise SdoAbortedError(od.ABORT_NOT_MAPPABLE)
