"""Reading of run.mcap as a Recording, from a file that may be complete, cut, damaged or hostile."""

import json
import math
from array import array
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from google.protobuf.message import DecodeError

from drivers import Command, PowerState, RawFrame, Sample
from tdhil.errors import LogError
from tdhil.file_kind import MAGIC
from tdhil.recording import log_format, log_messages
from tdhil.recording.builder import FACTS, RecordingBuilder, structure
from tdhil.recording.chunk_table import NO_COMMAND, ChunkTable, TorqueCommand
from tdhil.recording.log_format import CHANNELS, CLASSES, MODE_OF, PACKAGE, RECOVERED, STATE_OF, Event, schema_name
from tdhil.recording.log_messages import TEXT_LIMIT
from tdhil.recording.mcap_records import CHANNEL, MESSAGE, MESSAGE_HEAD, RECORD_HEAD, SCHEMA
from tdhil.recording.mcap_recovery import Contents, Damage, Library, Whole, walk
from tdhil.recording.recording import Excitation, FloatArray, Level, Ramp, Recording, Stage

# ---------------------------------------------------------------------------------------------------------------------
# Records inside a chunk with a valid CRC. Pure; the bytes may still be hostile.


_LONGEST = 128                         # characters of a name; those of tdhil are shorter


class Schema(NamedTuple):
    """Schema record, ``identifier:2  n:4 name  …``; its fields are not read, because they are known."""

    identifier: int
    name: str


class Channel(NamedTuple):
    """Channel record, ``identifier:2  schema:2  n:4 topic  …``."""

    identifier: int
    schema: int
    topic: str


class Message(NamedTuple):
    """Message record, ``channel:2  sequence:4  log time:8  publish time:8  payload``."""

    channel: int
    log_time_ns: int
    payload: bytes


def records(chunk: bytes) -> Iterator[Schema | Channel | Message]:
    """Yield the records in order; other kinds are skipped. Raises ValueError for a record that exceeds the chunk."""
    offset, size = 0, len(chunk)
    while offset < size:
        if offset + RECORD_HEAD.size > size:
            raise ValueError("a record is cut")
        opcode, length = RECORD_HEAD.unpack_from(chunk, offset)
        start = offset + RECORD_HEAD.size
        offset = start + length
        if offset > size:
            raise ValueError("a record is longer than its chunk")
        if opcode == MESSAGE:
            if length < MESSAGE_HEAD.size:
                raise ValueError("a message is too short")
            channel, _, log_time_ns, _ = MESSAGE_HEAD.unpack_from(chunk, start)
            yield Message(channel, log_time_ns, chunk[start + MESSAGE_HEAD.size:offset])
        elif opcode == SCHEMA:
            yield Schema(_number(chunk, start), _string(chunk, start + 2, offset))
        elif opcode == CHANNEL:
            yield Channel(_number(chunk, start), _number(chunk, start + 2), _string(chunk, start + 4, offset))


def _number(chunk: bytes, start: int) -> int:
    return int.from_bytes(chunk[start:start + 2], "little")


def _string(chunk: bytes, start: int, end: int) -> str:
    length = min(_LONGEST, int.from_bytes(chunk[start:start + 4], "little"))
    return chunk[start + 4:min(end, start + 4 + length)].decode("utf-8", "replace")


# ---------------------------------------------------------------------------------------------------------------------
# Messages of tdhil's channels in any file.


_NUMBER: Final = {(topic, schema_name(message)): number for number, (topic, message) in CHANNELS.items()}
_OTHER: Final = "Give a run.mcap of this tool"
_BUFFER: Final = 2**17                 # bytes; reading consists mostly of small sequential reads


class Ours(NamedTuple):
    """One message on one of tdhil's channels, not decoded yet; ``number`` is the channel's in `CHANNELS`."""

    number: int
    payload: bytes
    log_time_ns: int


def messages(path: Path, *, salvage: bool = False) -> Iterator[Ours | Damage | Whole]:
    """Yield tdhil's messages, damaged places, and at the end `Whole` if the file was closed.

    Raises `LogError` for a file that cannot be opened, is empty, is not MCAP, or (at the end) has no message of tdhil.
    ``salvage``: a file that does not begin like MCAP is searched too, because its head may be damaged.
    """
    declared = _Declared()
    for found in _batches(path, declared, salvage, 0):
        if isinstance(found, list):
            for contents in found:
                yield from declared.messages(contents)
        else:
            yield found


def _batches(
    path: Path, declared: "_Declared", salvage: bool, size_limit: int
) -> Iterator[list[Contents] | Damage | Whole]:
    """Yield the good chunks in batches of up to ``size_limit`` bytes, and the damaged places; the caller decodes the
    chunks.

    A damaged place or a header between chunks changes ``declared`` only after the earlier chunks were used.
    """
    batch: list[Contents] = []
    waiting = 0
    try:
        with path.open("rb", buffering=_BUFFER) as file:
            size = file.seek(0, 2)
            file.seek(0)
            if size == 0:
                raise LogError("the file is empty", where=str(path), next_step="The run has to be done again")
            if file.read(len(MAGIC)) != MAGIC[:size]:
                if not salvage:
                    raise LogError("this is not an MCAP file", where=str(path), next_step=_OTHER)
                yield Damage(0, "the file does not begin like MCAP")
                declared.assume()
            for found in walk(file, size):
                if isinstance(found, Contents):
                    batch.append(found)
                    waiting += len(found.data)
                    if waiting <= size_limit:
                        continue
                if batch:
                    yield batch
                    batch, waiting = [], 0
                if isinstance(found, Library):
                    declared.library(found.name)
                elif not isinstance(found, Contents):
                    if salvage and isinstance(found, Damage):
                        declared.assume_undeclared()       # the damaged part may have declared the channels
                    yield found
    except OSError as error:
        raise LogError(f"the log can't be read: {error.strerror or error}", where=str(path),
                       next_step="Check the path") from error
    if batch:
        yield batch
    if not declared.ours:
        what = "nothing of a run of this tool is in it" if salvage else "an MCAP file, but not a run of this tool"
        raise LogError(what, where=str(path), next_step=_OTHER)


class _Declared:
    """Assignment of the file's channels to those of tdhil, by topic and schema."""

    def __init__(self) -> None:
        self.ours = False
        self._schemas: dict[int, str] = {}
        self._numbers: dict[int, int] = {}

    def library(self, name: str) -> None:
        """Use tdhil's channel numbers for a file of tdhil, even if the chunk with the declarations is lost."""
        if name.split(" ", maxsplit=1)[0] == PACKAGE:
            self.ours = True
            self._numbers = {number: number for number in CHANNELS} | self._numbers

    def assume(self) -> None:
        """Use tdhil's channel numbers if the writer is unknown; chunks that do not fit show an error themselves."""
        self._numbers = {number: number for number in CHANNELS}

    def assume_undeclared(self) -> None:
        """Use tdhil's channel numbers if none were declared so far."""
        if not self._schemas:
            self._numbers = {number: number for number in CHANNELS} | self._numbers

    @property
    def numbers(self) -> Mapping[int, int]:
        """Number of tdhil's channel by the number in the file, so far."""
        return self._numbers

    def messages(self, contents: Contents) -> Iterator[Ours | Damage]:
        numbers = self._numbers
        try:
            for record in records(contents.data):
                if isinstance(record, Message):
                    if record.channel in numbers:
                        self.ours = True
                        yield Ours(numbers[record.channel], record.payload, record.log_time_ns)
                elif isinstance(record, Schema):
                    self._schemas[record.identifier] = record.name
                else:
                    self._channel(record)
        except ValueError as error:
            yield Damage(contents.offset, f"a chunk is malformed: {error}")

    def _channel(self, record: Channel) -> None:
        number = _NUMBER.get((record.topic, self._schemas.get(record.schema, "")))
        self._numbers.pop(record.identifier, None)
        if number is not None:
            self.ours = True
            self._numbers[record.identifier] = number


# ---------------------------------------------------------------------------------------------------------------------

SAMPLES: Final = 8_000_000             # samples of 41 bytes each, 57 with a position; two hours at 1 kHz
_CENTURY_NS: Final = 946_684_800 * 10**9       # 2000-01-01
RARE: Final = 20_000                   # most stages, events and problems
RARE_BYTES: Final = 64 * 2**20         # bytes of everything except samples, commands and frames
BATCH: Final = 2 * 2**20               # bytes of chunks read at once; a longer chunk is read message by message
_UNREAD: Final = frozenset({log_format.FRF, log_format.LIVE_INERTIA, log_format.LOG}) | log_format.RAW_FRAMES
_EVERY_CYCLE: Final = frozenset({log_format.SAMPLE, log_format.COMMAND})


@dataclass(frozen=True)
class LoggedRun:
    """Run as read from the log. ``complete`` is False if the file was not closed or a part of it is lost.

    ``problems``: damaged places, one line each. ``result``: None if the run has none. ``epoch_ns``: wall clock at
    control time zero, 0 if unknown. ``virtual_string``: a row a cycle, with the columns of
    `log_format.VIRTUAL_COLUMNS`.
    """

    recording: Recording
    configuration: dict[str, Any]
    result: dict[str, Any] | None
    events: tuple[Event, ...]
    stages: tuple[Stage, ...]
    complete: bool
    problems: tuple[str, ...]
    epoch_ns: int = 0
    virtual_string: FloatArray = field(default_factory=lambda: np.empty((0, len(log_format.VIRTUAL_COLUMNS))))


def read_run(path: Path, *, salvage: bool = False, batch: int = BATCH) -> LoggedRun:
    """Return everything except the raw frames and the speed setpoints. Raises `LogError` without a message of tdhil.

    ``salvage``: also read a file with a damaged head. ``batch``: bytes of chunks read at once; 0 means message by
    message, which gives the same result bit for bit and takes five times as long.
    """
    return _Reading(batch).run(path, salvage)


def read_samples(path: Path) -> Iterator[Sample]:
    """Yield the samples of the log, without damaged stretches. Raises `LogError` like `read_run`."""
    for _, message in _messages(path, log_format.SAMPLE):
        yield _sample_of(message)


def read_frames(path: Path) -> Iterator[RawFrame]:
    """Yield the raw frames of the bus, without damaged stretches. Raises `LogError` like `read_run`.

    On Modbus they are requests and replies, with the unit as identifier.
    """
    for _, message in _messages(path, *log_format.RAW_FRAMES):
        for frame in message.frames:
            yield RawFrame(frame.time_s, frame.outgoing, frame.identifier, frame.data)


def read_cycles(path: Path) -> Iterator[tuple[Command | None, Sample]]:
    """Yield every sample with the command before it, None before the first command. Raises `LogError` like
    `read_run`.
    """
    command: Command | None = None
    for number, message in _messages(path, log_format.COMMAND, log_format.SAMPLE):
        if number == log_format.SAMPLE:
            yield command, _sample_of(message)
        elif (mode := MODE_OF.get(message.mode)) is not None:
            command = Command(mode, message.speed_rad_s, message.torque_nm, message.torque_offset_nm)


def _sample_of(message: Any) -> Sample:
    demand_nm = message.torque_demand_nm if message.HasField("torque_demand_nm") else None
    return Sample(
        message.time_s, message.age_s, message.half_width_s, message.fresh, message.speed_rad_s,
        message.torque_nm, demand_nm, MODE_OF.get(message.mode), STATE_OF.get(message.state, PowerState.UNKNOWN),
        message.standstill, message.limit_active, message.status,
        message.position_rad if message.HasField("position_rad") else None)


def _messages(path: Path, *wanted: int) -> Iterator[tuple[int, Any]]:
    for found in messages(path):
        if isinstance(found, Ours) and found.number in wanted:
            with suppress(DecodeError):
                yield found.number, CLASSES[CHANNELS[found.number][1]].FromString(found.payload)


class _Reading:
    """One reading of one file; ``batch``: bytes of chunks read at once, 0 for message by message."""

    def __init__(self, batch: int) -> None:
        self._batch = batch
        self._builder = RecordingBuilder()
        self._texts: dict[int, dict[str, Any]] = {}
        self._events: list[Event] = []
        self._virtual = array("d")
        self._command = NO_COMMAND
        self._stages: list[Stage] = []
        self._problems: list[str] = []
        self._budget = RARE_BYTES
        self._whole = False
        self._lost = False
        self._epoch_ns: int | None = None
        self._take: dict[int, Callable[[Any], None]] = {
            log_format.SAMPLE: self._sample,
            log_format.COMMAND: self._torque_command,
            log_format.STAGE: self._stage,
            log_format.EXCITATION: self._excitation,
            log_format.EVENT: self._event,
            log_format.VIRTUAL_STRING: self._virtual_row,
        }

    def run(self, path: Path, salvage: bool) -> LoggedRun:
        declared = _Declared()
        for found in _batches(path, declared, salvage, self._batch):
            if isinstance(found, list):
                if not self._chunks(found, declared):
                    self._problem(f"more than {SAMPLES} samples: the rest is not read")
                    break
            elif isinstance(found, Damage):
                self._problem(str(found))
            else:
                self._whole = True
        self._learn()
        run = self._texts.get(log_format.CONFIGURATION, {}).get("run")
        complete = self._whole and not self._lost
        return LoggedRun(
            recording=self._builder.recording(complete=complete),
            configuration=run if isinstance(run, dict) else {},
            result=self._texts.get(log_format.RESULT),
            events=tuple(self._events),
            stages=tuple(self._stages),
            complete=complete,
            problems=tuple(self._problems),
            epoch_ns=self._epoch_ns or 0,
            virtual_string=np.array(self._virtual).reshape(-1, len(log_format.VIRTUAL_COLUMNS)),
        )

    def _chunks(self, batch: list[Contents], declared: _Declared) -> bool:
        """Read the content of a batch, by numpy if it has the layout of tdhil's writer. Returns False to end the
        reading.
        """
        if not self._batch or any(len(one.data) > self._batch for one in batch):
            return all(self._one_by_one(one, declared) for one in batch)
        table = ChunkTable([one.data for one in batch])
        first = 0
        while first < len(batch):
            last = first
            while last < len(batch) and table.plain[last]:
                last += 1
            if last == first or not self._block(table, first, last, declared):
                last = max(last, first + 1)
                if not all(self._one_by_one(one, declared) for one in batch[first:last]):
                    return False
            first = last
        return True

    def _block(self, table: ChunkTable, first: int, last: int, declared: _Declared) -> bool:
        """Read chunks without declarations by numpy. Returns False if nothing was read; they must be read one by
        one.
        """
        taken = table.messages(
            first, last, declared.numbers, log_format.SAMPLE, log_format.COMMAND, _UNREAD, self._command)
        if taken is None:
            return False
        samples, command, others, ours = taken
        if samples is not None:
            if len(self._builder) + len(samples.values) >= SAMPLES:
                return False
            self._builder.add_block(
                samples.values, samples.fresh, samples.limited, samples.setpoints, samples.positions_at,
                samples.position_rad,
            )
            if self._epoch_ns is None:
                self._epoch_ns = self._epoch_of(samples.first_log_time_ns)
        self._command = command
        declared.ours = declared.ours or ours
        for one in others:
            self._message(one.number, one.payload)
        return True

    def _one_by_one(self, contents: Contents, declared: _Declared) -> bool:
        """Read one chunk with any content, message by message. Returns False to end the reading."""
        for found in declared.messages(contents):
            if isinstance(found, Damage):
                self._problem(str(found))
                continue
            self._message(found.number, found.payload)
            if self._epoch_ns is None and len(self._builder):
                self._epoch_ns = self._epoch_of(found.log_time_ns)
            if len(self._builder) >= SAMPLES:
                return False
        return True

    def _epoch_of(self, log_time_ns: int) -> int:
        """Return the epoch from the first sample; a time before the year 2000 is the zero of a stepped log."""
        time_s = self._builder.first_time_s
        epoch_ns = log_time_ns - round(time_s * 1e9) if abs(time_s) < 1e9 else 0
        return epoch_ns if epoch_ns > _CENTURY_NS else 0

    def _message(self, number: int, payload: bytes) -> None:
        try:
            if number in _UNREAD:
                return
            if number not in _EVERY_CYCLE:
                self._budget -= len(payload)
                if self._budget < 0:
                    raise ValueError(f"more than {RARE_BYTES} bytes of such messages")
            if number in (log_format.CONFIGURATION, log_format.RESULT):
                self._text(number, payload)
            elif number in self._take:
                self._take[number](CLASSES[CHANNELS[number][1]].FromString(payload))
        except (DecodeError, TypeError, ValueError, RecursionError) as error:
            self._problem(f"a message on {CHANNELS[number][0]} can't be read: {error}")

    def _sample(self, message: Any) -> None:
        enabled = message.state == log_messages.ENABLED_STATE
        in_torque = enabled and message.mode == log_messages.TORQUE_MODE and self._command.time_s == message.time_s
        demanded = enabled and message.HasField("torque_demand_nm")
        self._builder.add_values(
            message.time_s, message.speed_rad_s, message.torque_nm, fresh=message.fresh, limited=message.limit_active,
            commanded_nm=self._command.torque_nm if in_torque else math.nan,
            demanded_nm=message.torque_demand_nm if demanded else math.nan,
            position_rad=message.position_rad if message.HasField("position_rad") else None)

    def _torque_command(self, message: Any) -> None:
        in_torque = message.mode == log_messages.TORQUE_MODE
        self._command = TorqueCommand(message.time_s, message.torque_nm if in_torque else math.nan)

    def _virtual_row(self, message: Any) -> None:
        self._virtual.extend(getattr(message, name) for name in log_format.VIRTUAL_COLUMNS)

    def _stage(self, message: Any) -> None:
        if len(self._stages) < RARE:
            stage = structure(Stage, message)
            self._stages.append(stage)
            self._builder.stage(stage)

    def _event(self, message: Any) -> None:
        event = structure(Event, message)
        if event.kind == RECOVERED:
            self._problem(event.text)
        if len(self._events) < RARE:
            self._events.append(event)

    def _excitation(self, message: Any) -> None:
        self._builder.excitation(
            structure(Excitation, message.excitation) if message.HasField("excitation") else None,
            structure(tuple[Level, ...], message.levels),
            structure(tuple[Ramp, ...], message.ramps))

    def _text(self, number: int, payload: bytes) -> None:
        if len(payload) > TEXT_LIMIT:
            raise ValueError(f"{len(payload)} bytes of text (limit {TEXT_LIMIT})")
        content = json.loads(CLASSES["Text"].FromString(payload).json)
        if not isinstance(content, dict):
            raise TypeError("not a JSON object")
        self._texts[number] = content

    def _learn(self) -> None:
        facts = self._texts.get(log_format.CONFIGURATION, {}).get("recording", {})
        try:
            self._builder.learn(**{name: value for name, value in facts.items() if name in FACTS})
        except (TypeError, ValueError, AttributeError) as error:
            self._problem(f"the configuration can't be read: {error}")

    def _problem(self, text: str) -> None:
        self._lost = True
        if len(self._problems) < RARE:
            self._problems.append(text[:200])
