"""A quick stop outside of any run: best effort, on a drive that was not prepared. It is no emergency stop.

Each round sends the request if the state asks for it, then reads the drive. The reading alone decides the next state:

```text
   reading                             state     action in the next round     end
   ---------------------------------   -------   --------------------------   -----------------------------
                            begin ---> ASKING    REQUEST, then read
   follows setpoints, or blank ------> ASKING    REQUEST, then read           no slower for 10 s: TURNING
   turns, follows no setpoint -------> BRAKING   WATCH: read only             no slower for 10 s: TURNING
   speed near zero ------------------> QUIET     WATCH: read only             after 3 s: AT_REST
   ... and the drive reports it too -> STILL     WATCH: read only             after 1.5 s: AT_REST
   error, or no reply ---------------> SILENT    REQUEST, then read           no reply for 3 s: NO_ANSWER

   usual way:       ASKING ---> BRAKING ---> QUIET, STILL ---> AT_REST
   another master:  ASKING <---> BRAKING                       (its setpoints act again: the request is repeated)
   a gap:           any state <---> SILENT                     (the time at standstill begins again)
   any state, after 120 s: TURNING, or NO_ANSWER if the drive never replied
```

No action disables the drive: a turning shaft would coast, and a shaft at standstill may hold a load.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from types import MappingProxyType
from typing import Protocol

from drivers.clock import Clock
from drivers.drive import PowerState
from drivers.errors import CommunicationLost, TdhilError

QUIET_S, QUIET_UNSAID_S = 1.5, 3.0
"""Least duration of standstill, s: if the drive reports it too, and if it does not."""
PAUSE_S = 0.02
"""Time between two rounds, s."""
SILENT_S = 3.0
"""Longest time without any reply, s."""
NO_SLOWER_S, SLOWER = 10.0, 0.99
"""Longest time, s, in which the speed does not fall below this share of its least value."""
LONGEST_STOP_S = 120.0
"""Longest time of the whole stop, s."""
MOST_TROUBLES = 20
"""Number of errors that the report repeats."""
SLOPE_S, LONGEST_LAG_S = 1.0, 2.0
"""Time before the torque is off in which the fall of the speed is measured, and longest lag of a reported speed, s."""
FALLEN_SHARE = 0.4
"""Share of its speed by which a report that lags has fallen one lag later: 0.63 with a first-order lag, 1 with a dead
time. A shaft that runs out without a brake falls by less, unless friction brakes it nearly as fast as the drive."""
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


# ---------------------------------------------------------------------------------------------------------------------
# The table. Pure.


class StopAction(Enum):
    """Action of the next round."""

    REQUEST = "send the quick stop, then read"
    WATCH = "read only"
    END = "end"


class StopState(Enum):
    """State of the stop, from the latest reading."""

    ASKING = "asking"
    BRAKING = "braking"
    QUIET = "quiet"
    STILL = "still"
    SILENT = "silent"


@dataclass(frozen=True)
class StopRound:
    """One round. ``seen``: None after an error. ``heard``: the drive replied, also if only with an error."""

    time_s: float
    seen: Seen | None
    heard: bool = True


@dataclass(frozen=True)
class StopCourse:
    """State and its times. ``least_speed``: least magnitude so far of a speed that is not near zero."""

    state: StopState
    begun_s: float
    heard_s: float                     # latest reply
    gained_s: float                    # latest time at which the shaft became slower
    near_zero_s: float                 # begin of the present standstill; inf: there is none
    least_speed: float
    longest_s: float
    answered: bool = False             # there was a reading
    ended: Ended | None = None

    @classmethod
    def begin(cls, now_s: float, longest_s: float = LONGEST_STOP_S) -> StopCourse:
        """Return the state before the first request."""
        return cls(StopState.ASKING, now_s, now_s, now_s, math.inf, math.inf, longest_s)


@dataclass(frozen=True)
class StopRule:
    """``action`` in a state, and its end: ``limit_s`` after ``since_s``."""

    action: StopAction
    since_s: Callable[[StopCourse], float]
    reached: Callable[[float, float], bool]
    limit_s: float
    ended: Ended


_heard_s = operator.attrgetter("heard_s")
_gained_s = operator.attrgetter("gained_s")
_near_zero_s = operator.attrgetter("near_zero_s")

TABLE: Mapping[StopState, StopRule] = MappingProxyType({
    StopState.ASKING: StopRule(StopAction.REQUEST, _gained_s, operator.gt, NO_SLOWER_S, Ended.TURNING),
    StopState.BRAKING: StopRule(StopAction.WATCH, _gained_s, operator.gt, NO_SLOWER_S, Ended.TURNING),
    StopState.QUIET: StopRule(StopAction.WATCH, _near_zero_s, operator.ge, QUIET_UNSAID_S, Ended.AT_REST),
    StopState.STILL: StopRule(StopAction.WATCH, _near_zero_s, operator.ge, QUIET_S, Ended.AT_REST),
    StopState.SILENT: StopRule(StopAction.REQUEST, _heard_s, operator.gt, SILENT_S, Ended.NO_ANSWER),
})


def state_of(seen: Seen | None) -> StopState:
    """Return the state that a reading means. A status word that a gateway made up (``blank``) shows nothing."""
    if seen is None:
        return StopState.SILENT
    if seen.follows or seen.blank:
        return StopState.ASKING
    if not seen.near_zero:
        return StopState.BRAKING
    return StopState.STILL if seen.standstill or seen.state in _NO_TORQUE else StopState.QUIET


def step(before: StopCourse, now: StopRound) -> tuple[StopCourse, StopAction]:
    """Return the next state and action. Pure."""
    seen, time_s, state = now.seen, now.time_s, state_of(now.seen)
    standing = state in (StopState.QUIET, StopState.STILL)
    slower = seen is not None and not seen.near_zero and abs(seen.speed) < SLOWER * before.least_speed
    after = replace(
        before,
        state=state,
        heard_s=time_s if now.heard else before.heard_s,
        gained_s=time_s if slower else before.gained_s,
        near_zero_s=min(before.near_zero_s, time_s) if standing else math.inf,
        least_speed=abs(seen.speed) if seen is not None and slower else before.least_speed,
        answered=before.answered or seen is not None,
    )
    row = TABLE[state]
    if row.reached(time_s - row.since_s(after), row.limit_s):
        return replace(after, ended=row.ended), StopAction.END
    if time_s - after.begun_s > after.longest_s:
        return replace(after, ended=Ended.TURNING if after.answered else Ended.NO_ANSWER), StopAction.END
    return after, row.action


# ---------------------------------------------------------------------------------------------------------------------


def bare_stop(target: Target, clock: Clock, longest_s: float = LONGEST_STOP_S) -> BareStopReport:
    """Stop the shaft. Never raises: errors are among the remarks."""
    stopping, action = StopCourse.begin(clock.now_s(), longest_s), StopAction.REQUEST
    rounds: list[StopRound] = []       # those with a reading
    troubles: list[str] = []
    asked = 0
    while action is not StopAction.END:
        if action is StopAction.REQUEST:
            asked += 1
            try:
                target.ask(asked)
            except TdhilError as error:    # the reading shows whether it helped anyway
                troubles.append(str(error))
        try:
            seen = target.poll()
            now = StopRound(clock.now_s(), seen)
            rounds.append(now)
        except TdhilError as error:
            troubles.append(str(error))
            now = StopRound(clock.now_s(), None, heard=not isinstance(error, CommunicationLost))
        stopping, action = step(stopping, now)
        clock.wait_until(clock.now_s() + PAUSE_S)
    assert stopping.ended is not None
    readings = [one.seen for one in rounds if one.seen is not None]
    return BareStopReport(
        stopping.ended,
        readings[0] if readings else None,
        readings[-1] if readings else None,
        clock.now_s() - stopping.begun_s,
        asked,
        (*target.remarks(), *_remarks(rounds), *dict.fromkeys(troubles[:MOST_TROUBLES])),
    )


def _remarks(rounds: list[StopRound]) -> list[str]:
    """Return remarks on the readings besides the end: a shaft that ran out, a state that is not valid."""
    said = []
    readings = [(one.time_s, one.seen) for one in rounds if one.seen is not None]
    coasted = _ran_out(readings)
    if coasted is not None:
        said.append(
            f"the drive reported its torque off at {coasted.speed:.3g} {coasted.unit}, and this speed did not fall as"
            " fast as during braking: the shaft ran out without a brake"
        )
    shown = next((one.text for _, one in reversed(readings) if one.blank), "")
    if shown:
        said.append(
            f"the drive showed {shown}: tdhil ignored the speed beside it, and requested the quick stop again"
        )
    return said


def _ran_out(readings: list[tuple[float, Seen]]) -> Seen | None:
    """Return the first reading of a turning shaft without torque; None if there is none, or if the report only lags.

    A speed report with the lag L is ahead of a ramp of the slope a by a·L. When the drive has stopped the shaft and
    switches its torque off, the report still shows about this speed, and then falls within L.
    """
    at = next((k for k, (_, one) in enumerate(readings) if one.state is PowerState.OFF and not one.near_zero), None)
    if at is None:
        return None
    off_s, off = readings[at]
    begun_s, begun = next((time_s, one) for time_s, one in readings if time_s >= off_s - SLOPE_S)
    fallen = abs(begun.speed) - abs(off.speed)
    if fallen <= 0.0:                  # not braked before
        return off
    lag_s = abs(off.speed) * (off_s - begun_s) / fallen
    later = next((one for time_s, one in readings[at:] if time_s >= off_s + lag_s), None)
    if lag_s > LONGEST_LAG_S or later is None:
        return off
    return None if later.near_zero or abs(later.speed) <= (1.0 - FALLEN_SHARE) * abs(off.speed) else off
