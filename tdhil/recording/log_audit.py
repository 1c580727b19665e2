"""Audit of a log that is passed on: every record of the file, and every text in it.

Reading skips records that tdhil does not know. For a file that others receive, such a record must be seen.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import zstandard

from tdhil.errors import LogBroken
from tdhil.file_kind import MAGIC
from tdhil.recording.log_format import CHANNELS, CLASSES, RAW_FRAMES, SAMPLE
from tdhil.recording.log_reader import Ours, messages
from tdhil.recording.mcap_records import (
    ATTACHMENT,
    CHANNEL,
    CHUNK,
    CHUNK_INDEX,
    DATA_END,
    FOOTER,
    HEADER,
    MESSAGE,
    MESSAGE_INDEX,
    METADATA,
    RECORD_HEAD,
    SCHEMA,
    STATISTICS,
    SUMMARY_OFFSET,
)
from tdhil.recording.mcap_recovery import CHUNK_LIMIT, Contents, chunk_head, contents, read_at

_PLAIN: Final = frozenset({
    HEADER, FOOTER, SCHEMA, CHANNEL, CHUNK, MESSAGE_INDEX, CHUNK_INDEX, STATISTICS, SUMMARY_OFFSET, DATA_END})
"""Records of a finished log: header, footer, declarations, chunks, indexes, statistics. An attachment, metadata
or a message outside a chunk is none of them."""
_FOREIGN: Final = {ATTACHMENT: "an attachment", METADATA: "metadata"}
_WITH_TEXT: Final = frozenset({HEADER, SCHEMA, CHANNEL})
"""Records with texts."""


@dataclass(frozen=True)
class LogAudit:
    """Content of a file beside the messages of tdhil. ``foreign``: unknown records, one line each; ``declarations``:
    bodies of the records that have texts.
    """

    foreign: tuple[str, ...]
    declarations: tuple[bytes, ...]


def audit_log(path: Path) -> LogAudit:
    """Read every record of a finished log. Raises LogBroken for a file whose records do not fill it."""
    foreign: dict[str, None] = {}
    declarations: dict[bytes, None] = {}
    counted = 0
    with path.open("rb") as file:
        size = file.seek(0, 2)
        offset, opcode = len(MAGIC), 0
        while opcode != FOOTER:
            head = read_at(file, offset, RECORD_HEAD.size)
            if len(head) < RECORD_HEAD.size:
                raise LogBroken("its records do not fill the file", where=path.name)
            opcode, length = RECORD_HEAD.unpack(head)
            if opcode not in _PLAIN:
                foreign[_FOREIGN.get(opcode, f"record {opcode:02X}h")] = None
            elif opcode in _WITH_TEXT:
                declarations[read_at(file, offset + RECORD_HEAD.size, length)] = None
            elif opcode == CHUNK:
                counted += _chunk(file, offset, size, foreign, declarations)
            offset += RECORD_HEAD.size + length
        if offset + len(MAGIC) != size:
            foreign["bytes behind the end"] = None
    if counted != sum(isinstance(one, Ours) for one in messages(path)):
        foreign["messages on other topics"] = None
    return LogAudit(tuple(foreign), tuple(declarations))


def _chunk(file: Any, offset: int, size: int, foreign: dict[str, None], declarations: dict[bytes, None]) -> int:
    """Take the records of one chunk. Return the number of its messages."""
    head = chunk_head(file, offset, size)
    found = None if head is None else contents(file, offset, head, zstandard.ZstdDecompressor(
        max_window_size=CHUNK_LIMIT))
    if not isinstance(found, Contents):
        raise LogBroken("a chunk is damaged", where=Path(file.name).name)
    count, at, data = 0, 0, found.data
    while at < len(data):
        opcode, length = RECORD_HEAD.unpack_from(data, at)
        body = data[at + RECORD_HEAD.size:at + RECORD_HEAD.size + length]
        at += RECORD_HEAD.size + length
        if opcode == MESSAGE:
            count += 1
        elif opcode in _WITH_TEXT:
            declarations[body] = None
        else:
            foreign[f"record {opcode:02X}h in a chunk"] = None
    return count


def messages_of(path: Path) -> Iterator[tuple[int, bytes]]:
    """Yield channel and payload of each message of tdhil, in their order."""
    return ((one.number, one.payload) for one in messages(path) if isinstance(one, Ours))


def texts_of_message(channel: int, payload: bytes) -> Iterator[str]:
    """Yield every text of a message, at all levels; a JSON text as its keys and its values."""
    if channel == SAMPLE or channel in RAW_FRAMES:
        return
    name = CHANNELS[channel][1]
    for text in _texts(CLASSES[name].FromString(payload)):
        waiting: list[Any] = [text]
        if name == "Text":
            with suppress(ValueError):
                waiting = [json.loads(text)]
        while waiting:
            one = waiting.pop()
            if isinstance(one, str):
                yield one
            elif isinstance(one, dict):
                yield from one
                waiting += one.values()
            elif isinstance(one, list):
                waiting += one


def _texts(message: Any) -> Iterator[str]:
    for field, value in message.ListFields():
        for one in value if hasattr(value, "append") or hasattr(value, "add") else (value,):
            if field.message_type is not None:
                yield from _texts(one)
            elif field.type == field.TYPE_STRING:
                yield one
