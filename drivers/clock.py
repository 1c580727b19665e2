"""Control time, as every loop above the drive sees it.

Two clocks: the wall's monotonic one, and one that the bus steps by a period a cycle (a simulated drive
advances its plant by as much), so that a protocol of minutes takes seconds and repeats.
"""

import math
import time
from collections import deque
from collections.abc import Callable, Iterable
from typing import Protocol

from drivers.errors import CommunicationLost


class Clock(Protocol):
    """Seconds since the clock was made; ``wait_until`` returns how late it came back (0 if in time)."""

    stepped: bool

    def now_s(self) -> float: ...

    def wait_until(self, time_s: float) -> float: ...


def _boot_time_s() -> float:
    """Monotonic, and it goes on while a laptop sleeps: a loop that slept through must notice that it did."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


_now_s = _boot_time_s if hasattr(time, "CLOCK_BOOTTIME") else time.monotonic


class MonotonicClock:
    """The machine's monotonic clock, time asleep included; its zero is the moment it was made."""

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
    """Moves only when told to: a wait is over at once, and it is then exactly the time waited for."""

    stepped = True

    def __init__(self) -> None:
        self._now_s = 0.0

    def now_s(self) -> float:
        return self._now_s

    def wait_until(self, time_s: float) -> float:
        self._now_s = max(self._now_s, time_s)
        return 0.0


# ---------------------------------------------------------------------------------------------------------------------
# The beat of the cycle: when each one begins, which began late, and whether this loop itself stood still.


LOWER_THE_RATE = "Lower --rate, or give --real-time-priority"
"""What to do where this computer, or its adapter, doesn't keep up."""

RECENT = 1000
"""So many cycles are looked at when it is asked how late they were."""
LATE_SHARE = 0.02
"""Of those: so many late ones are an ordinary scheduler's."""
RATES_HZ = (1000.0, 500.0, 250.0, 200.0, 125.0, 100.0, 50.0, 25.0, 20.0)
"""What is tried below a profile's rate, where this computer doesn't hold that one; a watchdog wants five cycles."""
STALL_S, STALL_CYCLES = 0.05, 3.0
"""Whoever was away for longer than both has stood still."""


def how_late(late_s: Iterable[float], period_s: float) -> str:
    """`host or adapter late (n of m cycles, p99 …)`, or nothing where few of these cycles were.

    ``late_s``: by how much each cycle began late, or each answer came after its cycle, s.
    """
    ordered = sorted(late_s)
    late = sum(one > 0.5 * period_s for one in ordered)
    if late <= LATE_SHARE * len(ordered):
        return ""
    p99_s = quantile(ordered, 0.99)
    return f"host or adapter late ({late} of {len(ordered)} cycles, p99 {1e3 * p99_s:.3g} ms)"


def quantile(ordered: list[float], share: float) -> float:
    """The smallest of these, in order, that so large a share doesn't exceed."""
    return ordered[max(0, math.ceil(share * len(ordered)) - 1)] if ordered else 0.0


class Ticks:
    """A tick every ``period_s``. ``longest_stall_s``: standing still for longer is an error; 0: it never is."""

    def __init__(self, clock: Clock, period_s: float, longest_stall_s: float = 0.0) -> None:
        self._clock = clock
        self._period_s = period_s
        self._longest_stall_s = longest_stall_s
        self._ended_s = self._began_s = clock.now_s()
        self._next_s = self._ended_s + period_s
        self.overruns = 0
        self.late_s: deque[float] = deque(maxlen=RECENT)       # by how much the last cycles began late
        self._stalls: deque[tuple[float, float]] = deque(maxlen=RECENT)    # when this loop was back, how long away

    def wait(self, until: Callable[[float], None] | None = None) -> None:
        """Until the next tick; ``until`` waits for a control time, s, in its own way.

        Raises CommunicationLost if the loop comes back far too late, once for each time.

        A tick that was overslept is not caught up with: the line would carry two cycles in a row without a pause, and
        what a SYNC measures would be one instant twice.
        """
        clock, due_s = self._clock, self._next_s
        (until or clock.wait_until)(due_s)
        now_s = clock.now_s()
        self.late_s.append(now_s - due_s)
        if now_s - due_s > 0.5 * self._period_s:
            self.overruns += 1
        self._next_s = max(due_s + self._period_s, now_s + 0.5 * self._period_s)
        self._began_s = now_s
        # Waiting for a reply that didn't come isn't standing still: that is told by its own error.
        self._refuse_stall(now_s - max(due_s, self._ended_s), now_s)

    def check(self) -> None:
        """Just before a setpoint goes out: a process can be frozen anywhere, also between the tick and here.

        Raises CommunicationLost like `wait`.
        """
        now_s = self._clock.now_s()
        self._refuse_stall(now_s - self._began_s, now_s)

    def check_end(self) -> None:
        """When the cycle's frames are in: whoever was frozen in waiting for them must not judge the drive's silence.

        Raises CommunicationLost like `wait`.
        """
        now_s = self._clock.now_s()
        self._refuse_stall(now_s - self._began_s, now_s, "")

    def stood_still_s(self, within_s: float) -> float:
        """The longest that this loop was away for and came back from within the last ``within_s``, s; 0: never."""
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
            )

    def done(self) -> None:
        """The talk of one cycle on the line is over."""
        self._ended_s = self._clock.now_s()

    def put_off(self) -> None:
        """Time was well spent on something else: the next tick is due now at the earliest, nothing was overslept."""
        self._next_s = max(self._next_s, self._clock.now_s())
