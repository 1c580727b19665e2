"""Comparison of angle and reported speed, on a shaft with a true angle in closed form."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.drive import Mode, PositionReading, PowerState, Sample
from tdhil.runner.speed_check import Angles

PERIOD_S, EVERY = 0.004, 15
WIDTHS = (None, 2.0 * math.pi, 65536 * 2.0 * math.pi / 4096)


def sample(time_s, speed_rad_s, fresh=True):
    return Sample(
        time_s, 0.0, 0.0, fresh, speed_rad_s, 0.0, None, Mode.SPEED, PowerState.ENABLED, False, False, 0x27
    )


def watched(factor, counts_per_turn, wraps_rad, seconds=6.0, speed_rad_s=1.0, swing=0.3, lost=0.0):
    """Watch a shaft. ``factor``: true over reported speed. ``swing``: relative amplitude of its variation."""
    angles, count = Angles(), 2.0 * math.pi / counts_per_turn
    for k in range(round(seconds / PERIOD_S)):
        time_s = k * PERIOD_S
        reported = speed_rad_s * (1.0 + swing * math.sin(5.0 * time_s))
        angles.saw(sample(time_s, reported, fresh=lost == 0.0 or k % round(1.0 / lost) != 0))
        if k % EVERY == 0:
            way = speed_rad_s * (time_s + swing * (1.0 - math.cos(5.0 * time_s)) / 5.0)
            angle = math.floor(factor * way / count) * count
            if wraps_rad is not None:
                angle %= wraps_rad
            angles.read(PositionReading(time_s, 0.0, angle, wraps_rad, "6064h"), speed_rad_s)
    return angles


@pytest.mark.heavy
@given(st.floats(0.05, 11.0), st.booleans(), st.sampled_from([512, 4096, 1 << 20]), st.sampled_from(WIDTHS),
       st.floats(0.0, 0.4), st.sampled_from([0.0, 0.1]))
def test_the_factor_is_found(factor, backwards, counts, wraps_rad, swing, lost):
    factor = -factor if backwards else factor
    ratio = watched(factor, counts, wraps_rad, swing=swing, lost=lost).ratio()
    assert ratio is not None
    assert ratio.value == pytest.approx(factor, rel=0.035)


@pytest.mark.heavy
@given(st.floats(0.2, 10.0))
def test_a_counter_of_turns_needs_some_turns_and_is_then_right(factor):
    seconds = 3.2 * 2.0 * math.pi / factor
    ratio = watched(factor, 1, None, seconds=seconds + 2.0, swing=0.0).ratio()
    assert ratio is None or ratio.value == pytest.approx(factor, rel=0.07)
    assert watched(factor, 1, None, seconds=40.0 / factor + 4.0, swing=0.0).ratio() is not None


def test_the_factor_is_not_reported_too_early():
    assert watched(1.0, 4096, None, seconds=1.5).ratio() is None


def test_a_constant_angle_is_reported_after_more_than_one_turn():
    assert watched(0.0, 4096, None, seconds=6.0).ratio() is None          # it could be a counter of turns
    assert watched(0.0, 4096, None, seconds=9.0).ratio().value == 0.0


def test_an_angle_that_restarts_too_often_gives_no_factor():
    angles = watched(1.0, 4096, 2.0 * math.pi, speed_rad_s=20.0)
    assert angles.blind
    assert angles.ratio() is None
    assert angles.speed_rad_s() is None


@pytest.mark.heavy
@given(st.floats(0.5, 10.0))
def test_the_speed_of_the_angle_is_between_its_bounds(factor):
    low, high = watched(factor, 4096, None, swing=0.0).speed_rad_s()
    assert low <= factor <= high
    assert high - low < 0.45 * factor          # at a steady speed a count looks like a step
