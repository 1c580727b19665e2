"""Motion after the drive left operation by itself: it removed its torque, or brakes after a fault. Pure."""

from __future__ import annotations

import math

from tdhil.runner.observer.points import Point

BRAKED_SHARE = 0.1
"""Least impulse of a braking torque that has stopped a shaft, over the largest that its inertia may need. Before stage
2 ends, the bound of J is up to four times J (`drive-fault@speed+1s`: 388 for 104 kg·m²), and friction takes a part of
the impulse. A drive whose speed signal is lost has none: its torque drives the shaft on."""


class LeftOperation:
    """Points from the one at which the drive left operation. ``speed_rad_s``: the largest reported speed since then."""

    def __init__(self, first: Point) -> None:
        self.time_s = first.time_s
        self.speed_rad_s = abs(first.speed)
        self._sign = math.copysign(1.0, first.speed)
        self._driving_nms = self._sign * first.impulse
        self._braking_nms = 0.0
        self._stopped = False

    def see(self, point: Point, *, turns: bool) -> None:
        """Add a point; ``turns``: its reported speed is clearly not zero.

        The torque counts until the speed is reported as zero: later, an error of its zero would add up.
        """
        if self._stopped:
            return
        self._stopped = not turns
        self.speed_rad_s = max(self.speed_rad_s, abs(point.speed))
        impulse_nms = self._sign * point.impulse
        self._driving_nms = max(self._driving_nms, impulse_nms)
        self._braking_nms = self._driving_nms - impulse_nms

    def braked(self, inertia_high: float) -> bool:
        """Return whether the reported torque stopped the shaft; ``inertia_high``: upper bound of J, kg·m²."""
        return self._stopped and self._braking_nms >= BRAKED_SHARE * inertia_high * self.speed_rad_s
