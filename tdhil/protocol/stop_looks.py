"""Single looks at a drive (`drivers.drive.Looking`) for a stop without feedback of the cycle, or none to believe.

A look feeds what supervises the host. So it must not go on for ever at a shaft that is not slowing down: such a one is
left to the drive's own watchdog, which wants silence (`Slowing`).
"""

from __future__ import annotations

import math

from drivers.drive import Drive, Looking, Sample

AFTER_S = 0.2
"""Without cyclic feedback for so long, the drive is looked at."""

EVERY_S, MOST_S = 0.1, 0.4
"""Between two looks; twice as long after each that brought nothing, up to the second."""

SLOWING_S, SLOWER = 1.0, 0.98
"""Under looks alone the shaft must have lost so much of its speed each second."""


class Looks:
    """Knows when a look is due. ``only``: the cyclic feedback is not believed any more."""

    def __init__(self, drive: Drive, period_s: float) -> None:
        self._drive = drive if isinstance(drive, Looking) else None
        self._period_s = period_s
        self._missing_s = 0.0
        self._due_s = AFTER_S
        self._pause_s = EVERY_S
        self.only = False
        self.answered = 0

    @property
    def standing(self) -> bool:
        """Do looks stand in for the cycle's feedback at present?"""
        return self.only or self._missing_s > 0.0

    def heard(self) -> None:
        """The cycle brought feedback."""
        self._missing_s, self._due_s, self._pause_s = 0.0, AFTER_S, EVERY_S

    def missed(self) -> Sample | None:
        """A cycle has brought none: the drive's answer, where a look was due and was answered. May raise."""
        self._missing_s += self._period_s
        if self._drive is None or self._missing_s < self._due_s - 1e-9:
            return None
        self._due_s = self._missing_s + self._pause_s
        self._pause_s = min(MOST_S, 2.0 * self._pause_s)
        return self.ask()

    def ask(self) -> Sample | None:
        """Look now; None without an answer. May raise."""
        sample = self._drive.look() if self._drive is not None else None
        if sample is not None:
            self.answered += 1
            self._due_s, self._pause_s = self._missing_s + EVERY_S, EVERY_S
        return sample


class Slowing:
    """Does the shaft lose speed? ``within_s``: how long it may take over `SLOWER` of it."""

    def __init__(self, at_rest_rad_s: float, within_s: float = SLOWING_S) -> None:
        self._at_rest_rad_s = at_rest_rad_s
        self._within_s = within_s
        self._since_s: float | None = None
        self._speed_rad_s = math.inf

    def reset(self) -> None:
        """What comes next is seen as the first."""
        self._since_s = None

    def see(self, time_s: float, speed_rad_s: float) -> bool:
        """False once a shaft that turns has not got slower for so long."""
        speed_rad_s = abs(speed_rad_s)
        if self._since_s is None or speed_rad_s <= max(self._at_rest_rad_s, SLOWER * self._speed_rad_s):
            self._since_s, self._speed_rad_s = time_s, speed_rad_s
        return time_s - self._since_s < self._within_s
