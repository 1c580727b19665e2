"""Rows of a long study in a file of JSON lines, so that the study can be stopped, continued and added to."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar

from benchmarks.in_processes import in_processes

Row = dict[str, Any]
Number = TypeVar("Number", int, str)


def kept_rows(
    out: Path | None, key: str, numbers: Iterable[Number], judged: Callable[[Number], Row], show: Callable[[Row], None],
    jobs: int = 1,
) -> list[Row]:
    """Return the rows of earlier parts in ``out``, then those of all ``numbers`` that are not among them.

    ``judged`` makes the row of a number or name, which stands under ``key``, in one of ``jobs`` processes. Each new row
    is appended to ``out``, if it is given, before ``show`` is called with it.
    """
    rows: list[Row] = []
    if out is not None and out.exists():
        rows = [json.loads(line) for line in out.read_text(encoding="utf-8").splitlines()]
    known = {row[key] for row in rows}
    for row in in_processes(judged, [number for number in numbers if number not in known], jobs):
        rows.append(row)
        if out is not None:
            with out.open("a", encoding="utf-8") as kept:
                kept.write(json.dumps(row) + "\n")
        show(row)
    return rows


def drop_rows(out: Path, dropped: Callable[[Row], bool]) -> None:
    """Remove rows of earlier parts from ``out``, so that `kept_rows` makes them anew."""
    if not out.exists():
        return
    lines = [line for line in out.read_text(encoding="utf-8").splitlines() if not dropped(json.loads(line))]
    out.write_text("".join(line + "\n" for line in lines), encoding="utf-8")
