"""The motion of stage 5: pure numpy, planned before the shaft moves, fast to evaluate in a cycle."""

from tdhil.runner.excitation.plan import (
    LEAST_COUNTED as LEAST_COUNTED, PlanRequest as PlanRequest, Plan as Plan,
    PlannedSegment as PlannedSegment, make_plan as make_plan, periodic_kind as periodic_kind,
    settling_periods as settling_periods,
)
from tdhil.runner.excitation.pulses import (
    CALM_S as CALM_S, SpeedChange as SpeedChange, SpeedChangeKind as SpeedChangeKind,
    SpeedChangePlan as SpeedChangePlan, plan_speed_changes as plan_speed_changes,
)
from tdhil.runner.excitation.reference import (
    DriveMode as DriveMode, ExcitationKind as ExcitationKind, MotionLimits as MotionLimits,
    PeriodicReference as PeriodicReference, PlanRefused as PlanRefused, RigGuess as RigGuess,
    Transition as Transition, excitation_kind as excitation_kind, make_transition as make_transition,
)
from tdhil.runner.excitation.signals import (
    ECHOES_S as ECHOES_S, PeriodicKind as PeriodicKind, Shape as Shape,
    leaves_time_before_echo as leaves_time_before_echo, unit_peak as unit_peak,
)
from tdhil.runner.excitation.speed_loop import (
    SpeedFollowing as SpeedFollowing, fit_following as fit_following, held_back_to as held_back_to,
)
