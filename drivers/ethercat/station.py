"""Registers of an EtherCAT slave controller (ESC), and the AL state machine behind them.

::

    INIT ─► PRE-OP ─► SAFE-OP ─► OP        0120h AL control (host), 0130h AL status (slave), 0134h AL status code
            mailbox   feedback   setpoints

Source: ETG.1000.4 (data link layer: registers), ETG.1000.6 (application layer: states and AL status codes).
"""

from __future__ import annotations

import struct
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import NamedTuple

from drivers.errors import CommunicationLost, DriveFault, PreflightRefused
from profiles import MessageCode

FEATURES, ALIAS = 0x0008, 0x0012
AL_CONTROL, AL_STATUS = 0x0120, 0x0130
SYNC_MANAGERS, SYNC_MANAGER_BYTES = 0x0800, 8
"""Address of the first sync manager's registers, and their length, bytes: start address u16, length u16, control u8,
status u8, activation u8, PDI control u8."""
FMMU_COUNT, FMMUS, FMMU_BYTES = 0x0004, 0x0600, 16
"""Register with the number of FMMUs, address of the first one's registers, and their length, bytes."""
READS, WRITES = 1, 2
"""Types of an FMMU: the master reads inputs, or writes outputs."""
HAS_CLOCKS = 1 << 2
"""Bit of 0008h: the slave controller has distributed clocks."""

INIT, PRE_OP, SAFE_OP, OP = 1, 2, 4, 8
ERROR_OR_ACKNOWLEDGE = 1 << 4
"""Bit of AL status (error) and of AL control (acknowledge it)."""
_NAMES = {INIT: "INIT", PRE_OP: "PRE-OP", 3: "BOOT", SAFE_OP: "SAFE-OP", OP: "OP"}
REGISTER_US, CYCLE_US = 200_000, 2_000
"""Time in which a register's datagram is repeated until it is answered, µs: before motion or in stepped time, and in a
cycle."""
STATE_S = 5.0
"""Longest time for a change of the AL state, s; ETG.1020 allows 10 s for SAFE-OP to OP and 5 s for the others."""
_PAUSE_S = 0.002
_FMMU = struct.Struct("<IHxxHxBB3x")

_CODES = {
    0x0000: "no error", 0x0001: "unspecified error", 0x0011: "invalid requested state change",
    0x0012: "unknown requested state", 0x0016: "invalid mailbox configuration",
    0x0017: "invalid sync manager configuration", 0x0018: "no valid inputs", 0x0019: "no valid outputs",
    0x001A: "synchronization error", 0x001B: "sync manager watchdog", 0x001D: "invalid output configuration",
    0x001E: "invalid input configuration", 0x001F: "invalid watchdog configuration", 0x0024: "invalid input mapping",
    0x0025: "invalid output mapping", 0x002C: "fatal SYNC error", 0x002D: "no SYNC error",
    0x0030: "invalid DC SYNC configuration", 0x0032: "PLL error", 0x0035: "invalid DC SYNC cycle time",
}
SM_WATCHDOG = 0x001B


class AlStatus(NamedTuple):
    """AL state of a slave. ``code``: AL status code, meaningful with ``error``."""

    state: int
    error: bool
    code: int

    @property
    def text(self) -> str:
        """The state in words, with the AL status code if there is an error."""
        meaning = _CODES.get(self.code, "see the manual of the drive")
        return state_name(self.state) + (f", AL status code {self.code:04X}h ({meaning})" if self.error else "")


class ActiveFmmu(NamedTuple):
    """Active fieldbus memory management unit: it maps logical addresses to the slave's memory, in bytes.

    ``kind``: `READS` (inputs) or `WRITES` (outputs).
    """

    logical: int
    length: int
    physical: int
    kind: int

    def overlaps(self, other: ActiveFmmu) -> bool:
        """Return whether both map a common logical address."""
        return self.logical < other.logical + other.length and other.logical < self.logical + self.length


def state_name(state: int) -> str:
    """Return the name of an AL state."""
    return _NAMES.get(state, f"state {state:X}h")


class Station(ABC):
    """One slave's registers. ``place``: its name for messages. ``wait_us``: time for an answer, µs."""

    place = "slave"
    wait_us = REGISTER_US

    @abstractmethod
    def read(self, offset: int, size: int) -> bytes:
        """Return registers or memory of the slave controller. Raises CommunicationLost without an answer."""

    @abstractmethod
    def write(self, offset: int, data: bytes) -> None:
        """Write registers or memory of the slave controller. Raises CommunicationLost if it takes none."""

    def number(self, offset: int, size: int = 2) -> int:
        """Return a register as a number."""
        return int.from_bytes(self.read(offset, size), "little")

    def al_status(self) -> AlStatus:
        """Return the AL state."""
        data = self.read(AL_STATUS, 6)
        status = int.from_bytes(data[:2], "little")
        return AlStatus(status & 0xF, bool(status & ERROR_OR_ACKNOWLEDGE), int.from_bytes(data[4:6], "little"))

    def ask_for(self, state: int) -> bool:
        """Request an AL state without waiting. Return False if the slave shows an error.

        Then only the error is acknowledged, and the state must be requested again once the error is cleared. AL control
        holds one request: a slave ignores a write that comes before its firmware has read the last one.
        """
        found = self.al_status()
        if found.error:
            self.write(AL_CONTROL, (found.state | ERROR_OR_ACKNOWLEDGE).to_bytes(2, "little"))
        else:
            self.write(AL_CONTROL, state.to_bytes(2, "little"))
        return not found.error

    def reach(self, state: int, keep_on: Callable[[], None] | None = None) -> None:
        """Request an AL state and wait for it; ``keep_on`` is called meanwhile.

        An error that the slave shows before the request is acknowledged. Raises DriveFault if the slave refuses the
        state, or is not there after `STATE_S`.
        """
        asked = self.ask_for(state)
        end_s = time.monotonic() + STATE_S
        while True:
            if keep_on is not None:
                keep_on()
            found = self.al_status()
            if not found.error:
                if found.state == state:
                    return
                if not asked:
                    asked = self.ask_for(state)
            if (found.error and asked) or time.monotonic() > end_s:
                raise DriveFault(
                    f"the drive does not change to {state_name(state)}: it shows {found.text}", where=self.place,
                    next_step="See the manual of the drive for this AL status code: mapping, watchdog, cycle or clock",
                    entry=MessageCode.STATE_LEFT,
                )
            time.sleep(_PAUSE_S)

    def sync_manager(self, number: int) -> tuple[int, int, int]:
        """Return start address, length in bytes, and control byte of a sync manager."""
        data = self.read(SYNC_MANAGERS + number * SYNC_MANAGER_BYTES, 5)
        return int.from_bytes(data[:2], "little"), int.from_bytes(data[2:4], "little"), data[4]

    def fmmus(self) -> list[ActiveFmmu]:
        """Return the active FMMUs."""
        data = self.read(FMMUS, self.number(FMMU_COUNT, 1) * FMMU_BYTES)
        return [ActiveFmmu(*values) for *values, active in _FMMU.iter_unpack(data) if active & 1]


def not_answered(what: str, place: str) -> CommunicationLost:
    """Return the error for a slave that does not answer."""
    return CommunicationLost(what, where=place, next_step="Check cable, supply of the drive, and --position",
                             entry=MessageCode.COMMUNICATION_LOST)


def station_of(stations: Sequence[Station], interface: str, position: int, alias: int | None) -> Station:
    """Return the slave at the position, or with the configured station alias. Raises PreflightRefused."""
    found = [one for number, one in enumerate(stations)
             if (number == position if alias is None else one.number(ALIAS) == alias)]
    if len(found) == 1:
        return found[0]
    wanted = f"at position {position}" if alias is None else f"with station alias {alias}"
    text, next_step = f"slaves are {wanted}; {len(stations)} answer", "See tdhil scan; positions begin at 0"
    if found:
        raise PreflightRefused(f"{len(found)} {text}", where=interface, next_step=next_step,
                               entry=MessageCode.NODE_ID_CONFLICT)
    raise PreflightRefused(f"no {text}", where=interface, next_step=next_step, entry=MessageCode.NO_DRIVE_FOUND)


def has_clocks(station: Station) -> bool:
    """Return whether the slave controller has distributed clocks."""
    return bool(station.number(FEATURES) & HAS_CLOCKS)
