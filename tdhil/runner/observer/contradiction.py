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
    """The first contradiction between reports stays. ``what``: a sentence with values, ``helps``: the next step."""

    signals: frozenset[Signal]
    what: str
    helps: str
    time_s: float
    lighter: bool = False              # a smaller inertia explains it: a part of the load may be lost
