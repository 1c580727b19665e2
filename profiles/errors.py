"""The root of the error tree, and the errors of data files.

The root stands here because `profiles` lies below every other room; `drivers.errors` re-exports it and
draws the whole tree.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

from profiles.messages import MessageCode, with_code
from profiles.visible_text import visible

_FLAG: Final = re.compile(r"(?<![\w-])--?[a-z][a-z-]*(?![\w-])")


class TdhilError(Exception):
    """Root of each error that a user can cause or meet.

    ``what`` happened, ``where`` (file:line, object, register, stage) and ``next_step``, the cure. Texts name options by
    their flags; ``spelling`` maps a flag to its name in another interface (API, Python).
    ``entry``: the entry of the table of messages; without one, that of the class.
    """

    spelling: Mapping[str, str] = MappingProxyType({})
    entry: MessageCode = MessageCode.INTERNAL_ERROR

    def __init__(self, what: str, *, where: str = "", next_step: str = "", entry: MessageCode | None = None) -> None:
        super().__init__(what)
        self.what = what
        self.where = where
        self.next_step = next_step
        if entry is not None:
            self.entry = entry

    @property
    def coded(self) -> str:
        """The text for a person, followed by its code."""
        return with_code(str(self), self.entry.code)

    def __str__(self) -> str:
        text = f"{self.where}: {self.what}" if self.where else self.what
        text = f"{text}. {self.next_step}" if self.next_step else text
        return visible(_FLAG.sub(lambda found: self.spelling.get(found[0], found[0]), text), keep="\n")


@dataclass(frozen=True)
class Problem:
    """One thing wrong with a data file; ``line`` counts from 1, 0 where no line can be named.

    As text it is one printable line, whatever the file holds: a key may be a line break or turn the writing around.
    """

    file: str
    line: int
    message: str

    def __str__(self) -> str:
        text = f"{self.file}:{self.line}: {self.message}" if self.line else f"{self.file}: {self.message}"
        return visible(text)


class DataFileError(TdhilError):
    """A YAML, EDS or other data file that can't be used; carries every problem found, not only the first."""

    entry = MessageCode.DATA_FILE_WRONG

    def __init__(self, problems: tuple[Problem, ...], *, entry: MessageCode | None = None) -> None:
        super().__init__("\n".join(str(problem) for problem in problems), entry=entry)
        self.problems = problems
