"""A reported speed that does not respond to the torque, above a drill string: rules of the observer, point by point."""

from collections import deque
from dataclasses import replace
from types import SimpleNamespace

import pytest

from drivers import Command, Mode
from tdhil.runner.observer.unanswered_torque import FlatSpeed, PointInRun
from tests.rigs import LIMITS

STRING = replace(LIMITS, load="string", torque_ramp_nm_s=0.1 * LIMITS.torque_nm)
EVERY_S, LAG_S, NOISE_RAD_S, STILL_RAD_S = 0.1, 0.5, 0.01, 0.05
INERTIA_KG_M2, STRING_NM_S_RAD, HOLDING_NM = 100.0, 200.0, 150.0


def found(torque_of, speed_of=lambda _: 4.0, until_s=6.0, mode=Mode.TORQUE):
    """Return the time of the first contradiction, s, and None without one."""
    rule = FlatSpeed(STRING, STILL_RAD_S, LAG_S)
    bounds = SimpleNamespace(known=True, inertia_high=INERTIA_KG_M2, string_nm_s_rad=STRING_NM_S_RAD)
    for k in range(round(until_s / EVERY_S)):
        time_s = k * EVERY_S
        torque_nm = torque_of(time_s)
        point = SimpleNamespace(time_s=time_s, torque=torque_nm, speed=speed_of(time_s))
        now = PointInRun(point, Command(mode, 4.0, torque_nm), EVERY_S, deque(), bounds, NOISE_RAD_S, True, False)
        if rule.see(now) is not None:
            return time_s
    return None


def test_a_speed_that_a_torque_should_have_moved_is_found():
    noticed_s = found(lambda time_s: HOLDING_NM if time_s < 1.0 else 2.0 * HOLDING_NM)
    assert noticed_s == pytest.approx(2.5, abs=0.11)        # FLAT_S and FLAT_LAGS lags


def test_a_speed_in_balance_after_a_pulse_is_believed():
    """The point with which the speed becomes flat is the last one of a braking pulse. Then the torque holds the shaft.

    `healthy_runs.py`, seed 1862: the pulse of the braking probe.
    """
    def torque_of(time_s):
        return -HOLDING_NM if time_s < 0.35 else HOLDING_NM

    def speed_of(time_s):
        return 4.5 - max(0.0, min(0.3, time_s))

    assert found(torque_of, speed_of) is None


def test_a_speed_that_is_lost_within_a_pulse_is_found_by_the_next_torque():
    def torque_of(time_s):
        return -HOLDING_NM if time_s < 0.35 else HOLDING_NM if time_s < 3.0 else 3.0 * HOLDING_NM

    assert found(torque_of, until_s=9.0) is not None
