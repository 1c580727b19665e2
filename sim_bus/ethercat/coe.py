"""CAN application protocol over EtherCAT: the SDO server behind the mailbox (ETG.1000.6).

::

    mailbox    length, address, channel, type | counter << 4 · type 3 is CoE, 0 an error
    CoE        service << 12: 1 emergency, 2 SDO request, 3 SDO response
    SDO        command, index, subindex, 4 bytes of data or size; more data follows in a normal transfer
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from struct import Struct

from canopen.sdo import SdoAbortedError

from sim_bus.objects import ABORT_LENGTH, ObjectStore

_MAILBOX, _COE, _SDO = Struct("<HHBB"), Struct("<H"), Struct("<BHB")
_TYPE_ERROR, _TYPE_COE = 0, 3
_EMERGENCY, _REQUEST, _RESPONSE = 1, 2, 3
_HEAD = _MAILBOX.size + _COE.size
_UNSUPPORTED_PROTOCOL, _INVALID_HEADER = 2, 5
"""Codes of a mailbox error."""

_ABORT_TOGGLE, _ABORT_COMMAND, _ABORT_COMPLETE, _ABORT_TRANSFER = 0x05030000, 0x05040001, 0x06010000, 0x08000020
_COMPLETE = 0x10
_LARGEST = 4096
"""Most bytes that a segmented download may bring."""


class Meddling(Enum):
    """What a scripted fault makes of the transfers of an object."""

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


class CoeServer:
    """Answers messages of the master; ``post`` puts a message into the mailbox that the master reads."""

    def __init__(self, store: ObjectStore, post: Callable[[bytes], None], mailbox_size: int) -> None:
        self._store = store
        self._post = post
        self._room = mailbox_size - _HEAD
        self._counter = self._last_counter = 0
        self._transfer: _Transfer | None = None
        self.meddling: dict[tuple[int, int], Meddling] = {}
        self.silent = False
        """Scripted: no message is answered."""

    def reset(self) -> None:
        """The mailbox starts anew."""
        self._counter = self._last_counter = 0
        self._transfer = None

    def emergency(self, code: int, register: int) -> None:
        """Tells the master of an error of the drive; 0 and 0: none any more."""
        self._send(_EMERGENCY, code.to_bytes(2, "little") + bytes((register, 0, 0, 0, 0, 0)))

    def take(self, message: bytes) -> None:
        """One message from the master; one that it repeats is dropped."""
        length, _address, _channel, kind = _MAILBOX.unpack_from(message)
        counter = kind >> 4 & 7
        if counter and counter == self._last_counter:
            return
        self._last_counter = counter
        body = message[_MAILBOX.size:_MAILBOX.size + length]
        if self.silent:
            return
        if kind & 0x0F != _TYPE_COE:
            self._error(_UNSUPPORTED_PROTOCOL)
        elif len(body) < _COE.size + _SDO.size:
            self._error(_INVALID_HEADER)
        elif _COE.unpack_from(body)[0] >> 12 == _REQUEST:
            self._sdo(body[_COE.size:].ljust(8, b"\0"))
        else:
            self._error(_INVALID_HEADER)

    def _send(self, service: int, body: bytes) -> None:
        self._message(_TYPE_COE, _COE.pack(service << 12) + body)

    def _error(self, code: int) -> None:
        self._message(_TYPE_ERROR, (1).to_bytes(2, "little") + code.to_bytes(2, "little"))

    def _message(self, kind: int, content: bytes) -> None:
        self._counter = self._counter % 7 + 1
        self._post(_MAILBOX.pack(len(content), 0, 0, kind | self._counter << 4) + content)

    # -- SDO ---------------------------------------------------------------------------------------------

    def _sdo(self, request: bytes) -> None:
        command, index, subindex = _SDO.unpack_from(request)
        kind, transfer = command >> 5, self._transfer
        if kind in {0, 3} and transfer is not None:
            index, subindex = transfer.index, transfer.subindex
        meddling = self.meddling.get((index, subindex))
        if meddling is Meddling.UNANSWERED:
            return
        try:
            if meddling is Meddling.ABORTED:
                raise SdoAbortedError(_ABORT_TRANSFER)
            if kind == 1:
                self._download(command, index, subindex, request)
            elif kind == 2:
                self._upload(command, index, subindex)
            elif kind == 4:
                self._transfer = None                    # the master aborts
            elif kind in {0, 3} and transfer is not None and transfer.upload is (kind == 3):
                self._segment(transfer, command, request)
            else:
                raise SdoAbortedError(_ABORT_COMMAND)
        except SdoAbortedError as error:
            self._transfer = None
            self._send(_REQUEST, _SDO.pack(0x80, index, subindex) + int(error.code).to_bytes(4, "little"))

    def _begin(self, command: int) -> None:
        self._transfer = None
        if command & _COMPLETE:
            raise SdoAbortedError(_ABORT_COMPLETE)

    def _keep(self, index: int, subindex: int, data: bytes) -> None:
        if self.meddling.get((index, subindex)) is not Meddling.NOT_KEPT:
            self._store.set_data(index, subindex, data, check_writable=True)

    def _upload(self, command: int, index: int, subindex: int) -> None:
        self._begin(command)
        data = self._store.get_data(index, subindex, check_readable=True)
        if self.meddling.get((index, subindex)) is Meddling.OTHERWISE:
            data = bytes((data[0] ^ 0x04,)) + data[1:]
        if 0 < len(data) <= 4:
            head = _SDO.pack(0x43 | 4 - len(data) << 2, index, subindex)
            self._send(_RESPONSE, head + data.ljust(4, b"\0"))
            return
        now = self._room - 8
        self._send(_RESPONSE, _SDO.pack(0x41, index, subindex) + len(data).to_bytes(4, "little") + data[:now])
        if len(data) > now:
            self._transfer = _Transfer(index, subindex, data[now:])

    def _download(self, command: int, index: int, subindex: int, request: bytes) -> None:
        self._begin(command)
        if command & 2:
            data = request[4:8 - (command >> 2 & 3)] if command & 1 else request[4:8]
            self._keep(index, subindex, data)
        else:
            size, data = int.from_bytes(request[4:8], "little"), request[8:]
            if size > _LARGEST:
                raise SdoAbortedError(ABORT_LENGTH)
            if size > len(data):
                self._transfer = _Transfer(index, subindex, data, size=size, upload=False)
            else:
                self._keep(index, subindex, data[:size])
        self._send(_RESPONSE, _SDO.pack(0x60, index, subindex) + bytes(4))

    def _segment(self, transfer: _Transfer, command: int, request: bytes) -> None:
        toggle = command & 0x10
        if toggle != transfer.toggle:
            raise SdoAbortedError(_ABORT_TOGGLE)
        transfer.toggle ^= 0x10
        if transfer.upload:
            now, transfer.data = transfer.data[:self._room - 1], transfer.data[self._room - 1:]
            last = not transfer.data
            self._send(_RESPONSE, bytes((toggle | max(0, 7 - len(now)) << 1 | last,)) + now.ljust(7, b"\0"))
        else:
            data = request[1:]
            transfer.data += data[:7 - (command >> 1 & 7)] if len(data) == 7 else data
            last = bool(command & 1)
            if last or len(transfer.data) > transfer.size:
                if len(transfer.data) != transfer.size:
                    raise SdoAbortedError(ABORT_LENGTH)
                self._keep(transfer.index, transfer.subindex, transfer.data)
            self._send(_RESPONSE, bytes((0x20 | toggle,)) + bytes(7))
        if last:
            self._transfer = None
