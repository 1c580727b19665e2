"""Stop without cyclic feedback: polls show standstill, and tdhil never disables a turning shaft because of a poll."""

from dataclasses import dataclass, replace

import pytest

from drivers.drive import Mode, PowerState
from drivers.errors import CommandRejected, CommunicationLost
from tdhil.runner.feedback_polls import AFTER_S, EVERY_S, SLOWING_S, FeedbackPolls, Slowing
from tdhil.runner.settings import ControlAssumptions
from tdhil.runner.stop import (
    MODE_S,
    REST_AFTER_S,
    SILENT_S,
    UNMOVED_S,
)
from tests.runner.fake_drive import LIMITS, PERIOD_S, FakeDrive
from tests.runner.string_drive import StringDrive, StringWorld

SETTLE_S = 3.0 * ControlAssumptions().largest_speed_lag_s


@dataclass
class LookedAt(FakeDrive):
    """Drive that answers polls; ``gone``: the fault of the cyclic feedback."""

    polls: int = 0
    answers: bool = True
    raises: BaseException | None = None
    gone: str = ""

    def __post_init__(self):
        self.misbehave = self._report
        self._frozen = None

    def _report(self, drive, sample):
        if self.gone == "missing":
            return sample._replace(fresh=False)
        if self.gone == "error":
            raise CommunicationLost("no statusword")
        if self.gone == "frozen":
            self._frozen = self._frozen or sample
            return self._frozen._replace(time_s=sample.time_s)
        return sample

    def poll(self):
        self.polls += 1
        if self.raises is not None:
            raise self.raises
        return self.report() if self.answers else None


def stopped(world, gone, speed=5.0, **options):
    here = world(LookedAt(**options))
    here.turn(speed)
    here.drive.gone = gone
    return here, here.stop_sequence().run()


@pytest.mark.parametrize("gone", ["missing", "error"])
@pytest.mark.parametrize("speed", [0.0, 5.0])
def test_without_feedback_polls_confirm_standstill(world, gone, speed):
    here, report = stopped(world, gone, speed)
    assert report.confirmed and report.disabled
    assert here.drive.disabled_at == [0.0]
    assert any("the drive was polled instead" in line for line in report.trouble)
    # Ramp, settling, disabling and settling again. Polls are at least EVERY_S apart.
    took_s = speed / 2.0 + 2.0 * SETTLE_S
    assert here.drive.polls <= took_s / EVERY_S + 10


def test_without_feedback_in_torque_mode_polls_confirm_the_quick_stop(world):
    """The profile does not state that a quick stop brakes in torque mode, and no report shows the mode."""
    here = world(LookedAt(quick_stop_in_torque_mode=False))
    here.turn(3.0, Mode.TORQUE)
    here.drive.gone = "missing"
    begun_s = here.bench.now_s
    asked_s = []
    here.drive.quick_stop = lambda stop=here.drive.quick_stop: (asked_s.append(here.bench.now_s), stop())
    report = here.stop_sequence().run()
    assert report.confirmed and report.disabled and here.drive.polls > 10
    assert asked_s[0] - begun_s < MODE_S + 0.1
    assert not report.stayed_in_torque_mode


@pytest.mark.parametrize("mode", [Mode.SPEED, Mode.TORQUE])
def test_without_feedback_above_a_string_polls_confirm_standstill(mode):
    class PolledString(StringDrive):
        def poll(self):
            self.polls = getattr(self, "polls", 0) + 1
            return self.report()

    here = StringWorld(speed=3.0, mode=mode)
    here.drive.__class__ = PolledString
    here.drive.misbehave = lambda drive, sample: sample._replace(fresh=False)
    report = here.stop_sequence().run()
    assert here.drive.polls > 10
    assert report.at_rest_s is not None, report.trouble


def test_a_shaft_that_brakes_on_a_slow_ramp_is_not_left_to_the_watchdog(world):
    """150 rad/s at 2 rad/s²: in one second the speed falls by 1.3 %."""
    here = world(LookedAt(viscous=0.0), replace(LIMITS, speed_max_rad_s=160.0, quick_stop_rad_s2=2.0))
    here.turn(150.0)
    here.drive.gone = "missing"
    report = here.stop_sequence().run()
    assert report.confirmed, report.trouble


def test_a_shaft_without_torque_is_not_left_to_a_watchdog(world):
    """A string may hold up its speed for seconds, and no watchdog of a drive without torque acts."""
    here = world(LookedAt(viscous=0.0, coulomb=0.0))
    here.turn(3.0)
    here.drive.gone = "missing"
    here.drive.state = here.drive.wish = PowerState.OFF
    begun_s = here.bench.now_s
    report = here.stop_sequence().run()
    assert not report.confirmed and not any("left alone" in line for line in report.trouble)
    assert here.bench.now_s - begun_s > 2.0 * (AFTER_S + SLOWING_S)


def test_a_poll_that_contradicts_the_cycle_is_repeated_after_a_standstill_and_reported_once(world):
    @dataclass
    class Stuck(LookedAt):
        def poll(self):
            self.polls += 1
            return self.report()._replace(speed_rad_s=1.0)

    here = world(Stuck())
    here.turn(0.0)
    begun_s = here.bench.now_s
    report = here.stop_sequence().run()
    assert not report.confirmed
    assert here.drive.polls <= (here.bench.now_s - begun_s) / SETTLE_S + 2
    assert sum("a single request" in line for line in report.trouble) == 1


def test_a_polled_speed_of_zero_that_the_angle_contradicts_is_no_standstill(world):
    """The shaft brakes to 0.5 rad/s and continues to turn. The reported speed is always 0.5 rad/s too low."""

    class Low(LookedAt):
        turned_rad = 0.0

        def _move(self, command):
            super()._move(command)
            self.speed = max(0.5, self.speed)
            self.turned_rad += self.speed * PERIOD_S

        def report(self):
            low = self.speed - 0.5
            return super().report()._replace(speed_rad_s=low, position_rad=self.turned_rad, standstill=low == 0.0)

    here = world(Low())
    here.turn(5.0)
    here.drive.gone = "missing"
    report = here.stop_sequence().run()
    assert not report.confirmed and all(speed == 0.0 for speed in here.drive.disabled_at)


def test_polls_of_which_one_in_three_is_answered_confirm_standstill(world):
    """The host was late and the watchdog has tripped. The drive sends no frames and answers every third poll."""

    class Late(LookedAt):
        def poll(self):
            self.answers = self.polls % 3 == 2
            return super().poll()

    here = world(Late())
    here.turn(5.0)
    here.drive.gone = "missing"
    report = here.stop_sequence().run()
    assert report.confirmed and here.drive.disabled_at == [0.0]


def test_with_cyclic_feedback_one_poll_is_enough(world):
    here = world(LookedAt(misbehave=None))
    here.turn(5.0)
    assert here.stop_sequence().run().confirmed
    assert here.drive.polls == 1       # one, before the drive is disabled


@pytest.mark.parametrize("options", [
    {"answers": False}, {"raises": CommunicationLost("gone")}, {"raises": RuntimeError("what?")},
    {"raises": KeyboardInterrupt()},
])
@pytest.mark.parametrize("gone", ["missing", "error"])
def test_unanswered_polls_do_not_delay_the_end_of_the_stop(world, gone, options):
    here = world(LookedAt(**options))
    here.turn(5.0)
    here.drive.gone = gone
    begun_s = here.bench.now_s
    report = here.stop_sequence().run()
    assert not report.confirmed and report.at_rest_s is None
    assert "disable" not in here.drive.calls
    assert here.bench.now_s - begun_s <= SILENT_S + 2 * PERIOD_S
    assert 1 <= here.drive.polls <= 5


def test_a_shaft_that_turns_by_its_polls_is_left_to_the_watchdog_soon(world):
    here = world(LookedAt(brakes=False))
    here.turn(5.0)
    here.drive.coulomb = here.drive.viscous = 0.0
    here.drive.gone = "missing"
    begun_s = here.bench.now_s
    report = here.stop_sequence().run()
    assert not report.confirmed
    assert "own watchdog" in report.trouble[-1]
    assert "disable" not in here.drive.calls and here.drive.disabled_at == []
    assert here.bench.now_s - begun_s <= AFTER_S + SLOWING_S + 3.0 * EVERY_S


def test_without_an_effective_watchdog_the_host_continues_the_quick_stop(world):
    """The drive takes the quick stop only after some time. No watchdog would stop the shaft."""

    class Late(LookedAt):
        def poll(self):
            self.brakes = self.polls > 20
            return super().poll()

    here = world(Late(brakes=False))
    here.turn(5.0)
    here.drive.coulomb = here.drive.viscous = 0.0
    here.drive.gone = "missing"
    report = here.stop_sequence(watched=False).run()
    assert report.confirmed
    assert here.drive.disabled_at == [0.0]


def test_a_shaft_that_coasts_to_standstill_is_waited_for(world):
    here = world(LookedAt(brakes=False))
    here.turn(5.0)
    here.drive.gone = "missing"
    report = here.stop_sequence().run()
    assert report.confirmed
    assert here.drive.disabled_at == [0.0]


def test_frozen_feedback_that_a_poll_contradicts_is_rejected(world):
    here, report = stopped(world, "frozen")
    assert report.confirmed
    assert here.drive.disabled_at == [0.0]
    assert any("no longer counts" in line for line in report.trouble)


@pytest.mark.parametrize("options", [{"brakes": False}, {"answers": False}, {"raises": CommunicationLost("gone")}])
def test_frozen_feedback_without_a_contradicting_poll_is_no_standstill(world, options):
    here = world(LookedAt(**options))
    here.turn(5.0)
    here.drive.coulomb = here.drive.viscous = 0.0
    here.drive.gone = "frozen"
    report = here.stop_sequence().run()
    assert not report.confirmed
    assert "disable" not in here.drive.calls


def test_feedback_that_is_lost_after_standstill_was_seen(world):
    """Only polls show that the drive is disabled and that the shaft stays at standstill."""
    here = world(LookedAt())
    here.turn(2.0)
    disable = here.drive.disable

    def gone_by_now():
        here.drive.gone = "missing"
        disable()

    here.drive.disable = gone_by_now
    begun_s = here.bench.now_s
    report = here.stop_sequence().run()
    assert report.confirmed
    assert here.bench.now_s - begun_s < 1.0 + SETTLE_S + REST_AFTER_S
    assert here.drive.polls >= SETTLE_S / EVERY_S - 2


@pytest.mark.parametrize("period_s", [0.004, 0.02, 0.2])
def test_polls_are_due_by_time(period_s):
    drive = LookedAt()
    drive.mode = Mode.SPEED
    polls = FeedbackPolls(drive, period_s)
    for _ in range(round(2.0 / period_s)):
        polls.missed()
    assert drive.polls <= (2.0 - AFTER_S) / max(EVERY_S, period_s) + 2
    assert drive.polls >= (2.0 - AFTER_S) / max(EVERY_S, period_s) - 2
    polls.heard()
    assert not polls.standing
    assert polls.missed() is None or period_s >= AFTER_S


@dataclass
class DrivenOn(FakeDrive):
    """Drive that another master keeps at ``driven`` rad/s, until the watchdog trips after the end of feeding."""

    driven: float | None = 5.0
    watchdog_s: float = 0.5
    unfed_since_s: float | None = None
    refuses: int = 0
    rejects: bool = False

    def stop_feeding(self):
        self.calls.append("stop_feeding")
        if self.rejects:
            raise CommandRejected("somebody else feeds it, too")
        if self.refuses:
            self.refuses -= 1
            raise CommunicationLost("busy")
        self.unfed_since_s = self.clock.now_s()

    def _move(self, command):
        unfed = self.unfed_since_s is not None and self.clock.now_s() - self.unfed_since_s > self.watchdog_s
        if unfed and self.state is not PowerState.FAULT:
            self.fault()
        super()._move(command)
        if self.driven is not None and self.state is not PowerState.FAULT:
            self.speed = self.driven


@pytest.mark.parametrize("refuses", [0, 3])
def test_a_shaft_that_somebody_drives_on_is_left_to_the_watchdog_and_watched(world, refuses):
    here = world(DrivenOn(driven=None, refuses=refuses))
    here.turn(5.0)
    here.drive.driven = 5.0
    begun_s = here.bench.now_s
    report = here.stop_sequence().run()
    assert here.drive.calls.count("stop_feeding") == 1 + refuses
    assert here.drive.unfed_since_s - begun_s == pytest.approx(UNMOVED_S, abs=0.2)
    assert report.confirmed and here.drive.speed == 0.0 and here.drive.disabled_at in ([], [0.0])
    assert any("sign of life was ended" in line for line in report.trouble)
    assert report.trouble.count("busy") == refuses


def test_the_stop_waits_for_a_slow_watchdog(world):
    """The host waits for the watchdog as long as for its own quick stop."""
    here = world(DrivenOn(driven=None, watchdog_s=14.0))
    here.turn(5.0)
    here.drive.driven = 5.0
    assert here.stop_sequence().run().confirmed


@pytest.mark.parametrize("read_by", ["polls", "nothing until the watchdog acts"])
def test_the_watch_does_not_end_before_a_slow_watchdog_acts(world, read_by):
    """Each request feeds the watchdog of a Modbus drive, so it is not read. The watch used to end after 1 s."""

    class NotReported(DrivenOn):
        def exchange(self, command):
            sample = super().exchange(command)
            return sample._replace(fresh=False) if self.unfed_since_s is not None and not self.tripped else sample

        @property
        def tripped(self):
            return self.state is PowerState.FAULT

    class Polled(NotReported):
        def poll(self):
            return self.report()

    kind = Polled if read_by == "polls" else NotReported
    here = world(kind(driven=None, watchdog_s=3.0), replace(LIMITS, watchdog_s=3.0))
    here.turn(5.0)
    here.drive.driven = 5.0
    report = here.stop_sequence().run()
    assert report.confirmed, report.trouble


def test_stop_feeding_is_requested_once_if_another_master_feeds_the_watchdog(world):
    here = world(DrivenOn(driven=None, rejects=True))
    here.turn(5.0)
    here.drive.driven = 5.0
    report = here.stop_sequence().run()
    assert not report.confirmed
    assert here.drive.calls.count("stop_feeding") == 1
    assert report.trouble[0] == "somebody else feeds it, too"
    assert not any("sign of life was ended" in line for line in report.trouble)


@pytest.mark.parametrize("options", [{"watched": False}, {}])
def test_feeding_continues_without_a_watchdog_or_without_stop_feeding(world, options):
    drive = DrivenOn(driven=None) if options else FakeDrive(brakes=False)
    here = world(drive)
    here.turn(5.0)
    drive.driven, drive.coulomb, drive.viscous = 5.0, 0.0, 0.0
    report = here.stop_sequence(**options).run()
    assert not report.confirmed and "stop_feeding" not in drive.calls


def test_a_watchdog_that_does_not_act_leaves_the_stop_unconfirmed(world):
    here = world(DrivenOn(driven=None, watchdog_s=1e9))
    here.turn(5.0)
    here.drive.driven = 5.0
    report = here.stop_sequence().run()
    assert not report.confirmed and report.at_rest_s is None
    assert here.drive.calls.count("stop_feeding") == 1 and "disable" not in here.drive.calls


@pytest.mark.parametrize("inertia", [100.0, 1500.0])
def test_the_watchdog_of_a_slowing_shaft_is_fed_to_the_end(world, inertia):
    """The shaft slows down on the ramp of the drive, or a heavy one by friction alone for more than a minute."""
    here = world(DrivenOn(driven=None, inertia=inertia, brakes=inertia < 1000.0))
    here.turn(9.0)
    report = here.stop_sequence().run()
    assert report.confirmed and "stop_feeding" not in here.drive.calls


@pytest.mark.heavy
def test_with_a_string_or_a_long_ramp_the_wait_for_a_slowing_shaft_is_longer(world):
    for limits in (replace(LIMITS, load="string", torque_ramp_nm_s=20.0), replace(LIMITS, quick_stop_rad_s2=0.1)):
        here = world(DrivenOn(driven=None), limits)
        here.turn(5.0)
        here.drive.driven = 5.0
        sequence, unfed = here.stop_sequence(), []
        here.drive.stop_feeding = lambda unfed=unfed, here=here: unfed.append(here.bench.now_s)
        quick_stop, begun = here.drive.quick_stop, []
        here.drive.quick_stop = lambda begun=begun, here=here, ask=quick_stop: (begun.append(here.bench.now_s), ask())
        sequence.run()
        assert unfed[0] - begun[0] == pytest.approx(10.0, abs=0.3)


def test_slowing():
    slowing = Slowing(0.05)
    assert all(slowing.see(0.1 * k, 5.0 * 0.97 ** (0.1 * k)) for k in range(100))
    assert all(slowing.see(10.0 + 0.1 * k, 0.04 * (-1) ** k) for k in range(100))
    assert not all(slowing.see(30.0 + 0.1 * k, 2.0) for k in range(12))
    slowing.reset()
    assert not all(slowing.see(32.0 + 0.1 * k, -2.0) for k in range(12))
    slowing.reset()
    assert slowing.see(40.0, 9.0)
    assert not slowing.see(41.0, float("nan"))


def test_a_drive_without_polls_is_not_polled():
    polls = FeedbackPolls(FakeDrive(), PERIOD_S)
    assert polls.ask() is None
    assert all(polls.missed() is None for _ in range(round(3.0 / PERIOD_S)))
    assert (polls.answered, polls.standing) == (0, True)
