"""Control time, for every loop above the drive.

Two clocks exist: the computer's monotonic clock, and one that the bus advances by a period per cycle. A simulated drive
advances its plant by the same time, so that a run of minutes takes seconds and is repeatable.
"""

import math
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable
from typing import Protocol

from drivers.errors import CommunicationLost
from profiles import MessageCode


class Clock(Protocol):
    """Seconds since the clock was made; ``wait_until`` returns how late it came back (0 if in time)."""

    stepped: bool

    def now_s(self) -> float: ...

    def wait_until(self, time_s: float) -> float: ...


_BOOT_TIME = "CLOCK_BOOTTIME"
_CLOCKS = {"darwin": "CLOCK_MONOTONIC_RAW"}
"""Monotonic clock that includes sleep, by platform; any other platform: `_BOOT_TIME`. On macOS `time.monotonic` reads
mach_absolute_time, which stops during sleep. CLOCK_MONOTONIC_RAW reads mach_continuous_time, which does not (Apple's
clock_gettime(3)). On Linux the clock of that name stops, and CLOCK_BOOTTIME does not (clock_gettime(2))."""


def _clock_with_sleep(platform: str) -> Callable[[], float]:
    """Return monotonic time that includes sleep: a loop must detect that the laptop slept.

    `time.monotonic` if the platform has no such clock by a name. On Windows it includes sleep.
    """
    name = _CLOCKS.get(platform, _BOOT_TIME)
    return (lambda: time.clock_gettime(getattr(time, name))) if hasattr(time, name) else time.monotonic


_now_s = _clock_with_sleep(sys.platform)


class MonotonicClock:
    """The computer's monotonic clock, time asleep included. It starts at zero."""

    stepped = False

    def __init__(self) -> None:
        self._zero_s = _now_s()

    def now_s(self) -> float:
        return _now_s() - self._zero_s

    def wait_until(self, time_s: float) -> float:
        left_s = time_s - self.now_s()
        if left_s > 0.0:
            time.sleep(left_s)
            return 0.0
        return -left_s


class SteppedClock:
    """Clock that advances only on request: a wait returns at once, exactly at the requested time."""

    stepped = True

    def __init__(self) -> None:
        self._now_s = 0.0

    def now_s(self) -> float:
        return self._now_s

    def wait_until(self, time_s: float) -> float:
        self._now_s = max(self._now_s, time_s)
        return 0.0


# ---------------------------------------------------------------------------------------------------------------------
# Ticks of the cycle: the start of each cycle, its delay, and delays of this loop itself.


LOWER_THE_RATE = "Close other programs, add --real-time-priority, or lower --rate"
"""Advice if this computer, or its adapter, is too slow."""

SWITCH_S = 0.0005
"""Longest time for which another thread of this process may hold the interpreter, s, while a control loop runs."""
RECENT = 1000
"""Number of cycles in the statistics of delays."""
LATE_SHARE = 0.02
"""Share of late cycles that an ordinary scheduler causes."""
RATES_HZ = (1000.0, 500.0, 250.0, 200.0, 125.0, 100.0, 50.0, 25.0, 20.0)
"""Rates, Hz, below a profile's rate, for a computer that does not hold that rate; a watchdog needs five cycles."""
STALL_S, STALL_CYCLES = 0.05, 3.0
"""Limits of a stall, s and cycles: a loop that was delayed by more than both has stalled."""


def how_late(late_s: Iterable[float], period_s: float) -> str:
    """Return the number of late cycles and the cause as text, or an empty text if few of these cycles were late.

    ``late_s``: delay of the start of each cycle, or of each answer after its cycle, s.
    """
    ordered = sorted(late_s)
    late = sum(one > 0.5 * period_s for one in ordered)
    if late <= LATE_SHARE * len(ordered):
        return ""
    p99_s = quantile(ordered, 0.99)
    return (f"{late} of the last {len(ordered)} cycles were late (99 % of all by at most {1e3 * p99_s:.3g} ms): the"
            " computer or the adapter is too slow")


def quantile(ordered: list[float], share: float) -> float:
    """Return the smallest of these ordered values that this share of them does not exceed."""
    return ordered[max(0, math.ceil(share * len(ordered)) - 1)] if ordered else 0.0


FOLLOW_GAIN, FOLLOW_STEP = 0.05, 0.01
"""Share of the deviation from another clock that one tick corrects, and its limit as a share of the period."""


class Ticks:
    """A tick every ``period_s``. ``longest_stall_s``: a longer delay is an error; 0: no delay is an error."""

    def __init__(self, clock: Clock, period_s: float, longest_stall_s: float = 0.0) -> None:
        self._clock = clock
        self._period_s = period_s
        self._longest_stall_s = longest_stall_s
        counts_s = max(STALL_S, STALL_CYCLES * period_s)
        self._no_stall_s = min(counts_s, longest_stall_s) if longest_stall_s > 0.0 else counts_s
        self._ended_s = self._began_s = clock.now_s()
        self._next_s = self._ended_s + period_s
        self.overruns = 0
        self.late_s: deque[float] = deque(maxlen=RECENT)       # delay of the start of the last cycles
        self._stalls: deque[tuple[float, float]] = deque(maxlen=RECENT)    # time of return, duration of the stall

    def wait(self, until: Callable[[float], None] | None = None) -> None:
        """Wait until the next tick; ``until`` waits for a control time, s, in its own way.

        Raises CommunicationLost if the loop returns far too late, once for each time.

        A missed tick is not made up for: the line would carry two cycles without a pause, and two SYNCs would measure
        nearly the same instant.
        """
        clock, due_s = self._clock, self._next_s
        (until or clock.wait_until)(due_s)
        now_s = self._began_s = clock.now_s()
        late_s, half_s = now_s - due_s, 0.5 * self._period_s
        self.late_s.append(late_s)
        if late_s > half_s:
            self.overruns += 1
        self._next_s = max(due_s + self._period_s, now_s + half_s)
        # Waiting for a missing reply is not a stall; it has its own error.
        stood_still_s = now_s - max(due_s, self._ended_s)
        if stood_still_s > self._no_stall_s:
            self._refuse_stall(stood_still_s, now_s)

    def check(self) -> None:
        """Check for a stall just before a setpoint is sent: a process can be frozen anywhere, also after the tick.

        Raises CommunicationLost like `wait`.
        """
        now_s = self._clock.now_s()
        if now_s - self._began_s > self._no_stall_s:
            self._refuse_stall(now_s - self._began_s, now_s)

    def check_end(self) -> None:
        """Check for a stall when the cycle's frames are in: a loop that was frozen can't judge the drive's silence.

        Raises CommunicationLost like `wait`.
        """
        now_s = self._clock.now_s()
        if now_s - self._began_s > self._no_stall_s:
            self._refuse_stall(now_s - self._began_s, now_s, "")

    def stood_still_s(self, within_s: float) -> float:
        """Return the longest stall that ended within the last ``within_s``, s; 0 if there was none."""
        since_s = self._clock.now_s() - within_s
        return max((away_s for back_s, away_s in self._stalls if back_s >= since_s), default=0.0)

    def _refuse_stall(
        self, stood_still_s: float, now_s: float, then: str = "; the setpoint it had in hand was not sent"
    ) -> None:
        if stood_still_s > STALL_S and stood_still_s > STALL_CYCLES * self._period_s:
            self._stalls.append((now_s, stood_still_s))
        if 0.0 < self._longest_stall_s < stood_still_s:
            self._next_s = now_s + self._period_s
            self._ended_s = self._began_s = now_s
            raise CommunicationLost(
                f"the control loop stood still for {stood_still_s:.2f} s{then}",
                where="host",
                next_step="Was the laptop asleep, the process frozen? The drive's watchdog may have stopped the shaft",
                entry=MessageCode.HOST_LATE,
            )

    def done(self) -> None:
        """Note that the transactions of one cycle have ended."""
        self._ended_s = self._clock.now_s()

    def put_off(self) -> None:
        """Postpone the next tick to now at the earliest after other planned work; it does not count as a missed
        tick.
        """
        self._next_s = max(self._next_s, self._clock.now_s())

    def follow(self, behind: float) -> None:
        """Move the next tick towards the clock of the bus. ``behind``: deviation of this tick, in periods."""
        self._next_s -= max(-FOLLOW_STEP, min(FOLLOW_STEP, FOLLOW_GAIN * behind)) * self._period_s
