"""Control time."""

import pytest

from drivers.clock import MonotonicClock, SteppedClock


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


def test_how_late_a_wait_came_back(fake_time):
    clock = MonotonicClock()
    fake_time.sleep(3.0)
    assert clock.wait_until(1.0) == pytest.approx(2.0)
    assert clock.now_s() == pytest.approx(3.0)


def test_the_wall_clock_plays_no_part(monkeypatch):
    import time

    clock = MonotonicClock()
    monkeypatch.setattr(time, "time", lambda: -1e9)
    assert 0.0 <= clock.now_s() < 1e6
