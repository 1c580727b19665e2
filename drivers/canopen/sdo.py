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
from drivers.errors import CommunicationLost, ObjectRefused
from drivers.undo_journal import UndoJournal
from profiles import MessageCode


class _LinkNetwork(canopen.Network):  # type: ignore[misc]
    """A canopen network without a bus of its own: it transmits through the link."""

    def __init__(self, link: CanLink) -> None:
        super().__init__()
        self._link = link

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self._link.send(can_id, bytes(data))


_ANSWERS = {0: 1, 1: 3, 2: 2, 3: 0}
"""Command specifier of the request → that of its response (CiA 301): segment and initiate, download and upload."""
_INITIATE = (1, 2)
_ABORT = 0x80


def is_answer(request: bytes, response: bytes) -> bool:
    """Return whether the frame answers the request. Late answers and answers to other clients do not."""
    if len(response) != 8:
        return False
    command = request[0] >> 5
    same_object = response[1:4] == request[1:4]
    if response[0] == _ABORT:
        return same_object or command not in _INITIATE
    return response[0] >> 5 == _ANSWERS.get(command) and (same_object or command not in _INITIATE)


class _PumpingClient(SdoClient):  # type: ignore[misc]
    """Waits for a response by taking frames off the link."""

    RESPONSE_TIMEOUT = 0.5
    MAX_RETRIES = 3

    def __init__(self, link: CanLink, node: int) -> None:
        super().__init__(0x600 + node, 0x580 + node, canopen.ObjectDictionary())
        self.network = _LinkNetwork(link)
        self._link = link
        self._asked = bytes(8)
        self._answers = 0              # to the current request
        self.doubled = 0               # answers to a request that was already answered
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


class Objects:
    """The drive's object dictionary, as integers and strings.

    Raises ObjectRefused when the drive aborts a transfer and CommunicationLost when it doesn't answer.
    """

    def __init__(self, link: CanLink, node: int) -> None:
        self._client = _PumpingClient(link, node)
        self._node = node
        self._undo: list[Callable[[], None]] = []
        self._changed: set[tuple[int, int]] = set()
        self.journal: UndoJournal | None = None        # records each change before it is made
        self.stands: dict[tuple[int, int], bytes] = {}     # last value read back, or found right

    def on_answer(self, take: Callable[[bytes], None]) -> None:
        """Have ``take`` see every SDO answer of the drive, including answers to other clients."""
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

    def read(self, index: int, subindex: int = 0, *, signed: bool = False) -> int:
        return int.from_bytes(self.read_bytes(index, subindex), "little", signed=signed)

    def read_if_there(self, index: int, subindex: int = 0, *, signed: bool = False) -> int | None:
        """Return the value, or None if the drive does not have the object."""
        try:
            return self.read(index, subindex, signed=signed)
        except ObjectRefused:
            return None

    def write(self, index: int, subindex: int, value: int, bits: int) -> None:
        self.write_bytes(index, subindex, _encoded(value, bits, name(index, subindex)), str(value))

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

    def change(self, index: int, subindex: int, value: int, bits: int) -> int:
        """Write a value, remember the former one, and return the value read back."""
        signed = value < 0
        before = self.read_bytes(index, subindex)
        if int.from_bytes(before, "little", signed=signed) != value:
            after = _encoded(value, bits, name(index, subindex))
            self._note_change(index, subindex, before, after)
            self.write_bytes(index, subindex, after, str(value))
        back = self.stands[index, subindex] = self.read_bytes(index, subindex)
        return int.from_bytes(back, "little", signed=signed)

    def change_bytes(self, index: int, subindex: int, data: bytes) -> bytes:
        """Do the same as `change`, for an object of any type."""
        before = self.read_bytes(index, subindex)
        if before != data:
            self._note_change(index, subindex, before, data)
            self.write_bytes(index, subindex, data)
        back = self.stands[index, subindex] = self.read_bytes(index, subindex)
        return back

    def _note_change(self, index: int, subindex: int, before: bytes, after: bytes) -> None:
        """Register the restore, and record the former value in case this host dies."""
        where = name(index, subindex)
        if (index, subindex) not in self._changed:
            self._changed.add((index, subindex))
            self.on_restore(lambda: self._give_back(index, subindex, before))
        if self.journal is not None:
            self.journal.changing(where, before, after)

    def _give_back(self, index: int, subindex: int, before: bytes) -> None:
        self.write_bytes(index, subindex, before, str(int.from_bytes(before, "little")))
        if self.journal is not None:
            self.journal.given_back(name(index, subindex))

    def on_restore(self, undo: Callable[[], None]) -> None:
        """Have ``undo`` called by `restore`."""
        self._undo.append(undo)

    def restore(self) -> tuple[str, ...]:
        """Undo every change, the last one first. Return the changes that could not be restored."""
        failed = []
        self._changed.clear()
        while self._undo:
            try:
                self._undo.pop()()
            except ObjectRefused as error:
                failed.append(str(error))
            except CommunicationLost as error:
                failed.append(str(error))
                self._undo.clear()
        return tuple(failed)

    def _silent(self, index: int, subindex: int) -> CommunicationLost:
        return CommunicationLost(
            f"node {self._node} does not answer SDO requests",
            where=name(index, subindex),
            next_step="Check that the drive is powered, its node-ID and bit rate, the cable and its termination",
            entry=MessageCode.NODE_SILENT,
        )


def _encoded(value: int, bits: int, where: str) -> bytes:
    try:
        return value.to_bytes(bits // 8, "little", signed=value < 0)
    except OverflowError as error:
        raise ObjectRefused(f"{value} is outside the range of {bits} bits", where=where) from error


def place(where: str) -> tuple[int, int]:
    """Return (index, subindex) of a name written by `name`. Raises ValueError."""
    index, _, subindex = where.partition(":")
    return int(index.removesuffix("h"), 16), int(subindex or 0)


def name(index: int, subindex: int = 0) -> str:
    """Return an object's name for messages: 6040h, 1016h:1."""
    return f"{index:04X}h:{subindex}" if subindex else f"{index:04X}h"
