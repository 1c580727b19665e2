"""Exit code of each error, for scripts of users and for the tests.

::

    TdhilError                      what, where, next step                                     exit
    ├── UsageError                  --node 300: must be at most 127                              2
    ├── DataFileError               rig.yaml:12: unknown key 'speed_max'                         2
    ├── PreflightRefused            the drive's identity is not the profile's; nothing moved     4
    │   └── DriveHeld               in `tdhil.session`: another process has the drive; names it  4
    ├── CommunicationLost           no statusword for 5 cycles; adapter unplugged                5
    ├── DriveFault                  EMCY 3210h in motion; state machine stuck                    6
    │   ├── SensorFault             EMCY 7305h in motion: the speed sensor is at fault           6
    │   ├── ModeNotConfirmed        6061h did not follow 6060h in time                           6
    │   └── ReportsContradict       reported speed and reported torque cannot both be true       6
    ├── LimitHit                    speed outside its window; torque or time limit reached       7
    ├── StopNotConfirmed            standstill was not confirmed after the stop sequence         8
    ├── CommandRejected             a NaN setpoint, an error in tdhil; it was not transmitted    1
    ├── LogError                    in `tdhil.errors`: each brings its own `exit_code`
    │   ├── LogUnopened             no such folder                                               2
    │   ├── LogBroken               the disk became full during the run; the shaft was stopped   3
    │   ├── LogRefused              too little disk space before the run; nothing moved          4
    │   └── NothingRecoverable      no message of the file can be read                          10
    ├── TuningRefused               `tdhil tune`: the requested gains can't be recommended      11
    ├── LoopTuningRefused           `tdhil tune speed`: no gains keep the margins               11
    └── Interrupted                 Ctrl-C (130); SIGTERM, SIGHUP, SIGQUIT, SIGTSTP (143); signal n (128 + n)

Codes 3 (partial result) and 9 (not identifiable, model rejected) belong to results, which are no errors. A log that
broke off has code 3, too, since its content can be replayed.
Each error has an entry in the table of messages (`profiles.messages`). The code of the entry is shown after the text.
An attribute ``exit_code`` of a class or an instance takes precedence over this table.
"""

import errno
import signal
from enum import IntEnum

from drivers import (
    CommunicationLost,
    DataFileError,
    DriveFault,
    LimitHit,
    PreflightRefused,
    StopNotConfirmed,
    TdhilError,
)
from profiles import MessageCode, UsageError

SIGNALS, HIGHEST_SIGNAL = 128, 64
"""Exit code 128 + n: signal n ended the process; n is at most 64."""


class ExitCode(IntEnum):
    """Exit code of the process."""

    OK = 0
    INTERNAL = 1                # internal error: an error in this program
    USAGE = 2                   # usage or configuration
    PARTIAL = 3                 # partial result
    REFUSED = 4                 # preflight refused: nothing has moved
    COMMUNICATION = 5           # communication lost
    DRIVE_FAULT = 6
    LIMIT = 7                   # limit hit
    STOP_NOT_CONFIRMED = 8      # use the hard-wired emergency stop
    NOT_IDENTIFIABLE = 9        # not identifiable, or the model was rejected
    NOTHING_RECOVERABLE = 10    # nothing recoverable in a log
    TUNING_REFUSED = 11         # the requested gains cannot be recommended
    NOT_PASSED = 12             # a rehearsal or an acceptance did not pass
    INTERRUPTED = 130           # Ctrl-C (SIGINT)
    TERMINATED = 143            # SIGTERM, SIGHUP, SIGQUIT (Ctrl-\), SIGTSTP (Ctrl-Z)

    @classmethod
    def _missing_(cls, value: object) -> "ExitCode | None":
        """Return code 128 + n for any other signal n that ended a run, as shells do."""
        if not (isinstance(value, int) and SIGNALS < value <= SIGNALS + HIGHEST_SIGNAL):
            return None
        member = int.__new__(cls, value)
        member._name_, member._value_ = f"SIGNAL_{value - SIGNALS}", value
        return member


class Interrupted(TdhilError):
    """The operator or the system ended the program. It is raised after the stop of the shaft.

    ``why``: the cause, if more than the name of a signal is known.
    """

    entry = MessageCode.INTERRUPTED

    def __init__(self, number: int, why: str = "", *, next_step: str = "") -> None:
        self.signal = int(number)
        how = "Ctrl-C" if number == signal.SIGINT else _signal_name(self.signal)
        super().__init__(f"interrupted: {why}" if why else f"interrupted by {how}", next_step=next_step)

    @property
    def exit_code(self) -> ExitCode:
        """Exit code: 130 for Ctrl-C, 143 for signals that request the end of a program, 128 + n for other signals n."""
        if _signal_name(self.signal) in _ASK_TO_END:
            return ExitCode.TERMINATED
        return ExitCode(SIGNALS + self.signal)


_ASK_TO_END = ("SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP", "SIGBREAK")


def _signal_name(number: int) -> str:
    """Return the name of a signal; "signal n" for real-time signals, which have no name."""
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


_CODES: dict[type[BaseException], ExitCode] = {
    UsageError: ExitCode.USAGE,
    DataFileError: ExitCode.USAGE,
    PreflightRefused: ExitCode.REFUSED,
    CommunicationLost: ExitCode.COMMUNICATION,
    DriveFault: ExitCode.DRIVE_FAULT,
    LimitHit: ExitCode.LIMIT,
    StopNotConfirmed: ExitCode.STOP_NOT_CONFIRMED,
    KeyboardInterrupt: ExitCode.INTERRUPTED,
}
_VALUES = frozenset(int(code) for code in ExitCode)


def exit_code(error: BaseException) -> ExitCode:
    """Return the exit code of ``error``: its own attribute, else that of its nearest class in the table, else 1."""
    own = getattr(error, "exit_code", None)
    if isinstance(own, int) and (own in _VALUES or isinstance(own, ExitCode)):
        return ExitCode(own)
    for kind in type(error).__mro__:
        if kind in _CODES:
            return _CODES[kind]
    return ExitCode.INTERNAL


# ---------------------------------------------------------------------------------------------------------------------
# Errors of a log, below the root of the error tree in `drivers.errors`.
#
# ::
#
#     LogError                    empty, not MCAP, not a run of tdhil                              by the command
#     ├── LogUnopened             no such folder, no right to write there; nothing has moved       exit 2
#     ├── LogRefused              too little space on the disk before the run; nothing has moved   exit 4
#     ├── LogBroken               disk failure or full disk during the run; the shaft was stopped  exit 3
#     ├── NothingRecoverable      no message of the file can be read                               exit 10
#     └── NothingRecorded         the run was refused, or ended in setup: nothing to identify      exit of the run
#
# A run whose log broke off is a partial result, not an internal error: the written part can be replayed.


class LogError(TdhilError):
    """The log can't be written (disk full, no such folder) or can't be read (empty, not MCAP, not a run of tdhil)."""

    entry = MessageCode.LOG_PROBLEM


class LogUnopened(LogError):
    """A log cannot be created at the named place."""

    entry = MessageCode.LOG_UNOPENED

    exit_code = ExitCode.USAGE


class LogRefused(LogError):
    """The disk has too little space for the start of a run."""

    entry = MessageCode.LOG_DISK_FULL

    exit_code = ExitCode.REFUSED


class LogBroken(LogError):
    """The log ended before its run."""

    entry = MessageCode.LOG_BROKEN

    exit_code = ExitCode.PARTIAL


class NothingRecoverable(LogError):
    """The log has no readable message."""

    entry = MessageCode.NOTHING_RECOVERABLE

    exit_code = ExitCode.NOTHING_RECOVERABLE


class NothingRecorded(LogError):
    """The run in the log ended before it recorded data for an identification. The exit code is that of the run."""

    entry = MessageCode.NOTHING_RECORDED

    def __init__(self, what: str, code: int, *, where: str = "", next_step: str = "") -> None:
        super().__init__(what, where=where, next_step=next_step)
        self.exit_code = ExitCode(code)


# ---------------------------------------------------------------------------------------------------------------------
# Errors of a trace in CSV, below `LogError` and so below the root of the error tree.
#
# ::
#
#     LogError
#     ├── CsvMisnamed      trace.csv:4: no column 'n_rmp'; did you mean 'n_rpm'?         exit 2
#     └── CsvUnusable      trace.csv:88: the time goes back, here and in 512 more rows   exit 10


class CsvMisnamed(LogError):
    """A requested column or unit is missing or ambiguous; options of the command line can correct it."""

    entry = MessageCode.CSV_COLUMNS_UNCLEAR

    exit_code = ExitCode.USAGE


class CsvUnusable(LogError):
    """The file can't be used as a trace: another export is needed."""

    entry = MessageCode.CSV_UNUSABLE

    exit_code = ExitCode.NOTHING_RECOVERABLE


def code_of(error: BaseException) -> str:
    """Return the code of ``error`` in the table of messages (`profiles.messages`)."""
    if isinstance(error, TdhilError):
        return error.entry.code
    if isinstance(error, KeyboardInterrupt):
        return MessageCode.INTERRUPTED.code
    return (MessageCode.SYSTEM_REFUSED if of_the_system(error) else MessageCode.INTERNAL_ERROR).code


def error_document(error: BaseException) -> dict[str, str]:
    """Return the entry of a JSON document for an error: ``kind``, ``message`` and ``code``."""
    return {"kind": type(error).__name__, "message": str(error), "code": code_of(error)}


_THE_SYSTEM_S = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOSPC, errno.ENOMEM, errno.EIO, errno.EROFS})


def of_the_system(error: BaseException) -> bool:
    """Return whether an error comes from the computer's state (open files, disk, memory, terminal), not from tdhil."""
    return isinstance(error, OSError) and error.errno in _THE_SYSTEM_S


def existing_file(where: object, what: str = "already exists") -> UsageError:
    """Return the refusal to overwrite a file. ``where``: the file, or the option with it; ``what``: the reason."""
    return UsageError(f"{what} and was not overwritten", where=str(where),
                      next_step="Name another file, or move the existing one", entry=MessageCode.FILE_EXISTS)


def shown(text: str) -> str:
    """Return ``text`` for a message: printable, on one line, at most 40 characters."""
    clean = "".join(sign if sign.isprintable() else "·" for sign in text[:41])
    return clean if len(text) <= 40 else clean[:39] + "…"


__all__ = ["ExitCode", "Interrupted", "MessageCode", "TdhilError", "UsageError", "code_of", "exit_code"]
