"""Modbus frames around PDUs, as the drive sees them. Pure.

::

    TCP   transaction:2 protocol:2 = 0  length:2  unit:1  PDU          (messaging guide, section 3.1.3)
    RTU   unit:1  PDU  CRC:2, low byte first                            (serial line guide, section 2.5.1)

The RTU end of frame is known from its function code; where the code is unknown, from a CRC that fits. Silence clears
what is left of a broken frame. Written for the drive alone; the host has its own.
"""

from collections.abc import Iterator
from struct import Struct
from typing import NamedTuple

_MBAP = Struct(">HHHB")
_LONGEST_TCP = 260
_LONGEST_RTU = 256
_SILENCE_S = 0.05
"""A pty has no bit rate, and a host may be held up between two bytes: far more than the 1.75 ms of a line."""
_FIXED = dict.fromkeys((1, 2, 3, 4, 5, 6, 8), 8)
_COUNTED = {15: (6, 9), 16: (6, 9), 23: (10, 13)}
"""function: (where its byte count stands, length without what it counts)."""


class Request(NamedTuple):
    """To whom, what, and the transaction that the reply repeats; ``connection`` tells clients apart."""

    unit: int
    pdu: bytes
    transaction: int = 0
    connection: int = 0


class NotModbus(Exception):
    """The peer doesn't speak Modbus."""


def tcp_requests(buffer: bytearray) -> Iterator[Request]:
    """Takes whole frames off ``buffer``. NotModbus for anything else."""
    while len(buffer) >= _MBAP.size:
        transaction, protocol, length, unit = _MBAP.unpack_from(buffer)
        if protocol or not 2 <= length <= _LONGEST_TCP - 6:
            raise NotModbus
        if len(buffer) < 6 + length:
            return
        pdu = bytes(buffer[_MBAP.size : 6 + length])
        del buffer[: 6 + length]
        yield Request(unit, pdu, transaction)


def tcp_reply(request: Request, pdu: bytes, wrong_bits: int = 0) -> bytes:
    """The frame that answers; ``wrong_bits`` of its transaction are another's."""
    return _MBAP.pack(request.transaction ^ wrong_bits, 0, len(pdu) + 1, request.unit) + pdu


class RtuReceiver:
    """Bytes in as they come, requests out."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._heard_s = 0.0

    def feed(self, data: bytes, now_s: float) -> Iterator[Request]:
        """``now_s`` on any clock that doesn't go back."""
        if now_s - self._heard_s > _SILENCE_S:
            self._buffer.clear()
        self._heard_s = now_s
        self._buffer += data
        while len(self._buffer) >= 4:
            length = self._length()
            if length == 0:
                return
            frame, self._buffer = self._buffer[:length], self._buffer[length:]
            if crc(frame[:-2]) != int.from_bytes(frame[-2:], "little"):
                self._buffer.clear()        # out of step: silence will tell where the next frame begins
                return
            yield Request(frame[0], bytes(frame[1:-2]))

    def _length(self) -> int:
        """Of the frame at the beginning; 0 while it isn't there."""
        buffer = self._buffer
        function = buffer[1]
        if function in _FIXED:
            length = _FIXED[function]
        elif function in _COUNTED:
            at, fixed = _COUNTED[function]
            length = fixed + buffer[at] if len(buffer) > at else _LONGEST_RTU
        elif crc(buffer[:-2]) == int.from_bytes(buffer[-2:], "little") or len(buffer) >= _LONGEST_RTU:
            length = len(buffer)
        else:
            return 0
        return length if len(buffer) >= length else 0


def rtu_reply(request: Request, pdu: bytes, wrong_bits: int = 0) -> bytes:
    """The frame that answers; ``wrong_bits`` of its CRC are wrong."""
    body = bytes((request.unit,)) + pdu
    return body + (crc(body) ^ wrong_bits).to_bytes(2, "little")


def crc(data: bytes | bytearray) -> int:
    """CRC-16 of the serial line guide: polynomial A001h, reflected, from FFFFh."""
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ 0xA001 if value & 1 else value >> 1
    return value
