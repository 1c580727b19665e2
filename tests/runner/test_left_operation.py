"""Drive that left operation in motion: test of whether the reported torque stopped the shaft."""

import math

import pytest

from tdhil.runner.observer.left_operation import LeftOperation
from tdhil.runner.observer.points import Point

STEP_S = 0.04
J_KG_M2 = 100.0


def point(time_s, speed_rad_s, impulse_nms):
    found = Point()
    found.time_s, found.speed, found.impulse = time_s, speed_rad_s, impulse_nms
    return found


def followed(torque_nm, from_rad_s=2.0, lag_s=0.4, stop_s=1.0, later_nm=0.0):
    """Observe a reported speed that lags a ramp to zero, with a constant torque. ``later_nm``: torque from 3 s on."""
    points = [point(0.0, from_rad_s, 0.0)]
    left, speed, impulse = LeftOperation(points[0]), from_rad_s, 0.0
    for k in range(1, 120):
        true = from_rad_s * max(0.0, 1.0 - k * STEP_S / stop_s)
        speed += (true - speed) * STEP_S / lag_s
        impulse += STEP_S * (torque_nm if k * STEP_S < stop_s else later_nm if k * STEP_S > 3.0 else 0.0)
        left.see(point(k * STEP_S, speed, impulse), turns=abs(speed) > 0.2)
    return left


@pytest.mark.parametrize("way", [1.0, -1.0])
@pytest.mark.parametrize(("torque_nm", "found"), [(-150.0, True), (-15.0, False), (0.0, False), (150.0, False)])
def test_only_a_braking_torque_stops_a_shaft(way, torque_nm, found):
    assert followed(way * torque_nm, from_rad_s=way * 2.0).braked(J_KG_M2) is found


def test_without_a_bound_of_j_nothing_is_known():
    assert not followed(-150.0).braked(math.inf)


def test_torque_after_the_stop_does_not_count():
    """An offset of the torque signal would accumulate to any impulse."""
    assert not followed(0.0, later_nm=-50.0).braked(J_KG_M2)


def test_a_shaft_that_still_turns_has_not_been_stopped():
    left = LeftOperation(point(0.0, 2.0, 0.0))
    left.see(point(0.5, 1.0, -100.0), turns=True)
    assert not left.braked(J_KG_M2)


def test_nothing_is_known_before_the_next_point():
    assert not LeftOperation(point(0.0, 2.0, 0.0)).braked(J_KG_M2)


def test_the_torque_that_still_drives_is_no_braking_and_the_speed_counts_at_its_largest():
    """The report lags: after the fault it still shows a driving torque and a rising speed."""
    left = LeftOperation(point(0.0, 1.0, 0.0))
    for at, speed, impulse in ((0.2, 2.0, 40.0), (0.6, 1.0, 25.0), (1.0, 0.0, 10.0)):
        left.see(point(at, speed, impulse), turns=speed > 0.2)
    assert left.speed_rad_s == 2.0
    assert left.braked(30.0 / (0.1 * 2.0))                    # 30 N·m·s from the largest impulse on
    assert not left.braked(31.0 / (0.1 * 2.0))
