"""One cycle: guard, drive, log, guard, display; and the conditions that its helpers wait for."""

import itertools
import signal
import threading
import time

import pytest

from drivers.drive import Command, Mode, PowerState
from drivers.errors import CommandRejected, CommunicationLost, DriveFault, LimitHit, ModeNotConfirmed
from tdhil.errors import ExitCode, Interrupted, exit_code
from tests.runner.fake_drive import FakeDrive

REST = Command(Mode.SPEED, 0.0, 0.0)


@pytest.mark.parametrize(
    ("signum", "code"),
    [
        (signal.SIGINT, ExitCode.INTERRUPTED),
        (signal.SIGTERM, ExitCode.TERMINATED),
        (signal.SIGHUP, ExitCode.TERMINATED),
    ],
)
def test_a_stop_request_ends_the_next_cycle_before_the_drive_sees_anything(world, signum, code):
    here = world()
    here.bench.cycle(REST)
    here.stop_request.ask(signum)
    here.stop_request.ask(signal.SIGTERM if signum != signal.SIGTERM else signal.SIGINT)
    with pytest.raises(Interrupted) as caught:
        here.bench.cycle(REST)
    assert exit_code(caught.value) is code          # the first request stays
    assert here.drive.cycles == here.log.cycles == 1
    assert here.stop_request.count == 2


def test_a_rejected_command_never_reaches_the_drive(world):
    here = world()
    for command in (Command(Mode.TORQUE, 0.0, float("nan")), Command(Mode.SPEED, 11.0, 0.0)):
        with pytest.raises(CommandRejected):
            here.bench.cycle(command)
    assert here.drive.commands == []


def test_a_sample_that_trips_the_guard_is_in_the_log(world):
    here = world(FakeDrive(misbehave=lambda drive, sample: sample._replace(speed_rad_s=20.0)))
    with pytest.raises(LimitHit):
        here.bench.cycle(REST)
    assert here.log.cycles == 1
    assert here.bench.last.speed_rad_s == 20.0
    assert here.display.seen == 0


def test_hold_keeps_a_command_for_a_time(world):
    here = world()
    samples = here.bench.hold(REST, 0.5)
    assert len(samples) == 25
    assert here.drive.commands == [REST] * 25
    assert here.display.seen == here.log.cycles == 25
    assert len(here.bench.hold(REST, 0.0)) == 1     # at least one cycle


def test_enable_waits_for_state_and_mode(world):
    here = world()
    sample = here.bench.enable(Mode.TORQUE, Command(Mode.TORQUE, 0.0, 0.0))
    assert (sample.state, sample.mode) == (PowerState.ENABLED, Mode.TORQUE)
    assert here.guard.expected is PowerState.ENABLED
    here.drive.state = here.drive.wish = PowerState.OFF
    with pytest.raises(DriveFault, match="left the state"):
        here.bench.cycle(REST)


def test_a_drive_that_stays_off_is_a_fault_after_a_time(world):
    here = world(FakeDrive(misbehave=lambda drive, sample: sample._replace(state=PowerState.READY)))
    with pytest.raises(DriveFault, match="torque mode was not enabled within 3 s"):
        here.bench.enable(Mode.TORQUE, Command(Mode.TORQUE, 0.0, 0.0))
    assert here.drive.cycles == 150


def test_a_drive_that_faults_while_enabling_is_not_waited_for(world):
    here = world(FakeDrive(misbehave=lambda drive, sample: sample._replace(state=PowerState.FAULT)))
    with pytest.raises(DriveFault, match="'fault'"):
        here.bench.enable(Mode.SPEED, REST)
    assert here.drive.cycles == 1


def test_a_mode_switch_is_confirmed_or_fails(world):
    here = world()
    here.turn(4.0)
    assert here.bench.switch_mode(Command(Mode.TORQUE, 4.0, 92.0)).mode is Mode.TORQUE
    here.drive.misbehave = lambda drive, sample: sample._replace(mode=None)
    before = here.drive.cycles
    with pytest.raises(ModeNotConfirmed, match=r"speed mode within 0\.5 s"):
        here.bench.switch_mode(Command(Mode.SPEED, 4.0, 92.0))
    assert here.drive.cycles - before == 25


def test_the_stop_cycle_is_neither_guarded_nor_stopped_by_log_or_display(world):
    here, count = world(), itertools.count()

    def full(*_):
        raise OSError("disk full")

    def no_terminal(*_):
        raise ValueError(f"no terminal {next(count)}")

    here.stop_request.ask(signal.SIGINT)
    here.log.on_cycle = full
    for _ in range(20):
        here.bench.stop_cycle(REST)
    assert here.bench.stop_side_troubles == ["OSError: disk full"]          # each is recorded once
    here.display.on_cycle = no_terminal
    for _ in range(20):
        here.bench.stop_cycle(REST)
    assert here.drive.cycles == 40
    different = [f"ValueError: no terminal {number}" for number in range(9)]
    assert here.bench.stop_side_troubles == ["OSError: disk full", *different]      # and no more than ten of them


def test_an_observer_that_fails_keeps_no_cycle_of_the_stop_from_the_log(world, monkeypatch):
    here, kept = world(), []

    def broken(*_):
        raise ValueError("empty")

    monkeypatch.setattr(type(here.guard.observer), "see", broken)
    here.log.on_cycle = lambda *_: kept.append(True)
    for _ in range(5):
        here.bench.stop_cycle(REST)
    assert len(kept) == 5


def test_the_stop_cycle_raises_the_exceptions_of_the_drive(world):
    def gone(drive, sample):
        raise CommunicationLost("gone")

    with pytest.raises(CommunicationLost):
        world(FakeDrive(misbehave=gone)).bench.stop_cycle(REST)


def test_arithmetic_takes_no_cycles_in_stepped_time_and_feeds_the_drive_in_real_time(world):
    here = world()
    assert here.bench.compute(lambda: 42, REST) == 42
    assert here.drive.cycles == 0
    here.drive.clock.stepped = False

    def work():
        while here.drive.cycles < 3:
            time.sleep(0.001)
        return 43

    assert here.bench.compute(work, REST) == 43
    assert here.drive.cycles >= 3
    with pytest.raises(ZeroDivisionError):
        here.bench.compute(lambda: 1 // 0, REST)


def test_in_stepped_time_a_long_computation_gives_signs_of_life_and_no_cycle(world):
    """A peer in another process considers a silent host dead and continues in its own time."""
    here = world()
    alive = threading.Event()
    here.drive.keep_alive = alive.set
    assert here.bench.compute(lambda: alive.wait(60.0), REST)
    assert here.drive.cycles == 0
    assert here.bench.compute(lambda: "done", REST) == "done"


def test_a_stop_request_ends_the_wait_for_a_computation(world):
    here = world()
    here.stop_request.ask(2)
    with pytest.raises(Interrupted):
        here.bench.compute(lambda: time.sleep(0.05), REST)
