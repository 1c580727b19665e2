"""Comparison of the reported angle and speed, without a drive."""

import math

import pytest

from drivers.drive import Mode, PositionReading, PowerState, Sample
from tdhil.runner.speed_check import Angles

SPEED_RAD_S, PERIOD_S, COUNT_RAD = 5.0, 0.04, 2.0 * math.pi / 8192


def sample(time_s):
    return Sample(time_s, 0.0, 0.0, True, SPEED_RAD_S, 0.0, None, Mode.SPEED, PowerState.ENABLED, False, False, 0)


def compared(late_s, *, factor=1.0, half_width_s=0.001, seconds=4.0):
    """Return the result after this time. ``late_s(cycle)``: delay between a sample and the reading of its angle."""
    angles = Angles()
    for cycle in range(round(seconds / PERIOD_S)):
        time_s = cycle * PERIOD_S
        angles.saw(sample(time_s))
        read_s = time_s + late_s(cycle)
        angle = COUNT_RAD * math.floor(factor * SPEED_RAD_S * read_s / COUNT_RAD)
        angles.read(PositionReading(read_s, half_width_s, angle, None, "6064h"), SPEED_RAD_S)
    return angles.ratio()


@pytest.mark.parametrize("late", [
    lambda cycle: 0.0, lambda cycle: 0.02, lambda cycle: 0.3 if cycle > 95 else 0.0, lambda cycle: 0.004 * cycle,
], ids=["never", "always", "at the end", "more and more"])
@pytest.mark.parametrize("factor", [1.0, 2.0, 0.5])
def test_a_host_that_was_late_sees_the_same_ratio(late, factor):
    """The shaft turns between a sample and the later reading of the angle."""
    assert compared(late, factor=factor).value == pytest.approx(factor, rel=0.005)


def test_an_uncertainty_of_time_is_one_of_the_ratio():
    sharp, dull = compared(lambda cycle: 0.0), compared(lambda cycle: 0.0, half_width_s=0.01)
    assert dull.half_width > sharp.half_width + 0.004
    assert compared(lambda cycle: 0.0, half_width_s=0.2) is None


def test_an_angle_that_moves_without_reported_speed_has_a_ratio():
    angles, backwards = Angles(), Angles()
    for cycle in range(100):
        time_s = cycle * PERIOD_S
        for found, sign in ((angles, 1.0), (backwards, -1.0)):
            found.saw(Sample(time_s, 0.0, 0.0, True, 0.0, 0.0, None, Mode.SPEED, PowerState.ENABLED, False, False, 0))
            angle = COUNT_RAD * math.floor(sign * SPEED_RAD_S * time_s / COUNT_RAD)
            found.read(PositionReading(time_s, 0.001, angle, None, "6064h"), SPEED_RAD_S)
    assert angles.ratio().value == backwards.ratio().value == pytest.approx(1000.0)
