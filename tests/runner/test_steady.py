"""Conditions of a steady speed, and the operating point from it."""

import numpy as np
import pytest

from drivers.drive import Command, Mode, PowerState, Sample
from drivers.errors import CommunicationLost, LimitHit
from tdhil.runner.stages.steady import approaching_s, steady_level, trace, wait_until_steady
from tests.runner.fake_drive import FakeDrive


def sample(time_s, speed, torque, fresh=True):
    return Sample(time_s, 0.0, 0.0, fresh, speed, torque, None, Mode.SPEED, PowerState.ENABLED, False, False, 0)


def test_a_trace_holds_the_fresh_samples_only():
    found = trace([sample(0.0, 1.0, 10.0), sample(1.0, 9.0, 90.0, fresh=False), sample(2.0, 3.0, 30.0)])
    assert found.time_s.tolist() == [0.0, 2.0]
    assert found.speed_rad_s.tolist() == [1.0, 3.0]
    assert found.torque_nm.tolist() == [10.0, 30.0]


def test_no_samples_give_an_empty_trace():
    assert trace([]).time_s.shape == (0,)


def test_a_level_is_the_mean_and_scatter_between_its_first_and_last_sample():
    level = steady_level([sample(1.0, 2.0, 10.0), sample(2.0, 4.0, 14.0), sample(3.0, 99.0, 99.0, fresh=False)])
    assert (level.level.start_s, level.level.end_s) == (1.0, 2.0)
    assert (level.speed_rad_s, level.torque_nm) == (3.0, 12.0)
    assert (level.speed_sd_rad_s, level.torque_sd_nm) == (1.0, 2.0)


def test_four_good_blocks_in_a_row_count_as_steady(world):
    here = world()
    here.turn(4.0)
    seen = wait_until_steady(here.bench, Command(Mode.SPEED, 4.0, 0.0), 4.0, 0.05, timeout_s=60.0)
    assert len(seen) * here.bench.period_s == pytest.approx(4 * 0.5)


def test_a_bad_block_restarts_the_count(world):
    here = world()
    here.turn(4.0)
    first = here.drive.cycles

    def stumble(drive, seen):
        third_block = 50 <= drive.cycles - first < 75
        return seen._replace(speed_rad_s=5.0) if third_block else seen

    here.drive.misbehave = stumble
    seen = wait_until_steady(here.bench, Command(Mode.SPEED, 4.0, 0.0), 4.0, 0.05, timeout_s=60.0)
    assert len(seen) * here.bench.period_s == pytest.approx(7 * 0.5)


def test_a_speed_that_does_not_settle_is_a_limit_hit(world):
    here = world(FakeDrive(follow_s=1e9))
    here.turn(4.0)
    with pytest.raises(LimitHit, match=r"did not settle at 6\.000 rad/s within 5 s"):
        wait_until_steady(here.bench, Command(Mode.SPEED, 6.0, 0.0), 6.0, 0.05, timeout_s=5.0)


def test_lost_feedback_ends_the_wait(world):
    here = world()
    here.turn(4.0)
    here.drive.misbehave = lambda drive, seen: seen._replace(fresh=False)
    with pytest.raises(CommunicationLost):
        wait_until_steady(here.bench, Command(Mode.SPEED, 4.0, 0.0), 4.0, 0.05, timeout_s=60.0)


def test_a_loop_with_little_integral_gain_is_named_with_its_time_constant(world):
    """P 300, I 2: friction leaves an error that decays slowly. The approach at the end of a run would take as long."""
    here = world(FakeDrive(follow_s=1e9))
    here.turn(4.0)
    first = here.drive.cycles
    here.drive.misbehave = lambda drive, seen: seen._replace(
        speed_rad_s=4.0 - 0.3 * np.exp(-(drive.cycles - first) * here.bench.period_s / 150.0))
    with pytest.raises(LimitHit, match=r"time constant of 1(4|5)\d s") as refused:
        wait_until_steady(here.bench, Command(Mode.SPEED, 4.0, 0.0), 4.0, 0.05, timeout_s=60.0)
    assert "Raise the integral gain about 7 times" in refused.value.next_step or "8 times" in refused.value.next_step
    assert "minutes to bring the shaft to standstill" in refused.value.next_step


@pytest.mark.parametrize("course", [
    np.full(120, 2.7), 2.7 - 0.001 * np.arange(120), 0.02 * np.arange(120), 3.0 + 0.2 * (-1.0) ** np.arange(120)])
def test_a_speed_with_a_constant_error_is_no_slow_approach(course):
    assert approaching_s(course, 3.0) is None


def test_the_time_constant_of_an_approach_from_either_side():
    decay = 0.3 * np.exp(-0.5 * np.arange(120) / 80.0)
    assert approaching_s(3.0 - decay, 3.0) == pytest.approx(80.0, rel=1e-6)
    assert approaching_s(3.0 + decay, 3.0) == pytest.approx(80.0, rel=1e-6)
