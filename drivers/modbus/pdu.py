"""Request and reply PDUs of the functions that are used, pure.

Modbus Application Protocol V1.1b3: 3 read holding registers (section 6.3), 4 read input registers (6.4), 6 write
single register (6.6), 8 diagnostics (6.8), 16 write multiple registers (6.12), 23 read/write multiple registers (6.17),
exceptions (7).
"""

import struct
from collections.abc import Sequence

from drivers.errors import CommunicationLost, DriveFault, ObjectRefused
from profiles import MessageCode

# ---------------------------------------------------------------------------------------------------------------------
# Errors on a Modbus line, as leaves of the one error tree (`drivers.errors`).
#
# ::
#
#     CommunicationLost
#     ├── NoReply            no reply came in time
#     ├── BadReply           CRC, length, unit, function or transaction id are not those of the request
#     │   └── NoisyReply     a reply that the line has damaged: the request may be repeated at once
#     └── LinkLost           connection reset or closed, port gone; stays so until a new link is opened
#     ObjectRefused
#     └── RegisterRefused    exception reply to a request before motion
#     DriveFault
#     └── CycleRefused       exception reply to a request of the cycle
#
# Exception codes: Modbus Application Protocol V1.1b3, section 7.


ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE, DEVICE_FAILURE, BUSY = 1, 2, 3, 4, 6

EXCEPTION_NAMES = {
    1: "illegal function",
    2: "illegal data address",
    3: "illegal data value",
    4: "server device failure",
    5: "acknowledge, still working on it",
    6: "server device busy",
    8: "memory parity error",
    10: "gateway path unavailable",
    11: "gateway target does not respond",
}

_STEPS = {
    1: "The drive does not have this function: remove it from cycle.functions in the profile",
    2: "Count addresses from 0 (a manual's 40001 is 0); check the profile's address and the drive's model",
    3: "The drive does not accept this value or number of registers: check scale and limits in the profile",
    4: "The drive failed to process the request: check its panel for a fault",
    6: "The drive is busy. Disconnect any commissioning tool, wait, and start again",
    10: "Check the gateway's configuration and the unit number (--unit)",
    11: "Check the drive behind the gateway: power, address, baud rate",
}


class NoReply(CommunicationLost):
    """Missing reply: none came within the time-out."""

    entry = MessageCode.NO_REPLY


class BadReply(CommunicationLost):
    """Data came, but no valid reply to this request."""

    entry = MessageCode.BAD_REPLY


class NoisyReply(BadReply):
    """A damaged reply to this request; the drive has most probably executed it."""


class LinkLost(CommunicationLost):
    """The line itself is lost: connection reset, closed by the drive, adapter unplugged."""

    entry = MessageCode.LINK_LOST


class RegisterRefused(ObjectRefused):
    """The drive answered with an exception; ``code`` is its number."""

    def __init__(self, code: int, where: str) -> None:
        super().__init__(f"the drive refused: {exception_text(code)}", where=where, next_step=_STEPS.get(code, ""))
        self.code = code


class CycleRefused(DriveFault):
    """The drive answered a request of the cycle with an exception; ``code`` is its number."""

    def __init__(self, code: int, where: str) -> None:
        super().__init__(
            f"the drive refused a request of the cycle: {exception_text(code)}",
            where=where,
            next_step=_STEPS.get(code, "Check the drive's panel for a fault"),
        )
        self.code = code


def exception_text(code: int) -> str:
    """Return number and name of an exception code."""
    return f"exception {code}, {EXCEPTION_NAMES.get(code, 'of the manufacturer')}"


# ---------------------------------------------------------------------------------------------------------------------

READ_HOLDING, READ_INPUT, WRITE_ONE, DIAGNOSTICS, WRITE_MANY, READ_WRITE = 3, 4, 6, 8, 16, 23
REQUESTS_SO_FAR = 0x000E
"""Sub-function of 8: number of requests to this server since it was switched on, modulo 65536."""
EXCEPTION = 0x80
MOST_READ, MOST_WRITTEN, MOST_WRITTEN_WITH_READ = 125, 123, 121


def read(function: int, address: int, count: int) -> bytes:
    """Return a request of function 3 or 4."""
    _within(address, count, MOST_READ)
    return struct.pack(">BHH", function, address, count)


def write_one(address: int, word: int) -> bytes:
    """Return a request of function 6."""
    return struct.pack(">BHH", WRITE_ONE, address, word)


def count_requests() -> bytes:
    """Return a request of function 8, server message count."""
    return struct.pack(">BHH", DIAGNOSTICS, REQUESTS_SO_FAR, 0)


def write_many(address: int, words: Sequence[int]) -> bytes:
    """Return a request of function 16."""
    _within(address, len(words), MOST_WRITTEN)
    return struct.pack(f">BHHB{len(words)}H", WRITE_MANY, address, len(words), 2 * len(words), *words)


def read_write(read_address: int, read_count: int, write_address: int, words: Sequence[int]) -> bytes:
    """Return a request of function 23: the drive writes first, then reads."""
    _within(read_address, read_count, MOST_READ)
    _within(write_address, len(words), MOST_WRITTEN_WITH_READ)
    return struct.pack(
        f">BHHHHB{len(words)}H",
        READ_WRITE, read_address, read_count, write_address, len(words), 2 * len(words), *words,
    )


def words_of(request: bytes, reply: bytes, where: str = "") -> tuple[int, ...]:
    """Return the registers in the reply to this request; none for a write.

    Raises RegisterRefused for an exception reply, BadReply if it is not a reply to this request.
    """
    function = request[0]
    if len(reply) == 2 and reply[0] == function | EXCEPTION:
        raise RegisterRefused(reply[1], where)
    if not reply or reply[0] != function:
        raise _bad(f"a reply {reply[:8].hex(' ') or 'without content'} to a request of function {function}", where)
    if function in (WRITE_ONE, WRITE_MANY):
        # Address and value, or address and count, come back as they were sent.
        if reply != request[:5]:
            raise _bad(f"the drive acknowledged {reply[:8].hex(' ')}, not {request[:5].hex(' ')}", where)
        return ()
    if function == DIAGNOSTICS:
        if len(reply) != 5 or reply[:3] != request[:3]:
            raise _bad(f"{reply[:8].hex(' ')} to diagnostics {request[:3].hex(' ')}", where)
        return (int.from_bytes(reply[3:], "big"),)
    count = struct.unpack_from(">H", request, 3)[0]
    if len(reply) != 2 + 2 * count or reply[1] != 2 * count:
        said = f", its own count says {reply[1]}" if len(reply) > 1 else ""
        raise _bad(f"{len(reply)} bytes{said}, but {2 + 2 * count} were requested", where)
    return struct.unpack_from(f">{count}H", reply, 2)


def answers(request: bytes, reply: bytes) -> bool:
    """Return whether this PDU can be the reply to that request, by its function. Exceptions are replies too."""
    return bool(reply) and reply[0] & ~EXCEPTION == request[0]


def reply_length(head: bytes) -> int | None:
    """Return the length of the reply PDU that begins with ``head``; None if its function does not define it."""
    if not head:
        return None
    function = head[0]
    if function & EXCEPTION:
        return 2
    if function in (WRITE_ONE, WRITE_MANY, DIAGNOSTICS):
        return 5
    if function in (READ_HOLDING, READ_INPUT, READ_WRITE) and len(head) > 1:
        return 2 + head[1]
    return None


def _within(address: int, count: int, most: int) -> None:
    if not (1 <= count <= most and address >= 0 and address + count <= 0x1_0000):
        raise ValueError(f"{count} registers from {address} on are not possible in one request")


def _bad(what: str, where: str) -> BadReply:
    return BadReply(what, where=where, next_step="Check wiring and termination. Is a second master on the line?")
