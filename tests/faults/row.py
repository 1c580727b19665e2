"""Row of the fault table."""

from dataclasses import dataclass

from tdhil.session import REQUIRED

HERE = "tests/faults/"


@dataclass(frozen=True)
class Row:
    """Row. ``codes``: allowed exit codes. ``said``: findings of other tests, if no test here measures the row."""

    fault: str
    expected: str
    codes: str
    tests: tuple[str, ...]
    said: str = ""


def must(row):
    """Return the required reaction to a fault that can be scripted: the product judges a rehearsal by the same text."""
    return REQUIRED[row].reaction
