"""Ctrl-C, SIGQUIT, SIGTERM and SIGHUP become a wish to stop, which the control loop sees in its next cycle."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from tdhil.run import StopRequest

_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGBREAK")  # the last three don't exist everywhere


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

    known = [getattr(signal, name) for name in _NAMES if hasattr(signal, name)]
    former = {number: signal.signal(number, handler) for number in known}
    try:
        yield request
    finally:
        for number, before in former.items():
            signal.signal(number, before)
