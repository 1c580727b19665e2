"""Mailbox of the slave, and the CAN application protocol in it (ETG.1000.6).

::

    mailbox    length, address, channel, type | counter << 4 · type 3 is CoE, 0 an error
    CoE        service << 12: 1 emergency, 2 SDO request, 3 SDO response
"""

from collections.abc import Callable
from struct import Struct

from sim_bus.objects import ObjectStore
from sim_bus.sdo_server import ABORTED, SdoServer

_MAILBOX, _COE = Struct("<HHBB"), Struct("<H")
_TYPE_ERROR, _TYPE_COE = 0, 3
_EMERGENCY, _REQUEST, _RESPONSE = 1, 2, 3
_HEAD = _MAILBOX.size + _COE.size
_UNSUPPORTED_PROTOCOL, _INVALID_HEADER = 2, 5
"""Codes of a mailbox error."""

_SDO_SIZE = 8


class CoeServer:
    """CoE server for messages of the master. ``post`` puts a message into the mailbox that the master reads."""

    def __init__(self, store: ObjectStore, post: Callable[[bytes], None], mailbox_size: int) -> None:
        self.sdo = SdoServer(store, mailbox_size - _HEAD)
        self._post = post
        self._counter = self._last_counter = 0

    def reset(self) -> None:
        """Reset the mailbox."""
        self._counter = self._last_counter = 0
        self.sdo.reset()

    def emergency(self, message: bytes) -> None:
        """Send the eight bytes of an emergency message to the master."""
        self._send(_EMERGENCY, message)

    def take(self, message: bytes) -> None:
        """Take one message from the master. A repeated message is dropped."""
        length, _address, _channel, kind = _MAILBOX.unpack_from(message)
        counter = kind >> 4 & 7
        if counter and counter == self._last_counter:
            return
        self._last_counter = counter
        body = message[_MAILBOX.size:_MAILBOX.size + length]
        if kind & 0x0F != _TYPE_COE:
            self._error(_UNSUPPORTED_PROTOCOL)
        elif len(body) <= _COE.size or _COE.unpack_from(body)[0] >> 12 != _REQUEST:
            self._error(_INVALID_HEADER)
        elif answer := self.sdo.answer(body[_COE.size:].ljust(_SDO_SIZE, b"\0")):
            self._send(_REQUEST if answer[0] == ABORTED else _RESPONSE, answer)

    def _send(self, service: int, body: bytes) -> None:
        self._message(_TYPE_COE, _COE.pack(service << 12) + body)

    def _error(self, code: int) -> None:
        self._message(_TYPE_ERROR, (1).to_bytes(2, "little") + code.to_bytes(2, "little"))

    def _message(self, kind: int, content: bytes) -> None:
        self._counter = self._counter % 7 + 1
        self._post(_MAILBOX.pack(len(content), 0, 0, kind | self._counter << 4) + content)
