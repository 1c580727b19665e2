"""Slow dither beside the excitation: when it is used, its size, and its period, which differs from the excitation's."""

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tdhil.runner.excitation import MotionLimits, RigGuess, make_plan
from tdhil.runner.guard import Guard
from tdhil.runner.settings import ControlAssumptions
from tdhil.runner.stages.acquire import dither, dither_peak
from tests.rigs import LIMITS

RPM = 2.0 * math.pi / 60.0


def test_only_for_coarse_resolution():
    assert dither_peak(0.01 * RPM, 9.5) == 0.0
    assert dither_peak(RPM, 9.5) > RPM
    assert dither_peak(10.0 * RPM, 9.5) <= 0.03 * 9.5 / 2.0          # share of the margin of a plan


@given(time=st.floats(0.0, 1e4), period=st.floats(0.1, 100.0), peak=st.floats(0.0, 1.0))
def test_it_begins_at_zero_and_stays_below_its_peak(time, period, peak):
    assert dither(0.0, period, peak) == 0.0
    assert abs(dither(time, period, peak)) <= peak * (1.0 + 1e-9)


def test_it_is_at_a_different_phase_in_each_period_of_the_excitation():
    starts = sorted(dither(20.0 * number, 20.0, 1.0) for number in range(8))
    assert min(b - a for a, b in pairwise(starts)) > 0.02


@pytest.mark.heavy
@given(
    inertia=st.floats(1.0, 1000.0), coulomb=st.floats(0.0, 80.0), viscous=st.floats(0.0, 5.0),
    period_s=st.sampled_from([0.004, 1.0 / 15.0, 0.1]),
)
def test_the_guard_of_a_slow_line_accepts_a_plan_in_torque_mode(inertia, coulomb, viscous, period_s):
    assumptions = ControlAssumptions().at_period(period_s)
    guess = RigGuess(inertia, viscous, coulomb)
    plan = make_plan(MotionLimits(0.5, 10.0, 400.0, Guard.foresight_s(assumptions)), guess)
    guard = Guard(LIMITS, period_s, 1e-3, 0.1, ControlAssumptions())
    for segment in plan.segments:
        for step in range(0, 400):
            speed, torque = segment.reference.reference(segment.duration_s / segment.periods * step / 400)
            assert guard.predicted_speed(guess, torque, speed) > -0.2
