"""Convert each signal that would end the process into a stop request, which the control loop reads in its next cycle.

These are Ctrl-C, Ctrl-Z, SIGQUIT, SIGTERM and SIGHUP in any case. SIGUSR1, SIGALRM, SIGXCPU, the real-time signals and
all others whose default ends a process are added, unless the program that uses tdhil handles or ignores them. Signals
of a broken program (SIGSEGV, SIGBUS, SIGFPE, SIGILL) are left: a handler would return to the same instruction for ever.

The system suspends a background process that reads from or writes to its terminal (SIGTTIN, SIGTTOU). During a run
these signals are ignored: a suspended process would leave a turning shaft to the drive's watchdog, if it has one.
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
"""Signals that are ignored by default."""
_OUT_OF_REACH = ("SIGKILL", "SIGSTOP", "SIGSEGV", "SIGBUS", "SIGFPE", "SIGILL")


def _numbers(names: tuple[str, ...]) -> set[int]:
    return {int(getattr(signal, name)) for name in names if hasattr(signal, name)}


def _others() -> list[int]:
    """Return the numbers of all other signals that would now end this process or raise in it (`Ending`)."""
    known = _numbers((*_NAMES, *_UNHEARD, *_HARMLESS, *_OUT_OF_REACH))
    return sorted(int(one) for one in signal.valid_signals() if one not in known and _ends(signal.getsignal(one)))


def _ends(handler: object) -> bool:
    return handler is signal.SIG_DFL or isinstance(getattr(handler, "__self__", None), Ending)


@contextmanager
def stop_on_signals(request: StopRequest | None = None) -> Iterator[StopRequest]:
    """Install handlers that set ``request``, or a new one. The former handlers are restored afterwards.

    A second Ctrl-C changes nothing. Python delivers signals to the main thread. In another thread no handler is
    installed, and only ``request`` stops.
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

    During the evaluation the first signal raises Interrupted. After a signal has ended the run (``request``, which the
    run receives), or after `calm`, no signal interrupts any more: the log is closed and the result is printed. In a
    process of tdhil's own (`own_process`) signals are ignored from the end on. The interpreter restores the defaults
    when it exits, and the next signal would then kill it.
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
        """Return all signals except Ctrl-Z: a process may be suspended when no shaft depends on it any more."""
        return *sorted(_numbers(_NAMES) - _numbers(("SIGTSTP",))), *_others()

    def calm(self) -> None:
        """Ignore further signals, so that the remaining work is finished."""
        self._calm = True

    def code(self, code: int) -> int:
        """Return the exit code of a command that ended with ``code``: a signal's code if ``code`` is 0."""
        return code if code or self.signum is None else int(Interrupted(self.signum).exit_code)

    def _on_signal(self, signum: int, frame: FrameType | None) -> None:
        first, self.signum = self.signum is None, self.signum or signum
        if first and not self._calm and self.request.signum is None:
            self._calm = True
            raise Interrupted(signum)
