"""A reported speed that does not respond to the torque, above a drill string: rules of the observer, point by point."""

import math
from collections import deque
from dataclasses import replace
from types import SimpleNamespace

import pytest

from drivers import Command, Mode
from tdhil.runner.observer.unanswered_torque import (
    BEYOND_S,
    FLAT_LIMIT_S,
    HELD_S,
    STRAINED_S,
    VARIED_S,
    YIELD_S,
    FlatSpeedAboveString,
    FlatSpeedWithoutString,
    HeldShaft,
    IgnoredYield,
    PointInRun,
    TorqueAtLimitBeyondSetpoint,
    TorqueAtLimitNearSetpoint,
    rules,
)
from tests.rigs import LIMITS

STRING = replace(LIMITS, load="string", torque_ramp_nm_s=0.1 * LIMITS.torque_nm)
EVERY_S, LAG_S, NOISE_RAD_S, STILL_RAD_S = 0.1, 0.5, 0.01, 0.05
INERTIA_KG_M2, STRING_NM_S_RAD, HOLDING_NM, BREAKAWAY_NM = 100.0, 200.0, 150.0, 20.0
LIMIT_NM, FASTEST_RAD_S = STRING.torque_nm, STRING.speed_max_rad_s


def first(rule, torque_of, speed_of, until_s, command_of, *, known=True, moved=True, stopping=False):
    """Return the time of the first contradiction, s, and None without one."""
    bounds = SimpleNamespace(
        known=known, inertia_high=INERTIA_KG_M2, string_nm_s_rad=STRING_NM_S_RAD, breakaway_nm=BREAKAWAY_NM)
    points = deque()
    for k in range(round(until_s / EVERY_S)):
        time_s = k * EVERY_S
        points.append(SimpleNamespace(time_s=time_s, torque=torque_of(time_s), speed=speed_of(time_s)))
        now = PointInRun(points[-1], command_of(time_s), EVERY_S, points, bounds, NOISE_RAD_S, moved, stopping)
        if rule.see(now) is not None:
            return time_s
    return None


def found(torque_of, speed_of=lambda _: 4.0, until_s=6.0, mode=Mode.TORQUE):
    """Return the time at which a flat speed is found, s."""
    return first(FlatSpeedAboveString(STRING, STILL_RAD_S, LAG_S), torque_of, speed_of, until_s,
                 lambda time_s: Command(mode, 4.0, torque_of(time_s)))


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


def test_a_torque_that_falls_is_noticed_as_one_that_rises():
    assert found(lambda time_s: 2.0 * HOLDING_NM if time_s < 1.0 else 0.5 * HOLDING_NM) is not None


def test_a_speed_that_leaves_its_noise_in_both_directions_together_has_answered():
    """Each speed is within the noise of the first one, and the highest is not within the noise of the lowest."""
    steps = (0.0, 1.6 * NOISE_RAD_S, -1.6 * NOISE_RAD_S)

    def speed_of(time_s):
        return 4.0 + steps[round(time_s / EVERY_S) % 3]

    assert found(lambda time_s: HOLDING_NM if time_s < 1.0 else 2.0 * HOLDING_NM, speed_of) is None


def test_after_a_response_the_balance_restarts():
    def torque_of(time_s):
        return HOLDING_NM if time_s < 4.95 else 4.0 * HOLDING_NM + 60.0 * math.cos(2.0 * math.pi * (time_s - 5.0))

    assert found(torque_of, lambda time_s: 4.0 if time_s < 4.95 else 5.0, 10.0) is None


def test_the_balance_begins_with_torque_mode():
    def torque_of(time_s):
        return 2.0 * HOLDING_NM if time_s < 0.05 else HOLDING_NM

    def command_of(time_s):
        return Command(Mode.SPEED if time_s < 1.0 else Mode.TORQUE, 4.0, torque_of(time_s))

    assert first(FlatSpeedAboveString(STRING, STILL_RAD_S, LAG_S), torque_of, lambda _: 4.0, 8.0, command_of) is None


def multisine_nm(time_s):
    """Return a torque whose first second already has its whole range: no impulse leaves the loads that it allows."""
    return HOLDING_NM + 200.0 * math.cos(2.0 * math.pi * 0.5 * time_s) + 200.0 * math.cos(2.0 * math.pi * time_s)


def test_a_speed_that_does_not_follow_a_multisine_is_found():
    """`lying_reports.py` 795: the sensor froze in a multisine. The shaft reached 15 rad/s, and its limit is 10."""
    noticed_s = found(multisine_nm, until_s=30.0)
    assert VARIED_S < noticed_s < 3.0 * VARIED_S
    # a small part of it is within the noise, and a speed that follows it is none that stays
    assert found(lambda time_s: HOLDING_NM + 0.05 * (multisine_nm(time_s) - HOLDING_NM), until_s=30.0) is None
    assert found(multisine_nm, lambda time_s: 4.0 + 0.3 * math.sin(2.0 * math.pi * 0.5 * time_s), 30.0) is None


def test_in_speed_mode_a_speed_that_is_constant_with_the_torque_at_its_limit_is_not_controlled():
    noticed_s = found(lambda _: LIMIT_NM, mode=Mode.SPEED)
    assert noticed_s == pytest.approx(FLAT_LIMIT_S, abs=0.11)
    assert found(lambda _: 0.8 * LIMIT_NM, mode=Mode.SPEED) is None
    assert found(lambda _: LIMIT_NM, lambda time_s: 4.0 + 0.1 * math.floor(time_s), mode=Mode.SPEED) is None
    assert found(lambda _: LIMIT_NM, lambda _: STILL_RAD_S, mode=Mode.SPEED) is None


def constant(kind, until_s, *, speed_rad_s, torque_nm=LIMIT_NM, setpoint_rad_s=4.0, mode=Mode.SPEED, **said):
    """Return the time at which a rule of this kind finds reports that stay the same from the first point on, s."""
    return first(kind(STRING, STILL_RAD_S), lambda _: torque_nm, lambda _: speed_rad_s, until_s,
                 lambda _: Command(mode, setpoint_rad_s, torque_nm), **said)


def held(until_s=6.0, **other):
    return constant(HeldShaft, until_s, **{"speed_rad_s": 0.0} | other)


def test_a_shaft_that_moved_and_stands_with_the_torque_at_its_limit_is_held_or_not_measured():
    assert held() == pytest.approx(HELD_S - EVERY_S, abs=0.11)
    assert held(until_s=HELD_S - 2.0 * EVERY_S) is None


@pytest.mark.parametrize("other", [
    {"speed_rad_s": 2.0 * STILL_RAD_S}, {"torque_nm": 0.8 * LIMIT_NM}, {"setpoint_rad_s": 3.0 * STILL_RAD_S},
    {"mode": Mode.TORQUE}, {"moved": False},
])
def test_a_shaft_is_not_held_without_each_of_these(other):
    assert held(**other) is None


def test_the_time_of_a_held_shaft_restarts():
    stands = {False: 0.0, True: 1.0}
    assert first(HeldShaft(STRING, STILL_RAD_S), lambda _: LIMIT_NM, lambda time_s: stands[time_s % 1.0 > 0.85], 8.0,
                 lambda _: Command(Mode.SPEED, 4.0, 0.0)) is None


def strained(until_s=8.0, **other):
    return constant(TorqueAtLimitNearSetpoint, until_s, **{"speed_rad_s": 4.0, "known": False} | other)


def test_a_speed_at_its_setpoint_needs_no_torque_at_its_limit():
    assert strained() == pytest.approx(STRAINED_S - EVERY_S, abs=0.11)
    assert strained(until_s=STRAINED_S - 2.0 * EVERY_S) is None


@pytest.mark.parametrize("other", [
    {"speed_rad_s": 4.0 + 0.2 * FASTEST_RAD_S}, {"torque_nm": 0.8 * LIMIT_NM}, {"mode": Mode.TORQUE}, {"known": True},
    {"speed_rad_s": 3.0 * STILL_RAD_S, "setpoint_rad_s": 0.0},
])
def test_a_torque_at_its_limit_is_no_contradiction_without_each_of_these(other):
    assert strained(**other) is None


def test_the_time_at_the_limit_restarts():
    assert first(TorqueAtLimitNearSetpoint(STRING, STILL_RAD_S), lambda time_s: LIMIT_NM * (time_s % 3.0 < 2.85),
                 lambda _: 4.0, 12.0, lambda _: Command(Mode.SPEED, 4.0, 0.0), known=False) is None


def ignored(until_s=8.0, speed_of=lambda _: 0.0, mode_of=lambda _: Mode.SPEED, stopping=True, torque_nm=HOLDING_NM,
            lag_s=LAG_S, yield_rad_s=1.0):
    """Return the time at which an ignored yield is found, s; torque and commanded yield oscillate."""
    return first(IgnoredYield(STILL_RAD_S, lag_s, EVERY_S), lambda time_s: torque_nm * math.cos(time_s), speed_of,
                 until_s, lambda time_s: Command(mode_of(time_s), yield_rad_s * (1.5 + math.cos(time_s)), 0.0),
                 stopping=stopping)


def test_a_shaft_that_stands_while_the_stop_yields_is_not_measured():
    assert ignored() == pytest.approx(YIELD_S - 2.0 * EVERY_S, abs=0.11)


@pytest.mark.parametrize("other", [
    {"stopping": False}, {"mode_of": lambda _: Mode.TORQUE}, {"speed_of": math.cos}, {"speed_of": lambda _: 1.5},
    {"torque_nm": 0.5 * BREAKAWAY_NM}, {"yield_rad_s": 0.5 * STILL_RAD_S}, {"lag_s": 0.6 * YIELD_S},
    {"mode_of": lambda time_s: Mode.SPEED if time_s % 3.0 < 2.85 else Mode.TORQUE},        # the time restarts
    {"speed_of": lambda time_s: 0.9 if time_s % 3.5 < 1.0 else 0.0},                       # it moves now and then
])
def test_a_yield_is_not_ignored_without_each_of_these(other):
    assert ignored(**other) is None


def test_only_the_last_seconds_of_a_yield_count():
    assert ignored(until_s=16.0, speed_of=lambda time_s: 1.0 if time_s < 6.0 else 0.0) == pytest.approx(
        6.0 + YIELD_S, abs=0.3)


def at_limit_without_string(rule, speed_rad_s, torque_nm, **other):
    """Return the time at which a constant torque and speed are found while 3 rad/s are commanded, s."""
    return first(rule, lambda _: torque_nm, lambda _: speed_rad_s, 6.0,
                 lambda _: Command(Mode.SPEED, 3.0, 0.0), **{"known": False, **other})


def beyond():
    return TorqueAtLimitBeyondSetpoint(LIMITS, STILL_RAD_S, LAG_S)


def flat():
    return FlatSpeedWithoutString(LIMITS, STILL_RAD_S)


def test_without_a_string_torque_at_its_limit_drives_no_shaft_beyond_its_setpoint():
    assert at_limit_without_string(beyond(), 4.0, LIMITS.torque_nm) == pytest.approx(BEYOND_S, abs=0.11)


@pytest.mark.parametrize(("speed_rad_s", "torque_nm", "other"), [
    (4.0, -LIMITS.torque_nm, {}), (2.0, LIMITS.torque_nm, {}), (3.1, LIMITS.torque_nm, {}),
    (4.0, 0.5 * LIMITS.torque_nm, {}), (4.0, LIMITS.torque_nm, {"known": True}),
    (4.0, LIMITS.torque_nm, {"moved": False}),
], ids=["braking", "below", "near", "half the torque", "J known", "never moved"])
def test_it_is_not_found_without_each_of_these(speed_rad_s, torque_nm, other):
    assert at_limit_without_string(beyond(), speed_rad_s, torque_nm, **other) is None


def test_without_a_string_a_slow_flat_speed_counts_until_j_is_known_and_not_in_a_stop():
    """A faster one may be at the speed at which a viscous load is as large as the torque limit."""
    assert at_limit_without_string(flat(), 0.5, LIMITS.torque_nm) == pytest.approx(FLAT_LIMIT_S, abs=0.11)
    assert at_limit_without_string(flat(), 4.0, LIMITS.torque_nm) is None
    for other in ({"known": True}, {"stopping": True}, {"moved": False}):
        assert at_limit_without_string(flat(), 0.5, LIMITS.torque_nm, **other) is None


def test_each_load_has_its_rules():
    assert {type(rule) for rule in rules(LIMITS, STILL_RAD_S, LAG_S, EVERY_S)} == {
        HeldShaft, TorqueAtLimitBeyondSetpoint, FlatSpeedWithoutString}
    assert {type(rule) for rule in rules(STRING, STILL_RAD_S, LAG_S, EVERY_S)} == {
        HeldShaft, TorqueAtLimitNearSetpoint, FlatSpeedAboveString, IgnoredYield}
