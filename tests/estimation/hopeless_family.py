"""A family of hopeless records: a name, what it does to a sound one with a seed, and what must be said of it.

A family says which words the reason or a warning must have, where the fault can be recognised; those that can only be
refused, or let through with a warning because the interval still covers, have none.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from tests.estimation.hopeless_shaft import LEAD_S, PERIOD_S, PERIODS, Trouble


@dataclass(frozen=True)
class Family:
    """``trouble``: what happens to the shaft; ``spoil``: to the record; ``said``: one of these must be said."""

    name: str
    said: tuple[str, ...]
    spoil: Callable | None = None
    trouble: Callable[[np.random.Generator], Trouble] = lambda rng: Trouble()


def families():
    """(a list; decorators that put into it what happens to the record, and what happens to the shaft)."""
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
    """A second within the excitation of the first segment, after settling."""
    return LEAD_S + PERIOD_S + rng.uniform(0.0, (PERIODS - 2) * PERIOD_S)
