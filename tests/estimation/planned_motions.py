"""Planned excitations as motions of the test bench."""

import math

from tdhil.runner.excitation import MotionLimits, Plan, PlanRequest, RigGuess, make_plan
from tests.estimation.shaft_bench import Motion

LIMITS = MotionLimits(0.5, 10.0, 400.0)


def planned(wish: PlanRequest | None = None, guess: RigGuess | None = None) -> tuple[Motion, Plan]:
    """Return a plan for the field-like rig as a motion, with the time of transitions between segments."""
    plan = make_plan(LIMITS, guess or RigGuess(104.0, 8.0, 60.0), wish)
    now = 3.0
    segments, references = [], []
    for index, segment in enumerate(plan.segments):
        if index:
            before = plan.segments[index - 1].reference.start_speed_rad_s
            now += math.ceil(plan.transition(before, index).duration_s)
        segments.append(segment.recorded(now))
        references.append(segment.reference.reference)
        now += segment.duration_s
    return Motion(tuple(references), tuple(segments), plan.kind, (), now + 1.0), plan
