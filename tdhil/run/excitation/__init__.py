"""What the shaft is asked to do in stage 5: pure numpy, planned before it moves, cheap to evaluate in a cycle."""

from tdhil.run.excitation.plan import (
    LEAST_COUNTED,
    ExcitationWish,
    Plan,
    PlannedSegment,
    make_plan,
    periodic_kind,
    settling_periods,
)
from tdhil.run.excitation.pulses import (
    CALM_S,
    SwingKind,
    SwingPlan,
    Way,
    make_swings,
)
from tdhil.run.excitation.reference import (
    DriveMode,
    ExcitationKind,
    MotionLimits,
    PeriodicReference,
    PlanRefused,
    RigGuess,
    Transition,
    excitation_kind,
    make_transition,
)
from tdhil.run.excitation.signals import (
    ECHOES_S,
    PeriodicKind,
    Shape,
    unit_peak,
)
from tdhil.run.excitation.speed_loop import Following, fit_following, held_back_to

__all__ = [
    "CALM_S",
    "ECHOES_S",
    "LEAST_COUNTED",
    "DriveMode",
    "ExcitationKind",
    "ExcitationWish",
    "Following",
    "MotionLimits",
    "PeriodicKind",
    "PeriodicReference",
    "Plan",
    "PlanRefused",
    "PlannedSegment",
    "RigGuess",
    "Shape",
    "SwingKind",
    "SwingPlan",
    "Transition",
    "Way",
    "excitation_kind",
    "fit_following",
    "held_back_to",
    "make_plan",
    "make_swings",
    "make_transition",
    "periodic_kind",
    "settling_periods",
    "unit_peak",
]
