"""Reading of an MCAP file that may be complete, cut, damaged or hostile: yields the content that can be trusted.

::

    magic  { 06 length:8  Chunk   { 07 length:8  MessageIndex } … } …  0F DataEnd  summary  02 Footer  magic

Only the content of chunks is used, because only chunks have a CRC; indexes and summary are skipped. Other tools add
attachments and metadata between the records. Both are skipped without being read, if their lengths are consistent.
After invalid records, the next chunk is searched by the name of its compression and its consistent lengths. At most the
limit of a chunk (`contents`) is decompressed, and `TOTAL_LIMIT` in all.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from struct import Struct
from typing import BinaryIO, Final
from zlib import crc32

import lz4.frame  # type: ignore[import-untyped]
import zstandard

from tdhil.file_kind import MAGIC
from tdhil.recording.mcap_records import (
    ATTACHMENT,
    CHUNK,
    DATA_END,
    FOOTER,
    HEADER,
    KNOWN,
    MESSAGE_INDEX,
    METADATA,
    RECORD_HEAD,
)

# ---------------------------------------------------------------------------------------------------------------------
# One chunk of an MCAP file, decompressed within limits that do not depend on its declarations.
#
# ::
#
#     06 length:8  start time:8  end time:8  uncompressed size:8  CRC:4  n:4 compression  size:8 data


CHUNK_LIMIT: Final = 16 * 2**20        # bytes, uncompressed; a power of two, as the window of zstd requires
CHUNK_HEAD: Final = Struct("<QQQII")


@dataclass(frozen=True)
class Damage:
    """Damaged place that was skipped; ``offset`` is its position in the file."""

    offset: int
    text: str

    def __str__(self) -> str:
        return f"byte {self.offset}: {self.text}"


@dataclass(frozen=True)
class Contents:
    """Content of one good chunk, uncompressed; ``offset`` is the chunk's position in the file."""

    offset: int
    data: bytes


@dataclass(frozen=True)
class ChunkHead:
    """Header of a chunk; its compressed data are at ``start``, ``length`` bytes long."""

    compression: str
    uncompressed_size: int
    crc: int
    start: int
    length: int


def chunk_head(file: BinaryIO, offset: int, size: int) -> ChunkHead | None:
    """Return the chunk record at ``offset``, if its lengths agree with each other and with the file; else None."""
    head = read_at(file, offset, RECORD_HEAD.size + CHUNK_HEAD.size + 24)
    if len(head) < RECORD_HEAD.size + CHUNK_HEAD.size or head[0] != CHUNK:
        return None
    _, length = RECORD_HEAD.unpack_from(head)
    _, _, uncompressed_size, crc, name_length = CHUNK_HEAD.unpack_from(head, RECORD_HEAD.size)
    name_at = RECORD_HEAD.size + CHUNK_HEAD.size
    if name_length > 8 or len(head) < name_at + name_length + 8 or offset + RECORD_HEAD.size + length > size:
        return None
    name = head[name_at:name_at + name_length].decode("ascii", "replace")
    data_length = int.from_bytes(head[name_at + name_length:name_at + name_length + 8], "little")
    if length != CHUNK_HEAD.size + name_length + 8 + data_length:
        return None
    return ChunkHead(name, uncompressed_size, crc, offset + name_at + name_length + 8, data_length)


def contents(file: BinaryIO, offset: int, chunk: ChunkHead, zstd: zstandard.ZstdDecompressor) -> Contents | Damage:
    """Return the chunk with the head read at ``offset``, decompressed and checked. ``zstd`` limits the window.

    No more memory is used than for one byte above the stated size.
    """
    if chunk.uncompressed_size > CHUNK_LIMIT or chunk.length > CHUNK_LIMIT:
        return Damage(offset, f"a chunk of {max(chunk.uncompressed_size, chunk.length)} bytes is refused "
                               f"(limit {CHUNK_LIMIT})")
    data = read_at(file, chunk.start, chunk.length)
    limit = chunk.uncompressed_size + 1
    try:
        if chunk.compression == "zstd" and 0 <= zstandard.frame_content_size(data) < limit:
            inflated = zstd.decompress(data)        # memory is reserved for the size that the frame states
        elif chunk.compression == "zstd":
            with zstd.stream_reader(data) as reader:
                inflated = reader.read(limit)
        elif chunk.compression == "lz4":
            inflated = bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=limit))
        elif chunk.compression == "":
            inflated = data[:limit]
        else:
            raise ValueError(f"unknown compression {chunk.compression!r}")
    except (zstandard.ZstdError, RuntimeError, ValueError, EOFError, MemoryError) as error:
        return Damage(offset, f"a chunk can't be decompressed: {' '.join(str(error).split())}")
    if len(inflated) != chunk.uncompressed_size:
        return Damage(offset, f"a chunk is not of the size it declares ({chunk.uncompressed_size} bytes)")
    if chunk.crc and crc32(inflated) != chunk.crc:
        return Damage(offset, "a chunk is damaged: its CRC is wrong")
    return Contents(offset, inflated)


def read_at(file: BinaryIO, offset: int, length: int) -> bytes:
    """Return up to ``length`` bytes from ``offset`` on; fewer at the end of the file."""
    file.seek(max(0, offset))
    return file.read(length)


# ---------------------------------------------------------------------------------------------------------------------

TOTAL_LIMIT: Final = 4 * 2**30
_INDEX_HEAD: Final = RECORD_HEAD.size + 6                     # channel:2  length of the rest:4
_NAMES: Final = re.compile(rb"\x04\0\0\0zstd|\x03\0\0\0lz4")
_FOOTER: Final = RECORD_HEAD.pack(FOOTER, 20)
_STEP: Final = 2**20


@dataclass(frozen=True)
class Library:
    """Program that wrote the file, as stated in it."""

    name: str


class Whole:
    """Sign of a file that was closed properly, at its end."""


Found = Contents | Damage | Library | Whole


def walk(file: BinaryIO, size: int) -> Iterator[Found]:
    """Yield the content of every good chunk, damaged places, the library, and the end of a closed file.

    ``size`` is the length of the file. The caller checks the magic at its start.
    """
    offset, total = len(MAGIC), 0
    zstd = zstandard.ZstdDecompressor(max_window_size=CHUNK_LIMIT)
    while True:
        head = read_at(file, offset, _INDEX_HEAD)
        opcode, length = RECORD_HEAD.unpack_from(head) if len(head) >= RECORD_HEAD.size else (0, 0)
        end = offset + RECORD_HEAD.size + length
        if (opcode == MESSAGE_INDEX and end <= size and len(head) == _INDEX_HEAD
                and int.from_bytes(head[-4:], "little") + 6 == length):     # its two lengths agree
            offset = end                    # most records are of this kind
            continue
        if not head:
            yield Damage(offset, "the file ends in mid-run: it was not closed")
            return
        if opcode == DATA_END and length == 4:
            tail = read_at(file, size - len(MAGIC) - 20 - len(_FOOTER), len(_FOOTER) + 20 + len(MAGIC))
            closed = tail.startswith(_FOOTER) and tail.endswith(MAGIC)
            yield Whole() if closed else Damage(offset, "the index at the end is cut or damaged")
            return
        if opcode == CHUNK and (chunk := chunk_head(file, offset, size)):
            found = contents(file, offset, chunk, zstd)
            if isinstance(found, Contents):
                total += len(found.data)
                if total > TOTAL_LIMIT:
                    yield Damage(offset, f"more than {TOTAL_LIMIT >> 30} GiB of contents: the rest is not read")
                    return
            yield found
        elif opcode == HEADER and end <= size and length < 4096:
            body = read_at(file, offset + RECORD_HEAD.size, length)     # n:4 profile  n:4 library
            start = 4 + int.from_bytes(body[:4], "little")
            name = body[start + 4:start + 4 + int.from_bytes(body[start:start + 4], "little")]
            yield Library(name.decode("utf-8", "replace"))
        elif end <= size and _is_added(file, opcode, offset + RECORD_HEAD.size, end):
            offset = end
            continue
        else:
            found_at = _next_chunk(file, offset + 1, size)
            cut = found_at is None and (len(head) < RECORD_HEAD.size or (opcode in KNOWN and end > size))
            text = "the file ends in the middle of a record: it was not closed" if cut else "not a record"
            yield Damage(offset, text + ("" if found_at is None or cut else f": {found_at - offset} bytes skipped"))
            if found_at is None:
                return
            end = found_at
        offset = end


def _is_added(file: BinaryIO, opcode: int, start: int, end: int) -> bool:
    """Return whether an attachment or metadata of another tool fills ``start`` to ``end``, by the lengths in it.

    ::

        09  log time:8  creation time:8  n:4 name  n:4 media type  n:8 data  CRC:4
        0C  n:4 name  n:4 pairs of (n:4 key  n:4 value)
    """
    fields = {ATTACHMENT: ((16, 0), (0, 4), (0, 4), (0, 8), (4, 0)), METADATA: ((0, 4), (0, 4))}.get(opcode, ())
    for fixed, size in fields:
        start += fixed + size + int.from_bytes(read_at(file, start + fixed, size), "little")
        if start > end:
            return False
    return bool(fields) and start == end


def _next_chunk(file: BinaryIO, offset: int, size: int) -> int | None:
    """Return the start of the next consistent chunk; None if there is none."""
    before = RECORD_HEAD.size + CHUNK_HEAD.size - 4           # bytes from the chunk's start to the compression's name
    while offset < size:
        block = read_at(file, offset, _STEP + before + 8)  # blocks overlap by the size of a chunk's head
        for match in _NAMES.finditer(block, before):
            if chunk_head(file, offset + match.start() - before, size):
                return offset + match.start() - before
        offset += _STEP
    return None
