"""Short cuts of the observer agree with its full comparison."""

import random
from collections import deque

import pytest

from tdhil.runner.excitation import RigGuess
from tdhil.runner.observer.momentum_balance import MomentumBalance
from tdhil.runner.observer.points import Point
from tdhil.runner.observer.position_way import ANGLE_WINDOW_S, PositionWay, Way
from tdhil.runner.observer.shaft_bounds import ShaftBounds
from tests.rigs import LIMITS

WAY = Way(0, 0.0, 1.0)


def test_if_the_torque_explains_the_slope_all_torques_together_explain_it(monkeypatch):
    rng = random.Random(3)
    short = full = 0
    for _ in range(300):
        known = ShaftBounds(LIMITS, 0.5)
        known.know(RigGuess(rng.uniform(20.0, 200.0), 8.0, 60.0, inertia_rel_error=rng.uniform(0.0, 0.5)))
        balance, points = MomentumBalance(LIMITS, 0.5, 0.04, 1.0), deque()
        for number in range(rng.choice((20, 120))):
            point = Point()
            point.time_s, point.speed = 0.04 * number, rng.uniform(-10.0, 10.0)
            point.slope = rng.gauss(0.0, 15.0)
            low, high = sorted((rng.uniform(-500.0, 500.0), rng.uniform(-500.0, 500.0)))
            point.torque_least, point.torque_most = low, high
            point.load_low = point.load_high = 0.0
            points.append(point)
        shown = balance._too_steep(points, known, 0.01)
        with monkeypatch.context() as patched:
            patched.setattr(MomentumBalance, "_clear_rad_s2", lambda *_: 0.0)
            whole = balance._too_steep(points, known, 0.01)
        assert (shown > 1.0) == (whole > 1.0)
        short += shown == 0.0 < whole
        full += whole > 1.0
    assert short > 30 and full > 30


def test_the_speed_by_the_position_is_that_of_the_last_half_second():
    way = PositionWay(0.5, 0.01, 0.1)
    for number in range(100):
        way.see(0.001 * number**2, 0.02 * number, WAY, 0.0)
    reach = int(1.01 * ANGLE_WINDOW_S[0] / 0.02)
    assert way.rate_rad_s == pytest.approx(0.001 * (99**2 - (99 - reach) ** 2) / (0.02 * reach))
    way.restart()
    assert way.rate_rad_s is None
