"""Scripted faults of one simulated EtherCAT drive; each sets something and restores it. All times are plant time."""

from collections.abc import Callable

import numpy as np

from sim_bus.drive_faults import FaultAct, FaultSchedule, InjectedFault, changed, of_drive, once
from sim_bus.ethercat.slave import Cia402Slave
from sim_bus.fault_script import (
    FaultKind,
    Kinds,
    Scripted,
    error_code,
    number,
    object_place,
    plain,
    share,
)
from sim_bus.sdo_server import Meddling

_SEED = 0xFA17
_FIRST, _LENGTH, _HEAD = 16, slice(22, 24), 26
"""Places of the first datagram in a frame: its command, its length, its data."""

_LRD, _LWR, _LRW = 10, 11, 12

Misbehaviour = FaultAct["Faults"]


def _part(name: str) -> Callable[[str], Misbehaviour]:
    """Return a fault that affects a share of the frames, given by the name of the attribute."""
    def make(text: str) -> Misbehaviour:
        part = share(text)
        return changed(lambda line: line, name, lambda _: part)

    return make


def _transfers(how: Meddling) -> Callable[[str], Misbehaviour]:
    """Return a fault that affects all transfers of an object."""
    def make(text: str) -> Misbehaviour:
        key = object_place(text)
        return Misbehaviour(lambda line: line.slave.coe.sdo.meddling.update({key: how}),
                            lambda line: line.slave.coe.sdo.meddling.pop(key, None))

    return make


def _of_drive(fault: InjectedFault) -> Misbehaviour:
    return Misbehaviour(lambda line: fault.begin(line.slave), lambda line: fault.end(line.slave))


def _garbage(line: "Faults") -> bytes:
    """Return an EEPROM with an identity of ones and a wrong checksum."""
    content = bytearray(line.slave.esc.eeprom)
    content[14], content[16:32] = content[14] ^ 0xFF, b"\xff" * 16
    return bytes(content)


def _jump(line: "Faults", jump_s: float) -> None:
    line.slave.esc.clock_ns = max(0, line.slave.esc.clock_ns + round(1e9 * jump_s))


def _failed(line: "Faults", code: int) -> None:
    line.slave.report(code)
    line.slave.application.fault()


def _slave(line: "Faults") -> Cia402Slave:
    return line.slave


KINDS: Kinds[Misbehaviour] = Kinds({
    "bus-dead": FaultKind(12, "nothing gets through any more: cable cut", plain(lambda: _part("loss")("1"))),
    "frame-loss": FaultKind(17, "this share of all frames is lost, either way", _part("loss"), "1%", "SHARE"),
    "frozen-feedback": FaultKind(19, "the inputs keep their last values",
                                 plain(lambda: changed(_slave, "frozen", lambda line: line.slave.inputs()))),
    "node-reset": FaultKind(21, "the drive restarts: INIT, its torque is off, the shaft coasts",
                            plain(lambda: Misbehaviour(lambda line: line.slave.restart()))),
    "emcy": FaultKind(23, "an emergency message, with the drive still enabled",
                      once(error_code, lambda line, code: line.slave.report(code)), "7305h", "CODE"),
    "drive-fault": FaultKind(23, "emergency message and fault state, after the drive's own fault reaction",
                             once(error_code, _failed), "3210h", "CODE"),
    "sdo-abort": FaultKind(24, "the drive aborts every transfer of an object", _transfers(Meddling.ABORTED), "6072h",
                           "OBJECT"),
    "sdo-timeout": FaultKind(25, "the drive doesn't answer when asked for an object",
                             _transfers(Meddling.UNANSWERED), "6072h", "OBJECT"),
    "wrong-identity": FaultKind(29, "1018h:1, the vendor, is another one",
                                plain(lambda: _transfers(Meddling.OTHERWISE)("1018h:1"))),
    "fault-at-start": FaultKind(30, "the drive is in fault when the host comes", once(error_code, _failed), "3210h",
                                "CODE"),
    "write-not-kept": FaultKind(45, "a write to an object is answered and not kept", _transfers(Meddling.NOT_KEPT),
                                "6080h", "OBJECT"),
    "reads-back-otherwise": FaultKind(45, "an object reads back as something else", _transfers(Meddling.OTHERWISE),
                                      "6072h", "OBJECT"),
    "watchdog-not-armed": FaultKind(50, "writes to registers 0400h to 0421h are answered and not kept", plain(
        lambda: changed(lambda line: line.slave.esc, "locked", lambda _: range(0x0400, 0x0422)))),
    "mailbox-timeout": FaultKind(0, "no message in the mailbox is answered",
                                 plain(lambda: changed(lambda line: line.slave.coe, "silent", lambda _: True))),
    "wrong-working-counter": FaultKind(0, "this share of the process data comes back with a working counter of 0",
                                       _part("uncounted"), "1%", "SHARE"),
    "al-error": FaultKind(0, "the slave leaves OPERATIONAL with this AL status code",
                          once(error_code, lambda line, code: line.slave.al_error(code)), "001Bh", "CODE"),
    "sm-watchdog": FaultKind(0, "the watchdog of the process data expires, though they come",
                             plain(lambda: Misbehaviour(lambda line: line.slave.esc.expire_watchdog()))),
    "sii-garbage": FaultKind(0, "the identity in the EEPROM reads as ones, and its checksum is wrong",
                             plain(lambda: changed(lambda line: line.slave.esc, "eeprom", _garbage))),
    "clock-jump": FaultKind(0, "the distributed clock jumps by so many seconds", once(number, _jump), "1", "SECONDS"),
    **of_drive(_of_drive),
})
parse_all, listed, listing = KINDS.parse_all, KINDS.listed, KINDS.listing


class Faults(FaultSchedule[Misbehaviour]):
    """Script of one drive, between host and slave."""

    def __init__(self, script: tuple[Scripted, ...], slave: Cia402Slave, seed: int) -> None:
        super().__init__(script, KINDS.make)
        self.slave: Cia402Slave = slave
        self.scripted = bool(script)
        self.loss = self.uncounted = 0.0
        self._rng = np.random.default_rng((seed, _SEED))
        for fault in self.cast.all:
            fault.place = self
        if script:
            self.happen_to(slave)
            self.moved(0)

    def answer(self, frame: bytes) -> bytes:
        """Return the frame as it comes back; empty if it is lost. A lost cycle takes its time too."""
        command = frame[_FIRST] if len(frame) > _HEAD else 0
        if self._happens(self.loss):
            if command in (_LWR, _LRW):
                self.slave.pass_cycle()
            return b""
        answered = self.slave.answer(frame)
        if self._happens(self.loss):
            return b""
        if command in (_LRD, _LWR, _LRW) and self._happens(self.uncounted):
            end = _HEAD + (int.from_bytes(frame[_LENGTH], "little") & 0x07FF)
            answered = answered[:end] + bytes(2) + answered[end + 2:]
        return answered

    def _happens(self, part: float) -> bool:
        return part > 0.0 and bool(self._rng.random() < part)
