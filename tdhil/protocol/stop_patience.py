"""How long a stop is waited for: by the ramp, and beyond it for as long as the shaft keeps getting slower. Pure.

A heavy shaft at its torque limit takes J ω / T instead of the ramp's time, and one on a string swings on the way down:
the highest speed of each block of 5 s must be lower than ever before by 1 %, or patience ends after two more blocks.
"""

from __future__ import annotations

import math

BLOCK_S = 5.0
BLOCKS = 2.0
SLOWER = 0.99
LONGEST_S = 300.0


class Patience:
    """``see`` every sample and ``wait`` every cycle without one; ``over`` says when to give up."""

    def __init__(self, enough_s: float, at_rest_rad_s: float) -> None:
        self._enough_s = enough_s
        self._at_rest_rad_s = at_rest_rad_s
        self._block_s = 0.0
        self._peak = 0.0
        self._best = math.inf
        self._gained_s = 0.0
        self.waited_s = 0.0

    @property
    def over(self) -> bool:
        """Long enough, and no slower for two blocks; or longer than any stop may take."""
        no_gain_s = self.waited_s - self._gained_s
        return self.waited_s > LONGEST_S or (self.waited_s > self._enough_s and no_gain_s > BLOCKS * BLOCK_S)

    def wait(self, period_s: float) -> None:
        """A cycle has gone by."""
        self.waited_s += period_s
        self._block_s += period_s
        if self._block_s < BLOCK_S:
            return
        # A shaft that hardly moves gets no slower by noise alone.
        if self._at_rest_rad_s < self._peak < SLOWER * self._best:
            self._best, self._gained_s = self._peak, self.waited_s
        self._block_s = self._peak = 0.0

    def see(self, speed_rad_s: float, period_s: float) -> None:
        """A cycle has gone by, and showed this speed."""
        self._peak = max(self._peak, abs(speed_rad_s))
        self.wait(period_s)
