"""Tasks of a long study in several processes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from multiprocessing import get_context
from typing import TypeVar

TASKS_PER_PROCESS = 50
"""A process ends after this many tasks, so that its memory stays small."""

Task = TypeVar("Task")
Result = TypeVar("Result")


def in_processes(work: Callable[[Task], Result], tasks: Sequence[Task], jobs: int) -> Iterator[Result]:
    """Yield the results of ``work`` in the order of the tasks; with one job, from this process.

    `concurrent.futures` is not used: with ``max_tasks_per_child`` its pool hangs if all processes end at once
    (CPython, issue 115634).
    """
    if jobs <= 1:
        yield from map(work, tasks)
        return
    with get_context("spawn").Pool(jobs, maxtasksperchild=TASKS_PER_PROCESS) as pool:
        yield from pool.imap(work, tasks)
