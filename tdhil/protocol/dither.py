"""A slow small motion beside the excitation of speed mode, where the drive reports speed in coarse steps. Pure.

Under speed control one period repeats the last, and so does the rounding of its reports to whole rpm, say: a pattern
that adds up on the excited lines instead of averaging out, and that no scatter between periods shows. A triangle of a
count or two, whose period has no whole ratio to the excitation's, makes every period round elsewhere.
"""

import math

COUNTS = 2.0              # peak of the triangle, in counts of the reported speed
COARSE_SHARE = 0.002      # of the window: finer counts than this need none
MOST_SHARE = 0.015        # of the window: half of the margin that a plan keeps free at either end
PERIODS = (math.sqrt(5.0) - 1.0) / 2.0
"""Of the excitation's period: the golden ratio is the farthest from every whole ratio."""


def dither_peak(resolution_rad_s: float, window_rad_s: float) -> float:
    """Peak of the triangle, rad/s; 0 where the reported speed is fine enough."""
    if resolution_rad_s < COARSE_SHARE * window_rad_s:
        return 0.0
    return min(COUNTS * resolution_rad_s, MOST_SHARE * window_rad_s)


def dither(time_s: float, period_s: float, peak_rad_s: float) -> float:
    """What is added to the speed setpoint, rad/s; begins at zero."""
    turn = (time_s / (PERIODS * period_s) + 0.25) % 1.0
    return peak_rad_s * (1.0 - 4.0 * abs(turn - 0.5))
