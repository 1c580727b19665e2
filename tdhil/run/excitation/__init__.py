"""What the shaft is asked to do in stage 5: pure numpy, planned before it moves, cheap to evaluate in a cycle."""

from tdhil.run.excitation.plan import (
    LEAST_COUNTED,
    ExcitationKind,
    ExcitationWish,
    Plan,
    PlannedSegment,
    make_plan,
    settling_periods,
)
from tdhil.run.excitation.pulses import SwingKind, SwingPlan, make_swings
from tdhil.run.excitation.reference import (
    DriveMode,
    MachineLimits,
    PeriodicReference,
    PlanRefused,
    RigGuess,
    Transition,
    make_transition,
)
from tdhil.run.excitation.signals import Shape
from tdhil.run.excitation.speed_loop import Following, fit_following, held_back_to

__all__ = [
    "LEAST_COUNTED",
    "DriveMode",
    "ExcitationKind",
    "ExcitationWish",
    "Following",
    "MachineLimits",
    "PeriodicReference",
    "Plan",
    "PlanRefused",
    "PlannedSegment",
    "RigGuess",
    "Shape",
    "SwingKind",
    "SwingPlan",
    "Transition",
    "fit_following",
    "held_back_to",
    "make_plan",
    "make_swings",
    "make_transition",
    "settling_periods",
]
