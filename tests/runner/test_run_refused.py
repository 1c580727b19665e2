"""Refusals before motion, and findings of the sign probe at low speed."""

import signal
from dataclasses import replace

import pytest

from drivers.drive import Mode, Outcome, PowerState
from drivers.errors import LimitHit, PreflightRefused
from tdhil.errors import ExitCode, Interrupted, exit_code
from tdhil.runner.settings import ExcitationRequest
from tdhil.runner.stages.setup import TORQUE_SEEN_S, probe_sign
from tests.runner.fake_drive import LIMITS, PERIOD_S, SPEED_RESOLUTION, FakeDrive, refused_check
from tests.runner.reporting_drive import Reporting
from tests.runner.run_outcomes import assert_at_rest, outcomes


def assert_nothing_moved(here, result):
    assert result.stop is None
    assert outcomes(result) == [("setup", "aborted")]
    assert not [call for call in here.drive.calls if call.startswith("enable")]
    assert here.drive.state is PowerState.OFF
    assert here.drive.speed == 0.0
    assert here.drive.closed


def test_a_refused_confirmation_moves_nothing(world):
    here = world()

    def refuse(task, preflight, idle):
        assert task.limits is LIMITS
        assert preflight.watchdog_s == 0.5
        for _ in range(50):
            idle()                                  # feeds the watchdog while the operator decides
        raise PreflightRefused("not confirmed")

    result = here.runner(confirm=refuse).run()
    assert isinstance(result.cause, PreflightRefused)
    assert here.drive.cycles == 100                 # a second of standstill and the idle cycles
    assert {(command.speed_rad_s, command.torque_nm) for command in here.drive.commands} == {(0.0, 0.0)}
    assert_nothing_moved(here, result)


def test_a_stop_request_at_the_prompt_moves_nothing(world):
    here = world()

    def think(task, preflight, idle):
        idle()
        here.stop_request.ask(signal.SIGINT)
        idle()
        raise AssertionError("the stop request was not seen")

    result = here.runner(confirm=think).run()
    assert isinstance(result.cause, Interrupted)
    assert_nothing_moved(here, result)


def test_a_refused_preflight_moves_nothing_and_states_the_remedy(world):
    here = world(FakeDrive(refused=(refused_check(), refused_check())))
    asked = []
    result = here.runner(confirm=lambda *_: asked.append(1)).run()
    assert isinstance(result.cause, PreflightRefused)
    assert "watchdog: required armed, found not armed (and 1 more" in str(result.cause)
    assert result.cause.next_step == "arm it"
    assert asked == []
    assert here.drive.cycles == 0
    assert_nothing_moved(here, result)


@pytest.mark.parametrize(
    ("position_period_s", "calibrated", "rows"),
    [(None, False, ["torque scale", "speed scale"]), (0.02, False, ["torque scale"]), (None, True, ["speed scale"]),
     (0.02, True, [])],
)
def test_preflight_names_each_scale_that_no_report_can_contradict(world, position_period_s, calibrated, rows):
    class Positioned(FakeDrive):
        def preflight(self, limits):
            return replace(super().preflight(limits), position_period_s=position_period_s)

    here = world(Positioned(speed=1.0, coulomb=0.0, viscous=0.0))
    here.runner(calibrated=calibrated).run()
    (preflight,) = here.display.preflights
    assert [check.name for check in preflight.checks if check.outcome is Outcome.NOTE] == rows
    assert preflight.refused == ()


@pytest.mark.parametrize(
    ("speed_rad_s", "reported_rad_s", "shown"),
    [(1.0, None, "speed 1.000 rad/s"), (0.08, None, "speed 0.080 rad/s"), (0.3, 0.0, "0.300 rad/s by its position")],
)
def test_a_shaft_that_already_turns_is_left_alone(world, speed_rad_s, reported_rad_s, shown):
    """Standstill is that of the stop: 0.5 % of the limit of 10 rad/s, by speed and by position."""
    here = world(Reporting(speed=speed_rad_s, coulomb=0.0, viscous=0.0, sees=reported_rad_s, with_position=True))
    result = here.runner().run()
    assert isinstance(result.cause, PreflightRefused)
    assert "already turns" in str(result.cause)
    assert shown in str(result.cause)
    assert result.stop is None
    assert not [call for call in here.drive.calls if call.startswith("enable")]


@pytest.mark.heavy
def test_a_fault_is_reset_with_the_operators_consent_only(world):
    for word in (False, True):
        here = world(FakeDrive(state=PowerState.FAULT, wish=PowerState.FAULT))
        result = here.runner(reset_fault=word).run()
        assert ("reset_fault" in here.drive.calls) is word
        assert (result.cause is None) is word


@pytest.mark.parametrize("mode", ["torque", "speed"])
def test_an_inverted_sign_is_found_at_low_speed(world, mode):
    here = world(FakeDrive(direction=-1.0))
    fastest = []
    here.display.on_cycle = lambda *_: fastest.append(abs(here.drive.speed))
    result = here.runner(ExcitationRequest(mode=mode)).run()
    assert isinstance(result.cause, PreflightRefused)
    assert exit_code(result.cause) is ExitCode.REFUSED
    assert "turned backwards" in str(result.cause)
    assert max(fastest) < 0.1 * LIMITS.speed_max_rad_s
    if mode == "torque":
        assert_at_rest(here, result)
        return
    # The drive's speed control may accelerate such a shaft. Its torque is removed while it is slow; friction stops it.
    assert result.stop.confirmed and "torque removed" in result.stop.trouble[0]
    assert here.drive.speed == 0.0 and here.drive.state is PowerState.OFF
    assert abs(here.drive.disabled_at[0]) < 0.02 * LIMITS.speed_max_rad_s
    assert not [call for call in here.drive.calls if call == "quick_stop"]


@pytest.mark.parametrize("mode", Mode)
def test_a_shaft_that_leaps_backwards_in_the_probe_has_an_inverted_sign(world, mode):
    """The guard trips first."""
    here = world()
    here.drive.misbehave = lambda drive, s: s._replace(speed_rad_s={10: -0.05, 11: -0.5}.get(drive.cycles, 0.0))
    with pytest.raises(PreflightRefused, match="turned backwards"):
        probe_sign(here.bench, LIMITS, mode, SPEED_RESOLUTION)
    assert here.guard.observer.backwards


def test_a_locked_shaft_ends_the_probe(world):
    here = world(FakeDrive(shaft_locked=True))
    result = here.runner().run()
    assert isinstance(result.cause, PreflightRefused)
    assert "did not move up to the limit of 200 N·m" in str(result.cause)
    torques = [command.torque_nm for command in here.drive.commands if command.mode is Mode.TORQUE]
    assert max(torques) == 200.0
    after = torques[len(torques) - torques[::-1].index(200.0):]
    assert len(after) * PERIOD_S >= TORQUE_SEEN_S and set(after) == {0.0}      # no torque is left for the stop
    assert result.stop.confirmed


def test_a_torque_above_that_of_the_probe_ends_it_in_speed_mode_and_is_named(world):
    """The set speed does not rise while the torque is above the limit of the probe."""
    here = world()
    here.drive.misbehave = lambda drive, sample: sample._replace(
        speed_rad_s=0.0, torque_nm=60.0 if drive.commands[-1].speed_rad_s > 0.3 else 0.0)
    with pytest.raises(PreflightRefused, match="torque rose to 60 N·m, above") as error:
        probe_sign(here.bench, replace(LIMITS, probe_torque_nm=50.0), Mode.SPEED, SPEED_RESOLUTION)
    assert "raise limits.probe_torque_nm" in error.value.next_step
    assert max(command.speed_rad_s for command in here.drive.commands) == pytest.approx(0.3, abs=0.01)


def test_the_probe_keeps_to_its_travel(world):
    """Reported speed is noise about zero while the shaft creeps."""
    here = world()
    here.limits = replace(LIMITS, probe_travel_rad=0.02)
    here.drive.misbehave = lambda drive, sample: sample._replace(speed_rad_s=min(0.09, sample.speed_rad_s))
    result = here.runner().run()
    assert "without a clear direction" in str(result.cause)
    assert here.drive.speed == 0.0


class TightDrive(FakeDrive):
    """Drive whose own limits are tighter than those of the rig, and stay."""

    kept = (None, None)

    def preflight(self, limits):
        torque_nm, speed_rad_s = self.kept
        return replace(super().preflight(limits), kept_torque_nm=torque_nm, kept_speed_rad_s=speed_rad_s)


@pytest.mark.parametrize(("kept", "flag"), [
    ((0.0, None), "--accept-wider-limit torque"),
    ((None, 0.4), "--accept-wider-limit speed"),              # the window begins at 0.5
])
def test_limits_of_the_drive_that_leave_no_room(world, kept, flag):
    here = world(TightDrive())
    here.drive.kept = kept
    result = here.runner().run()
    assert int(exit_code(result.cause)) == 4
    assert flag in result.cause.next_step
    assert_nothing_moved(here, result)


def test_the_run_keeps_within_the_drive_s_own_limits(world):
    here = world(TightDrive())
    here.drive.kept = (150.0, 4.0)
    seen = []

    def confirm(task, preflight, idle):
        seen.append(task.limits)
        raise PreflightRefused("seen enough")

    here.runner(confirm=confirm).run()
    (limits,) = seen
    assert (limits.torque_nm, limits.probe_torque_nm, limits.speed_max_rad_s) == (150.0, 150.0, 4.0)


def test_a_plan_for_a_shaft_that_is_too_heavy_ends_with_its_own_message(world):
    """The shaft has already moved: a limit leaves no room, and the shaft is stopped."""
    here = world()
    request = ExcitationRequest(kind="sine", frequency_hz=2.0, amplitude_rad_s=2.0, offset_rad_s=5.0, periods=3)
    outcome = here.runner(request).run()
    assert isinstance(outcome.cause, LimitHit)
    assert exit_code(outcome.cause) == 7
    assert "that stages 2 and 3 measured" in outcome.cause.what
    assert "The shaft was stopped" in outcome.cause.next_step
    assert "--amplitude" in outcome.cause.next_step
    assert outcome.stop.confirmed
