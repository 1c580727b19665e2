"""The typed confirmation before a real shaft moves. While it waits, the drive's watchdog is fed."""

from __future__ import annotations

import math
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from functools import partial
from typing import TypeVar

from rich.console import Console

from drivers import ACCEPTED_BY, ANY_CLIENT, NOTHING_STOPS_IT, Preflight, PreflightRefused
from profiles import visible
from profiles.quantities import RPM
from tdhil.report import LiveDisplay, minutes
from tdhil.runner import Display, ExcitationRequest, Idle, MachineLimits, Task

T = TypeVar("T")

WORD = "MOVE"
SPEED_FLAG = "--accept-speed-unit"
_UNWATCHED = "  [ ] somebody stands at that stop for the whole run: nothing else stops the shaft if this host fails\n"
_SHARED = (
    "  [ ] every other client of this drive is switched off (PLC, panel, historian, gateway), and somebody stands at\n"
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
    """Return if the shaft may be moved; raises PreflightRefused (exit 4) if not.

    A simulated peer needs no confirmation. ``--yes`` replaces the prompt, not the limits.
    """
    if preflight.identity.simulated:
        return
    pause_display()
    console.print(motion_summary(preflight, task.limits, task.request, unverified), markup=False)
    if yes:
        console.print("Confirmed by --yes.")
        return
    if sys.stdin is None or not sys.stdin.isatty():
        raise PreflightRefused(
            "nobody is there to confirm that the shaft may move",
            where="no terminal",
            next_step="Run it at a terminal, or pass --yes if somebody stands at the hard-wired stop",
        )
    _forget_what_was_typed()
    console.print(f"Type {WORD} and Enter to turn the shaft, anything else to leave it alone: ", end="")
    if _ask(idle).strip() != WORD:
        raise PreflightRefused("not confirmed", where="prompt", next_step="Nothing has moved")


def confirm_speed(
    speed_rad_s: float,
    why: str,
    idle: Idle,
    *,
    console: Console,
    pause_display: Callable[[], None],
    gear_ratio: float = 1.0,
) -> None:
    """Return if the operator sees the shaft turn as fast as the drive reports; PreflightRefused (exit 4) if not.

    Asked while the shaft turns, one cycle after the other; ``--yes`` is no answer to it.
    """
    turning = turns_text(speed_rad_s)
    if sys.stdin is None or not sys.stdin.isatty():
        raise PreflightRefused(
            f"nobody is there to see whether the shaft turns {turning}, as the drive reports ({why})",
            where="no terminal",
            next_step="Run it at a terminal, where somebody sees the shaft; say in the profile where the drive tells"
            f" its angle (position); or take the unit of speed by name: {SPEED_FLAG}",
        )
    main = f" (the main shaft, behind the gear, {turns_text(speed_rad_s / gear_ratio)})" if gear_ratio != 1.0 else ""

    def ask() -> str:
        """In the thread that waits, and the display's last words too: a terminal that takes nothing holds no cycle."""
        pause_display()
        _forget_what_was_typed()
        console.print(
            f"\nThe shaft turns, and {why}.\n"
            f"The drive reports {speed_rad_s:.3g} rad/s: watch a mark on the motor's shaft for some turns.",
            markup=False,
        )
        console.print(
            f"Is it turning {turning}{main}? Type yes and Enter; anything else stops it: ", end="", markup=False
        )
        return _line()

    answer = _meanwhile(idle, ask).strip().lower()
    if answer not in ("y", "yes"):
        raise PreflightRefused(
            f"the shaft was not seen to turn {turning}, as the drive reports: its unit of speed is not what the profile"
            " says",
            where="prompt",
            next_step="Check the speed scaling in the profile: how long one turn really takes, against what was asked,"
            " is the factor",
        )


def turns_text(speed_rad_s: float) -> str:
    """A speed as somebody with a watch sees it."""
    way = "forward" if speed_rad_s >= 0.0 else "backwards"
    turn_s = 2.0 * math.pi / max(abs(speed_rad_s), 1e-9)
    if turn_s >= 2.0:
        return f"{way} once every {turn_s:.3g} s"
    return f"{way} {10.0 / turn_s:.3g} times in 10 s"


def motion_summary(
    preflight: Preflight, limits: MachineLimits, request: ExcitationRequest, unverified: Sequence[str] = ()
) -> str:
    """What will happen, and what the operator must have seen to. ``unverified``: what he took of the profile."""
    silent = f"{preflight.watchdog_s:g} s in the drive, then {preflight.safe_action.replace('_', ' ')}"
    watchdog, seen_to = (silent, "") if preflight.watched else (f"NONE, {ACCEPTED_BY}: {NOTHING_STOPS_IT}", _UNWATCHED)
    if preflight.watched and preflight.fed_by_any_client:
        watchdog, seen_to = f"{silent}; but {ANY_CLIENT}", _SHARED
    return (
        f"\nThis run will move {visible(preflight.identity.name)}:\n"
        f"  sign probe      torque up to {limits.probe_torque_nm:g} N·m, at most {limits.probe_travel_rad:g} rad\n"
        f"  speed window    {limits.speed_min_rad_s:.4g} to {limits.speed_max_rad_s:.4g} rad/s "
        f"({RPM.of_si(limits.speed_min_rad_s):.4g} to {RPM.of_si(limits.speed_max_rad_s):.4g} rpm)\n"
        f"  peak torque     {limits.torque_nm:g} N·m\n"
        f"  excitation      {request.kind}\n"
        f"  duration        at most {minutes(limits.time_s)}\n"
        f"  watchdog        {watchdog}\n"
        f"{_taken(unverified)}"
        "Before you confirm:\n"
        "  [ ] brake released\n"
        "  [ ] pipe handler and people clear of the shaft\n"
        "  [ ] hard-wired emergency stop tested and within reach (Ctrl-C stops, but is no emergency stop)\n"
        f"{seen_to}"
    )


def _taken(unverified: Sequence[str]) -> str:
    if not unverified:
        return ""
    lines = "".join(f"  {visible(one)}\n" for one in unverified)
    return f"Taken as the profile has it, although nobody verified it:\n{lines}"


def _ask(idle: Idle) -> str:
    """A line from the terminal. Raises PreflightRefused where it can't be read, as by a program in the background."""
    return _meanwhile(idle, _line)


def _forget_what_was_typed() -> None:
    """What was typed before the question was asked is no answer to it."""
    with suppress(ImportError, OSError, ValueError):
        import termios

        with suppress(termios.error):
            termios.tcflush(sys.stdin.fileno(), termios.TCIFLUSH)


def _line() -> str:
    try:
        return sys.stdin.readline()
    except OSError as error:
        raise PreflightRefused(
            f"the terminal can't be asked: {error.strerror or error}", where="terminal",
            next_step="Run it in the foreground, at a terminal",
        ) from error


def _meanwhile(idle: Idle, ask: Callable[[], T]) -> T:
    """What ``ask`` gives, or raises what it raises: done in a thread, with a cycle of nothing again and again."""
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
    """Whoever sits at the terminal: sees the run there, types the confirmation, watches the shaft."""

    def __init__(self, console: Console, *, yes: bool = False, gear_ratio: float = 1.0) -> None:
        self._console = console
        self._yes = yes
        self._gear_ratio = gear_ratio
        self._display = LiveDisplay(console, show_preflight=False)
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
    """The same, but a function of the caller's confirms motion: it is given in words what will move."""

    def __init__(self, console: Console, ask: Callable[[str], bool], *, gear_ratio: float = 1.0) -> None:
        super().__init__(console, gear_ratio=gear_ratio)
        self._ask = ask

    def confirm(self, task: Task, preflight: Preflight, idle: Idle, unverified: tuple[str, ...]) -> None:
        """Ask in a thread of its own: the drive's watchdog is fed meanwhile."""
        if preflight.identity.simulated:
            return
        self._display.pause()
        text = motion_summary(preflight, task.limits, task.request, unverified)
        if _meanwhile(idle, partial(self._ask, text)) is not True:
            raise PreflightRefused("not confirmed", where="confirm", next_step="Nothing has moved")
