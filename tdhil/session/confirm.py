"""The typed confirmation before a real shaft moves. While it waits, the drive's watchdog is fed."""

from __future__ import annotations

import math
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from functools import partial
from typing import TYPE_CHECKING, Final, TypeVar

from rich.console import Console

from drivers import ACCEPTED_BY, ANY_CLIENT, NOTHING_STOPS_IT, Preflight, PreflightRefused
from profiles import MessageCode, visible
from profiles.quantities import RPM
from tdhil.recording import LiveInertia
from tdhil.report import LiveDisplay, minutes
from tdhil.runner import Display, ExcitationRequest, Idle, MachineLimits, Task

if TYPE_CHECKING:
    from tdhil.soft_torque import EvaluationCase
    from tdhil.speed_loop import StepCase

T = TypeVar("T")

WORD, MOUNTED = "MOVE", "MOUNTED"
SPEED_FLAG = "--accept-speed-unit"
CHECKLIST: Final = (
    "brake released", "pipe handler and people clear of the shaft",
    "hard-wired emergency stop tested and within reach (a stop by tdhil is no emergency stop)",
)
"""Checklist of a person before each motion."""
_UNWATCHED = "  [ ] an operator stays at that stop for the whole run: nothing else stops the shaft if this host fails\n"
_SHARED = (
    "  [ ] every other client of this drive is switched off (PLC, panel, historian, gateway); an operator stays at\n"
    "      that stop for the whole run\n"
)


def confirm_motion(
    task: Task,
    preflight: Preflight,
    idle: Idle,
    *,
    yes: bool,
    console: Console,
    pause_display: Callable[[], None],
    unverified: Sequence[str] = (),
) -> None:
    """Return if the shaft may be moved. Raises PreflightRefused (exit 4) if not.

    A simulated peer needs no confirmation. ``--yes`` replaces the prompt, not the limits.
    """
    if preflight.identity.simulated:
        return
    pause_display()
    console.print(motion_summary(preflight, task.limits, task.request, unverified, task.case), markup=False)
    if yes:
        console.print("Confirmed by --yes.")
        return
    if sys.stdin is None or not sys.stdin.isatty():
        raise PreflightRefused(
            "no operator can confirm that the shaft may move",
            where="no terminal",
            next_step="Run it at a terminal, or add --yes if an operator stands at the hard-wired emergency stop",
            entry=MessageCode.NOT_CONFIRMED,
        )
    _forget_what_was_typed()
    console.print(f"Type {WORD} and Enter to turn the shaft, anything else to cancel: ", end="")
    if _ask(idle).strip() != WORD:
        raise PreflightRefused("the motion was not confirmed", where="prompt", next_step="Nothing has moved",
                               entry=MessageCode.NOT_CONFIRMED)


def confirm_speed(
    speed_rad_s: float,
    why: str,
    idle: Idle,
    *,
    console: Console,
    pause_display: Callable[[], None],
    gear_ratio: float = 1.0,
) -> None:
    """Return if the operator sees the shaft turn at the reported speed. Raises PreflightRefused (exit 4) if not.

    Cycles continue while the prompt waits. ``--yes`` does not answer this question.
    """
    turning = turns_text(speed_rad_s)
    if sys.stdin is None or not sys.stdin.isatty():
        raise PreflightRefused(
            f"no operator can confirm that the shaft turns {turning}, as the drive reports ({why})",
            where="no terminal",
            next_step="Run it at a terminal, where an operator sees the shaft. Or name the drive's position object in"
            f" the profile (position). Or accept the unit of speed by name: {SPEED_FLAG}",
            entry=MessageCode.SPEED_UNIT_NOT_SEEN,
        )
    main = f" (the main shaft, behind the gear, {turns_text(speed_rad_s / gear_ratio)})" if gear_ratio != 1.0 else ""

    def ask() -> str:
        """Run in the waiting thread, with the last output of the display: a blocked terminal then delays no cycle."""
        pause_display()
        _forget_what_was_typed()
        console.print(
            f"\nThe shaft turns, and {why}.\n"
            f"The drive reports {speed_rad_s:.3g} rad/s. Watch a mark on the motor shaft for some turns.",
            markup=False,
        )
        console.print(
            f"Does it turn {turning}{main}? Type yes and Enter; any other answer stops it: ", end="", markup=False
        )
        return _line()

    answer = _meanwhile(idle, ask).strip().lower()
    if answer not in ("y", "yes"):
        raise PreflightRefused(
            f"the operator did not confirm that the shaft turns {turning}, as the drive reports: the unit of speed in"
            " the profile is probably wrong",
            where="prompt",
            next_step="Time ten turns of the shaft. Multiply the speed scaling in the profile by the expected time"
            " divided by the measured time. Then repeat this check",
            entry=MessageCode.SPEED_UNIT_WRONG,
        )


def require_terminal(what: str) -> None:
    """Raise PreflightRefused (exit 4) if no operator can confirm ``what`` at a terminal."""
    if sys.stdin is None or not sys.stdin.isatty():
        raise PreflightRefused(f"no operator can confirm {what}", where="no terminal",
                               next_step="Run it at a terminal. --yes does not answer this question",
                               entry=MessageCode.NOT_CONFIRMED)


def confirm_mounted(console: Console, later: str) -> None:
    """Return when the operator confirms that the body is on the shaft. Raises PreflightRefused (exit 4) if not.

    No drive is open meanwhile. ``later``: the command that calibrates from a second run at another time.
    """
    require_terminal("that the body is mounted")
    _forget_what_was_typed()
    console.print(
        "\nThe drive is disabled. Before you touch the shaft:\n"
        "  [ ] switch the drive off and lock it out\n"
        "  [ ] bolt the body tight to the motor shaft; change nothing else (drive, filters, gear)\n"
        "  [ ] take tools off the shaft, clear it of people, and switch the drive on again", markup=False)
    console.print(f"Type {MOUNTED} and Enter when the body is mounted, anything else to cancel: ", end="")
    if _line().strip() != MOUNTED:
        raise PreflightRefused(
            "the body was not confirmed as mounted; the second run was not started", where="prompt",
            next_step=f"The first log is kept. Do the run with the body later, then: {later}",
            entry=MessageCode.NOT_CONFIRMED)


def turns_text(speed_rad_s: float) -> str:
    """Return a speed in turns per time, as an operator with a watch sees it."""
    way = "forward" if speed_rad_s >= 0.0 else "backwards"
    turn_s = 2.0 * math.pi / max(abs(speed_rad_s), 1e-9)
    if turn_s >= 2.0:
        return f"{way} once every {turn_s:.3g} s"
    return f"{way} {10.0 / turn_s:.3g} times in 10 s"


def motion_summary(
    preflight: Preflight, limits: MachineLimits, request: ExcitationRequest, unverified: Sequence[str] = (),
    case: EvaluationCase | StepCase | None = None,
) -> str:
    """Return the planned motion and the checklist. ``unverified``: profile entries that the operator accepted.

    ``case``: the motion in place of an excitation.
    """
    silent = f"{preflight.watchdog_s:g} s in the drive, then {preflight.reaction}"
    watchdog, seen_to = (silent, "") if preflight.watched else (f"NONE, {ACCEPTED_BY}: {NOTHING_STOPS_IT}", _UNWATCHED)
    if preflight.watched and preflight.fed_by_any_client:
        watchdog, seen_to = f"{silent}; but {ANY_CLIENT}", _SHARED
    points = "".join(f"  [ ] {point}\n" for point in CHECKLIST)
    return (
        f"\nThis run will move {visible(preflight.identity.name)}:\n"
        f"  sign probe      torque up to {limits.probe_torque_nm:g} N·m, at most {limits.probe_travel_rad:g} rad\n"
        f"  speed window    {limits.speed_min_rad_s:.4g} to {limits.speed_max_rad_s:.4g} rad/s "
        f"({RPM.of_si(limits.speed_min_rad_s):.4g} to {RPM.of_si(limits.speed_max_rad_s):.4g} rpm)\n"
        f"  peak torque     {limits.torque_nm:g} N·m\n"
        f"  excitation      {request.kind if case is None else case.motion}\n"
        f"  duration        at most {minutes(limits.time_s)}\n"
        f"  watchdog        {watchdog}\n"
        f"{_taken(unverified)}"
        f"Before you confirm:\n{points}{seen_to}"
    )


def _taken(unverified: Sequence[str]) -> str:
    if not unverified:
        return ""
    lines = "".join(f"  {visible(one)}\n" for one in unverified)
    return f"Accepted although unverified in the profile:\n{lines}"


def _ask(idle: Idle) -> str:
    """Return a line from the terminal. Raises PreflightRefused if it can't be read, as in a background process."""
    return _meanwhile(idle, _line)


def _forget_what_was_typed() -> None:
    """Discard input that was typed before the question appeared."""
    with suppress(ImportError, OSError, ValueError):
        import termios

        with suppress(termios.error):
            termios.tcflush(sys.stdin.fileno(), termios.TCIFLUSH)


def _line() -> str:
    try:
        return sys.stdin.readline()
    except OSError as error:
        raise PreflightRefused(
            f"the terminal can't be read: {error.strerror or error}", where="terminal",
            next_step="Run it in the foreground, at a terminal",
            entry=MessageCode.NOT_CONFIRMED,
        ) from error


def _meanwhile(idle: Idle, ask: Callable[[], T]) -> T:
    """Return the result of ``ask``, or raise its exception. It runs in a thread; idle cycles continue meanwhile."""
    answer: Future[T] = Future()

    def work() -> None:
        try:
            answer.set_result(ask())
        except BaseException as error:         # raised where the answer is awaited
            answer.set_exception(error)

    threading.Thread(target=work, name="prompt", daemon=True).start()
    while True:
        idle()
        if answer.done():
            return answer.result()


class TerminalOperator:
    """The operator at the terminal, who sees the run there, types the confirmation, and watches the shaft."""

    def __init__(
        self, console: Console, *, yes: bool = False, gear_ratio: float = 1.0,
        on_inertia: Callable[[LiveInertia], object] | None = None,
    ) -> None:
        """``on_inertia`` receives J during the run."""
        self._console = console
        self._yes = yes
        self._gear_ratio = gear_ratio
        self._display = LiveDisplay(console, show_preflight=False, on_inertia=on_inertia)
        self._watching = False

    @contextmanager
    def watch(self) -> Iterator[Display]:
        with self._display as display:
            self._watching = True
            try:
                yield display
            finally:
                self._watching = False

    def confirm(self, task: Task, preflight: Preflight, idle: Idle, unverified: tuple[str, ...]) -> None:
        confirm_motion(
            task, preflight, idle, yes=self._yes, console=self._console, pause_display=self._display.pause,
            unverified=unverified,
        )

    def confirm_speed(self, speed_rad_s: float, why: str, idle: Idle) -> None:
        confirm_speed(
            speed_rad_s, why, idle, console=self._console, pause_display=self._display.pause,
            gear_ratio=self._gear_ratio,
        )

    def say(self, text: str) -> None:
        if self._watching:
            self._display.say(text)
        else:
            self._console.print(text, style="dim", markup=False, highlight=False, soft_wrap=True)

    def warn(self, text: str) -> None:
        self._console.print(text, style="yellow", markup=False, soft_wrap=True)


class CallbackOperator(TerminalOperator):
    """The operator at the terminal, but a function of the caller confirms motion. It receives the summary of the
    motion.
    """

    def __init__(
        self, console: Console, ask: Callable[[str], bool], *, gear_ratio: float = 1.0,
        on_inertia: Callable[[LiveInertia], object] | None = None,
    ) -> None:
        super().__init__(console, gear_ratio=gear_ratio, on_inertia=on_inertia)
        self._ask = ask

    def confirm(self, task: Task, preflight: Preflight, idle: Idle, unverified: tuple[str, ...]) -> None:
        """Call the function in its own thread. The drive's watchdog is fed meanwhile."""
        if preflight.identity.simulated:
            return
        self._display.pause()
        text = motion_summary(preflight, task.limits, task.request, unverified, task.case)
        if _meanwhile(idle, partial(self._ask, text)) is not True:
            raise PreflightRefused("the motion was not confirmed", where="confirm", next_step="Nothing has moved",
                                   entry=MessageCode.NOT_CONFIRMED)
