"""Computations beside the control loop: in a worker process if one is ready, else in a thread of this process.

A process (`tdhil.worker_process`) has its own interpreter and priority: no cycle waits for it. It is started, and has
loaded all modules, before the shaft moves. It ends whenever this process ends. Nothing ever waits for it: when its
answer is not needed any more, it is killed.
"""

from __future__ import annotations

import pickle
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event, Lock, Thread
from typing import Any, Generic, TypeVar

from drivers import SWITCH_S
from tdhil.worker_process import READY, NotSent, WorkerProcess, result_in

T = TypeVar("T")


NICE = 10
"""Increment of the process's nice value over the control loop's. The process must still run beside a busy program."""

READY_S = 60.0
"""Wall time for the process to load its modules, s. tdhil waits, because loading would disturb later steps."""

_REAPED_S = 1.0           # wall time to wait for the end of a killed process, s
_PROGRAM = "from tdhil.runner.background_process import main\nmain()"


class Gone(Exception):
    """The process can't answer: it never started, died, or could not read the request."""


class BackgroundProcess:
    """A worker process for one computation at a time, asked by any thread. ``program``: tests use another one.

    Raises OSError if it can't be started. The owner calls `end`, and `close` when there is time.
    """

    def __init__(self, program: str = _PROGRAM) -> None:
        self._answering = Lock()
        self._process = WorkerProcess(program, quiet=True, yields=True)
        self._ready = Event()
        self._began = False
        Thread(target=self._await_ready, name="tdhil-worker", daemon=True).start()

    @property
    def pid(self) -> int:
        """Return the process id."""
        return self._process.pid

    def wait_ready(self, for_s: float) -> bool | None:
        """Return whether the process is ready. None: not within ``for_s`` of wall time; False: it failed to start."""
        return self._began if self._ready.wait(for_s) else None

    def ask(self, work: Callable[[], T]) -> T:
        """Run ``work`` in the process; return its result or raise its error. No timeout. Raises Gone without an answer.

        ``work`` is pickled: a function of a module, or a `functools.partial` of one with arguments of plain data.
        """
        with self._answering:
            try:
                self._process.send(work)
                answer = self._process.receive()
            except Exception as error:
                raise Gone(f"{type(error).__name__}: {error}") from error
        try:
            result: T = result_in(answer)
        except NotSent as error:
            raise Gone(str(error)) from error
        return result

    def end(self) -> None:
        """Kill the process in any state; returns at once."""
        self._process.kill()

    def close(self) -> None:
        """Kill the process and close its pipes. This takes two seconds at most."""
        self.end()
        self._process.wait(_REAPED_S)
        if self._answering.acquire(timeout=_REAPED_S):
            self._process.close()
            self._answering.release()

    def _await_ready(self) -> None:
        with self._answering:
            try:
                self._began = pickle.loads(self._process.receive()) == READY
            except Exception:       # any failure means not ready
                self._began = False
            finally:
                self._ready.set()


class Background(Generic[T]):
    """A computation that starts at once. Nothing has to wait for it: neither a stop nor the end of the process.

    If ``worker_process`` can't do it, a thread does, and ``instead`` states why. While a thread computes, the control
    loop gets the interpreter sooner than usual, also after the work was dropped. Without ``or_thread``, `result` raises
    Gone instead.
    """

    def __init__(
        self, work: Callable[[], T], worker_process: BackgroundProcess | None = None, *, or_thread: bool = True
    ) -> None:
        self.ended = Event()
        self.instead = ""
        self._work = work
        self._worker_process = worker_process
        self._or_thread = or_thread
        self._dropped = False
        self._found: list[T] = []
        self._failure: BaseException | None = None
        # A pool's threads are joined when the interpreter ends; a daemon thread is not.
        Thread(target=self._run, name="tdhil-beside", daemon=True).start()

    def result(self) -> T:
        """Return the result after the end, or raise the error of the work."""
        if self._failure is not None:
            raise self._failure
        return self._found[0]

    def drop(self) -> None:
        """Drop the work; returns at once."""
        self._dropped = True
        if self._worker_process is not None:
            self._worker_process.end()

    def _run(self) -> None:
        try:
            self._found.append(self._result())
        except BaseException as error:         # raised by `result`
            self._failure = error
        finally:
            self.ended.set()

    def _result(self) -> T:
        if self._worker_process is not None:
            try:
                return self._worker_process.ask(self._work)
            except Gone as gone:
                if self._dropped or not self._or_thread:
                    raise
                self.instead = str(gone)
        with _in_a_thread(self):
            return self._work()


_in_threads: set[Background[Any]] = set()
_entering = Lock()
_usual_s: list[float] = []       # the interpreter's former value, while any thread computes


@contextmanager
def _in_a_thread(work: Background[Any]) -> Iterator[None]:
    """Shorten the interpreter's switch interval with the first thread, and restore it after the last one."""
    with _entering:
        if not _in_threads:
            _usual_s.append(sys.getswitchinterval())
            sys.setswitchinterval(min(_usual_s[0], SWITCH_S))
        _in_threads.add(work)
    try:
        yield
    finally:
        with _entering:
            _in_threads.discard(work)
            if not _in_threads:
                sys.setswitchinterval(_usual_s.pop())


def thread_computes() -> bool:
    """Return whether a dropped computation still runs in a thread of this process.

    The process must then not end in the usual way: on exit the C library ends OpenBLAS, which has been observed to
    wait forever for such a thread.
    """
    return bool(_in_threads)


def begin(
    meanwhile: Callable[[], object], stopped: Callable[[], bool], within_s: float = READY_S, program: str = _PROGRAM
) -> tuple[BackgroundProcess | None, str]:
    """Return a ready process, or None and the reason. Returns None sooner once ``stopped`` returns True.

    It takes as long as Python loads the modules: a second or two, more on a busy computer. ``meanwhile`` runs beside
    it.
    """
    try:
        worker_process = BackgroundProcess(program)
    except (OSError, ValueError, RuntimeError, subprocess.SubprocessError) as error:
        meanwhile()
        return None, f"it can't be started: {error}"
    try:
        meanwhile()
        until_s = time.monotonic() + within_s
        while not stopped():
            ready = worker_process.wait_ready(0.05)
            if ready:
                return worker_process, ""
            if ready is not None:
                worker_process.close()
                return None, "it died while it was loading"
            if time.monotonic() > until_s:
                worker_process.close()
                return None, f"it was not ready within {within_s:g} s"
    except BaseException:
        worker_process.close()
        raise
    worker_process.close()
    return None, "a stop was requested"

