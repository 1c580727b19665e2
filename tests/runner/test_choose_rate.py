"""Choice of the cycle rate: tests with real cycles, from the highest rate down, before any motion."""

import signal

import pytest

from drivers.drive import Command, Mode, Paced
from tdhil.errors import Interrupted
from tdhil.runner.preconditions import CYCLES, WARM_UP, choose_rate
from tests.runner.fake_drive import FakeDrive

REST = Command(Mode.SPEED, 0.0, 0.0)
RATES = (250.0, 200.0, 125.0, 100.0, 50.0, 25.0)


class PacedDrive(FakeDrive):
    """Drive whose cycles begin ``late(rate, cycle)`` seconds late. Cycles of ``deaf`` get no answer."""

    def __init__(self, late=lambda rate, cycle: 0.0, deaf=lambda rate, cycle: False, rates=RATES):
        super().__init__()
        self.clock.stepped = False
        self.rates_hz, self.began_late_s = rates, 0.0
        self.set, self.tried = [], {}
        self.late, self.deaf = late, deaf

    def set_rate(self, rate_hz, *, measuring=False):
        self.calls.append("set_rate")
        self.set.append((rate_hz, measuring))
        self.period_s, self.count = 1.0 / rate_hz, 0

    def exchange(self, command):
        rate = round(1.0 / self.period_s)
        cycle, self.count = getattr(self, "count", 0), getattr(self, "count", 0) + 1
        self.tried[rate] = self.count
        self.began_late_s = self.late(rate, cycle)
        return super().exchange(command)._replace(fresh=not self.deaf(rate, cycle))


def chosen(drive):
    return choose_rate(drive, drive.rates_hz, lambda: drive.exchange(REST))


def test_a_quiet_computer_holds_the_profiles_rate():
    drive = PacedDrive(lambda rate, cycle: 1e-4)
    assert isinstance(drive, Paced)
    choice = chosen(drive)
    assert drive.set == [(250.0, True), (250.0, False)]
    assert drive.tried == {250: CYCLES + WARM_UP}
    assert choice.text == (
        "250 cycles per second: this computer sustains them (p99.9 of 0.1 ms in 1000 cycles; --rate overrides)"
    )


@pytest.mark.parametrize(("late_s", "rate"), [(0.0019, 250), (0.0021, 200), (0.003, 125), (0.0045, 100), (0.0099, 50),
                                              (0.019, 25), (1.0, 25)])
def test_the_highest_rate_whose_half_period_is_longer_than_the_delay(late_s, rate):
    """Every hundredth cycle is late by this delay, so that the 99th percentile contains it."""
    drive = PacedDrive(lambda rate, cycle: late_s if cycle % 97 == 96 else 0.0)
    choice = chosen(drive)
    assert choice.taken.rate_hz == rate == drive.set[-1][0]
    assert drive.set[-1] == (rate, False)
    assert choice.taken.holds is (late_s < 1.0)
    assert ("instead of the profile's 250" in choice.text) is (rate < 250 and late_s < 1.0)
    assert ("does not sustain" in choice.text) is (rate < 250)


def test_one_late_cycle_in_a_thousand_is_accepted_and_a_second_is_not():
    assert chosen(PacedDrive(lambda rate, cycle: 0.5 * (cycle == 500))).taken.rate_hz == 250.0
    assert chosen(PacedDrive(lambda rate, cycle: 0.5 * (rate == 250 and cycle in (500, 900)))).taken.rate_hz == 200.0


def test_the_first_cycles_do_not_count():
    assert chosen(PacedDrive(lambda rate, cycle: 0.5 * (cycle < WARM_UP))).taken.rate_hz == 250.0


def test_a_line_that_does_not_answer_in_time_is_too_fast_as_well():
    choice = chosen(PacedDrive(deaf=lambda rate, cycle: rate > 100 and cycle % 3 == 0))
    assert choice.taken.rate_hz == 100.0
    assert all(one.cycles < 10 for one in choice.tried[:3])      # the attempt ends as soon as the result is clear


@pytest.mark.heavy
def test_the_runner_tries_before_motion_and_goes_on_at_that_rate(world):
    drive = PacedDrive(lambda rate, cycle: 0.015 * (rate > 25 and cycle % 50 == 49), rates=(50.0, 25.0))
    drive.period_s = 0.02
    here = world(drive)
    said = []

    def enough(drive, sample):
        if "enable torque" in drive.calls:
            here.stop_request.ask(signal.SIGINT)
        return sample

    drive.misbehave = enough
    here.runner(say=said.append).run()
    assert here.drive.period_s == 0.04
    calls = drive.calls
    assert calls.index("preflight") < calls.index("set_rate")
    assert max(k for k, call in enumerate(calls) if call == "set_rate") < calls.index("enable torque")
    (line,) = [line for line in said if "cycles per second" in line]
    assert line.startswith("25 cycles per second (p99.9 of")
    assert ("rate", line) in here.log.events
    assert [one["rate_hz"] for one in here.log.run["rate_tried"]] == [50.0, 25.0]
    assert here.log.run["cycle"]["rate_hz"] == 25.0


def test_a_stated_rate_is_used(world):
    drive = PacedDrive(lambda rate, cycle: 1.0, rates=())
    here = world(drive)
    here.stop_request.ask(signal.SIGINT)
    here.runner().run()
    assert "set_rate" not in drive.calls


@pytest.mark.heavy
def test_ctrl_c_ends_the_choice_of_the_rate(world):
    drive = PacedDrive()
    here = world(drive)
    drive.misbehave = lambda drive, sample: here.stop_request.ask(signal.SIGINT) or sample
    result = here.runner().run()
    assert isinstance(result.cause, Interrupted)
    assert drive.cycles == 1
    assert result.stop is None
