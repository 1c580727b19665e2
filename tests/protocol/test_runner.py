"""The five stages in order, and whatever goes wrong in any of them: stopped, the first cause kept."""

import signal
from dataclasses import replace

import pytest
from fake_drive import LIMITS, FakeDrive, lost, refused_check

from drivers.drive import Mode, PowerState
from drivers.errors import CommunicationLost, DriveFault, LimitHit, ModeNotConfirmed, PreflightRefused
from tdhil.errors import ExitCode, Interrupted, exit_code
from tdhil.protocol.runner import STAGES
from tdhil.protocol.settings import ExcitationRequest
from tdhil.record.errors import LogError

IN_STAGE = 20           # cycles into the stage; setup has moved the shaft by then (probe) after 120
EACH_STAGE = pytest.mark.parametrize("stage", STAGES)


def after(stage):
    return 120 if stage == "setup" else IN_STAGE


def outcomes(result):
    return [(stage.name, stage.outcome) for stage in result.stages]


def up_to(stage):
    index = STAGES.index(stage)
    return [(name, "ok") for name in STAGES[:index]] + [(stage, "aborted")]


def assert_at_rest(here, result):
    assert result.stop.confirmed
    assert here.drive.speed == 0.0
    assert here.drive.disabled_at == [0.0]
    assert here.drive.state is PowerState.OFF
    assert here.drive.closed
    assert here.drive.calls[-1] == "close"
    assert here.display.stops == [True]


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


def test_the_drive_is_disabled_once_and_after_the_quick_stop(world):
    here = world()
    here.runner().run()
    asked = [call for call in here.drive.calls if call != "exchange"]
    assert asked == ["connect", "preflight", "enable torque", "quick_stop", "disable", "close"]


def test_a_segment_is_announced_with_its_end_before_it_is_run(world):
    """A log that ends inside a segment can be read because of it."""
    here = world()

    def end(stage, cycles):
        if stage == "acquire" and here.log.motions[-1][0] is not None:
            raise RuntimeError("here")

    here.display.on_cycle = end
    here.runner().run()
    (segment,) = here.log.motions[-1][0].segments
    assert segment.end_s - segment.start_s == pytest.approx(2 * segment.period_s)


def test_in_speed_mode_two_stages_are_skipped(world):
    here = world()
    result = here.runner(ExcitationRequest(mode="speed", periods=2)).run()
    assert result.cause is None
    assert [stage.outcome for stage in result.stages] == ["ok", "ok", "skipped", "skipped", "ok"]
    assert Mode.TORQUE not in {command.mode for command in here.drive.commands}
    assert here.log.motions[-1][0].mode == "speed"
    assert_at_rest(here, result)


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


# -- something goes wrong in each stage ----------------------------------------------------------------------


@EACH_STAGE
@pytest.mark.parametrize(
    "error",
    [RuntimeError("a mistake"), LogError("disk full"), LimitHit("too far"), KeyboardInterrupt(), SystemExit(3)],
    ids=lambda error: type(error).__name__,
)
def test_an_exception_from_display_in_each_stage(world, stage, error):
    here = world()

    def fail(name, cycles):
        if (name, cycles) == (stage, after(stage)):
            raise error

    here.display.on_cycle = fail
    result = here.runner().run()
    assert result.cause is error
    assert outcomes(result) == up_to(stage)
    assert type(error).__name__ in result.stages[-1].detail
    assert here.log.failures == [error]
    assert_at_rest(here, result)


@EACH_STAGE
def test_a_display_that_is_broken_for_good(world, stage):
    here = world()
    error = RuntimeError("no terminal")

    def fail(name, cycles=10**9):
        if name == stage and cycles >= after(stage):
            raise error

    here.display.on_cycle = here.display.on_ended = fail
    result = here.runner().run()
    assert result.cause is error
    assert outcomes(result) == up_to(stage)
    assert_at_rest(here, result)


@EACH_STAGE
def test_a_display_that_fails_as_a_stage_begins(world, stage):
    here = world()
    error = RuntimeError("no terminal")

    def fail(name):
        if name == stage:
            raise error

    here.display.on_started = fail
    result = here.runner().run()
    assert result.cause is error
    assert outcomes(result) == up_to(stage)
    if stage == "setup":
        assert result.stop is None
    else:
        assert_at_rest(here, result)


@EACH_STAGE
def test_a_log_that_is_broken_for_good(world, stage):
    """Disk full: every later call fails as well, those of the stop and of the end of the stage included."""
    here = world()
    error = LogError("disk full")

    def fail_cycle():
        if here.display.stage == stage and here.display.seen >= after(stage):
            raise error

    def fail_stage(name):
        if name == stage:
            raise LogError("still full")

    here.log.on_cycle, here.log.on_stage = fail_cycle, fail_stage
    result = here.runner().run()
    assert result.cause is error
    assert outcomes(result) == up_to(stage)
    assert_at_rest(here, result)


@EACH_STAGE
@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
def test_a_stop_request_in_each_stage(world, stage, signum):
    here = world()

    def press(name, cycles):
        if name == stage and cycles >= after(stage):
            here.stop_request.ask(signum)      # again and again: the stop's own cycles are shown too

    here.display.on_cycle = press
    result = here.runner().run()
    assert isinstance(result.cause, Interrupted)
    assert exit_code(result.cause) is (ExitCode.INTERRUPTED if signum == signal.SIGINT else ExitCode.TERMINATED)
    assert here.stop_request.count > 10
    assert outcomes(result) == up_to(stage)
    assert [kind for kind, _ in here.log.events][-1] == "interrupted"
    assert here.log.failures == []
    assert_at_rest(here, result)


@EACH_STAGE
def test_a_drive_fault_in_each_stage(world, stage):
    here = world()

    def fault(drive, sample):
        if here.display.stage == stage and here.display.seen == after(stage):
            drive.fault()
        return drive.report()

    here.drive.misbehave = fault
    result = here.runner().run()
    assert isinstance(result.cause, DriveFault)
    assert outcomes(result) == up_to(stage)
    assert result.stop.confirmed
    assert here.drive.speed == 0.0
    assert here.drive.state is PowerState.FAULT     # left for the operator to see


@EACH_STAGE
def test_an_emergency_message_once_in_each_stage(world, stage):
    here = world()
    error, told = DriveFault("EMCY 7305h"), []

    def emcy(drive, sample):
        if here.display.stage == stage and here.display.seen == after(stage) and not told:
            told.append(True)
            raise error
        return sample

    here.drive.misbehave = emcy
    result = here.runner().run()
    assert result.cause is error
    assert outcomes(result) == up_to(stage)
    assert_at_rest(here, result)


@EACH_STAGE
def test_the_first_cause_is_kept_when_the_stop_fails_too(world, stage):
    here = world()
    error = RuntimeError("first")

    def fail(name, cycles):
        if (name, cycles) == (stage, after(stage)):
            here.drive.misbehave = lost
            raise error

    here.display.on_cycle = fail
    result = here.runner().run()
    assert result.cause is error
    assert not result.stop.confirmed
    assert "the bus is gone" in result.stop.trouble[0]
    assert here.drive.disabled_at == []
    assert here.drive.closed


@EACH_STAGE
def test_a_lost_bus_in_each_stage(world, stage):
    here = world()

    def cut(drive, sample):
        if here.display.stage == stage and here.display.seen >= after(stage):
            raise CommunicationLost("cut")
        return sample

    here.drive.misbehave = cut
    result = here.runner().run()
    assert isinstance(result.cause, CommunicationLost)
    assert outcomes(result) == up_to(stage)
    assert not result.stop.confirmed
    assert here.drive.disabled_at == []


def test_what_fails_while_closing_is_the_cause_only_where_there_is_no_other(world):
    for first in (None, RuntimeError("first")):
        here = world()

        def close():
            raise CommunicationLost("while closing")

        def fail(name, cycles, first=first):
            if first is not None and name == "speed":
                raise first

        here.drive.close, here.display.on_cycle = close, fail
        result = here.runner().run()
        assert result.stop.confirmed
        if first is None:
            assert isinstance(result.cause, CommunicationLost)
        else:
            assert result.cause is first


def test_a_stop_that_is_not_confirmed_after_a_good_run_shows(world):
    here = world(FakeDrive(brakes=False))
    here.drive.coulomb = here.drive.viscous = 0.0

    def slip(name, cycles):
        if name == "acquire":
            here.drive.viscous = here.drive.coulomb = 0.0

    here.display.on_cycle = slip
    result = here.runner(ExcitationRequest(mode="speed", periods=2)).run()
    assert not result.stop.confirmed
    assert here.drive.disabled_at == []


# -- refused before motion -----------------------------------------------------------------------------------


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
            idle()                                  # feeds the watchdog while somebody thinks
        raise PreflightRefused("not confirmed")

    result = here.runner(confirm=refuse).run()
    assert isinstance(result.cause, PreflightRefused)
    assert here.drive.cycles == 100                 # a second of standstill, and the idle cycles
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


def test_a_refused_preflight_moves_nothing_and_says_how_to_mend_it(world):
    here = world(FakeDrive(refused=(refused_check(), refused_check())))
    asked = []
    result = here.runner(confirm=lambda *_: asked.append(1)).run()
    assert isinstance(result.cause, PreflightRefused)
    assert "watchdog: wanted armed, found not armed (and 1 more" in str(result.cause)
    assert result.cause.next_step == "arm it"
    assert asked == []
    assert here.drive.cycles == 0
    assert_nothing_moved(here, result)


def test_a_shaft_that_already_turns_is_left_alone(world):
    here = world(FakeDrive(speed=1.0, coulomb=0.0, viscous=0.0))
    result = here.runner().run()
    assert isinstance(result.cause, PreflightRefused)
    assert "already turns" in str(result.cause)
    assert result.stop is None
    assert not [call for call in here.drive.calls if call.startswith("enable")]


def test_a_fault_is_reset_on_the_operator_s_word_only(world):
    for word in (False, True):
        here = world(FakeDrive(state=PowerState.FAULT, wish=PowerState.FAULT))
        result = here.runner(reset_fault=word).run()
        assert ("reset_fault" in here.drive.calls) is word
        assert (result.cause is None) is word


# -- the sign probe, the plan, the mode ----------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["torque", "speed"])
def test_an_inverted_sign_is_found_at_walking_pace(world, mode):
    here = world(FakeDrive(direction=-1.0))
    fastest = []
    here.display.on_cycle = lambda *_: fastest.append(abs(here.drive.speed))
    result = here.runner(ExcitationRequest(mode=mode)).run()
    assert isinstance(result.cause, PreflightRefused)
    assert exit_code(result.cause) is ExitCode.REFUSED
    assert "turned backwards" in str(result.cause)
    assert max(fastest) < 0.1 * LIMITS.speed_max_rad_s
    assert_at_rest(here, result)


def test_a_locked_shaft_ends_the_probe(world):
    here = world(FakeDrive(shaft_locked=True))
    result = here.runner().run()
    assert isinstance(result.cause, PreflightRefused)
    assert "did not move up to 200 N·m" in str(result.cause)
    assert max(command.torque_nm for command in here.drive.commands) == 200.0
    assert result.stop.confirmed


def test_the_probe_goes_no_farther_than_it_may(world):
    """Reported speed is noise about zero while the shaft creeps."""
    here = world()
    here.limits = replace(LIMITS, probe_travel_rad=0.02)
    here.drive.misbehave = lambda drive, sample: sample._replace(speed_rad_s=min(0.09, sample.speed_rad_s))
    result = here.runner().run()
    assert "without a clear direction" in str(result.cause)
    assert here.drive.speed == 0.0


def test_an_excitation_that_does_not_fit_is_refused_and_the_shaft_stopped(world):
    here = world()
    result = here.runner(ExcitationRequest(amplitude_rad_s=9.0)).run()
    assert isinstance(result.cause, PreflightRefused)
    assert exit_code(result.cause) is ExitCode.REFUSED
    assert "amplitude of 9 rad/s" in str(result.cause)
    assert outcomes(result) == [("setup", "ok"), ("speed", "ok"), ("torque", "ok")]
    assert_at_rest(here, result)


def test_a_mode_that_the_drive_does_not_take_over_is_found_out(world):
    here = world(FakeDrive(misbehave=lambda d, s: s._replace(mode=Mode.TORQUE) if s.mode is Mode.SPEED else s))
    result = here.runner().run()
    assert isinstance(result.cause, ModeNotConfirmed)
    assert outcomes(result)[-1] == ("speed", "aborted")
    assert here.drive.speed == 0.0


def test_the_switch_to_torque_mode_is_seeded_with_what_flows(world):
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
    assert "longer than 20 s" in str(result.cause)
    assert_at_rest(here, result)


def test_a_load_that_lets_go_in_torque_mode_is_caught_inside_the_window(world):
    here = world()

    def let_go(name, cycles):
        if name == "acquire" and cycles == 200:
            here.drive.coulomb, here.drive.viscous, here.drive.inertia = -150.0, 0.0, 60.0

    here.display.on_cycle = let_go
    result = here.runner().run()
    assert isinstance(result.cause, LimitHit)
    assert outcomes(result) == up_to("acquire")
    assert result.stop.at_rest_s is not None
    # A load that drives turns the shaft again as soon as the drive lets go of it, and that is said.
    assert not result.stop.confirmed
    assert "began to turn" in result.stop.trouble[-1]


@pytest.mark.parametrize("inertia", [2.0, 100.0, 3000.0])
def test_light_and_heavy_shafts_go_through_alike(world, inertia):
    here = world(FakeDrive(inertia=inertia))
    result = here.runner(ExcitationRequest(periods=2)).run()
    assert result.cause is None, result.cause
    assert_at_rest(here, result)


def test_settings_that_could_not_be_given_back_are_in_the_log(world):
    here = world()
    here.drive.left = ("6072h: no answer",)
    assert here.runner().run().cause is None
    assert any("6072h" in event[-1] and "not given back" in event[-1] for event in here.log.events)
