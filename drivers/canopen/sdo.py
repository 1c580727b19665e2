"""Reading and writing of objects by SDO, over `CanLink`.

The SDO client of the canopen package does the transfers (CiA 301, SDO upload and download, expedited and segmented).
Only its waiting is replaced: it takes frames off the link instead of sleeping on a queue that another thread fills.
"""

from __future__ import annotations

import queue
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import canopen
from canopen.sdo import SdoAbortedError, SdoClient, SdoCommunicationError

from drivers.canopen.bus import CanLink
from drivers.cia402 import Objects, is_answer, name
from drivers.errors import CommunicationLost, ObjectRefused
from profiles import MessageCode


class _LinkNetwork(canopen.Network):  # type: ignore[misc]
    """A canopen network without a bus of its own: it transmits through the link."""

    def __init__(self, link: CanLink) -> None:
        super().__init__()
        self._link = link

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self._link.send(can_id, bytes(data))


class _PumpingClient(SdoClient):  # type: ignore[misc]
    """SDO client that takes frames off the link while it waits for a response."""

    RESPONSE_TIMEOUT = 0.5
    MAX_RETRIES = 3

    def __init__(self, link: CanLink, node: int) -> None:
        super().__init__(0x600 + node, 0x580 + node, canopen.ObjectDictionary())
        self.network = _LinkNetwork(link)
        self._link = link
        self._asked = bytes(8)
        self._answers = 0              # number of answers to the current request
        self.doubled = 0               # number of answers to requests that were already answered
        self.aside: Callable[[bytes], None] = lambda data: None
        link.handlers[self.tx_cobid] = self._take

    def send_request(self, request: bytes) -> None:
        self._link.drain()  # frames in the buffer answer an older request
        self.responses: queue.Queue[bytes] = queue.Queue()
        self._asked = bytes(request)
        self._answers = 0
        super().send_request(request)

    def _take(self, data: bytes) -> None:
        self.aside(data)
        if is_answer(self._asked, data):
            self._answers += 1
            self.doubled += self._answers > 1
            self.responses.put(data)

    def read_response(self) -> Any:
        self._link.await_answer(lambda: not self.responses.empty(), self.RESPONSE_TIMEOUT)
        if self.responses.empty():
            raise SdoCommunicationError("No SDO response received")
        return super().read_response()


class SdoObjects(Objects):
    """The object dictionary of one node, by SDO.

    Raises ObjectRefused when the drive aborts a transfer and CommunicationLost when it doesn't answer.
    """

    def __init__(self, link: CanLink, node: int) -> None:
        super().__init__()
        self._client = _PumpingClient(link, node)
        self._node = node

    def on_answer(self, take: Callable[[bytes], None]) -> None:
        """Register ``take``, which is called with every SDO answer of the drive, including answers to other clients."""
        self._client.aside = take

    @property
    def doubled(self) -> int:
        """Number of requests that were answered twice."""
        return self._client.doubled

    @contextmanager
    def answered_within(self, answer_s: float) -> Iterator[None]:
        """Send each request once and wait at most ``answer_s`` of wall time: a shaft may be turning meanwhile."""
        client = self._client
        usual = client.RESPONSE_TIMEOUT, client.MAX_RETRIES
        client.RESPONSE_TIMEOUT, client.MAX_RETRIES = answer_s, 1
        try:
            yield
        finally:
            client.RESPONSE_TIMEOUT, client.MAX_RETRIES = usual

    def read_bytes(self, index: int, subindex: int = 0) -> bytes:
        try:
            return bytes(self._client.upload(index, subindex))
        except SdoAbortedError as error:
            raise ObjectRefused(f"the drive refused the read request: {error}", where=name(index, subindex)) from error
        except SdoCommunicationError as error:
            raise self._silent(index, subindex) from error

    def write_bytes(self, index: int, subindex: int, data: bytes, shown: str = "") -> None:
        """Write raw bytes. ``shown`` is the value for messages."""
        try:
            self._client.download(index, subindex, data)
        except SdoAbortedError as error:
            raise ObjectRefused(
                f"the drive refused the value {shown or data.hex(' ')}: {error}", where=name(index, subindex)
            ) from error
        except SdoCommunicationError as error:
            raise self._silent(index, subindex) from error

    def _silent(self, index: int, subindex: int) -> CommunicationLost:
        return CommunicationLost(
            f"node {self._node} does not answer SDO requests",
            where=name(index, subindex),
            next_step="Check that the drive is powered, its node-ID and bit rate, the cable and its termination",
            entry=MessageCode.NODE_SILENT,
        )
