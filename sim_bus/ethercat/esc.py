"""EtherCAT slave controller: registers, memory, datagrams, FMMUs, SyncManagers, SII access, watchdog and clock.

::

    frame      14 bytes Ethernet, ethertype 88A4h · 2 bytes length | type << 12 · datagrams
    datagram   command, index, position or station, offset, length | more << 15, event, data, working counter

Knows no state machine, no mailbox protocol and no drive: they are behind `Pdi`. Nothing here waits or reads a clock.
"""

from collections import deque
from collections.abc import Callable, Container
from struct import Struct
from typing import Protocol

ETHERTYPE = 0x88A4
_ETHERNET_SIZE, _DATAGRAM = 14, Struct("<BBHHHH")
_TIME, _MANAGER_REGISTERS, _FMMU_REGISTERS = Struct("<Q"), Struct("<HHBBBB"), Struct("<IHBBHBBB3x")
_DATAGRAMS = 1
"""Type of the EtherCAT header that is followed by datagrams."""

RAM, MEMORY_SIZE = 0x1000, 0x2000
AL_CONTROL, AL_STATUS, AL_STATUS_CODE = 0x0120, 0x0130, 0x0134
_STATION, _DL_ALIAS = 0x0010, 0x0103
_DIVIDER, _WATCHDOG, _WATCHDOG_STATUS, _WATCHDOG_COUNT = 0x0400, 0x0420, 0x0440, 0x0442
_SII_CONTROL, _SII_ADDRESS, _SII_DATA = 0x0502, 0x0504, 0x0508
_FMMU, FMMUS, _MANAGER, MANAGERS = 0x0600, 8, 0x0800, 8
_LATCH, _SYSTEM_TIME, _LOCAL_TIME, _OFFSET = 0x0900, 0x0910, 0x0918, 0x0920
_WATCHDOG_UNIT_S = 40e-9
"""Least unit of the watchdog divider: 25 MHz."""

_SII_READ, _SII_WRITE, _SII_REFUSED = 0x0100, 0x0200, 0x2000
_WRITABLE = ((0x0010, 0x0012), (0x0100, 0x0104), (0x0120, 0x0122), (0x0200, 0x0202), (0x0300, 0x0314),
             (0x0400, 0x0402), (0x0410, 0x0412), (0x0420, 0x0422), (0x0442, 0x0444), (0x0500, 0x0510),
             (_FMMU, _FMMU + 16 * FMMUS), (0x0900, 0x0904), (0x0910, 0x0918), (0x0920, 0x0936), (0x0980, 0x09A8),
             *((at + first, at + end) for at in range(_MANAGER, _MANAGER + 8 * MANAGERS, 8)
               for first, end in ((0, 5), (6, 7))),         # SyncManager: status and PDI control belong to the slave
             (RAM, MEMORY_SIZE))
_COUNTERS = ((0x0300, 0x0314), (0x0442, 0x0444))
"""Registers that any write clears."""

_DELIVERED = {
    0x0000: bytes((0x11, 0x00, 0x02, 0x00, FMMUS, MANAGERS, 8, 0x0F, 0x0D, 0x00)),   # FMMUs map bytes; clock of 64 bits
    0x0110: bytes((0x13, 0x56)),         # PDI runs; link at port 0 only
    AL_STATUS: b"\1\0", 0x0140: b"\x05\x0C",
    _DIVIDER: (2498).to_bytes(2, "little"), 0x0410: (1000).to_bytes(2, "little"),
    _WATCHDOG: (1000).to_bytes(2, "little"), _WATCHDOG_STATUS: b"\1\0",
}
"""Contents of the registers after power-on."""


_BY_POSITION, _BY_STATION, _BROADCAST, _LOGICAL = range(4)
"""Addressing of a datagram."""
_NOP, _ARMW, _FRMW = 0, 13, 14
"""Commands beside the twelve of `_access`: none; read one slave and write the others, by position or by station."""


def _access(command: int) -> tuple[int, bool, bool]:
    """Return addressing, and whether the command reads and writes: APRD APWR APRW, FPRD …, BRD …, LRD LWR LRW."""
    addressing, how = divmod(command - 1, 3)
    return addressing, how != 1, how != 0


class Pdi(Protocol):
    """Interface to the slave's processor: events of the master, and the present inputs."""

    def al_control(self, word: int) -> None: ...
    def mailbox(self, message: bytes) -> None: ...
    def outputs(self, data: bytes) -> None: ...
    def inputs(self) -> bytes: ...
    def watchdog_expired(self) -> None: ...


class SyncManager:
    """One SyncManager, from its eight registers."""

    def __init__(self, number: int, registers: bytes | bytearray) -> None:
        self.start, self.length, control, _status, active, _pdi = _MANAGER_REGISTERS.unpack(registers)
        self.mailbox, self.host_writes = control & 0x03 == 0x02, control & 0x0C == 0x04
        self.triggers_watchdog = bool(control & 0x40)
        self.enabled = bool(active & 1) and self.length > 0
        self.end = self.start + self.length
        self.status_at = _MANAGER + 8 * number + 5

    def covers(self, begin: int, end: int) -> bool:
        """Return whether the range touches its buffer."""
        return self.enabled and begin < self.end and self.start < end


class Fmmu:
    """One fieldbus memory management unit (FMMU), from its sixteen registers. It maps whole bytes."""

    def __init__(self, registers: bytes | bytearray) -> None:
        self.logical, self.length, _first, _last, self.physical, _bit, kind, active = _FMMU_REGISTERS.unpack(registers)
        self.reads, self.writes = bool(kind & 1), bool(kind & 2)
        self.active = bool(active & 1) and self.length > 0

    def part(self, logical: int, count: int) -> tuple[int, slice]:
        """Return the physical address, and the part of the datagram, of the mapped section of that range."""
        begin, end = max(logical, self.logical), min(logical + count, self.logical + self.length)
        return self.physical + begin - self.logical, slice(begin - logical, max(begin, end) - logical)


class Esc:
    """Slave controller at position 0 of a line that ends with it."""

    def __init__(self, pdi: Pdi, eeprom: bytes) -> None:
        self._pdi = pdi
        self.eeprom = eeprom
        self.memory = bytearray(MEMORY_SIZE)
        for at, data in _DELIVERED.items():
            self.memory[at:at + len(data)] = data
        self.memory[0x0012:0x0014] = eeprom[8:10]
        self.clock_ns = self.fine_ns = 0
        """Local time of the distributed clock, ns: ``clock_ns`` is plant time, ``fine_ns`` the lead of the frame over
        it."""
        self.locked: Container[int] = ()
        """Scripted: registers that keep their values."""
        self.managers = [SyncManager(n, bytes(8)) for n in range(MANAGERS)]
        self._fmmus: list[Fmmu] = []
        self._waiting: deque[bytes] = deque()
        self._last_answer = b""
        self._unfed_s: float | None = None
        """Time since the last outputs, s; None if no watchdog runs."""
        self._after_write: tuple[tuple[int, int, Callable[[], None]], ...] = (
            (AL_CONTROL, AL_CONTROL + 2, lambda: pdi.al_control(self.word(AL_CONTROL))),
            (_SII_CONTROL, _SII_CONTROL + 2, self._access_sii),
            (_FMMU, _FMMU + 16 * FMMUS, self._read_fmmus), (_MANAGER, _MANAGER + 8 * MANAGERS, self._read_managers),
            (_LATCH, _LATCH + 4, self._latch), (_SYSTEM_TIME, _SYSTEM_TIME + 8, self._tell_time),
        )

    def word(self, at: int) -> int:
        """Return a register of 16 bits."""
        return int.from_bytes(self.memory[at:at + 2], "little")

    def set_word(self, at: int, value: int) -> None:
        """Set a register of 16 bits from the slave's side."""
        self.memory[at:at + 2] = value.to_bytes(2, "little")

    # -- frames ------------------------------------------------------------------------------------------

    def answer(self, frame: bytes) -> bytes:
        """Return the frame as it leaves the slave. A frame of another ethertype leaves unchanged."""
        data = bytearray(frame)
        if len(data) < _ETHERNET_SIZE + 2 or int.from_bytes(data[12:14], "big") != ETHERTYPE:
            return bytes(data)
        header = int.from_bytes(data[14:16], "little")
        at, end = _ETHERNET_SIZE + 2, _ETHERNET_SIZE + 2 + (header & 0x07FF)
        more = header >> 12 == _DATAGRAMS
        while more and at + _DATAGRAM.size + 2 <= min(end, len(data)):
            command, index, position, offset, length, event = _DATAGRAM.unpack_from(data, at)
            begin, more = at + _DATAGRAM.size, bool(length & 0x8000)
            at = begin + (length & 0x07FF) + 2
            if at > len(data):
                break
            body, counter = data[begin:at - 2], int.from_bytes(data[at - 2:at], "little")
            gained = 0
            addressing, reads, writes = _access(command)
            if addressing == _LOGICAL:
                gained = self._logical(reads, writes, position | offset << 16, body)
            elif _NOP < command <= _FRMW:
                gained, position = self._physical(command, position, offset, body)
            _DATAGRAM.pack_into(data, begin - _DATAGRAM.size, command, index, position, offset, length, event)
            data[begin:at - 2] = body
            data[at - 2:at] = ((counter + gained) & 0xFFFF).to_bytes(2, "little")
        data[6] |= 0x02                  # as every slave does: the source address is locally administered
        return bytes(data)

    def _physical(self, command: int, position: int, offset: int, body: bytearray) -> tuple[int, int]:
        """Execute a datagram with a physical address. Return the increment of the working counter, and the position
        that leaves.
        """
        addressing, reads, writes = _access(command)
        multiple, step = command in (_ARMW, _FRMW), 2 if reads and writes else 1
        if addressing == _BY_POSITION or command == _ARMW:
            addressed, position = position == 0, (position + 1) & 0xFFFF
        elif addressing == _BROADCAST:
            addressed, position = True, (position + 1) & 0xFFFF
        else:
            alias = self.memory[_DL_ALIAS] & 1 and position == self.word(0x0012)
            addressed = position == self.word(_STATION) or bool(alias)
        if multiple:
            reads, writes = addressed, not addressed
        sent, gained = bytes(body), 0
        if reads and addressed and (found := self._read(offset, len(body))) is not None:
            body[:] = bytes(a | b for a, b in zip(body, found, strict=True)) if addressing == _BROADCAST else found
            gained = 1
        if writes and (addressed or multiple) and self._write(offset, sent):
            gained += step
        return gained, position

    def _logical(self, reads: bool, writes: bool, logical: int, body: bytearray) -> int:
        """Execute a datagram with a logical address. Return the increment of the working counter. Reads come first."""
        sent, was_read, was_written = bytes(body), False, False
        for fmmu in self._fmmus:
            at, place = fmmu.part(logical, len(body))
            count = place.stop - place.start
            if count and fmmu.reads and reads and (found := self._read(at, count)) is not None:
                body[place] = found
                was_read = True
        for fmmu in self._fmmus:
            at, place = fmmu.part(logical, len(body))
            if sent[place] and fmmu.writes and writes:
                was_written |= self._write(at, sent[place])
        return was_read + (2 if reads and writes else 1) * was_written

    # -- memory ------------------------------------------------------------------------------------------

    def _read(self, at: int, count: int) -> bytes | None:
        """Return the data that a master reads there; None if reading is not allowed."""
        end = at + count
        if end > MEMORY_SIZE:
            return None
        if at < _OFFSET and end > _SYSTEM_TIME:
            self._tell_time()
        manager = next((one for one in self.managers if one.covers(at, end)), None)
        if manager is None or at < RAM:
            return bytes(self.memory[at:end])
        if not manager.mailbox:
            if not manager.host_writes and at <= manager.start:
                inputs = self._pdi.inputs()[:manager.length]
                self.memory[manager.start:manager.start + len(inputs)] = inputs
            return bytes(self.memory[at:end])
        if manager.host_writes or not self._full(manager):
            return None
        found = bytes(self.memory[at:end])
        if end >= manager.end:
            self._mark(manager, 0)
            self._next_answer()
        return found

    def _write(self, at: int, data: bytes) -> bool:
        """Write as a master. Return False if writing is not allowed."""
        end = at + len(data)
        parts = [(max(at, a), min(end, b)) for a, b in _WRITABLE if at < b and a < end]
        if end > MEMORY_SIZE or not parts:
            return False
        if at in self.locked:
            return True
        manager = next((one for one in self.managers if at >= RAM and one.covers(at, end)), None)
        if manager is not None and (not manager.host_writes or (manager.mailbox and self._full(manager))):
            return False
        for begin, stop in parts:
            self.memory[begin:stop] = data[begin - at:stop - at]
        if at < RAM:
            for first, last in _COUNTERS:
                if at < last and first < end:
                    self.memory[first:last] = bytes(last - first)
            for first, last, act in self._after_write:
                if at < last and first < end:
                    act()
        elif manager is not None and end >= manager.end:
            self._written(manager)
        return True

    def _written(self, manager: SyncManager) -> None:
        """Handle the last byte of a buffer."""
        data = bytes(self.memory[manager.start:manager.end])
        if manager.mailbox:
            self._mark(manager, 8)
            self._pdi.mailbox(data)
            self._mark(manager, 0)
            return
        if manager.triggers_watchdog:
            self._unfed_s = 0.0
            self.memory[_WATCHDOG_STATUS] |= 1
        self._pdi.outputs(data)

    def _full(self, manager: SyncManager) -> bool:
        return bool(self.memory[manager.status_at] & 8)

    def _mark(self, manager: SyncManager, full: int) -> None:
        self.memory[manager.status_at] = self.memory[manager.status_at] & ~8 | full

    def _read_fmmus(self) -> None:
        units = (Fmmu(self.memory[at:at + 16]) for at in range(_FMMU, _FMMU + 16 * FMMUS, 16))
        self._fmmus = [one for one in units if one.active]

    def _read_managers(self) -> None:
        places = range(_MANAGER, _MANAGER + 8 * MANAGERS, 8)
        self.managers = [SyncManager(n, self.memory[at:at + 8]) for n, at in enumerate(places)]
        for one in self.managers:
            self.memory[one.status_at] &= 0xFF * one.enabled
        request, acknowledged = (self.memory[_MANAGER + 8 + own] & 2 for own in (6, 7))
        if request != acknowledged:            # the master requests the last message again: its frame was lost
            self.memory[_MANAGER + 8 + 7] ^= 2
            if self._last_answer:
                self._put(self._last_answer)

    # -- mailbox to the master ---------------------------------------------------------------------------

    def post(self, message: bytes) -> None:
        """Put a message into the mailbox that the master reads, behind those that wait."""
        self._waiting.append(message)
        if not self._full(self.managers[1]):
            self._next_answer()

    def clear_mailbox(self) -> None:
        """Clear all messages, when the mailbox starts or ends."""
        self._waiting.clear()
        self._last_answer = b""
        self._mark(self.managers[1], 0)

    def _next_answer(self) -> None:
        if self._waiting:
            self._last_answer = self._waiting.popleft()
            self._put(self._last_answer)

    def _put(self, message: bytes) -> None:
        manager = self.managers[1]
        if manager.enabled and manager.mailbox and not manager.host_writes:
            self.memory[manager.start:manager.end] = message[:manager.length].ljust(manager.length, b"\0")
            self._mark(manager, 8)

    # -- SII, watchdog, clock ----------------------------------------------------------------------------

    def _access_sii(self) -> None:
        """Read four bytes of the EEPROM. A write is refused."""
        control = self.word(_SII_CONTROL)
        at = 2 * int.from_bytes(self.memory[_SII_ADDRESS:_SII_ADDRESS + 4], "little")
        if control & _SII_READ:
            self.memory[_SII_DATA:_SII_DATA + 4] = self.eeprom[at:at + 4].ljust(4, b"\xff")
        self.set_word(_SII_CONTROL, _SII_REFUSED if control & _SII_WRITE else 0)

    def stop_watchdog(self) -> None:
        """End the watchdog: no outputs are expected."""
        self._unfed_s = None

    def expire_watchdog(self) -> None:
        """Handle the end of the watchdog's time."""
        self._unfed_s = None
        self.memory[_WATCHDOG_STATUS] &= ~1
        self.memory[_WATCHDOG_COUNT] = min(255, self.memory[_WATCHDOG_COUNT] + 1)
        self._pdi.watchdog_expired()

    def pass_time(self, duration_us: int) -> None:
        """Advance clock and watchdog by this time."""
        self.clock_ns += 1000 * duration_us
        if self._unfed_s is not None:
            self._unfed_s += 1e-6 * duration_us
            longest_s = (self.word(_DIVIDER) + 2) * _WATCHDOG_UNIT_S * self.word(_WATCHDOG)
            if 0.0 < longest_s < self._unfed_s:
                self.expire_watchdog()

    def _tell_time(self) -> None:
        offset, = _TIME.unpack_from(self.memory, _OFFSET)
        _TIME.pack_into(self.memory, _SYSTEM_TIME, (self.clock_ns + self.fine_ns + offset) % (1 << 64))

    def _latch(self) -> None:
        """Store the receive times of this frame, at port 0 and at the processing unit."""
        now = self.clock_ns + self.fine_ns
        _TIME.pack_into(self.memory, _LOCAL_TIME, now)
        self.memory[_LATCH:_LATCH + 4] = self.memory[_LOCAL_TIME:_LOCAL_TIME + 4]
