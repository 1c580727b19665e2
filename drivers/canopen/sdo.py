"""Reading and writing of objects by SDO, over `CanLink` (CiA 301)."""

from __future__ import annotations

from collections.abc import Callable

from drivers.canopen.bus import CanLink
from drivers.cia402 import SdoClient, is_answer
from drivers.errors import CommunicationLost
from profiles import MessageCode

ANSWER_S, TRIES = 0.5, 3
"""Waiting time for an answer at standstill, s, and number of attempts."""
TIMED_OUT = bytes((0x80, 0, 0, 0)) + (0x05040000).to_bytes(4, "little")
"""Abort of a transfer whose answer is missing."""


class SdoObjects(SdoClient):
    """The object dictionary of one node, by SDO.

    Raises ObjectRefused when the drive aborts a transfer and CommunicationLost when it doesn't answer.
    """

    def __init__(self, link: CanLink, node: int) -> None:
        super().__init__(ANSWER_S, (TRIES, TRIES), normal=False, drive=f"node {node}")
        self._link = link
        self._node = node
        self._asked = bytes(8)
        self._answer: bytes | None = None      # first answer to the current request
        self.doubled = 0               # number of answers to requests that were already answered
        self._aside: Callable[[bytes], None] = lambda data: None
        link.handlers[0x580 + node] = self._take

    def on_answer(self, take: Callable[[bytes], None]) -> None:
        """Register ``take``, which is called with every SDO answer of the drive, including answers to other clients."""
        self._aside = take

    def call(self, request: bytes, where: str, answer_s: float, tries: int) -> bytes:
        """Send a request and take frames off the link until it is answered."""
        for _ in range(tries):
            self._send(request)
            self._link.await_answer(lambda: self._answer is not None, answer_s)
            if self._answer is not None:
                return self._answer
        self._send(TIMED_OUT)
        raise CommunicationLost(
            f"node {self._node} does not answer SDO requests",
            where=where,
            next_step="Check that the drive is powered, its node-ID and bit rate, the cable and its termination",
            entry=MessageCode.NODE_SILENT,
        )

    def tell(self, message: bytes) -> None:
        """Send a message that has no answer."""
        self._send(message)

    def _send(self, request: bytes) -> None:
        self._link.drain()  # frames in the buffer answer an older request
        self._asked, self._answer = request, None
        self._link.send(0x600 + self._node, request)

    def _take(self, data: bytes) -> None:
        self._aside(data)
        if is_answer(self._asked, data):
            self.doubled += self._answer is not None
            self._answer = self._answer or data
