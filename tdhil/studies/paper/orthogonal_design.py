"""Orthogonal designs as a tool: any array, any factors of the rig by name, and the resulting runs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from itertools import combinations

import numpy as np
from pydantic import ValidationError, model_validator

from profiles import DataModel, Finding, parse_model, refuse_if
from tdhil.recording import FloatArray
from tdhil.studies.paper.loop import FACTORS, SYMBOLS, LoopSettings, changed, full_name

# ---------------------------------------------------------------------------------------------------------------------
# Orthogonal arrays: those in tdhil, and the check for any other.
#
# An array is orthogonal (of strength two) if in every pair of columns every pair of levels occurs equally often. The
# level means of one factor are then free of the additive effects of all others, as range analysis requires.


Rows = tuple[tuple[int, ...], ...]

MAX_RUNS = 512


class NamedArray(DataModel):
    """Array that is part of the program."""

    name: str
    rows: Rows


class _Arrays(DataModel):
    arrays: tuple[NamedArray, ...]


@cache
def shipped_arrays() -> dict[str, Rows]:
    """Return the arrays in tdhil: L9 and L16."""
    name = "design_arrays.yaml"
    text = files("tdhil.studies.paper").joinpath(name).read_text(encoding="utf-8")
    return {array.name: array.rows for array in parse_model(text, name, _Arrays).arrays}


def fault_of(rows: Sequence[Sequence[int]]) -> str | None:
    """Return why ``rows`` is not an orthogonal array, in words; None if it is one."""
    if not rows or not rows[0]:
        return "the array is empty"
    if len(rows) > MAX_RUNS:
        return f"the array has {len(rows)} runs; {MAX_RUNS} are possible"
    for number, row in enumerate(rows, start=1):
        if len(row) != len(rows[0]):
            return f"run {number} has {len(row)} columns where run 1 has {len(rows[0])}"
    columns = list(zip(*rows, strict=True))
    for number, column in enumerate(columns, start=1):
        counts = Counter(column)
        if sorted(counts) != list(range(1, len(counts) + 1)) or len(counts) < 2:
            return f"column {number}: levels must be numbered 1, 2, … without a gap, and be two at least"
        if len(set(counts.values())) > 1:
            return f"not orthogonal: column {number} has {_uneven(counts)}"
    for (first, one), (second, other) in combinations(enumerate(columns, start=1), 2):
        counts = Counter(dict.fromkeys(_pairs(one, other), 0))
        counts.update(zip(one, other, strict=True))
        if len(set(counts.values())) > 1:
            return f"not orthogonal: columns {first} and {second} have {_uneven(counts)}"
    return None


def _pairs(one: Sequence[int], other: Sequence[int]) -> list[tuple[int, int]]:
    return [(left, right) for left in sorted(set(one)) for right in sorted(set(other))]


def _uneven(counts: Counter[int] | Counter[tuple[int, int]]) -> str:
    (most, often), (least, seldom) = counts.most_common()[0], counts.most_common()[-1]
    kind = "levels" if isinstance(most, tuple) else "level"
    return f"{kind} {most} {_times(often)} and {least} {_times(seldom)}"


def _times(count: int) -> str:
    return {0: "never", 1: "once", 2: "twice"}.get(count, f"{count} times")


# ---------------------------------------------------------------------------------------------------------------------
# Range analysis (equation 17): change of the mean response with one factor of an orthogonal array.
#
# Over the runs with one level of a factor, every other factor has each of its levels equally often. If effects are
# additive, level means differ only by that factor. R = largest level mean less smallest.


RangeRows = Sequence[Sequence[int]]


@dataclass(frozen=True)
class LevelMeans:
    """Means of one factor, level 1 first."""

    means: tuple[float, ...]

    @property
    def range(self) -> float:
        """Range R of equation 17."""
        return max(self.means) - min(self.means)


def main_effects(rows: RangeRows, responses: Sequence[float] | FloatArray) -> tuple[LevelMeans, ...]:
    """Return, for each column of the array, the mean response at each of its levels."""
    levels, found = np.asarray(rows), np.asarray(responses, dtype=np.float64)
    return tuple(
        LevelMeans(tuple(float(found[column == level].mean()) for level in np.unique(column))) for column in levels.T
    )


def ranking(ranges: Sequence[float]) -> tuple[int, ...]:
    """Return the rank of each factor, 1 for the largest range; equal ranges rank in their order."""
    order = sorted(range(len(ranges)), key=lambda index: -ranges[index])
    ranks = [0] * len(ranges)
    for rank, index in enumerate(order, start=1):
        ranks[index] = rank
    return tuple(ranks)


def is_saturated(rows: RangeRows) -> bool:
    """Return whether the level means determine every run: 1 + Σ(levels − 1) = runs."""
    levels = np.asarray(rows)
    return 1 + sum(len(np.unique(column)) - 1 for column in levels.T) == len(levels)


def runs_from_means(rows: RangeRows, means: Sequence[Sequence[float]]) -> tuple[float, ...]:
    """Return the responses whose level means are ``means``: J_run = m + Σ over factors of (mean of its level − m).

    For a saturated array the effects use all degrees of freedom, so the sum is exact. m is the grand mean: the mean of
    the factors' own grand means, which differ because the printed figures are rounded.
    """
    if not is_saturated(rows):
        raise ValueError("the array isn't saturated: its level means don't fix the runs")
    grand = float(np.mean([np.mean(of_factor) for of_factor in means]))
    return tuple(
        grand + sum(of_factor[level - 1] - grand for of_factor, level in zip(means, row, strict=True)) for row in rows
    )


# ---------------------------------------------------------------------------------------------------------------------

class Factor(DataModel):
    """Factor: a field of the settings, or its symbol, and a value for each level of its column."""

    name: str
    levels: tuple[float, ...]

    @property
    def field(self) -> str:
        """Full name of the field."""
        return full_name(self.name)


class DesignSettings(LoopSettings):
    """Design: an array (by name, or row by row), its factors in the order of its columns, and the common settings."""

    array: str | Rows = "L9"
    factors: tuple[Factor, ...] = ()

    @property
    def varied(self) -> frozenset[str]:
        """Fields whose values come from the array."""
        return frozenset(factor.field for factor in self.factors)

    @property
    def rows(self) -> Rows:
        """Rows of the array, with only the columns that have a factor."""
        rows = shipped_arrays()[self.array] if isinstance(self.array, str) else self.array
        return tuple(row[: len(self.factors)] for row in rows)

    def values(self, run: int) -> dict[str, float]:
        """Return the factors of run ``run`` (from 0), by field name."""
        return {
            factor.field: factor.levels[level - 1] for factor, level in zip(self.factors, self.rows[run], strict=True)
        }

    def runs(self) -> list[LoopSettings]:
        """Return the settings of every run, in array order."""
        return [changed(self, **self.values(run)) for run in range(len(self.rows))]

    @model_validator(mode="after")
    def _orthogonal(self) -> DesignSettings:
        findings: list[Finding] = []
        if isinstance(self.array, str) and self.array not in shipped_arrays():
            known = ", ".join(shipped_arrays())
            findings.append(("array", f"no array '{self.array[:40]}' here (known: {known}); write it row by row"))
        elif (fault := fault_of(rows := shipped_arrays()[self.array] if isinstance(self.array, str) else self.array)):
            findings.append(("array", fault))
        else:
            findings += _unfit(self.factors, rows)
        refuse_if(findings)
        for run in range(len(self.rows)):
            try:
                changed(self, **self.values(run))
            except ValidationError as error:
                refuse_if([("factors", f"run {run + 1}: {_first(error)}")])
        return self


def _unfit(factors: tuple[Factor, ...], rows: Rows) -> list[Finding]:
    """Return the errors of factors on this array."""
    findings: list[Finding] = []
    if not factors:
        return [("factors", "a design needs at least one factor")]
    if len(factors) > len(rows[0]):
        return [("factors", f"{len(factors)} factors for the {len(rows[0])} columns of the array")]
    for index, factor in enumerate(factors):
        needed = len({row[index] for row in rows})
        if factor.field not in FACTORS:
            short = [symbol for symbol, field in SYMBOLS.items() if field in FACTORS]
            findings.append(("factors", f"no factor '{factor.name[:40]}'; known: {', '.join((*FACTORS, *short))}"))
        if factor.field in {earlier.field for earlier in factors[:index]}:
            findings.append(("factors", f"'{factor.field}' is a factor already"))
        if len(factor.levels) != needed or len(set(factor.levels)) != needed:
            findings.append(
                ("factors", f"column {index + 1} of the array needs {needed} different levels of '{factor.name}'")
            )
    return findings


def _first(error: ValidationError) -> str:
    item = error.errors(include_url=False)[0]
    where = ".".join(str(part) for part in item["loc"])
    message = item["msg"].removeprefix("Value error, ")
    return f"{where}: {message}" if where else message
