"""SDO client (CiA 301): transfers of objects in messages, on any bus that carries them.

A frame of CANopen has eight bytes, so data of more than four are sent in segments of seven. A longer message of
EtherCAT (CoE) holds them behind its first eight bytes (normal transfer), and segments follow only if they do not fit.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager

from drivers.cia402.objects import Objects, name
from drivers.cia402.sdo_message import ABORT, UPLOAD_SEGMENT, abort_text, download, upload, value_of
from drivers.errors import ObjectRefused

_FRAME, _SEGMENT = 8, 7
_TOGGLE = 0x10


class SdoClient(Objects):
    """The object dictionary of one drive. A bus implements `call`.

    ``normal``: messages are longer than eight bytes. ``tries``: number of attempts for a request, and for a segment.
    Raises ObjectRefused when the drive aborts a transfer and CommunicationLost when it doesn't answer.
    """

    def __init__(self, answer_s: float, tries: tuple[int, int], *, normal: bool) -> None:
        super().__init__()
        self._normal = normal
        self._answer_s, self._tries = answer_s, tries

    @abstractmethod
    def call(self, request: bytes, where: str, answer_s: float, tries: int) -> bytes:
        """Send a request and return its answer (`is_answer`). ``where``: name of the object.

        Raises CommunicationLost without an answer.
        """

    @contextmanager
    def answered_within(self, answer_s: float) -> Iterator[None]:
        """Send each request once and wait at most ``answer_s`` of wall time: a shaft may be turning meanwhile."""
        usual = self._answer_s, self._tries
        self._answer_s, self._tries = answer_s, (1, 1)
        try:
            yield
        finally:
            self._answer_s, self._tries = usual

    def read_bytes(self, index: int, subindex: int = 0) -> bytes:
        """Return the bytes of an object."""
        where, what = name(index, subindex), "the read request"
        answer = self._transfer(upload(index, subindex), where, what)
        data = value_of(answer)
        if answer[0] & 2:
            return data
        size, toggle, last = int.from_bytes(answer[4:8], "little"), 0, False
        while not last and not (self._normal and len(data) >= size):
            segment = self._transfer(bytes((UPLOAD_SEGMENT | toggle,)).ljust(_FRAME, b"\0"), where, what, segment=1)
            data += segment[1 : 8 - (segment[0] >> 1 & 7)] if len(segment) == _FRAME else segment[1:]
            toggle, last = toggle ^ _TOGGLE, bool(segment[0] & 1)
        return data[:size] if self._normal else data

    def write_bytes(self, index: int, subindex: int, data: bytes, shown: str = "") -> None:
        """Write raw bytes. ``shown`` is the value for messages."""
        where, what = name(index, subindex), f"the value {shown or data.hex(' ')}"
        request, rest = download(index, subindex, data), b""
        if not self._normal:
            request, rest = request[:_FRAME], request[_FRAME:]
        self._transfer(request, where, what)
        toggle = 0
        while rest:
            now, rest = rest[:_SEGMENT], rest[_SEGMENT:]
            head = toggle | _SEGMENT - len(now) << 1 | (not rest)
            self._transfer(bytes((head,)) + now.ljust(_SEGMENT, b"\0"), where, what, segment=1)
            toggle ^= _TOGGLE

    def _transfer(self, request: bytes, where: str, what: str, *, segment: int = 0) -> bytes:
        answer = self.call(request, where, self._answer_s, self._tries[segment])
        if answer[0] == ABORT:
            error = abort_text(int.from_bytes(answer[4:8], "little"))
            raise ObjectRefused(f"the drive refused {what}: {error}", where=where)
        return answer
