"""Survey of a CSV trace before its columns are known: header, first rows, and a guess of the columns and units.

The guess is a proposal for a person, who confirms or corrects it. `tdhil replay` never guesses a name: there the
columns have their usual names, or are named.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from tdhil.errors import CsvUnusable, UsageError, shown
from tdhil.recording.csv.layout import (
    DELIMITERS,
    HEADER_LINES,
    MOST_COLUMNS,
    QUANTITIES,
    SI,
    USUAL,
    ColumnChoice,
    Header,
    find_header,
    is_setpoint,
    known_units,
    parse_columns,
    split_name,
    unit_in_name,
    unit_of,
    words_of,
)
from tdhil.recording.csv.text import blocks, decimal_sign, encoding_of, is_missing, looks_numeric, number, split_cells

_BELOW = 6          # lines below the header in which the first row of numbers is looked for
ROWS = 8
"""Rows of numbers that a survey shows."""
_LOOKED_AT = 200    # rows from which the decimal sign and the order of the time are found

# Words in names of columns, as the tools of drives, PLCs and loggers write them, in English and German. One-letter
# names are symbols of the quantities. A setpoint or a limit is never guessed (`layout.is_setpoint`).
_WORDS: Mapping[str, frozenset[str]] = {
    "time": frozenset(("time", "zeit", "t", "timestamp", "zeitstempel", "sec", "seconds", "sekunden", "uhrzeit")),
    "speed": frozenset((
        "speed", "drehzahl", "n", "velocity", "geschwindigkeit", "omega", "w", "rpm", "rotation", "nist", "nact")),
    "torque": frozenset((
        "torque", "drehmoment", "moment", "m", "trq", "mom", "tq", "mist", "mact", "mdi", "tau")),
}
_PARTS: Mapping[str, tuple[str, ...]] = {
    "time": ("time", "zeit"), "speed": ("speed", "drehzahl", "veloc", "rpm"), "torque": ("torque", "moment", "trq"),
}
_REPORTED = frozenset(("act", "actual", "ist", "istwert", "feedback", "fbk", "measured", "value", "reported"))
_OTHER = frozenset(("filtered", "mean", "avg", "load", "lag"))


@dataclass(frozen=True)
class GuessedColumn:
    """Guess of one quantity: ``column`` is '' if no column fits; ``unit`` is '' if no unit is stated."""

    quantity: str
    column: str
    unit: str


@dataclass(frozen=True)
class TraceSurvey:
    """Content of a trace before its columns are known.

    ``names``: of the columns, as in the header at ``line``; ``units``: as the file states them, '' without one;
    ``rows``: the first rows of numbers as text, a cell for each name; ``comma``: the decimal sign is a comma.
    """

    encoding: str
    delimiter: str
    line: int
    names: tuple[str, ...]
    units: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    comma: bool
    guess: tuple[GuessedColumn, ...]


def survey_trace(path: Path) -> TraceSurvey:
    """Return the survey of the trace in ``path``. Raises CsvUnusable or CsvMisnamed without a table."""
    encoding = encoding_of(path)
    head = next(blocks(path, encoding), None)
    if head is None:
        raise CsvUnusable("the file is empty", where=str(path))
    header, first = _header(head.lines, str(path))
    names = header.names
    cells = [split_cells(line, header.delimiter) for line in head.lines[first:first + _LOOKED_AT] if line.strip()]
    rows = [tuple((*row, *[""] * len(names))[:len(names)]) for row in cells]
    # the row of units below the header, '' in each place without one
    below = ([*split_cells(line, header.delimiter), *[""] * len(names)][:len(names)]
             for line in head.lines[header.line:first])
    stated = next((row for row in below if any(unit_of(quantity, cell) for quantity in QUANTITIES
                                               for cell in row if cell)), [""] * len(names))
    units = []
    for name, unit in zip(names, stated, strict=True):
        symbols = [one.symbol for quantity in QUANTITIES if (one := unit_in_name(quantity, name)) is not None]
        units.append(unit if unit and not is_missing(unit) else
                     split_name(name)[1] or max(symbols, key=len, default=""))      # rad_s also ends like a second
    comma = decimal_sign([cell for cell in row if looks_numeric(cell)] for row in rows) == ","
    return TraceSurvey(encoding, header.delimiter, header.line, names, tuple(units), tuple(rows[:ROWS]), comma,
                       guess_columns(names, stated, rows, comma=comma))


def _header(lines: Sequence[str], file: str) -> tuple[Header, int]:
    """Return the header, and the position of the first row of numbers in ``lines``.

    A header has two words at least, and a row with as many cells and two numbers follows it closely. Of several such
    lines (a row of units may be one), the one with the most words is the header; of equal ones the first.
    """
    best: tuple[int, Header, int] | None = None
    for number_, line in enumerate(lines[:HEADER_LINES], 1):
        for delimiter in DELIMITERS:
            names = split_cells(line, delimiter)
            words = sum(bool(name) and not _is_value(name) for name in names)
            if words < 2 or len(names) > MOST_COLUMNS or (best is not None and words <= best[0]):
                continue
            for first in range(number_, min(number_ + _BELOW, len(lines))):
                cells = split_cells(lines[first], delimiter)
                if (len(names) <= len(cells) <= len(names) + 1 and sum(map(_is_value, cells)) >= 2
                        and (_is_value(cells[0]) or is_missing(cells[0]))):
                    best = words, Header(number_, delimiter, tuple(names), ()), first
                    break
    if best is not None:
        return best[1], best[2]
    header = find_header(lines, USUAL, file)       # its error states what is missing
    raise CsvUnusable("no row of numbers follows the header", where=f"{file}:{header.line}",
                      next_step="Look at the file in an editor")


def _is_value(cell: str) -> bool:
    return looks_numeric(cell) or (":" in cell and cell[:1].isdigit())


def guess_columns(
    names: Sequence[str], stated: Sequence[str], rows: Sequence[Sequence[str]], *, comma: bool = False
) -> tuple[GuessedColumn, ...]:
    """Return a guess for time, speed and torque. No column is used twice, and a guess never fails.

    ``stated``: row of units below the header, '' without one; ``rows``: rows of numbers.
    """
    folded = [" ".join(name.casefold().split()) for name in names]       # `find_header` compares names in this way
    unique = [at for at, name in enumerate(names) if name and folded.count(folded[at]) == 1]
    scored = sorted(
        ((_score(quantity, names[at], stated[at], [row[at] for row in rows if at < len(row)], comma=comma), -at,
          quantity) for at in unique for quantity in QUANTITIES), reverse=True)
    taken: dict[str, int] = {}
    for score, place, quantity in scored:
        if score > 0.0 and quantity not in taken and -place not in taken.values():
            taken[quantity] = -place
    guessed = []
    for quantity in QUANTITIES:
        at = taken.get(quantity)
        unit = None if at is None else unit_of(quantity, stated[at]) or unit_in_name(quantity, names[at])
        guessed.append(GuessedColumn(quantity, "" if at is None else names[at], "" if unit is None else unit.symbol))
    return tuple(guessed)


def _score(quantity: str, name: str, stated: str, cells: Sequence[str], *, comma: bool) -> float:
    """Return how well a column fits a quantity; 0 or less: not at all. Words count most, then units."""
    values = [cell for cell in cells if not is_missing(cell)]
    clock = quantity == "time" and any(":" in cell for cell in values)
    if (values and not clock and not any(map(looks_numeric, values))) or is_setpoint(quantity, name):
        return 0.0
    words = words_of(quantity, name)
    folded = name.casefold()
    score = 4.0 if words & _WORDS[quantity] else 3.0 if any(part in folded for part in _PARTS[quantity]) else 0.0
    of_another = any(unit_of(other, stated) or unit_in_name(other, name) for other in QUANTITIES if other != quantity)
    if unit_of(quantity, stated) is not None or unit_in_name(quantity, name) is not None:
        score += 2.0
    elif of_another:
        score -= 5.0
    if score <= 0.0:
        return 3.0 if clock else 0.0
    score += 0.5 * bool(words & _REPORTED) - 1.5 * bool(words & _OTHER)
    if quantity == "time":
        numbers = [found for cell in values if (found := number(cell, comma)) is not None]
        score += 2.0 if clock or (len(numbers) > 1 and all(a < b for a, b in pairwise(numbers))) else -2.0
    return score


# ---------------------------------------------------------------------------------------------------------------------
# Mistakes in a choice of columns, all at once.


def column_mistakes(columns: Sequence[str], names: Sequence[str], *, rated: bool) -> Iterator[tuple[str, str]]:
    """Yield (quantity, mistake) for each mistake in ``columns``, such as ``speed=n:rpm``, against the file's names.

    ``rated``: whether the rated torque is known, for a torque in % or ‰. That mistake has the quantity ``rated``.
    """
    chosen: dict[str, ColumnChoice] = {}
    for item in columns:
        quantity = item.partition("=")[0].strip().casefold()
        quantity = quantity if quantity in QUANTITIES else ""
        try:
            (choice,) = (one for one in parse_columns([item]) if one.name)
        except (UsageError, ValueError) as error:
            yield quantity, error.what if isinstance(error, UsageError) else f"{shown(item)!r} names no column"
            chosen.setdefault(quantity, ColumnChoice(quantity))
            continue
        if quantity in chosen:
            yield quantity, f"{quantity} is named twice"
        chosen[quantity] = choice
    for quantity in QUANTITIES:
        if quantity not in chosen:
            yield quantity, f"Choose the column of {quantity}"
    folded = [" ".join(one.casefold().split()) for one in names]
    bare = [" ".join(split_name(one)[0].casefold().split()) for one in names]
    used: dict[str, str] = {}
    for quantity, choice in chosen.items():
        if not choice.name:
            continue
        wanted = " ".join(choice.name.casefold().split())
        count = folded.count(wanted) or bare.count(wanted)
        if not count:
            yield quantity, f"The file has no column {shown(choice.name)!r}"
        elif count > 1:
            yield quantity, f"{count} columns are called {shown(choice.name)!r}. Rename one in the file"
        if wanted in used:
            yield quantity, f"This column is already that of {used[wanted]}"
        used[wanted] = quantity
        if choice.unit is not None and choice.unit.of_rated and not rated:
            yield "rated", f"Torque in {choice.unit.symbol} needs the rated torque, in N·m"


def units_of(quantity: str) -> tuple[str, ...]:
    """Return the symbols of the units for a choice of ``quantity``, the SI unit first."""
    return tuple(dict.fromkeys((SI[quantity], *known_units(quantity))))
