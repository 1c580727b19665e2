"""A quick stop outside of any run: best effort, on a drive that was not prepared. It is no emergency stop.

It first sends the request and then reads the state, repeatedly while the drive still follows another master's
setpoints, until standstill, or no answer comes, or the shaft gets no slower. It never disables the drive: a turning
shaft would coast, and a shaft at standstill may hold a load.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

from drivers.clock import Clock
from drivers.drive import PowerState
from drivers.errors import CommunicationLost, TdhilError

QUIET_S, QUIET_UNSAID_S = 1.5, 3.0
"""Least duration of standstill, s: if the drive reports it too, and if it does not."""
PAUSE_S = 0.02
SILENT_S = 3.0
NO_SLOWER_S, SLOWER = 10.0, 0.99
LONGEST_S = 120.0
_NO_TORQUE = (PowerState.OFF, PowerState.READY, PowerState.NOT_READY, PowerState.FAULT)


class Ended(Enum):
    """Result of a quick stop."""

    AT_REST = "at rest"
    TURNING = "still turning"
    NO_ANSWER = "no answer"


BLANK_WORDS = (0x0000, 0xFFFF)


@dataclass(frozen=True)
class Seen:
    """One reading. ``speed`` in rad/s, or in counts if the drive's unit is unknown; see ``unit``."""

    state: PowerState
    text: str                          # the state in the drive's own terms, with its status word
    speed: float
    unit: str
    near_zero: bool
    standstill: bool                   # as reported by the drive
    follows: bool                      # setpoints still act
    blank: bool = False                # the status word is all zeros or all ones: a gateway without its drive


class Target(Protocol):
    """Interface of a drive that a quick stop needs. Both methods may raise TdhilError."""

    def ask(self, attempt: int) -> None:
        """Send the quick stop; a later attempt may use stronger means than an earlier one."""

    def poll(self) -> Seen:
        """Read the state of the drive."""

    def remarks(self) -> tuple[str, ...]:
        """Return remarks: another master, and changes in the drive, one line each."""


@dataclass(frozen=True)
class BareStopReport:
    """Requests sent and states read."""

    ended: Ended
    first: Seen | None
    last: Seen | None
    took_s: float
    asked: int
    remarks: tuple[str, ...]


def bare_stop(target: Target, clock: Clock, longest_s: float = LONGEST_S) -> BareStopReport:
    """Stop the shaft. Never raises: errors are among the remarks."""
    begun_s = heard_s = gained_s = clock.now_s()
    first: Seen | None = None
    last: Seen | None = None
    quiet_since_s: float | None = None
    best, asked, follows = math.inf, 0, True
    troubles: list[str] = []
    coasted: Seen | None = None
    shown = ""                         # what was shown in place of a state
    ended: Ended | None = None
    while ended is None:
        try:
            if follows:
                asked += 1
                target.ask(asked)
        except TdhilError as error:    # the poll shows whether it helped anyway
            _note(troubles, error)
        now_s = clock.now_s()
        try:
            last = target.poll()
        except TdhilError as error:
            _note(troubles, error)
            now_s = clock.now_s()
            quiet_since_s, follows = None, True
            if not isinstance(error, CommunicationLost):
                heard_s = now_s
            if now_s - heard_s > SILENT_S:
                ended = Ended.NO_ANSWER
        else:
            now_s = heard_s = clock.now_s()
            first, follows = first or last, last.follows or last.blank
            if coasted is None and last.state is PowerState.OFF and not last.near_zero:
                coasted = last
            shown = last.text if last.blank else shown
            if not last.near_zero or follows:
                quiet_since_s = None
            elif quiet_since_s is None:
                quiet_since_s = now_s
            said = last.standstill or last.state in _NO_TORQUE
            if quiet_since_s is not None and now_s - quiet_since_s >= (QUIET_S if said else QUIET_UNSAID_S):
                ended = Ended.AT_REST
            if not last.near_zero and abs(last.speed) < SLOWER * best:
                best, gained_s = abs(last.speed), now_s
            stuck = quiet_since_s is None and now_s - gained_s > NO_SLOWER_S
            if ended is None and stuck:
                ended = Ended.TURNING
        if ended is None and now_s - begun_s > longest_s:
            ended = Ended.TURNING if last is not None else Ended.NO_ANSWER
        clock.wait_until(clock.now_s() + PAUSE_S)
    ran_out = () if coasted is None else (
        f"the torque was off while the shaft still turned at {coasted.speed:.3g} {coasted.unit}: the shaft ran out",
    )
    no_state = () if not shown else (
        f"the drive showed {shown}: tdhil ignored the speed beside it, and requested the quick stop again",
    )
    return BareStopReport(
        ended, first, last, clock.now_s() - begun_s, asked,
        (*target.remarks(), *ran_out, *no_state, *dict.fromkeys(troubles)),
    )


def _note(troubles: list[str], error: TdhilError) -> None:
    if len(troubles) < 20:
        troubles.append(str(error))
