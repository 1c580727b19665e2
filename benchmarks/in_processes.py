"""Tasks of a long study in several processes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import TypeVar

TASKS_PER_PROCESS = 50
"""The processes are replaced after this many tasks each, so that their memory stays small."""

Task = TypeVar("Task")
Result = TypeVar("Result")


def in_processes(work: Callable[[Task], Result], tasks: Sequence[Task], jobs: int) -> Iterator[Result]:
    """Yield the results of ``work`` in the order of the tasks; with one job, from this process.

    Each part of the tasks has a pool of its own. ``max_tasks_per_child`` is not used: the pool hangs if all processes
    end at once (CPython, issue 115634). `multiprocessing.Pool` is not used: its processes may not start others, as the
    simulated EtherCAT segment does.
    """
    if jobs <= 1:
        yield from map(work, tasks)
        return
    part = jobs * TASKS_PER_PROCESS
    for begin in range(0, len(tasks), part):
        with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
            yield from pool.map(work, tasks[begin : begin + part])
