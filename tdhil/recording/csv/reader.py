"""Reading of a trace, with further data of the bench, as a Recording."""

import math
from collections.abc import Iterator, Mapping
from copy import copy
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tdhil.errors import CsvMisnamed, CsvUnusable, MessageCode, UsageError, shown
from tdhil.recording.csv.excitation import load_excitation
from tdhil.recording.csv.layout import (
    REFERENCE_FLAG,
    USUAL,
    Choices,
    ColumnLayout,
    columns_flag,
    find_layout,
    named,
)
from tdhil.recording.csv.text import (
    LARGEST,
    ClockReader,
    LineBlock,
    blocks,
    encoding_of,
    is_missing,
    number,
    split_cells,
)
from tdhil.recording.recording import BoolArray, FloatArray, LagPrior, Recording

# ---------------------------------------------------------------------------------------------------------------------
# Conversion of rows to numbers: whole blocks by numpy if every row is regular, else cell by cell.
#
# Rows that are left out are counted by cause, with the line of the first. A ragged row may be cut or may have decimal
# commas between commas, so its columns are ambiguous.


LineArray = NDArray[np.int64]


@dataclass
class Tally:
    """Number of rows with one cause, and the line of the first."""

    count: int = 0
    first: int = 0

    def add(self, line: int) -> None:
        self.count += 1
        self.first = self.first or line


class RowReader:
    """Reader of a file's blocks in order; values are in the file's units, except clock times, which become seconds."""

    def __init__(self, layout: ColumnLayout) -> None:
        header = layout.header
        self._layout = layout
        self._width = len(header.names)
        self._delimiter = header.delimiter
        self.columns = self._columns = header.columns
        self._clock = ClockReader() if layout.clock else None
        self.ragged, self.missing, self.unreadable = Tally(), Tally(), Tally()
        self.rows = 0              # all rows that are not blank

    def read(self, block: LineBlock) -> tuple[FloatArray, LineArray]:
        """Return the columns of the layout (N, K) and the line numbers (N,) of the usable rows from the layout's
        first line on.
        """
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
        """Return all lines as numbers, if every line is regular."""
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
        if self._clock is None:
            return values
        before = copy(self._clock)
        column, seconds = self._columns[0], self._clock.seconds
        times = [seconds(line.split(delimiter, column + 1)[column].strip()) for line in lines]
        if None in times:
            self._clock = before        # unchanged if one time cannot be read
            return None
        return np.column_stack([np.array(times, dtype=np.float64), values])

    def _one_by_one(self, lines: list[str], first: int) -> tuple[FloatArray, LineArray]:
        found: list[list[float]] = []
        numbers: list[int] = []
        for at, line in enumerate(lines, first):
            if not line or line.isspace():
                continue
            self.rows += 1
            row = self._row(line, at)
            if row is not None:
                found.append(row)
                numbers.append(at)
        return np.array(found, dtype=np.float64).reshape(-1, len(self._columns)), np.array(numbers, dtype=np.int64)

    def _row(self, line: str, at: int) -> list[float] | None:
        cells = split_cells(line, self._delimiter)
        # some tools write a separator after the last cell; others leave out the last, empty cells of a row
        if len(cells) <= max(self._columns) or any(cells[self._width :]):
            self.ragged.add(at)
            return None
        wanted = [cells[column] for column in self._columns]
        comma = self._layout.comma
        time = number(wanted[0], comma) if self._clock is None else self._clock.seconds(wanted[0])
        values = [time, *(number(cell, comma) for cell in wanted[1:])]
        known = [value for value in values if value is not None]
        if len(known) < len(values):
            (self.missing if any(map(is_missing, wanted)) else self.unreadable).add(at)
            return None
        return known


# ---------------------------------------------------------------------------------------------------------------------
# Checks of the time stamps from a drive's tool: repeated, out of order, or with gaps; some faults can be corrected.


LONGEST_S = 7 * 86400.0
_MOST_DROPPED = 0.10      # largest share of rows dropped; with more it is not one recording
GAP_INTERVALS = 5.0       # usual intervals, from which a gap is reported
LEAST_GAP_S = 0.1         # shortest gap that is left where a clock was set back. A choice: estimation bridges 0.05 s


def rising(time_s: FloatArray, lines: LineArray, file: str) -> tuple[BoolArray, list[str]]:
    """Return the rows to keep (N,), and warnings. Raises CsvUnusable for rows without order, or of a week or longer."""
    keep = np.ones(len(time_s), dtype=np.bool_)
    if len(time_s) < 2:
        return keep, []
    # drop a single stamp that is too high between two good ones, and not all rows after it
    keep[1:-1] = ~((time_s[1:-1] > time_s[2:]) & (time_s[2:] > time_s[:-2]))
    kept = np.flatnonzero(keep)
    highest = np.maximum.accumulate(time_s[kept])
    keep[kept[1:]] = time_s[kept][1:] > highest[:-1]
    lost = np.flatnonzero(~keep)
    warnings = []
    if len(lost):
        first = int(lost[0])
        step = float(time_s[first] - time_s[first - 1])
        how = "repeats itself" if step == 0.0 else "goes back" if step < 0.0 else "jumps ahead and back"
        if len(lost) > _MOST_DROPPED * len(time_s):
            raise CsvUnusable(
                f"the time {how}, here and in {len(lost) - 1} more of {len(time_s)} rows",
                where=f"{file}:{lines[first]}",
                next_step="Export one recording, in its order, with time stamps as fine as the samples",
            )
        apart = _kept_apart(time_s, keep)
        by = f" by {-step:.3g} s" if step < 0.0 else ""
        warnings.append(f"{file}:{lines[first]}: {_row_list(int(np.sum(~keep)))} dropped, where the time {how}{by}"
                        + ("; a gap was left there, because the clock was set back" if apart else ""))
    steps = np.diff(time_s[keep])
    if not len(steps):
        return keep, warnings
    usual, widest = float(np.median(steps)), int(np.argmax(steps))
    line = int(lines[keep][widest + 1])
    if float(np.sum(steps)) > LONGEST_S:
        raise CsvUnusable(
            f"the time spans {float(np.sum(steps)):.3g} s, more than a week", where=f"{file}:{line}",
            next_step="Check the unit of time (--columns time=…:ms), and the widest gap, which is at this line",
        )
    gaps = int(np.sum(steps > GAP_INTERVALS * usual))
    if gaps:
        plural = "gap" if gaps == 1 else "gaps"
        warnings.append(f"{file}:{line}: {gaps} {plural} in the time, the widest of {steps[widest]:.3g} s here")
    return keep, warnings


def _kept_apart(time_s: FloatArray, keep: BoolArray) -> bool:
    """Leave out further rows in ``keep``, so that a gap remains where the clock was set back; return whether it was.

    The rows after such a place continue from the earlier time. Those behind the highest time so far are later than
    their stamps say, and the motion between both parts is not known. A single stamp out of order is no such place.
    """
    lost = ~keep
    begins = 1 + np.flatnonzero(lost[1:-1] & lost[2:] & (time_s[1:-1] < time_s[:-2]) & (time_s[2:] > time_s[1:-1]))
    kept = np.flatnonzero(keep)
    highest = time_s[kept][np.searchsorted(kept, begins) - 1]
    gap_s = max(LEAST_GAP_S, (GAP_INTERVALS + 1.0) * float(np.median(np.diff(time_s[kept])))) if len(kept) > 1 else 0.0
    for first, last in np.searchsorted(time_s[kept], np.stack([highest, highest + gap_s], axis=1), side="right"):
        keep[kept[first:last]] = False
    return len(begins) > 0


def _row_list(count: int) -> str:
    return "1 row was" if count == 1 else f"{count} rows were"


# ---------------------------------------------------------------------------------------------------------------------
# Trace from a drive's own tool: samples in SI, and warnings on assumptions and on rows left out.


MAX_ROWS = 10_000_000      # rows, at most; each takes 32 bytes during reading
_MOST_ODD = 0.10           # largest share of rows that are ragged, or without a number


@dataclass(frozen=True)
class CsvTrace:
    """Trace: (N,) each, SI, time rising; ``warnings``: one line each."""

    time_s: FloatArray
    speed_rad_s: FloatArray
    torque_nm: FloatArray
    warnings: tuple[str, ...]


def read_trace(path: Path, choices: Choices = USUAL, rated_torque_nm: float | None = None) -> CsvTrace:
    """Return the trace in ``path``. Raises CsvMisnamed for columns and units, CsvUnusable otherwise, with file and
    line.

    Raises UsageError if the torque is a share of the rated torque, and the rated torque is missing.
    """
    (time, speed, torque), warnings = _read_columns(path, choices, rated_torque_nm)
    return CsvTrace(time, speed, torque, warnings)


@dataclass(frozen=True)
class ReferenceTrace:
    """Torque of a reference sensor: (N,) each, SI, time rising; ``warnings``: one line each."""

    time_s: FloatArray
    torque_nm: FloatArray
    warnings: tuple[str, ...]


def read_reference(path: Path, choices: Choices) -> ReferenceTrace:
    """Return the trace of a reference sensor, without a speed. Raises like `read_trace`, and CsvUnusable for a lost
    row.

    A calibration uses every value of the sensor. A missing value, or a time that does not rise, is therefore refused.
    Only a row that repeats the one before it is left out.
    """
    (time, torque), warnings = _read_columns(path, choices, None, whole=True)
    return ReferenceTrace(time, torque, warnings)


def _read_columns(
    path: Path, choices: Choices, rated_torque_nm: float | None, *, whole: bool = False
) -> tuple[list[FloatArray], tuple[str, ...]]:
    """Return the columns of the choices, and warnings. ``whole``: no row may be left out."""
    file = str(path)
    encoding = encoding_of(path)
    source = blocks(path, encoding)
    head = next(source, None)
    if head is None:
        raise CsvUnusable("the file is empty", where=file)
    layout = find_layout(head.lines, choices, file)
    if whole and any(unit.of_rated for unit in layout.units):
        raise CsvMisnamed("the torque of a reference is needed in a unit of torque, not as a share of a rated torque",
                          where=f"{file}:{layout.header.line}", next_step=f"Such as: {REFERENCE_FLAG} torque=m:Nm")
    factors = _factors(layout, rated_torque_nm, file)
    warnings = [*layout.assumed]
    if encoding == "cp1252":
        warnings.insert(0, f"{file}: not UTF-8; read as Windows-1252 (Latin-1)")
    reader = RowReader(layout)
    columns, lines = _collect(chain([head], source), reader, warnings, file)
    dropped = _left_out(reader, layout, choices, file)
    for column, factor in zip(columns, factors, strict=True):
        np.multiply(column, factor, out=column)
    good = np.ones(len(lines), dtype=np.bool_)
    for column in columns:
        good &= np.abs(column) < LARGEST
    if not np.any(good):
        raise CsvUnusable(f"no row has {named(choices)}", where=file, next_step="Look at it in an editor")
    lost = np.flatnonzero(~good)
    if len(lost):
        dropped.append(f"{file}:{lines[lost[0]]}: {_row_list(len(lost))} dropped: a number beyond every machine")
        columns, lines = [column[good] for column in columns], lines[good]
    if layout.clock:
        columns[0] -= columns[0][0]
    if whole:
        again = np.concatenate([[False], np.all([np.diff(column) == 0.0 for column in columns], axis=0)])
        columns, lines = [column[~again] for column in columns], lines[~again]
    if layout.units[0].assumed and len(lines) > 1:
        _check_seconds(float(np.median(np.diff(columns[0]))), layout, choices, file)
    keep, notes = rising(columns[0], lines, file)
    if not np.all(keep):
        columns = [column[keep] for column in columns]
    if whole and (dropped or not np.all(keep)):
        where, _, what = [*dropped, *notes][0].removeprefix(f"{file}:").partition(": ")
        raise CsvUnusable(f"a reference must be whole: {what}", where=f"{file}:{where}",
                          next_step="Correct or remove this line in a copy of the file, or export it again")
    return columns, (*warnings, *dropped, *notes)


COARSE_S = 1.0
"""Step of the time, s, from which a time without a unit is not taken for seconds. A choice: drives, PLCs and loggers
sample faster, and their counts of samples and of milliseconds have steps of 1 and more."""


def _check_seconds(step: float, layout: ColumnLayout, choices: Choices, file: str) -> None:
    """Raise CsvMisnamed for a time without a unit whose usual step is too large for seconds."""
    if step < COARSE_S:
        return
    name, flag = shown(layout.header.names[layout.header.columns[0]]), columns_flag(choices)
    raise CsvMisnamed(
        f"no unit is stated for {name!r}, whose usual step is {step:g}. It may count milliseconds or samples",
        where=f"{file}:{layout.header.line}",
        next_step=f"State its unit: {flag} time='{name}:ms', or ':s' if it is in seconds. If it counts samples, divide "
        "it by the sample rate in a copy of the file",
    )


def _factors(layout: ColumnLayout, rated_torque_nm: float | None, file: str) -> list[float]:
    factors = []
    for unit in layout.units:
        if unit.of_rated and rated_torque_nm is None:
            raise UsageError(
                f"the torque is in {unit.symbol} of the rated torque, which is not given",
                where=f"{file}:{layout.header.line}",
                next_step="Add --rated-torque, in N·m, from the name plate or the drive",
                entry=MessageCode.RATED_TORQUE_MISSING,
            )
        factors.append(unit.factor * (rated_torque_nm or 1.0) if unit.of_rated else unit.factor)
    return factors


def _collect(
    source: Iterator[LineBlock], reader: RowReader, warnings: list[str], file: str
) -> tuple[list[FloatArray], LineArray]:
    """Return the columns and the line numbers, at most `MAX_ROWS` rows."""
    parts: tuple[list[FloatArray], ...] = tuple([] for _ in reader.columns)
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
        part.clear()      # one column at a time, so that the memory is not twice that of the recording
    return columns, np.concatenate(numbers)


def _left_out(reader: RowReader, layout: ColumnLayout, choices: Choices, file: str) -> list[str]:
    """Return warnings for dropped rows. Raises CsvUnusable if there are too many of them."""
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
            f"{_rows(odd)} something else than a number in {named(choices).replace(' and ', ' or ')}",
            where=f"{file}:{odd.first}", next_step="Look at this line in an editor",
        )
    causes = ((ragged, "cells missing or too many"), (reader.missing, "no value"), (odd, "no readable number"))
    return [
        f"{file}:{tally.first}: {_row_list(tally.count)} dropped: {cause}"
        for tally, cause in causes if tally.count
    ]


def _rows(tally: Tally) -> str:
    return "1 row has" if tally.count == 1 else f"{tally.count} rows have"


# ---------------------------------------------------------------------------------------------------------------------

_LOOKED_AT = 200_000     # samples used to find the resolution
_ROUNDING = 1e-9         # of the largest value: smaller differences are rounding of the arithmetic


@dataclass(frozen=True)
class Bench:
    """Data of the bench that a trace does not contain: N·m and 1 at the motor shaft; None if unknown.

    ``skew_sd_s``: standard uncertainty of the time offset between speed and torque, s. None: the interval of one
    sample, because the tool may read speed and torque one after the other, but at least the usual value within a frame
    (`LagPrior`).
    """

    rated_torque_nm: float | None = None
    torque_limit_nm: float | None = None
    torque_scale_rel_sd: float = 0.0
    gear_ratio: float = 1.0
    lag_prior: LagPrior = field(default_factory=LagPrior)
    skew_sd_s: float | None = None


def read_recording(
    path: Path, choices: Choices = USUAL, excitation: Path | Mapping[str, Any] | None = None, bench: Bench | None = None
) -> tuple[Recording, tuple[str, ...]]:
    """Return the Recording, and a warning for each assumption and for rows left out.

    Raises like `read_trace`, and DataFileError for the file of the excitation.
    """
    bench = bench or Bench()
    trace = read_trace(path, choices, bench.rated_torque_nm)
    known, levels = (None, ()) if excitation is None else load_excitation(excitation, trace.time_s)
    count = len(trace.time_s)
    prior, skew_sd_s = bench.lag_prior, bench.skew_sd_s
    if skew_sd_s is None:
        usual_s = float(np.median(np.diff(trace.time_s))) if count > 1 else 0.0
        skew_sd_s = max(prior.skew_sd_s, usual_s)
    return Recording(
        time_s=trace.time_s,
        speed_rad_s=trace.speed_rad_s,
        torque_nm=trace.torque_nm,
        fresh=np.ones(count, dtype=np.bool_),
        limited=np.zeros(count, dtype=np.bool_),
        excitation=known,
        levels=levels,
        lag_prior=replace(prior, skew_sd_s=skew_sd_s),
        speed_resolution_rad_s=resolution(trace.speed_rad_s),
        torque_resolution_nm=resolution(trace.torque_nm),
        torque_limit_nm=bench.torque_limit_nm,
        torque_scale_rel_sd=bench.torque_scale_rel_sd,
        gear_ratio=bench.gear_ratio,
    ), trace.warnings


def resolution(signal: FloatArray) -> float:
    """Return the smallest step between two values, 0 for a constant: the quantum of a quantised signal.

    Without the quantum, the rounded crest of a small wave would look clipped.
    """
    values = np.unique(signal[:_LOOKED_AT])
    steps = np.diff(values)
    steps = steps[steps > _ROUNDING * float(np.max(np.abs(values)))]
    found = float(steps.min()) if len(steps) else 0.0
    return found if math.isfinite(found) else 0.0
