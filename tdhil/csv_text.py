"""Text in a CSV cell that no spreadsheet takes for a formula, and back.

A spreadsheet runs a cell that begins with ``=``, ``+``, ``-``, ``@``, a tab or a line break as a formula. A rig's
name, a note or a file's name may begin so. An apostrophe in front makes it a text for every spreadsheet. `text_of`
takes that one apostrophe off again, so that our own tables give back what was written. Numbers are never touched.
"""

from __future__ import annotations

import re
from typing import Final

_FORMULA: Final = re.compile(r"'*[=+\-@\t\r\n\uff1d\uff0b\uff0d\uff20]")
"""Also their wide forms, which some spreadsheets take alike; and what our own apostrophe stands before already."""


def cell_of(text: str) -> str:
    """Return the text for a CSV cell, with an apostrophe in front where it could be a formula."""
    return f"'{text}" if _FORMULA.match(text) else text


def text_of(cell: str) -> str:
    """Return the text that `cell_of` made this cell of."""
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell) else cell
