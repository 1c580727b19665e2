"""Faults of a Modbus line: requests and replies that are lost, late, damaged, refused, old; connections that die.

Codes and frames: Modbus application protocol V1.1b3, section 7; messaging guide, 3.1.3; serial line guide, 2.5.1.
"""

from typing import Literal

from sim_bus.modbus.fault_hooks import Ask, Misbehaviour
from sim_bus.modbus.reply import NONE, Reply

_OTHER_TRANSACTION, _OTHER_CRC = 0x5555, 0x0100
_TABLES = {3: "holding", 4: "input", 23: "holding"}


class _Some(Misbehaviour):
    """Happens to a share of the requests."""

    def __init__(self, share: float) -> None:
        self._share = share

    def asked(self, pdu: bytes, ask: Ask) -> Reply:
        return self._spoilt(pdu, ask) if self.scene.rng.random() < self._share else ask(pdu)

    def _spoilt(self, pdu: bytes, ask: Ask) -> Reply:
        raise NotImplementedError


class NoReply(_Some):
    """Neither request nor reply gets through; the drive doesn't act."""

    def _spoilt(self, pdu: bytes, ask: Ask) -> Reply:
        return NONE


class WrongTransaction(_Some):
    """The drive acts, and its reply bears the transaction of another request."""

    def _spoilt(self, pdu: bytes, ask: Ask) -> Reply:
        return ask(pdu)._replace(transaction_bits=_OTHER_TRANSACTION)


class BadCrc(_Some):
    """The drive acts, and its reply has a wrong CRC."""

    def _spoilt(self, pdu: bytes, ask: Ask) -> Reply:
        return ask(pdu)._replace(crc_bits=_OTHER_CRC)


class Short(_Some):
    """The drive acts, and says half of its reply."""

    def _spoilt(self, pdu: bytes, ask: Ask) -> Reply:
        reply = ask(pdu)
        return reply if reply.pdu is None else reply._replace(pdu=reply.pdu[: (len(reply.pdu) + 1) // 2])


class Late(Misbehaviour):
    """The drive acts at once, and its reply comes so much later, s."""

    def __init__(self, late_s: float) -> None:
        self._late_s = late_s

    def asked(self, pdu: bytes, ask: Ask) -> Reply:
        reply = ask(pdu)
        return reply._replace(late_s=reply.late_s + self._late_s)


class Refusing(Misbehaviour):
    """The drive hears every request, does nothing, and answers with an exception."""

    def __init__(self, code: int) -> None:
        self._code = code

    def asked(self, pdu: bytes, ask: Ask) -> Reply:
        return Reply(self.scene.machine.refuse(pdu, self._code))


class Connection(Misbehaviour):
    """The connection on which the next request comes is lost, once; a new one works."""

    def __init__(self, how: Literal["reset", "half-open"]) -> None:
        self._how: Literal["reset", "half-open"] = how
        self._done = False

    def asked(self, pdu: bytes, ask: Ask) -> Reply:
        if self._done:
            return ask(pdu)
        self._done = True
        return NONE._replace(connection=self._how)


class Frozen(Misbehaviour):
    """What is read of the feedback is what was read of it first: a gateway that repeats its process image.

    What is written goes through.
    """

    def __init__(self) -> None:
        self._kept: dict[bytes, bytes] = {}

    def end(self) -> None:
        self._kept.clear()

    def asked(self, pdu: bytes, ask: Ask) -> Reply:
        reply = ask(pdu)
        if reply.pdu is None or reply.pdu[0] != pdu[0] or not self._is_feedback(pdu):
            return reply
        return reply._replace(pdu=self._kept.setdefault(pdu[:5], reply.pdu))

    def _is_feedback(self, pdu: bytes) -> bool:
        """Reads speed or torque."""
        table = _TABLES.get(pdu[0])
        first, count = int.from_bytes(pdu[1:3], "big"), int.from_bytes(pdu[3:5], "big")
        cycle = self.scene.profile.cycle
        return any(
            signal.register_.table == table and first <= signal.register_.address < first + count
            for signal in (cycle.speed, cycle.torque)
        )
