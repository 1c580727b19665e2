"""Numbers of a table as people read them: one column, one number of decimals."""

from __future__ import annotations

import math
from collections.abc import Sequence

from tdhil.studies.study import Cell

_DIGITS = 5          # of a column's largest number
_MOST_DECIMALS = 5
_WIDE = 1e3          # a column whose numbers differ more than that gets its digits one by one


def shown(value: Cell) -> str:
    """Alone: six digits at most; '-' for nothing."""
    if value is None:
        return "-"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def column_texts(values: Sequence[Cell]) -> list[str]:
    """A column, its numbers with as many decimals as its largest bears; whole numbers as they are."""
    sizes = [abs(value) for value in values if isinstance(value, float) and math.isfinite(value) and value != 0.0]
    whole = all(size == int(size) for size in sizes)
    if not sizes or whole or max(sizes) > _WIDE * min(sizes) or max(sizes) < 1e-3:
        return [f"{value:.{_DIGITS}g}" if isinstance(value, float) and not whole else shown(value) for value in values]
    decimals = min(_MOST_DECIMALS, max(0, _DIGITS - 1 - math.floor(math.log10(max(sizes)))))
    while decimals and all(f"{value:.{decimals}f}".endswith("0") for value in values if isinstance(value, float)):
        decimals -= 1
    return [f"{value:.{decimals}f}" if isinstance(value, float) else shown(value) for value in values]
