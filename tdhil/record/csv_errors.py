"""What can be wrong with a trace in CSV, below `LogError` and so below the root of the tree.

::

    LogError
    ├── CsvMisnamed      trace.csv:4: no column 'n_rmp'; did you mean 'n_rpm'?         exit 2
    └── CsvUnusable      trace.csv:88: the time goes back, here and in 512 more rows   exit 10
"""

from tdhil.errors import ExitCode
from tdhil.record.errors import LogError


class CsvMisnamed(LogError):
    """A column or a unit that was asked for is not there, or not clear: the command line can mend it."""

    exit_code = ExitCode.USAGE


class CsvUnusable(LogError):
    """Nothing of the file can be used as a trace: another export is needed."""

    exit_code = ExitCode.NOTHING_RECOVERABLE


def shown(text: str) -> str:
    """``text`` for a message: printable, on one line, at most 40 characters."""
    clean = "".join(sign if sign.isprintable() else "·" for sign in text[:41])
    return clean if len(text) <= 40 else clean[:39] + "…"
