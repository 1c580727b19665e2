"""Stick-slip in a recording: the shaft sticks while torque rises, and jumps when static friction is exceeded.

Static friction is larger than friction in motion, and a speed loop that is too soft cannot hold the speed between them.
The recording shows a standstill, within the resolution of the speed, during which torque rises steadily; then motion,
and standstill again. A start from standstill differs: the torque is constant, and rises when motion begins.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from profiles import MessageCode
from tdhil.estimation.result import Refused
from tdhil.estimation.samples import Samples, edges_of_runs
from tdhil.estimation.time_domain.windows import STILL_QUANTA

_STILL_SHARE = 0.02       # of the highest speed: a lower speed counts as standstill
_MOVES_SHARE = 0.2        # of the highest speed: least speed of a jump
_LEAST_SAMPLES = 12       # fewest samples of a standstill
_SETTLED = 0.2            # of a standstill: its beginning, in which the reports still show the motion before
_STEADY = 0.9             # least correlation of torque and time: a torque that rises late and suddenly has less
_LEAST_RISE = 0.1         # of the torque's span: a smaller rise is drift
_MOST_JUMPS_APART = 0.5   # least share of stick-slip in all standstills between motions
_LEAST_JUMPS = 3          # fewest jumps of stick-slip


@dataclass(frozen=True)
class StickSlip:
    """Result of the search. ``jumps``: number of times the shaft stuck and jumped; ``still``: share of time at
    standstill.

    ``rise_nm``: median rise of torque before a jump, N·m.
    """

    jumps: int
    still: float
    rise_nm: float


def refuse_stick_slip(samples: Samples, speed_quantum: float, torque_quantum: float) -> None:
    """Raise Refused if a recording has stick-slip, with the motion that would help."""
    seen = find_stick_slip(samples, speed_quantum, torque_quantum)
    if seen is None:
        return
    raise Refused(
        f"stick-slip: the shaft stopped {seen.jumps} times while the torque rose by {seen.rise_nm:.3g} N·m, and "
        f"then jumped. It was at standstill for {100 * seen.still:.0f} % of the record",
        "turn faster, so that the shaft never stops, or use a stiffer speed loop",
        entry=MessageCode.STICK_SLIP_RECORDED,
    )


def find_stick_slip(samples: Samples, speed_quantum: float, torque_quantum: float) -> StickSlip | None:
    """Return the stick-slip of a recording; None without stick-slip."""
    if len(samples) < 4 * _LEAST_SAMPLES:
        return None
    speed, torque = samples.speed_rad_s, samples.torque_nm
    fastest = float(np.max(np.abs(speed)))
    still = np.abs(speed) <= max(_STILL_SHARE * fastest, STILL_QUANTA * speed_quantum)
    span = float(np.ptp(torque))
    parts = [(int(first), int(last)) for first, last in pairwise(edges_of_runs(still))]
    between, rises = 0, []
    for (first, last), (_, after) in pairwise(parts):
        if not still[first] or first == 0 or last - first < _LEAST_SAMPLES:
            continue
        jump = speed[last:after]
        if np.max(np.abs(jump)) < _MOVES_SHARE * fastest:
            continue
        between += 1
        way = float(np.sign(jump[np.argmax(np.abs(jump))]))
        stops = np.flatnonzero(still[:first])
        before = speed[int(stops[-1]) + 1 if len(stops) else 0 : first]
        if way != (float(np.sign(before[np.argmax(np.abs(before))])) if len(before) else 0.0):
            continue      # a speed loop that reverses the shaft also integrates at standstill, for a moment
        # the rise of torque over the standstill after the reports settled, N·m, if it is steady
        begun = first + int(_SETTLED * (last - first))
        time_s, pull = samples.time_s[begun:last] - samples.time_s[begun], way * torque[begun:last]
        if np.ptp(pull) == 0.0 or np.corrcoef(time_s, pull)[0, 1] < _STEADY:
            continue
        rise = float(np.polyfit(time_s, pull, 1)[0]) * float(time_s[-1])
        if rise > max(_LEAST_RISE * span, 2.0 * torque_quantum):
            rises.append(rise)
    if len(rises) < _LEAST_JUMPS or len(rises) < _MOST_JUMPS_APART * between:
        return None
    return StickSlip(len(rises), float(np.mean(still)), float(np.median(rises)))
