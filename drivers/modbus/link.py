"""Interface of a Modbus line for the driver: one request, one reply, and the two times that bound the transaction.

pymodbus makes the frames; the transaction is our own. Its client reconnects by itself, and can't distinguish a foreign
reply, a wrong CRC and silence (docs/decisions/0008).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

from drivers.clock import Clock
from drivers.modbus.pdu import NoReply


class Reply(NamedTuple):
    """A reply PDU. ``sent_s``: start of sending the request; ``received_s``: end of the reply (control time)."""

    pdu: bytes
    sent_s: float
    received_s: float


class Link(Protocol):
    """A line with drives on it, one transaction at a time.

    A link may also have ``late``: the number of replies that came after their time and were dropped (`late_replies`).
    """

    @property
    def clock(self) -> Clock: ...

    @property
    def description(self) -> str: ...

    def transact(self, unit: int, pdu: bytes, timeout_s: float) -> Reply:
        """Send one request PDU (function code and data) and return its reply PDU; exception replies are replies too.

        Raises `drivers.modbus.pdu`: NoReply, BadReply, LinkLost.
        """
        ...

    def close(self) -> None: ...


def late_replies(link: Link) -> int:
    """Return the number of late replies that a link has dropped; 0 if it does not count them."""
    return int(getattr(link, "late", 0))


# ---------------------------------------------------------------------------------------------------------------------
# A line to a drive in the same process and time: no socket, no thread; waiting advances the drive.


Serve = Callable[[int, bytes, float], tuple[bytes | None, float]]
"""(unit, request PDU, control time) → the reply PDU, None without an answer, and the time when it is complete."""


class EmbeddedLink:
    """Passes each request to ``serve`` and waits, on its clock, until the reply would have come over a real line."""

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
        """Raise NoReply without an answer in time; a reply that is complete later is dropped."""
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
        """Notify the other side, if it has registered for it."""
        self._on_close()
