"""The guard: what trips it, what doesn't, and where it expects the shaft to be."""

import math
from dataclasses import replace

import pytest
from fake_drive import LIMITS, NAN, PERIOD_S, SPEED_RESOLUTION, TORQUE_RESOLUTION
from hypothesis import given
from hypothesis import strategies as st

from drivers.drive import Command, Mode, PowerState, Sample
from drivers.errors import CommandRejected, CommunicationLost, DriveFault, LimitHit, TdhilError
from tdhil.protocol.excitation import RigGuess
from tdhil.protocol.guard import Guard
from tdhil.protocol.settings import ControlAssumptions

REST = Command(Mode.SPEED, 0.0, 0.0)
REVERSIBLE = replace(LIMITS, allow_reverse=True)
MODEL = RigGuess(inertia_kg_m2=100.0, viscous_nm_s_rad=10.0, coulomb_nm=50.0)
INF = math.inf


def guard(limits=LIMITS, **assumptions):
    return Guard(limits, PERIOD_S, SPEED_RESOLUTION, TORQUE_RESOLUTION, ControlAssumptions(**assumptions))


def sample(speed=0.0, torque=0.0, *, time_s=0.0, fresh=True, state=PowerState.ENABLED):
    return Sample(time_s, 0.0, 0.0, fresh, speed, torque, None, Mode.SPEED, state, False, False, 0x27)


@pytest.mark.parametrize("mode", Mode)
@pytest.mark.parametrize("value", [NAN, INF, -INF])
@pytest.mark.parametrize("which", ["speed", "torque"])
def test_a_setpoint_that_is_no_number_is_rejected_in_either_place(mode, value, which):
    command = Command(mode, value, 0.0) if which == "speed" else Command(mode, 0.0, value)
    with pytest.raises(CommandRejected, match="not finite"):
        guard().check_command(command)


@pytest.mark.parametrize(
    ("speed", "torque", "what"),
    [(10.001, 0.0, "speed setpoint"), (-0.001, 0.0, "speed setpoint"), (0.0, 400.1, "torque setpoint"),
     (0.0, -400.1, "torque setpoint")],
)
def test_a_setpoint_outside_the_limits_is_rejected(speed, torque, what):
    for mode in Mode:
        with pytest.raises(CommandRejected, match=what):
            guard().check_command(Command(mode, speed, torque))


def test_backwards_setpoints_need_allow_reverse():
    guard(REVERSIBLE).check_command(Command(Mode.SPEED, -10.0, 0.0))
    with pytest.raises(CommandRejected, match="outside -10 to 10"):
        guard(REVERSIBLE).check_command(Command(Mode.SPEED, -10.1, 0.0))


@given(speed=st.floats(0.0, 10.0), torque=st.floats(-400.0, 400.0), mode=st.sampled_from(Mode))
def test_no_command_inside_the_limits_is_rejected(speed, torque, mode):
    guard().check_command(Command(mode, speed, torque))


@given(speed=st.floats(), torque=st.floats())
def test_a_command_passes_if_and_only_if_it_is_within_the_limits(speed, torque):
    inside = 0.0 <= speed <= 10.0 and abs(torque) <= 400.0 * (1.0 + 1e-9)
    try:
        guard().check_command(Command(Mode.TORQUE, speed, torque))
    except CommandRejected:
        assert not inside
    else:
        assert inside


@given(speed=st.floats(-0.19, 10.0), torque=st.floats(-500.0, 500.0), time_s=st.floats(0.0, 900.0))
def test_no_sample_inside_the_limits_trips(speed, torque, time_s):
    watch = guard()
    watch.start_clock(0.0)
    watch.expected = PowerState.ENABLED
    watch.check_sample(REST, sample(speed, torque, time_s=time_s))


@pytest.mark.parametrize(
    ("limits", "seen", "what"),
    [
        (LIMITS, sample(10.01), "beyond the limit of 10 rad/s"),
        (LIMITS, sample(-0.21), "turns backwards"),
        (LIMITS, sample(torque=511.0), "torque 511.0 N·m is beyond"),
        (LIMITS, sample(torque=-511.0), "torque -511.0 N·m is beyond"),
        (LIMITS, sample(time_s=901.0), "longer than 900 s"),
        (REVERSIBLE, sample(10.01), "beyond the limit of 10 rad/s"),
        (REVERSIBLE, sample(-10.01), "beyond the limit of 10 rad/s"),
    ],
)
def test_every_limit_trips(limits, seen, what):
    watch = guard(limits)
    watch.start_clock(0.0)
    with pytest.raises(LimitHit, match=what) as caught:
        watch.check_sample(REST, seen)
    assert caught.value.where
    assert caught.value.next_step


def test_the_time_limit_counts_from_the_first_motion():
    watch = guard()
    watch.check_sample(REST, sample(time_s=5000.0))
    watch.start_clock(5000.0)
    watch.check_sample(REST, sample(time_s=5900.0))
    with pytest.raises(LimitHit):
        watch.check_sample(REST, sample(time_s=5900.1))


def test_reverse_rotation_is_allowed_where_the_rig_says_so():
    guard(REVERSIBLE).check_sample(REST, sample(-9.9))


@pytest.mark.parametrize(("speed", "torque"), [(NAN, 0.0), (0.0, NAN), (INF, 0.0), (0.0, -INF), (-INF, 0.0)])
def test_feedback_that_is_no_number_trips(speed, torque):
    for limits in (LIMITS, REVERSIBLE):
        with pytest.raises(TdhilError):
            guard(limits).check_sample(REST, sample(speed, torque))


@pytest.mark.parametrize("state", [state for state in PowerState if state is not PowerState.ENABLED])
def test_a_drive_that_leaves_its_state_trips(state):
    watch = guard()
    watch.check_sample(REST, sample(state=state))       # nothing expected yet
    watch.expected = PowerState.ENABLED
    with pytest.raises(DriveFault, match=state.value):
        watch.check_sample(REST, sample(state=state))


@pytest.mark.parametrize(
    ("period_s", "watchdog_s", "allowed"),
    [(0.02, 0.5, 13), (0.004, 0.5, 63), (0.001, 5.0, 250), (0.004, 0.1, 13), (0.1, 0.5, 3), (0.5, 5.0, 3)],
)
def test_feedback_may_fail_to_come_for_so_many_cycles(period_s, watchdog_s, allowed):
    """A quarter of a second or half of what the watchdog grants the host, whichever is less; two cycles always."""
    watch = Guard(replace(LIMITS, watchdog_s=watchdog_s), period_s, SPEED_RESOLUTION, TORQUE_RESOLUTION)
    for _ in range(3):
        for _ in range(allowed - 1):
            watch.check_sample(REST, sample(fresh=False))
        watch.check_sample(REST, sample())              # one that is fresh begins the count anew
    with pytest.raises(CommunicationLost, match=f"no feedback for {allowed} cycles"):
        for _ in range(allowed):
            watch.check_sample(REST, sample(fresh=False))


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


def test_torque_that_leads_out_of_the_window_trips_before_the_speed_is_there():
    watch = guard()
    watch.model = MODEL
    # 10 = ω + (T − 50 − 10 ω)·0.6/70 at ω = 8: T = 130 + 2·70/0.6 = 363.3
    watch.check_sample(Command(Mode.TORQUE, 8.0, 363.0), sample(8.0, 363.0))
    with pytest.raises(LimitHit, match="about to leave its window"):
        watch.check_sample(Command(Mode.TORQUE, 8.0, 364.0), sample(8.0, 364.0))
    watch.check_sample(Command(Mode.SPEED, 8.0, 364.0), sample(8.0, 364.0))     # the drive's own loop holds it
    watch.model = None
    watch.check_sample(Command(Mode.TORQUE, 8.0, 364.0), sample(8.0, 364.0))    # nothing known yet


@given(
    speed=st.floats(0.0, 10.0), torque=st.floats(-400.0, 400.0), inertia=st.floats(1.0, 1e4),
    viscous=st.floats(0.0, 50.0), coulomb=st.floats(0.0, 300.0),
)
def test_the_prediction_alone_decides_in_torque_mode(speed, torque, inertia, viscous, coulomb):
    watch = guard()
    watch.model = RigGuess(inertia, viscous, coulomb)
    predicted = speed + (torque - coulomb - viscous * speed) / (0.7 * inertia) * 0.6
    if abs(predicted - 10.0) < 1e-6:
        return
    if predicted > 10.0:
        with pytest.raises(LimitHit):
            watch.check_sample(Command(Mode.TORQUE, speed, torque), sample(speed, torque))
    else:
        watch.check_sample(Command(Mode.TORQUE, speed, torque), sample(speed, torque))
