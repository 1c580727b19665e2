"""The words of socketcand's raw mode, as python-can's stock client speaks and understands them. Pure.

::

    server → client   < hi >                               on connection
    client → server   < open can0 >                        → < ok >
    client → server   < rawmode >                          → < ok >
    client → server   < send 123 2 a 1f >                  identifier (3 or 8 digits), length, bytes; hex
    server → client   < frame 123 1700000000.123456 0A1F > bytes without blanks; none at all: two blanks before >

A length with no bytes is what the client makes of a remote frame.
"""

from dataclasses import dataclass

HI = b"< hi >"
OK = b"< ok >"
LONGEST_WORD = 512
"""A client that sends so much without a ``>`` isn't one."""


@dataclass(frozen=True, slots=True)
class WireFrame:
    """A frame on its way through the hub."""

    can_id: int
    extended: bool
    data: bytes
    remote_length: int | None = None


def split(buffer: bytearray) -> list[str]:
    """Takes the complete words ``< … >`` out of the front of ``buffer`` and returns what stands inside them."""
    end = buffer.rfind(b">")
    if end < 0:
        return []
    text = buffer[: end + 1].decode("ascii", "replace")
    del buffer[: end + 1]
    return [word.split("<", 1)[-1].strip() for word in text.split(">")[:-1]]


def parse_send(word: str) -> WireFrame | None:
    """The frame in ``send …``; None where it is none."""
    parts = word.split()
    try:
        can_id, length = int(parts[1], 16), int(parts[2], 16)
        data = bytes(int(part, 16) for part in parts[3:])
    except (IndexError, ValueError):
        return None
    extended = len(parts[1]) > 3
    if not 0 <= length <= 8 or not 0 <= can_id <= (0x1FFFFFFF if extended else 0x7FF):
        return None
    if not data and length:
        return WireFrame(can_id, extended, b"", length)
    return WireFrame(can_id, extended, data) if len(data) == length else None


def frame_word(frame: WireFrame, time_s: float) -> bytes:
    """What a client is told of a frame."""
    digits = f"{frame.can_id:08X}" if frame.extended else f"{frame.can_id:03X}"
    return f"< frame {digits} {time_s:.6f} {frame.data.hex().upper()} >".encode("ascii")
