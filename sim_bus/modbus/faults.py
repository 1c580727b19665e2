"""Scripted faults of one simulated Modbus drive: each fault begins and ends on time, and changes requests and replies.

All times are plant time. The host's write of the stage (`profiles.simulator_marker.MARKER_STAGE_REGISTER`) belongs to
the rehearsal, not to the line: no fault affects it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from profiles import MARKER_STAGE_REGISTER
from profiles.modbus import ModbusProfile
from sim_bus.cia402 import OperationMode
from sim_bus.fault_script import (
    FAULT_SEED,
    STOP,
    Cast,
    FaultKind,
    FaultRefused,
    Kinds,
    KnownFault,
    Moment,
    Passing,
    Scripted,
    number,
    plain,
    share,
)
from sim_bus.modbus.codec import NONE, DriveReply
from sim_bus.modbus.machine import Machine
from sim_bus.modbus.wrong_maps import Wrong, parse
from sim_bus.reports import Lie, lying

# ---------------------------------------------------------------------------------------------------------------------
# Effects of a scripted fault of a Modbus drive: it acts between request and reply, or changes the drive itself.


Ask = Callable[[bytes], DriveReply]
"""Function: request PDU → reply."""


@dataclass(frozen=True)
class Scene:
    """Place of a fault."""

    machine: Machine
    profile: ModbusProfile
    rng: np.random.Generator


class Misbehaviour(Passing):
    """A fault without effect; a subclass overrides the methods that it needs. `begin` is called first."""

    scene: Scene

    def asked(self, pdu: bytes, ask: Ask) -> DriveReply:
        """Return the reply to a request. ``ask`` returns the reply without this fault."""
        return ask(pdu)


# ---------------------------------------------------------------------------------------------------------------------
# Faults of a Modbus line: requests and replies that are lost, late, damaged, refused or old; connections that end.
#
# Codes and frames: Modbus application protocol V1.1b3, section 7; messaging guide, 3.1.3; serial line guide, 2.5.1.


_OTHER_TRANSACTION, _OTHER_CRC = 0x5555, 0x0100
_TABLES = {3: "holding", 4: "input", 23: "holding"}


class _Some(Misbehaviour):
    """Base of faults that affect a share of the requests."""

    def __init__(self, share: float) -> None:
        self._share = share

    def asked(self, pdu: bytes, ask: Ask) -> DriveReply:
        return self._spoilt(pdu, ask) if self.scene.rng.random() < self._share else ask(pdu)

    def _spoilt(self, pdu: bytes, ask: Ask) -> DriveReply:
        raise NotImplementedError


class LostExchange(_Some):
    """Loss of request and reply; the drive does not act."""

    def _spoilt(self, pdu: bytes, ask: Ask) -> DriveReply:
        return NONE


class WrongTransaction(_Some):
    """Wrong transaction id: the drive acts, and its reply has the id of another request."""

    def _spoilt(self, pdu: bytes, ask: Ask) -> DriveReply:
        return ask(pdu)._replace(transaction_bits=_OTHER_TRANSACTION)


class BadCrc(_Some):
    """Wrong CRC: the drive acts, and the CRC of its reply is wrong."""

    def _spoilt(self, pdu: bytes, ask: Ask) -> DriveReply:
        return ask(pdu)._replace(crc_bits=_OTHER_CRC)


class Short(_Some):
    """Short reply: the drive acts, and sends half of its reply."""

    def _spoilt(self, pdu: bytes, ask: Ask) -> DriveReply:
        reply = ask(pdu)
        return reply if reply.pdu is None else reply._replace(pdu=reply.pdu[: (len(reply.pdu) + 1) // 2])


class LateReply(Misbehaviour):
    """Late reply: the drive acts at once, and its reply comes later by this time, s."""

    def __init__(self, late_s: float) -> None:
        self._late_s = late_s

    def asked(self, pdu: bytes, ask: Ask) -> DriveReply:
        reply = ask(pdu)
        return reply._replace(late_s=reply.late_s + self._late_s)


class Refusing(Misbehaviour):
    """Refusal: the drive receives every request, does nothing, and replies with an exception."""

    def __init__(self, code: int) -> None:
        self._code = code

    def asked(self, pdu: bytes, ask: Ask) -> DriveReply:
        return DriveReply(self.scene.machine.refuse(pdu, self._code))


class LostConnection(Misbehaviour):
    """Loss of the connection on which the next request comes, once. A new connection works."""

    def __init__(self, how: Literal["reset", "half-open"]) -> None:
        self._how: Literal["reset", "half-open"] = how
        self._done = False

    def asked(self, pdu: bytes, ask: Ask) -> DriveReply:
        if self._done:
            return ask(pdu)
        self._done = True
        return NONE._replace(connection=self._how)


class FrozenReads(Misbehaviour):
    """Frozen feedback: reads repeat the first values, like a gateway that repeats its process image.

    Writes are not affected.
    """

    def __init__(self) -> None:
        self._kept: dict[bytes, bytes] = {}

    def end(self) -> None:
        self._kept.clear()

    def asked(self, pdu: bytes, ask: Ask) -> DriveReply:
        reply = ask(pdu)
        if reply.pdu is None or reply.pdu[0] != pdu[0]:
            return reply
        table = _TABLES.get(pdu[0])
        first, count = int.from_bytes(pdu[1:3], "big"), int.from_bytes(pdu[3:5], "big")
        cycle = self.scene.profile.cycle
        if not any(signal.register_.table == table and first <= signal.register_.address < first + count
                   for signal in (cycle.speed, cycle.torque)):
            return reply
        return reply._replace(pdu=self._kept.setdefault(pdu[:5], reply.pdu))


# ---------------------------------------------------------------------------------------------------------------------
# Faults of the Modbus drive itself and of its load.


class Act(Misbehaviour):
    """A change of the drive, which is reversed at the end if possible."""

    def __init__(self, begin: Callable[[Machine], None], end: Callable[[Machine], None] | None = None) -> None:
        self._begin, self._end = begin, end

    def begin(self) -> None:
        self._begin(self.scene.machine)

    def end(self) -> None:
        if self._end is not None:
            self._end(self.scene.machine)


class NotArmed(Misbehaviour):
    """Watchdog that is not armed: its time is written without an error, and keeps its value."""

    def begin(self) -> None:
        watchdog = self.scene.profile.watchdog.parameter
        if watchdog is not None:
            self.scene.machine.parameters.not_kept.add(watchdog)

    def end(self) -> None:
        self.scene.machine.parameters.not_kept.clear()


def drive_fault() -> Act:
    """Return the fault: the drive finds a fault, executes its fault reaction, and stays in fault."""
    return Act(Machine.trip)


def stuck() -> Act:
    """Return the fault: the state machine ignores all commands."""
    return Act(lambda machine: _deaf(machine, True), lambda machine: _deaf(machine, False))


def safe_torque_off() -> Act:
    """Return the fault STO: torque off at once, and no enabling while it lasts. The shaft coasts."""
    def begin(machine: Machine) -> None:
        mode = machine.application.mode
        machine.application.power_off()
        machine.application.set_mode(mode.value)        # the control mode follows from the wiring
        _deaf(machine, True)

    return Act(begin, lambda machine: _deaf(machine, False))


def mode_kept() -> Act:
    """Return the fault: speed or torque is selected without effect; the display shows the old mode."""
    def keep(machine: Machine, keeps: bool) -> None:
        machine.application.keeps_mode = keeps

    return Act(lambda machine: keep(machine, True), lambda machine: keep(machine, False))


def mode_lost() -> Act:
    """Return the fault: the drive controls speed from then on, whatever is selected, and displays it."""
    def lose(machine: Machine) -> None:
        machine.application.set_mode(OperationMode.CYCLIC_VELOCITY.value)
        machine.application.keeps_mode = True

    def over(machine: Machine) -> None:
        machine.application.keeps_mode = False

    return Act(lose, over)


def limited_torque(share: float) -> Act:
    """Return the fault: an internal limit leaves this share of the torque limits, independent of their registers."""
    return Act(lambda machine: machine.leave_torque(share), lambda machine: machine.leave_torque(1.0))


def hot(temperature_c: float) -> Act:
    """Return the fault: motor and drive have this temperature, °C. Raises ValueError for one out of range."""
    if not 0.0 <= temperature_c <= 300.0:
        raise ValueError("°C, from 0 to 300")
    return Act(lambda machine: machine.heat(temperature_c), lambda machine: machine.heat(40.0))


def load_lost(share: float) -> Act:
    """Return the fault: the coupled load is lost, and this share of the motor end's inertia and friction is left."""
    return Act(lambda machine: machine.inverter.lose_load(share))


def lying_drive(lie: Lie) -> Act:
    """Return the fault: sensor, power stage or reports of the drive are wrong (`sim_bus.reports`)."""
    return Act(lambda machine: lie.begin(machine.inverter.lies), lambda machine: lie.end(machine.inverter.lies))


def _deaf(machine: Machine, deaf: bool) -> None:
    machine.application.deaf = deaf


# ---------------------------------------------------------------------------------------------------------------------
# Table of the faults on Modbus: name, row of the fault table, effect, meaning of the value.


WRONGS = {
    "word-order": "word_order", "scale-10": "scale_10", "address-off-by-one": "address_off_by_one", "sign": "sign",
    "unsigned": "unsigned", "write-not-kept": "write_not_applied", "reads-back-otherwise": "reads_back_something_else",
}
"""Faults that are errors of the register map (`sim_bus.modbus.wrong_maps`), from the start and without end."""

ONLY_ON = {"wrong-transaction-id": ("tcp",), "reset": ("tcp",), "half-open": ("tcp",), "bad-crc": ("rtu", "embedded")}
"""Lines on which a fault is possible, if not on all of tcp, rtu and embedded."""

_LINES = {
    "tcp": "tdhil simulate modbus --tcp HOST:PORT", "rtu": "tdhil simulate modbus --rtu",
    "embedded": "tdhil identify --simulate",
}


def _code(text: str) -> int:
    if text not in {"1", "2", "3", "4", "6"}:
        raise ValueError("an exception: 1 function, 2 address, 3 value, 4 failure, 6 busy")
    return int(text)


def _delay_s(text: str) -> float:
    found = re.fullmatch(r"(\d{1,4}(?:\.\d{1,6})?)(m?s)", text)
    if found is None:
        raise ValueError("a time, such as 200ms")
    return float(found[1]) / (1000.0 if found[2] == "ms" else 1.0)


def _name(text: str) -> Misbehaviour:
    if not re.fullmatch(r"[a-z][a-z0-9_]*", text):
        raise ValueError("a parameter as the profile calls it")
    return Misbehaviour()


def _wiring(summary: str, row: int = 44) -> FaultKind[Misbehaviour]:
    return FaultKind(row, summary, plain(Misbehaviour))


KINDS: Kinds[Misbehaviour] = Kinds({
    "frozen-feedback": FaultKind(19, "speed and torque keep their last values; writes still take effect",
                                 plain(FrozenReads)),
    "drive-fault": FaultKind(23, "the drive is in the fault state after its fault reaction", plain(drive_fault)),
    "fault-at-start": FaultKind(30, "the drive is in the fault state before the run", plain(drive_fault)),
    "stuck-state": FaultKind(31, "the drive ignores the controlword", plain(stuck)),
    "mode-not-followed": FaultKind(32, "the drive does not change its mode", plain(mode_kept)),
    "mode-lost": FaultKind(82, "the drive changes to speed mode without a command, and stays there",
                           plain(mode_lost)),
    "sto": FaultKind(33, "safe torque off: the shaft coasts, and the drive cannot be enabled",
                     plain(safe_torque_off)),
    "internal-limit": FaultKind(33, "an internal limit reduces the torque to this share",
                                lambda v: limited_torque(share(v)), "10%", "SHARE"),
    "load-lost": FaultKind(34, "the load comes off the shaft: this share of inertia and friction remains",
                           lambda v: load_lost(max(0.001, share(v))), "10%", "SHARE"),
    "hot": FaultKind(35, "motor and drive reach this temperature, °C", lambda v: hot(number(v)), "150", "CELSIUS"),
    "exception": FaultKind(38, "the drive answers each request with this exception, and executes none: 1 to 4, 6 busy",
                           lambda v: Refusing(_code(v)), "4", "CODE"),
    "no-reply": FaultKind(39, "this share of the requests is lost, and gets no reply",
                          lambda v: LostExchange(share(v)), "100%", "SHARE"),
    "late-reply": FaultKind(40, "each reply is late by this time", lambda v: LateReply(_delay_s(v)), "1s", "TIME"),
    "wrong-transaction-id": FaultKind(41, "this share of the replies has another transaction ID (TCP only)",
                                      lambda v: WrongTransaction(share(v)), "100%", "SHARE"),
    "bad-crc": FaultKind(42, "this share of the replies has a wrong CRC (not on TCP; embedded: such a reply is lost)",
                         lambda v: BadCrc(share(v)), "100%", "SHARE"),
    "short-reply": FaultKind(42, "this share of the replies is cut to half its length", lambda v: Short(share(v)),
                             "100%", "SHARE"),
    "reset": FaultKind(43, "the connection is reset, once (TCP only)", plain(lambda: LostConnection("reset"))),
    "half-open": FaultKind(43, "the connection stays open, and transmits nothing (TCP only)",
                           plain(lambda: LostConnection("half-open"))),
    "word-order": _wiring("the two words of 32-bit values are exchanged"),
    "scale-10": _wiring("each scaled register counts tenths of its unit"),
    "address-off-by-one": _wiring("each register is one address higher"),
    "sign": _wiring("signed registers report the opposite sign"),
    "unsigned": _wiring("signed registers report values without a sign"),
    "write-not-kept": _wiring("the drive confirms writes to parameters, and keeps the old values", 45),
    "reads-back-otherwise": FaultKind(45, "a parameter, by its name in the profile, reads back with another value",
                                      _name, "torque_limit", "PARAMETER"),
    "watchdog-not-armed": FaultKind(50, "the drive confirms the watchdog's time, and keeps the old one",
                                    plain(NotArmed)),
})
KINDS.update(lying(lying_drive))
make, listing = KINDS.make, KINDS.listing


def parse_all(texts: Sequence[str], line_kind: str) -> tuple[Scripted, ...]:
    """Return all faults of a command line, each checked, for ``tcp``, ``rtu`` or ``embedded``. Raises FaultRefused."""
    faults = KINDS.parse_all(texts)
    for fault in faults:
        where = f"--fault {fault.text}"
        lines = ONLY_ON.get(fault.name, tuple(_LINES))
        if line_kind not in lines:
            raise FaultRefused(f"there is no {fault.name} on this line", where=where,
                               next_step=f"Rehearse it with {' or '.join(_LINES[one] for one in lines)}")
        if fault.name in WRONGS and (fault.at != Moment() or "/" in fault.text):
            raise FaultRefused(f"{fault.name} is how the drive is wired: from the start, for good", where=where,
                               next_step="Leave the @ and the / out")
    return faults


def wrongs_of(script: Iterable[Scripted], parameters: Sequence[str]) -> tuple[Wrong, ...]:
    """Return the errors of the register map in a script. Raises FaultRefused for a parameter that is not in the
    profile.
    """
    wrongs = []
    for fault in script:
        if fault.name not in WRONGS:
            continue
        kind = KINDS[fault.name]
        of = fault.value or kind.value
        if of and of not in parameters:
            raise FaultRefused(f"the profile has no parameter '{of[:40]}'", where=f"--fault {fault.text}",
                               next_step=f"It has: {', '.join(parameters)}")
        wrongs.append(parse(f"{WRONGS[fault.name]}:{of}" if of else WRONGS[fault.name]))
    return tuple(wrongs)


def listed(line_kind: str) -> tuple[KnownFault, ...]:
    """Return every fault that is possible on ``tcp``, ``rtu`` or ``embedded``."""
    kinds = Kinds({name: kind for name, kind in KINDS.items() if line_kind in ONLY_ON.get(name, _LINES)})
    return kinds.listed(WRONGS)


# ---------------------------------------------------------------------------------------------------------------------

_WRITES = (6, 16)
_STAGE_REGISTER = MARKER_STAGE_REGISTER.to_bytes(2, "big")


def tells_stage(pdu: bytes) -> bool:
    """Return whether the request is the host's report of a stage."""
    return len(pdu) > 3 and pdu[0] in _WRITES and pdu[1:3] == _STAGE_REGISTER


class Faults:
    """Script of one drive, active from now on. Requests come in by `request`."""

    def __init__(self, machine: Machine, profile: ModbusProfile, script: tuple[Scripted, ...] = (),
                 seed: int = 0) -> None:
        self._machine = machine
        self._cast: Cast[Misbehaviour] = Cast(script, make)
        scene = Scene(machine, profile, np.random.default_rng((seed, FAULT_SEED)))
        for fault in self._cast.all:
            fault.scene = scene
        if script:
            machine.on_time = self.moved
            machine.on_stage = self._on_stage
            machine.application.on_stop = lambda: self._on_stage(STOP)
            self.moved(0)

    @property
    def waiting(self) -> tuple[str, ...]:
        """Faults that have not begun yet, as they were written."""
        return self._cast.waiting

    def moved(self, now_us: int) -> None:
        """Begin and end the faults that are due at this plant time, µs."""
        if self._cast.moved(now_us, self._machine.note):
            self._machine.application.regulate()

    def request(self, pdu: bytes, connection: int = 0) -> DriveReply:
        """Return the reply to a request to the drive at the present time."""
        ask: Ask = partial(self._ask, connection=connection)
        if tells_stage(pdu):
            return ask(pdu)
        for fault in self._cast.active:
            ask = partial(fault.asked, ask=ask)
        return ask(pdu)

    def _ask(self, pdu: bytes, connection: int) -> DriveReply:
        return DriveReply(self._machine.request(pdu, connection))

    def _on_stage(self, number: int) -> None:
        now_us = round(1e6 * self._machine.time_s)
        self._cast.stage(number, now_us)
        self.moved(now_us)
