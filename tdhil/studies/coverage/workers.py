"""Work over several processes, which a Ctrl-C in the terminal does not reach and which don't outlive their host.

Each worker is a Python in a process group of its own from its first instruction: a terminal sends Ctrl-C to the group
in its foreground, so no worker is hit by it, not even one that is still importing. Tasks come one at a time over its
stdin, results go over its stdout; no thread and no lock is shared, so that it can be killed at any moment. The end of
its stdin ends it, however the host came to its own.

Not `concurrent.futures.ProcessPoolExecutor`: after an interruption, both the end of its ``with`` and the end of the
interpreter wait for a thread that may not have seen that the waiting tasks were cancelled, and then does all of them.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from selectors import EVENT_READ, DefaultSelector
from typing import Any, TypeVar

from tdhil.errors import TdhilError

Task = TypeVar("Task")
Result = TypeVar("Result")

_PROGRAM = "import sys; sys.path[:] = {path!r}; from tdhil.studies.coverage.workers import serve; serve()"


def results(function: Callable[[Task], Result], wanted: Sequence[Task], processes: int) -> Iterator[Result]:
    """``function`` of every task, as they are done. It is told by its name, so it must be one of a module.

    What it raises is raised here; TdhilError where a worker has died. When this ends or is closed all workers are
    gone, at once and without what they had in hand.
    """
    waiting = iter(wanted)
    workers: list[_Worker] = []
    try:
        with DefaultSelector() as answers:
            for _, task in zip(range(processes), waiting, strict=False):
                workers.append(worker := _Worker())
                worker.give(function, task)
                answers.register(worker.stdout, EVENT_READ, worker)
            while answers.get_map():
                for key, _ in answers.select():
                    worker = key.data
                    answer = worker.take()
                    for task in waiting:
                        worker.give(function, task)
                        break
                    else:
                        answers.unregister(worker.stdout)
                    yield answer
    finally:
        for worker in workers:
            worker.kill()


class _Worker:
    """One process, idle or with one task in hand."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", _PROGRAM.format(path=sys.path)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, process_group=0,
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._stdin, self.stdout = self._process.stdin, self._process.stdout

    def give(self, function: Callable[[Task], Any], task: Task) -> None:
        try:
            pickle.dump((function, task), self._stdin)
            self._stdin.flush()
        except BrokenPipeError:
            raise self._died() from None

    def take(self) -> Any:
        """The result; waits until all of it is there."""
        try:
            failed, answer = pickle.load(self.stdout)
        except (EOFError, pickle.UnpicklingError):
            raise self._died() from None
        if failed:
            raise answer
        return answer

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()
        for pipe in (self._stdin, self.stdout):
            with suppress(OSError):     # half a task may still wait to be written
                pipe.close()

    def _died(self) -> TdhilError:
        self._process.kill()
        code = self._process.wait()
        return TdhilError(
            f"a process that worked for it died (exit code {code})", where=f"process {self._process.pid}",
            next_step="If memory was short, let fewer of them work at a time, such as --set processes=1",
        )


def serve() -> None:
    """In a worker: one task after the other, until the host closes the pipes or is gone."""
    with suppress(BrokenPipeError), os.fdopen(os.dup(1), "wb") as answers:
        os.dup2(2, 1)           # whatever else is printed is no result
        while True:
            try:
                function, task = pickle.load(sys.stdin.buffer)
            except (EOFError, pickle.UnpicklingError):
                return
            try:
                answer = (False, function(task))
            except Exception as error:
                error.add_note("In a process of its own:\n" + traceback.format_exc())
                answer = (True, error)
            pickle.dump(answer, answers)
            answers.flush()
