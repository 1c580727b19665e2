"""Range analysis (equation 17): how much the mean response moves when one factor of an orthogonal array moves.

Over the runs of one level of a factor, every other factor takes each of its levels equally often; if effects add up,
level means differ by that factor alone. R = largest level mean less smallest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Rows = Sequence[Sequence[int]]


@dataclass(frozen=True)
class LevelMeans:
    """One factor's means, level 1 first."""

    means: tuple[float, ...]

    @property
    def range(self) -> float:
        """R of equation 17."""
        return max(self.means) - min(self.means)


def main_effects(rows: Rows, responses: Sequence[float] | FloatArray) -> tuple[LevelMeans, ...]:
    """For each column of the array, the mean response at each of its levels."""
    levels, found = np.asarray(rows), np.asarray(responses, dtype=np.float64)
    return tuple(
        LevelMeans(tuple(float(found[column == level].mean()) for level in np.unique(column))) for column in levels.T
    )


def ranking(ranges: Sequence[float]) -> tuple[int, ...]:
    """The rank of each factor, 1 for the largest range; equal ranges rank in their order."""
    order = sorted(range(len(ranges)), key=lambda index: -ranges[index])
    ranks = [0] * len(ranges)
    for rank, index in enumerate(order, start=1):
        ranks[index] = rank
    return tuple(ranks)


def is_saturated(rows: Rows) -> bool:
    """Whether the level means fix every run: 1 + Σ(levels − 1) = runs."""
    levels = np.asarray(rows)
    return 1 + sum(len(np.unique(column)) - 1 for column in levels.T) == len(levels)


def runs_from_means(rows: Rows, means: Sequence[Sequence[float]]) -> tuple[float, ...]:
    """The responses whose level means are ``means``: J_run = m + Σ over factors of (mean of its level − m).

    With a saturated array effects use up all degrees of freedom, so the sum is no model but the data themselves;
    m is the grand mean (of the factors' own grand means, which rounding of printed figures lets differ).
    """
    if not is_saturated(rows):
        raise ValueError("the array isn't saturated: its level means don't fix the runs")
    grand = float(np.mean([np.mean(of_factor) for of_factor in means]))
    return tuple(
        grand + sum(of_factor[level - 1] - grand for of_factor, level in zip(means, row, strict=True)) for row in rows
    )
