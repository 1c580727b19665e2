"""Something that happened in a run and is worth a line: an error, a warning, a drop, a key press."""

from dataclasses import dataclass
from typing import Final

RECOVERED: Final = "recovered"
"""Kind of the event in a salvaged copy: the copy is whole, the run that it shows is not."""


FAILURE: Final = "failure"
INTERRUPTED: Final = "interrupted"
"""Kinds of the event that ended a run: what went wrong, or who asked for it."""


@dataclass(frozen=True)
class Event:
    """``time_s`` is control time; ``kind`` is one lower-case word; ``traceback`` is empty where there was none."""

    time_s: float
    kind: str
    text: str
    traceback: str = ""
