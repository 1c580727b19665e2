"""Scripted Modbus lines: one without a reply, one with garbled replies, and one with a drive on unit 3."""

from drivers.clock import Clock
from drivers.modbus.link import Reply
from drivers.modbus.pdu import BadReply, NoReply

IDENTIFICATION = (bytes.fromhex("2b 0e 01 01 00 00 03") + b"\x00\x07Danfoss" + b"\x01\x06FC 302" + b"\x02\x038.1")
"""Function 43/14: vendor, product code, revision (Modbus Application Protocol V1.1b3, section 6.21)."""


class Silent:
    """Line without any unit."""

    description = "a silent line"

    def __init__(self, clock: Clock) -> None:
        self.clock = clock

    def transact(self, unit: int, pdu: bytes, timeout_s: float) -> Reply:
        raise NoReply("no reply", where=self.description)

    def close(self) -> None:
        pass


class Garbled(Silent):
    """Line with a unit at another baud rate."""

    description = "a garbled line"

    def transact(self, unit: int, pdu: bytes, timeout_s: float) -> Reply:
        raise BadReply("CRC", where=self.description)


class Answering(Silent):
    """Line with unit 3, which sends its name and refuses every register (exception 2)."""

    description = "a line with a drive"

    def transact(self, unit: int, pdu: bytes, timeout_s: float) -> Reply:
        if unit != 3:
            raise NoReply("no reply", where=self.description)
        assert pdu[0] in (3, 4, 0x2B), "a scan never writes"
        reply = IDENTIFICATION if pdu[0] == 0x2B else bytes((pdu[0] | 0x80, 2))
        return Reply(reply, 0.0, 0.0)
