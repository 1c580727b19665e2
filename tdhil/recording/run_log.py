"""Where a run goes as it happens: to the file, and to the Recording that is identified from afterwards."""

from __future__ import annotations

import traceback
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from drivers.drive import Command, RawFrame, Sample
from tdhil.errors import Interrupted
from tdhil.record.ended import ended_by
from tdhil.record.event import FAILURE, INTERRUPTED, Event
from tdhil.recording.builder import RecordingBuilder
from tdhil.recording.log_writer import RunWriter
from tdhil.recording.recording import Excitation, Level, Ramp, Recording, Stage


class RunLog:
    """One run's memory. What the builder gets, the file gets, so that a replay sees what the live run saw."""

    def __init__(self, writer: RunWriter, run: Mapping[str, Any]) -> None:
        self._writer = writer
        self._builder = RecordingBuilder()
        self._run = dict(run)
        self._dropped = 0
        writer.configuration(self._run, {})

    @property
    def run(self) -> dict[str, Any]:
        """The run's configuration so far."""
        return dict(self._run)

    def frame(self, frame: RawFrame) -> None:
        """One raw frame, as it passes on the bus."""
        self._writer.frame(frame)

    def cycle(self, command: Command, sample: Sample) -> None:
        """One exchange."""
        self._builder.add(sample)
        self._writer.command(sample.time_s, command)
        self._writer.sample(sample)

    def event(self, time_s: float, kind: str, text: str) -> None:
        """Something worth a line."""
        self._writer.event(Event(time_s, kind, text))

    def failure(self, time_s: float, error: BaseException) -> None:
        """What ended a run, with its traceback: for us, in the log; the user gets the message alone."""
        self.configure(ended=ended_by(error, time_s))
        if isinstance(error, Interrupted):
            self._writer.event(Event(time_s, INTERRUPTED, str(error)))
            return
        trace = "".join(traceback.format_exception(error))
        self._writer.event(Event(time_s, FAILURE, f"{type(error).__name__}: {error}", trace))

    def stage(self, stage: Stage) -> Stage:
        """A stage that has ended; as it stands in the log: degraded where the log could not take all of it."""
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
        """Everything known so far of what the shaft was made to do; the last call counts."""
        self._builder.excitation(excitation, levels, ramps)
        self._writer.excitation(excitation, levels, ramps)

    def learn(self, **facts: Any) -> None:
        """Facts of the Recording, by their names there."""
        self._builder.learn(**facts)
        self._writer.configuration(self._run, self._builder.facts)

    def configure(self, **run: Any) -> None:
        """More of the run's configuration."""
        self._run |= run
        self._writer.configuration(self._run, self._builder.facts)

    def result(self, document: Mapping[str, Any]) -> None:
        """The result document."""
        self._writer.result(document)

    def recording(self, *, complete: bool) -> Recording:
        """The Recording so far."""
        return self._builder.recording(complete=complete)

    def close(self) -> None:
        """Finish the file."""
        self._writer.close()
