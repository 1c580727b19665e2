"""Stop sequence with feedback that fails for a time, fails permanently, or contains no valid speed."""

import pytest

from drivers.drive import PositionReading, PowerState
from drivers.errors import CommunicationLost
from tdhil.runner.standstill import AT_REST_SHARE
from tdhil.runner.stop import LONGEST_GAP_CYCLES, LONGEST_GAP_S, POSITION_EVERY_S
from tests.runner.fake_drive import LIMITS, PERIOD_S, FakeDrive, lost
from tests.runner.stop_calls import LAG_S, SILENT, asked


@pytest.mark.parametrize("first", [0, 1, 60, 200])
@pytest.mark.parametrize("error", [CommunicationLost("a frame is missing"), RuntimeError("what?"), ValueError("no")])
def test_exchanges_that_fail_for_a_while_are_survived(world, first, error):
    here = world()
    here.turn(5.0)
    begun = here.drive.cycles

    def stumble(drive, sample):
        if first <= drive.cycles - begun - 1 < first + SILENT - 1:
            raise error
        return sample

    here.drive.misbehave = stumble
    report = here.stop_sequence().run()
    assert report.confirmed
    assert str(error) in report.trouble
    assert here.drive.disabled_at == [0.0]


@pytest.mark.parametrize(("every", "factor", "confirmed"), [(20, 1.05, True), (20, -1.9, True), (20, 2.5, False),
                                                            (3, 1.05, False)])
def test_single_counts_of_a_coarse_and_noisy_report_are_no_motion(world, every, factor, confirmed):
    """They count as motion neither before nor after the drive is disabled."""
    here = world()
    here.turn(5.0)
    at_rest_rad_s = AT_REST_SHARE * LIMITS.speed_max_rad_s

    def coarse(drive, sample):
        return sample._replace(speed_rad_s=sample.speed_rad_s + factor * at_rest_rad_s * (drive.cycles % every == 0))

    here.drive.misbehave = coarse
    report = here.stop_sequence().run()
    assert report.confirmed is confirmed
    assert not confirmed or "began to turn" not in str(report.trouble)


@pytest.mark.parametrize("misbehave", [lost, lambda drive, sample: sample._replace(fresh=False)], ids=["dead", "stale"])
def test_an_unreachable_drive_is_left_to_its_watchdog(world, misbehave):
    here = world()
    here.turn(5.0)
    begun = here.drive.cycles
    here.drive.misbehave = misbehave
    report = here.stop_sequence().run()
    assert not report.confirmed
    assert not report.disabled
    assert here.drive.cycles - begun == SILENT
    assert asked(here.drive) == ["quick_stop"]
    assert here.drive.disabled_at == []


@pytest.mark.parametrize(("missing_s", "anew"), [(0.5 * LONGEST_GAP_S, False), (1.5 * LONGEST_GAP_S, True)])
def test_a_longer_gap_in_the_feedback_restarts_the_wait(world, missing_s, anew):
    here = world()
    here.turn(5.0)
    begun, missing = here.drive.cycles, round(missing_s / PERIOD_S)

    def stumble(drive, sample):
        return sample._replace(fresh=False) if 150 <= drive.cycles - begun < 150 + missing else sample

    here.drive.misbehave = stumble
    start_s = here.bench.now_s
    report = here.stop_sequence().run()
    assert report.confirmed
    begins_s = (150 + missing) * PERIOD_S if anew else 5.0 / 2.0
    assert report.at_rest_s - start_s == pytest.approx(begins_s + 3.0 * LAG_S, abs=0.15)


@pytest.mark.parametrize(("missing", "confirmed"), [(LONGEST_GAP_CYCLES - 1, True), (LONGEST_GAP_CYCLES, False)])
def test_on_a_slow_line_the_gap_is_counted_in_cycles(world, missing, confirmed):
    """Several frames are lost for each one that arrives, at 10 Hz."""
    here = world(FakeDrive(period_s=0.1))
    here.turn(1.0)
    here.drive.misbehave = lambda drive, sample: sample._replace(fresh=drive.cycles % (missing + 1) == 0)
    assert here.stop_sequence().run().confirmed is confirmed


def test_speed_feedback_that_is_no_number_is_no_standstill(world):
    here = world(FakeDrive(misbehave=lambda drive, sample: sample._replace(speed_rad_s=float("nan"))))
    here.drive.state = here.drive.wish = PowerState.ENABLED
    report = here.stop_sequence().run()
    assert not report.confirmed
    assert "disable" not in here.drive.calls


def test_missing_feedback_is_reported(world):
    here = world()
    here.turn(5.0)
    here.drive.misbehave = lambda drive, sample: sample._replace(fresh=False)
    assert here.stop_sequence().run().trouble == ("no feedback from the drive any more",)


class Asked(FakeDrive):
    """Drive that reports its angle to a single request only. ``error``: exception of such a request."""

    turned_rad = 0.0
    readings = 0
    error: BaseException | None = None

    def _move(self, command):
        super()._move(command)
        self.turned_rad += self.speed * PERIOD_S

    def read_position(self):
        self.readings += 1
        if self.error is not None:
            raise self.error
        return PositionReading(self.clock.now_s(), 0.001, self.turned_rad, None, "6064h")


@pytest.mark.parametrize("error", [None, CommunicationLost("no reply"), KeyboardInterrupt()])
def test_a_position_by_single_requests_is_polled_at_intervals(world, error):
    here = world(Asked())
    here.turn(5.0)
    here.drive.error, begun_s = error, here.bench.now_s
    report = here.stop_sequence().run()
    took_s = here.bench.now_s - begun_s
    assert report.confirmed and here.drive.disabled_at == [0.0]
    assert took_s / POSITION_EVERY_S / 1.5 < here.drive.readings <= took_s / POSITION_EVERY_S + 1


class Creeping(Asked):
    """Drive whose shaft creeps for a while at a speed that a coarse report shows as zero."""

    longest_s = 6.0
    crept_s = 0.0

    def _move(self, command):
        super()._move(command)
        if self.speed == 0.0 and self.crept_s < self.longest_s:
            self.crept_s += PERIOD_S
            self.turned_rad += 0.3 * PERIOD_S


def test_standstill_is_held_against_a_position_by_single_requests(world):
    """The readings of the stop must not reduce the polling rate (`benchmarks/lying_reports.py`, number 3730)."""
    here = world(Creeping())
    here.turn(5.0)
    assert here.stop_sequence().run().confirmed
    assert here.drive.crept_s >= here.drive.longest_s
