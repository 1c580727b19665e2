"""Contradiction between reports of the drive. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class Signal(Enum):
    """A report of the drive."""

    SPEED = "reported speed"
    TORQUE = "reported torque"
    ANGLE = "reported position"
    ALL = "feedback"


@dataclass(frozen=True)
class Contradiction:
    """First contradiction between reports; it is not replaced. ``what``: a sentence with values, ``helps``: the next
    step.
    """

    signals: frozenset[Signal]
    what: str
    helps: str
    time_s: float
    lighter: bool = False              # True: a smaller inertia explains it, so a part of the load may be lost
    lag_hides: bool = False            # True: a lost signal may fall like this shaft until every lag has ended
