"""Record of the stages: each stage is announced, shown, rated and logged, however it ends."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from drivers import Counters, Drive, Preflight, Rehearsed, ReportsOthers
from profiles import CodedText, MessageCode
from tdhil.recording import RunLog, Stage
from tdhil.runner import preconditions
from tdhil.runner.task import Display, Say

# ---------------------------------------------------------------------------------------------------------------------
# Actions of other masters on the drive's bus during a run, for the log, the display and the result.


def summary(drive: Drive) -> tuple[str, ...]:
    """Return the actions of others in the whole run, one line each; none if the drive can't detect them."""
    return drive.summary() if isinstance(drive, ReportsOthers) else ()


def report_others(drive: Drive, configure: Callable[..., None], say: Callable[[str], None]) -> None:
    """Write the actions of others to the log's configuration and to the display, at the end."""
    if lines := summary(drive):
        configure(others=list(lines))
        for line in lines:
            say(f"on the drive's bus: {line}")


def stage_warnings(run: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the warnings for the result, from the log's configuration: the same live and in replay."""
    found = run.get("others")
    lines = found if isinstance(found, list) else ()
    return tuple(CodedText(f"on the drive's bus: {line}", MessageCode.FOREIGN_TRAFFIC) for line in lines)


# ---------------------------------------------------------------------------------------------------------------------
# Quality of a stage, from errors on the bus and in the loop while it ran. Pure.


TOLERATED_LOSS = 0.01
"""A stage with a larger share of cycles without feedback counts as degraded; a few are normal."""

TOLERATED_LATE = 0.05
"""Tolerated share of cycles that began late, or with feedback after its cycle or twice."""

FEW_LATE = 10
"""Tolerated number of late cycles, also in a short stage."""


def stage_quality(before: Counters, after: Counters) -> tuple[str, str]:
    """Return (``ok`` or ``degraded``, text)."""
    cycles = after.cycles - before.cycles
    parts, outcome = [], "ok"
    some_late = max(FEW_LATE, TOLERATED_LATE * cycles)
    for count, tolerated, text in (
        (after.missed - before.missed, TOLERATED_LOSS * cycles, "without feedback"),
        (after.late - before.late, some_late, "with feedback that came late or twice"),
        (after.overruns - before.overruns, some_late, "that began late"),
    ):
        if count:
            parts.append(f"{count} of {cycles} cycles {text}")
        if count > tolerated:
            outcome = "degraded"
    errors, passive = after.error_frames - before.error_frames, after.passive - before.passive
    if errors:
        parts.append(f"{errors} error frames" + (", the adapter was error-passive" if passive else ""))
    if passive or errors > TOLERATED_LOSS * cycles:
        outcome = "degraded"
    return outcome, ", ".join(parts)


# ---------------------------------------------------------------------------------------------------------------------

class StageBook:
    """The stages of one run. ``stages``: ended ones; ``preflight``: set once there is one."""

    def __init__(self, drive: Drive, log: RunLog, display: Display, say: Say) -> None:
        self.stages: list[Stage] = []
        self.preflight: Preflight | None = None
        self._drive = drive
        self._log = log
        self._display = display
        self._say = say

    @contextmanager
    def stage(self, name: str, expected_s: float) -> Iterator[None]:
        """Run the block as this stage. Errors of the block are raised again: an aborted stage stays aborted."""
        start_s = self._now_s()
        before = self._drive.counters
        try:
            self._display.stage_started(name, expected_s)
            self._announce(name)
            yield
        except BaseException as error:
            preconditions.correct(error, self.preflight)
            try:
                self._end(Stage(name, start_s, self._now_s(), "aborted", _short(error)))
            except Exception as also:  # the first cause stays the cause
                error.add_note(f"and the end of the stage could not be logged: {also}")
            raise
        after = self._drive.counters
        if after.wall_jumps > before.wall_jumps:
            self._log.event(self._now_s(), "clock",
                            "the wall clock jumped: time stamps on the bus changed, the times in this log did not")
        if after.passive > before.passive:
            text = "the CAN adapter is error-passive. Check bit rate, termination and cable"
            self._log.event(self._now_s(), "bus", text)
            self._say(text)
        outcome, detail = stage_quality(before, after)
        self._end(Stage(name, start_s, self._now_s(), outcome, detail))

    def skip(self, name: str, why: str) -> None:
        """Log a stage that this run does not need."""
        self._display.stage_started(name, 0.0)
        self._end(Stage(name, self._now_s(), self._now_s(), "skipped", why))

    def _now_s(self) -> float:
        return self._drive.clock.now_s()

    def _announce(self, name: str) -> None:
        """Announce a stage to the drive: a simulated peer triggers its scripted faults by it."""
        if isinstance(self._drive, Rehearsed):
            self._drive.announce(name)

    def _end(self, stage: Stage) -> None:
        self.stages.append(stage)
        self.stages[-1] = stage = self._log.stage(stage)
        self._display.stage_ended(stage)


def _short(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"[:300]
