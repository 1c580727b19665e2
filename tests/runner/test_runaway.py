"""Acceleration during a quick stop: evidence of the torque since the stop, point by point."""

import math
from types import SimpleNamespace

import pytest

from tdhil.runner.observer.runaway import REPEATED_S, Belief, Runaway
from tests.rigs import LIMITS

EVERY_S, STILL_RAD_S, INERTIA_KG_M2, START_RAD_S = 0.1, 0.05, 10.0, 4.0
BELIEF = Belief(doubt=None, reports_trusted=True, comes_down=False, moved=True, rate_rad_s=None, demand_nm=None)
KNOWN = SimpleNamespace(
    inertia_low=INERTIA_KG_M2, inertia_high=INERTIA_KG_M2, likely_inertia=INERTIA_KG_M2, known=True, pushing_nm=1e9,
    friction=lambda speed, still: (0.0, 0.0))
PUSHING_NM = 30.0         # 3 rad/s in a second


def by_torque(reports):
    """Return the evidence of the torque after these reports, (speed, torque) every 0.1 s."""
    runaway, impulse_nms = Runaway(LIMITS, STILL_RAD_S), 0.0
    runaway.begin(START_RAD_S)
    for k, (speed, torque) in enumerate(reports):
        impulse_nms += EVERY_S * torque
        point = SimpleNamespace(time_s=k * EVERY_S, speed=speed, torque=torque, impulse=impulse_nms, still=STILL_RAD_S)
        runaway.see(point, KNOWN, BELIEF)
    return runaway._by_torque(True, 1.0)


def repeated(seconds, torque_nm=PUSHING_NM):
    return [(START_RAD_S, torque_nm)] * round(seconds / EVERY_S)


def varied(seconds, torque_nm=PUSHING_NM):
    return [(START_RAD_S + 1e-3 * (k % 2), torque_nm) for k in range(round(seconds / EVERY_S))]


def test_a_torque_that_drives_the_shaft_beyond_its_limit_counts():
    assert "accounts for" in by_torque(varied(4.0))
    assert by_torque(varied(1.0)) == ""


def test_a_torque_that_repeats_counts_as_long_as_it_repeats():
    """A lost encoder reports a constant speed, and a drive at its limit a constant torque."""
    assert "accounts for" in by_torque(repeated(4.0))


@pytest.mark.parametrize("before", [[], varied(0.5, 0.0)], ids=["from the start", "later"])
def test_a_torque_that_repeated_and_then_went_on_was_late(before):
    """Reports that are constant for 2 s and then continue were delayed: the stop had begun long before.

    `lying_reports.py`, number 3683: the torque of a shaft that braked was removed.
    """
    assert by_torque([*before, *repeated(4.0), *varied(0.5, -PUSHING_NM)]) == ""


def test_after_a_delay_the_torque_counts_again():
    late = [*repeated(4.0), *varied(0.5, 0.0)]
    assert "accounts for" in by_torque([*late, *varied(4.0)])


def test_a_single_repeated_point_is_no_delay():
    pairs = [pair for _ in range(14) for pair in (*repeated(0.2), (START_RAD_S + 1e-3, PUSHING_NM))]
    assert REPEATED_S > 2.0 * EVERY_S
    assert "accounts for" in by_torque(pairs)


@pytest.mark.parametrize(("torque_nm", "found"), [(-LIMITS.torque_nm, True), (-0.5 * LIMITS.torque_nm, False)])
def test_with_an_unknown_inertia_a_braking_torque_at_its_limit_shows_an_inverted_sign(torque_nm, found):
    """With exchanged motor phases the quick stop accelerates the shaft, and the report says that it brakes."""
    unknown = SimpleNamespace(**{**vars(KNOWN), "known": False, "inertia_high": math.inf})
    runaway, impulse_nms, limit_rad_s = Runaway(LIMITS, STILL_RAD_S), 0.0, LIMITS.speed_max_rad_s
    runaway.begin(0.5)
    for k in range(60):
        impulse_nms += EVERY_S * torque_nm
        speed = 0.5 + 0.25 * limit_rad_s * EVERY_S * k
        point = SimpleNamespace(time_s=k * EVERY_S, speed=speed, torque=torque_nm, impulse=impulse_nms,
                                still=STILL_RAD_S)
        runaway.see(point, unknown, BELIEF)
        sample = SimpleNamespace(time_s=k * EVERY_S, speed_rad_s=speed)
        assert not runaway.seen(BELIEF, sample) or speed > limit_rad_s
    assert bool(runaway.seen(BELIEF, sample)) is found
