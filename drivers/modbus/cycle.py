"""One cycle's numbers: command → registers to write, registers read → feedback. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from drivers.drive import Command, Mode
from drivers.errors import CommandRejected, CommunicationLost, PreflightRefused
from drivers.modbus import pdu
from drivers.modbus.access import RegisterAccess, RegisterAnswer
from drivers.modbus.codec import Scales, WordOrder, from_words, register_name, to_counts, to_words
from drivers.modbus.pdu import BUSY, LinkLost, NoisyReply, RegisterRefused
from profiles import MessageCode
from profiles.modbus import ModbusProfile, Position, Register

# ---------------------------------------------------------------------------------------------------------------------
# Planning of the fewest transactions per cycle from a profile's registers, pure.
#
# Writes never cover a register that was not requested; reads may include up to `largest_gap` others. Setpoints are sent
# before the control word or together with it. With function 23 a write and a read share a transaction (the drive writes
# first); without it each block has its own. Speed and torque are read last, in one transaction if possible, else in two
# consecutive ones.
#
# Values that are not needed every cycle (mode register and display, torque demand, the motor's angle) are included if
# that costs no transaction; the angle only beside speed or torque, so that it belongs to the same moment.


Words = Mapping[tuple[str, int], int]
"""Registers by (table, address)."""


class RegisterSpan(NamedTuple):
    """Neighbouring registers of one table."""

    table: str
    address: int
    length: int

    def covers(self, register: Register) -> bool:
        """Return whether the span contains the whole register."""
        end = register.address + register.count
        return register.table == self.table and self.address <= register.address and end <= self.address + self.length


class Transaction(NamedTuple):
    """One request and its reply: a write, a read, or both."""

    function: int
    write: RegisterSpan | None
    read: RegisterSpan | None

    def request(self, image: Mapping[int, int]) -> bytes:
        """Return the PDU; ``image`` has the word of every holding register that is written."""
        words = [] if self.write is None else [image[self.write.address + k] for k in range(self.write.length)]
        if self.write is None:
            assert self.read is not None
            return pdu.read(self.function, self.read.address, self.read.length)
        if self.function == pdu.WRITE_ONE:
            return pdu.write_one(self.write.address, words[0])
        if self.function == pdu.WRITE_MANY:
            return pdu.write_many(self.write.address, words)
        assert self.read is not None
        return pdu.read_write(self.read.address, self.read.length, self.write.address, words)

    def __str__(self) -> str:
        parts = [f"{verb} {span.address}+{span.length}"
                 for verb, span in (("writes", self.write), ("reads", self.read)) if span is not None]
        return f"{self.function} {' '.join(parts)}"


@dataclass(frozen=True)
class CyclePlan:
    """Transactions on the line: ``cycle`` in each cycle, the others for a mode switch or its check."""

    cycle: tuple[Transaction, ...]
    mode_writes: tuple[Transaction, ...]
    mode_reads: tuple[Transaction, ...]
    has_demand: bool
    has_position: bool = False


def plan_cycle(profile: ModbusProfile, *, position: bool = False) -> CyclePlan:
    """Return the cheapest plan; ``position``: the drive is known to give the profile's angle.

    Raises PreflightRefused if the profile's functions do not suffice.
    """
    cycle, modes = profile.cycle, profile.modes
    setpoints = [cycle.speed_setpoint.register_]
    if modes.torque and cycle.torque_setpoint is not None:
        setpoints.append(cycle.torque_setpoint.register_)
    written = [*setpoints, cycle.control.register_]
    feedback = [cycle.status.register_, cycle.speed.register_, cycle.torque.register_]
    mode_writes = [modes.register_] if modes.register_ is not None else []
    mode_reads = [modes.display.register_] if modes.display is not None else []
    demand = [cycle.torque_demand.register_] if cycle.torque_demand is not None else []

    most_written = min(cycle.largest_write, pdu.MOST_WRITTEN)
    if 16 not in cycle.functions:
        most_written = min(most_written, pdu.MOST_WRITTEN_WITH_READ) if 23 in cycle.functions else 1

    def write_spans(registers: Sequence[Register]) -> list[RegisterSpan]:
        return spans(registers, 0, most_written)

    def read_spans(registers: Sequence[Register]) -> list[RegisterSpan]:
        return spans(registers, cycle.largest_gap, cycle.largest_read)

    if mode_writes and len(write_spans([*written, *mode_writes])) == len(write_spans(written)):
        written, mode_writes = [*written, *mode_writes], []
    for extra in (mode_reads, demand):
        if extra and len(read_spans([*feedback, *extra])) == len(read_spans(feedback)):
            feedback += extra
            if extra is mode_reads:
                mode_reads = []
    # Speed and torque last and side by side, so that their moments are as close as possible.
    moving = (cycle.speed.register_, cycle.torque.register_)
    has_position = False
    if position and profile.position is not None:
        angle = profile.position.register_
        reads = read_spans([*feedback, angle])
        beside = any(span.covers(angle) and any(map(span.covers, moving)) for span in reads)
        has_position = beside and len(reads) == len(read_spans(feedback))
        feedback += [angle] * has_position
    control = cycle.control.register_
    writes = sorted(write_spans(written), key=lambda span: (span.covers(control), span.address))
    reads = sorted(read_spans(feedback), key=lambda span: any(span.covers(one) for one in moving))
    functions = frozenset(cycle.functions)
    return CyclePlan(
        _pair(writes, reads, functions),
        _pair(write_spans(mode_writes), [], functions) if mode_writes else (),
        _pair([], read_spans(mode_reads), functions) if mode_reads else (),
        bool(demand) and demand[0] in feedback,
        has_position,
    )


def only_reads(transactions: Sequence[Transaction], functions: frozenset[int]) -> tuple[Transaction, ...]:
    """Return the reads of these transactions without any write; () if the drive has no function for that."""
    found = []
    for span in (one.read for one in transactions if one.read is not None and one.read != one.write):
        function = pdu.READ_HOLDING if span.table == "holding" else pdu.READ_INPUT
        if function not in functions:
            return ()
        found.append(Transaction(function, None, span))
    return tuple(found)


def spans(registers: Iterable[Register], gap: int, most: int) -> list[RegisterSpan]:
    """Combine registers into as few spans as possible, none split. Raises PreflightRefused if one is too long."""
    found: list[RegisterSpan] = []
    for register in sorted(registers, key=lambda one: (one.table, one.address, one.count)):
        if register.count > most:
            raise PreflightRefused(
                f"a 32-bit number in register {register.address} can't be transferred in one request",
                where="profile, cycle.functions",
                next_step="The drive would apply its halves one after the other. Function 16 or 23 is needed",
                entry=MessageCode.MODBUS_FUNCTIONS_MISSING,
            )
        end = register.address + register.count
        if found:
            last = found[-1]
            near = register.table == last.table and register.address <= last.address + last.length + gap
            if near and end - last.address <= most:
                found[-1] = RegisterSpan(last.table, last.address, max(last.length, end - last.address))
                continue
        found.append(RegisterSpan(register.table, register.address, register.count))
    return found


def _pair(writes: Sequence[RegisterSpan], reads: Sequence[RegisterSpan],
          functions: frozenset[int]) -> tuple[Transaction, ...]:
    """Combine a write and a read into one transaction if function 23 is known. The order of the writes is kept."""
    pairable = [span for span in reads if span.table == "holding"] if pdu.READ_WRITE in functions else []
    fit = [span.length <= pdu.MOST_WRITTEN_WITH_READ for span in writes]
    pairs = min(len(writes), len(pairable)) if all(fit) else 0
    alone, paired = writes[: len(writes) - pairs], writes[len(writes) - pairs :]
    # Take the last pairable reads, so that speed and torque come in the same transactions as the control word.
    shared = pairable[len(pairable) - pairs :]
    rest = [span for span in reads if span not in shared]
    return (
        *(_write(span, functions) for span in alone),
        *(_read(span, functions) for span in rest),
        *(Transaction(pdu.READ_WRITE, one, other) for one, other in zip(paired, shared, strict=True)),
    )


def _write(span: RegisterSpan, functions: frozenset[int]) -> Transaction:
    if span.length == 1 and pdu.WRITE_ONE in functions:
        return Transaction(pdu.WRITE_ONE, span, None)
    if pdu.WRITE_MANY in functions:
        return Transaction(pdu.WRITE_MANY, span, None)
    if pdu.READ_WRITE in functions:
        # The written span is read too, because function 23 always reads.
        return Transaction(pdu.READ_WRITE, span, span)
    raise _unable("written", span)


def _read(span: RegisterSpan, functions: frozenset[int]) -> Transaction:
    function = pdu.READ_HOLDING if span.table == "holding" else pdu.READ_INPUT
    if function not in functions:
        raise _unable("read", span)
    return Transaction(function, None, span)


def _unable(verb: str, span: RegisterSpan) -> PreflightRefused:
    return PreflightRefused(
        f"register {span.address} can't be {verb}: the profile names no function for it",
        where="profile, cycle.functions",
        next_step="List the function codes of the drive there: 3 reads; 6, 16 and 23 write",
        entry=MessageCode.MODBUS_FUNCTIONS_MISSING,
    )


# ---------------------------------------------------------------------------------------------------------------------
# One round of the cycle's transactions on the line, with the time interval of speed and torque.


BUSY_TRIES, BUSY_PAUSE_S = 3, 0.002
"""Attempts and pause, s, of a transaction that the drive delayed with exception 6; then the cycle counts as missed."""


class Round(NamedTuple):
    """Registers read in a round, and the control times that bound the transactions with speed and torque."""

    words: Mapping[tuple[str, int], int]
    sent_s: float
    received_s: float
    longest_s: float               # duration of the longest single transaction, s


def go_round(
    access: RegisterAccess,
    transactions: Sequence[Transaction],
    image: Mapping[int, int],
    timeout_s: float,
    moving: Sequence[Register],
    again_until_s: float = -math.inf,
    *,
    every_write: bool = False,
) -> Round:
    """Run the transactions one after the other; the first that fails ends the round.

    A reply damaged by noise is requested once more, until ``again_until_s`` (control time). ``every_write``: after a
    failure the remaining writes are sent all the same, and then the first error is raised. The line may lose the
    replies only. A stop must then reach the drive, because the requests before its control word feed the watchdog.

    Raises CommunicationLost (NoReply, BadReply, LinkLost) and RegisterRefused.
    """
    words: dict[tuple[str, int], int] = {}
    sent_s: float | None = None
    received_s = longest_s = 0.0
    failed: CommunicationLost | RegisterRefused | None = None
    for transaction in transactions:
        if failed is not None and transaction.write is None:
            continue
        try:
            answer = _patiently(access, transaction.request(image), timeout_s, str(transaction), again_until_s)
        except LinkLost:
            raise
        except (CommunicationLost, RegisterRefused) as error:
            if not every_write:
                raise
            failed = failed or error
            continue
        longest_s = max(longest_s, answer.received_s - answer.sent_s)
        span = transaction.read
        if span is None:
            continue
        words.update({(span.table, span.address + k): word for k, word in enumerate(answer.words)})
        if any(span.covers(register) for register in moving):
            sent_s = answer.sent_s if sent_s is None else sent_s
            received_s = answer.received_s
    if failed is not None:
        raise failed
    return Round(words, sent_s or 0.0, received_s, longest_s)


def _patiently(access: RegisterAccess, pdu: bytes, timeout_s: float, what: str, again_until_s: float) -> RegisterAnswer:
    tries, noisy = 1, False
    while True:
        try:
            return access.once(pdu, timeout_s, f"function {what}")
        except NoisyReply:
            if noisy or access.clock.now_s() >= again_until_s:
                raise
            noisy = True
            continue
        except RegisterRefused as error:
            if error.code != BUSY or tries >= BUSY_TRIES:
                raise
        tries += 1
        access.clock.wait_until(access.clock.now_s() + BUSY_PAUSE_S)


# ---------------------------------------------------------------------------------------------------------------------

class Setpoints(NamedTuple):
    """A command in the drive's own counts. ``reverse``: sign of the speed, if its register has none."""

    speed: int
    torque: int | None
    reverse: bool


class CycleFeedback(NamedTuple):
    """Values read in a cycle, in SI at the motor shaft. ``mode_word``: None if the display was not read."""

    status: int
    speed_rad_s: float
    torque_nm: float
    torque_demand_nm: float | None
    mode_word: int | None
    position_rad: float | None = None          # as counted; None if it was not read


class Codec:
    """The cycle's registers with their scales."""

    def __init__(
        self, profile: ModbusProfile, scales: Scales, *, has_demand: bool, has_position: bool = False
    ) -> None:
        self._cycle = profile.cycle
        self._modes = profile.modes
        self._signless = profile.control.reverse_bits is not None
        self._order: WordOrder = profile.line.word_order
        self._has_demand = has_demand
        self._position = profile.position if has_position else None
        self.scales = scales

    def setpoints(self, command: Command) -> Setpoints:
        """Return the command's counts. Raises CommandRejected for values that are not finite or out of range."""
        entry = self._cycle.speed_setpoint
        reverse = self._signless and command.speed_rad_s < 0.0
        speed_rad_s = -command.speed_rad_s if reverse else command.speed_rad_s
        where = f"speed setpoint, {register_name(entry.register_)}"
        speed = to_counts(speed_rad_s, self.scales.speed_setpoint, entry.register_, where)
        torque_entry = self._cycle.torque_setpoint
        if torque_entry is None or not self._modes.torque:
            if not math.isfinite(command.torque_nm):
                raise CommandRejected(f"{command.torque_nm} N·m is not finite", where="torque setpoint")
            return Setpoints(speed, None, reverse)
        where = f"torque setpoint, {register_name(torque_entry.register_)}"
        torque = to_counts(command.torque_nm, self.scales.torque_setpoint, torque_entry.register_, where)
        return Setpoints(speed, torque, reverse)

    def image(self, controlword: int, setpoints: Setpoints, mode: Mode) -> dict[int, int]:
        """Return every register that a cycle may write, by its address.

        If both setpoints share a register, it holds the one of the requested mode.
        """
        image: dict[int, int] = {}
        numbers: list[tuple[Register, int]] = [(self._cycle.speed_setpoint.register_, setpoints.speed)]
        if self._cycle.torque_setpoint is not None and setpoints.torque is not None:
            numbers.append((self._cycle.torque_setpoint.register_, setpoints.torque))
        if mode is Mode.SPEED:
            numbers.reverse()
        value = self._modes.torque_value if mode is Mode.TORQUE else self._modes.speed_value
        if self._modes.register_ is not None and value is not None:
            numbers.append((self._modes.register_, value))
        for register, number in numbers:
            words = to_words(number, register.type, self._order)
            image.update({register.address + k: word for k, word in enumerate(words)})
        image[self._cycle.control.register_.address] = controlword
        return image

    def feedback(self, words: Words) -> CycleFeedback:
        """Return the values read. Raises KeyError if a register is missing."""
        demand = self._cycle.torque_demand if self._has_demand else None
        display, position = self._modes.display, self._position
        return CycleFeedback(
            self._number(words, self._cycle.status.register_) & 0xFFFF,
            self._number(words, self._cycle.speed.register_) * self.scales.speed,
            self._number(words, self._cycle.torque.register_) * self.scales.torque,
            None if demand is None else self._number(words, demand.register_) * self.scales.torque_demand,
            words.get((display.register_.table, display.register_.address)) if display is not None else None,
            None if position is None else self._number(words, position.register_) * rad_per_count(position),
        )

    def _number(self, words: Words, register: Register) -> int:
        own = [words[register.table, register.address + k] for k in range(register.count)]
        return from_words(own, register.type, self._order)


def rad_per_count(position: Position) -> float:
    """Return rad per count of the motor's angle."""
    return 2.0 * math.pi / position.counts_per_turn


def shown_mode(profile: ModbusProfile, word: int) -> Mode | None:
    """Return the mode that the drive displays; None for another one, or if it displays none."""
    display = profile.modes.display
    if display is None:
        return None
    shown: Mapping[int, Mode] = {display.torque: Mode.TORQUE, display.speed: Mode.SPEED}
    return shown.get(word & display.mask)
