"""The records inside a chunk that passed its CRC: pure, over bytes that may still be hostile."""

from collections.abc import Iterator
from struct import Struct
from typing import NamedTuple

_RECORD = Struct("<BQ")
_MESSAGE = Struct("<HIQQ")
SCHEMA, CHANNEL, MESSAGE = 0x03, 0x04, 0x05
_LONGEST = 128                         # characters of a name: ours are shorter


class Schema(NamedTuple):
    """``identifier:2  n:4 name  …``: the fields themselves are known here."""

    identifier: int
    name: str


class Channel(NamedTuple):
    """``identifier:2  schema:2  n:4 topic  …``."""

    identifier: int
    schema: int
    topic: str


class Message(NamedTuple):
    """``channel:2  sequence:4  log time:8  publish time:8  payload``."""

    channel: int
    log_time_ns: int
    payload: bytes


def records(chunk: bytes) -> Iterator[Schema | Channel | Message]:
    """The records in order; others are stepped over. Raises ValueError where a record leaves the chunk."""
    offset, size = 0, len(chunk)
    while offset < size:
        if offset + _RECORD.size > size:
            raise ValueError("a record is cut")
        opcode, length = _RECORD.unpack_from(chunk, offset)
        start = offset + _RECORD.size
        offset = start + length
        if offset > size:
            raise ValueError("a record is longer than its chunk")
        if opcode == MESSAGE:
            if length < _MESSAGE.size:
                raise ValueError("a message is too short")
            channel, _, log_time_ns, _ = _MESSAGE.unpack_from(chunk, start)
            yield Message(channel, log_time_ns, chunk[start + _MESSAGE.size:offset])
        elif opcode == SCHEMA:
            yield Schema(_number(chunk, start), _string(chunk, start + 2, offset))
        elif opcode == CHANNEL:
            yield Channel(_number(chunk, start), _number(chunk, start + 2), _string(chunk, start + 4, offset))


def _number(chunk: bytes, start: int) -> int:
    return int.from_bytes(chunk[start:start + 2], "little")


def _string(chunk: bytes, start: int, end: int) -> str:
    length = min(_LONGEST, int.from_bytes(chunk[start:start + 4], "little"))
    return chunk[start + 4:min(end, start + 4 + length)].decode("utf-8", "replace")
