"""One drive's registers over a `Link`: requests with their retries, and changes that can be restored."""

from __future__ import annotations

from typing import NamedTuple

from drivers.clock import Clock
from drivers.drive import FrameTap, Identity, RawFrame
from drivers.modbus import pdu as requests
from drivers.modbus.codec import RegisterType, WordOrder, from_words, register_name, to_words
from drivers.modbus.link import Link
from drivers.modbus.pdu import BUSY, BadReply, NoReply, RegisterRefused
from drivers.preflight import PreflightTable
from drivers.undo_journal import Change, UndoJournal, Undos, restore_left
from profiles.modbus import Register

SETTING_TIMEOUT_S = 1.0
"""Time for a reply before motion, s: a drive may be slow with a parameter (SINAMICS p2024 allows 1 s)."""
TRIES = 3
"""Attempts of a request before motion without a valid reply."""
BUSY_TRIES, BUSY_PAUSE_S = 5, 0.05
"""Attempts of a request that the drive delayed with exception 6, and the pause between them, s."""
_TYPES: dict[int, RegisterType] = {2: "u16", 4: "u32"}
"""Type of a register in the undo journal by the length of its value, bytes. The sign has no effect on the words."""


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
        self.journal: UndoJournal | None = None        # records each change before it is made
        self._undos = Undos()

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
        if self.journal is not None:
            self.journal.changing(register_name(register), _bytes(register, before), _bytes(register, counts))
        self._add_undo(register, before)
        self.write(register, counts)
        return self.read(register)

    def press(self, register: Register, counts: int, before: int, timeout_s: float) -> None:
        """Write counts once in a cycle. `restore` writes ``before`` back."""
        words = to_words(counts, register.type, self._order)
        if self.journal is not None:
            self.journal.changing_in_motion(register_name(register), _bytes(register, before), _bytes(register, counts))
        self._add_undo(register, before)
        self.once(self.write_request(register.address, words), timeout_s, register_name(register))

    def _add_undo(self, register: Register, before: int) -> None:
        """Register the restore of a register, unless it was changed before in this run."""
        where = register_name(register)
        if where in self.changed:
            return

        def give_back() -> None:
            self.write(register, before)
            if self.journal is not None:
                self.journal.given_back(where)

        self._undos.add([where], give_back)

    @property
    def changed(self) -> tuple[str, ...]:
        """Registers that differ from their former value."""
        return tuple(name for names in self._undos.names for name in names)

    def restore(self) -> tuple[str, ...]:
        """Undo every change, the last one first. Return the changes that could not be restored, a line each."""
        return self._undos.restore(lambda: self.changed)

    def restore_from(self, table: PreflightTable, journal: UndoJournal, identity: Identity) -> bool:
        """Restore the settings that an earlier run left in the drive because its host died, if they are unchanged.

        Later changes are recorded in the journal. Return whether a register was written.
        """
        def give_back(one: Change) -> bool:
            address, kind = int(one.where.split()[1]), _TYPES[len(one.before)]
            after, before = (to_words(int.from_bytes(data, "little"), kind, self._order)
                             for data in (one.after, one.before))
            unchanged = self.read_words("holding", address, len(after), one.where) == after
            if unchanged:
                self.write_words(address, before, one.where)
            return unchanged

        written = restore_left(table, journal, reversed(journal.opened(identity)), give_back)
        self.journal = journal
        return written


def _bytes(register: Register, counts: int) -> bytes:
    """Return counts as the undo journal holds them: two bytes for each register, the low byte first."""
    length = 2 * register.count
    return (counts % (1 << 8 * length)).to_bytes(length, "little")
