"""A trace exported from a drive's own tool: CSV in, samples in SI out, and what had to be assumed or left out."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np

from tdhil.errors import UsageError
from tdhil.record.csv_choice import USUAL, Choices
from tdhil.record.csv_errors import CsvUnusable
from tdhil.record.csv_numbers import LARGEST
from tdhil.record.csv_order import rising
from tdhil.record.csv_rows import LineArray, RowReader, Tally
from tdhil.recording.csv.layout import Layout, find_layout
from tdhil.recording.csv.text import Block, blocks, encoding_of
from tdhil.recording.recording import FloatArray

MAX_ROWS = 10_000_000      # 32 bytes each while they are read
_MOST_ODD = 0.10           # of the rows, ragged or without a number where one should be


@dataclass(frozen=True)
class Trace:
    """(N,) each, SI, time rising; ``warnings`` a line each."""

    time_s: FloatArray
    speed_rad_s: FloatArray
    torque_nm: FloatArray
    warnings: tuple[str, ...]


def read_trace(path: Path, choices: Choices = USUAL, rated_torque_nm: float | None = None) -> Trace:
    """The trace in ``path``. CsvMisnamed for columns and units, CsvUnusable for the rest, both with file and line.

    UsageError if the torque is a share of the rated torque, and that isn't given.
    """
    file = str(path)
    encoding = encoding_of(path)
    source = blocks(path, encoding)
    head = next(source, None)
    if head is None:
        raise CsvUnusable("the file is empty", where=file)
    layout = find_layout(head.lines, choices, file)
    factors = _factors(layout, rated_torque_nm, file)
    warnings = [*layout.assumed]
    if encoding == "cp1252":
        warnings.insert(0, f"{file}: not UTF-8; read as Windows-1252 (Latin-1)")
    reader = RowReader(layout)
    columns, lines = _collect(chain([head], source), reader, warnings, file)
    warnings += _left_out(reader, layout, file)
    for column, factor in zip(columns, factors, strict=True):
        np.multiply(column, factor, out=column)
    columns, lines = _possible(columns, lines, warnings, file)
    if layout.clock:
        columns[0] -= columns[0][0]
    keep, notes = rising(columns[0], lines, file)
    if not np.all(keep):
        columns = [column[keep] for column in columns]
    return Trace(columns[0], columns[1], columns[2], (*warnings, *notes))


def _factors(layout: Layout, rated_torque_nm: float | None, file: str) -> list[float]:
    factors = []
    for unit in layout.units:
        if unit.of_rated and rated_torque_nm is None:
            raise UsageError(
                f"the torque is in {unit.symbol} of the rated torque, which is not given",
                where=f"{file}:{layout.header.line}",
                next_step="Add --rated-torque, in N·m, from the name plate or the drive",
            )
        factors.append(unit.factor * (rated_torque_nm or 1.0) if unit.of_rated else unit.factor)
    return factors


def _collect(
    source: Iterator[Block], reader: RowReader, warnings: list[str], file: str
) -> tuple[list[FloatArray], LineArray]:
    """The three columns and the lines, at most `MAX_ROWS` of them."""
    parts: tuple[list[FloatArray], ...] = ([], [], [])
    numbers: list[LineArray] = []
    room = MAX_ROWS
    for block in source:
        values, lines = reader.read(block)
        over = len(lines) > room
        if over:
            warnings.append(f"{file}:{lines[room]}: more than {MAX_ROWS} rows; what follows is not read")
            values, lines = values[:room], lines[:room]
        for part, column in zip(parts, values.T, strict=True):
            part.append(np.ascontiguousarray(column))
        numbers.append(lines)
        room -= len(lines)
        if over:
            break
    columns = []
    for part in parts:
        columns.append(np.concatenate(part))
        part.clear()      # one column at a time, so that the peak is not twice the record
    return columns, np.concatenate(numbers)


def _left_out(reader: RowReader, layout: Layout, file: str) -> list[str]:
    """Warnings for what was dropped; CsvUnusable where that is so much that the rest can't be trusted."""
    ragged, odd = reader.ragged, reader.unreadable
    if ragged.count > _MOST_ODD * reader.rows:
        comma = layout.header.delimiter == ","
        raise CsvUnusable(
            f"{_rows(ragged)} not as many cells as the header, which has {len(layout.header.names)}",
            where=f"{file}:{ragged.first}",
            next_step="With decimal commas the separator must be a semicolon or a tab" if comma else "Export it again",
        )
    if odd.count > _MOST_ODD * reader.rows:
        raise CsvUnusable(
            f"{_rows(odd)} something else than a number in time, speed or torque",
            where=f"{file}:{odd.first}", next_step="Look at this line in an editor",
        )
    causes = ((ragged, "cells missing or too many"), (reader.missing, "no value"), (odd, "no readable number"))
    return [
        f"{file}:{tally.first}: {tally.count} {'row was' if tally.count == 1 else 'rows were'} dropped: {cause}"
        for tally, cause in causes if tally.count
    ]


def _possible(
    columns: list[FloatArray], lines: LineArray, warnings: list[str], file: str
) -> tuple[list[FloatArray], LineArray]:
    """Without the rows that no machine can have; CsvUnusable if none is left."""
    good = np.ones(len(lines), dtype=np.bool_)
    for column in columns:
        good &= np.abs(column) < LARGEST
    if not np.any(good):
        raise CsvUnusable("no row has a time, a speed and a torque", where=file, next_step="Look at it in an editor")
    lost = np.flatnonzero(~good)
    if len(lost):
        many = "1 row was" if len(lost) == 1 else f"{len(lost)} rows were"
        warnings.append(f"{file}:{lines[lost[0]]}: {many} dropped: a number beyond every machine")
        columns, lines = [column[good] for column in columns], lines[good]
    return columns, lines


def _rows(tally: Tally) -> str:
    return "1 row has" if tally.count == 1 else f"{tally.count} rows have"
