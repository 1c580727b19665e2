"""Computations beside the control loop: in a worker process if one is ready, else in a thread of this process.

A process has its own interpreter and priority: no cycle waits for it. It is started, and has loaded all modules, before
the shaft moves. It receives work as pickles through a pipe, and answers through another. As a new program it inherits
neither sockets nor signal handlers nor threads. It ends when its pipe is closed, and so whenever this process ends.
Nothing ever waits for it: when its answer is not needed any more, it is killed.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from threading import Event, Lock, Thread
from typing import IO, Any, Generic, TypeVar

from tdhil.numerics import ONE_THREAD

T = TypeVar("T")

SWITCH_S = 0.0005
"""Longest time for which a computing thread of this process may hold the interpreter, s."""

NICE = 10
"""Increment of the process's nice value over the control loop's. The process must still run beside a busy program."""

READY_S = 60.0
"""Wall time for the process to load its modules, s. tdhil waits, because loading would disturb later steps."""

READY = b"ready"
_REAPED_S = 1.0           # wall time to wait for the end of a killed process, s
_PROGRAM = (
    "import pickle, sys\n"
    "sys.path[:] = pickle.load(sys.stdin.buffer)\n"
    "from tdhil.runner.background_process import serve\n"
    "serve()\n"
)


class Gone(Exception):
    """The process can't answer: it never started, died, or could not read the request."""


class WorkerProcess:
    """A worker process for computations. ``program``: its Python program; tests use another one.

    Raises OSError if it can't be started. The owner calls `end`, and `close` when there is time.
    """

    def __init__(self, program: str = _PROGRAM) -> None:
        if not sys.executable:
            raise FileNotFoundError("the path of the Python interpreter is unknown")
        self._answering = Lock()
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", program],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            env=os.environ | ONE_THREAD, **_out_of_the_way(),      # the other cores are for the control loop
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._questions: IO[bytes] = self._process.stdin
        self._answers: IO[bytes] = self._process.stdout
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
                question = pickle.dumps(work)
                pickle.dump(question, self._questions)
                self._questions.flush()
                kind, answer = pickle.load(self._answers)
                found = pickle.loads(answer)
            except Exception as error:
                raise Gone(f"{type(error).__name__}: {error}") from error
        if kind == "unfit":
            raise Gone(str(found))
        if kind == "raised":
            assert isinstance(found, BaseException)
            raise found
        result: T = found
        return result

    def end(self) -> None:
        """Kill the process in any state; returns at once."""
        with suppress(OSError):
            self._process.kill()

    def close(self) -> None:
        """Kill the process and close its pipes. This takes two seconds at most."""
        self.end()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_REAPED_S)
        if self._answering.acquire(timeout=_REAPED_S):
            for pipe in (self._questions, self._answers):
                with suppress(OSError):
                    pipe.close()
            self._answering.release()

    def _await_ready(self) -> None:
        with self._answering:
            try:
                pickle.dump(sys.path, self._questions)
                self._questions.flush()
                self._began = pickle.load(self._answers) == READY
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
        self, work: Callable[[], T], worker_process: WorkerProcess | None = None, *, or_thread: bool = True
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
            self._found.append(self._reckon())
        except BaseException as error:         # raised by `result`
            self._failure = error
        finally:
            self.ended.set()

    def _reckon(self) -> T:
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


def goes_on() -> bool:
    """Return whether a dropped computation still runs in a thread of this process.

    The process must then not end in the usual way: on exit the C library ends OpenBLAS, which has been observed to
    wait forever for such a thread.
    """
    return bool(_in_threads)


def begin(
    meanwhile: Callable[[], object], stopped: Callable[[], bool], within_s: float = READY_S, program: str = _PROGRAM
) -> tuple[WorkerProcess | None, str]:
    """Return a ready process, or None and the reason. Returns None sooner once ``stopped`` returns True.

    It takes as long as Python loads the modules: a second or two, more on a busy computer. ``meanwhile`` runs beside
    it.
    """
    try:
        worker_process = WorkerProcess(program)
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


def _out_of_the_way() -> dict[str, Any]:
    """Keep Ctrl-C from the process. It stays in the same session: across sessions nice values have no effect."""
    if sys.platform == "win32":
        flags = subprocess.CREATE_NEW_PROCESS_GROUP | subprocess.CREATE_NO_WINDOW
        return {"creationflags": flags | subprocess.BELOW_NORMAL_PRIORITY_CLASS}
    return {"process_group": 0}
