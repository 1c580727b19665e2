"""Stop sequence after the drive is disabled: reports of the shaft."""

import math

import pytest

from drivers.drive import PowerState
from tdhil.runner.stop import REST_AFTER_S
from tests.runner.fake_drive import PERIOD_S
from tests.runner.reporting_drive import Reporting
from tests.runner.stop_calls import LAG_S, SILENT


def when_off(drive, speeds):
    """Misbehaviour: values that the drive reports after it is disabled, one per second; the last one stays."""
    since = []

    def change(_, sample):
        if sample.state is not PowerState.OFF:
            return sample
        since.append(sample.time_s)
        speed = speeds[min(int(sample.time_s - since[0]), len(speeds) - 1)]
        return sample._replace(fresh=False) if speed is None else sample._replace(speed_rad_s=speed)

    drive.misbehave = change
    return since


def test_a_shaft_that_begins_to_turn_once_it_is_disabled_is_reported_and_watched(world):
    here = world()
    here.turn(5.0)
    since = when_off(here.drive, [0.0, 0.4, 0.2, -0.1, 0.0])
    report = here.stop_sequence().run()
    assert report.confirmed
    assert len(report.trouble) == 1
    assert "began to turn (0.400 rad/s) once its torque was off" in report.trouble[0]
    assert since[-1] - since[0] == pytest.approx(4.0 + 3.0 * LAG_S, abs=0.1)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_shaft_that_continues_to_turn_once_it_is_disabled_is_not_confirmed(world, sign):
    here = world()
    here.turn(5.0)
    since = when_off(here.drive, [sign * 0.4])
    report = here.stop_sequence().run()
    assert report.disabled
    assert report.at_rest_s is not None
    assert report.confirmed is False
    assert "began to turn" in report.trouble[-1]
    assert since[-1] - since[0] == pytest.approx(REST_AFTER_S, abs=0.1)


def test_a_shaft_that_turns_by_its_position_once_it_is_disabled_is_not_confirmed(world):
    """The speed signal is lost at the same time."""
    here = world(Reporting(with_position=True))
    here.turn(5.0)
    here.guard.observer.position(1e-3, math.inf)
    since = when_off(here.drive, [0.0])
    plain = here.drive.misbehave
    here.drive.misbehave = lambda drive, sample: (
        plain(drive, sample)._replace(position_rad=drive.angle + 0.15 * PERIOD_S * len(since)))
    report = here.stop_sequence().run()
    assert report.disabled
    assert report.confirmed is False
    assert "rad/s by its position) once its torque was off" in report.trouble[-1]


def test_a_shaft_at_standstill_is_watched_for_as_long_as_reports_may_lag(world):
    here = world()
    here.turn(5.0)
    since = when_off(here.drive, [0.0])
    assert here.stop_sequence().run().confirmed
    assert since[-1] - since[0] == pytest.approx(3.0 * LAG_S, abs=0.1)


def test_lost_frames_afterwards_and_silence_afterwards(world):
    here = world()
    here.turn(5.0)
    when_off(here.drive, [0.0, None, None, None])
    report = here.stop_sequence().run()
    assert report.confirmed            # it was at standstill and disabled
    assert "sent no feedback" in report.trouble[-1]
    here = world()
    here.turn(5.0)
    since = when_off(here.drive, [0.0])
    plain = here.drive.misbehave
    here.drive.misbehave = lambda drive, sample: (
        plain(drive, sample)._replace(fresh=drive.cycles % 2 == 0 or sample.state is not PowerState.OFF))
    report = here.stop_sequence().run()
    assert report.confirmed
    assert report.trouble == ()
    assert since[-1] - since[0] == pytest.approx(2 * 3.0 * LAG_S, abs=0.2)


def test_a_drive_that_falls_silent_when_it_is_to_be_disabled(world):
    here = world()
    here.turn(5.0)
    here.drive.misbehave = lambda drive, sample: sample._replace(fresh="disable" not in drive.calls)
    begun = here.drive.cycles
    report = here.stop_sequence().run()
    assert report.disabled is False
    assert report.confirmed is False
    assert "did not confirm that it is disabled" in report.trouble[-1]
    assert here.drive.cycles - begun < (2.5 + 1.5) / PERIOD_S + SILENT + 10
