"""One plant's figures from its runs, and the bounds of the proof held against them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tdhil.studies.coverage.plants import CoveragePlant
from tdhil.study.coverage_runs import Run

ONE_SIDED = 0.99          # confidence of each bound of the miss rate
MOST_REFUSED = 0.02
_BIAS_FLOOR = 0.002
_BIAS_ERRORS = 3.0
_OVER_BOUND = 1.2
_LEAST_MISSES = 0.4       # of the nominal miss rate: 2 % of 5 %


@dataclass(frozen=True)
class PlantFigures:
    """Shares of the true inertia, but for rates, ratios and counts. None where no run gave a number or nothing applies.

    ``miss_rate`` is over the runs that gave a number; a refusal is counted apart, as neither hit nor miss.
    """

    plant: CoveragePlant
    runs: int
    refused: int
    misses: int
    miss_rate: float | None
    miss_low: float
    miss_high: float
    bias: float | None
    bias_error: float | None
    rmse: float | None
    half_width: float | None
    bound: float | None             # root of the Cramér-Rao bound
    reasons: tuple[tuple[str, int], ...]
    run_seconds: float

    @property
    def answered(self) -> int:
        return self.runs - self.refused

    @property
    def over_bound(self) -> float | None:
        """RMSE over the root of the Cramér-Rao bound, where the model is the truth and not degenerate."""
        return self.rmse / self.bound if self.rmse is not None and self.bound and self.plant.bound_applies else None

    def width_over_bound(self, quantile: float) -> float | None:
        """Mean half-width over that of an estimator at the bound which knows structure and noise."""
        return self.half_width / (quantile * self.bound) if self.half_width is not None and self.bound else None


def clopper_pearson(hits: int, tries: int, one_sided: float = ONE_SIDED) -> tuple[float, float]:
    """Bounds of a share, each exceeded with probability 1 − one_sided: quantiles of the beta distribution."""
    from scipy.stats import beta

    low = float(beta.ppf(1.0 - one_sided, hits, tries - hits + 1)) if hits > 0 else 0.0
    high = float(beta.ppf(one_sided, hits + 1, tries - hits)) if hits < tries else 1.0
    return low, high


def figures_of(plant: CoveragePlant, runs: Sequence[Run], bound_kg_m2: float | None) -> PlantFigures:
    """Added up in the order of the runs' numbers, so that the same runs give the same bits."""
    ordered = sorted(runs, key=lambda run: run.number)
    told = [
        (run.value, run.low, run.high)
        for run in ordered
        if run.value is not None and run.low is not None and run.high is not None
    ]
    truth = plant.inertia_kg_m2
    misses = sum(not low <= truth <= high for _, low, high in told)
    low, high = clopper_pearson(misses, len(told))
    error = np.array([value / truth - 1.0 for value, _, _ in told])
    reasons = Counter(f"{run.verdict}: {run.reason}" for run in ordered if run.value is None)
    return PlantFigures(
        plant=plant,
        runs=len(ordered),
        refused=len(ordered) - len(told),
        misses=misses,
        miss_rate=misses / len(told) if told else None,
        miss_low=low,
        miss_high=high,
        bias=float(error.mean()) if told else None,
        bias_error=float(error.std(ddof=1) / np.sqrt(len(told))) if len(told) > 1 else None,
        rmse=float(np.sqrt(np.mean(error**2))) if told else None,
        half_width=float(np.mean([0.5 * (top - bottom) / truth for _, bottom, top in told])) if told else None,
        bound=bound_kg_m2 / truth if bound_kg_m2 is not None else None,
        reasons=tuple(reasons.most_common()),
        run_seconds=float(np.mean([run.seconds for run in ordered])) if ordered else 0.0,
    )


def covers(found: PlantFigures, nominal: float) -> bool | None:
    """Is the lower bound of the miss rate at most the nominal rate?"""
    return None if found.miss_rate is None else found.miss_low <= nominal


def not_too_wide(found: PlantFigures, nominal: float) -> bool | None:
    """Could the miss rate be 2 % or more (of a nominal 5 %)? Only where the model is the truth."""
    if found.miss_rate is None or not found.plant.model_true:
        return None
    return found.miss_high >= _LEAST_MISSES * nominal


def answers(found: PlantFigures) -> bool | None:
    """Is a number refused in 2 % of the runs at most (lower 99 % bound)? Only where the model is the truth."""
    if not found.plant.model_true or found.runs == 0:
        return None
    return clopper_pearson(found.refused, found.runs)[0] <= MOST_REFUSED


def unbiased(found: PlantFigures) -> bool | None:
    """|bias| ≤ max(0.2 %, 3 Monte-Carlo standard errors)."""
    if found.bias is None or found.bias_error is None:
        return None
    return abs(found.bias) <= max(_BIAS_FLOOR, _BIAS_ERRORS * found.bias_error)


def efficient(found: PlantFigures) -> bool | None:
    """RMSE ≤ 1.2 × the Cramér-Rao bound."""
    return None if found.over_bound is None else found.over_bound <= _OVER_BOUND
