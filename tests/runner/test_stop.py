"""Stop sequence: its order. It never disables a turning shaft."""

import random
from dataclasses import replace

import pytest

from drivers.drive import Command, Mode, PowerState
from drivers.errors import CommunicationLost, StopNotConfirmed
from tdhil.errors import ExitCode, exit_code
from tdhil.runner.stop import StopReport, not_confirmed
from tests.rigs import LIMITS
from tests.runner.fake_drive import FakeDrive
from tests.runner.stop_calls import LAG_S, asked

MODES = pytest.mark.parametrize("mode", Mode)


@MODES
def test_quick_stop_then_standstill_then_disable_then_confirmed(world, mode):
    here = world()
    here.turn(5.0, mode)
    start_s = here.bench.now_s
    report = here.stop_sequence().run()
    assert report.confirmed
    assert report.disabled
    assert report.trouble == ()
    assert asked(here.drive) == ["quick_stop", "disable"]
    assert here.drive.disabled_at == [0.0]
    # 5 rad/s at 2 rad/s² and the wait for the lags
    assert report.at_rest_s - start_s == pytest.approx(5.0 / 2.0 + 3.0 * LAG_S, abs=0.3)


@MODES
def test_the_reported_speed_must_be_zero_for_longer_than_the_largest_lag(world, mode):
    """Statusword and reported speed show standstill from the first cycle on, but the shaft may still turn."""
    here = world(FakeDrive(misbehave=lambda drive, sample: sample._replace(speed_rad_s=0.0, standstill=True)))
    here.turn(2.0, mode)
    start_s = here.bench.now_s
    report = here.stop_sequence().run()
    assert report.at_rest_s - start_s >= 3.0 * LAG_S
    assert here.drive.disabled_at == [0.0]


@pytest.mark.parametrize(("rig_rad_s", "confirmed"), [(10.0, True), (0.0, False)])
def test_a_lower_highest_speed_of_one_run_makes_no_report_quieter(world, rig_rad_s, confirmed):
    """Noise of 0.025 rad/s is half of the standstill speed of this rig, 0.05 rad/s, and not of a rig for 2 rad/s."""
    rng = random.Random(1)
    noisy = FakeDrive(misbehave=lambda _, one: one._replace(speed_rad_s=one.speed_rad_s + rng.gauss(0.0, 0.025)))
    here = world(noisy, replace(LIMITS, speed_max_rad_s=2.0, rig_speed_max_rad_s=rig_rad_s))
    here.turn(1.2)
    report = here.stop_sequence().run()
    assert report.confirmed is confirmed
    assert noisy.speed == 0.0


@pytest.mark.parametrize("what", ["status", "speed"])
def test_one_signal_of_standstill_is_not_enough(world, what):
    change = {"standstill": False} if what == "status" else {"speed_rad_s": 0.3}
    here = world(FakeDrive(misbehave=lambda drive, sample: sample._replace(**change)))
    here.turn(5.0)
    report = here.stop_sequence().run()
    assert not report.confirmed
    assert not report.disabled
    assert "standstill was not observed" in report.trouble[-1]
    assert ("the reported speed was zero, but the drive's status" in report.trouble[-1]) == (what == "status")
    assert "disable" not in here.drive.calls
    assert here.drive.disabled_at == []


@MODES
def test_a_turning_shaft_is_never_disabled(world, mode):
    here = world(FakeDrive(brakes=False))
    here.turn(5.0, mode)
    here.drive.coulomb = here.drive.viscous = 0.0
    report = here.stop_sequence().run()
    assert not report.confirmed
    assert report.at_rest_s is None
    assert "disable" not in here.drive.calls
    assert here.drive.disabled_at == []
    error = not_confirmed(report)
    assert isinstance(error, StopNotConfirmed)
    assert exit_code(error) is ExitCode.STOP_NOT_CONFIRMED
    assert "hard-wired emergency stop" in error.next_step


@MODES
def test_speed_mode_comes_first_where_a_quick_stop_does_not_brake_in_torque_mode(world, mode):
    here = world(FakeDrive(quick_stop_in_torque_mode=False))
    here.turn(5.0, mode)
    modes = []
    quick_stop = here.drive.quick_stop

    def noted():
        modes.append(here.drive.mode)
        quick_stop()

    here.drive.quick_stop = noted
    assert here.stop_sequence().run().confirmed
    assert modes == [Mode.SPEED]
    assert here.drive.disabled_at == [0.0]


def test_the_quick_stop_is_sent_even_if_the_mode_is_never_confirmed(world):
    here = world(FakeDrive(quick_stop_in_torque_mode=False, misbehave=lambda drive, s: s._replace(mode=None)))
    here.drive.state = here.drive.wish = PowerState.ENABLED
    here.drive.speed = 3.0
    report = here.stop_sequence().run()
    assert report.confirmed
    assert here.drive.calls.index("quick_stop") == pytest.approx(0.5 / here.bench.period_s, abs=1)


def test_a_drive_that_never_confirms_that_it_is_disabled(world):
    here = world()
    here.turn(5.0)
    here.drive.disable = lambda: None
    report = here.stop_sequence().run()
    assert report.at_rest_s is not None
    assert not report.confirmed
    assert "did not confirm that it is disabled" in report.trouble[-1]


@pytest.mark.parametrize("method", ["quick_stop", "disable"])
@pytest.mark.parametrize("times", [1, 10])
def test_a_request_that_the_drive_rejects_at_first_is_repeated(world, method, times):
    """Every method of a drive may raise, according to the contract."""
    here = world()
    here.turn(5.0)
    plain, left = getattr(here.drive, method), [times]

    def reluctant():
        if left[0]:
            left[0] -= 1
            raise CommunicationLost("busy")
        plain()

    setattr(here.drive, method, reluctant)
    report = here.stop_sequence().run()
    assert report.confirmed
    assert "busy" in report.trouble[0]
    assert here.drive.disabled_at == [0.0]


@pytest.mark.parametrize("method", ["quick_stop", "disable"])
def test_a_request_that_is_always_rejected_still_ends_in_a_report(world, method):
    here = world()
    here.turn(5.0)

    def never():
        raise RuntimeError("no")

    setattr(here.drive, method, never)
    report = here.stop_sequence().run()
    assert not report.confirmed
    assert here.drive.disabled_at == []


@pytest.mark.parametrize("part", ["log", "display"])
def test_a_broken_log_or_display_does_not_stop_the_stop(world, part):
    here = world()
    here.turn(5.0)

    def broken(*_):
        raise OSError("disk full")

    getattr(here, part).on_cycle = broken
    assert here.stop_sequence().run().confirmed
    assert here.bench.stop_side_troubles


def test_it_runs_once_and_a_second_call_returns_the_first_report(world):
    here = world()
    here.turn(5.0)
    sequence = here.stop_sequence()
    report = sequence.run()
    calls = list(here.drive.calls)
    assert sequence.run() is report
    assert here.drive.calls == calls


def test_a_stop_request_does_not_disturb_it(world):
    here = world()
    here.turn(5.0)
    here.stop_request.ask(2)
    here.stop_request.ask(2)
    assert here.stop_sequence().run().confirmed


def test_a_guard_that_has_tripped_does_not_disturb_it(world):
    here = world()
    here.turn(5.0)
    here.drive.speed = 14.0
    assert here.stop_sequence().run().confirmed


@pytest.mark.parametrize("speed", [0.0, 5.0])
def test_a_drive_in_fault_is_at_standstill_when_its_shaft_is(world, speed):
    here = world()
    here.turn(5.0)
    here.bench.hold(Command(Mode.SPEED, speed, 0.0), 5.0)
    here.drive.fault()
    report = here.stop_sequence().run()
    assert report.confirmed
    assert here.drive.disabled_at == []
    assert here.drive.state is PowerState.FAULT
    assert here.drive.speed == 0.0


def test_a_faulted_drive_whose_shaft_continues_to_turn_is_not_confirmed(world):
    here = world(FakeDrive(brakes=False, coulomb=0.0, viscous=0.0))
    here.turn(5.0)
    here.drive.fault()
    report = here.stop_sequence().run()
    assert not report.confirmed
    assert "disable" not in here.drive.calls


def test_a_shaft_that_never_moved_is_disabled_after_the_wait(world):
    here = world()
    here.bench.enable(Mode.TORQUE, Command(Mode.TORQUE, 0.0, 0.0))
    assert here.stop_sequence().run().confirmed
    assert here.drive.state is PowerState.OFF


def test_the_guard_expects_no_state_after_the_stop(world):
    here = world()
    here.turn(5.0)
    assert here.guard.expected is PowerState.ENABLED
    here.stop_sequence().run()
    assert here.guard.expected is None


def test_an_unconfirmed_stop_without_a_trouble_is_reported_as_well():
    assert "no standstill seen" in str(not_confirmed(StopReport(False, None, False)))
