"""Stop with intermittent conditions: speed, feedback, torque, and the state of the drive."""

from dataclasses import dataclass

import pytest

from drivers.drive import Mode, PowerState
from drivers.errors import CommunicationLost
from tdhil.runner.settings import ControlAssumptions
from tests.runner.fake_drive import PERIOD_S, FakeDrive
from tests.runner.string_drive import StringDrive, StringWorld

SETTLE_S = 3.0 * ControlAssumptions().largest_speed_lag_s


def cycle_feedback(drive, sample):
    """Drop the feedback according to the drive's ``gone``. The rest may contain another torque or speed."""
    if drive.gone(drive.cycles):
        return sample._replace(fresh=False)
    return sample._replace(**drive.told)


@dataclass
class Polled(FakeDrive):
    """Drive that answers polls, and answers them truthfully."""

    def __post_init__(self):
        self.misbehave, self.gone, self.told = cycle_feedback, lambda cycle: False, {}

    def poll(self):
        return self.report()


@dataclass
class PolledString(StringDrive):
    """The same drive with a string."""

    def __post_init__(self):
        super().__post_init__()
        self.misbehave, self.gone, self.told = cycle_feedback, lambda cycle: False, {}

    def poll(self):
        return self.report()


def test_a_shaft_that_turns_again_restarts_the_wait(world):
    here = world()
    here.turn(2.0)
    begun = here.drive.cycles
    again = range(begun + 120, begun + 125)            # at standstill for more than a second by then

    def turns(drive, sample):
        return sample._replace(speed_rad_s=0.5, standstill=False) if drive.cycles in again else sample

    here.drive.misbehave = turns
    begin_s = here.bench.now_s
    report = here.stop_sequence().run()
    assert report.confirmed
    assert report.at_rest_s - begin_s >= 125 * PERIOD_S + SETTLE_S - 0.05


def test_feedback_that_returns_restarts_the_time_of_the_shaft(world):
    """Feedback is missing twice, each time for less than polls wait for a shaft that does not slow down."""
    here = world(Polled(brakes=False))
    here.turn(5.0)
    here.drive.coulomb = here.drive.viscous = 0.0
    begun = here.drive.cycles

    def gone(cycle):
        here.drive.brakes = cycle > begun + 100
        return cycle < begun + 100 and not begun + 50 <= cycle < begun + 55

    here.drive.gone = gone
    assert here.stop_sequence().run().confirmed


@pytest.mark.parametrize("told", [{"torque_nm": 300.0}, {"torque_nm": 300.0, "speed_rad_s": 5.0}],
                         ids=["gone", "not believed"])
def test_torque_of_feedback_that_is_gone_or_not_believed_is_not_held(told):
    """A poll shows the string without torque, so the drive may be disabled."""
    here = StringWorld()
    here.drive = here.bench.drive = PolledString()
    here.drive.state = here.drive.wish = PowerState.QUICK_STOP
    here.drive.told = told
    if "speed_rad_s" not in told:
        here.drive.gone = lambda cycle: cycle > 30
    report = here.stop_sequence().run()
    assert report.confirmed, report.trouble
    assert report.disabled


def test_time_without_feedback_counts_where_speed_mode_is_not_followed():
    here = StringWorld(speed=4.0)
    plain = here.drive._move

    def deaf(command):
        if here.drive.state is not PowerState.ENABLED:
            here.drive.angle = 0.0
            plain(command)

    here.drive._move = deaf
    here.drive.misbehave = lambda drive, sample: sample._replace(fresh=drive.cycles % 10 == 0)
    report = here.stop_sequence().run()
    assert "did not follow speed mode" in report.trouble[0]
    assert here.bench.now_s < 60.0


def test_lost_frames_do_not_end_a_coast(world):
    here = world()
    here.turn(2.0, Mode.TORQUE)
    here.guard.observer.backwards = True
    here.drive.misbehave = lambda drive, sample: sample._replace(fresh=drive.cycles % 5 != 0)
    report = here.stop_sequence().run()
    assert report.confirmed and report.trouble == ()
    assert "quick_stop" not in here.drive.calls


def test_without_feedback_no_torque_is_released():
    here = StringWorld(twist_nm=300.0)
    here.drive.misbehave = lambda drive, sample: sample._replace(fresh=not 150 <= drive.cycles < 160)
    assert here.stop_sequence().run().confirmed
    assert here.drive.commands[148].speed_rad_s != 0.0, "it yields at this time"
    assert [command.speed_rad_s for command in here.drive.commands[150:160]] == [0.0] * 10
    assert here.drive.commands[165].speed_rad_s != 0.0


def test_a_fault_during_the_release_of_torque_ends_it_and_is_reported_once():
    here = StringWorld(twist_nm=300.0)

    def faults(drive, sample):
        if drive.cycles == 150:
            drive.fault()
        return sample

    here.drive.misbehave = faults
    report = here.stop_sequence().run()
    assert sum("during the release of trapped torque" in line for line in report.trouble) == 1


def test_the_quick_stop_follows_speed_mode_at_once(world):
    """For a drive that stays in torque mode see test_stop_stays_in_torque_mode.py."""
    here = world(FakeDrive(quick_stop_in_torque_mode=False))
    here.turn(5.0, Mode.TORQUE)
    before = len(here.drive.calls)
    here.stop_sequence().run()
    assert here.drive.calls[before:].index("quick_stop") <= 2


@pytest.mark.parametrize("gone", ["missing", "frozen"])
def test_a_failed_poll_is_reported_and_the_stop_continues(world, gone):
    @dataclass
    class Unanswered(Polled):
        def poll(self):
            raise CommunicationLost("6041h does not answer")

    here = world(Unanswered())
    here.turn(5.0)
    if gone == "missing":
        here.drive.gone = lambda cycle: True
    else:
        here.drive.told = {"speed_rad_s": 5.0, "standstill": False}
    report = here.stop_sequence().run()
    assert not report.confirmed
    assert any("6041h does not answer" in line for line in report.trouble)
    assert here.drive.calls.count("quick_stop") == 1
    assert "disable" not in here.drive.calls
