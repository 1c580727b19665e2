"""run.mcap back into a Recording, from a file that may be whole, cut, damaged or hostile."""

import json
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from google.protobuf.message import DecodeError

from drivers.drive import Command, PowerState, RawFrame, Sample
from tdhil.record.event import RECOVERED, Event
from tdhil.record.inflate import Damage
from tdhil.record.messages import Ours, messages
from tdhil.record.plain import structure
from tdhil.recording import log_format
from tdhil.recording.builder import FACTS, RecordingBuilder
from tdhil.recording.log_format import CHANNELS, CLASSES, MODE_OF, STATE_OF
from tdhil.recording.log_messages import TEXT_LIMIT
from tdhil.recording.recording import Excitation, Level, Ramp, Recording, Stage

SAMPLES: Final = 8_000_000             # 25 bytes each; two hours at 1 kHz
_CENTURY_NS: Final = 946_684_800 * 10**9       # 2000-01-01
RARE: Final = 20_000                   # stages, events, problems
RARE_BYTES: Final = 64 * 2**20         # of everything but samples, commands and frames


@dataclass(frozen=True)
class Run:
    """A run as the log has it. ``complete`` is False where the file wasn't closed or some of it is lost.

    ``problems`` says what was stepped over, a line each; ``result`` is None where the run got none. ``epoch_ns`` is the
    wall clock at control time zero, 0 where the log doesn't tell.
    """

    recording: Recording
    configuration: dict[str, Any]
    result: dict[str, Any] | None
    events: tuple[Event, ...]
    stages: tuple[Stage, ...]
    complete: bool
    problems: tuple[str, ...]
    epoch_ns: int = 0


def read_run(path: Path, *, salvage: bool = False) -> Run:
    """Everything but the raw frames and the commands. Raises `LogError` if there is nothing of ours in the file.

    ``salvage``: also where the file's head is damaged.
    """
    return _Reading().run(path, salvage)


def read_samples(path: Path) -> Iterator[Sample]:
    """The samples as they were logged, damaged stretches left out. Raises `LogError` like `read_run`."""
    for _, message in _messages(path, log_format.SAMPLE):
        yield _sample_of(message)


def read_frames(path: Path) -> Iterator[RawFrame]:
    """The raw frames as they stood on the bus, damaged stretches left out. Raises `LogError` like `read_run`.

    Of a Modbus line they are requests and replies, the unit for an identifier.
    """
    for _, message in _messages(path, log_format.CAN, log_format.MODBUS):
        for frame in message.frames:
            yield RawFrame(frame.time_s, frame.outgoing, frame.identifier, frame.data)


def read_cycles(path: Path) -> Iterator[tuple[Command | None, Sample]]:
    """Every sample with the command that it answers, None before the first. Raises `LogError` like `read_run`."""
    command: Command | None = None
    for number, message in _messages(path, log_format.COMMAND, log_format.SAMPLE):
        if number == log_format.SAMPLE:
            yield command, _sample_of(message)
        elif (mode := MODE_OF.get(message.mode)) is not None:
            command = Command(mode, message.speed_rad_s, message.torque_nm)


def _sample_of(message: Any) -> Sample:
    demand_nm = message.torque_demand_nm if message.HasField("torque_demand_nm") else None
    return Sample(
        message.time_s, message.age_s, message.half_width_s, message.fresh, message.speed_rad_s,
        message.torque_nm, demand_nm, MODE_OF.get(message.mode), STATE_OF.get(message.state, PowerState.NOT_READY),
        message.standstill, message.limit_active, message.status)


def _messages(path: Path, *wanted: int) -> Iterator[tuple[int, Any]]:
    for found in messages(path):
        if isinstance(found, Ours) and found.number in wanted:
            with suppress(DecodeError):
                yield found.number, CLASSES[CHANNELS[found.number][1]].FromString(found.payload)


class _Reading:
    """One reading of one file."""

    def __init__(self) -> None:
        self._builder = RecordingBuilder()
        self._texts: dict[int, dict[str, Any]] = {}
        self._events: list[Event] = []
        self._stages: list[Stage] = []
        self._problems: list[str] = []
        self._budget = RARE_BYTES
        self._whole = False
        self._lost = False
        self._epoch_ns: int | None = None
        self._take: dict[int, Callable[[Any], None]] = {
            log_format.SAMPLE: self._sample,
            log_format.STAGE: self._stage,
            log_format.EXCITATION: self._excitation,
            log_format.EVENT: self._event,
        }

    def run(self, path: Path, salvage: bool) -> Run:
        for found in messages(path, salvage=salvage):
            if isinstance(found, Ours):
                self._message(found.number, found.payload)
                if self._epoch_ns is None and len(self._builder):
                    self._epoch_ns = self._epoch_of(found.log_time_ns)
            elif isinstance(found, Damage):
                self._problem(str(found))
            else:
                self._whole = True
            if len(self._builder) >= SAMPLES:
                self._problem(f"more than {SAMPLES} samples: the rest is not read")
                break
        self._learn()
        run = self._texts.get(log_format.CONFIGURATION, {}).get("run")
        complete = self._whole and not self._lost
        return Run(
            recording=self._builder.recording(complete=complete),
            configuration=run if isinstance(run, dict) else {},
            result=self._texts.get(log_format.RESULT),
            events=tuple(self._events),
            stages=tuple(self._stages),
            complete=complete,
            problems=tuple(self._problems),
            epoch_ns=self._epoch_ns or 0,
        )

    def _epoch_of(self, log_time_ns: int) -> int:
        """From the first sample; what lies before this century is the zero of a stepped log."""
        time_s = self._builder.first_time_s
        epoch_ns = log_time_ns - round(time_s * 1e9) if abs(time_s) < 1e9 else 0
        return epoch_ns if epoch_ns > _CENTURY_NS else 0

    def _message(self, number: int, payload: bytes) -> None:
        try:
            if number in (log_format.COMMAND, log_format.CAN, log_format.LOG, log_format.MODBUS):
                return
            if number != log_format.SAMPLE:
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
        self._builder.add_values(
            message.time_s, message.speed_rad_s, message.torque_nm, fresh=message.fresh, limited=message.limit_active)

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
