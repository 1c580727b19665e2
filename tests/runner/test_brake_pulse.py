"""Pulse of the braking probe on simple shafts: read with the right sign, and read as full torque forward."""

from dataclasses import replace
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tdhil.runner.excitation import RigGuess
from tdhil.runner.guard import Guard
from tdhil.runner.settings import ControlAssumptions
from tdhil.runner.stages.braking_probe import Before, NoPulse, Pulse, plan_pulse, slow_speed
from tdhil.runner.stages.speed import mean_speeds
from tests.runner.fake_drive import LIMITS

USUAL = RigGuess(104.0, 8.0, 60.0)
PERIODS = [0.004, 0.02, 0.1]


def planned(limits=LIMITS, guess=USUAL, speed=2.9, flowing=83.0, noise=0.02, period_s=0.02):
    return plan_pulse(
        limits, guess, ControlAssumptions().at_period(period_s), Before(speed, flowing, noise), period_s
    )


def turned(torques, speed, inertia, period_s, friction_nm=0.0):
    """Return the speeds of a shaft under one torque per cycle and friction. Friction does not reverse the shaft."""
    seen = [speed]
    for torque in torques:
        seen.append(seen[-1] + (torque - friction_nm) / inertia * period_s)
    return seen


shafts = st.builds(
    lambda inertia, flowing, speed, noise: (RigGuess(inertia, 0.0, flowing), flowing, speed, noise),
    st.floats(0.1, 5000.0), st.floats(0.0, 300.0), st.floats(1.0, 6.0), st.floats(0.001, 0.1),
)
rigs = st.sampled_from([LIMITS, replace(LIMITS, load="string", torque_ramp_nm_s=20.0),
                        replace(LIMITS, load="string", torque_ramp_nm_s=5000.0), replace(LIMITS, probe_torque_nm=30.0)])


@given(shaft=shafts, limits=rigs, period_s=st.sampled_from(PERIODS), lighter=st.floats(0.7, 1.5))
def test_the_worst_case_of_a_pulse_is_predicted(shaft, limits, period_s, lighter):
    guess, flowing, speed, noise = shaft
    pulse = planned(limits, guess, speed, flowing, noise, period_s)
    if isinstance(pulse, NoPulse):
        assert pulse.next_step
        return
    assumed = ControlAssumptions().at_period(period_s)
    setpoints = pulse.setpoints_nm()
    assert setpoints[-1] == flowing
    assert min(setpoints) == pulse.torque_nm < 0.0
    assert -pulse.torque_nm <= limits.probe_torque_nm
    inertia = lighter * guess.inertia_kg_m2
    # Every setpoint below zero is full torque forward, and the last one acts for the reaction time too.
    acting = [limits.torque_nm if torque < 0.0 else torque for torque in setpoints[:-1]]
    acting += [limits.torque_nm] * round(assumed.reaction_s / period_s)
    highest = max(turned(acting, speed, inertia, period_s))
    assert highest <= pulse.highest_rad_s + limits.torque_nm / inertia * period_s
    assert pulse.highest_rad_s <= speed + 0.8 * (limits.speed_max_rad_s - speed) + 1e-9
    # With the right sign, the shaft stays in its window and slows down by the announced amount.
    slowed = turned(setpoints, speed, inertia, period_s, flowing)
    assert min(slowed) >= max(0.0, limits.speed_min_rad_s)
    assert (speed - slowed[-1]) * lighter == pytest.approx(pulse.slowing_rad_s, rel=1e-6)
    assert pulse.slowing_rad_s >= 2.0 * noise
    # The guard predicts the speed and accepts the pulse at every speed on the way, noise included.
    guard = Guard(limits, period_s, 0.01, 1.0, ControlAssumptions())
    for seen in (speed, min(slowed)) if lighter >= 1.0 else (speed,):
        assert guard.predicted_speed(guess, pulse.torque_nm, seen - noise) >= 0.0


@pytest.mark.parametrize("period_s", PERIODS)
def test_on_a_usual_rig_it_is_short_and_can_be_seen(period_s):
    pulse = planned(period_s=period_s)
    assert isinstance(pulse, Pulse)
    assert pulse.cycles * period_s <= 0.5
    assert pulse.slowing_rad_s > 0.4
    assert pulse.highest_rad_s < 0.8 * LIMITS.speed_max_rad_s


@pytest.mark.parametrize(
    ("change", "why", "step"),
    [({"guess": RigGuess(2.0, 8.0, 60.0)}, "the torque limit of 400 N·m", "Lower limits.torque_nm to"),
     ({"limits": replace(LIMITS, torque_nm=20.0), "guess": RigGuess(3.0), "flowing": 15.0, "period_s": 0.1},
      "out of its window within 0.2 s", "--mode speed"),
     ({"noise": 1.0}, "too little to detect", "--mode speed")],
)
def test_a_plan_without_a_pulse_states_the_reason(change, why, step):
    found = planned(**change)
    assert isinstance(found, NoPulse)
    assert why in found.why
    assert step in found.next_step


def test_the_torque_limit_that_it_advises_is_low_enough():
    light = {"guess": RigGuess(2.0, 0.0, 1.0), "flowing": 1.0, "noise": 0.001}
    advised = float(planned(**light).next_step.split(" to ")[1].split()[0])
    lower = replace(LIMITS, torque_nm=0.99 * advised, probe_torque_nm=20.0)
    assert isinstance(planned(limits=lower, **light), Pulse)


def test_with_a_string_the_torque_goes_down_and_up_on_ramps():
    pulse = planned(replace(LIMITS, load="string", torque_ramp_nm_s=400.0), RigGuess(500.0, 8.0, 60.0))
    down = [pulse.flowing_nm, *pulse.setpoints_nm()]
    steps = [abs(after - before) for before, after in pairwise(down)]
    assert max(steps) <= 1.1 * 400.0 * 0.02


@given(wander=st.floats(0.0, 4.0), speed=st.floats(1.0, 8.0))
def test_a_pulse_keeps_a_margin_for_the_oscillation_of_a_string(wander, speed):
    """The pulse and the oscillation of the string together keep the speed above the lower end of the window."""
    limits = replace(LIMITS, load="string", torque_ramp_nm_s=20.0)
    before = Before(speed, 83.0, 0.02, 0.0, wander)
    pulse = plan_pulse(limits, USUAL, ControlAssumptions(), before, 0.02)
    if isinstance(pulse, Pulse):
        assert speed - pulse.slowing_rad_s - wander >= limits.speed_min_rad_s
        assert pulse.slowing_rad_s >= 1.25 * wander       # a smaller pulse could not be distinguished from the string


def test_the_probe_is_at_a_higher_speed_if_a_string_oscillates():
    low, high = mean_speeds(LIMITS)
    assert slow_speed(LIMITS) == low
    assert slow_speed(LIMITS, 0.5) == low + 0.5
    assert slow_speed(LIMITS, 100.0) == 0.5 * (LIMITS.speed_min_rad_s + LIMITS.speed_max_rad_s) <= high
