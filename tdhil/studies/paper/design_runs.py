"""Carries a design out: every run simulated, its line fitted, its level means taken."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from tdhil.estimation.result import Identification, LineFit
from tdhil.studies.paper.loop import LoopRecord, simulate
from tdhil.studies.paper.orthogonal_design import DesignSettings
from tdhil.studies.paper.processing import backward_difference, settled_periods, torque_line
from tdhil.study.loop_reference import reference_of
from tdhil.study.ranges import LevelMeans, main_effects, ranking
from tdhil.study.settings import LoopSettings, changed
from tdhil.study.tables_bias import closed_form_inertia
from tdhil.study.tables_identified import identified

FloatArray = NDArray[np.float64]

_POINTS = 1500


@dataclass(frozen=True)
class DesignRun:
    """One run of an array, identified."""

    factors: dict[str, float]
    settings: LoopSettings
    line: LineFit
    """The paper's: all samples, start-up included."""
    settled: LineFit | None
    """Whole periods only, the start-up dropped; None where no period is left."""
    closed_form_kg_m2: float | None
    silent_kg_m2: float | None
    """The paper's line with no noise at all; only where noise is a factor."""
    alpha_rad_s2: FloatArray
    torque_nm: FloatArray
    """Points of the scatter, evenly thinned out."""
    identification: Identification | None = None
    """This tool's own, of the same samples, lags declared absent; None where the motion is no sine."""


@dataclass(frozen=True)
class DesignResult:
    """All runs in array order, and what the factors do."""

    runs: tuple[DesignRun, ...]
    effects: tuple[LevelMeans, ...]
    simulated_s: float
    wall_s: float

    @property
    def inertias(self) -> tuple[float, ...]:
        """J of every run, as the paper identifies it."""
        return tuple(run.line.inertia_kg_m2 for run in self.runs)

    @property
    def ranks(self) -> tuple[int, ...]:
        """Of the factors, 1 for the largest range."""
        return ranking([effect.range for effect in self.effects])


def run_design(settings: DesignSettings, progress: Callable[[float], None]) -> DesignResult:
    """Simulates all runs side by side, and each a second time without noise if noise is a factor."""
    runs = settings.runs()
    noisy = "noise_power_nm2_s" in {factor.field for factor in settings.factors}
    twins = [changed(run, noise_power_nm2_s=0.0) for run in runs] if noisy else []
    begun = perf_counter()
    record = simulate(runs + twins, progress)
    wall_s = perf_counter() - begun
    done = tuple(
        _identified(record, number, run, settings.values(number), number + len(runs) if noisy else None)
        for number, run in enumerate(runs)
    )
    effects = main_effects(settings.rows, [run.line.inertia_kg_m2 for run in done])
    return DesignResult(done, effects, record.simulated_s, wall_s)


def _identified(
    record: LoopRecord, number: int, run: LoopSettings, factors: dict[str, float], twin: int | None
) -> DesignRun:
    time, _, speed, torque = record.of(number)
    thin = slice(None, None, max(1, len(time) // _POINTS))
    return DesignRun(
        factors, run, torque_line(time, speed, torque), _settled(record, number, run), closed_form_inertia(run),
        None if twin is None else _line(record, twin, slice(None)).inertia_kg_m2,
        backward_difference(time, speed)[thin].copy(), torque[1:][thin].copy(),
        identified(run, time, speed, torque),
    )


def _settled(record: LoopRecord, number: int, run: LoopSettings) -> LineFit | None:
    period_s = reference_of(run).period_s
    window = None if period_s is None else settled_periods(run.steps, run.sample_period_s, period_s)
    return None if window is None else _line(record, number, window)


def _line(record: LoopRecord, number: int, samples: slice) -> LineFit:
    time, _, speed, torque = record.of(number, samples)
    return torque_line(time, speed, torque)
