"""The same tasks on an existing Dask cluster: `--scheduler tcp://host:8786` (extra `cluster`).

A worker of Dask doesn't execute a task itself. It keeps a `Pool` of one process, with the same limits, tries and losses
as on one machine. So no log can end Dask's worker. If the worker is killed from outside, its task is only submitted
again.
"""

from __future__ import annotations

import importlib
import platform
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError
from contextlib import suppress
from importlib import metadata
from typing import Any, Final, TypeVar

from tdhil.errors import MessageCode, TdhilError, UsageError
from tdhil.process_pool import Loss, Pool, TaskLimits
from tdhil.version import __version__

Task = TypeVar("Task")
Result = TypeVar("Result")

_ASKED: Final = ("numpy", "scipy")      # packages that affect the last digits of the rows
_AHEAD: Final = 4                       # number of submitted tasks for each thread of the cluster
_RESUBMIT: Final = 5
_PATIENCE_S: Final = 60.0               # longest time without any worker
_LOOK_S: Final = 10.0
_ASK_S: Final = 0.5                     # interval between two calls of ``stop``
_here = threading.local()


def versions() -> dict[str, str]:
    """Return the versions that a worker and its host must have in common, by name."""
    found = {"python": ".".join(platform.python_version_tuple()[:2]), "tdhil": __version__}
    for name in _ASKED:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "none"
    return found


def guarded(function: Callable[[Task], Result], task: Task, limits: TaskLimits) -> Result | Loss:
    """Execute one task, in the process that this thread of a Dask worker keeps."""
    pool = getattr(_here, "pool", None)
    if pool is None or _here.made_for != (function, limits):
        if pool is not None:
            pool.close()
        pool = _here.pool = Pool(function, 1, limits)
        _here.made_for = (function, limits)
    found: list[Result | Loss] = [result for _, result in pool.run([task])]
    return found[0]


def run_on_cluster(
    function: Callable[[Task], Result], tasks: Iterable[Task], address: str, limits: TaskLimits,
    stop: Callable[[], bool] | None = None,
) -> Iterator[tuple[Task, Result | Loss]]:
    """Yield every task with its result, as `Pool.run` does. Raises UsageError before the start if the scheduler can't
    be reached or its workers don't fit, and TdhilError if all workers have gone.
    """
    try:
        distributed = importlib.import_module("distributed")
    except ImportError as error:
        raise UsageError("distributed is not installed", where="--scheduler",
                         next_step="Install it with: pip install '.[cluster]'",
                         entry=MessageCode.PACKAGE_MISSING) from error
    try:
        client = distributed.Client(address, timeout="10s", set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise UsageError(f"no Dask scheduler answers: {error}", where=f"--scheduler {address}",
                         next_step="Start one with: dask scheduler", entry=MessageCode.CLUSTER_UNUSABLE) from error
    with client:
        threads = _check(client, address)
        yield from _results(distributed, client, function, tasks, limits, threads * _AHEAD, stop)


def _results(
    distributed: Any, client: Any, function: Callable[[Task], Result], tasks: Iterable[Task], limits: TaskLimits,
    most: int, stop: Callable[[], bool] | None,
) -> Iterator[tuple[Task, Result | Loss]]:
    waiting = iter(tasks)
    under_way: dict[Any, tuple[Task, int]] = {}

    def submit(task: Task, tries: int) -> None:
        under_way[client.submit(guarded, function, task, limits, pure=False)] = (task, tries)

    while True:
        for _, task in zip(range(most - len(under_way)), waiting, strict=False):
            submit(task, 1)
        if not under_way:
            return
        done = _done(distributed, client, list(under_way), stop)
        if not done:
            client.cancel(list(under_way), force=True)
            return
        for future in done:
            task, tries = under_way.pop(future)
            try:
                result: Result | Loss = future.result(timeout=_LOOK_S)
            except (TimeoutError, CancelledError):
                # A worker finished this task, and ended before the result was fetched. Dask repeats the task, but if it
                # closed its last worker the wait has no end. The task is submitted again, and `_done` reports missing
                # workers.
                future.cancel()
                submit(task, tries)
                continue
            except Exception as error:
                failure = error
            else:
                yield task, result
                continue
            if not isinstance(failure, distributed.scheduler.KilledWorker):
                raise TdhilError(f"a worker of the cluster failed: {failure!r}", where="fleet",
                                 entry=MessageCode.WORKER_PROCESS_LOST)
            if tries < _RESUBMIT:
                submit(task, tries + 1)
            else:
                yield task, Loss("ProcessDied", f"the cluster's workers died with it, in each of {tries} tries")


def _done(distributed: Any, client: Any, futures: list[Any], stop: Callable[[], bool] | None) -> list[Any]:
    """Return the finished tasks, at least one; none after a request to stop. Raises TdhilError after a long time
    without workers.
    """
    empty_s = 0.0
    wait_s = _LOOK_S if stop is None else _ASK_S
    while stop is None or not stop():
        with suppress(TimeoutError), client.as_current():
            return list(distributed.wait(futures, timeout=wait_s, return_when="FIRST_COMPLETED").done)
        empty_s = 0.0 if client.scheduler_info()["workers"] else empty_s + wait_s
        if empty_s >= _PATIENCE_S:
            raise TdhilError(f"the cluster has had no worker for {empty_s:.0f} s; finished results are kept",
                             where="fleet", next_step="Start workers, and the same command again",
                             entry=MessageCode.WORKER_PROCESS_LOST)
    return []


def _check(client: Any, address: str) -> int:
    """Return the number of tasks that the cluster executes at once. Raises UsageError for a worker that doesn't fit."""
    wanted = versions()
    try:
        theirs = client.run(versions, on_error="return")
    except Exception as error:
        raise UsageError(f"the workers do not report their versions: {error}", where=f"--scheduler {address}",
                         next_step=f"Install tdhil {__version__} where they run",
                         entry=MessageCode.CLUSTER_UNUSABLE) from error
    if not theirs:
        raise UsageError("the scheduler has no workers", where=f"--scheduler {address}",
                         next_step=f"Start some with: dask worker {address}", entry=MessageCode.CLUSTER_UNUSABLE)
    for worker, found in sorted(theirs.items()):
        if not isinstance(found, dict):
            raise UsageError(f"{worker} can't run it: {found!r}", where=f"--scheduler {address}",
                             next_step=f"Install tdhil {__version__} there", entry=MessageCode.CLUSTER_UNUSABLE)
        odd = [f"{name} {found.get(name)} (here {one})" for name, one in wanted.items() if found.get(name) != one]
        if odd:
            raise UsageError(f"{worker} has {', '.join(odd)}", where=f"--scheduler {address}",
                             next_step="Rows would depend on the worker: install the same versions",
                             entry=MessageCode.CLUSTER_UNUSABLE)
    return int(sum(client.nthreads().values()))
