"""TPDO2, which comes once in several SYNCs, and the SYNC that its angle belongs to.

A drive answers a SYNC with TPDO1 and then, if it is due, with TPDO2. So a TPDO2 after this cycle's TPDO1 belongs to the
same SYNC, and its angle to the same instant as speed and torque. Each TPDO2 shows when the next is due, and a cycle in
which it is due waits for it. An angle that comes at any other moment is dropped, because its sample was already
returned. Mode display and torque demand count at any time.
"""

from __future__ import annotations

from typing import NamedTuple

from drivers.canopen.pdo import Slow

FORGOTTEN = 3
"""Number of missing TPDO2 after which tdhil stops waiting for them, because the time of the next is unknown."""


class ModeAndDemand(NamedTuple):
    """Mode display 6061h, and the torque demand 6074h in counts if it is carried."""

    code: int
    demand: int | None


class SlowFeedback:
    """Content of TPDO2. ``every``: number of SYNCs between two TPDO2."""

    def __init__(self, carried: Slow, every: int) -> None:
        self.carried = carried
        self._every = every
        self._syncs = 0                # number of SYNCs sent so far
        self._came_at: int | None = None           # number of the SYNC of the latest TPDO2
        self._counts: float | None = None          # angle at this cycle's SYNC
        self._waited_for = False
        self._held: ModeAndDemand | None = None

    def begin(self) -> None:
        """Count a SYNC, immediately before it is sent."""
        self._syncs += 1
        self._counts = None

    @property
    def due(self) -> bool:
        """True if this cycle must wait for a TPDO2."""
        if self.carried.position is None or self._came_at is None:
            return False
        since = self._syncs - self._came_at
        return since > 0 and since % self._every == 0 and since <= FORGOTTEN * self._every

    def wait(self) -> None:
        """Record that this cycle now waits for TPDO2 alone; its content is shown with the next cycle."""
        self._waited_for = True

    def take(self, data: bytes, behind_feedback: bool) -> ModeAndDemand | None:
        """Take one frame, without a wide shape's statusword. Return the values to show at once.

        ``behind_feedback``: this cycle's TPDO1 has come, so the frame belongs to the same SYNC. Otherwise it belongs to
        the SYNC before.
        """
        code, demand, counts = self.carried.unpack(data)
        self._came_at = self._syncs if behind_feedback else self._syncs - 1
        if behind_feedback:
            self._counts = counts
        shown = ModeAndDemand(code, demand)
        if self._waited_for:
            self._held = shown
            return None
        return shown

    def end(self) -> ModeAndDemand | None:
        """End the cycle. Return the values that came during the wait and are shown now."""
        shown, self._held = self._held, None
        self._waited_for = False
        return shown

    @property
    def counts(self) -> float | None:
        """The angle in counts at this cycle's SYNC; None if it did not come."""
        return self._counts
