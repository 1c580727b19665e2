"""Stick-slip in a record: the shaft sticks while torque rises, and jumps when friction gives way.

Static friction is larger than friction in motion, and a speed loop that is too soft cannot hold the speed between them.
What is seen is a standstill, within the resolution of the speed, during which torque rises steadily; then motion, and
standstill again. A start from standstill is another thing: there the torque is constant, and rises when motion begins.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from profiles import MessageCode
from tdhil.estimation.result import Refused
from tdhil.estimation.samples import Samples
from tdhil.recording import BoolArray, FloatArray

_STILL_SHARE = 0.02       # of the highest speed: slower is standstill, …
_STILL_QUANTA = 3.0       # … and so is what lies within so many steps of the reported speed
_MOVES_SHARE = 0.2        # of the highest speed, that a jump reaches
_LEAST_SAMPLES = 12       # of a standstill
_SETTLED = 0.2            # of a standstill: at its begin the reports still show the motion before
_STEADY = 0.9             # correlation of torque and time: a torque that rises late and at once has less
_LEAST_RISE = 0.1         # of the torque's span: less is drift
_MOST_JUMPS_APART = 0.5   # of all standstills between motions, that are stick-slip
_LEAST_JUMPS = 3          # jumps that make stick-slip


@dataclass(frozen=True)
class StickSlip:
    """``jumps``: how often the shaft stuck and jumped; ``still``: share of the record at standstill.

    ``rise_nm``: how far torque rises before a jump, N·m, the median.
    """

    jumps: int
    still: float
    rise_nm: float


def refuse_stick_slip(samples: Samples, speed_quantum: float, torque_quantum: float) -> None:
    """Raise Refused where a record has stick-slip, with the motion that would help."""
    seen = find_stick_slip(samples, speed_quantum, torque_quantum)
    if seen is None:
        return
    raise Refused(
        f"stick-slip: the shaft stood still {seen.jumps} times while torque rose by {seen.rise_nm:.3g} N·m,"
        f" and then jumped; it was at standstill for {seen.still:.0%} of the record",
        "turn faster, so that the shaft never stops, or use a stiffer speed loop: friction at standstill is larger"
        " than in motion, and the speed loop does not hold the speed between them",
        entry=MessageCode.STICK_SLIP_RECORDED,
    )


def find_stick_slip(samples: Samples, speed_quantum: float, torque_quantum: float) -> StickSlip | None:
    """The stick-slip in a record; None where it has none."""
    if len(samples) < 4 * _LEAST_SAMPLES:
        return None
    speed, torque = samples.speed_rad_s, samples.torque_nm
    fastest = float(np.max(np.abs(speed)))
    still = np.abs(speed) <= max(_STILL_SHARE * fastest, _STILL_QUANTA * speed_quantum)
    span = float(np.ptp(torque))
    edges = np.concatenate([[0], np.flatnonzero(np.diff(still)) + 1, [len(still)]])
    parts = [(int(first), int(last)) for first, last in pairwise(edges)]
    between, rises = 0, []
    for (first, last), (_, after) in pairwise(parts):
        if not still[first] or first == 0 or last - first < _LEAST_SAMPLES:
            continue
        jump = speed[last:after]
        if np.max(np.abs(jump)) < _MOVES_SHARE * fastest:
            continue
        between += 1
        way = float(np.sign(jump[np.argmax(np.abs(jump))]))
        if way != _way_before(speed, still, first):
            continue      # a speed loop that reverses the shaft winds up at standstill as well, for a moment
        rise = _rise(samples.time_s[first:last], way * torque[first:last])
        if rise > max(_LEAST_RISE * span, 2.0 * torque_quantum):
            rises.append(rise)
    if len(rises) < _LEAST_JUMPS or len(rises) < _MOST_JUMPS_APART * between:
        return None
    return StickSlip(len(rises), float(np.mean(still)), float(np.median(rises)))


def _way_before(speed: FloatArray, still: BoolArray, first: int) -> float:
    """The sense of rotation before the standstill that begins with sample ``first``, ±1."""
    stops = np.flatnonzero(still[:first])
    begun = int(stops[-1]) + 1 if len(stops) else 0
    moving = speed[begun:first]
    return float(np.sign(moving[np.argmax(np.abs(moving))])) if len(moving) else 0.0


def _rise(time: FloatArray, torque: FloatArray) -> float:
    """How far torque rises over a standstill, N·m, once the reports have settled; 0 where it is not steady."""
    begun = int(_SETTLED * len(time))
    time, torque = time[begun:] - time[begun], torque[begun:]
    if np.ptp(torque) == 0.0 or np.corrcoef(time, torque)[0, 1] < _STEADY:
        return 0.0
    slope = float(np.polyfit(time, torque, 1)[0])
    return slope * float(time[-1])
