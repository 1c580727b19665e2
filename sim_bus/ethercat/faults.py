"""Scripted faults of one simulated EtherCAT drive; each sets something and restores it. All times are plant time."""

from functools import partial

from sim_bus.drive_faults import FaultAct, FaultSchedule, changed, of_bus, of_drive, once
from sim_bus.ethercat.slave import Cia402Slave
from sim_bus.fault_script import FaultKind, Kinds, Scripted, error_code, number, plain, share
from sim_bus.sdo_server import Meddling

_FIRST, _LENGTH, _HEAD = 16, slice(22, 24), 26
"""Places of the first datagram in a frame: its command, its length, its data."""

_LRD, _LWR, _LRW = 10, 11, 12

Misbehaviour = FaultAct["Faults"]


def _part(name: str, part: float) -> Misbehaviour:
    """Return a fault that affects a share of the frames, given by the name of the attribute."""
    return changed(lambda line: line, name, lambda _: part)


def _transfers(how: Meddling, index: int, sub: int) -> Misbehaviour:
    """Return a fault that affects all transfers of an object."""
    return Misbehaviour(lambda line: line.slave.coe.sdo.meddling.update({(index, sub): how}),
                        lambda line: line.slave.coe.sdo.meddling.pop((index, sub), None))


def _garbage(line: "Faults") -> bytes:
    """Return an EEPROM with an identity of ones and a wrong checksum."""
    content = bytearray(line.slave.esc.eeprom)
    content[14], content[16:32] = content[14] ^ 0xFF, b"\xff" * 16
    return bytes(content)


def _jump(line: "Faults", jump_s: float) -> None:
    line.slave.esc.clock_ns = max(0, line.slave.esc.clock_ns + round(1e9 * jump_s))


def _slave(line: "Faults") -> Cia402Slave:
    return line.slave


KINDS: Kinds[Misbehaviour] = Kinds({
    **of_bus(
        dead=lambda: _part("loss", 1.0), lossy=lambda part: _part("loss", part), loss="1%",
        restart=lambda: Misbehaviour(lambda line: line.slave.restart()), restarts="INIT",
        transfers=_transfers,
    ),
    "frozen-feedback": FaultKind(19, "the inputs keep their last values", plain(
        lambda: changed(_slave, "inputs", lambda line: partial(bytes, line.slave.inputs())))),
    "watchdog-not-armed": FaultKind(
        50, "the slave confirms writes to registers 0400h to 0421h, and keeps the old values", plain(
        lambda: changed(lambda line: line.slave.esc, "locked", lambda _: range(0x0400, 0x0422)))),
    "mailbox-timeout": FaultKind(125, "the slave answers no message in its mailbox",
                                 plain(lambda: changed(_slave, "mailbox", lambda _: lambda message: None))),
    "wrong-working-counter": FaultKind(124, "this share of the process data returns with a working counter of 0",
                                       lambda v: _part("uncounted", share(v)), "1%", "SHARE"),
    "al-error": FaultKind(122, "the slave leaves OPERATIONAL with this AL status code",
                          once(error_code, lambda line, code: line.slave.al_error(code)), "001Bh", "CODE"),
    "sm-watchdog": FaultKind(123, "the process data watchdog expires, although data arrive",
                             plain(lambda: Misbehaviour(lambda line: line.slave.esc.expire_watchdog()))),
    "sii-garbage": FaultKind(126, "all bits of the identity in the EEPROM are set, and its checksum is wrong",
                             plain(lambda: changed(lambda line: line.slave.esc, "eeprom", _garbage))),
    "clock-jump": FaultKind(127, "the distributed clock jumps by this time, s", once(number, _jump), "1", "SECONDS"),
    **of_drive(lambda fault: Misbehaviour(lambda line: fault.begin(line.slave), lambda line: fault.end(line.slave))),
})
parse_all, listed, listing = KINDS.parse_all, KINDS.listed, KINDS.listing


class Faults(FaultSchedule[Misbehaviour]):
    """Script of one drive, between host and slave."""

    def __init__(self, script: tuple[Scripted, ...], slave: Cia402Slave, seed: int) -> None:
        super().__init__(script, KINDS.make, seed)
        self.slave: Cia402Slave = slave
        self.loss = self.uncounted = 0.0
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
        return part > 0.0 and bool(self.rng.random() < part)
