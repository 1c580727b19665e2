"""A pool of worker processes that continues if a task ends or blocks its process (`tdhil.worker_process`).

A task has a time limit: the host kills the process. It also has a memory limit, which the process sets itself. A task
that ends its process or exceeds its time is tried once more, after all others, and then becomes a `Loss`. A process
that was killed from outside (SIGKILL, SIGTERM) counts against its task only after `_KILLS` times.

`concurrent.futures` is not used: one dead process breaks its pool and all tasks, and after an interruption it computes
all waiting tasks. joblib does the same. With twenty logs, one of which kills its process, they finished 7 and none.
"""

from __future__ import annotations

import math
import os
import signal
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from selectors import EVENT_READ, DefaultSelector
from typing import Any, Final, Generic, Self, TypeVar

from tdhil.errors import MessageCode, TdhilError
from tdhil.worker_process import WorkerProcess, result_in

Task = TypeVar("Task")
Result = TypeVar("Result")

# The comment names the pool in lists of processes.
_PROGRAM: Final = "from tdhil.worker_process import serve; serve(memory_bytes={memory!r})    # tdhil.process_pool"
_TRIES: Final = 2
_KILLS: Final = 5
_END_S: Final = 5.0             # longest time for the end of a process that has closed its stdout, s
_ASK_S: Final = 0.2             # interval of the check for a stop, s
_START_S: Final = 60.0          # longest time for the start of a process, on a busy machine, s
_STARTS: Final = 3              # consecutive processes that end before a task: the fault is not a task's


@dataclass(frozen=True)
class TaskLimits:
    """Limits of a task. ``time_s``: wall time. ``memory_bytes``: additional memory above that of a new process, if the
    system supports a limit. None: no limit.
    """

    time_s: float | None = 120.0
    memory_bytes: int | None = 1_500_000_000


@dataclass(frozen=True)
class Loss:
    """Reason why a task has no result. ``kind``: TimeLimit or ProcessDied; ``text``: in words."""

    kind: str
    text: str


@dataclass
class _Job(Generic[Task]):
    task: Task
    faults: int = 0
    kills: int = 0


def usable_cores() -> int:
    """Return the number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Pool(Generic[Task, Result]):
    """Pool of ``jobs`` processes that call ``function``, a module's function passed by name. They start when needed."""

    def __init__(self, function: Callable[[Task], Result], jobs: int, limits: TaskLimits) -> None:
        self._function = function
        self._jobs = max(1, jobs)
        self._limits = limits
        self._workers: list[_Worker] = []

    def run(
        self, tasks: Iterable[Task], stop: Callable[[], bool] | None = None
    ) -> Iterator[tuple[Task, Result | Loss]]:
        """Yield each task with its result or its loss, in the order of completion.

        ``stop`` is called several times a second: True ends the run at once, and tasks in progress are dropped.
        Raises TdhilError if no process can be started, and each error of ``function``. A caller that stops
        early must call `close`.
        """
        fresh = iter(tasks)
        again: deque[_Job[Task]] = deque()
        stillborn = 0
        with DefaultSelector() as answers:
            for worker in self._workers:
                worker.job = None
                answers.register(worker.process.stdout, EVENT_READ, worker)
            while True:
                if stop is not None and stop():
                    return
                more = self._feed(fresh, again, answers)
                busy = [worker for worker in self._workers if worker.job is not None]
                if not busy and not more:
                    return
                now_s = time.monotonic()
                next_s = min((worker.deadline_s for worker in busy), default=now_s + 1.0)
                if stop is not None:
                    next_s = min(next_s, now_s + _ASK_S)
                wait_s = None if math.isinf(next_s) else max(0.0, next_s - now_s)
                ready = {key.data for key, _ in answers.select(wait_s)}
                now_s = time.monotonic()
                for worker in ready.difference(busy):
                    answers.unregister(worker.process.stdout)      # an idle process that has ended
                    self._workers.remove(worker)
                    worker.kill()
                for worker in busy:
                    job = worker.job
                    assert job is not None
                    late = worker not in ready and now_s >= worker.deadline_s
                    answer: Any = worker.take() if worker in ready else _DEAD if late else _PART
                    if answer is _PART:
                        continue
                    if answer is not _DEAD:
                        worker.job = None
                        result: Result = answer
                        yield job.task, result
                        continue
                    answers.unregister(worker.process.stdout)
                    self._workers.remove(worker)
                    loss, outside = worker.reason_of_end(late, self._limits)
                    stillborn = 0 if worker.awake else stillborn + 1
                    if stillborn > _STARTS * self._jobs:
                        raise TdhilError(f"the processes end before they begin: {loss.text}", where="process pool",
                                         next_step="Look for memory and for `ulimit -v`",
                                         entry=MessageCode.WORKER_PROCESS_LOST)
                    job.kills += outside
                    job.faults += not outside
                    if job.faults < _TRIES and job.kills < _KILLS:
                        again.append(job)
                    else:
                        yield job.task, loss

    def _feed(self, fresh: Iterator[Task], again: deque[_Job[Task]], answers: DefaultSelector) -> bool:
        """Give each idle process a task. Start more processes while tasks remain. Return False without a task."""
        while True:
            worker = next((one for one in self._workers if one.job is None), None)
            if worker is None and len(self._workers) >= self._jobs:
                return True
            try:
                job: _Job[Task] = _Job(next(fresh))
            except StopIteration:
                if not again:
                    return False
                job = again.popleft()
            if worker is None:
                worker = _Worker(self._limits)
                self._workers.append(worker)
                answers.register(worker.process.stdout, EVENT_READ, worker)
            worker.give(self._function, job, self._limits.time_s)

    def pids(self) -> list[int]:
        """Return the ids of the present worker processes."""
        return [worker.process.pid for worker in self._workers]

    def close(self) -> None:
        """End all worker processes at once. Tasks in progress are dropped."""
        while self._workers:
            self._workers.pop().kill()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


_PART: Final = object()         # the result has not arrived completely
_DEAD: Final = object()


class _Worker:
    """One worker process, idle or with one task."""

    def __init__(self, limits: TaskLimits) -> None:
        self.job: _Job[Any] | None = None
        self.deadline_s = 0.0
        self.awake = False
        self._time_s = 0.0
        self.process = WorkerProcess(_PROGRAM.format(memory=limits.memory_bytes))

    def give(self, function: Callable[[Any], Any], job: _Job[Any], limit_s: float | None) -> None:
        time_s = math.inf if limit_s is None else limit_s
        self.job, self._time_s = job, time_s
        self.deadline_s = time.monotonic() + (time_s if self.awake else max(time_s, _START_S))
        with suppress(BrokenPipeError):        # an ended process is found by the end of its stdout
            self.process.send(partial(function, job.task))

    def take(self) -> Any:
        """Return the result; `_PART` if incomplete, `_DEAD` if the process has ended. Raises the function's error."""
        try:
            message = self.process.received()
        except EOFError:
            return _DEAD
        if message is not None and not self.awake:     # message: ready; more may have come with it
            self.awake, self.deadline_s = True, time.monotonic() + self._time_s
            message = self.process.kept()
        return _PART if message is None else result_in(message)

    def reason_of_end(self, late: bool, limits: TaskLimits) -> tuple[Loss, bool]:
        """Return the reason of the process's end, and whether it was killed from outside."""
        if late:
            self.kill()
            return Loss("TimeLimit", f"no result within {limits.time_s:g} s, in each of {_TRIES} tries"), False
        self.process.wait(_END_S)
        code = self.kill()
        outside = code in (-int(getattr(signal, "SIGKILL", 9)), -int(signal.SIGTERM))
        reason = f"exit code {code}" if code >= 0 else _signal_name(-code)
        tries = _KILLS if outside else _TRIES
        return Loss("ProcessDied", f"its process ended ({reason}), in each of {tries} tries"), outside

    def kill(self) -> int:
        """Kill the process, if it has not ended, and return its exit code."""
        self.process.kill()
        code = self.process.wait(None)
        assert code is not None
        self.process.close()
        return code


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
