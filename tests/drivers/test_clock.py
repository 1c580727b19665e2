"""Control time."""

import pytest

from drivers import clock as clock_module
from drivers.clock import MonotonicClock, SteppedClock, Ticks
from drivers.errors import CommunicationLost


def test_stepped_time_moves_by_waiting_only():
    clock = SteppedClock()
    assert clock.stepped
    assert clock.now_s() == clock.now_s() == 0.0
    assert clock.wait_until(1.25) == 0.0
    assert clock.now_s() == 1.25


def test_stepped_time_never_goes_back():
    clock = SteppedClock()
    clock.wait_until(2.0)
    assert clock.wait_until(1.0) == 0.0
    assert clock.now_s() == 2.0


def test_monotonic_time(fake_time):
    clock = MonotonicClock()
    assert not clock.stepped
    assert clock.now_s() == 0.0
    assert clock.wait_until(0.5) == 0.0
    assert clock.now_s() == pytest.approx(0.5)


def test_the_delay_of_a_wait(fake_time):
    clock = MonotonicClock()
    fake_time.sleep(3.0)
    assert clock.wait_until(1.0) == pytest.approx(2.0)
    assert clock.now_s() == pytest.approx(3.0)


def test_the_wall_clock_plays_no_part(monkeypatch):
    import time

    clock = MonotonicClock()
    monkeypatch.setattr(time, "time", lambda: -1e9)
    assert 0.0 <= clock.now_s() < 1e6


class SleepingComputer:
    """Module `time` of a computer that sleeps: only the named clock advances during the sleep."""

    def __init__(self, goes_on):
        self.names = ["CLOCK_MONOTONIC", "CLOCK_MONOTONIC_RAW", *{goes_on} - {"CLOCK_MONOTONIC_RAW"}]
        for number, name in enumerate(self.names):
            setattr(self, name, number)
        self.goes_on, self.awake_s, self.asleep_s = goes_on, 100.0, 0.0

    def clock_gettime(self, number):
        return self.awake_s + (self.asleep_s if self.names[number] == self.goes_on else 0.0)

    def monotonic(self):
        return self.awake_s

    def sleep(self, duration_s):
        self.awake_s += duration_s


@pytest.mark.parametrize(("platform", "goes_on"), [("linux", "CLOCK_BOOTTIME"), ("darwin", "CLOCK_MONOTONIC_RAW")])
def test_a_computer_that_slept_during_a_run_is_found(monkeypatch, platform, goes_on):
    computer = SleepingComputer(goes_on)
    monkeypatch.setattr(clock_module, "time", computer)
    monkeypatch.setattr(clock_module, "_now_s", clock_module._clock_with_sleep(platform))
    ticks = Ticks(MonotonicClock(), 0.004, 0.25)
    ticks.wait()
    computer.asleep_s += 3600.0
    with pytest.raises(CommunicationLost, match=r"stood still for 3600\.\d+ s"):
        ticks.wait()


def test_a_platform_without_such_a_clock_has_pythons_own(monkeypatch):
    class Plain:
        def monotonic(self):
            return 7.0

    monkeypatch.setattr(clock_module, "time", Plain())
    assert clock_module._clock_with_sleep("win32")() == 7.0
