"""Keeps the book of the stages: each is announced, shown, judged and written to the log, however it ends."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from drivers.drive import Drive, Preflight, Rehearsed
from tdhil.protocol import no_watchdog
from tdhil.protocol.stage_quality import stage_quality
from tdhil.recording.recording import Stage
from tdhil.recording.run_log import RunLog
from tdhil.run.task import Display, Say


class StageBook:
    """Of one run. ``stages`` are those that have ended; ``preflight`` is set once there is one."""

    def __init__(self, drive: Drive, log: RunLog, display: Display, say: Say) -> None:
        self.stages: list[Stage] = []
        self.preflight: Preflight | None = None
        self._drive = drive
        self._log = log
        self._display = display
        self._say = say

    @contextmanager
    def stage(self, name: str, expected_s: float) -> Iterator[None]:
        """What runs inside is that stage. Raises what it raises: an aborted stage stays aborted."""
        start_s = self._now_s()
        before = self._drive.counters
        try:
            self._display.stage_started(name, expected_s)
            self._announce(name)
            yield
        except BaseException as error:
            no_watchdog.correct(error, self.preflight)
            try:
                self._end(Stage(name, start_s, self._now_s(), "aborted", _short(error)))
            except Exception as also:  # the first cause stays the cause
                error.add_note(f"and the end of the stage was not taken: {also}")
            raise
        after = self._drive.counters
        if after.wall_jumps > before.wall_jumps:
            self._log.event(self._now_s(), "clock",
                            "the wall clock jumped: stamps on the bus moved, the times in this log did not")
        if after.passive > before.passive:
            self._tell_bus("the adapter is error-passive: check bit rate, termination and cable")
        outcome, detail = stage_quality(before, after)
        self._end(Stage(name, start_s, self._now_s(), outcome, detail))

    def skip(self, name: str, why: str) -> None:
        """A stage that this run doesn't need."""
        self._display.stage_started(name, 0.0)
        self._end(Stage(name, self._now_s(), self._now_s(), "skipped", why))

    def _now_s(self) -> float:
        return self._drive.clock.now_s()

    def _tell_bus(self, text: str) -> None:
        self._log.event(self._now_s(), "bus", text)
        self._say(text)

    def _announce(self, name: str) -> None:
        """A drive may pass it on to a simulated peer, whose scripted faults wait for it."""
        if isinstance(self._drive, Rehearsed):
            self._drive.announce(name)

    def _end(self, stage: Stage) -> None:
        self.stages.append(stage)
        self.stages[-1] = stage = self._log.stage(stage)
        self._display.stage_ended(stage)


def _short(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"[:300]
