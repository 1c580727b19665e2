"""Rows of a long study in a file of JSON lines, so that the study can be stopped, continued and added to."""

from __future__ import annotations

import argparse
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


def numbered_rows(
    doc: str, usual: int, usual_clean: int, judged: Callable[[int, bool], Row], show: Callable[[Row], None]
) -> tuple[list[Row], bool]:
    """Read the options of a study with numbered rows. Return its rows, and whether they are those without the effect.

    ``doc``: docstring of the study. ``usual``, ``usual_clean``: number of rows, without and with ``--clean``.
    ``judged`` makes the row of a number, with or without ``--clean``.
    """
    parser = argparse.ArgumentParser(description=doc.splitlines()[0])
    parser.add_argument("--rows", type=int, help=f"how many; {usual}, or {usual_clean} with --clean")
    parser.add_argument("--first", type=int, default=0, help="the first one")
    parser.add_argument("--step", type=int, default=1, help="every so many rows; 5 takes two of each batch")
    parser.add_argument("--clean", action="store_true", help="rows without the effect")
    parser.add_argument("--out", type=Path, help="file of the rows, continued if it exists")
    asked = parser.parse_args()
    count = asked.rows if asked.rows is not None else usual_clean if asked.clean else usual
    numbers = range(asked.first, asked.first + count, asked.step)
    return kept_rows(asked.out, "row", numbers, lambda number: judged(number, asked.clean), show), asked.clean


def drop_rows(out: Path, dropped: Callable[[Row], bool]) -> None:
    """Remove rows of earlier parts from ``out``, so that `kept_rows` makes them anew."""
    if not out.exists():
        return
    lines = [line for line in out.read_text(encoding="utf-8").splitlines() if not dropped(json.loads(line))]
    out.write_text("".join(line + "\n" for line in lines), encoding="utf-8")
