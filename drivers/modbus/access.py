"""One drive's registers over a `Link`: requests with their retries, and changes that can be restored."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from drivers.clock import Clock
from drivers.drive import FrameTap, RawFrame
from drivers.errors import CommunicationLost
from drivers.modbus import pdu as requests
from drivers.modbus.codec import WordOrder, from_words, register_name, to_words
from drivers.modbus.link import Link
from drivers.modbus.pdu import BUSY, BadReply, NoReply, RegisterRefused
from profiles.modbus import Register

SETTING_TIMEOUT_S = 1.0
"""Time for a reply before motion, s: a drive may be slow with a parameter (SINAMICS p2024 allows 1 s)."""
TRIES = 3
"""Attempts of a request before motion without a valid reply."""
BUSY_TRIES, BUSY_PAUSE_S = 5, 0.05
"""Attempts of a request that the drive delayed with exception 6, and the pause between them, s."""


class RegisterAnswer(NamedTuple):
    """The registers in a reply, and the control times of request and reply."""

    words: tuple[int, ...]
    sent_s: float
    received_s: float


class RegisterAccess:
    """Register access to one unit; ``tap`` gets every PDU.

    Raises RegisterRefused for an exception reply and CommunicationLost (NoReply, BadReply, LinkLost) otherwise.
    """

    def __init__(
        self, link: Link, unit: int, order: WordOrder, functions: frozenset[int], tap: FrameTap | None = None
    ) -> None:
        self._link = link
        self._unit = unit
        self._order = order
        self._functions = functions
        self._tap = tap
        self.asked = 0                 # number of requests sent to this unit
        self._undo: dict[tuple[str, int], Callable[[], None]] = {}

    @property
    def clock(self) -> Clock:
        """Control time."""
        return self._link.clock

    def once(self, pdu: bytes, timeout_s: float, where: str = "") -> RegisterAnswer:
        """Run one transaction, without retries."""
        if self._tap is not None:
            self._tap(RawFrame(self.clock.now_s(), True, self._unit, pdu))
        self.asked += 1
        reply = self._link.transact(self._unit, pdu, timeout_s)
        if self._tap is not None:
            self._tap(RawFrame(reply.received_s, False, self._unit, reply.pdu))
        return RegisterAnswer(requests.words_of(pdu, reply.pdu, where), reply.sent_s, reply.received_s)

    def ask(self, pdu: bytes, where: str = "") -> tuple[int, ...]:
        """Send a request before motion; repeat it after silence, a damaged reply, or a busy drive."""
        silent = busy = 0
        while True:
            try:
                return self.once(pdu, SETTING_TIMEOUT_S, where).words
            except (NoReply, BadReply) as error:
                silent += 1
                if silent >= TRIES:
                    raise type(error)(error.what, where=where or error.where, next_step=error.next_step) from error
            except RegisterRefused as error:
                busy += 1
                if error.code != BUSY or busy >= BUSY_TRIES:
                    raise
                self.clock.wait_until(self.clock.now_s() + BUSY_PAUSE_S)

    def read_words(self, table: str, address: int, count: int, where: str = "") -> tuple[int, ...]:
        """Read neighbouring registers, in one request."""
        function = requests.READ_HOLDING if table == "holding" else requests.READ_INPUT
        return self.ask(requests.read(function, address, count), where or f"register {address}")

    def read(self, register: Register) -> int:
        """Return the number in a register, in counts."""
        words = self.read_words(register.table, register.address, register.count, register_name(register))
        return from_words(words, register.type, self._order)

    def write(self, register: Register, counts: int) -> None:
        """Write counts into a register. Raises CommandRejected if they don't fit."""
        self.write_words(register.address, to_words(counts, register.type, self._order), register_name(register))

    def write_words(self, address: int, words: tuple[int, ...], where: str = "") -> None:
        """Write neighbouring registers, in one request if the drive has a function for it."""
        self.ask(self.write_request(address, words), where)

    def write_request(self, address: int, words: tuple[int, ...]) -> bytes:
        """Return the PDU that writes neighbouring registers."""
        if len(words) == 1 and requests.WRITE_ONE in self._functions:
            return requests.write_one(address, words[0])
        if requests.WRITE_MANY in self._functions or requests.READ_WRITE not in self._functions:
            return requests.write_many(address, words)
        return requests.read_write(address, len(words), address, words)

    def change(self, register: Register, counts: int) -> int:
        """Write a value, remember the former one, and return the value read back.

        An equal value is not written again: many drives save every write in a memory with limited write cycles.
        """
        before = self.read(register)
        if before == counts:
            return before
        self._undo.setdefault((register.table, register.address), lambda: self.write(register, before))
        self.write(register, counts)
        return self.read(register)

    def press(self, register: Register, counts: int, before: int, timeout_s: float) -> None:
        """Write counts once in a cycle. `restore` writes ``before`` back."""
        self._undo.setdefault((register.table, register.address), lambda: self.write(register, before))
        words = to_words(counts, register.type, self._order)
        self.once(self.write_request(register.address, words), timeout_s, register_name(register))

    @property
    def changed(self) -> tuple[str, ...]:
        """Registers that differ from their former value."""
        return tuple(f"register {address}" for _, address in self._undo)

    def restore(self) -> tuple[str, ...]:
        """Undo every change, the last one first. Return the changes that could not be restored, a line each."""
        failed: list[str] = []
        while self._undo:
            _, undo = self._undo.popitem()
            try:
                undo()
            except RegisterRefused as error:
                failed.append(str(error))
            except CommunicationLost as error:
                failed.append(f"{error} ({len(self._undo)} more settings were not restored)")
                self._undo.clear()
        return tuple(failed)
