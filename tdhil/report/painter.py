"""Paints in a thread of its own, so that a terminal that takes nothing (Ctrl-S, a pty nobody reads) holds up nobody.

Whoever asks only leaves a note and goes on: lines are kept in order, up to a number of them, and of pictures the latest
only. The thread is a daemon: it may be stuck in a write for ever, and the process still ends.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable

Job = Callable[[], None]

MOST_LINES = 500
"""Of a terminal that has stopped taking them, the oldest are dropped."""


class Painter:
    """Every method but `flush` returns at once. What fails in a job, if not the terminal itself, a later one raises."""

    def __init__(self) -> None:
        self._lines: deque[Job] = deque(maxlen=MOST_LINES)
        self._picture: Job | None = None
        self._wake = threading.Event()
        self._waiting: deque[threading.Event] = deque()
        self._thread: threading.Thread | None = None
        self._failure: Exception | None = None
        self._gone = False             # the terminal
        self._ending = False

    def line(self, job: Job) -> None:
        """Do this after what was asked for before. Raises what failed earlier."""
        self._check()
        self._lines.append(job)
        self._begin()

    def picture(self, job: Job) -> None:
        """Do this once all lines are done, unless a newer picture comes. Raises what failed earlier."""
        self._check()
        self._picture = job
        self._begin()

    def flush(self, timeout_s: float) -> bool:
        """Wait until all is done, so long at most; whether it is."""
        if self._thread is None:
            return True
        done = threading.Event()
        self._waiting.append(done)
        self._wake.set()
        return done.wait(timeout_s)

    def end(self) -> None:
        """Let the thread go once all is done; whatever is asked for afterwards begins a new one."""
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
            # Taken first: what they wait for was asked for before they came.
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
        except (OSError, ValueError):  # closed, hung up: a run goes on without its display
            self._gone = True
        except Exception as error:
            self._failure = error
