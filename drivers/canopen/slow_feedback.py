"""TPDO2, which comes with every few SYNCs, and the SYNC that its angle belongs to.

A drive answers a SYNC with TPDO1 and then, where it is due, with TPDO2. So a TPDO2 that comes behind this cycle's TPDO1
is of the same SYNC, and its angle is of the same instant as speed and torque. From one that has come it is known when
the next is due: a cycle that is due waits for it. An angle that comes at any other moment is dropped, since the sample
that it belongs to has been given away; the mode display and the torque demand count whenever they come.
"""

from __future__ import annotations

from typing import NamedTuple

from drivers.canopen.pdo import Slow

FORGOTTEN = 3
"""After so many that were due and didn't come nobody waits for the next: it is not known when that would be."""


class ModeAndDemand(NamedTuple):
    """Mode display 6061h, and the torque demand 6074h in counts where it is carried."""

    code: int
    demand: int | None


class SlowFeedback:
    """What came; ``every``: TPDO2 comes with every so many SYNCs."""

    def __init__(self, carried: Slow, every: int) -> None:
        self.carried = carried
        self._every = every
        self._syncs = 0                # that went out
        self._came_at: int | None = None           # the SYNC that the last one belongs to
        self._counts: float | None = None          # of the angle, of this cycle's SYNC
        self._waited_for = False
        self._held: ModeAndDemand | None = None

    def begin(self) -> None:
        """Note that a SYNC is about to go out."""
        self._syncs += 1
        self._counts = None

    @property
    def due(self) -> bool:
        """Is one to be waited for, in this cycle?"""
        if self.carried.position is None or self._came_at is None:
            return False
        since = self._syncs - self._came_at
        return since > 0 and since % self._every == 0 and since <= FORGOTTEN * self._every

    def wait(self) -> None:
        """From now on this cycle waits for nothing else; what comes is shown with the next cycle."""
        self._waited_for = True

    def take(self, data: bytes, behind_feedback: bool) -> ModeAndDemand | None:
        """Take one frame, without a wide shape's statusword; what is to be shown at once.

        ``behind_feedback``: this cycle's TPDO1 has come, so it is of the same SYNC; otherwise it is of the one before.
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
        """End the cycle; what came while it was waited for, and is to be shown now."""
        shown, self._held = self._held, None
        self._waited_for = False
        return shown

    @property
    def counts(self) -> float | None:
        """The angle in counts, of this cycle's SYNC; None where it didn't come."""
        return self._counts
