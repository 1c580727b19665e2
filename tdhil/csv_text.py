"""Text in CSV cells that no spreadsheet executes as a formula: conversion in both directions.

A spreadsheet runs a cell that begins with ``=``, ``+``, ``-``, ``@``, a tab or a line break as a formula. A rig's
name, a note or a file's name may begin with such a character. With an apostrophe in front, every spreadsheet reads it
as text. `text_of` removes this apostrophe, so that tables of tdhil are read as written. Numbers are never changed.
"""

from __future__ import annotations

import re
from typing import Final

_FORMULA: Final = re.compile(r"'*[=+\-@\t\r\n\uff1d\uff0b\uff0d\uff20]")
"""Start of a formula, also in the wide forms that some spreadsheets accept, and behind any apostrophes."""


def cell_of(text: str) -> str:
    """Return the text for a CSV cell, with an apostrophe in front if it could be a formula."""
    return f"'{text}" if _FORMULA.match(text) else text


def text_of(cell: str) -> str:
    """Return the text from which `cell_of` made this cell."""
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell) else cell
