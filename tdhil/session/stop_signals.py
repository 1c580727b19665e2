"""Ctrl-C, SIGQUIT, SIGTERM and SIGHUP become a wish to stop, which the control loop sees in its next cycle."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from tdhil.run import StopRequest

_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGBREAK")  # the last three don't exist everywhere


@contextmanager
def stop_on_signals() -> Iterator[StopRequest]:
    """Handlers that only note the wish; the former ones come back afterwards. A second Ctrl-C changes nothing."""
    request = StopRequest()

    def handler(signum: int, frame: FrameType | None) -> None:
        request.ask(signum)

    known = [getattr(signal, name) for name in _NAMES if hasattr(signal, name)]
    former = {number: signal.signal(number, handler) for number in known}
    try:
        yield request
    finally:
        for number, before in former.items():
            signal.signal(number, before)
