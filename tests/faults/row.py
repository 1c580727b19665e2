"""One row of the fault table."""

from dataclasses import dataclass

HERE = "tests/faults/"


@dataclass(frozen=True)
class Row:
    """``codes``: how the process may end. ``said``: what tests elsewhere show, where none here measures it."""

    fault: str
    expected: str
    codes: str
    tests: tuple[str, ...]
    said: str = ""
