"""What a Modbus line must do for the driver: one request, one reply, and the two moments that bound it."""

from typing import NamedTuple, Protocol

from drivers.clock import Clock


class Reply(NamedTuple):
    """A reply PDU. ``sent_s``: the request began to be sent; ``received_s``: the reply was complete (control time)."""

    pdu: bytes
    sent_s: float
    received_s: float


class Link(Protocol):
    """A line with drives on it, one transaction at a time.

    A link may also have ``late``: how many replies came after their time and were dropped (`late_replies`).
    """

    @property
    def clock(self) -> Clock: ...

    @property
    def description(self) -> str: ...

    def transact(self, unit: int, pdu: bytes, timeout_s: float) -> Reply:
        """One request PDU (function code and data) and its reply PDU; exception replies are replies too.

        Raises `drivers.modbus.errors`: NoReply, BadReply, LinkLost.
        """
        ...

    def close(self) -> None: ...


def late_replies(link: Link) -> int:
    """How many late replies a link has dropped so far; 0 where it doesn't count them."""
    return int(getattr(link, "late", 0))
