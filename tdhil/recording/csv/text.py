"""Reading of a text file in blocks of whole lines, for any encoding, in limited memory.

UTF-8 and UTF-16 are recognised by their byte order mark. Without one the encoding is UTF-8 if the beginning decodes as
UTF-8, else Windows-1252, which includes the letters of Latin-1. Line ends may be LF, CR LF or CR.

This is an own reader, with `csv` for lines with quotes. The readers of numpy and pandas stop at the first bad row, or
skip it silently. Here each bad row is counted by its cause, with its line.
"""

import codecs
import csv
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path

from tdhil.errors import CsvUnusable

# ---------------------------------------------------------------------------------------------------------------------
# Times of day and time stamps, as seconds since the beginning of the first day.
#
# Accepted forms: ``12:00:00.123`` (also with decimal comma), ``00:12.3`` (minutes), with or without AM or PM. A date
# may precede (``2024-05-01T``, ``2024/05/01``, ``01.05.2024``), a zone may follow (``Z``, ``+02:00``). Without a date,
# a clock that changes from the last hour of a day to the first one has passed midnight. ``5/1/2024`` is not accepted,
# because day and month are ambiguous.


_DAY_S = 86400.0
_CLOCK = re.compile(
    r"(?:(?P<date>[^\s:]+?)[T\s]\s*)?(?:(?P<hour>\d{1,3}):)?(?P<minute>\d{1,2}):(?P<second>\d{1,2}(?:[.,]\d*)?)"
    r"\s*(?P<half>[AaPp]\.?[Mm]\.?)?\s*(?P<zone>Z|[+-]\d{2}:?\d{2})?",
    re.ASCII,
)
_YEAR_FIRST = re.compile(r"(\d{4})[-/.](\d{1,2})[-/.](\d{1,2})", re.ASCII)
_YEAR_LAST = re.compile(r"(\d{1,2})[.](\d{1,2})[.](\d{4})", re.ASCII)


class ClockReader:
    """Reader of one column of clock times from top to bottom; it stores the day."""

    def __init__(self) -> None:
        self._prefix = "\0"        # text up to the last colon of the row before, without zone and AM or PM
        self._base_s = 0.0         # value of this text, s
        self._last_s = 0.0         # s, within its own day
        self._days: dict[str, int] = {}
        self._night = 0
        self._first: int | None = None

    def seconds(self, cell: str) -> float | None:
        """Return seconds since the beginning of the first cell's day; None if the cell is not a time."""
        prefix, _, tail = cell.rpartition(":")
        if prefix == self._prefix and len(tail) >= 2 and tail[:2].isdigit():
            try:
                return self._base_s + float(tail.replace(",", "."))
            except ValueError:
                pass
        found = _CLOCK.fullmatch(cell)
        if found is None or (found["hour"] is None and not re.search(r"[.,]", found["second"])):
            return None
        minutes, second = int(found["minute"]), float(found["second"].replace(",", "."))
        hours = int(found["hour"] or 0)
        if minutes > 59 or second >= 61.0 or (found["date"] and hours > 24):
            return None
        if found["half"]:
            hours = hours % 12 + (12 if found["half"][0] in "Pp" else 0)
        base, zone = 3600.0 * hours + 60.0 * minutes, found["zone"]
        if zone not in (None, "Z"):
            offset = 3600.0 * int(zone[1:3]) + 60.0 * int(zone[-2:])
            base -= -offset if zone[0] == "-" else offset
        day = self._day(found["date"] or "", base)
        if day is None:
            return None
        self._base_s = base + _DAY_S * day
        self._prefix = "\0" if found["half"] or zone else prefix
        return self._base_s + second

    def _day(self, text: str, of_day_s: float) -> int | None:
        """Return the days since the first cell's day; None for an invalid date, or one with ambiguous day and month."""
        if not text:
            if self._last_s >= _DAY_S - 3600.0 and of_day_s < 3600.0:
                self._night += 1
            self._last_s = of_day_s
            return self._night
        if text not in self._days:
            if len(self._days) > 366:
                return None
            try:
                if found := _YEAR_FIRST.fullmatch(text):
                    ordinal = date(int(found[1]), int(found[2]), int(found[3])).toordinal()
                elif found := _YEAR_LAST.fullmatch(text):
                    ordinal = date(int(found[3]), int(found[2]), int(found[1])).toordinal()
                else:
                    return None
            except ValueError:
                return None
            if self._first is None:
                self._first = ordinal
            self._days[text] = ordinal - self._first
        return self._days[text]


# ---------------------------------------------------------------------------------------------------------------------
# Cells and the numbers in them: quotes, decimal comma or point, signs between thousands.
#
# A dot in a column with decimal commas, or a comma in one with decimal points, is accepted only if it must separate
# thousands (``1.234,5``, ``1,234.5``). ``1.234`` in a column with ``0,5`` is ambiguous, and is not accepted. In a file
# without any such sign of the other kind, ``1.234`` may still be 1234. A sign is a decimal one if one cell has another
# number of decimals, begins with 0, or has four digits in its whole part. Else each cell with it has three decimals: a
# fixed format, which has no integers in its column and as many decimals in most columns, or thousands.


LARGEST = 1e12        # in SI; a larger value is a place-holder such as 3.4e38
_MISSING = {"", "-", "--", "nan", "n/a", "na", "#n/a", "null", "none", "inf", "-inf", "+inf", "1.#qnan", "#nv", "?"}
_POINTED = re.compile(r"[+-]?\d{1,3}(,\d{3})+\.\d*")
_COMMAED = re.compile(r"[+-]?\d{1,3}(\.\d{3})+,\d*")
_DIGITS = re.compile(r"[+-]?\d*[.,]?\d*([eE][+-]?\d+)?")
_THREE = re.compile(r"[+-]?[1-9]\d{0,2}[.,]\d{3}")
_INTEGER = re.compile(r"[+-]?0*([1-9]\d*)")
_SPACES = str.maketrans({"\u2212": "-", "\u00a0": None, "\u202f": None, "'": None, "’": None})


def split_cells(line: str, delimiter: str) -> list[str]:
    """Return the cells of one line, stripped. A quote never extends beyond its line."""
    if '"' in line:
        try:
            return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))]
        except (csv.Error, StopIteration):
            pass
    return [cell.strip() for cell in line.split(delimiter)]


def is_missing(cell: str) -> bool:
    """Return whether a cell is empty, or has a tool's text for no value."""
    return cell.casefold() in _MISSING


def number(cell: str, comma: bool) -> float | None:
    """Return the finite number in a cell, or None. ``comma``: the decimal sign is a comma."""
    if not comma or ("." not in cell and "," in cell):       # the usual case first, because it is fast
        value = _float(cell.replace(",", ".") if comma else cell)
        if value is not None:
            return value
    text = cell.translate(_SPACES)
    if comma:
        if "," in text:
            text = (text.replace(".", "") if _COMMAED.fullmatch(text) else text).replace(",", ".", 1)
            if "," in text:
                return None
        elif "." in text:
            return None
    elif "," in text:
        if not _POINTED.fullmatch(text):
            return None
        text = text.replace(",", "")
    return _float(text)


def _float(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) and "_" not in text else None


def looks_numeric(cell: str) -> bool:
    """Return whether a cell is a number with either decimal sign."""
    return number(cell, False) is not None or number(cell, True) is not None


def decimal_sign(rows: Iterable[Sequence[str]]) -> str:
    """Return ``,`` or ``.``, or ``?`` for a contradiction, from the required cells of some rows at the beginning."""
    signs = set()
    for row in rows:
        for cell in row:
            text = cell.translate(_SPACES)
            if _COMMAED.fullmatch(text):
                signs.add(",")
            elif _POINTED.fullmatch(text):
                signs.add(".")
            elif _DIGITS.fullmatch(text) and ("," in text or "." in text):
                signs.add("," if "," in text else ".")
    if len(signs) > 1:
        return "?"
    return signs.pop() if signs else "."


def perhaps_thousands(rows: Iterable[Sequence[str]]) -> tuple[int, str] | None:
    """Return the column whose only sign may separate thousands, and such a cell; None if the sign is a decimal one."""
    three: dict[int, str] = {}
    digits: dict[int, int] = {}        # most digits of an integer other than 0, by column
    for row in rows:
        for at, cell in enumerate(row):
            text = cell.translate(_SPACES)
            if _THREE.fullmatch(text):
                three.setdefault(at, text)
            elif found := _INTEGER.fullmatch(text):
                digits[at] = max(digits.get(at, 0), len(found[1]))
            elif ("." in text or "," in text) and _DIGITS.fullmatch(text):
                return None
    if any(digits.get(at, 0) > 3 for at in three):
        return None
    mixed = [at for at in three if at in digits]
    chosen = mixed or (list(three) if len(three) == 1 else [])
    return (chosen[0], three[chosen[0]]) if chosen else None


# ---------------------------------------------------------------------------------------------------------------------

MAX_BYTES = 4 * 2**30
MAX_LINE = 64 * 1024      # characters; a line of a table has some hundred
_BLOCK = 1 << 20          # characters
_HEAD = 64 * 1024
_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_PACKED = {
    b"PK\x03\x04": "a spreadsheet (.xlsx) or a zip",
    b"\xd0\xcf\x11\xe0": "a spreadsheet (.xls)",
    b"\x1f\x8b": "a gzip",
}


@dataclass(frozen=True)
class LineBlock:
    """Lines without their ends; ``first`` is the number of the first line, from 1."""

    first: int
    lines: list[str]


def encoding_of(path: Path) -> str:
    """Return the encoding of ``path``. Raises CsvUnusable for an empty, too large, packed, binary or unreadable
    file.
    """
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            head = file.read(_HEAD)
    except OSError as error:
        raise CsvUnusable(f"can't be read ({error.strerror or error})", where=str(path)) from error
    if not head:
        raise CsvUnusable("the file is empty", where=str(path),
                          next_step="Nothing was recorded in it, or its copy failed. Copy it again, or repeat the run")
    if size > MAX_BYTES:
        raise CsvUnusable(
            f"the file is larger than {MAX_BYTES >> 30} GiB", where=str(path),
            next_step="Export the stretch with the excitation alone",
        )
    for magic, what in _PACKED.items():
        if head.startswith(magic):
            raise CsvUnusable(f"this is {what} file, no text", where=str(path), next_step="Save the table as CSV")
    found = next((name for mark, name in _MARKS if head.startswith(mark)), None)
    if found is None:
        try:
            codecs.getincrementaldecoder("utf-8")().decode(head)     # incremental: the cut may be inside a character
            found = "utf-8"
        except UnicodeDecodeError:
            found = "cp1252"
    # a logger that lost power leaves NUL characters after its last line
    text = codecs.getincrementaldecoder(found)(errors="replace").decode(head).rstrip("\0")
    odd = sum(sign < " " and sign not in "\t\n\r\f\v" for sign in text)
    if not text or "\0" in text[:1024] or odd > 0.05 * len(text):
        raise CsvUnusable(
            "this is neither text nor a run.mcap", where=str(path),
            next_step="The log is damaged from its start: look for another copy" if path.suffix == ".mcap"
            else "Export the trace as CSV, in UTF-8 (UTF-16 needs its byte order mark)",
        )
    return found


def blocks(path: Path, encoding: str) -> Iterator[LineBlock]:
    """Yield the lines of the file, about a million characters at a time. Raises CsvUnusable for a line that is too
    long.
    """
    first, rest = 1, ""
    try:
        with path.open("r", encoding=encoding, errors="replace", newline=None) as file:
            while chunk := file.read(_BLOCK):
                lines = (rest + chunk.replace("\0", "")).split("\n")
                rest = lines.pop()
                if max(map(len, lines), default=0) > MAX_LINE or len(rest) > MAX_LINE:
                    at = next(at for at, line in enumerate([*lines, rest], first) if len(line) > MAX_LINE)
                    raise CsvUnusable(
                        f"a line of more than {MAX_LINE} characters is none of a table", where=f"{path}:{at}",
                        next_step="Look at the file in an editor",
                    )
                if lines:
                    yield LineBlock(first, lines)
                    first += len(lines)
    except OSError as error:
        raise CsvUnusable(f"can't be read ({error.strerror or error})", where=str(path)) from error
    except UnicodeError as error:
        raise CsvUnusable(f"can't be decoded as {encoding}", where=str(path)) from error
    if rest:
        yield LineBlock(first, [rest])
