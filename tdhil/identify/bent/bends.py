"""The shapes that friction over speed may have besides its straight line.

    T_f(ω) = T_c sgn ω + B ω + c g(ω)

g is Stribeck's bell, exp(−(ω/ω_s)²), whose ω_s runs over a grid, or the parabola ω |ω| of a fan and of churned oil,
which wide bells come near. One shape with either sign of c, not a sum of them: over the speeds of one run two of them
could hardly be told apart.
"""

from dataclasses import dataclass

import numpy as np

from tdhil.recording.recording import FloatArray

_WIDTHS = 9
_NARROWEST, _WIDEST = 0.35, 1.0     # of the slowest and of the fastest speed: outside, a bell is not to be seen


@dataclass(frozen=True)
class Bend:
    """One shape; ``width_rad_s`` None: the parabola."""

    width_rad_s: float | None

    def over(self, speed: FloatArray) -> FloatArray:
        """The shape g at speeds (rad/s)."""
        if self.width_rad_s is None:
            parabola: FloatArray = speed * np.abs(speed)
            return parabola
        bell: FloatArray = np.sign(speed) * np.exp(-((speed / self.width_rad_s) ** 2))
        return bell


def bends(slowest_rad_s: float, fastest_rad_s: float) -> tuple[Bend, ...]:
    """All that is tried for a run between two speeds of one direction, both in magnitude."""
    widths = np.geomspace(_NARROWEST * slowest_rad_s, _WIDEST * fastest_rad_s, _WIDTHS)
    return (*(Bend(float(width)) for width in widths), Bend(None))
