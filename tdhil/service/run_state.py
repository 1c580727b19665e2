"""What a run of the service is at each moment: its states, which may follow which, and what each knows. Pure.

::

    requested → preflight → awaiting_confirmation → moving(stage) → stopping → identifying → done
                                                                             ↘ refused | stopped | failed
    whenever the run's process or the drive is lost:                           interrupted | stop_not_confirmed

There is no queue of motions, no pause and no way back: a run that has ended is ended.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from enum import StrEnum
from typing import Any

from drivers import CommunicationLost, PreflightRefused
from tdhil.errors import HIGHEST_SIGNAL, SIGNALS, ExitCode, TdhilError


class State(StrEnum):
    """Of one run."""

    REQUESTED = "requested"
    PREFLIGHT = "preflight"
    AWAITING = "awaiting_confirmation"
    MOVING = "moving"
    STOPPING = "stopping"
    IDENTIFYING = "identifying"
    DONE = "done"
    REFUSED = "refused"                    # before anything moved, or by a probe of sign or unit
    STOPPED = "stopped"                    # somebody asked for it, and the shaft was seen at rest
    FAILED = "failed"                      # something went wrong, and the shaft was seen at rest
    STOP_NOT_CONFIRMED = "stop_not_confirmed"
    INTERRUPTED = "interrupted"            # the run's process was lost; what then was seen of the shaft is said


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
"""The shaft may be turning."""


class NotSo(ValueError):
    """A state that can't follow the one before: a mistake of this program."""


@dataclass(frozen=True)
class Told:
    """An error of the tree as a file and a page have it."""

    kind: str
    message: str
    what: str
    where: str
    next_step: str
    exit_code: int

    @staticmethod
    def of(error: BaseException) -> Told:
        from tdhil.errors import exit_code

        what, where, next_step = str(error), "", ""
        if isinstance(error, TdhilError):
            what, where, next_step = error.what, error.where, error.next_step
        return Told(type(error).__name__, str(error), what, where, next_step, int(exit_code(error)))


@dataclass(frozen=True)
class Stop:
    """What became of a wish to stop: each time as ISO 8601 in UTC, None as long as it hasn't come.

    ``seen``: the drive was in quick stop, or had been commanded to zero speed.
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
    """What is waited for: ``binding`` is the SHA-256 of all that the code is good for."""

    binding: str
    text: str
    expires: str


@dataclass(frozen=True)
class Watch:
    """Who watches a run that brakes as soon as nobody does.

    ``gone``: since when its page has not been seen, by what itself or its silence said (``how``: hidden, closed,
    silent); None while it is there. ``lost``: when it was too long, and the run was made to brake.
    """

    by: str
    since: str
    gone: str | None = None
    how: str | None = None
    lost: str | None = None


@dataclass(frozen=True)
class Entered:
    """A state (of `moving` with its stage) and when it began."""

    state: State
    at: str
    stage: str | None = None


@dataclass(frozen=True)
class Status:
    """Everything that is known of a run besides its samples; state.json. Times are ISO 8601 in UTC."""

    id: str
    rig: str
    history: tuple[Entered, ...]
    simulated: bool | None = None
    pid: int | None = None
    expected_s: Mapping[str, float] = field(default_factory=dict)     # of each stage, control time
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

    @staticmethod
    def begun(run: str, rig: str, at: str) -> Status:
        return Status(run, rig, (Entered(State.REQUESTED, at),))

    @property
    def state(self) -> State:
        return self.history[-1].state

    @property
    def stage(self) -> str | None:
        return self.history[-1].stage

    @property
    def at(self) -> str:
        """When the state began."""
        return self.history[-1].at

    @property
    def ended(self) -> bool:
        return self.state in ENDED

    def to(self, state: State, at: str, stage: str | None = None, **known: Any) -> Status:
        """The status after this step. Raises NotSo where it can't follow."""
        if state not in FOLLOWS[self.state]:
            raise NotSo(f"{self.id}: {state} after {self.state}")
        return replace(self, history=(*self.history, Entered(state, at, stage)), **known)

    def plain(self) -> dict[str, Any]:
        """For JSON."""
        return {**asdict(self), "state": self.state.value, "stage": self.stage, "at": self.at}

    @staticmethod
    def of_plain(plain: Mapping[str, Any]) -> Status:
        """Raises ValueError, TypeError or KeyError for what is none."""
        known = {name: value for name, value in plain.items() if name not in ("state", "stage", "at")}
        history = tuple(Entered(State(one["state"]), one["at"], one.get("stage")) for one in known.pop("history"))
        if not history:
            raise ValueError("a run without a state")
        for name, kind in (
            ("stop", Stop), ("error", Told), ("confirmation", Confirmation), ("watch", Watch),
        ):
            if known.get(name) is not None:
                known[name] = kind(**known[name])
        known["identity_numbers"] = tuple(known.get("identity_numbers", ()))
        known["preflight"] = tuple(Check(**one) for one in known.get("preflight", ()))
        return Status(history=history, **known)


def end_of(exit_code: int, *, stop_confirmed: bool | None) -> State:
    """The state in which a run ends that has this exit code. ``stop_confirmed``: None where nothing was enabled."""
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
    """The status at its end, by way of the states that nobody has told of."""
    if end not in FOLLOWS[status.state]:
        for between in (State.STOPPING, State.IDENTIFYING):
            if between in FOLLOWS[status.state]:
                status = status.to(between, at)
            if end in FOLLOWS[status.state]:
                break
    return status.to(end, at, **known)


def now() -> str:
    """Wall clock, ISO 8601 in UTC, to the millisecond."""
    return iso(datetime.now(UTC).timestamp())


def iso(time_s: float) -> str:
    """A time as of `time.time`, the same way."""
    return datetime.fromtimestamp(time_s, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


# ---------------------------------------------------------------------------------------------------------------------
# Refusals of the service, in the one tree.
#
# ::
#
#     TdhilError
#     ├── NotThere                    no such rig, run or file                                  exit 2, HTTP 404
#     ├── NotAllowed                  another host, another origin, not over HTTP, not his role exit 4, HTTP 403
#     │   ├── NotLoggedIn             nobody knows who asks                                     exit 4, HTTP 401
#     │   └── TooManyTries            of passwords; ``wait_s`` says how long                    exit 4, HTTP 429
#     │       └── TooManyRuns         of those that show a code                                 exit 4, HTTP 429
#     ├── NoRoom                      the disk is full                                          exit 4, HTTP 507
#     ├── CommunicationLost
#     │   └── NotReacting             the run's process stands still                            exit 5, HTTP 504
#     └── PreflightRefused
#         └── Conflict                another run has the rig; the code is void                 exit 4, HTTP 409


class NotThere(TdhilError):
    """No such rig, run or file."""

    exit_code = ExitCode.USAGE


class NotAllowed(TdhilError):
    """May not be had from there, or not over HTTP at all."""

    exit_code = ExitCode.REFUSED


class NotLoggedIn(NotAllowed):
    """Nobody knows who asks."""


class TooManyTries(NotAllowed):
    """Of passwords. ``wait_s``: then again."""

    def __init__(self, wait_s: float) -> None:
        self.wait_s = wait_s
        super().__init__("too many tries", where="login", next_step=f"Again in {wait_s:.0f} s."
                         " Who is logged in already can stop all the same; so does the hard-wired stop")


class TooManyRuns(TooManyTries):
    """Of those that show a code at the rig."""

    def __init__(self, wait_s: float, rig: str) -> None:
        NotAllowed.__init__(
            self, "too many runs that show a code were requested", where=f"rig {rig}",
            next_step=f"Nothing was started. Again in {wait_s:.0f} s, or run it at the rig: tdhil identify")
        self.wait_s = wait_s


class NoRoom(TdhilError):
    """The disk is full."""

    exit_code = ExitCode.REFUSED


class NotReacting(CommunicationLost):
    """The run's process stands still: what was asked of it is not done by it."""


class Conflict(PreflightRefused):
    """It can't be now: another run has the rig, or the run is beyond that. ``holder``: who has it, in words."""

    def __init__(self, what: str, *, where: str = "", next_step: str = "", holder: str | None = None) -> None:
        super().__init__(what, where=where, next_step=next_step)
        self.holder = holder


def blocking(statuses: Iterable[Status], signed_off: Iterable[str]) -> Status | None:
    """The run whose stop nobody confirmed and nobody has signed off: its rig moves for no one."""
    off = set(signed_off)
    return next((one for one in statuses if one.state is State.STOP_NOT_CONFIRMED and one.id not in off), None)
