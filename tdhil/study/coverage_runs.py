"""The runs of the benchmark: simulated, identified, kept as a line each; over several processes where wanted.

A run is named by (base seed, plant, number) and draws from its own stream, so the totals depend neither on the number
of processes nor on how runs are grouped.
"""

from __future__ import annotations

import signal
import zlib
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.synchronize import Event

from tdhil.identify.identify import identify
from tdhil.identify.options import Options
from tdhil.study.coverage_plants import CoveragePlant
from tdhil.study.coverage_simulator import simulate

GROUP = 20     # runs simulated together: some 200 MB

_interrupted: Event | None = None      # in a worker: set when the whole benchmark was


@dataclass(frozen=True)
class Run:
    """What identification said of one run; ``value``, ``low``, ``high`` in kg·m², None where it gave no number."""

    plant: str
    number: int
    seconds: float
    verdict: str
    reason: str
    value: float | None = None
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True)
class Task:
    """Runs ``first`` … ``first + count − 1`` of one plant."""

    plant: CoveragePlant
    first: int
    count: int
    base_seed: int
    periods: int
    confidence: float


def tasks(
    plants: Iterable[CoveragePlant], seeds: int, base_seed: int, periods: int, confidence: float
) -> list[Task]:
    """Every plant's runs in groups."""
    return [
        Task(plant, first, min(GROUP, seeds - first), base_seed, periods, confidence)
        for plant in plants
        for first in range(0, seeds, GROUP)
    ]


def run_task(task: Task) -> tuple[Run, ...]:
    """Simulate and identify one group."""
    own = zlib.crc32(task.plant.name.encode())      # by name: a plant's runs don't depend on which others there are
    numbers = range(task.first, task.first + task.count)
    recordings = simulate(task.plant, [(task.base_seed, own, number) for number in numbers], task.periods)
    options = Options(confidence=task.confidence)
    found = []
    for number, recording in zip(numbers, recordings, strict=True):
        if _interrupted is not None and _interrupted.is_set():
            break
        said = identify(recording, options)
        seconds = float(recording.time_s[-1] - recording.time_s[0])
        run = Run(task.plant.name, number, seconds, said.verdict.value, said.reason)
        if said.inertia is not None:
            inertia = said.inertia
            run = Run(*_head(run), float(inertia.value), float(inertia.low), float(inertia.high))
        found.append(run)
    return tuple(found)


def _head(run: Run) -> tuple[str, int, float, str, str]:
    return run.plant, run.number, run.seconds, run.verdict, run.reason


def run_all(wanted: list[Task], processes: int) -> Iterator[tuple[Run, ...]]:
    """Groups as they are done, in no particular order."""
    if processes <= 1:
        yield from map(run_task, wanted)
        return
    interrupted = get_context("spawn").Event()
    with ProcessPoolExecutor(processes, get_context("spawn"), _as_worker, (interrupted,)) as pool:
        waiting = [pool.submit(run_task, task) for task in wanted]
        try:
            for done in as_completed(waiting):
                yield done.result()
        except BaseException:
            # The groups under way end with the run they are at; a worker killed in the middle may leave the pool stuck.
            interrupted.set()
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _as_worker(interrupted: Event) -> None:
    """A terminal sends Ctrl-C to the children too, which would each say so with a traceback."""
    global _interrupted  # noqa: PLW0603
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _interrupted = interrupted
