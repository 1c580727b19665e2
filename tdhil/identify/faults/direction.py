"""Signs and columns: does the torque do work on the shaft when it speeds up?

At a line T = G W, and a shaft with inertia has Im G > 0: torque leads speed. Lags turn G by less than a quarter turn at
the slow lines. Where Im G is negative at every clear line, the reported torque counts the other way round (G is −G), or
speed and torque stand in each other's place (G is 1/G). A drive's convention tells which: the mean torque of a shaft
that is driven against friction has the sign of its speed, if both were not exchanged. And where G is the same real
number at lines that are far apart, torque is a copy of speed: inertia and lags would have to cancel exactly.
"""

import numpy as np

from tdhil.estimation.frequency_domain.spectrum import Line
from tdhil.estimation.result import Refused

_CLEAR = 5.0      # sd by which Im(T W*) must be below zero at one line at least; at the others it must be below
_COPY = 1e-3      # relative


def check_direction(lines: tuple[Line, ...], mean_speed: float, mean_torque: float) -> None:
    """Raise Refused if at every one of the excited lines torque trails speed; means in rad/s and N·m."""
    if not lines:
        return
    if _copied(lines):
        raise Refused(
            "the torque is a copy of the speed: their ratio is the same at every line",
            "check which columns hold speed and torque",
        )
    clearest = 0.0
    for line in lines:
        cross = (line.torque * np.conj(line.speed)).imag
        # what one period's scatter makes of it
        noise = np.sqrt((line.s_tt * np.abs(line.speed) ** 2 + line.s_ww * np.abs(line.torque) ** 2) / line.periods)
        if np.any(cross >= 0.0):
            return
        clearest = max(clearest, float(np.max(-cross / noise)))
    if clearest < _CLEAR:
        return
    if mean_speed * mean_torque < 0.0:
        raise Refused(
            "the torque opposes every acceleration, and the mean speed too: its sign is the wrong way round",
            "count torque positive that drives the speed positive",
        )
    raise Refused(
        "the torque trails the speed at every line, as for a negative inertia: speed and torque stand in each other's "
        "place, or one of them has the wrong sign",
        "check which column is which, and the sign of the torque",
    )


def _copied(lines: tuple[Line, ...]) -> bool:
    """Is T/W one and the same real number, at lines an octave apart or more?"""
    if lines[-1].hertz < 2.0 * lines[0].hertz:
        return False
    ratio = np.concatenate([line.torque / line.speed for line in lines])
    return bool(np.max(np.abs(ratio - ratio[0].real)) < _COPY * abs(ratio[0].real))
