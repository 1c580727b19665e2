"""SDO client (CiA 301): transfers of objects in messages, on any bus that carries them.

A frame of CANopen has eight bytes, so data of more than four are sent in segments of seven. A longer message of
EtherCAT (CoE) holds them behind its first eight bytes (normal transfer), and segments follow only if they do not fit.

A drive decides how many segments follow, so each upload is bounded in length and time. The client aborts a longer one.
"""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager

from drivers.cia402.objects import Objects, name
from drivers.cia402.sdo_message import ABORT, TOGGLE, UPLOAD_SEGMENT, abort_text, download, upload, value_of
from drivers.errors import CommunicationLost, ObjectRefused
from profiles import MessageCode

_FRAME, _SEGMENT = 8, 7
LONGEST_OBJECT = 1024
"""Longest object that is read, bytes. The longest that tdhil needs is a text of CiA 301, which has some tens."""
LONGEST_NUMBER = 8
"""Longest number, bytes: UNSIGNED64 (CiA 301, data type 1Bh)."""
LONGEST_UPLOAD_S = 5.0
"""Longest wall time for the segments of one object, s: up to 147, for each of which a slow drive needs 10 ms."""
_TOO_LONG, _TOO_SLOW = 0x05040005, 0x05040000
"""Abort codes of CiA 301: out of memory, and time-out."""


class SdoClient(Objects):
    """The object dictionary of one drive. A bus implements `call`.

    ``normal``: messages are longer than eight bytes. ``tries``: number of attempts for a request, and for a segment.
    ``drive``: its name in messages. Raises ObjectRefused when the drive aborts a transfer, and CommunicationLost when
    it doesn't answer or sends an object without an end.
    """

    def __init__(self, answer_s: float, tries: tuple[int, int], *, normal: bool, drive: str) -> None:
        super().__init__()
        self._normal = normal
        self._drive = drive
        self._answer_s, self._tries = answer_s, tries
        self._at_rest = True

    @abstractmethod
    def call(self, request: bytes, where: str, answer_s: float, tries: int) -> bytes:
        """Send a request and return its answer (`is_answer`). ``where``: name of the object.

        Raises CommunicationLost without an answer.
        """

    @abstractmethod
    def tell(self, message: bytes) -> None:
        """Send a message that has no answer: an abort."""

    @contextmanager
    def answered_within(self, answer_s: float) -> Iterator[None]:
        """Send each request once and wait at most ``answer_s`` of wall time: a shaft may be turning meanwhile.

        A read then is one request and one answer. An object in segments is refused: the drive decides on their number,
        and the watchdog is not fed in between.
        """
        usual = self._answer_s, self._tries, self._at_rest
        self._answer_s, self._tries, self._at_rest = answer_s, (1, 1), False
        try:
            yield
        finally:
            self._answer_s, self._tries, self._at_rest = usual

    def read_bytes(self, index: int, subindex: int = 0) -> bytes:
        """Return the bytes of an object, at most `LONGEST_OBJECT`."""
        return self._upload(index, subindex, LONGEST_OBJECT)

    def read(self, index: int, subindex: int = 0, *, signed: bool = False) -> int:
        """Return the value of a number, which has at most `LONGEST_NUMBER` bytes."""
        return int.from_bytes(self._upload(index, subindex, LONGEST_NUMBER), "little", signed=signed)

    def _upload(self, index: int, subindex: int, longest: int) -> bytes:
        where, what = name(index, subindex), "the read request"
        request = upload(index, subindex)
        answer = self._transfer(request, where, what)
        data = value_of(answer)
        if answer[0] & 2:
            return data
        # CANopen states the size only if bit 0 is set; CoE always does (ETG.1000.6, 5.6.2.4)
        size = int.from_bytes(answer[4:8], "little") if self._normal or answer[0] & 1 else 0
        if size > longest or len(data) > longest:
            raise self._ended(request, where, f"announces {max(size, len(data))} bytes, and the limit is {longest}")
        toggle, last, spent_s = 0, False, 0.0
        while not last and not (self._normal and len(data) >= size):
            if not self._at_rest:
                raise self._ended(request, where, "sends segments while the shaft may turn")
            begun_s = time.monotonic()
            segment = self._transfer(bytes((UPLOAD_SEGMENT | toggle,)).ljust(_FRAME, b"\0"), where, what, segment=1)
            # After a freeze of this computer the time in between is not the drive's.
            spent_s += min(time.monotonic() - begun_s, self._answer_s * self._tries[1])
            part = segment[1 : 8 - (segment[0] >> 1 & 7)] if len(segment) == _FRAME else segment[1:]
            data, toggle, last = data + part, toggle ^ TOGGLE, bool(segment[0] & 1)
            if len(data) > longest:
                raise self._ended(request, where, f"sends more than {longest} bytes")
            if not last and not part:
                raise self._ended(request, where, "sends segments without data")
            if not last and spent_s > LONGEST_UPLOAD_S:
                raise self._ended(request, where, f"sent {len(data)} bytes in {spent_s:.1f} s without an end, and the "
                                  f"limit is {LONGEST_UPLOAD_S:g} s", _TOO_SLOW)
        return data[:size] if self._normal else data

    def _ended(self, request: bytes, where: str, what: str, code: int = _TOO_LONG) -> CommunicationLost:
        """Abort the upload, and return the error."""
        self.tell(bytes((ABORT,)) + request[1:4] + code.to_bytes(4, "little"))
        return CommunicationLost(
            f"{self._drive} {what}. tdhil ended the transfer", where=where,
            next_step="Compare the object with the drive's manual, and check firmware and gateway of the drive",
            entry=MessageCode.UPLOAD_WITHOUT_END,
        )

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
            toggle ^= TOGGLE

    def _transfer(self, request: bytes, where: str, what: str, *, segment: int = 0) -> bytes:
        answer = self.call(request, where, self._answer_s, self._tries[segment])
        if answer[0] == ABORT:
            error = abort_text(int.from_bytes(answer[4:8], "little"))
            raise ObjectRefused(f"the drive refused {what}: {error}", where=where)
        return answer
