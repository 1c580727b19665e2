"""The root of the error tree, and the errors of use and of data files.

The root is defined here because `profiles` lies below every other room. `drivers.errors` re-exports it and draws the
whole tree.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

from profiles.messages import MessageCode, with_code
from profiles.visible_text import visible

_FLAG: Final = re.compile(r"(?<![\w-])--?[a-z][a-z-]*(?![\w-])")


STOP_SAID: Final[Mapping[bool | None, str]] = {
    None: "tdhil stops the shaft.", True: "The shaft was stopped.", False: "Standstill was not confirmed.",
}
"""Text on the shaft, by the outcome of the stop; None: it is not known yet."""


class TdhilError(Exception):
    """Root of all errors that a user can cause or meet.

    ``what`` happened, ``where`` (file:line, object, register, stage), and ``next_step``, the remedy. Texts name options
    by their flags. ``spelling`` maps a flag to its keyword in Python; the service's pages show the label of its field.
    ``entry``: the entry of the table of messages; without it, that of the class. ``stops``: the error ends a motion.
    Its text then states the outcome of the stop (``stopped``), once this is known.
    """

    spelling: Mapping[str, str] = MappingProxyType({})
    entry: MessageCode = MessageCode.INTERNAL_ERROR

    def __init__(
        self, what: str, *, where: str = "", next_step: str = "", entry: MessageCode | None = None, stops: bool = False
    ) -> None:
        super().__init__(what)
        self.what = what
        self.where = where
        self.stops = stops
        self.stopped: bool | None = None
        self._remedy = next_step
        if entry is not None:
            self.entry = entry

    @property
    def next_step(self) -> str:
        """Return the remedy; of an error that ends a motion, with the outcome of the stop before it."""
        return f"{STOP_SAID[self.stopped]} {self._remedy}" if self.stops else self._remedy

    @next_step.setter
    def next_step(self, remedy: str) -> None:
        self._remedy = remedy

    @property
    def coded(self) -> str:
        """Return the text of the error with its code."""
        return with_code(str(self), self.entry.code)

    def __str__(self) -> str:
        text = f"{self.where}: {self.what}" if self.where else self.what
        text = f"{text}{'' if text.endswith('?') else '.'} {self.next_step}" if self.next_step else text
        return visible(_FLAG.sub(lambda found: self.spelling.get(found[0], found[0]), text), keep="\n")


class UsageError(TdhilError):
    """Refusal: the command line requests something impossible, or two things that exclude each other."""

    entry = MessageCode.USAGE


@dataclass(frozen=True)
class Problem:
    """One problem in a data file. ``line`` counts from 1; it is 0 if no line is known.

    Its text is one printable line, also if a key in the file contains a line break or changes the direction of writing.
    """

    file: str
    line: int
    message: str

    def __str__(self) -> str:
        text = f"{self.file}:{self.line}: {self.message}" if self.line else f"{self.file}: {self.message}"
        return visible(text)


class DataFileError(TdhilError):
    """A YAML, EDS or other data file that can't be used. It carries every problem found, not only the first."""

    entry = MessageCode.DATA_FILE_WRONG

    def __init__(self, problems: tuple[Problem, ...], *, entry: MessageCode | None = None) -> None:
        super().__init__("\n".join(str(problem) for problem in problems), entry=entry)
        self.problems = problems
