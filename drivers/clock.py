"""Control time, as every loop above the drive sees it.

Two clocks: the wall's monotonic one, and one that the bus steps by a period a cycle (a simulated drive
advances its plant by as much), so that a protocol of minutes takes seconds and repeats.
"""

import time
from typing import Protocol


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
