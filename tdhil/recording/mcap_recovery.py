"""Walks through an MCAP file that may be whole, cut, damaged or hostile, and gives what can be trusted.

::

    magic  { 06 length:8  Chunk   { 07 length:8  MessageIndex } … } …  0F DataEnd  summary  02 Footer  magic

Only what stands in chunks counts, since only that has a CRC; indexes and summary are stepped over. Where the
records make no sense any more, the next chunk is looked for by the name of its compression and its consistent
lengths. Nothing is decompressed beyond the limit of a chunk (`inflate`), nor in sum beyond `TOTAL_LIMIT`.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from struct import Struct
from typing import BinaryIO, Final

from tdhil.record.inflate import CHUNK, CHUNK_HEAD, Contents, Damage, chunk_head, contents, read_at
from tdhil.recording.mcap_container import MAGIC

TOTAL_LIMIT: Final = 4 * 2**30
HEADER, MESSAGE_INDEX, DATA_END = 0x01, 0x07, 0x0F
_KNOWN: Final = frozenset(range(0x01, 0x10))
_RECORD: Final = Struct("<BQ")
_NAMES: Final = re.compile(rb"\x04\0\0\0zstd|\x03\0\0\0lz4")
_FOOTER: Final = _RECORD.pack(0x02, 20)
_STEP: Final = 2**20


@dataclass(frozen=True)
class Library:
    """Who wrote the file, by its own words."""

    name: str


class Whole:
    """The last thing from a file that was closed as it should be."""


Found = Contents | Damage | Library | Whole


def walk(file: BinaryIO, size: int) -> Iterator[Found]:
    """The contents of every good chunk, and what was met on the way.

    ``size`` is the length of the file. The magic at its start is the caller's to check.
    """
    offset, total = len(MAGIC), 0
    while True:
        head = read_at(file, offset, _RECORD.size)
        opcode, length = _RECORD.unpack(head) if len(head) == _RECORD.size else (0, 0)
        end = offset + _RECORD.size + length
        if not head:
            yield Damage(offset, "the file ends in mid-run: it was not closed")
            return
        if opcode == DATA_END and length == 4:
            yield Whole() if _is_closed(file, size) else Damage(offset, "the index at the end is cut or damaged")
            return
        if opcode == CHUNK and (chunk := chunk_head(file, offset, size)):
            found = contents(file, offset, chunk)
            if isinstance(found, Contents):
                total += len(found.data)
                if total > TOTAL_LIMIT:
                    yield Damage(offset, f"more than {TOTAL_LIMIT >> 30} GiB of contents: the rest is not read")
                    return
            yield found
        elif opcode == HEADER and end <= size and length < 4096:
            yield Library(_library(read_at(file, offset + _RECORD.size, length)))
        elif opcode != MESSAGE_INDEX or not _is_index(file, offset, length, size):
            found_at = _next_chunk(file, offset + 1, size)
            cut = found_at is None and (len(head) < _RECORD.size or (opcode in _KNOWN and end > size))
            text = "the file ends in the middle of a record: it was not closed" if cut else "not a record"
            yield Damage(offset, text + ("" if found_at is None or cut else f": {found_at - offset} bytes skipped"))
            if found_at is None:
                return
            end = found_at
        offset = end


def _is_index(file: BinaryIO, offset: int, length: int, size: int) -> bool:
    """Is this a message index whose two lengths agree?"""
    start = offset + _RECORD.size
    head = read_at(file, start, 6)
    return len(head) == 6 and int.from_bytes(head[2:], "little") + 6 == length and start + length <= size


def _next_chunk(file: BinaryIO, offset: int, size: int) -> int | None:
    """Where the next chunk begins that agrees with itself; None if there is none."""
    before = _RECORD.size + CHUNK_HEAD.size - 4           # from the chunk's first byte to its compression's name
    while offset < size:
        block = read_at(file, offset, _STEP + before + 8)  # blocks overlap by what a chunk's head takes
        for match in _NAMES.finditer(block, before):
            if chunk_head(file, offset + match.start() - before, size):
                return offset + match.start() - before
        offset += _STEP
    return None


def _is_closed(file: BinaryIO, size: int) -> bool:
    tail = read_at(file, size - len(MAGIC) - 20 - len(_FOOTER), len(_FOOTER) + 20 + len(MAGIC))
    return tail.startswith(_FOOTER) and tail.endswith(MAGIC)


def _library(body: bytes) -> str:
    """``n:4 profile  n:4 library``."""
    start = 4 + int.from_bytes(body[:4], "little")
    length = int.from_bytes(body[start:start + 4], "little")
    return body[start + 4:start + 4 + length].decode("utf-8", "replace")
