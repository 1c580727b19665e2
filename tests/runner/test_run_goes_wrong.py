"""Failures in each of the five stages: the shaft is stopped, and the first cause is kept."""

import signal

import pytest

from drivers.drive import PowerState
from drivers.errors import CommunicationLost, DriveFault, LimitHit
from tdhil.errors import ExitCode, Interrupted, LogError, exit_code
from tdhil.runner.settings import ExcitationRequest
from tests.runner.fake_drive import FakeDrive, lost
from tests.runner.run_outcomes import EACH_STAGE, after, assert_at_rest, outcomes, up_to


@pytest.mark.heavy(but_first=3)
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


@pytest.mark.heavy(but_first=3)
@EACH_STAGE
def test_a_log_that_is_broken_for_good(world, stage):
    """The disk is full: every later call fails too, including those of the stop and of the end of the stage."""
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


@pytest.mark.heavy(but_first=3)
@EACH_STAGE
@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
def test_a_stop_request_in_each_stage(world, stage, signum):
    here = world()

    def press(name, cycles):
        if name == stage and cycles >= after(stage):
            here.stop_request.ask(signum)      # repeatedly: the display shows the cycles of the stop too

    here.display.on_cycle = press
    result = here.runner().run()
    assert isinstance(result.cause, Interrupted)
    assert exit_code(result.cause) is (ExitCode.INTERRUPTED if signum == signal.SIGINT else ExitCode.TERMINATED)
    assert here.stop_request.count > 10
    assert outcomes(result) == up_to(stage)
    assert here.log.failures == [result.cause]
    assert_at_rest(here, result)


@pytest.mark.heavy(but_first=3)
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
    # At the beginning of stage 2 the shaft is slow and J is unknown. A lost signal would fall as its speed does.
    assert result.stop.confirmed is (stage != "speed")
    assert here.drive.speed == 0.0
    assert here.drive.state is PowerState.FAULT     # not changed, so that the operator sees it


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


@pytest.mark.heavy
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


@pytest.mark.heavy
def test_an_unconfirmed_stop_after_a_good_run_is_reported(world):
    here = world(FakeDrive(brakes=False))
    here.drive.coulomb = here.drive.viscous = 0.0

    def slip(name, cycles):
        if name == "acquire":
            here.drive.viscous = here.drive.coulomb = 0.0

    here.display.on_cycle = slip
    result = here.runner(ExcitationRequest(mode="speed", periods=2)).run()
    assert not result.stop.confirmed
    assert here.drive.disabled_at == []
