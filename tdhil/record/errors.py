"""What can be wrong with a log, below the root of the tree in `drivers.errors`.

::

    LogError                    empty, not MCAP, not a run of ours                               as the command says
    ├── LogUnopened             no such folder, no right to write there; nothing has moved       exit 2
    ├── LogRefused              too little space on the disk to begin with; nothing has moved    exit 4
    ├── LogBroken               the disk failed or ran full in mid-run: the shaft was stopped    exit 3
    ├── NothingRecoverable      of this file nothing can be read back                            exit 10
    └── NothingRecorded         the run was refused, or ended in setup: nothing to identify      exit as the run's

A run whose log broke off is a partial result, not an internal error: what had been written by then replays.
"""

from drivers.errors import TdhilError
from tdhil.errors import ExitCode


class LogError(TdhilError):
    """The log can't be written (disk full, no such folder) or can't be read (empty, not MCAP, not a run of ours)."""


class LogUnopened(LogError):
    """There can be no file at the place that was named."""

    exit_code = ExitCode.USAGE


class LogRefused(LogError):
    """The disk is too full for a run to be begun."""

    exit_code = ExitCode.REFUSED


class LogBroken(LogError):
    """The log ended before its run did."""

    exit_code = ExitCode.PARTIAL


class NothingRecoverable(LogError):
    """A log of which nothing can be read."""

    exit_code = ExitCode.NOTHING_RECOVERABLE


class NothingRecorded(LogError):
    """A log of a run that ended before there was anything to identify from; it ends as that run did."""

    def __init__(self, what: str, code: int, *, where: str = "", next_step: str = "") -> None:
        super().__init__(what, where=where, next_step=next_step)
        self.exit_code = ExitCode(code)
