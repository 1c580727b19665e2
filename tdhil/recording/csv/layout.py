"""The header with its units, and where the numbers begin: all that is needed to read the rows.

A unit is taken from ``--columns``, else from a row of units below the header, else from the column's name
(``n_rpm``, ``Speed [rpm]``), else it is SI, which is told as an assumption. A file that contradicts itself is refused.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice

from tdhil.record.csv_choice import Choice, Choices
from tdhil.record.csv_errors import CsvMisnamed, CsvUnusable, shown
from tdhil.record.csv_header import Header, find_header
from tdhil.record.csv_numbers import decimal_sign, is_missing, looks_numeric, split_cells
from tdhil.record.csv_units import QUANTITIES, SI, Unit, known_units, unit_in_name, unit_of

_BELOW = 5          # rows that may stand between the header and the numbers
_LOOKED_AT = 5000   # rows, for the decimal sign


@dataclass(frozen=True)
class Layout:
    """``units`` of time, speed, torque; ``clock``: the time is written as such; ``comma``: the decimal sign."""

    header: Header
    first_line: int
    units: tuple[Unit, Unit, Unit]
    clock: bool
    comma: bool
    assumed: tuple[str, ...]


def find_layout(lines: Sequence[str], choices: Choices, file: str) -> Layout:
    """From the file's first block. CsvMisnamed for columns and units, CsvUnusable where no number follows."""
    header = find_header(lines, choices, file)
    below = range(header.line, min(header.line + _BELOW + 1, len(lines)))     # positions, so one line further
    rows = {at: _wanted(lines[at], header) for at in below if lines[at].strip()}
    first = next((at for at, row in rows.items() if _holds_data(row)), None)
    if first is None:
        raise CsvUnusable(
            f"no numbers in time, speed and torque in the lines below the header ({_listed(header)})",
            where=f"{file}:{header.line}", next_step="Look at the file in an editor",
        )
    stated = next(
        (row for at, row in rows.items() if at < first and any(map(unit_of, QUANTITIES, row))), ["", "", ""]
    )
    clock = ":" in rows[first][0]
    seen = [_wanted(line, header) for line in _telling(lines[first:], header.delimiter)]
    sign = decimal_sign(row[1:] if clock else row for row in seen)
    if sign == "?":
        raise CsvUnusable(
            "some numbers have a decimal comma and some a decimal point", where=f"{file}:{first + 1}",
            next_step="Export again with one of them, and without signs between thousands",
        )
    where = f"{file}:{header.line}"
    units, assumed = [], [f"{file}: numbers were read with a decimal comma"] if sign == "," else []
    for position, choice in enumerate(choices):
        if clock and choice.quantity == "time":
            units.append(Unit("time", "clock", 1.0))
            assumed.append(f"{file}: clock times; the first row is at 0 s")
            continue
        name = header.names[header.columns[position]]
        unit, notes = _unit(choice, name, stated[position], where)
        units.append(unit)
        assumed += [f"{file}: {note}" for note in notes]
    return Layout(header, first + 1, (units[0], units[1], units[2]), clock, sign == ",", tuple(assumed))


def _telling(lines: Sequence[str], delimiter: str) -> list[str]:
    """The first lines, and where commas are no separators, some further ones with a comma: a standstill is all 0."""
    further = (line for line in lines[_LOOKED_AT:] if "," in line) if delimiter != "," else ()
    return [*lines[:_LOOKED_AT], *islice(further, _LOOKED_AT)]


def _wanted(line: str, header: Header) -> list[str]:
    cells = split_cells(line, header.delimiter)
    return [cells[at] if at < len(cells) else "" for at in header.columns]


def _holds_data(row: Sequence[str]) -> bool:
    """A time and two numbers, or what stands for no number: channels that start late are empty at first."""
    timed = looks_numeric(row[0]) or (":" in row[0] and any(sign.isdigit() for sign in row[0]))
    values = [looks_numeric(cell) for cell in row[1:]]
    return (timed or is_missing(row[0])) and all(
        known or is_missing(cell) for known, cell in zip(values, row[1:], strict=True)
    ) and timed + sum(values) >= 1


def _unit(choice: Choice, name: str, stated: str, where: str) -> tuple[Unit, list[str]]:
    """The unit of one column, and what has to be said about it."""
    quantity = choice.quantity
    below = unit_of(quantity, stated)
    named = unit_in_name(quantity, name)
    if choice.unit is not None:
        other = below or named
        if other is not None and other != choice.unit:
            return choice.unit, [f"{quantity} was read in {choice.unit.symbol} as told; the file says {other.symbol}"]
        return choice.unit, []
    tell = f"Give it behind a colon: --columns {quantity}='{shown(name)}:{SI[quantity]}'"
    if stated and below is None and not is_missing(stated):
        raise CsvMisnamed(
            f"{shown(stated)!r} is no known unit of {quantity}; there are {', '.join(known_units(quantity))}",
            where=where, next_step=tell,
        )
    if below is not None and named is not None and below != named:
        raise CsvMisnamed(
            f"the unit of {shown(name)!r} is {named.symbol} by its name but {below.symbol} by the row of units",
            where=where, next_step=tell,
        )
    unit = below or named
    if unit is None:
        si = unit_of(quantity, SI[quantity])
        assert si is not None
        return si, [f"no unit is stated for {shown(name)!r}; {SI[quantity]} was assumed"]
    if unit.symbol == "1/s":
        return unit, [f"{shown(name)!r} in 1/s was read as revolutions a second"]
    return unit, []


def _listed(header: Header) -> str:
    return ", ".join(shown(header.names[at]) for at in header.columns)
