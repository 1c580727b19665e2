"""The stop sequence: its order, what it survives, and that a turning shaft is never disabled."""

import pytest
from fake_drive import PERIOD_S, FakeDrive, lost

from drivers.drive import Command, Mode, PowerState
from drivers.errors import CommunicationLost, StopNotConfirmed
from tdhil.errors import ExitCode, exit_code
from tdhil.protocol.settings import ControlAssumptions
from tdhil.protocol.stop import (
    LONGEST_GAP_CYCLES,
    LONGEST_GAP_S,
    MOST_INTERRUPTIONS,
    REST_AFTER_S,
    SILENT_CYCLES,
    SILENT_S,
    StopReport,
    not_confirmed,
)

SILENT = max(SILENT_CYCLES, round(SILENT_S / PERIOD_S))
LAG_S = ControlAssumptions().largest_speed_lag_s
MODES = pytest.mark.parametrize("mode", Mode)


def asked(drive):
    """What was asked of the drive, without the exchanges."""
    return [call for call in drive.calls if call != "exchange" and not call.startswith("enable")]


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
    """Status word and reported speed say standstill from the first cycle on: the shaft may still turn."""
    here = world(FakeDrive(misbehave=lambda drive, sample: sample._replace(speed_rad_s=0.0, standstill=True)))
    here.turn(2.0, mode)
    start_s = here.bench.now_s
    report = here.stop_sequence().run()
    assert report.at_rest_s - start_s >= 3.0 * LAG_S
    assert here.drive.disabled_at == [0.0]


@pytest.mark.parametrize("what", ["status", "speed"])
def test_one_witness_of_standstill_is_not_enough(world, what):
    change = {"standstill": False} if what == "status" else {"speed_rad_s": 0.3}
    here = world(FakeDrive(misbehave=lambda drive, sample: sample._replace(**change)))
    here.turn(5.0)
    report = here.stop_sequence().run()
    assert not report.confirmed
    assert not report.disabled
    assert "not seen at rest" in report.trouble[-1]
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


def test_a_mode_that_never_comes_does_not_keep_the_quick_stop_from_being_sent(world):
    here = world(FakeDrive(quick_stop_in_torque_mode=False, misbehave=lambda drive, s: s._replace(mode=None)))
    here.drive.state = here.drive.wish = PowerState.ENABLED
    here.drive.speed = 3.0
    report = here.stop_sequence().run()
    assert report.confirmed
    assert here.drive.calls.index("quick_stop") == pytest.approx(0.5 / here.bench.period_s, abs=1)


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


@pytest.mark.parametrize("misbehave", [lost, lambda drive, sample: sample._replace(fresh=False)], ids=["dead", "stale"])
def test_a_drive_that_can_not_be_reached_is_given_up_and_left_to_its_watchdog(world, misbehave):
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
def test_a_longer_gap_in_the_feedback_begins_the_wait_anew(world, missing_s, anew):
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
    """At 10 Hz, again and again: some frames are lost for each that comes."""
    here = world(FakeDrive(period_s=0.1))
    here.turn(1.0)
    here.drive.misbehave = lambda drive, sample: sample._replace(fresh=drive.cycles % (missing + 1) == 0)
    assert here.stop_sequence().run().confirmed is confirmed


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
def test_a_request_that_the_drive_does_not_take_at_first_is_made_again(world, method, times):
    """The contract lets every method of a drive raise."""
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
def test_a_request_that_is_never_taken_ends_in_a_report_all_the_same(world, method):
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


def test_it_runs_once_and_a_second_call_gives_the_first_report(world):
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
def test_a_drive_in_fault_is_at_rest_when_its_shaft_is(world, speed):
    here = world()
    here.turn(5.0)
    here.drive.speed = speed
    here.drive.fault()
    report = here.stop_sequence().run()
    assert report.confirmed
    assert here.drive.disabled_at == []
    assert here.drive.state is PowerState.FAULT
    assert here.drive.speed == 0.0


def test_a_faulted_drive_whose_shaft_goes_on_turning_is_not_confirmed(world):
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


# -- what is raised on the way -------------------------------------------------------------------------------------


@pytest.mark.parametrize("error", [KeyboardInterrupt(), SystemExit(3), MemoryError()])
@pytest.mark.parametrize("where", ["exchange", "quick_stop", "disable"])
def test_an_interrupt_in_any_call_does_not_end_it(world, error, where):
    here = world()
    here.turn(5.0)
    plain, left = getattr(here.drive, where), [3]

    def interrupted(*arguments):
        if left[0]:
            left[0] -= 1
            raise error
        return plain(*arguments)

    setattr(here.drive, where, interrupted)
    report = here.stop_sequence().run()
    assert report.confirmed
    assert here.drive.disabled_at == [0.0]
    assert report.trouble == tuple([str(error) or type(error).__name__] * 3)


@pytest.mark.parametrize("times", [1, MOST_INTERRUPTIONS - 1])
def test_an_interrupt_between_the_calls_begins_it_anew(world, times):
    """A second Ctrl-C can strike anywhere, in the sequence's own lines too."""
    here = world()
    here.turn(5.0)
    sequence = here.stop_sequence()
    plain, left = sequence._stays_at_rest, [times]

    def struck():
        if left[0]:
            left[0] -= 1
            raise KeyboardInterrupt
        return plain()

    sequence._stays_at_rest = struck
    report = sequence.run()
    assert report.confirmed
    assert report.trouble == ("KeyboardInterrupt",) * times
    assert here.drive.disabled_at == [0.0]


def test_an_interrupt_that_never_ends_is_reported(world):
    here = world()
    here.turn(5.0)
    sequence = here.stop_sequence()

    def struck():
        raise KeyboardInterrupt

    sequence._decelerate = struck
    report = sequence.run()
    assert (report.confirmed, report.disabled, report.at_rest_s) == (False, False, None)
    assert report.trouble == ("KeyboardInterrupt",) * MOST_INTERRUPTIONS
    assert "disable" not in here.drive.calls


def test_it_is_not_begun_a_second_time_from_inside_itself(world):
    here = world()
    here.turn(5.0)
    sequence, inner = here.stop_sequence(), []
    here.display.on_cycle = lambda *_: inner.append(sequence.run())
    report = sequence.run()
    assert report.confirmed
    assert {(one.confirmed, one.trouble) for one in inner} == {(False, ("the stop sequence is under way already",))}
    assert asked(here.drive) == ["quick_stop", "disable"]
    assert sequence.run() is report


def test_troubles_are_bounded(world):
    here = world()
    here.turn(5.0)
    here.drive.misbehave = lost
    assert len(here.stop_sequence().run().trouble) <= 21


def test_no_state_is_expected_any_more(world):
    here = world()
    here.turn(5.0)
    assert here.guard.expected is PowerState.ENABLED
    here.stop_sequence().run()
    assert here.guard.expected is None


# -- how long it is waited for -------------------------------------------------------------------------------------


def test_a_heavy_shaft_at_its_torque_limit_is_waited_for(world):
    """Ten times as long as the ramp: it gets slower all the while."""
    here = world(FakeDrive(brakes=False, coulomb=0.0, viscous=0.0))
    here.turn(5.0)
    here.drive.misbehave = lambda drive, sample: setattr(drive, "speed", max(0.0, drive.speed - 0.1 * PERIOD_S)) or (
        sample._replace(standstill=drive.speed == 0.0))
    start_s = here.bench.now_s
    report = here.stop_sequence().run()
    assert report.confirmed, report.trouble
    assert report.at_rest_s - start_s == pytest.approx(5.0 / 0.1 + 3.0 * LAG_S, abs=1.0)


def test_how_long_it_was_waited_for_is_said(world):
    here = world(FakeDrive(brakes=False))
    here.turn(5.0)
    here.drive.coulomb = here.drive.viscous = 0.0
    begun_s = here.bench.now_s
    report = here.stop_sequence().run()
    waited_s = here.bench.now_s - begun_s
    # 3·ω_max/a + 2·3·lag + 1
    assert waited_s == pytest.approx(3.0 * 10.0 / 2.0 + 6.0 * LAG_S + 1.0, abs=0.1)
    assert f"within {waited_s:.1f} s" in report.trouble[-1]


def test_cycles_without_feedback_count_as_time(world):
    here = world(FakeDrive(brakes=False))
    here.turn(5.0)
    here.drive.coulomb = here.drive.viscous = 0.0
    begun, begun_s = here.drive.cycles, here.bench.now_s
    here.drive.misbehave = lambda drive, sample: sample._replace(fresh=(drive.cycles - begun) % 3 == 0)
    here.stop_sequence().run()
    assert here.bench.now_s - begun_s == pytest.approx(19.0, abs=0.2)


# -- once its torque is off ----------------------------------------------------------------------------------------


def when_off(drive, speeds):
    """A misbehaviour: what the shaft shows from the moment it is disabled on, a value a second; then the last."""
    since = []

    def change(_, sample):
        if sample.state is not PowerState.OFF:
            return sample
        since.append(sample.time_s)
        speed = speeds[min(int(sample.time_s - since[0]), len(speeds) - 1)]
        return sample._replace(fresh=False) if speed is None else sample._replace(speed_rad_s=speed)

    drive.misbehave = change
    return since


def test_a_shaft_that_begins_to_turn_once_it_is_disabled_is_told_and_watched(world):
    here = world()
    here.turn(5.0)
    since = when_off(here.drive, [0.0, 0.4, 0.2, -0.1, 0.0])
    report = here.stop_sequence().run()
    assert report.confirmed
    assert len(report.trouble) == 1
    assert "began to turn (0.400 rad/s) once its torque was off" in report.trouble[0]
    assert since[-1] - since[0] == pytest.approx(4.0 + 3.0 * LAG_S, abs=0.1)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_shaft_that_goes_on_turning_once_it_is_disabled_is_not_confirmed(world, sign):
    here = world()
    here.turn(5.0)
    since = when_off(here.drive, [sign * 0.4])
    report = here.stop_sequence().run()
    assert report.disabled
    assert report.at_rest_s is not None
    assert report.confirmed is False
    assert "began to turn" in report.trouble[-1]
    assert since[-1] - since[0] == pytest.approx(REST_AFTER_S, abs=0.1)


def test_a_shaft_at_rest_is_watched_for_as_long_as_reports_may_lag(world):
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
    assert report.confirmed            # it was seen at rest, and disabled
    assert "nothing was heard" in report.trouble[-1]
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


def test_without_any_trouble_to_name_it_is_as_loud():
    assert "no standstill seen" in str(not_confirmed(StopReport(False, None, False)))


def test_speed_feedback_that_is_no_number_is_no_standstill(world):
    here = world(FakeDrive(misbehave=lambda drive, sample: sample._replace(speed_rad_s=float("nan"))))
    here.drive.state = here.drive.wish = PowerState.ENABLED
    report = here.stop_sequence().run()
    assert not report.confirmed
    assert "disable" not in here.drive.calls


def test_silence_is_told(world):
    here = world()
    here.turn(5.0)
    here.drive.misbehave = lambda drive, sample: sample._replace(fresh=False)
    assert here.stop_sequence().run().trouble == ("no feedback from the drive any more",)
