"""J during stage 5: after periods of the excitation, a worker process identifies the samples recorded so far.

The answer equals that at the end of the run: the same function on the same samples. It goes to the display and to the
log only: no cycle waits for it, and the length of stage 5 never depends on it. `adaptive_duration` may end a run early,
by its own analyses, whose cost in confidence is known beforehand.

In real time the worker process receives only the samples since its last answer, and an answer is due when the earlier
ones took at most `CORE_SHARE` of a core. Without that process there are no answers, because a thread would disturb the
cycles. In stepped time no cycle can be late: the answer is computed at the end of the period, and `STEPPED_S` apart.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol, runtime_checkable

from tdhil.estimation import Identification, Options, identify
from tdhil.recording import Excitation, LiveInertia, Recording, RecordingBuilder, RecordingPart, RunLog
from tdhil.runner.background import Background, Gone
from tdhil.runner.control_loop import ControlLoop

CORE_SHARE = 0.05
"""Largest share of a core that the answers take, in real time."""

STEPPED_S = 40.0
"""Least control time between two answers in stepped time, s. One takes up to 1 s of a core: `CORE_SHARE` of it."""

LEAST_PERIODS = 3
"""Evaluated periods below which the scatter is not known and no J is identified."""

NO_ANSWERS = "J is not shown during the run: the worker process is not available"

Identify = Callable[[Recording, float], Identification]
"""Function that identifies a recording with a confidence, as at the end of the run; it can be pickled."""


def identify_plainly(recording: Recording, confidence: float) -> Identification:
    """Identify without the options and the calibration of a session."""
    return identify(recording, Options(confidence=confidence))


@runtime_checkable
class FollowsInertia(Protocol):
    """A display that can show J during the run."""

    @property
    def follows_inertia(self) -> bool:
        """Return whether answers are requested now. Without a viewer they are not computed."""
        ...

    def inertia(self, found: LiveInertia) -> None:
        """Show an answer. Called by the control loop, so it returns at once."""
        ...


@dataclass(frozen=True)
class Answered:
    """An answer, and the processor time for it, s."""

    found: LiveInertia
    cpu_s: float


@dataclass(frozen=True)
class Interim:
    """Request for J, without the samples. ``motion`` ends with the last complete period.

    ``working``: confidence for the computation; in a run with a tolerance it is higher, so that the interval has the
    ``confidence`` after all analyses.
    """

    motion: Excitation
    identify: Identify
    confidence: float
    working: float
    tolerance: float | None = None
    least_left_s: float | None = None


def interim_answer(recording: Recording, asked: Interim) -> Answered:
    """Identify the periods so far. Return J, and the processor time."""
    began_s = time.thread_time()
    recording = replace(recording, excitation=asked.motion)
    found = live_inertia(asked.identify(recording, asked.working), recording, asked.confidence)
    found = replace(found, tolerance=asked.tolerance, least_left_s=asked.least_left_s)
    return Answered(found, time.thread_time() - began_s)


def counted_periods(motion: Excitation | None) -> int:
    """Return the whole periods after settling, of all segments."""
    return 0 if motion is None else sum(
        max(0, round((one.end_s - one.start_s) / one.period_s) - one.settle_periods) for one in motion.segments
    )


def live_inertia(found: Identification, recording: Recording, confidence: float) -> LiveInertia:
    """Return the part of a result that is shown during a run."""
    motion, inertia, residual = recording.excitation, found.inertia, found.residual
    time_s = float(recording.time_s[-1]) if len(recording.time_s) else 0.0
    if motion is not None and motion.segments:
        time_s = motion.segments[-1].end_s
    live = LiveInertia(time_s, counted_periods(motion), confidence, found.verdict.value, found.reason)
    if residual is not None and math.isfinite(residual.p_value):
        live = replace(live, p_value=residual.p_value)
    if inertia is None:
        return live
    return replace(
        live, inertia_kg_m2=inertia.value, low_kg_m2=inertia.low, high_kg_m2=inertia.high,
        low_total_kg_m2=inertia.low_total, high_total_kg_m2=inertia.high_total,
    )


# ---------------------------------------------------------------------------------------------------------------------
# Functions of the worker process, which serves one run and keeps its samples.


_kept: list[RecordingBuilder] = []


def answer_with(part: RecordingPart, asked: Interim) -> Answered:
    """Add the samples since the last answer, and identify. Raises ValueError if a part is missing."""
    if part.begin == 0:
        _kept[:] = [RecordingBuilder()]
    if not _kept:
        raise ValueError("the first part is missing")
    _kept[0].join(part)
    return interim_answer(_kept[0].recording(complete=True), asked)


# ---------------------------------------------------------------------------------------------------------------------


class InertiaWatch:
    """Requests J at ends of periods in one stage 5, and passes each answer on. None of its errors ends a run."""

    def __init__(
        self, loop: ControlLoop, log: RunLog, display: object, identify: Identify,
        confidence: float, working: Callable[[], float] | None = None, tolerance: float | None = None,
    ) -> None:
        """``working`` returns the present confidence to compute with, for a run with a ``tolerance``."""
        self._loop, self._log = loop, log
        self._display = display if isinstance(display, FollowsInertia) else None
        self._identify, self._confidence, self._working = identify, confidence, working
        self._tolerance = tolerance
        self._pending: Background[Answered] | None = None
        self._began_s = 0.0
        self._next_s = -math.inf       # of the clock: wall time, or control time if it is stepped
        self._sent: RecordingPart | None = None

    def period_ended(self, motion: Excitation, least_left_s: float) -> None:
        """Ask for J from ``motion``, if it is wanted, due, and the last answer has come."""
        display, loop = self._display, self._loop
        if display is None or self._pending is not None or not display.follows_inertia:
            return
        if counted_periods(motion) < LEAST_PERIODS:
            return
        stepped = loop.drive.clock.stepped
        now_s = loop.now_s if stepped else time.monotonic()
        if now_s < self._next_s:
            return
        working = self._confidence if self._working is None else self._working()
        left_s = None if self._tolerance is None else least_left_s
        asked = Interim(motion, self._identify, self._confidence, working, self._tolerance, left_s)
        if stepped:
            recording = self._log.recording(complete=True)
            self._next_s = now_s + STEPPED_S - 2.0 * loop.period_s     # ends of periods differ by a cycle
            self._report(loop.compute_while(partial(interim_answer, recording, asked), lambda: None).found)
            return
        if loop.worker_process is None:
            self._give_up("it is not there")
            return
        self._sent = part = self._log.part(self._sent)
        self._began_s = now_s
        self._pending = Background(partial(answer_with, part, asked), loop.worker_process, or_thread=False)

    def look(self) -> None:
        """Pass on an answer that has come. Called in every cycle."""
        pending = self._pending
        if pending is None or not pending.ended.is_set():
            return
        self._pending = None
        try:
            answered = pending.result()
        except Gone as gone:
            self._give_up(str(gone))
            return
        except Exception as error:         # the run's own result will show it
            self._give_up(f"{type(error).__name__}: {error}")
            return
        self._next_s = self._began_s + answered.cpu_s / CORE_SHARE
        self._report(answered.found)

    def _give_up(self, why: str) -> None:
        self._display = None
        self._log.event(self._loop.now_s, "host", f"{NO_ANSWERS} ({why})")

    def _report(self, found: LiveInertia) -> None:
        self._log.inertia(found)
        if self._display is not None:
            self._display.inertia(found)
