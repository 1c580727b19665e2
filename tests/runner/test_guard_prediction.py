"""Speed that the guard predicts, and the ends of the speed window in torque mode."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.drive import Command, Mode
from drivers.errors import LimitHit
from tdhil.runner.excitation import MotionLimits, RigGuess
from tdhil.runner.guard import Guard
from tdhil.runner.settings import ControlAssumptions
from tests.runner.fake_drive import LIMITS, SPEED_RESOLUTION, TORQUE_RESOLUTION
from tests.runner.guarded import MODEL, REVERSIBLE, guard, sample


@pytest.mark.parametrize(
    ("torque", "speed", "predicted"),
    [
        # ω + (T − T_c − B ω)/(0.7 J)·(0.1 + 0.5), by hand
        (190.0, 4.0, 4.0 + 100.0 / 70.0 * 0.6),
        (90.0, 4.0, 4.0),
        (0.0, 4.0, 4.0 - 90.0 / 70.0 * 0.6),
        (400.0, 0.0, 3.0),
    ],
)
def test_prediction_by_hand(torque, speed, predicted):
    assert guard().predicted_speed(MODEL, torque, speed) == pytest.approx(predicted, abs=1e-12)


def test_prediction_looks_as_far_as_lag_and_reaction():
    far = guard(largest_speed_lag_s=1.5, reaction_s=0.5, smallest_inertia_share=0.5)
    assert far.predicted_speed(MODEL, 190.0, 4.0) == pytest.approx(4.0 + 100.0 / 50.0 * 2.0)


def test_torque_that_leads_out_of_the_window_trips_before_the_speed_does():
    watch = guard()
    watch.model = MODEL
    # 10 = ω + (T − 50 − 10 ω)·0.6/70 at ω = 8: T = 130 + 2·70/0.6 = 363.3
    watch.check_sample(Command(Mode.TORQUE, 8.0, 363.0), sample(8.0, 363.0))
    with pytest.raises(LimitHit, match="about to leave its window"):
        watch.check_sample(Command(Mode.TORQUE, 8.0, 364.0), sample(8.0, 364.0))
    watch.check_sample(Command(Mode.SPEED, 8.0, 364.0), sample(8.0, 364.0))     # the drive's own loop holds the speed
    watch.model = None
    watch.check_sample(Command(Mode.TORQUE, 8.0, 364.0), sample(8.0, 364.0))    # J and friction are not known yet


@given(
    speed=st.floats(0.0, 10.0), torque=st.floats(-400.0, 400.0), inertia=st.floats(1.0, 1e4),
    viscous=st.floats(0.0, 50.0), coulomb=st.floats(0.0, 300.0),
)
def test_the_prediction_alone_decides_in_torque_mode(speed, torque, inertia, viscous, coulomb):
    watch = guard()
    watch.model = RigGuess(inertia, viscous, coulomb)
    predicted = watch.predicted_speed(watch.model, torque, speed)
    edges = (predicted - 10.0, predicted + 0.2, speed - 0.45)
    if min(map(abs, edges)) < 1e-6:
        return
    if edges[0] > 0.0 or edges[1] < 0.0 or edges[2] < 0.0:
        with pytest.raises(LimitHit):
            watch.check_sample(Command(Mode.TORQUE, speed, torque), sample(speed, torque))
    else:
        watch.check_sample(Command(Mode.TORQUE, speed, torque), sample(speed, torque))


# -- the window's ends in torque mode ------------------------------------------------------------------------------


def by_hand(speed, torque, coulomb, viscous, inertia, horizon=0.6, steps=60_000):
    """Integrate the motion of the shaft in small steps, with friction that holds at standstill."""
    dt = horizon / steps
    for _ in range(steps):
        if speed == 0.0:
            if abs(torque) <= coulomb:
                return 0.0
            direction = 1.0 if torque > 0.0 else -1.0
        else:
            direction = 1.0 if speed > 0.0 else -1.0
        after = speed + dt * (torque - direction * coulomb - viscous * speed) / inertia
        speed = 0.0 if after * direction < 0.0 else after
    return speed


@pytest.mark.parametrize("speed", [0.0, 0.2, 1.0, 4.0, -0.3])
@pytest.mark.parametrize("torque", [-400.0, -200.0, -40.0, 0.0, 40.0, 300.0])
def test_prediction_is_where_a_shaft_with_friction_goes(speed, torque):
    """Compare with small steps. The only difference: the prediction keeps viscous friction constant."""
    found = guard().predicted_speed(MODEL, torque, speed)
    true = by_hand(speed, torque, 50.0, 10.0, 70.0)
    assert found == pytest.approx(true, abs=0.06 * abs(found - speed) + 0.02)


@given(speed=st.floats(-10.0, 10.0), torque=st.floats(-400.0, 400.0))
def test_prediction_is_the_same_backwards(speed, torque):
    assert guard().predicted_speed(MODEL, -torque, -speed) == pytest.approx(
        -guard().predicted_speed(MODEL, torque, speed), abs=1e-9)


def torque_mode(torque, speed, limits=LIMITS, model=MODEL):
    watch = guard(limits)
    watch.model = model
    watch.check_sample(Command(Mode.TORQUE, 5.0, torque), sample(speed, torque))


def test_torque_that_would_turn_the_shaft_backwards_trips_while_it_still_turns_forward():
    # ω = 0.6 stops after 0.6·70/(300 + 50 + 6) = 0.118 s; then (300 − 50)/70·(0.6 − 0.118) = 1.72 rad/s backwards
    assert guard().predicted_speed(MODEL, -300.0, 0.6) == pytest.approx(-1.72, abs=0.01)
    with pytest.raises(LimitHit, match="about to turn backwards"):
        torque_mode(-300.0, 0.6)
    torque_mode(-300.0, 4.0)            # does not come to standstill within the prediction
    torque_mode(-45.0, 0.6)             # friction holds the stopped shaft
    torque_mode(-70.0, 0.52)            # backwards, but within noise


def test_with_reverse_allowed_the_speed_limit_applies_backwards_too():
    reversible = replace(REVERSIBLE, speed_min_rad_s=-10.0)
    torque_mode(-300.0, 0.6, reversible)
    torque_mode(-300.0, -8.0, reversible)
    with pytest.raises(LimitHit, match="about to turn backwards"):
        torque_mode(-390.0, -8.0, reversible)


def test_the_lower_end_of_the_window_is_held_in_torque_mode_once_something_is_known():
    with pytest.raises(LimitHit, match=r"has left its window: 0.440 rad/s is below 0.5 rad/s"):
        torque_mode(90.0, 0.44)
    torque_mode(90.0, 0.46)             # within noise of it
    guard().check_sample(Command(Mode.TORQUE, 0.0, 90.0), sample(0.0, 90.0))     # the sign probe starts from rest
    watch = guard()
    watch.model = MODEL
    watch.check_sample(Command(Mode.SPEED, 0.0, 0.0), sample(0.0))


@pytest.mark.parametrize(("period_s", "reaction"), [(0.004, 0.1), (0.02, 0.1), (0.1, 0.3)])
def test_a_slow_loop_reacts_late(period_s, reaction):
    watch = Guard(LIMITS, period_s, SPEED_RESOLUTION, TORQUE_RESOLUTION)
    assert watch.predicted_speed(MODEL, 190.0, 4.0) == pytest.approx(4.0 + 100.0 / 70.0 * (reaction + 0.5))


def test_the_margin_of_a_plan_is_that_of_the_prediction():
    assumptions = ControlAssumptions(largest_speed_lag_s=0.7, reaction_s=0.2, smallest_inertia_share=0.9)
    assert Guard.foresight_s(assumptions) == pytest.approx(1.0)
    assert Guard.room(LIMITS, assumptions, 0.25) == MotionLimits(0.75, 9.75, 400.0, Guard.foresight_s(assumptions))
