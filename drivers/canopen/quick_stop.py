"""The bare quick stop of a CiA 402 drive on CANopen (`drivers.quick_stop`): controlword 6040h, bit 2 low.

It is sent by SDO, which needs no mapping and no SYNC. Another master that continues to send enable operation in its
RPDO reverses it with its next frame (transition 16 of the state machine). Then the same word is sent in that RPDO too,
in a burst, so that one of them is in the drive when the SYNC comes. A master that watches the state sees the stop and
gives up. If even that is reversed, the RPDO that carries 6040h is switched off in the drive (bit 31 of 1400h:1).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from drivers.canopen.bus import CanLink
from drivers.canopen.pdo_mapping import DISABLED
from drivers.canopen.sdo import SdoObjects
from drivers.cia402 import CONTROLWORD, Cia402Target, mapping_entry, name
from drivers.clock import Clock
from drivers.errors import DriveFault
from profiles.canopen import CanopenProfile

if TYPE_CHECKING:
    import can

BY_SDO_TRIES, BY_RPDO_TRIES = 3, 6
"""Attempts by SDO alone, then attempts with a burst of RPDOs; after them the RPDO is switched off."""
BURST, BURST_PAUSE_S = 200, 0.0005
_RPDOS = 4


class CanopenTarget(Cia402Target):
    """One CANopen node on an open bus, for a bare quick stop."""

    def __init__(self, bus: can.BusABC, profile: CanopenProfile, clock: Clock, *, node: int) -> None:
        self._link = CanLink(bus, clock)
        self._link.stopping = True
        super().__init__(SdoObjects(self._link, node), profile, clock)
        self._foreign = 0
        self._syncs = 0
        for identifier in (0x200, 0x300, 0x400, 0x500):
            self._link.handlers[identifier + node] = self._on_foreign
        self._link.handlers[0x600 + node] = self._on_foreign
        self._link.handlers[0x080] = self._on_sync
        self._node = node

    def enforce(self, attempt: int) -> None:
        """Send the quick stop in RPDOs too, then switch the other master's RPDO off."""
        if attempt > BY_SDO_TRIES + BY_RPDO_TRIES:
            for index, cob_id, _, _ in self._rpdos():
                self._objects.write(index, 1, cob_id | DISABLED, 32)
                self._said.append(
                    f"the RPDO of the other master was switched off: {name(index, 1)} = {cob_id | DISABLED:08X}h;"
                    " to enable it again, restart the drive or start a run"
                )
        elif attempt > BY_SDO_TRIES:
            frames = [       # each RPDO: zeros, with the controlword in its place; offset and length in bits
                (cob_id & 0x7FF, (self._word << offset).to_bytes(length // 8, "little"))
                for _, cob_id, offset, length in self._rpdos()
            ]
            if not frames:
                raise DriveFault("no RPDO carries the controlword", where=name(0x1600))
            for _ in range(BURST):
                for identifier, data in frames:
                    self._link.send(identifier, data)
                self._link.pump_until(lambda: False, BURST_PAUSE_S)

    def wait(self, time_s: float) -> None:
        """Handle frames for this wall time, s."""
        self._link.pump_until(lambda: False, time_s)

    def stepped_by_another(self, stepped: bool) -> bool:
        """Return whether another master sends SYNC, by which a drive in stepped time advances."""
        return self._link.pump_until(lambda: self._syncs > 0, 0.2 if stepped else 0.0)

    def remarks(self) -> tuple[str, ...]:
        """Return remarks on another master, and on changes made in the drive."""
        heard: tuple[str, ...] = ()
        if self._foreign or self._syncs:
            heard = (f"another master is on the bus: {self._foreign} frames to node {self._node} and {self._syncs}"
                     " SYNC were received. Stop it too",)
        return (*heard, *super().remarks())

    def close(self) -> None:
        """Close the bus."""
        self._link.close()

    def _rpdos(self) -> list[tuple[int, int, int, int]]:
        """Return (1400h…, COB-ID, bit offset of 6040h, length in bits) of every enabled RPDO that carries 6040h."""
        found = []
        for number in range(_RPDOS):
            cob_id = self._objects.read_if_there(0x1400 + number, 1)
            if cob_id is None or cob_id & DISABLED:
                continue
            count = self._objects.read_if_there(0x1600 + number, 0) or 0
            at, place = 0, None
            for sub in range(1, min(count, 8) + 1):
                entry = self._objects.read(0x1600 + number, sub)
                if entry == mapping_entry(CONTROLWORD):
                    place = at
                at += entry & 0xFF
            if place is not None and at % 8 == 0 and at <= 64:
                found.append((0x1400 + number, cob_id, place, at))
        return found

    def _on_foreign(self, data: bytes) -> None:
        self._foreign += 1

    def _on_sync(self, data: bytes) -> None:
        self._syncs += 1
