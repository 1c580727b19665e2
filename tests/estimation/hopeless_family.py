"""Family of unusable records: a name, its change of a good record with a seed, and the required message.

If the fault can be recognised, the family states words of the reason or warning. Families without words are refused,
or accepted with a warning because the interval still covers.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from tests.estimation.hopeless_shaft import LEAD_S, PERIOD_S, PERIODS, Trouble


@dataclass(frozen=True)
class Family:
    """Family. ``trouble``: fault of the shaft. ``spoil``: fault of the record. ``said``: one of the required words."""

    name: str
    said: tuple[str, ...]
    spoil: Callable | None = None
    trouble: Callable[[np.random.Generator], Trouble] = lambda rng: Trouble()


def families():
    """Return a list, and decorators that add a fault of the record or of the shaft to it."""
    kept: list[Family] = []

    def family(*said: str, trouble=None):
        def keep(spoil):
            kept.append(Family(spoil.__name__, said, spoil, trouble or (lambda rng: Trouble())))
            return spoil

        return keep

    def shaft(name: str, *said: str):
        def keep(trouble):
            kept.append(Family(name, said, None, trouble))
            return trouble

        return keep

    return kept, family, shaft


def taken(r, index):
    return replace(r, time_s=r.time_s[index], speed_rad_s=r.speed_rad_s[index], torque_nm=r.torque_nm[index],
                   fresh=r.fresh[index], limited=r.limited[index])


def declaring(r, **changes):
    segments = tuple(replace(segment, **changes) for segment in r.excitation.segments)
    return replace(r, excitation=replace(r.excitation, segments=segments))


def moment(rng):
    """Return a time within the excitation of the first segment, after settling."""
    return LEAD_S + PERIOD_S + rng.uniform(0.0, (PERIODS - 2) * PERIOD_S)
