"""Log of a run during the run: data go to the file, and to the Recording for the identification."""

from __future__ import annotations

import traceback
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from drivers import Command, FrameTap, Sample
from tdhil.errors import Interrupted
from tdhil.recording.builder import RecordingBuilder, RecordingPart
from tdhil.recording.log_format import FAILURE, INTERRUPTED, VIRTUAL_COLUMNS, Event, LiveInertia
from tdhil.recording.log_writer import RunWriter
from tdhil.recording.recording import Excitation, FloatArray, Level, Ramp, Recording, Stage
from tdhil.recording.run_end import ended_by


class RunLog:
    """Memory of one run. Builder and file receive the same data, so that a replay uses the data of the live run."""

    def __init__(self, writer: RunWriter, run: Mapping[str, Any]) -> None:
        self._writer = writer
        self._builder = RecordingBuilder()
        self._run = dict(run)
        self._dropped = 0
        self._failed_s = 0.0
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
        self._failed_s = time_s
        self.configure(ended=ended_by(error, time_s))
        if isinstance(error, Interrupted):
            self._writer.event(Event(time_s, INTERRUPTED, str(error)))
            return
        trace = "".join(traceback.format_exception(error))
        self._writer.event(Event(time_s, FAILURE, f"{type(error).__name__}: {error}", trace))

    def stopped(self, error: BaseException) -> None:
        """Record again the error that ended a run: its text now states the outcome of the stop."""
        self.configure(ended=ended_by(error, self._failed_s))

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
