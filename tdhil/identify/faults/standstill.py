"""A shaft that stands still or turns back during the excitation: stick-slip, play, or a mean speed that is too low.

At rest friction takes whatever value holds the shaft, and behind zero it changes its sign: neither is the straight line
that the levels and the lines are read with, and a jump of friction has lines of its own at the excited frequencies.
"""

import numpy as np

from tdhil.estimation.result import Refused
from tdhil.estimation.samples import Samples
from tdhil.recording.recording import Segment

_NEAR_ZERO = 0.01       # of the speed's largest value counts as rest; at least so many of the signal's steps:
_STEPS = 2.0
_LEAST_SHARE = 0.02     # of the samples


def check_standstill(parts: list[tuple[Segment, Samples]], quantum: float) -> None:
    """Raise Refused if the speed was at zero, or behind it, for more than a share of a segment that turned."""
    for segment, part in parts:
        if len(part) == 0:
            continue
        speed = part.speed_rad_s
        high, low = float(np.max(speed)), float(np.min(speed))
        direction = 1.0 if high + low >= 0.0 else -1.0
        near = max(_NEAR_ZERO * max(high, -low), _STEPS * quantum)
        behind = np.count_nonzero(speed < -near) if direction > 0.0 else np.count_nonzero(speed > near)
        at_rest = np.count_nonzero(speed <= near) - np.count_nonzero(speed < -near)
        where = f"about {segment.offset_rad_s:.3g} rad/s"
        if at_rest > _LEAST_SHARE * len(part):
            raise Refused(
                f"stick-slip: the shaft stood still for {at_rest / len(part):.1%} of the excitation {where}",
                "turn faster on the mean, or excite with less amplitude, so that the shaft never stops",
            )
        if behind > _LEAST_SHARE * len(part):
            raise Refused(
                f"the shaft turned backwards for {behind / len(part):.1%} of the excitation {where}",
                "turn faster on the mean, or excite with less amplitude, for friction jumps at zero speed",
            )
