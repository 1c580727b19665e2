"""Display of a run in progress: the five stages with live speed, torque and remaining time. On stderr, not on
stdout.
"""

from __future__ import annotations

import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from drivers import SWITCH_S, Command, Outcome, Preflight, Sample
from profiles import visible
from profiles.quantities import in_nm
from tdhil.config import USUAL_STAGE_S
from tdhil.recording import LiveInertia, Stage
from tdhil.report.card import minutes
from tdhil.report.document import SIMULATED
from tdhil.report.graphs import GRAPHS

# ---------------------------------------------------------------------------------------------------------------------
# Output in its own thread, so that a blocked terminal (Ctrl-S, a pty without reader) blocks no other thread.
#
# A caller only queues a job and continues. Lines are kept in order, up to a limit; of pictures only the latest is kept.
# The thread is a daemon: it may be blocked in a write forever, and the process still ends.


Job = Callable[[], None]

MOST_LINES = 500
"""Longest queue of a terminal that accepts no lines; the oldest lines are dropped."""


class Painter:
    """Output thread. Every method except `flush` returns at once. An error in a job, except of the terminal, is
    raised later.
    """

    def __init__(self) -> None:
        self._lines: deque[Job] = deque(maxlen=MOST_LINES)
        self._picture: Job | None = None
        self._wake = threading.Event()
        self._waiting: deque[threading.Event] = deque()
        self._thread: threading.Thread | None = None
        self._failure: Exception | None = None
        self._gone = False             # True if the terminal is gone
        self._ending = False

    def line(self, job: Job) -> None:
        """Queue this job after earlier ones. Raises an error of an earlier job."""
        self._check()
        self._lines.append(job)
        self._begin()

    def picture(self, job: Job) -> None:
        """Do this job after all lines, unless a newer picture is queued. Raises an error of an earlier job."""
        self._check()
        self._picture = job
        self._begin()

    def line_after_picture(self, job: Job) -> None:
        """Queue this job after all earlier ones, including a waiting picture. Raises as `line` does."""
        picture, self._picture = self._picture, None
        if picture is not None:
            self.line(picture)
        self.line(job)

    def flush(self, timeout_s: float) -> bool:
        """Wait until all jobs are done, at most ``timeout_s``. Return whether they are done."""
        if self._thread is None:
            return True
        done = threading.Event()
        self._waiting.append(done)
        self._wake.set()
        return done.wait(timeout_s)

    def end(self) -> None:
        """End the thread after all jobs; a later job starts a new one."""
        self._ending = True
        self._wake.set()

    def _begin(self) -> None:
        self._ending = False
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, name="display", daemon=True)
            self._thread.start()
        self._wake.set()

    def _check(self) -> None:
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure

    def _work(self) -> None:
        while True:
            self._wake.wait()
            self._wake.clear()
            # taken first, because they were queued before these lines
            waiting = [self._waiting.popleft() for _ in range(len(self._waiting))]
            while self._lines or self._picture is not None:
                while self._lines:
                    self._do(self._lines.popleft())
                picture, self._picture = self._picture, None
                if picture is not None:
                    self._do(picture)
            for done in waiting:
                done.set()
            if self._ending and not self._lines:
                self._thread = None
                return

    def _do(self, job: Job) -> None:
        if self._gone:
            return
        try:
            job()
        except (OSError, ValueError):  # terminal closed or disconnected: a run continues without its display
            self._gone = True
        except Exception as error:
            self._failure = error


# ---------------------------------------------------------------------------------------------------------------------

class PlannedMotion(Protocol):
    """Displayed part of a plan of stage 5."""

    @property
    def kind(self) -> str: ...

    @property
    def mode(self) -> str: ...

    @property
    def duration_s(self) -> float: ...

    @property
    def speed_min_rad_s(self) -> float: ...

    @property
    def speed_max_rad_s(self) -> float: ...

    @property
    def torque_min_nm(self) -> float: ...

    @property
    def torque_max_nm(self) -> float: ...


_MARKS = {"ok": ("✓", "green"), "degraded": ("~", "yellow"), "aborted": ("✗", "red"), "skipped": ("-", "dim")}
_REFRESH_S = 0.2
_LONGEST_FLUSH_S = 2.0


@dataclass(frozen=True)
class LiveView:
    """Displayed content at one moment; it is never changed, only replaced."""

    expected_s: Mapping[str, float]
    ended: Mapping[str, Stage] = field(default_factory=dict)
    current: str | None = None
    elapsed_s: float = 0.0             # of the current stage, s of control time
    last: tuple[Command, Sample] | None = None
    simulated: bool = False
    inertias: tuple[LiveInertia, ...] = ()
    taken: bool = False                # True if a cycle has taken the terminal since the last pause
    end: str = ""


class LiveDisplay:
    """Display that is redrawn in place on a terminal; elsewhere one line a stage. Needs one clock reading a cycle.

    This class does not write. The thread of `Painter` does, from a view that does not change after it was passed.
    """

    def __init__(
        self, console: Console, show_preflight: bool, on_inertia: Callable[[LiveInertia], object] | None = None
    ) -> None:
        """``on_inertia`` receives J during the run, in the thread that draws."""
        self._console = console
        self._on_inertia = on_inertia
        self._show_preflight = show_preflight
        self._painter = Painter()
        self._view = LiveView(expected_s=dict(USUAL_STAGE_S))
        self._started_s: float | None = None
        self._next_s = 0.0
        self._live: Live | None = None         # used by the painter only
        self._usual_s = sys.getswitchinterval()

    def __enter__(self) -> LiveDisplay:
        # the control loop must get the interpreter back soon while a picture is drawn
        self._usual_s = sys.getswitchinterval()
        sys.setswitchinterval(min(self._usual_s, SWITCH_S))
        return self

    def __exit__(self, *exc: object) -> None:
        self.pause()
        self._painter.end()
        sys.setswitchinterval(self._usual_s)

    def pause(self) -> None:
        """Release the terminal for a prompt; the next stage or cycle takes it back.

        Waits until everything is written, up to a time limit.
        """
        view = self._view = replace(self._view, taken=False)
        # a later picture would take the terminal back, and the next output would overwrite its last line
        self._painter.line_after_picture(lambda: self._release_picture(view))
        self._painter.flush(_LONGEST_FLUSH_S)

    def say(self, text: str) -> None:
        """Print one line."""
        self._print(text, style="dim")

    def preflight(self, preflight: Preflight) -> None:
        """Print the preflight table for a real drive, or if a check refused."""
        self._view = replace(self._view, simulated=preflight.identity.simulated)
        if self._show_preflight or preflight.refused or not preflight.identity.simulated:
            view = self._view
            self._painter.line(lambda: self._release_picture(view))
            self._painter.line(lambda: self._console.print(preflight_table(preflight)))

    def stage_started(self, name: str, expected_s: float) -> None:
        self._view = replace(
            self._view, current=name, expected_s={**self._view.expected_s, name: expected_s}, elapsed_s=0.0
        )
        self._started_s = None
        if not self._console.is_terminal:
            self._print(f"{self._prefix()}stage {name} …")

    def planned(self, plan: PlannedMotion) -> None:
        """Show the plan of stage 5 as soon as it exists."""
        self._view = replace(self._view, expected_s={**self._view.expected_s, "acquire": plan.duration_s + 5.0})
        text = (
            f"plan: {plan.kind} in {plan.mode} mode, {minutes(plan.duration_s)}, speed {plan.speed_min_rad_s:.2f} to "
            f"{plan.speed_max_rad_s:.2f} rad/s, torque {in_nm(plan.torque_min_nm)} to {in_nm(plan.torque_max_nm)}"
        )
        self._print(self._prefix() + text, style="dim")

    def cycle(self, command: Command, sample: Sample) -> None:
        """Update the view in every cycle."""
        now_s = time.monotonic()
        if now_s < self._next_s:
            return
        self._next_s = now_s + _REFRESH_S
        if self._started_s is None:
            self._started_s = sample.time_s
        elapsed_s = sample.time_s - self._started_s
        self._view = replace(self._view, last=(command, sample), elapsed_s=elapsed_s, taken=True)
        self._show()

    @property
    def follows_inertia(self) -> bool:
        """Return whether J is wanted during the run: by a terminal or a function."""
        return self._console.is_terminal or self._on_inertia is not None

    def inertia(self, found: LiveInertia) -> None:
        """J from the periods so far."""
        self._view = replace(self._view, inertias=(*self._view.inertias, found)[-MOST_INERTIAS:])
        if self._on_inertia is not None:
            self._painter.line(lambda: self._hand_over(found))
        self._show()

    def stage_ended(self, stage: Stage) -> None:
        self._view = replace(self._view, ended={**self._view.ended, stage.name: stage})
        if not self._console.is_terminal:
            detail = f": {stage.cause}" if stage.detail else ""
            took = minutes(stage.end_s - stage.start_s)
            self._print(f"{self._prefix()}stage {stage.name} {stage.outcome}, {took}{detail}")
        else:
            self._show()

    def stopped(self, confirmed: bool) -> None:
        """Show the end of the stop sequence."""
        end = "shaft at standstill, drive disabled" if confirmed else "STOP NOT CONFIRMED"
        self._view = replace(self._view, end=end)
        if not self._console.is_terminal:
            self._print(f"{self._prefix()}{end}")
        else:
            self._show()

    def _hand_over(self, found: LiveInertia) -> None:
        """Call the function of the caller. An error of it ends the calls, not the run."""
        call, self._on_inertia = self._on_inertia, None
        if call is None:
            return
        try:
            call(found)
        except Exception as error:
            text = f"on_inertia is not called any more: {type(error).__name__}: {error}"
            self._console.print(text, style="yellow", markup=False)
            return
        self._on_inertia = call

    def _prefix(self) -> str:
        return f"{SIMULATED} " if self._view.simulated else ""

    def _print(self, text: str, style: str | None = None) -> None:
        def job() -> None:
            (self._live.console if self._live else self._console).print(
                text, style=style, highlight=False, markup=False
            )

        self._painter.line(job)

    def _show(self) -> None:
        if self._console.is_terminal:
            view = self._view
            self._painter.picture(lambda: self._draw(view))

    # -- in the painter's thread ------------------------------------------------------------------------------

    def _draw(self, view: LiveView) -> None:
        if self._live is None and view.taken:
            self._live = Live(console=self._console, auto_refresh=False, transient=False)
            self._live.start()
        if self._live is not None:
            self._live.update(picture(view, self._console.width), refresh=True)

    def _release_picture(self, view: LiveView) -> None:
        if self._live is not None:
            self._live.update(picture(view, self._console.width), refresh=True)
            self._live.stop()
            self._live = None


def picture(view: LiveView, width: int) -> RenderableType:
    """Return stages, bars, speed and torque; ``width``: available columns."""
    table = Table.grid(padding=(0, 1))
    table.add_column(width=1)
    table.add_column(width=8)
    table.add_column(width=34)
    table.add_column()
    left_s = 0.0
    for name, expected_s in view.expected_s.items():
        stage = view.ended.get(name)
        if stage is not None:
            took = minutes(stage.end_s - stage.start_s)
            note = stage.outcome if stage.outcome != "ok" else ""
            table.add_row(Text(*_MARKS.get(stage.outcome, (" ", ""))), name, note, Text(took, "dim"))
        elif name == view.current:
            done_s = view.elapsed_s
            left_s += max(0.0, expected_s - done_s)
            bar = ProgressBar(total=max(expected_s, 0.1), completed=min(done_s, expected_s), width=32)
            table.add_row(Text("▸", "cyan"), Text(name, "bold"), bar, minutes(done_s))
        else:
            left_s += expected_s
            table.add_row(" ", Text(name, "dim"), "", "")
    parts: list[RenderableType] = [table]
    if view.last is not None:
        command, sample = view.last
        text = view.end or (
            f"{sample.speed_rad_s:7.3f} rad/s  {sample.torque_nm:8.1f} N·m  {sample.state.value}, "
            f"{command.mode.value} mode  {minutes(left_s)} left"
        )
        parts.append(Text(text, no_wrap=True, overflow="ellipsis"))
    if view.inertias and not view.end:
        parts += inertia_rows(view.inertias, width)
    if view.simulated:
        parts.insert(0, Text(f"{SIMULATED} drive and rig: nothing real turns", style="magenta"))
    return Group(*parts)


MOST_INERTIAS = 200
_SHOWN = 6                # answers on a terminal of 24 lines
_CELLS = 36               # of an interval's bar, at most
_BESIDE = 27              # columns beside the bar: time, J, half-width and the gaps between them


def inertia_rows(inertias: Sequence[LiveInertia], width: int) -> list[RenderableType]:
    """J's interval over time, a line for each of some answers: the first, and the latest."""
    known = [one for one in inertias if one.inertia_kg_m2 is not None]
    last = inertias[-1]
    if not known:
        return [Text(f"J is not known yet: {last.reason}", "dim", no_wrap=True, overflow="ellipsis")]
    shown = known if len(known) <= _SHOWN else [known[0], *known[1 - _SHOWN:]]
    low = min(one.low_kg_m2 for one in shown if one.low_kg_m2 is not None)
    high = max(one.high_kg_m2 for one in shown if one.high_kg_m2 is not None)
    cells = min(_CELLS, max(len(f"{low:.4g} {high:.4g}"), width - _BESIDE))
    title = Text(f"J, kg·m², {100.0 * last.confidence:.4g} % interval (repeatability)", "dim")
    grid = Table.grid(padding=(0, 1))
    for column in (7, cells, 9, None):
        grid.add_column(width=column, no_wrap=True)
    grid.columns[0].justify = "right"
    grid.add_row("", Text(f"{low:.4g}{f'{high:.4g}':>{cells - len(f'{low:.4g}')}}", "dim"), "", "")
    for one in shown:
        style = "bold" if one is shown[-1] else ""
        grid.add_row(
            Text(minutes(one.time_s), "dim"), Text(_bar(one, low, high, cells), style),
            Text(f"{one.inertia_kg_m2:.4g}", style), Text(f"±{100.0 * one.relative_half_width:.2g} %", style),
        )
    return [title, grid, Text(GRAPHS["live"].reading, "dim"),
            Text(_said(last), "dim", no_wrap=True, overflow="ellipsis")]


def _bar(one: LiveInertia, low: float, high: float, width: int) -> str:
    """Return the interval between both ends of the scale, with J in it, in ``width`` cells at most."""
    def cell(value: float | None) -> int:
        share = 0.5 if value is None or high <= low else (value - low) / (high - low)
        return min(width - 1, max(0, round(share * (width - 1))))

    begin, middle, end = cell(one.low_kg_m2), cell(one.inertia_kg_m2), cell(one.high_kg_m2)
    cells = [" "] * begin + ["─"] * (end - begin + 1)
    cells[begin], cells[end] = "├", "┤"
    cells[middle] = "●"
    return "".join(cells)


def _said(last: LiveInertia) -> str:
    """Return a line on the latest answer."""
    parts = [f"{last.periods} period{'' if last.periods == 1 else 's'}"]
    if last.p_value is not None:
        parts.append(f"p {last.p_value:.2g}")
    if last.inertia_kg_m2 is None:
        parts = [f"now: {last.reason}"]
    if last.tolerance is not None and last.least_left_s is not None:
        return ", ".join((*parts, f"at least {minutes(last.least_left_s)} to ±{100.0 * last.tolerance:.3g} %"))
    return f"{', '.join(parts)}. --tolerance ends a run at an interval."


def preflight_table(preflight: Preflight) -> Table:
    """Return every check with the required and the found value."""
    who = preflight.identity
    title = Text(f"preflight: {visible(who.name)}" + (f" · {SIMULATED}" if who.simulated else ""), "table.title")
    table = Table(title=title, title_justify="left", expand=False)
    for heading in ("", "check", "wanted", "found", "where"):
        table.add_column(heading, overflow="fold")
    marks = {Outcome.OK: ("✓", "green"), Outcome.NOTE: ("i", "dim"), Outcome.REFUSED: ("✗", "red")}
    for check in preflight.checks:
        row = (Text(visible(text)) for text in (check.name, check.wanted, check.found, check.where))
        table.add_row(Text(*marks[check.outcome]), *row)
        if check.next_step:
            table.add_row("", "", "", Text(visible(check.next_step), "yellow"), "")
    table.add_row("", "if the host falls silent", "", preflight.reaction, "")
    return table
