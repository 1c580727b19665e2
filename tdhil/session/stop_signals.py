"""Each signal that would end the process becomes a request to stop, which the control loop sees in its next cycle.

Ctrl-C, Ctrl-Z, SIGQUIT, SIGTERM and SIGHUP in any case; SIGUSR1, SIGALRM, SIGXCPU, the real-time signals and all others
whose default ends a process, unless the program that uses tdhil handles or ignores them. Not those that a processor
raises for a broken program (SIGSEGV, SIGBUS, SIGFPE, SIGILL): a handler would return to the same instruction for ever.

A program in the background that asks its terminal something is stopped by the system where it stands (SIGTTIN,
SIGTTOU). Meanwhile it isn't: a turning shaft must not be left to the drive's watchdog, if it has one, by that.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from types import FrameType
from typing import Any, Self

from tdhil.errors import Interrupted
from tdhil.runner import StopRequest

_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP", "SIGBREAK")  # the last four don't exist everywhere
_UNHEARD = ("SIGTTIN", "SIGTTOU")
_HARMLESS = ("SIGCHLD", "SIGCLD", "SIGCONT", "SIGURG", "SIGWINCH", "SIGINFO")
"""Their default is to be ignored."""
_OUT_OF_REACH = ("SIGKILL", "SIGSTOP", "SIGSEGV", "SIGBUS", "SIGFPE", "SIGILL")


def _numbers(names: tuple[str, ...]) -> set[int]:
    return {int(getattr(signal, name)) for name in names if hasattr(signal, name)}


def _others() -> list[int]:
    """Numbers of all other signals that would end this process, or raise in it (`Ending`), as they stand now."""
    known = _numbers((*_NAMES, *_UNHEARD, *_HARMLESS, *_OUT_OF_REACH))
    return sorted(int(one) for one in signal.valid_signals() if one not in known and _ends(signal.getsignal(one)))


def _ends(handler: object) -> bool:
    return handler is signal.SIG_DFL or isinstance(getattr(handler, "__self__", None), Ending)


@contextmanager
def stop_on_signals(request: StopRequest | None = None) -> Iterator[StopRequest]:
    """Handlers that only note the wish, in ``request`` or one of its own; the former ones come back afterwards.

    A second Ctrl-C changes nothing. Python hands signals to the main thread: in another one they stay with whoever has
    that, and only ``request`` stops.
    """
    request = StopRequest() if request is None else request
    if threading.current_thread() is not threading.main_thread():
        yield request
        return

    def handler(signum: int, frame: FrameType | None) -> None:
        request.ask(signum)

    former = {number: signal.signal(number, handler) for number in (*_numbers(_NAMES), *_others())}
    former |= {number: signal.signal(number, signal.SIG_IGN) for number in _numbers(_UNHEARD)}
    try:
        yield request
    finally:
        _restore(former)


def _restore(former: Mapping[int, Any]) -> None:
    for number, before in former.items():
        signal.signal(number, signal.SIG_DFL if before is None else before)    # None: not set by Python


class Ending:
    """The signals of a command that runs a shaft, from before the run until the process has ended.

    While a result is worked out the first signal raises Interrupted. Once a signal has ended the run (``request``,
    which the run is given), or `calm` was called, none interrupts any more: the log is closed and what was found is
    said, however many come. In a process of tdhil's own (`own_process`) they
    are ignored from the end on: the interpreter, which gives them back their defaults, would be killed by the next.
    """

    def __init__(self, *, own_process: bool) -> None:
        self._own_process = own_process
        self.signum: int | None = None
        self.request = StopRequest()
        self._calm = False
        self._former: dict[int, Any] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            self._former = {one: signal.signal(one, self._on_signal) for one in self._wanted()}
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, where: object) -> None:
        if self._own_process and self._former:
            self._former = dict.fromkeys(self._former, signal.SIG_IGN)
        _restore(self._former)

    @staticmethod
    def _wanted() -> tuple[int, ...]:
        """All but Ctrl-Z: a process that no shaft depends on any more may be suspended."""
        return *sorted(_numbers(_NAMES) - _numbers(("SIGTSTP",))), *_others()

    def calm(self) -> None:
        """Finish what is left, whatever signal comes."""
        self._calm = True

    def code(self, code: int) -> int:
        """Return the exit code of a command that ended with ``code``: a signal shows where all else went well."""
        return code if code or self.signum is None else int(Interrupted(self.signum).exit_code)

    def _on_signal(self, signum: int, frame: FrameType | None) -> None:
        first, self.signum = self.signum is None, self.signum or signum
        if first and not self._calm and self.request.signum is None:
            self._calm = True
            raise Interrupted(signum)
