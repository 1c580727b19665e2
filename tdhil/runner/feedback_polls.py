"""Single polls of a drive (`drivers.drive.Polled`) for a stop without credible feedback of the cycle.

A poll also feeds the drive's watchdog. So polling must end if the shaft does not slow down: the watchdog acts only if
no requests come (`Slowing`).
"""

from __future__ import annotations

import math

from drivers import Drive, Polled, Sample

AFTER_S = 0.2
"""Time without cyclic feedback after which the drive is polled, s."""

EVERY_S, MOST_S = 0.1, 0.4
"""Interval between two polls, s. It doubles after each poll without an answer, up to the second value."""

SLOWING_S, SLOWER = 1.0, 0.98
"""Under polls alone: time within which the speed must fall, s, and the share to which it must fall."""


class FeedbackPolls:
    """Polls of the drive, with their timing. ``only``: the cyclic feedback no longer counts."""

    def __init__(self, drive: Drive, period_s: float) -> None:
        self._drive = drive if isinstance(drive, Polled) else None
        self._period_s = period_s
        self._missing_s = 0.0
        self._due_s = AFTER_S
        self._pause_s = EVERY_S
        self.only = False
        self.answered = 0

    @property
    def standing(self) -> bool:
        """Return whether polls replace the cycle's feedback at present."""
        return self.only or self._missing_s > 0.0

    def heard(self) -> None:
        """Note that the cycle brought feedback."""
        self._missing_s, self._due_s, self._pause_s = 0.0, AFTER_S, EVERY_S

    def missed(self) -> Sample | None:
        """Note a cycle without feedback. Return the drive's answer if a poll was due, or None. May raise."""
        self._missing_s += self._period_s
        if self._drive is None or self._missing_s < self._due_s - 1e-9:
            return None
        self._due_s = self._missing_s + self._pause_s
        self._pause_s = min(MOST_S, 2.0 * self._pause_s)
        return self.ask()

    def ask(self) -> Sample | None:
        """Poll now. Return the drive's answer, or None without one. May raise."""
        sample = self._drive.poll() if self._drive is not None else None
        if sample is not None:
            self.answered += 1
            self._due_s, self._pause_s = self._missing_s + EVERY_S, EVERY_S
        return sample


class Slowing:
    """Test whether a shaft slows down: to the share `SLOWER` of its speed within ``within_s``."""

    def __init__(self, at_rest_rad_s: float, within_s: float = SLOWING_S) -> None:
        self._at_rest_rad_s = at_rest_rad_s
        self._within_s = within_s
        self._since_s: float | None = None
        self._speed_rad_s = math.inf

    def reset(self) -> None:
        """Start again with the next sample."""
        self._since_s = None

    def see(self, time_s: float, speed_rad_s: float) -> bool:
        """Return False once a turning shaft has not become slower for ``within_s``."""
        speed_rad_s = abs(speed_rad_s)
        if self._since_s is None or speed_rad_s <= max(self._at_rest_rad_s, SLOWER * self._speed_rad_s):
            self._since_s, self._speed_rad_s = time_s, speed_rad_s
        return time_s - self._since_s < self._within_s
