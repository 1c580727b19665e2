"""Ctrl-C, Ctrl-Z, SIGQUIT, SIGTERM and SIGHUP become a wish to stop, which the control loop sees in its next cycle.

A program in the background that asks its terminal something is stopped by the system where it stands (SIGTTIN,
SIGTTOU). Meanwhile it isn't: a turning shaft must not be left to the drive's watchdog, if it has one, by that.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from tdhil.run import StopRequest

_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP", "SIGBREAK")  # the last four don't exist everywhere
_UNHEARD = ("SIGTTIN", "SIGTTOU")


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

    wanted = dict.fromkeys(_NAMES, handler) | dict.fromkeys(_UNHEARD, signal.SIG_IGN)
    known = {getattr(signal, name): what for name, what in wanted.items() if hasattr(signal, name)}
    former = {number: signal.signal(number, what) for number, what in known.items()}
    try:
        yield request
    finally:
        for number, before in former.items():
            signal.signal(number, signal.SIG_DFL if before is None else before)    # None: not set by Python
