"""Cells and the numbers in them: quotes, decimal comma or point, signs between thousands.

A dot in a column with decimal commas, or a comma in one with decimal points, is read only where it can mean nothing but
thousands (``1.234,5``, ``1,234.5``). ``1.234`` among ``0,5`` could be either, and is no number here.
"""

import csv
import math
import re
from collections.abc import Iterable, Sequence

LARGEST = 1e12        # beyond it, in SI, is no machine but a place-holder such as 3.4e38
_MISSING = {"", "-", "--", "nan", "n/a", "na", "#n/a", "null", "none", "inf", "-inf", "+inf", "1.#qnan", "#nv", "?"}
_POINTED = re.compile(r"[+-]?\d{1,3}(,\d{3})+\.\d*")
_COMMAED = re.compile(r"[+-]?\d{1,3}(\.\d{3})+,\d*")
_DIGITS = re.compile(r"[+-]?\d*[.,]?\d*([eE][+-]?\d+)?")
_SPACES = str.maketrans({"\u2212": "-", "\u00a0": None, "\u202f": None, "'": None, "’": None})


def split_cells(line: str, delimiter: str) -> list[str]:
    """The cells of one line, stripped. A quote never reaches beyond its line."""
    if '"' in line:
        try:
            return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))]
        except (csv.Error, StopIteration):
            pass
    return [cell.strip() for cell in line.split(delimiter)]


def is_missing(cell: str) -> bool:
    """An empty cell, or what tools write for no value."""
    return cell.casefold() in _MISSING


def number(cell: str, comma: bool) -> float | None:
    """The finite number in a cell, or None. ``comma``: the decimal sign."""
    if not comma or ("." not in cell and "," in cell):       # the usual case, before what costs time
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
    """A number under either decimal sign."""
    return number(cell, False) is not None or number(cell, True) is not None


def decimal_sign(rows: Iterable[Sequence[str]]) -> str:
    """``,`` or ``.``, or ``?`` where rows speak for both; of the wanted cells of some rows at the beginning."""
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
