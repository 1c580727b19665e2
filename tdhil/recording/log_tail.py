"""Reading of a run.mcap that another process still writes: each call returns the data since the last call.

The end of the file may be inside a chunk that is not complete yet; it is left for the next call. Only files of tdhil
are read in this way, because their channels are known.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
import zstandard
from google.protobuf.message import DecodeError

from tdhil.file_kind import MAGIC
from tdhil.recording import log_format
from tdhil.recording.builder import structure
from tdhil.recording.chunk_table import NO_COMMAND, ChunkTable
from tdhil.recording.log_format import CHANNELS, CLASSES, Event, LiveInertia
from tdhil.recording.mcap_records import CHUNK, DATA_END, MESSAGE, MESSAGE_HEAD, RECORD_HEAD
from tdhil.recording.mcap_recovery import CHUNK_LIMIT, Contents, chunk_head, contents, read_at
from tdhil.recording.recording import FloatArray, Stage

_NUMBERS: Final = {number: number for number in CHANNELS}
_SKIPPED: Final = log_format.RAW_FRAMES | {
    log_format.COMMAND, log_format.FRF, log_format.LOG, log_format.VIRTUAL_STRING}
MOST: Final = 2**20
"""Approximate bytes read at a time, so that a viewer that joins a long run late does not delay the others."""


def _nothing() -> FloatArray:
    return np.empty((0, 3))


@dataclass(frozen=True)
class LogNews:
    """New data of a log. ``samples`` (n, 3): control time in s, speed in rad/s, torque in N·m, in order.

    ``configuration`` and ``result``: the latest new ones, or None. ``epoch_ns``: wall clock at control time zero, 0
    without a sample. ``more``: more can be read at once. ``closed``: the log is complete.
    """

    samples: FloatArray = field(default_factory=_nothing)
    events: tuple[Event, ...] = ()
    stages: tuple[Stage, ...] = ()
    inertias: tuple[LiveInertia, ...] = ()
    configuration: dict[str, Any] | None = None
    result: dict[str, Any] | None = None
    epoch_ns: int = 0
    more: bool = False
    closed: bool = False


@dataclass(frozen=True)
class LogChunks:
    """New complete chunks, decompressed. ``more`` and ``closed`` as in LogNews."""

    chunks: tuple[bytes, ...] = ()
    more: bool = False
    closed: bool = False


@dataclass(frozen=True)
class LoggedMessage:
    """Message as in the log: number of its channel, its time (wall clock, ns) and its bytes."""

    number: int
    log_time_ns: int
    payload: bytes


def messages_in(chunk: bytes) -> Iterator[LoggedMessage]:
    """Yield the messages of a chunk in order, without those of other programs' channels."""
    at = 0
    while at + RECORD_HEAD.size <= len(chunk):
        opcode, length = RECORD_HEAD.unpack_from(chunk, at)
        at, end = at + RECORD_HEAD.size, at + RECORD_HEAD.size + length
        if end > len(chunk):
            return
        if opcode == MESSAGE and length >= MESSAGE_HEAD.size:
            number, _, log_time_ns, _ = MESSAGE_HEAD.unpack_from(chunk, at)
            if number in CHANNELS:
                yield LoggedMessage(number, log_time_ns, chunk[at + MESSAGE_HEAD.size:end])
        at = end


class LogTail:
    """Reader of one file. A call without new data takes nearly no time. ``offset``: bytes read so far."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.offset = 0
        self._zstd = zstandard.ZstdDecompressor(max_window_size=CHUNK_LIMIT)
        self.closed = False

    def read(self) -> LogNews:
        """Return the data since the last call; none if the file is missing, or cannot be read now."""
        came = self.read_chunks()
        decoded = [self._decoded(one) for one in came.chunks]
        samples = [one.samples for one in decoded if len(one.samples)]
        return LogNews(
            np.concatenate(samples) if samples else _nothing(),
            tuple(event for one in decoded for event in one.events),
            tuple(stage for one in decoded for stage in one.stages),
            tuple(found for one in decoded for found in one.inertias),
            next((one.configuration for one in reversed(decoded) if one.configuration is not None), None),
            next((one.result for one in reversed(decoded) if one.result is not None), None),
            next((one.epoch_ns for one in decoded if one.epoch_ns), 0),
            more=came.more,
            closed=came.closed,
        )

    def read_chunks(self) -> LogChunks:
        """Return the new complete chunks since the last call."""
        begin, found = self.offset, list[bytes]()
        with suppress(OSError):
            size = self._path.stat().st_size
            if size > self.offset and not self.closed:
                with self._path.open("rb") as file:
                    for content in self._contents(file, size):
                        found.append(content)
                        if self.offset - begin > MOST:
                            break
        return LogChunks(tuple(found), self.offset - begin > MOST, self.closed)

    def _contents(self, file: BinaryIO, size: int) -> Iterator[bytes]:
        """Yield complete chunks and set the offset after each. Damage is skipped if its length is known."""
        if self.offset == 0:
            if size < len(MAGIC):
                return
            self.offset = len(MAGIC)
        while True:
            head = read_at(file, self.offset, RECORD_HEAD.size)
            if len(head) < RECORD_HEAD.size:
                return
            opcode, length = RECORD_HEAD.unpack(head)
            end = self.offset + RECORD_HEAD.size + length
            if opcode == DATA_END and length == 4:
                self.closed = True
                return
            if end > size:
                return
            chunk = chunk_head(file, self.offset, size) if opcode == CHUNK else None
            at, self.offset = self.offset, end
            if chunk is not None and isinstance(inside := contents(file, at, chunk, self._zstd), Contents):
                yield inside.data

    @staticmethod
    def _decoded(chunk: bytes) -> LogNews:
        table = ChunkTable((chunk,))
        found = table.messages(0, 1, _NUMBERS, log_format.SAMPLE, log_format.COMMAND, _SKIPPED, NO_COMMAND)
        if found is None:
            return LogNews()           # samples with another layout are not from tdhil's writer
        block, _, messages, _ = found
        events: list[Event] = []
        stages: list[Stage] = []
        inertias: list[LiveInertia] = []
        texts: dict[int, dict[str, Any]] = {}
        for message in messages:
            with suppress(DecodeError, ValueError, TypeError, KeyError, RecursionError):
                decoded = CLASSES[CHANNELS[message.number][1]].FromString(message.payload)
                if message.number == log_format.EVENT:
                    events.append(structure(Event, decoded))
                elif message.number == log_format.STAGE:
                    stages.append(structure(Stage, decoded))
                elif message.number == log_format.LIVE_INERTIA:
                    inertias.append(structure(LiveInertia, decoded))
                elif message.number in (log_format.CONFIGURATION, log_format.RESULT):
                    plain = json.loads(decoded.json)
                    if isinstance(plain, dict):
                        texts[message.number] = plain
        epoch_ns = 0 if block is None else block.first_log_time_ns - round(float(block.values[0, 0]) * 1e9)
        return LogNews(
            _nothing() if block is None else block.values, tuple(events), tuple(stages), tuple(inertias),
            texts.get(log_format.CONFIGURATION), texts.get(log_format.RESULT), max(0, epoch_ns),
        )
