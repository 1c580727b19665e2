"""What the shaft is asked to do in stage 5: pure numpy, planned before it moves, cheap to evaluate in a cycle."""

from tdhil.protocol.excitation.limits import DriveMode, MachineLimits, PlanRefused, RigGuess
from tdhil.protocol.excitation.periodic import PeriodicReference
from tdhil.protocol.excitation.plan import LEAST_COUNTED, ExcitationWish, Plan, PlannedSegment, make_plan
from tdhil.protocol.excitation.shape import Shape
from tdhil.protocol.excitation.transition import Transition, make_transition

__all__ = [
    "LEAST_COUNTED",
    "DriveMode",
    "ExcitationWish",
    "MachineLimits",
    "PeriodicReference",
    "Plan",
    "PlanRefused",
    "PlannedSegment",
    "RigGuess",
    "Shape",
    "Transition",
    "make_plan",
    "make_transition",
]
