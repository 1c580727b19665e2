"""Orthogonal arrays: those that ship, and the check that any other has to pass.

An array is orthogonal (of strength two) if in every pair of columns every pair of levels stands equally often. Then the
level means of one factor are free of all others' additive effects, which is all that range analysis asks.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from itertools import combinations

from profiles.model import DataModel
from profiles.yaml_loader import parse_model

Rows = tuple[tuple[int, ...], ...]

MAX_RUNS = 512


class NamedArray(DataModel):
    """An array that ships with the program."""

    name: str
    rows: Rows


class _Arrays(DataModel):
    arrays: tuple[NamedArray, ...]


@cache
def shipped_arrays() -> dict[str, Rows]:
    """L9, L16."""
    name = "design_arrays.yaml"
    text = files("tdhil.studies").joinpath(name).read_text(encoding="utf-8")
    return {array.name: array.rows for array in parse_model(text, name, _Arrays).arrays}


def fault_of(rows: Sequence[Sequence[int]]) -> str | None:
    """What keeps ``rows`` from being an orthogonal array, in words; None if nothing does."""
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
