"""A line to a drive in the same process and the same time: no socket, no thread; waiting is what moves the drive on."""

from __future__ import annotations

from collections.abc import Callable

from drivers.clock import Clock
from drivers.modbus.errors import NoReply
from drivers.modbus.link import Reply

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
