"""One chunk of an MCAP file, decompressed within limits that hold whatever it declares.

::

    06 length:8  start time:8  end time:8  uncompressed size:8  CRC:4  n:4 compression  size:8 data
"""

from dataclasses import dataclass
from struct import Struct
from typing import BinaryIO, Final
from zlib import crc32

import lz4.frame  # type: ignore[import-untyped]
import zstandard

CHUNK_LIMIT: Final = 16 * 2**20        # bytes, uncompressed; a power of two, as zstd's window wants it
CHUNK: Final = 0x06
CHUNK_HEAD: Final = Struct("<QQQII")
_RECORD: Final = Struct("<BQ")


@dataclass(frozen=True)
class Damage:
    """Something that was stepped over; ``offset`` is its place in the file."""

    offset: int
    text: str

    def __str__(self) -> str:
        return f"byte {self.offset}: {self.text}"


@dataclass(frozen=True)
class Contents:
    """What one good chunk holds, uncompressed; ``offset`` is the chunk's place in the file."""

    offset: int
    data: bytes


@dataclass(frozen=True)
class ChunkHead:
    """What a chunk says of itself; its compressed data stand at ``start``, ``length`` bytes long."""

    compression: str
    uncompressed_size: int
    crc: int
    start: int
    length: int


def chunk_head(file: BinaryIO, offset: int, size: int) -> ChunkHead | None:
    """The chunk record at ``offset``, if there is one whose lengths agree with each other and with the file."""
    head = read_at(file, offset, _RECORD.size + CHUNK_HEAD.size + 24)
    if len(head) < _RECORD.size + CHUNK_HEAD.size or head[0] != CHUNK:
        return None
    _, length = _RECORD.unpack_from(head)
    _, _, uncompressed_size, crc, name_length = CHUNK_HEAD.unpack_from(head, _RECORD.size)
    name_at = _RECORD.size + CHUNK_HEAD.size
    if name_length > 8 or len(head) < name_at + name_length + 8 or offset + _RECORD.size + length > size:
        return None
    name = head[name_at:name_at + name_length].decode("ascii", "replace")
    data_length = int.from_bytes(head[name_at + name_length:name_at + name_length + 8], "little")
    if length != CHUNK_HEAD.size + name_length + 8 + data_length:
        return None
    return ChunkHead(name, uncompressed_size, crc, offset + name_at + name_length + 8, data_length)


def contents(file: BinaryIO, offset: int, chunk: ChunkHead) -> Contents | Damage:
    """The chunk whose head was read at ``offset``, decompressed and checked."""
    if chunk.uncompressed_size > CHUNK_LIMIT or chunk.length > CHUNK_LIMIT:
        return Damage(offset, f"a chunk of {max(chunk.uncompressed_size, chunk.length)} bytes is refused "
                               f"(limit {CHUNK_LIMIT})")
    data = read_at(file, chunk.start, chunk.length)
    try:
        inflated = _decompress(chunk.compression, data, chunk.uncompressed_size + 1)
    except (zstandard.ZstdError, RuntimeError, ValueError, EOFError, MemoryError) as error:
        return Damage(offset, f"a chunk can't be decompressed: {' '.join(str(error).split())}")
    if len(inflated) != chunk.uncompressed_size:
        return Damage(offset, f"a chunk is not of the size it declares ({chunk.uncompressed_size} bytes)")
    if chunk.crc and crc32(inflated) != chunk.crc:
        return Damage(offset, "a chunk is damaged: its CRC is wrong")
    return Contents(offset, inflated)


def _decompress(compression: str, data: bytes, limit: int) -> bytes:
    """At most ``limit`` bytes of it, and never more than that in memory."""
    if compression == "zstd":
        with zstandard.ZstdDecompressor(max_window_size=CHUNK_LIMIT).stream_reader(data) as reader:
            return reader.read(limit)
    if compression == "lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=limit))
    if compression == "":
        return data[:limit]
    raise ValueError(f"unknown compression {compression!r}")


def read_at(file: BinaryIO, offset: int, length: int) -> bytes:
    """Up to ``length`` bytes from ``offset`` on; fewer at the end of the file."""
    file.seek(max(0, offset))
    return file.read(length)
