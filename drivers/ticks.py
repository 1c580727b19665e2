"""The beat of the cycle: when each one begins, which began late, and whether this loop itself stood still."""

from collections.abc import Callable

from drivers.clock import Clock
from drivers.errors import CommunicationLost


class Ticks:
    """A tick every ``period_s``. ``longest_stall_s``: standing still for longer is an error; 0: it never is."""

    def __init__(self, clock: Clock, period_s: float, longest_stall_s: float = 0.0) -> None:
        self._clock = clock
        self._period_s = period_s
        self._longest_stall_s = longest_stall_s
        self._ended_s = self._began_s = clock.now_s()
        self._next_s = self._ended_s + period_s
        self.overruns = 0

    def wait(self, until: Callable[[float], None] | None = None) -> None:
        """Until the next tick; ``until`` waits for a control time, s, in its own way.

        Raises CommunicationLost if the loop comes back far too late, once for each time.

        A tick that was overslept is not caught up with: the line would carry two cycles in a row without a pause, and
        what a SYNC measures would be one instant twice.
        """
        clock, due_s = self._clock, self._next_s
        (until or clock.wait_until)(due_s)
        now_s = clock.now_s()
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

    def _refuse_stall(self, stood_still_s: float, now_s: float) -> None:
        if 0.0 < self._longest_stall_s < stood_still_s:
            self._next_s = now_s + self._period_s
            self._ended_s = self._began_s = now_s
            raise CommunicationLost(
                f"the control loop stood still for {stood_still_s:.2f} s; the setpoint it had in hand was not sent",
                where="host",
                next_step="Was the laptop asleep, the process frozen? The drive's watchdog may have stopped the shaft",
            )

    def done(self) -> None:
        """The talk of one cycle on the line is over."""
        self._ended_s = self._clock.now_s()

    def put_off(self) -> None:
        """Time was well spent on something else: the next tick is due now at the earliest, nothing was overslept."""
        self._next_s = max(self._next_s, self._clock.now_s())
