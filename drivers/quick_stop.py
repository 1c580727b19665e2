"""A quick stop from outside of any run: best effort, on a drive of which nothing was prepared. No emergency stop.

Asks first and looks afterwards, again and again while the drive still follows somebody else's setpoints, until the
shaft is at rest, or nothing is heard, or it gets no slower. Nothing is ever disabled here: a shaft that still turns
would coast, and one at rest may be holding something.
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
"""Standstill must last so long: where the drive says so too, and where it doesn't."""
PAUSE_S = 0.02
SILENT_S = 3.0
NO_SLOWER_S, SLOWER = 10.0, 0.99
LONGEST_S = 120.0
_NO_TORQUE = (PowerState.OFF, PowerState.READY, PowerState.NOT_READY, PowerState.FAULT)


class Ended(Enum):
    """How it ended."""

    AT_REST = "at rest"
    TURNING = "still turning"
    NO_ANSWER = "no answer"


BLANK_WORDS = (0x0000, 0xFFFF)


@dataclass(frozen=True)
class Seen:
    """One look. ``speed`` in rad/s, or in counts where the drive's unit isn't known; ``unit`` says which."""

    state: PowerState
    text: str                          # the state in the drive's own terms, with its status word
    speed: float
    unit: str
    near_zero: bool
    standstill: bool                   # as the drive says
    follows: bool                      # setpoints still act
    blank: bool = False                # the status word is all zeros or all ones: a gateway without its drive


class Target(Protocol):
    """A drive as far as stopping it needs it. Both methods may raise TdhilError."""

    def ask(self, attempt: int) -> None:
        """Ask for the quick stop; a later attempt may go further than an earlier one."""

    def poll(self) -> Seen:
        """What the drive shows now."""

    def remarks(self) -> tuple[str, ...]:
        """What a reader should know: another master, what was changed, a line each."""


@dataclass(frozen=True)
class BareStopReport:
    """What was asked for and seen."""

    ended: Ended
    first: Seen | None
    last: Seen | None
    took_s: float
    asked: int
    remarks: tuple[str, ...]


def bare_stop(target: Target, clock: Clock, longest_s: float = LONGEST_S) -> BareStopReport:
    """Never raises: what failed is among the remarks."""
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
        except TdhilError as error:    # the look says whether it helped all the same
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
    let_go = () if coasted is None else (
        f"its torque was off while the shaft still turned at {coasted.speed:.3g} {coasted.unit}: it ran out unbraked",
    )
    no_state = () if not shown else (
        f"the drive showed {shown}: a speed that comes with it is not believed, and the quick stop was asked for again",
    )
    return BareStopReport(
        ended, first, last, clock.now_s() - begun_s, asked,
        (*target.remarks(), *let_go, *no_state, *dict.fromkeys(troubles)),
    )


def _note(troubles: list[str], error: TdhilError) -> None:
    if len(troubles) < 20:
        troubles.append(str(error))
