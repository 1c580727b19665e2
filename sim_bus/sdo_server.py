"""SDO server of CiA 301 over an object dictionary, for a bus whose messages hold more than eight bytes. Pure.

::

    command, index, subindex, 4 bytes of data or size; more data follows in a normal transfer
    a segment: command, data
"""

from dataclasses import dataclass
from enum import Enum
from struct import Struct

from canopen.sdo import SdoAbortedError

from sim_bus.objects import ABORT_LENGTH, ObjectStore

HEAD = Struct("<BHB")
ABORTED = 0x80
"""Command of an abort."""

_DOWNLOAD_SEGMENT, _DOWNLOAD, _UPLOAD, _UPLOAD_SEGMENT, _ABORT = range(5)
"""Command specifiers of requests."""

_ABORT_TOGGLE, _ABORT_COMMAND, _ABORT_COMPLETE, _ABORT_TRANSFER = 0x05030000, 0x05040001, 0x06010000, 0x08000020
_COMPLETE = 0x10
_LARGEST = 4096
"""Largest length of a segmented download, bytes."""


class Meddling(Enum):
    """Effect of a scripted fault on the transfers of an object."""

    ABORTED, UNANSWERED, NOT_KEPT, OTHERWISE = range(4)


@dataclass
class _Transfer:
    """A segmented transfer under way."""

    index: int
    subindex: int
    data: bytes
    size: int = 0
    toggle: int = 0
    upload: bool = True


class SdoServer:
    """Server that answers one request after the other. ``room``: length of a message of the bus, bytes."""

    def __init__(self, store: ObjectStore, room: int) -> None:
        self._store = store
        self._room = room
        self._transfer: _Transfer | None = None
        self.meddling: dict[tuple[int, int], Meddling] = {}

    def reset(self) -> None:
        """Discard a transfer under way."""
        self._transfer = None

    def answer(self, request: bytes) -> bytes:
        """Return the answer to a request of at least eight bytes; empty: there is none."""
        command, index, subindex = HEAD.unpack_from(request)
        kind, transfer = command >> 5, self._transfer
        segment = kind in {_DOWNLOAD_SEGMENT, _UPLOAD_SEGMENT}
        if segment and transfer is not None:
            index, subindex = transfer.index, transfer.subindex
        meddling = self.meddling.get((index, subindex))
        if kind == _ABORT or meddling is Meddling.UNANSWERED:
            self._transfer = None
            return b""
        try:
            if meddling is Meddling.ABORTED:
                raise SdoAbortedError(_ABORT_TRANSFER)
            if kind == _DOWNLOAD:
                return self._download(command, index, subindex, request)
            if kind == _UPLOAD:
                return self._upload(command, index, subindex)
            if segment and transfer is not None and transfer.upload is (kind == _UPLOAD_SEGMENT):
                return self._segment(transfer, command, request)
            raise SdoAbortedError(_ABORT_COMMAND)
        except SdoAbortedError as error:
            self._transfer = None
            return HEAD.pack(ABORTED, index, subindex) + int(error.code).to_bytes(4, "little")

    def _begin(self, command: int) -> None:
        self._transfer = None
        if command & _COMPLETE:
            raise SdoAbortedError(_ABORT_COMPLETE)

    def _keep(self, index: int, subindex: int, data: bytes) -> None:
        if self.meddling.get((index, subindex)) is not Meddling.NOT_KEPT:
            self._store.set_data(index, subindex, data, check_writable=True)

    def _upload(self, command: int, index: int, subindex: int) -> bytes:
        self._begin(command)
        data = self._store.get_data(index, subindex, check_readable=True)
        if self.meddling.get((index, subindex)) is Meddling.OTHERWISE:
            data = bytes((data[0] ^ 0x04,)) + data[1:]
        if 0 < len(data) <= 4:
            return HEAD.pack(0x43 | 4 - len(data) << 2, index, subindex) + data.ljust(4, b"\0")
        now = self._room - 8
        if len(data) > now:
            self._transfer = _Transfer(index, subindex, data[now:])
        return HEAD.pack(0x41, index, subindex) + len(data).to_bytes(4, "little") + data[:now]

    def _download(self, command: int, index: int, subindex: int, request: bytes) -> bytes:
        self._begin(command)
        if command & 2:
            self._keep(index, subindex, request[4:8 - (command >> 2 & 3)] if command & 1 else request[4:8])
        else:
            size, data = int.from_bytes(request[4:8], "little"), request[8:]
            if size > _LARGEST:
                raise SdoAbortedError(ABORT_LENGTH)
            if size > len(data):
                self._transfer = _Transfer(index, subindex, data, size=size, upload=False)
            else:
                self._keep(index, subindex, data[:size])
        return HEAD.pack(0x60, index, subindex) + bytes(4)

    def _segment(self, transfer: _Transfer, command: int, request: bytes) -> bytes:
        toggle = command & 0x10
        if toggle != transfer.toggle:
            raise SdoAbortedError(_ABORT_TOGGLE)
        transfer.toggle ^= 0x10
        if transfer.upload:
            now, transfer.data = transfer.data[:self._room - 1], transfer.data[self._room - 1:]
            last = not transfer.data
            answer = bytes((toggle | max(0, 7 - len(now)) << 1 | last,)) + now.ljust(7, b"\0")
        else:
            data = request[1:]
            transfer.data += data[:7 - (command >> 1 & 7)] if len(data) == 7 else data
            last = bool(command & 1)
            if last or len(transfer.data) > transfer.size:
                if len(transfer.data) != transfer.size:
                    raise SdoAbortedError(ABORT_LENGTH)
                self._keep(transfer.index, transfer.subindex, transfer.data)
            answer = bytes((0x20 | toggle,)) + bytes(7)
        if last:
            self._transfer = None
        return answer
