"""The runs of the benchmark: simulated, identified, kept as a line each; over several processes where wanted.

A run is named by (base seed, plant, number) and draws from its own stream, so the totals depend neither on the number
of processes nor on how runs are grouped.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from tdhil.estimation.identify import identify
from tdhil.identify.options import Options
from tdhil.studies.coverage.plants import CoveragePlant
from tdhil.studies.coverage.simulate import simulate
from tdhil.studies.coverage.workers import results

GROUP = 20     # runs simulated together: some 200 MB


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
    """Groups as they are done, in no particular order. What is under way when this is interrupted is dropped."""
    if processes <= 1:
        return map(run_task, wanted)
    return results(run_task, wanted, processes)
