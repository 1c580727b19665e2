"""Writer of the MCAP container: records to chunks to the file.

The writer of the mcap package takes some 7 µs a message and cannot withdraw a chunk that the disk refused. Its record
classes are used for everything that is written once a chunk or less often. A message in its chunk:

::

    05  length:8  channel:2  sequence:4  log time:8  publish time:8  payload          (little-endian)

Schemas and channels are in the first chunk, where the CRC covers them. Each chunk is written in one piece with its
indexes, so a killed process leaves complete chunks and at most one cut chunk.
"""

import errno
import os
import stat
import sys
from contextlib import suppress
from struct import Struct
from typing import Any, Final, Protocol
from zlib import crc32

import zstandard
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, DataEnd, Footer, Header, Schema, Statistics, SummaryOffset

from tdhil.file_kind import MAGIC
from tdhil.recording.log_format import CHANNELS, CLASSES, PACKAGE, schema_name
from tdhil.version import __version__

LIBRARY: Final = f"{PACKAGE} {__version__}"
_MESSAGE: Final = Struct("<BQHIQQ")
_INDEX: Final = Struct("<BQHI")
_FOOTER_HEAD: Final = Struct("<BQQQ")
_TAIL: Final = 16
"""Bytes compared with the last write: a time and an offset of the last index, which are never all zero."""


class RawFile(Protocol):
    """Interface of the file; an unbuffered binary file fits."""

    def write(self, data: memoryview, /) -> int | None: ...

    def seek(self, offset: int, /) -> int: ...

    def truncate(self) -> int: ...

    def fileno(self) -> int: ...

    def close(self) -> None: ...


class LogGone(OSError):
    """Another program removed or truncated the file during writing."""


class Container:
    """One file during writing. Every method except `add` may raise OSError; the file then ends with its last chunk.

    Each write first checks that the file still exists: a write to a removed or truncated file gives no error.
    ``level``: of the compression; 1 keeps pace with a run.
    """

    def __init__(self, file: RawFile, level: int = 1) -> None:
        self._file = file
        self._offset = 0
        self._tail = b""                                # last bytes written
        self._seam: tuple[int, bytes] = (0, b"")        # their position, and the bytes before them
        try:        # pipes, devices and some file systems have no count of names
            found = os.fstat(file.fileno())
            self._watched = stat.S_ISREG(found.st_mode) and found.st_nlink > 0
        except (OSError, ValueError):
            self._watched = False
        self._compress = zstandard.ZstdCompressor(level=level).compress
        self._parts: list[bytes] = []
        self._size = 0
        self._index: dict[int, list[int]] = {}          # by channel: log time, offset, log time, offset,
        self._chunks: list[ChunkIndex] = []
        self._counts: dict[int, int] = dict.fromkeys(CHANNELS, 0)
        self._declarations = _declarations()
        self._put(MAGIC + _record(Header(profile="", library=LIBRARY)))

    @property
    def size(self) -> int:
        """Bytes of messages in the open chunk."""
        return self._size

    def add(self, channel: int, log_time_ns: int, payload: bytes) -> None:
        """Put a message into the open chunk."""
        if not self._parts and not self._chunks:
            first = b"".join(record for group in self._declarations for record in group)
            self._parts.append(first)
            self._size = len(first)
        self._index.setdefault(channel, []).extend((log_time_ns, self._size))
        length = len(payload)
        self._parts.append(_MESSAGE.pack(Opcode.MESSAGE, 22 + length, channel, 0, log_time_ns, log_time_ns))
        self._parts.append(payload)
        self._size += 31 + length

    def close_chunk(self) -> None:
        """Compress the open chunk, if it is not empty, and pass it to the operating system."""
        if not self._parts:
            return
        raw, index = b"".join(self._parts), self._index
        self._parts, self._size, self._index = [], 0, {}
        times = [time for pairs in index.values() for time in pairs[::2]]
        data = self._compress(raw)
        chunk = _record(Chunk(
            compression="zstd", data=data, message_start_time=min(times), message_end_time=max(times),
            uncompressed_crc=crc32(raw), uncompressed_size=len(raw)))
        parts, offsets, end = [chunk], {}, self._offset + len(chunk)
        for channel, pairs in index.items():
            offsets[channel] = end
            parts.append(_INDEX.pack(Opcode.MESSAGE_INDEX, 6 + 8 * len(pairs), channel, 8 * len(pairs)))
            parts.append(Struct(f"<{len(pairs)}Q").pack(*pairs))
            end += _INDEX.size + 8 * len(pairs)
        start = self._offset
        self._put(b"".join(parts))
        for channel, pairs in index.items():
            self._counts[channel] += len(pairs) // 2
        self._chunks.append(ChunkIndex(
            chunk_length=len(chunk), chunk_start_offset=start, compression="zstd", compressed_size=len(data),
            message_start_time=min(times), message_end_time=max(times), message_index_offsets=offsets,
            message_index_length=end - start - len(chunk), uncompressed_size=len(raw)))

    def finish(self) -> None:
        """Write the summary; the file is then a complete MCAP. An open chunk is not part of it."""
        end = _record(DataEnd(0))
        start = self._offset + len(end)
        schemas, channels = self._declarations
        statistics = Statistics(
            attachment_count=0, metadata_count=0, channel_count=len(CHANNELS), schema_count=len(CHANNELS),
            chunk_count=len(self._chunks), message_count=sum(self._counts.values()),
            channel_message_counts={channel: count for channel, count in self._counts.items() if count},
            message_start_time=min((chunk.message_start_time for chunk in self._chunks), default=0),
            message_end_time=max((chunk.message_end_time for chunk in self._chunks), default=0))
        groups: list[tuple[Opcode, list[bytes]]] = [
            (Opcode.SCHEMA, schemas),
            (Opcode.CHANNEL, channels),
            (Opcode.STATISTICS, [_record(statistics)]),
            (Opcode.CHUNK_INDEX, [_record(chunk) for chunk in self._chunks]),
        ]
        summary, pointers = b"", b""
        for opcode, records in groups:
            group = b"".join(records)
            pointers += _record(SummaryOffset(opcode, start + len(summary), len(group)))
            summary += group
        crc = crc32(summary + pointers + _FOOTER_HEAD.pack(Opcode.FOOTER, 20, start, start + len(summary)))
        footer = _record(Footer(summary_start=start, summary_offset_start=start + len(summary), summary_crc=crc))
        self._put(end + summary + pointers + footer + MAGIC)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _put(self, data: bytes) -> None:
        """Write all of ``data``, or restore the file and raise OSError; LogGone if the file is gone."""
        if self._watched:
            self._require_whole()
        left = memoryview(data)
        try:
            while left:
                written = self._file.write(left)
                if not written:
                    raise OSError("nothing was written")
                left = left[written:]
        except OSError:
            with suppress(OSError):                # the first cause is the one to report
                self._file.seek(self._offset)
                self._file.truncate()
            raise
        self._seam = (self._offset - len(self._tail), self._tail)
        self._tail = data[-_TAIL:]
        self._offset += len(data)

    def _require_whole(self) -> None:
        found = os.fstat(self._file.fileno())
        if not found.st_nlink:
            raise LogGone(errno.ENOENT, "the file was removed while it was being written")
        if found.st_size < self._offset:
            raise LogGone(
                errno.EIO, f"the file was cut to {found.st_size} of {self._offset} bytes while it was being written"
            )
        # If the file was truncated between check and write, the write made it long again, with a hole before it.
        start, before = self._seam
        if sys.platform == "win32":    # no pread; on Windows no other program can truncate an open file
            return
        try:
            stands = os.pread(self._file.fileno(), len(before), start)
        except OSError:                # also a file that cannot be read: nothing to compare
            return
        if stands != before:
            raise LogGone(
                errno.EIO,
                f"the file was cut to less than {start + len(before)} of {self._offset} bytes"
                " while it was being written",
            )


def _declarations() -> tuple[list[bytes], list[bytes]]:
    """Return the schema and channel records; a channel and its schema have the same number."""
    schemas, channels = [], []
    for number, (topic, message) in CHANNELS.items():
        schemas.append(_record(
            Schema(id=number, name=schema_name(message), encoding="protobuf", data=schema_of(message))))
        channels.append(_record(
            Channel(id=number, topic=topic, message_encoding="protobuf", schema_id=number, metadata={})))
    return schemas, channels


def schema_of(message: str) -> bytes:
    """Return the schema of a message for the log: a FileDescriptorSet of protobuf."""
    described, files = CLASSES[message].DESCRIPTOR.file, FileDescriptorSet()
    for file in (*described.dependencies, described):
        file.CopyToProto(files.file.add())
    return files.SerializeToString(deterministic=True)


def _record(record: Any) -> bytes:
    builder: Any = RecordBuilder()
    record.write(builder)
    data: bytes = builder.end()
    return data
