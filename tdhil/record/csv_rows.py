"""Rows to numbers: whole blocks by numpy where every row is as expected, cell by cell where one isn't.

What is left out is counted by its cause, with the line of the first: a ragged row may be cut or may have decimal commas
between commas, and its columns can't be told apart.
"""

from copy import copy
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tdhil.record.csv_clock import ClockReader
from tdhil.record.csv_numbers import is_missing, number, split_cells
from tdhil.recording.csv.layout import Layout
from tdhil.recording.csv.text import Block
from tdhil.recording.recording import FloatArray

LineArray = NDArray[np.int64]


@dataclass
class Tally:
    """How many rows went one way, and the line of the first."""

    count: int = 0
    first: int = 0

    def add(self, line: int) -> None:
        self.count += 1
        self.first = self.first or line


class RowReader:
    """Reads a file's blocks in order; as the file has them, not yet in SI, but for clock times."""

    def __init__(self, layout: Layout) -> None:
        header = layout.header
        self._layout = layout
        self._width = len(header.names)
        self._delimiter, self._columns = header.delimiter, header.columns
        self._clock = ClockReader() if layout.clock else None
        self.ragged, self.missing, self.unreadable = Tally(), Tally(), Tally()
        self.rows = 0              # all that weren't blank

    def read(self, block: Block) -> tuple[FloatArray, LineArray]:
        """(N, 3) time, speed, torque and (N,) line numbers of the usable rows at or below the layout's first line."""
        skipped = max(0, self._layout.first_line - block.first)
        lines, first = block.lines[skipped:], block.first + skipped
        values = self._at_once(lines)
        if values is not None:
            self.rows += len(lines)
            numbers = first + np.arange(len(lines), dtype=np.int64)
            if np.all(np.isfinite(values)):
                return values, numbers
        else:
            values, numbers = self._one_by_one(lines, first)
        good = np.all(np.isfinite(values), axis=1)
        for line in numbers[~good]:
            self.missing.add(int(line))
        return values[good], numbers[good]

    def _at_once(self, lines: list[str]) -> FloatArray | None:
        """All lines, if none of them needs a second look."""
        if not lines or any('"' in line for line in lines):
            return None
        delimiter = self._delimiter
        if any(line.count(delimiter) != self._width - 1 for line in lines):
            return None
        if self._layout.comma:
            if delimiter == "," or any("." in line for line in lines):
                return None
            lines = [line.replace(",", ".") for line in lines]
        wanted = self._columns if self._clock is None else self._columns[1:]
        try:
            values = np.loadtxt(lines, dtype=np.float64, delimiter=delimiter, usecols=wanted, comments=None, ndmin=2)
        except (ValueError, OverflowError):
            return None
        if len(values) != len(lines):
            return None
        return values if self._clock is None else self._timed(lines, values)

    def _timed(self, lines: list[str], values: FloatArray) -> FloatArray | None:
        """The block's clock times beside its values; None, with the clock where it was, if one can't be read."""
        assert self._clock is not None
        before = copy(self._clock)
        column, seconds = self._columns[0], self._clock.seconds
        times = [seconds(line.split(self._delimiter, column + 1)[column].strip()) for line in lines]
        if None in times:
            self._clock = before
            return None
        return np.column_stack([np.array(times, dtype=np.float64), values])

    def _one_by_one(self, lines: list[str], first: int) -> tuple[FloatArray, LineArray]:
        found: list[tuple[float, float, float]] = []
        numbers: list[int] = []
        for at, line in enumerate(lines, first):
            if not line or line.isspace():
                continue
            self.rows += 1
            row = self._row(line, at)
            if row is not None:
                found.append(row)
                numbers.append(at)
        return np.array(found, dtype=np.float64).reshape(-1, 3), np.array(numbers, dtype=np.int64)

    def _row(self, line: str, at: int) -> tuple[float, float, float] | None:
        cells = split_cells(line, self._delimiter)
        # A separator behind the last cell is a habit of some tools, a row without its last, empty cells of others.
        if len(cells) <= max(self._columns) or any(cells[self._width :]):
            self.ragged.add(at)
            return None
        wanted = [cells[column] for column in self._columns]
        comma = self._layout.comma
        time = number(wanted[0], comma) if self._clock is None else self._clock.seconds(wanted[0])
        speed, torque = number(wanted[1], comma), number(wanted[2], comma)
        if time is None or speed is None or torque is None:
            (self.missing if any(map(is_missing, wanted)) else self.unreadable).add(at)
            return None
        return time, speed, torque
