"""What a Modbus line must do for the driver: one request, one reply, and the two moments that bound it.

Frames are pymodbus's, the transaction is our own: its client connects anew by itself, and can't tell a foreign reply, a
wrong CRC and silence apart (docs/decisions/0008).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

from drivers.clock import Clock
from drivers.modbus.pdu import NoReply


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

        Raises `drivers.modbus.pdu`: NoReply, BadReply, LinkLost.
        """
        ...

    def close(self) -> None: ...


def late_replies(link: Link) -> int:
    """How many late replies a link has dropped so far; 0 where it doesn't count them."""
    return int(getattr(link, "late", 0))


# ---------------------------------------------------------------------------------------------------------------------
# A line to a drive in the same process and the same time: no socket, no thread; waiting is what moves the drive on.


Serve = Callable[[int, bytes, float], tuple[bytes | None, float]]
"""(unit, request PDU, control time) → the reply PDU, None where nobody answers, and when it is complete."""


class EmbeddedLink:
    """Hands each request to ``serve`` and waits, on its clock, until the reply would have come over a real line."""

    def __init__(
        self, serve: Serve, clock: Clock, *, description: str = "embedded simulator",
        on_close: Callable[[], None] = lambda: None,
    ) -> None:
        self.clock = clock
        self.description = description
        self.late = 0
        self._serve = serve
        self._on_close = on_close

    def transact(self, unit: int, pdu: bytes, timeout_s: float) -> Reply:
        """Raises NoReply where nobody answers in time; a reply that is complete later is dropped."""
        sent_s = self.clock.now_s()
        reply, complete_s = self._serve(unit, pdu, sent_s)
        if reply is None or complete_s > sent_s + timeout_s:
            self.late += reply is not None
            self.clock.wait_until(sent_s + timeout_s)
            raise NoReply(
                f"no reply within {timeout_s:.3g} s", where=f"{self.description}, unit {unit}",
                next_step="Check the unit number (--unit)",
            )
        self.clock.wait_until(complete_s)
        return Reply(reply, sent_s, complete_s)

    def close(self) -> None:
        """Tell the other side, if it wants to know."""
        self._on_close()
