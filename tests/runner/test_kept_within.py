"""Limits that the stages keep before the guard acts: the torque limit, and the end of coasting.

A setpoint that the guard rejects is an error of this program and ends the run, so no stage may request one.
"""

import math

import pytest

from drivers.drive import Mode
from drivers.errors import CommandRejected
from tdhil.runner.excitation import MotionLimits, RigGuess, SpeedChangePlan
from tdhil.runner.excitation.pulses import CALM_S, SpeedChange
from tdhil.runner.guard import kept_within
from tdhil.runner.settings import ControlAssumptions
from tdhil.runner.stages.acquire import Follower, run_speed_changes
from tdhil.runner.stages.hold import MeanSpeedControl, run_hold
from tests.runner.fake_drive import LIMITS, NAN, FakeDrive

ROOM = MotionLimits(LIMITS.speed_min_rad_s, LIMITS.speed_max_rad_s, LIMITS.torque_nm)


class Seen(Exception):
    """End the stage after enough cycles."""


def turning(world, drive=None, speed=5.0, cycles=50):
    """Turn at a speed in torque mode; the display ends the stage after ``cycles`` more cycles."""
    here = world(drive or FakeDrive())
    here.turn(speed, Mode.TORQUE)
    here.drive.commands.clear()
    here.display.seen = 0

    def on_cycle(_stage, seen):
        if seen >= cycles:
            raise Seen

    here.display.on_cycle = on_cycle
    return here


def torques(here):
    return [command.torque_nm for command in here.drive.commands]


@pytest.mark.parametrize(("start_rad_s", "target_rad_s", "friction_nm", "end_nm"), [
    (5.0, 8.0, 500.0, 400.0), (0.5, 1.0, 0.0, -400.0),
])
def test_hold_keeps_to_the_torque_limit(world, start_rad_s, target_rad_s, friction_nm, end_nm):
    """The model has too much friction, or the shaft is much faster than expected."""
    model = RigGuess(200.0, 0.0, friction_nm)
    here = turning(world, FakeDrive(inertia=1e4), speed=9.0 if end_nm < 0.0 else start_rad_s)
    control = MeanSpeedControl(model, 1000.0, ControlAssumptions())
    with pytest.raises(Seen):
        run_hold(here.bench, LIMITS, model, control, target_rad_s, start_rad_s, 0.01)
    asked = torques(here)
    assert end_nm in asked
    assert max(map(abs, asked)) == LIMITS.torque_nm


@pytest.mark.parametrize("asked_nm", [900.0, -900.0])
def test_acquire_keeps_to_the_torque_limit(world, asked_nm):
    here = turning(world, FakeDrive(inertia=1e4), cycles=20)
    follower = Follower(here.bench, LIMITS, Mode.TORQUE, None)
    with pytest.raises(Seen):
        follower.follow(lambda _: (5.0, asked_nm), 10.0)
    assert set(torques(here)) == {LIMITS.torque_nm if asked_nm > 0.0 else -LIMITS.torque_nm}


def test_acquire_keeps_to_it_with_what_the_slow_loop_adds(world):
    here = turning(world, FakeDrive(inertia=1e4), cycles=20)
    control = MeanSpeedControl(RigGuess(200.0, 8.0, 60.0), 1000.0, ControlAssumptions())
    follower = Follower(here.bench, LIMITS, Mode.TORQUE, control)
    with pytest.raises(Seen):
        follower.follow(lambda _: (9.0, 300.0), 10.0)
    assert max(torques(here)) == LIMITS.torque_nm


@pytest.mark.parametrize(("mode", "speed_rad_s", "torque_nm"), [
    (Mode.TORQUE, 5.0, NAN), (Mode.TORQUE, NAN, 50.0), (Mode.SPEED, NAN, 0.0),
])
@pytest.mark.parametrize("slow_loop", [False, True])
def test_a_reference_that_is_no_number_becomes_no_limit(world, mode, speed_rad_s, torque_nm, slow_loop):
    """A clamp to the limits would turn it into full torque or the highest speed."""
    here = turning(world)
    control = MeanSpeedControl(RigGuess(200.0, 8.0, 60.0), 1000.0, ControlAssumptions()) if slow_loop else None
    with pytest.raises(CommandRejected, match="not finite"):
        Follower(here.bench, LIMITS, mode, control).follow(lambda _: (speed_rad_s, torque_nm), 10.0)
    assert here.drive.commands == []


def test_a_first_torque_that_is_no_number_becomes_no_limit():
    assert math.isnan(kept_within(NAN, 0.0, 400.0))


def test_the_slow_loop_requests_no_braking_torque_where_it_is_not_allowed(world):
    """A shaft above the set speed would need braking torque, and the guard would end the run."""
    model = RigGuess(200.0, 0.0, 50.0)
    for stage in ("hold", "acquire"):
        here = turning(world, FakeDrive(inertia=1e4), speed=9.0)
        here.guard.no_braking = "the string would hide its answer"
        control = MeanSpeedControl(model, 1000.0, ControlAssumptions())
        with pytest.raises(Seen):
            if stage == "hold":
                run_hold(here.bench, LIMITS, model, control, 1.0, 0.5, 0.01)
            Follower(here.bench, LIMITS, Mode.TORQUE, control).follow(lambda _: (1.0, 50.0), 5.0)
        assert min(torques(here)) == 0.0


def test_coasting_ends_if_the_shaft_does_not_slow_down(world):
    """The assumed friction is far too high: after twice the planned time the speed is held again."""
    guess = RigGuess(100.0, 2.0, 20.0)
    way = SpeedChange(6.0, 2.0, 5.0, guess, coasting=True)
    plan = SpeedChangePlan("coast-down", "torque", 6.0, (way,), 2.0, 6.0, 0.0, 100.0, ROOM, guess)
    drive = FakeDrive(coulomb=0.0, viscous=0.0)
    longest = 2.0 * CALM_S + 2.0 * way.duration_s
    here = turning(world, drive, speed=6.0, cycles=round((longest + 2.0) / drive.period_s))
    run_speed_changes(here.bench, LIMITS, plan, None, ControlAssumptions(), lambda _: None)
    coasted = sum(command.torque_nm == 0.0 for command in here.drive.commands)
    assert coasted * drive.period_s == pytest.approx(2.0 * way.duration_s, abs=0.1)
