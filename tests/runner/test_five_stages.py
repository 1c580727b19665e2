"""The five stages in order, in each mode, and their ends: the plan, the mode, the limits."""

from dataclasses import replace

import pytest

from drivers.drive import Mode
from drivers.errors import LimitHit, ModeNotConfirmed, PreflightRefused
from tdhil.errors import ExitCode, exit_code
from tdhil.runner.settings import ExcitationRequest
from tdhil.runner.task import STAGES
from tests.runner.fake_drive import LIMITS, FakeDrive
from tests.runner.run_outcomes import assert_at_rest, outcomes, up_to


@pytest.mark.heavy
def test_a_run_goes_through_its_five_stages_and_stops(world):
    here = world()
    result = here.runner().run()
    assert result.cause is None
    assert outcomes(result) == [(name, "ok") for name in STAGES]
    assert [stage.name for stage in here.log.stages] == list(STAGES)
    assert all(before.end_s <= behind.start_s for before, behind in zip(result.stages, result.stages[1:], strict=False))
    assert_at_rest(here, result)
    excitation, levels, ramps = here.log.motions[-1]
    assert (excitation.kind, excitation.mode, len(excitation.segments)) == ("multisine", "torque", 2)
    assert (len(levels), len(ramps)) == (2, 2)
    assert here.log.facts["simulated"] is True
    assert here.log.facts["torque_limit_nm"] == 400.0
    assert len(here.display.plans) == len(here.display.preflights) == 1
    assert all(0.0 <= command.speed_rad_s <= 10.0 for command in here.drive.commands)
    assert all(abs(command.torque_nm) <= 400.0 for command in here.drive.commands)


@pytest.mark.heavy
def test_the_drive_is_disabled_once_and_after_the_quick_stop(world):
    here = world()
    here.runner().run()
    asked = [call for call in here.drive.calls if call != "exchange"]
    assert asked == ["connect", "preflight", "enable torque", "quick_stop", "disable", "close"]


def test_a_segment_is_announced_with_its_end_before_it_is_run(world):
    """The announcement makes a log readable that ends within a segment."""
    here = world()

    def end(stage, cycles):
        if stage == "acquire" and here.log.motions[-1][0] is not None:
            raise RuntimeError("here")

    here.display.on_cycle = end
    here.runner().run()
    (segment,) = here.log.motions[-1][0].segments
    assert segment.end_s - segment.start_s == pytest.approx(2 * segment.period_s)


@pytest.mark.heavy
def test_in_speed_mode_two_stages_are_skipped(world):
    here = world()
    result = here.runner(ExcitationRequest(mode="speed", periods=2)).run()
    assert result.cause is None
    assert [stage.outcome for stage in result.stages] == ["ok", "ok", "skipped", "skipped", "ok"]
    assert Mode.TORQUE not in {command.mode for command in here.drive.commands}
    assert here.log.motions[-1][0].mode == "speed"
    assert_at_rest(here, result)


@pytest.mark.heavy
def test_a_drive_without_torque_mode_is_run_in_speed_mode(world):
    here = world(FakeDrive(modes=frozenset({Mode.SPEED})))
    assert outcomes(here.runner().run())[2:4] == [("torque", "skipped"), ("hold", "skipped")]
    here = world(FakeDrive(modes=frozenset({Mode.SPEED})))
    result = here.runner(ExcitationRequest(mode="torque")).run()
    assert isinstance(result.cause, PreflightRefused)
    assert result.stop is None


@pytest.mark.parametrize("every", [10, 300])
def test_cycles_without_feedback_degrade_their_stage_if_they_are_many(world, every):
    here = world()

    def lose(drive, sample):
        if here.display.stage == "speed" and drive.cycles % every == 0:
            drive.missed += 1
            return sample._replace(fresh=False)
        return sample

    here.drive.misbehave = lose
    result = here.runner().run()
    assert result.cause is None
    assert [stage.outcome for stage in result.stages] == ["ok", "degraded" if every == 10 else "ok", "ok", "ok", "ok"]
    assert "cycles without feedback" in result.stages[1].detail
    assert here.log.run["counters"]["missed"] == here.drive.missed


def test_an_excitation_that_does_not_fit_what_was_found_in_motion_ends_with_the_shaft_stopped(world):
    here = world()
    result = here.runner(ExcitationRequest(amplitude_rad_s=9.0)).run()
    assert isinstance(result.cause, LimitHit)
    assert exit_code(result.cause) is ExitCode.LIMIT
    assert "amplitude of 9 rad/s" in str(result.cause)
    assert outcomes(result) == [("setup", "ok"), ("speed", "ok"), ("torque", "ok")]
    assert_at_rest(here, result)


def test_a_mode_that_the_drive_does_not_confirm_is_a_fault(world):
    here = world(FakeDrive(misbehave=lambda d, s: s._replace(mode=Mode.TORQUE) if s.mode is Mode.SPEED else s))
    result = here.runner().run()
    assert isinstance(result.cause, ModeNotConfirmed)
    assert outcomes(result)[-1] == ("speed", "aborted")
    assert here.drive.speed == 0.0


def test_the_switch_to_torque_mode_begins_with_the_torque_before_it(world):
    here = world()
    here.runner().run()
    commands = here.drive.commands
    enabled = next(i for i, command in enumerate(commands) if command.mode is Mode.SPEED and command.speed_rad_s > 0.0)
    switch = next(i for i in range(enabled, len(commands)) if commands[i].mode is Mode.TORQUE)
    flowing = 60.0 + 8.0 * commands[switch - 1].speed_rad_s
    assert commands[switch].torque_nm == pytest.approx(flowing, abs=2.0)
    assert [command.torque_nm for command in commands[switch - 5 : switch]] == [commands[switch].torque_nm] * 5


def test_the_time_limit_ends_a_run(world):
    here = world(limits=replace(LIMITS, time_s=20.0))
    result = here.runner().run()
    assert isinstance(result.cause, LimitHit)
    assert "longer than the limit of 20 s" in str(result.cause)
    assert_at_rest(here, result)


def test_a_lost_load_in_torque_mode_trips_inside_the_window(world):
    here = world()

    def let_go(name, cycles):
        if name == "acquire" and cycles == 200:
            here.drive.coulomb, here.drive.viscous, here.drive.inertia = -150.0, 0.0, 60.0

    here.display.on_cycle = let_go
    result = here.runner().run()
    assert isinstance(result.cause, LimitHit)
    assert outcomes(result) == up_to("acquire")
    assert result.stop.at_rest_s is not None
    # A driving load turns the shaft again once the drive is disabled, and the report states this.
    assert not result.stop.confirmed
    assert "began to turn" in result.stop.trouble[-1]


@pytest.mark.heavy
@pytest.mark.parametrize("inertia", [2.0, 100.0, 3000.0])
def test_light_and_heavy_shafts_go_through_alike(world, inertia):
    here = world(FakeDrive(inertia=inertia))
    result = here.runner(ExcitationRequest(periods=2)).run()
    assert result.cause is None, result.cause
    assert_at_rest(here, result)


def test_settings_that_could_not_be_restored_are_in_the_log(world):
    here = world()
    here.drive.left = ("6072h: no answer",)
    assert here.runner().run().cause is None
    assert any("6072h" in event[-1] and "not restored" in event[-1] for event in here.log.events)


def test_an_error_of_the_display_during_the_stop_is_reported_once(world):
    here = world()
    said: list[str] = []

    def broken(stage, cycles):
        if stage == "torque":
            raise OSError("the terminal is gone")

    here.display.on_cycle = broken
    result = here.runner(say=said.append).run()
    assert result.stop.confirmed
    text = "OSError: the terminal is gone"
    assert [event[-1] for event in here.log.events].count(f"error beside the stop, which went on: {text}") == 1
    assert said.count(f"error beside the stop, which went on: {text}") == 1
