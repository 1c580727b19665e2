"""Time that the stop sequence waits for standstill."""

import pytest

from tdhil.runner.stop import LONGEST_S, StopTimeout
from tests.runner.fake_drive import PERIOD_S, FakeDrive
from tests.runner.stop_calls import LAG_S


def test_a_heavy_shaft_at_its_torque_limit_is_waited_for(world):
    """It takes ten times as long as the ramp and slows down all the time."""
    here = world(FakeDrive(brakes=False, coulomb=0.0, viscous=0.0))
    here.turn(5.0)
    here.drive.misbehave = lambda drive, sample: setattr(drive, "speed", max(0.0, drive.speed - 0.1 * PERIOD_S)) or (
        sample._replace(standstill=drive.speed == 0.0))
    start_s = here.bench.now_s
    report = here.stop_sequence().run()
    assert report.confirmed, report.trouble
    assert report.at_rest_s - start_s == pytest.approx(5.0 / 0.1 + 3.0 * LAG_S, abs=1.0)


def test_the_duration_of_the_wait_is_reported(world):
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


def test_the_wait_for_a_coasting_shaft_is_bounded():
    patience = StopTimeout(5.0, 0.05)
    ended_s = {}
    while len(ended_s) < 2 and patience.waited_s < 2.0 * LONGEST_S:
        patience.see(0.0, 0.5)
        for coasts_s in (0.0, 1.0):
            if patience.ends(coasts_s):
                ended_s.setdefault(coasts_s, patience.waited_s)
    # Two blocks without a lower speed end the usual wait. Permanently missing feedback must not make it endless.
    assert ended_s[0.0] < 20.0
    assert ended_s[1.0] == pytest.approx(LONGEST_S, abs=1.0)
