"""CoE through the mailbox of a slave: SDO (expedited, normal, segmented) and emergency messages.

A request is written to sync manager 0. The answer is read from sync manager 1 when its status shows a full buffer. The
control loop does both itself, so a slow drive does not delay a cycle: `Mailbox.post` sends a request, and
`Mailbox.pump` reads an answer if there is one. The counter in the header is 0, which every slave accepts as a new
message.

::

    length u16, address u16, priority u8, type u8 | service << 12 u16 | command u8, index u16, sub-index u8, data
                mailbox header                      CoE header          SDO

Source: ETG.1000.6, mailbox and CoE; CiA 301, SDO.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress

from drivers.cia402 import SdoClient, is_answer
from drivers.clock import Clock
from drivers.errors import CommunicationLost, ObjectRefused
from drivers.ethercat.station import SYNC_MANAGER_BYTES, SYNC_MANAGERS, Station, not_answered

COE = 3
EMERGENCY, SDO_REQUEST, SDO_RESPONSE = 1, 2, 3
ANSWER_S, TRIES = 0.7, 3
"""Waiting time for an answer at standstill, s, and number of attempts."""
_PAUSE_S = 0.0005
_FULL = 1 << 3


class Mailbox:
    """The mailbox of one slave."""

    def __init__(self, station: Station, clock: Clock) -> None:
        self._station, self._clock = station, clock
        (self._out, self._out_size), (self._in, self._in_size) = (0, 0), (0, 0)
        self.on_emergency: Callable[[bytes], None] = lambda data: None
        """Called with the eight bytes of an emergency message."""
        self.on_answer: Callable[[bytes], None] = lambda sdo: None
        """Called with each SDO answer that no request waits for."""
        self.on_message: Callable[[bool, int, bytes], None] = lambda outgoing, manager, message: None
        """Called with each message and the number of its sync manager."""

    @property
    def place(self) -> str:
        """Name of the slave in messages."""
        return self._station.place

    def find(self) -> None:
        """Read addresses and lengths of the two mailboxes. Raises CommunicationLost if the slave has none."""
        (self._out, self._out_size, _), (self._in, self._in_size, _) = map(self._station.sync_manager, (0, 1))
        if not self._out_size or not self._in_size:
            raise not_answered("the slave has no mailbox in this state", self._station.place)

    def post(self, sdo: bytes) -> None:
        """Send an SDO request. Raises CommunicationLost if the mailbox is full or the slave does not answer."""
        if not self._out_size:
            self.find()
        message = (len(sdo) + 2).to_bytes(2, "little") + bytes((0, 0, 0, COE)) + bytes((0, SDO_REQUEST << 4)) + sdo
        if len(message) > self._out_size:
            raise ObjectRefused(f"{len(sdo)} bytes do not fit into the mailbox", where=self._station.place)
        self._station.write(self._out, message.ljust(self._out_size, b"\0"))
        self.on_message(True, 0, message)

    def pump(self) -> bytes | None:
        """Take one message out if there is one. Return its SDO part; emergency messages are passed on."""
        if not self._in_size:
            self.find()
        if not self._station.number(SYNC_MANAGERS + SYNC_MANAGER_BYTES + 5, 1) & _FULL:
            return None
        data = self._station.read(self._in, self._in_size)
        message = data[: 6 + int.from_bytes(data[:2], "little")]
        self.on_message(False, 1, message)
        if message[5] & 0xF != COE or len(message) < 8:
            return None
        service, rest = message[7] >> 4, message[8:]
        if service == EMERGENCY:
            self.on_emergency(rest)
        return rest if service in (SDO_REQUEST, SDO_RESPONSE) and len(rest) >= 3 else None

    def look(self) -> None:
        """Take one message out if there is one, and pass it on."""
        if (sdo := self.pump()) is not None:
            self.on_answer(sdo)

    def call(self, sdo: bytes, answer_s: float, tries: int, where: str) -> bytes:
        """Send a request and wait for its answer. Raises CommunicationLost without one."""
        for _ in range(tries):
            with suppress(CommunicationLost):          # sent again, or reported below
                self.look()
                self.post(sdo)
                end_s = time.monotonic() + answer_s
                while time.monotonic() < end_s:
                    found = self.pump()
                    if found is not None and is_answer(sdo, found[:8]):
                        return found
                    if found is not None:
                        self.on_answer(found)
                    else:
                        time.sleep(0.0 if self._clock.stepped else _PAUSE_S)
        raise not_answered(f"no answer to an SDO request (CoE) for {where}", self._station.place)


class CoeObjects(SdoClient):
    """The object dictionary of one slave, by CoE."""

    def __init__(self, mailbox: Mailbox) -> None:
        super().__init__(ANSWER_S, (TRIES, 1), normal=True, drive=mailbox.place)
        self._mailbox = mailbox

    def call(self, request: bytes, where: str, answer_s: float, tries: int) -> bytes:
        """Send a request and wait for its answer. Raises CommunicationLost without one."""
        return self._mailbox.call(request, answer_s, tries, where)

    def tell(self, message: bytes) -> None:
        """Send a message that has no answer."""
        self._mailbox.post(message)
