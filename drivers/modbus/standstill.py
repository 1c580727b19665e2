"""Standstill told from the reported speed, for drives whose status word doesn't tell."""

from __future__ import annotations

import math
from collections import deque

STILL_S = 0.2
LEAST_SAMPLES = 5
MOST_GAPS = 2
"""Single lost replies of a noisy line in a row, which unsay nothing: no shaft gets up and comes to rest meanwhile."""
COUNTS, SHARE = 5, 0.005
"""No sample beyond so many counts, or this share of the speed limit if that is more …"""
MEAN_COUNTS, MEAN_SHARE = 1, 0.001
"""… and their mean within this: noise averages out, a shaft that still creeps doesn't."""


class Standstill:
    """At rest once the speed has stayed at zero for `STILL_S` and `LEAST_SAMPLES` samples without a longer gap."""

    def __init__(self, count_rad_s: float, limit_rad_s: float, period_s: float) -> None:
        self._peak_rad_s = max(COUNTS * count_rad_s, SHARE * limit_rad_s)
        self._mean_rad_s = max(MEAN_COUNTS * count_rad_s, MEAN_SHARE * limit_rad_s)
        self._gaps = 0
        self._last: deque[float] = deque(maxlen=max(LEAST_SAMPLES, math.ceil(STILL_S / period_s)))

    def gap(self) -> None:
        """A cycle brought nothing. After some of these in a row what was seen before them no longer counts."""
        self._gaps += 1
        if self._gaps > MOST_GAPS:
            self._last.clear()

    def near(self, speed_rad_s: float) -> bool:
        """Is this one sample no more than the noise of a shaft at rest?"""
        return abs(speed_rad_s) <= self._peak_rad_s

    def add(self, speed_rad_s: float) -> bool:
        """One more sample; whether the shaft is at rest."""
        last, self._gaps = self._last, 0
        last.append(speed_rad_s)
        if len(last) < (last.maxlen or 0) or not self.near(speed_rad_s):
            return False
        return max(map(abs, last)) <= self._peak_rad_s and abs(sum(last)) <= self._mean_rad_s * len(last)
