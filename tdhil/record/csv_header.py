"""Where the table begins, what separates its cells, and which columns are time, speed and torque.

The header is the first of the beginning's lines in which all three are found; what stands above it is the tool's own
business. Names are compared without regard to case, first as they are, then without a unit in brackets.
"""

import difflib
from collections.abc import Sequence
from dataclasses import dataclass

from tdhil.record.csv_choice import Choice, Choices
from tdhil.record.csv_errors import CsvMisnamed, CsvUnusable, shown
from tdhil.record.csv_numbers import looks_numeric, split_cells
from tdhil.record.csv_units import QUANTITIES, split_name, unit_in_name

HEADER_LINES = 50
MOST_COLUMNS = 512
_DELIMITERS = ("\t", ";", ",")


@dataclass(frozen=True)
class Header:
    """``line`` counts from 1; ``columns`` are the positions of time, speed, torque in ``names``."""

    line: int
    delimiter: str
    names: tuple[str, ...]
    columns: tuple[int, int, int]


def find_header(lines: Sequence[str], choices: Choices, file: str) -> Header:
    """The header in the file's first lines. CsvMisnamed if a column isn't there, CsvUnusable if there is no table."""
    best: tuple[tuple[int, int, int], int, list[str]] | None = None
    for number, line in enumerate(lines[:HEADER_LINES], 1):
        for delimiter in _DELIMITERS:
            if delimiter not in line:
                continue
            names = split_cells(line, delimiter)
            if len(names) > MOST_COLUMNS:
                raise CsvUnusable(f"more than {MOST_COLUMNS} columns", where=f"{file}:{number}")
            found = [_positions(names, choice) for choice in choices]
            if all(found):
                return Header(number, delimiter, tuple(names), _one_each(found, names, choices, f"{file}:{number}"))
            words = sum(bool(name) and not looks_numeric(name) for name in names)
            score = (sum(map(bool, found)), words, -number)
            if best is None or score > best[0]:
                best = score, number, names
    if best is None:
        raise CsvUnusable(
            f"there is no table: no comma, semicolon or tab in the first {HEADER_LINES} lines", where=file,
            next_step="Export the trace as CSV, with a header above its columns",
        )
    (_, words, _), number, names = best
    if words < 2:
        raise CsvMisnamed(
            f"no header in the first {HEADER_LINES} lines", where=file,
            next_step="Put a line with the columns' names above them, such as time_s,speed_rad_s,torque_nm",
        )
    missing = next(choice for choice in choices if not _positions(names, choice))
    raise _no_column(missing, names, f"{file}:{number}")


def _positions(names: Sequence[str], choice: Choice) -> list[int]:
    """The columns that answer to a choice: by the whole name, else by the name without its unit."""
    full = [_folded(name) for name in names]
    bare = [_folded(split_name(name)[0]) for name in names]
    if choice.name:
        wanted = _folded(choice.name)
        exact = [at for at, name in enumerate(full) if name == wanted]
        return exact or [at for at, name in enumerate(bare) if name == wanted]
    quantity = choice.quantity
    standard = {"time": "time_s", "speed": "speed_rad_s", "torque": "torque_nm"}[quantity]
    exact = [at for at, name in enumerate(full) if name == standard]
    return exact or [
        at for at, name in enumerate(bare)
        if name == quantity or (name.startswith(f"{quantity}_") and unit_in_name(quantity, names[at]) is not None)
    ]


def _folded(name: str) -> str:
    return " ".join(name.casefold().split())


def _one_each(
    found: Sequence[Sequence[int]], names: Sequence[str], choices: Choices, where: str
) -> tuple[int, int, int]:
    for choice, positions in zip(choices, found, strict=True):
        if len(positions) > 1:
            several = ", ".join(repr(shown(names[at])) for at in positions[:4])
            raise CsvMisnamed(
                f"{len(positions)} columns could be {choice.quantity}: {several}", where=where,
                next_step="Name one with --columns, and rename it in the file if the names are the same",
            )
    time, speed, torque = (positions[0] for positions in found)
    if len({time, speed, torque}) < 3:
        raise CsvMisnamed("one column would hold two quantities", where=where, next_step="Name all with --columns")
    return time, speed, torque


def _no_column(choice: Choice, names: Sequence[str], where: str) -> CsvMisnamed:
    there = [name for name in names if name]
    listed = ", ".join(shown(name) for name in there[:12]) + (", …" if len(there) > 12 else "")
    wanted = choice.name or choice.quantity
    folded = {_folded(form): name for name in there for form in (split_name(name)[0], name)}
    close = difflib.get_close_matches(_folded(wanted)[:80], [form[:80] for form in folded], 1)
    hint = f"; did you mean {shown(folded.get(close[0], close[0]))!r}?" if close else ""
    missing = f"no column {shown(wanted)!r}" if choice.name else f"no column is called {choice.quantity}"
    step = f"The columns are: {listed}"
    if not choice.name:
        step += f". Say which is which: --columns {' '.join(f'{quantity}=…' for quantity in QUANTITIES)}"
    return CsvMisnamed(f"{missing}{hint}", where=where, next_step=step)
