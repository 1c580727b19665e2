"""The states of a run in the service: permitted order, and data of each state. Pure data, no files.

::

    requested → preflight → awaiting_confirmation → moving(stage) → stopping → identifying → done
                                                                             ↘ refused | stopped | failed
    whenever the run's process or the drive is lost:                           interrupted | stop_not_confirmed

There is no queue of motions and no pause. An ended run stays ended. A run that is made from an uploaded recording has
one state, done.
"""

from __future__ import annotations

import errno
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from enum import StrEnum
from typing import Any, Final

from drivers import CommunicationLost, PreflightRefused
from tdhil.errors import HIGHEST_SIGNAL, SIGNALS, ExitCode, MessageCode, TdhilError, UsageError


class State(StrEnum):
    """State of one run."""

    REQUESTED = "requested"
    PREFLIGHT = "preflight"
    AWAITING = "awaiting_confirmation"
    MOVING = "moving"
    STOPPING = "stopping"
    IDENTIFYING = "identifying"
    DONE = "done"
    REFUSED = "refused"                    # before motion, or by the sign probe or unit check
    STOPPED = "stopped"                    # stopped on request, also before motion: see `Stop.confirmed`
    FAILED = "failed"                      # an error, also before motion: see `Stop.confirmed`
    STOP_NOT_CONFIRMED = "stop_not_confirmed"
    INTERRUPTED = "interrupted"            # the run's process was lost; the error states how the shaft ended


_LOST = {State.INTERRUPTED, State.STOP_NOT_CONFIRMED}
_ENDED_EARLY = {State.REFUSED, State.STOPPED, State.FAILED, *_LOST}
FOLLOWS: Mapping[State, frozenset[State]] = {
    State.REQUESTED: frozenset({State.PREFLIGHT, *_ENDED_EARLY}),
    State.PREFLIGHT: frozenset({State.AWAITING, State.MOVING, *_ENDED_EARLY}),
    State.AWAITING: frozenset({State.MOVING, *_ENDED_EARLY}),
    State.MOVING: frozenset({State.MOVING, State.STOPPING, *_LOST}),
    State.STOPPING: frozenset({State.IDENTIFYING, *_ENDED_EARLY}),
    State.IDENTIFYING: frozenset({State.DONE, State.FAILED, *_LOST}),
    **{ended: frozenset() for ended in (State.DONE, *_ENDED_EARLY)},
}
ENDED = frozenset(state for state, after in FOLLOWS.items() if not after)
MAY_TURN = frozenset({State.MOVING, State.STOPPING})
"""States in which the shaft may turn."""


class NotSo(ValueError):
    """Error in this program: a state that can't follow the state before."""


@dataclass(frozen=True)
class Told:
    """An error of the tree, as data for a file or a page."""

    kind: str
    message: str
    what: str
    where: str
    next_step: str
    exit_code: int
    code: str = ""

    @staticmethod
    def of(error: BaseException) -> Told:
        from tdhil.errors import code_of, exit_code

        what, where, next_step = str(error), "", ""
        if isinstance(error, TdhilError):
            what, where, next_step = error.what, error.where, error.next_step
        return Told(type(error).__name__, str(error), what, where, next_step, int(exit_code(error)), code_of(error))


@dataclass(frozen=True)
class Stop:
    """Progress of a stop: each time as ISO 8601 in UTC, None until it is reached.

    ``seen``: time at which the drive was in quick stop, or was commanded to zero speed.
    ``confirmed``: whether standstill was confirmed; None if tdhil did not stop the drive.
    """

    asked: str | None = None
    by: str | None = None
    seen: str | None = None
    at_rest: str | None = None
    confirmed: bool | None = None


@dataclass(frozen=True)
class Check:
    """One line of the preflight table."""

    name: str
    wanted: str
    found: str
    outcome: str
    where: str
    next_step: str = ""


@dataclass(frozen=True)
class Confirmation:
    """Requested confirmation. ``binding``: SHA-256 of all data that the code confirms."""

    binding: str
    text: str
    expires: str


@dataclass(frozen=True)
class Watch:
    """The user who watches a run that stops when it is not watched.

    ``gone``: time since which the page is not visible; None while it is visible. ``how``: hidden or closed, as reported
    by the page, or silent. ``lost``: time at which the run was stopped, because the page was not visible for too long.
    """

    by: str
    since: str
    gone: str | None = None
    how: str | None = None
    lost: str | None = None


@dataclass(frozen=True)
class Entered:
    """A state and the time of its start; `moving` has its stage."""

    state: State
    at: str
    stage: str | None = None


@dataclass(frozen=True)
class Status:
    """All data of a run except its samples; state.json. Times are ISO 8601 in UTC."""

    id: str
    rig: str
    history: tuple[Entered, ...]
    simulated: bool | None = None
    pid: int | None = None
    expected_s: Mapping[str, float] = field(default_factory=dict)     # of each stage, s of control time
    preflight: tuple[Check, ...] = ()
    identity: str = ""
    identity_numbers: tuple[int, ...] = ()     # vendor, product, revision, serial; zeros where the drive has none
    safe_action: str = ""
    expected_half_width: float | None = None
    confirmation: Confirmation | None = None
    watch: Watch | None = None
    stop: Stop = Stop()
    error: Told | None = None
    exit_code: int | None = None
    verdict: str | None = None
    rehearsal: Mapping[str, Any] | None = None     # verdict on the rehearsed faults (`tdhil.session.Rehearsal`)

    @staticmethod
    def begun(run: str, rig: str, at: str) -> Status:
        return Status(run, rig, (Entered(State.REQUESTED, at),))

    @staticmethod
    def of_uploaded(run: str, rig: str, at: str, **known: Any) -> Status:
        """Return the status of a run that is made from an uploaded recording: it has ended, and nothing moved."""
        return Status(run, rig, (Entered(State.DONE, at),), **known)

    @property
    def state(self) -> State:
        return self.history[-1].state

    @property
    def stage(self) -> str | None:
        return self.history[-1].stage

    @property
    def at(self) -> str:
        """Time at which the state began."""
        return self.history[-1].at

    @property
    def ended(self) -> bool:
        return self.state in ENDED

    def to(self, state: State, at: str, stage: str | None = None, **known: Any) -> Status:
        """Return the status in this next state. Raises NotSo if the state can't follow."""
        if state not in FOLLOWS[self.state]:
            raise NotSo(f"{self.id}: {state} after {self.state}")
        return replace(self, history=(*self.history, Entered(state, at, stage)), **known)

    def plain(self) -> dict[str, Any]:
        """Return the status as plain data for JSON."""
        return {**asdict(self), "state": self.state.value, "stage": self.stage, "at": self.at}

    @staticmethod
    def of_plain(plain: Mapping[str, Any]) -> Status:
        """Read a status. Raises ValueError, TypeError or KeyError for other data."""
        known = {name: value for name, value in plain.items() if name not in ("state", "stage", "at")}
        history = tuple(Entered(State(one["state"]), one["at"], one.get("stage")) for one in known.pop("history"))
        if not history:
            raise ValueError("a run without a state")
        for name, kind in (("stop", Stop), ("error", Told), ("confirmation", Confirmation), ("watch", Watch)):
            if known.get(name) is not None:
                known[name] = kind(**known[name])
        known["identity_numbers"] = tuple(known.get("identity_numbers", ()))
        known["preflight"] = tuple(Check(**one) for one in known.get("preflight", ()))
        return Status(history=history, **known)


def end_of(exit_code: int, *, stop_confirmed: bool | None) -> State:
    """Return the end state for an exit code. ``stop_confirmed``: None if the drive was not enabled."""
    if stop_confirmed is False or exit_code == ExitCode.STOP_NOT_CONFIRMED:
        return State.STOP_NOT_CONFIRMED
    if exit_code in (ExitCode.OK, ExitCode.PARTIAL, ExitCode.NOT_IDENTIFIABLE):
        return State.DONE
    if exit_code in (ExitCode.REFUSED, ExitCode.USAGE):
        return State.REFUSED
    if SIGNALS < exit_code <= SIGNALS + HIGHEST_SIGNAL:
        return State.STOPPED
    return State.FAILED


def way_to(status: Status, end: State, at: str, **known: Any) -> Status:
    """Return the status in its end state, with the states between that were not reported."""
    if end not in FOLLOWS[status.state]:
        for between in (State.STOPPING, State.IDENTIFYING):
            if between in FOLLOWS[status.state]:
                status = status.to(between, at)
            if end in FOLLOWS[status.state]:
                break
    return status.to(end, at, **known)


def now() -> str:
    """Return the wall clock, ISO 8601 in UTC, to the millisecond."""
    return iso(datetime.now(UTC).timestamp())


def iso(time_s: float) -> str:
    """Return a time, s as of `time.time`, as ISO 8601 in UTC, to the millisecond."""
    return datetime.fromtimestamp(time_s, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


# ---------------------------------------------------------------------------------------------------------------------
# Refusals of the service, as a part of the error tree.
#
# ::
#
#     TdhilError
#     ├── NotThere                    no such rig, run or file                                  exit 2, HTTP 404
#     ├── NotAllowed                  other host or origin, not over HTTP, other role needed exit 4, HTTP 403
#     │   ├── NotLoggedIn             the client is not logged in                               exit 4, HTTP 401
#     │   └── TooManyTries            too many passwords; retry after ``wait_s``                exit 4, HTTP 429
#     │       └── TooManyRuns         too many runs that show a code                            exit 4, HTTP 429
#     ├── NoRoom                      the disk is full                                          exit 4, HTTP 507
#     ├── UsageError
#     │   └── TooLarge                the uploaded file is larger than the limit                exit 2, HTTP 413
#     ├── CommunicationLost
#     │   ├── NotReacting             the run's process is suspended                            exit 5, HTTP 504
#     │   ├── FolderMissing           the run's folder is missing; its process was signalled    exit 5, HTTP 504
#     │   └── TooSlow                 an upload takes too long                                  exit 5, HTTP 408
#     └── PreflightRefused
#         └── Conflict                another run uses the rig; the code is void                exit 4, HTTP 409


class NotThere(TdhilError):
    """The rig, run or file does not exist."""

    entry = MessageCode.NOT_FOUND

    exit_code = ExitCode.USAGE


class NotAllowed(TdhilError):
    """Refusal of a request from this client or origin, or of any request over HTTP."""

    entry = MessageCode.NOT_ALLOWED

    exit_code = ExitCode.REFUSED


def page_text(text: str) -> str:
    """Return the text. The call marks it for the catalogues: a page shows it in its language."""
    return text


class NotLoggedIn(NotAllowed):
    """The client is not logged in."""


class TooManyTries(NotAllowed):
    """Too many password tries. ``wait_s``: time until the next one, s."""

    def __init__(self, wait_s: float) -> None:
        self.wait_s = wait_s
        super().__init__(page_text("too many login attempts"), where="login", next_step=page_text(
            f"Try again in {wait_s:.0f} s. A logged-in user can still stop, and so can the hard-wired emergency stop"))


class TooManyRuns(TooManyTries):
    """Too many requested runs that show a code at the rig."""

    def __init__(self, wait_s: float, rig: str) -> None:
        NotAllowed.__init__(
            self, page_text("too many runs that show a code were requested"), where=f"rig {rig}", next_step=page_text(
                f"Nothing was started. Try again in {wait_s:.0f} s, or run it at the rig: tdhil identify --rig FILE"))
        self.wait_s = wait_s


FULL: Final = frozenset({errno.ENOSPC, errno.EDQUOT})
"""Numbers of the system's errors for a full disk and a used-up quota."""
UNCHANGED: Final = "Nothing was "
"""First words of a next step whose request had no effect: nothing was changed, signed or started."""


class NoRoom(TdhilError):
    """The disk is full."""

    entry = MessageCode.SERVICE_DISK_FULL

    exit_code = ExitCode.REFUSED


def disk_full(error: BaseException) -> NoRoom | None:
    """Return the refusal for an error that a full disk caused, also as its cause; None for any other error.

    A next step that begins with `UNCHANGED` is kept: it says that the refused request had no effect.
    """
    for one in (error, error.__cause__):
        if isinstance(one, OSError) and one.errno in FULL and not isinstance(error, NoRoom):
            what, where = getattr(error, "what", ""), getattr(error, "where", "")
            own = str(getattr(error, "next_step", ""))
            return NoRoom(
                what or f"the disk is full ({one.strerror})", where=where,
                next_step=own if own.startswith(UNCHANGED) else "Free some disk space, then repeat the request")
    return None


def request_wrong(what: str, where: str, next_step: str = "") -> UsageError:
    """Return the refusal of a request over HTTP with a value that the service can't use."""
    return UsageError(what, where=where, next_step=next_step, entry=MessageCode.REQUEST_WRONG)


def option_wrong(what: str, where: str, next_step: str = "") -> UsageError:
    """Return the refusal of an option of `tdhil serve`, or of what it names."""
    return UsageError(what, where=where, next_step=next_step, entry=MessageCode.SERVICE_OPTION_WRONG)


class NotReacting(CommunicationLost):
    """The run's process is suspended and does not carry out the request."""

    entry = MessageCode.RUN_NOT_REACTING


class FolderMissing(CommunicationLost):
    """The run's folder is missing. SIGTERM was sent to its process."""

    entry = MessageCode.SERVER_UNREACHABLE


class TooLarge(UsageError):
    """The uploaded file is larger than the limit."""

    entry = MessageCode.REQUEST_WRONG


class TooSlow(CommunicationLost):
    """An upload takes longer than its size allows."""


class Conflict(PreflightRefused):
    """Refusal: another run uses the rig, or the run is no longer in that state. ``holder``: the other run, in words."""

    entry = MessageCode.CONFLICT

    def __init__(self, what: str, *, where: str = "", next_step: str = "", holder: str | None = None,
                 entry: MessageCode | None = None) -> None:
        super().__init__(what, where=where, next_step=next_step, entry=entry)
        self.holder = holder


def blocking(statuses: Iterable[Status], signed_off: Iterable[str]) -> Status | None:
    """Return the run whose stop is neither confirmed nor signed off. It blocks its rig."""
    off = set(signed_off)
    return next((one for one in statuses if one.state is State.STOP_NOT_CONFIRMED and one.id not in off), None)
