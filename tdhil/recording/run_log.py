"""Log of a run during the run: data go to the file, and to the Recording for the identification."""

from __future__ import annotations

import math
import traceback
from array import array
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from drivers import Command, FrameTap, Sample, TdhilError
from tdhil.errors import ExitCode, Interrupted, code_of, exit_code
from tdhil.recording.builder import RecordingBuilder, RecordingPart
from tdhil.recording.log_format import FAILURE, INTERRUPTED, VIRTUAL_COLUMNS, Event, LiveInertia
from tdhil.recording.log_writer import RunWriter
from tdhil.recording.recording import Excitation, FloatArray, Level, Ramp, Recording, Stage

# ---------------------------------------------------------------------------------------------------------------------
# Cause that ended a run early: written into its log as typed fields, and read back from it, also from older logs.


@dataclass(frozen=True)
class RunEnd:
    """Cause of an early end. ``kind``: class of the error, such as DriveFault; ``time_s``: control time;
    ``exit_code``: of the run.
    """

    kind: str
    what: str
    where: str
    next_step: str
    exit_code: int
    time_s: float
    code: str = ""      # code in the table of messages; '' in a log of an older version

    @property
    def message(self) -> str:
        """Text of the event, with its place."""
        return f"{self.where}: {self.what}" if self.where else self.what


def ended_by(error: BaseException, time_s: float) -> dict[str, Any]:
    """Return the cause for the log's configuration, under `ended`."""
    what, where, next_step = str(error), "", ""
    if isinstance(error, TdhilError):
        what, where, next_step = error.what, error.where, error.next_step
    return asdict(RunEnd(type(error).__name__, what, where, next_step, int(exit_code(error)), time_s,
                         code_of(error)))


def find_ended(configuration: Mapping[str, Any], events: tuple[Event, ...]) -> RunEnd | None:
    """Return the cause that ended the run of this log; None if the run was complete, or the log ends first.

    Logs older than 0.2 have the cause only as text in an event.
    """
    found = configuration.get("ended")
    if isinstance(found, Mapping):
        text = {name: str(found.get(name, "")) for name in ("kind", "what", "where", "next_step", "code")}
        return RunEnd(**text, exit_code=_code(found.get("exit_code")), time_s=_number(found.get("time_s")))
    for event in events:
        if event.kind == INTERRUPTED:
            by_hand = "Ctrl-C" in event.text
            code = ExitCode.INTERRUPTED if by_hand else ExitCode.TERMINATED
            return RunEnd(Interrupted.__name__, event.text, "", "", int(code), event.time_s)
        if event.kind == FAILURE:
            kind, _, said = event.text.partition(": ")
            known = {one.__name__: one for one in _below(TdhilError)}.get(kind)
            code = exit_code(known("")) if known is not None and known is not Interrupted else ExitCode.INTERNAL
            return RunEnd(kind, said, "", "", int(code), event.time_s)
    return None


def _below(kind: type[TdhilError]) -> Iterator[type[TdhilError]]:
    yield kind
    for one in kind.__subclasses__():
        yield from _below(one)


def _code(value: object) -> int:
    with suppress(ValueError):
        if isinstance(value, int):
            return int(ExitCode(value))
    return int(ExitCode.INTERNAL)


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else math.nan


# ---------------------------------------------------------------------------------------------------------------------

class RunLog:
    """Memory of one run. Builder and file receive the same data, so that a replay uses the data of the live run."""

    def __init__(self, writer: RunWriter, run: Mapping[str, Any]) -> None:
        self._writer = writer
        self._builder = RecordingBuilder()
        self._run = dict(run)
        self._dropped = 0
        self._virtual = array("d")
        self._commanded = array("d")
        self.frame: FrameTap = writer.frame
        """Log one raw frame as it passes on the bus."""
        writer.configuration(self._run, {})

    @property
    def run(self) -> dict[str, Any]:
        """Return the configuration of the run so far."""
        return dict(self._run)

    def cycle(self, command: Command, sample: Sample) -> None:
        """Log one exchange."""
        self._builder.add(sample, command)
        self._commanded.append(command.torque_nm)
        self._writer.command(sample.time_s, command)
        self._writer.sample(sample)

    @property
    def commanded_nm(self) -> FloatArray:
        """Return the commanded torque of each cycle, (N,), N·m."""
        return np.array(self._commanded)

    def virtual(self, row: Sequence[float]) -> None:
        """Log one cycle of a virtual string (`log_format.VIRTUAL_COLUMNS`)."""
        self._virtual.extend(row)
        self._writer.virtual(row)

    @property
    def virtual_string(self) -> FloatArray:
        """Return the cycles of a virtual string, (cycles, columns)."""
        return np.array(self._virtual).reshape(-1, len(VIRTUAL_COLUMNS))

    def event(self, time_s: float, kind: str, text: str) -> None:
        """Log an event."""
        self._writer.event(Event(time_s, kind, text))

    def failure(self, time_s: float, error: BaseException) -> None:
        """Record the error that ended a run, with its traceback in the log; the user gets only the message."""
        self.configure(ended=ended_by(error, time_s))
        if isinstance(error, Interrupted):
            self._writer.event(Event(time_s, INTERRUPTED, str(error)))
            return
        trace = "".join(traceback.format_exception(error))
        self._writer.event(Event(time_s, FAILURE, f"{type(error).__name__}: {error}", trace))

    def stage(self, stage: Stage) -> Stage:
        """Log a stage that has ended. Return it as logged: degraded if the log is not complete."""
        dropped = self._writer.dropped - self._dropped
        if dropped:
            self._dropped += dropped
            detail = f"{dropped} records found no place in the log"
            outcome = "degraded" if stage.outcome == "ok" else stage.outcome
            stage = replace(stage, outcome=outcome, detail=f"{stage.detail}; {detail}" if stage.detail else detail)
        self._builder.stage(stage)
        self._writer.stage(stage)
        return stage

    def motion(self, excitation: Excitation | None, levels: Sequence[Level] = (), ramps: Sequence[Ramp] = ()) -> None:
        """Log everything known so far of the motion; the last call counts."""
        self._builder.excitation(excitation, levels, ramps)
        self._writer.excitation(excitation, levels, ramps)

    def learn(self, **facts: Any) -> None:
        """Log facts of the Recording, by their names there."""
        self._builder.learn(**facts)
        self._writer.configuration(self._run, self._builder.facts)

    def configure(self, **run: Any) -> None:
        """Add to the configuration of the run."""
        self._run |= run
        self._writer.configuration(self._run, self._builder.facts)

    def inertia(self, found: LiveInertia) -> None:
        """An interim answer."""
        self._writer.inertia(found)

    def result(self, document: Mapping[str, Any]) -> None:
        """Log the result document."""
        self._writer.result(document)

    def recording(self, *, complete: bool) -> Recording:
        """Return the Recording so far."""
        return self._builder.recording(complete=complete)

    def part(self, after: RecordingPart | None = None) -> RecordingPart:
        """Return the record after an earlier part, or the whole record."""
        return self._builder.part(after)

    def close(self) -> None:
        """Finish the file."""
        self._writer.close()
