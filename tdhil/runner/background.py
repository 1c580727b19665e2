"""Arithmetic beside the control loop: in a process of its own where one stands ready, else in a thread of this one.

A process has an interpreter and a priority of its own: no cycle waits for what it reckons. It is started and has loaded
all it needs before the shaft moves, gets its work as pickles through a pipe, and answers through another. It inherits
neither sockets nor signal handlers nor threads, since it begins as a new program; it ends when its pipe does, which is
when this process ends, however that comes about; and nobody ever waits for it: where its answer isn't wanted any more
it is killed.
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

from tdhil.process_pool import ONE_CORE

T = TypeVar("T")

SWITCH_S = 0.0005
"""How long arithmetic in a thread of this process may keep the interpreter to itself."""

NICE = 10
"""By how much the process is nicer than the control loop. It is no hog, but it must not starve beside one either."""

READY_S = 60.0
"""Wall time that the process gets to load what it needs. It is waited for: loading would disturb what follows."""

READY = b"ready"
_REAPED_S = 1.0           # wall time that a killed process gets to be gone; it is left to itself then
_PROGRAM = (
    "import pickle, sys\n"
    "sys.path[:] = pickle.load(sys.stdin.buffer)\n"
    "from tdhil.runner.background_process import serve\n"
    "serve()\n"
)


class Gone(Exception):
    """The process can't answer: it never began, died, or did not understand what it was asked."""


class WorkerProcess:
    """A process of its own for arithmetic. ``program`` is what it runs, for tests.

    Raises OSError where it can't be started. Whoever made one calls `end`, and `close` when nothing hurries any more.
    """

    def __init__(self, program: str = _PROGRAM) -> None:
        if not sys.executable:
            raise FileNotFoundError("where this Python lies is not known")
        self._answering = Lock()
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", program],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            env=os.environ | ONE_CORE, **_out_of_the_way(),      # the other cores are the control loop's
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
        """Of the process."""
        return self._process.pid

    def wait_ready(self, for_s: float) -> bool | None:
        """Has it loaded all it needs? None: not within ``for_s`` of wall time; False: it never will."""
        return self._began if self._ready.wait(for_s) else None

    def ask(self, work: Callable[[], T]) -> T:
        """What ``work`` gives, or raises what it raises; as long as it takes. Raises Gone where nothing comes of it.

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
        """Kill it, whatever it does; returns at once."""
        with suppress(OSError):
            self._process.kill()

    def close(self) -> None:
        """Kill it, and tidy up behind it: pipes and all. Takes a moment, a second at the very most."""
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
            except Exception:       # however that fails: it is not ready
                self._began = False
            finally:
                self._ready.set()


class Background(Generic[T]):
    """One piece of work, begun at once, that nobody has to wait for: neither a stop nor the process's end.

    Where ``worker_process`` can't do it, a thread does, and ``instead`` says why. As long as a thread is at it, whoever
    controls the shaft gets the interpreter sooner than usual, also once the work has been left alone.
    """

    def __init__(self, work: Callable[[], T], worker_process: WorkerProcess | None = None) -> None:
        self.ended = Event()
        self.instead = ""
        self._work = work
        self._worker_process = worker_process
        self._dropped = False
        self._found: list[T] = []
        self._failure: BaseException | None = None
        # A pool's threads are joined when the interpreter ends; a daemon is not.
        Thread(target=self._run, name="tdhil-beside", daemon=True).start()

    def result(self) -> T:
        """Once it has ended: what it gave, or raises what it raised."""
        if self._failure is not None:
            raise self._failure
        return self._found[0]

    def drop(self) -> None:
        """Nobody asks any more; returns at once."""
        self._dropped = True
        if self._worker_process is not None:
            self._worker_process.end()

    def _run(self) -> None:
        try:
            self._found.append(self._reckon())
        except BaseException as error:         # raised where the result is asked for
            self._failure = error
        finally:
            self.ended.set()

    def _reckon(self) -> T:
        if self._worker_process is not None:
            try:
                return self._worker_process.ask(self._work)
            except Gone as gone:
                if self._dropped:
                    raise
                self.instead = str(gone)
        with _in_a_thread(self):
            return self._work()


_in_threads: set[Background[Any]] = set()
_entering = Lock()
_usual_s: list[float] = []       # the interpreter's own, while any thread is at it


@contextmanager
def _in_a_thread(work: Background[Any]) -> Iterator[None]:
    """The first one in has the interpreter handed over sooner, the last one out gives back what was usual."""
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
    """Is a thread of this process still at arithmetic that was left alone? Then the process must not end in the usual
    way: on its way out the C library calls OpenBLAS's end, which has been seen to wait for ever for such a thread.
    """
    return bool(_in_threads)


def begin(
    meanwhile: Callable[[], object], stopped: Callable[[], bool], within_s: float = READY_S, program: str = _PROGRAM
) -> tuple[WorkerProcess | None, str]:
    """A process that stands ready, or None and why there is none. Ends sooner, with None, once ``stopped`` says so.

    Takes as long as Python takes to load what the plan needs: a second or two, more on a busy computer; ``meanwhile``
    is done beside it.
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
    return None, "a stop was asked for"


def _out_of_the_way() -> dict[str, Any]:
    """Ctrl-C at the terminal is for this process alone. The same session: where each is weighed, nice means nothing."""
    if sys.platform == "win32":
        flags = subprocess.CREATE_NEW_PROCESS_GROUP | subprocess.CREATE_NO_WINDOW
        return {"creationflags": flags | subprocess.BELOW_NORMAL_PRIORITY_CLASS}
    return {"process_group": 0}
