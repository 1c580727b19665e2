"""Observer alone: it accepts true reports of a shaft and finds false reports."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from drivers import Command, Mode, PowerState
from tdhil.runner.excitation import RigGuess
from tdhil.runner.observer import Observer, Signal
from tests.runner.guarded import REST, sample
from tests.runner.reporting_rig import LIMITS, Bench, Reports, Rig

COUNT_RAD = 2.0 * math.pi / 8192
PLAIN, WITH_POSITION = Rig(), Rig(position_count=COUNT_RAD)
STIFF = Rig(coulomb=80.0, viscous=15.0)
"""Rig whose friction is a third of the torque limit, enough to check a torque report with it."""
LAGS = (0.0, 0.1, 0.5)
SPEED_AND_TORQUE = frozenset({Signal.SPEED, Signal.TORQUE})
SPEED_AND_ANGLE = frozenset({Signal.SPEED, Signal.ANGLE})


def frozen(bench, *signals):
    """Freeze these reports at their present value."""
    kept = bench.samples[-1]
    values = {"speed_rad_s": kept.speed_rad_s, "torque_nm": kept.torque_nm, "position_rad": kept.position_rad}
    stuck = {name: values[name] for name in signals or values}
    return lambda reports: reports._replace(**stuck)


def changed(signal, scale=1.0, offset=0.0):
    """Give this report another scale or another offset."""
    def lie(reports: Reports):
        return reports._replace(**{signal: scale * getattr(reports, signal) + offset})
    return lie


def ramps(bench):
    """Ramp between 4 and 6 rad/s, with one second at each speed."""
    for speed in (6.0, 4.0):
        bench.ramp(speed)
        bench.hold(1.0, speed)


# -- healthy ----------------------------------------


@st.composite
def rigs(draw):
    """Return a rig with enough torque for its motion, and reports with any plausible lag and resolution."""
    top = draw(st.sampled_from([2.0, 10.0, 150.0]))
    acceleration = draw(st.floats(0.1, 1.0)) * top            # at its torque limit without friction, rad/s²
    inertia = 10.0 ** draw(st.floats(-3.0, 3.5))
    limit = inertia * acceleration
    limits = replace(
        LIMITS, speed_min_rad_s=0.05 * top, speed_max_rad_s=top, torque_nm=limit, probe_torque_nm=0.5 * limit,
        quick_stop_rad_s2=max(0.05 * top, draw(st.floats(0.05, 0.4)) * acceleration),
    )
    rate = draw(st.sampled_from([10.0, 20.0, 50.0, 100.0, 250.0]))
    return Rig(
        inertia=inertia, coulomb=draw(st.floats(0.02, 0.2)) * limit, viscous=draw(st.floats(0.0, 0.2)) * limit / top,
        limits=limits, rate_hz=rate, speed_lag_s=draw(st.floats(0.0, 0.5)), torque_lag_s=draw(st.floats(0.0, 0.5)),
        noise_rad_s=draw(st.floats(0.0, 0.003)) * top, speed_count=draw(st.floats(0.0005, 0.01)) * top,
        torque_count=draw(st.floats(0.0005, 0.01)) * limit,
        position_count=draw(st.sampled_from([0.0, COUNT_RAD])), demand=draw(st.booleans()),
    )


PHASES = (Phase.explicit, Phase.reuse, Phase.generate)      # a smaller rig is not a simpler one
any_run = given(rigs(), st.floats(-1.0, 1.0), st.floats(0.05, 0.3), st.floats(0.05, 1.0), st.integers(0, 1000))


@settings(phases=PHASES, max_examples=3)
@any_run
def test_a_healthy_run_raises_no_doubt(rig, wrong, rel_error, frequency_hz, seed):
    healthy(rig, wrong, rel_error, frequency_hz, seed)


@pytest.mark.heavy
@settings(phases=PHASES, max_examples=25)
@any_run
def test_more_healthy_runs_raise_no_doubt(rig, wrong, rel_error, frequency_hz, seed):
    healthy(rig, wrong, rel_error, frequency_hz, seed)


@pytest.mark.long
@settings(phases=PHASES)
@any_run
def test_many_healthy_runs_raise_no_doubt(rig, wrong, rel_error, frequency_hz, seed):
    healthy(rig, wrong, rel_error, frequency_hz, seed)


def healthy(rig, wrong, rel_error, frequency_hz, seed):
    """Run standstill, sign probe, operating points, torque mode, ramps under speed control, and the stop."""
    bench, top = Bench(rig, seed), rig.limits.speed_max_rad_s
    bench.first_levels()
    assert bench.observer.doubt is None, bench.observer.doubt
    bench.know(wrong * rel_error, rel_error)
    bench.ramp(0.5 * top)
    bench.hold(2.0, 0.5 * top)
    swing = 0.1 * top
    fastest_hz = 0.4 * rig.limits.torque_nm / (2.0 * math.pi * rig.inertia * swing)
    bench.excite(8.0, 0.5 * top, swing, min(frequency_hz, fastest_hz))
    for share in (0.7, 0.3):
        bench.ramp(share * top)
        bench.hold(1.5, share * top)
    assert bench.observer.doubt is None, bench.observer.doubt
    assert bench.quick_stop(2.0 * top / rig.limits.quick_stop_rad_s2 / 3.0 + 4.0) == ""
    assert bench.observer.doubt is None, bench.observer.doubt
    assert bench.observer.reports_trusted
    assert bench.observer.moved and bench.observer.unseen_s == 0.0


@pytest.mark.long(but_first=16)
@pytest.mark.heavy(but_first=3)
@pytest.mark.parametrize("speed_lag_s", [0.1, 0.3, 0.45, 0.5])
@pytest.mark.parametrize("coulomb", [100.0, 371.0, 500.0])
@pytest.mark.parametrize("quick_stop_rad_s2", [1.0, 1.8, 2.2, 3.0])
def test_a_lagging_speed_still_falls_once_friction_has_stopped_the_shaft(speed_lag_s, coulomb, quick_stop_rad_s2):
    """Static friction holds any torque at standstill, while the reported speed still falls to zero."""
    limits = replace(LIMITS, torque_nm=1856.0, quick_stop_rad_s2=quick_stop_rad_s2)
    rig = Rig(inertia=300.0, viscous=37.0, coulomb=coulomb, limits=limits, speed_lag_s=speed_lag_s, torque_lag_s=0.3)
    bench = Bench(rig).begun(3.0)
    assert bench.quick_stop(8.0) == ""
    assert bench.observer.doubt is None, bench.observer.doubt
    assert bench.observer.reports_trusted


def test_no_report_is_doubted_while_the_shaft_never_moves():
    bench = Bench(replace(PLAIN, coulomb=1e6))
    bench.probe()
    assert bench.observer.doubt is None
    assert not bench.observer.moved


# -- lies about a shaft whose J is known ----------------------------------------

JUMPS = {
    "lost": changed("speed_rad_s", 0.0), "half": changed("speed_rad_s", 0.5), "twice": changed("speed_rad_s", 2.0),
    "sign": changed("speed_rad_s", -1.0), "more": changed("speed_rad_s", offset=3.0),
    "less": changed("speed_rad_s", offset=-2.0),
}


@pytest.mark.heavy(but_first=3)
@pytest.mark.parametrize("lag_s", LAGS)
@pytest.mark.parametrize("name", JUMPS)
@pytest.mark.parametrize("mode", ["speed", "torque"])
def test_a_speed_that_jumps_is_found_at_once(name, lag_s, mode):
    """The torque cannot change the speed so fast. A few points are enough for any lag."""
    bench = Bench(replace(PLAIN, speed_lag_s=lag_s, torque_lag_s=0.5 * lag_s)).begun()
    if mode == "torque":
        bench.excite(4.0, 5.0, 1.0)
    bench.lie = JUMPS[name]
    start_s = bench.time_s
    for _ in range(10):
        bench.hold(0.02, 5.0) if mode == "speed" else bench.cycle(Command(Mode.TORQUE, 0.0, 60.0))
    assert bench.observer.doubt is not None
    assert bench.observer.doubt.time_s - start_s <= 0.2
    assert bench.observer.doubt.signals in (SPEED_AND_TORQUE, frozenset({Signal.TORQUE}))   # beyond its limit: it alone
    assert not bench.observer.reports_trusted


@pytest.mark.parametrize("lag_s", LAGS)
def test_a_lost_encoder_is_found_before_the_shaft_is_fast(lag_s):
    """The speed control accelerates with full torque. The doubt comes before the shaft reaches the speed limit."""
    bench = Bench(replace(PLAIN, speed_lag_s=lag_s)).begun()
    bench.sensor = lambda _: 0.0
    assert bench.found_after(3.0, lambda: bench.hold(0.02, 5.0)) is not None
    assert bench.observer.doubt.signals in (SPEED_AND_TORQUE, frozenset({Signal.TORQUE}))   # beyond its limit: it alone
    assert bench.fastest <= 6.0


@pytest.mark.heavy(but_first=3)
@pytest.mark.parametrize("lag_s", LAGS)
@pytest.mark.parametrize("how", ["ramps", "torque mode"])
def test_a_speed_that_freezes_is_found_once_the_shaft_turns_otherwise(lag_s, how):
    """The torque changes and the speed does not. The doubt comes within 4 s, the longest window."""
    bench = Bench(replace(PLAIN, speed_lag_s=lag_s)).begun()
    if how == "torque mode":
        bench.excite(4.0, 5.0, 1.0)
    bench.lie = frozen(bench, "speed_rad_s")
    start_s = bench.time_s
    ramps(bench) if how == "ramps" else bench.excite(5.0, 5.0, 1.0)
    assert bench.observer.doubt is not None
    assert bench.observer.doubt.time_s - start_s <= 4.0
    assert Signal.SPEED in bench.observer.doubt.signals


TORQUES = {"sign": (-1.0, 2.5), "lost": (0.0, 6.0), "tenth": (0.1, 6.0), "twice": (2.0, 6.0)}


@pytest.mark.heavy(but_first=2)
@pytest.mark.parametrize("lag_s", LAGS)
@pytest.mark.parametrize("name", TORQUES)
def test_a_torque_that_lies_is_found_in_torque_mode(name, lag_s):
    """Friction and inertia take 155 ± 160 N·m here."""
    scale, within_s = TORQUES[name]
    bench = Bench(replace(STIFF, speed_lag_s=lag_s, torque_lag_s=0.5 * lag_s)).begun()
    bench.excite(5.0, 5.0, 1.0)
    assert bench.observer.doubt is None
    bench.lie = changed("torque_nm", scale)
    start_s = bench.time_s
    bench.excite(10.0, 5.0, 1.0)
    assert bench.observer.doubt is not None
    assert bench.observer.doubt.time_s - start_s <= within_s
    assert Signal.TORQUE in bench.observer.doubt.signals


@pytest.mark.parametrize("lag_s", LAGS)
def test_half_a_torque_is_found_where_it_is_nearly_steady(lag_s):
    """The mean command over 4 s is 155 N·m, and half of it is reported."""
    bench = Bench(replace(STIFF, speed_lag_s=lag_s, torque_lag_s=0.5 * lag_s)).begun()
    bench.excite(5.0, 5.0, 0.1)
    bench.lie = changed("torque_nm", 0.5)
    start_s = bench.time_s
    bench.excite(10.0, 5.0, 0.1)
    assert bench.observer.doubt is not None
    assert bench.observer.doubt.time_s - start_s <= 6.0
    assert Signal.TORQUE in bench.observer.doubt.signals


@pytest.mark.parametrize("name", TORQUES)
def test_a_torque_that_lies_is_found_under_speed_control(name):
    """Only friction and inertia contradict the report without a torque command, and half a torque is plausible."""
    scale, within_s = TORQUES[name]
    bench = Bench(STIFF).begun()
    bench.lie = changed("torque_nm", scale)
    found_s = bench.found_after(10.0, lambda: ramps(bench))
    assert found_s is not None and found_s <= within_s
    assert bench.observer.doubt.signals in (SPEED_AND_TORQUE, frozenset({Signal.TORQUE}))   # beyond its limit: it alone


def test_torque_alone_is_doubted_where_it_contradicts_its_command():
    """The error exists from the start, like a wrong unit in the profile. Speed and standstill are still accepted."""
    bench = Bench(STIFF, lie=changed("torque_nm", 0.5))
    bench.first_levels()
    assert bench.observer.doubt is None             # J and friction are estimated from the same report
    bench.excite(8.0, 4.0, 0.2)
    assert bench.observer.doubt is not None
    assert bench.observer.doubt.signals == frozenset({Signal.TORQUE})
    assert bench.observer.reports_trusted


@pytest.mark.parametrize(("name", "moved_rad_s"), [("dead", 5.0), ("half", 5.0), ("sign", 5.0), ("double", 5.0)])
def test_a_position_that_does_not_go_as_far_as_the_speed_says(name, moved_rad_s):
    """Half of the travel or more is missing within a second."""
    bench = Bench(WITH_POSITION).begun()
    here = bench.angle
    bench.lie = {
        "dead": frozen(bench, "position_rad"),
        "half": lambda one: one._replace(position_rad=here + 0.5 * (one.position_rad - here)),
        "sign": lambda one: one._replace(position_rad=2.0 * here - one.position_rad),
        "double": lambda one: one._replace(position_rad=here + 2.0 * (one.position_rad - here)),
    }[name]
    found_s = bench.found_after(5.0, lambda: bench.hold(0.02, moved_rad_s))
    assert found_s is not None and found_s <= 3.0
    assert bench.observer.doubt.signals == SPEED_AND_ANGLE and "a filter" not in bench.observer.doubt.what.lower()


def test_the_position_finds_a_frozen_speed_however_little_torque_it_takes():
    bench = Bench(WITH_POSITION).begun()
    bench.lie = frozen(bench, "speed_rad_s")
    bench.ramp(3.0, 0.2)                             # so slow that the torque hardly changes
    bench.hold(2.0, 3.0)
    assert bench.observer.doubt is not None
    assert Signal.SPEED in bench.observer.doubt.signals


@pytest.mark.parametrize("speed_lag_s", [1.2, 2.0])
def test_a_filter_slower_than_assumed_is_named_beside_the_contradiction(speed_lag_s):
    """The position shows that the speed lags more than is plausible. The shaft is stopped, and the message names
    the lag to state in rig.yaml.
    """
    bench = Bench(replace(WITH_POSITION, speed_lag_s=speed_lag_s)).begun()
    bench.ramp(1.0, 1.0)
    bench.hold(8.0, 1.0)
    bench.ramp(9.0, 3.0)
    bench.hold(2.0, 9.0)
    doubt = bench.observer.doubt
    assert doubt is not None and doubt.signals == SPEED_AND_ANGLE
    named_s = float(doubt.what.split("with a lag of ")[1].split(" s")[0])
    assert named_s == pytest.approx(speed_lag_s, rel=0.25) and "drive_data.speed_lag_s" in doubt.helps


@pytest.mark.parametrize("rig", [PLAIN, WITH_POSITION])
def test_feedback_that_repeats_as_a_whole_is_found_once_the_setpoint_has_moved(rig):
    bench = Bench(rig).begun()
    bench.lie = frozen(bench)
    start_s = bench.time_s
    bench.ramp(7.0)
    bench.hold(1.0, 7.0)
    assert bench.observer.doubt is not None
    assert bench.observer.doubt.signals == frozenset({Signal.ALL})
    assert bench.observer.doubt.time_s - start_s <= 2.5


# -- before J is known ----------------------------------------


@pytest.mark.heavy(but_first=3)
@pytest.mark.parametrize("name", JUMPS)
def test_after_the_first_level_a_jump_is_found_although_j_is_not_known(name):
    bench = Bench(PLAIN)
    bench.first_levels()
    bench.lie = JUMPS[name]
    found_s = bench.found_after(1.0, lambda: bench.hold(0.02, 4.0))
    assert found_s is not None and found_s <= 0.2
    assert bench.observer.doubt.signals in (SPEED_AND_TORQUE, frozenset({Signal.TORQUE}))   # beyond its limit: it alone


def test_during_the_first_ramp_an_encoder_that_dies_is_found_by_the_torque_at_its_limit():
    bench = Bench(PLAIN)
    bench.probe()
    bench.ramp(2.0)
    bench.sensor = lambda _: 0.0
    found_s = bench.found_after(5.0, lambda: bench.hold(0.02, 4.0))
    assert found_s is not None and found_s <= 3.0
    assert Signal.SPEED in bench.observer.doubt.signals


def test_for_a_shaft_without_observed_motion_only_the_coasting_time_is_known():
    """The encoder is dead from the start. A locked shaft gives the same reports, so the stop allows time to coast."""
    bench = Bench(PLAIN, sensor=lambda _: 0.0)
    bench.probe()
    assert bench.observer.doubt is None and not bench.observer.moved
    assert bench.speed > 5.0
    wait_s = bench.observer.unseen_s
    assert 0.0 < wait_s <= 60.0
    bench.state = PowerState.OFF
    bench.hold(wait_s, 0.0)
    assert bench.speed == 0.0


def test_an_observed_motion_needs_no_coasting_time():
    bench = Bench(PLAIN)
    assert bench.observer.unseen_s == 0.0            # nor does a shaft without applied torque
    bench.probe()
    assert bench.observer.moved and bench.observer.unseen_s == 0.0


def test_a_position_that_moves_is_a_motion_too():
    bench = Bench(replace(WITH_POSITION, speed_lag_s=0.0), lie=changed("speed_rad_s", 0.0))
    bench.probe()
    assert bench.observer.moved and bench.observer.unseen_s == 0.0


def test_blind_s_is_long_enough_for_friction_to_stop_a_motion_that_lags_hide():
    bench = Bench(PLAIN)
    assert bench.observer.blind_s == 0.0             # no estimates
    bench = Bench(PLAIN).begun()
    hidden = 0.5 * PLAIN.friction(0.5) / PLAIN.inertia       # half a second of lag, rad/s
    assert 0.0 < bench.observer.blind_s <= 5.0
    bench.state, bench.speed = PowerState.OFF, hidden
    bench.hold(bench.observer.blind_s, 0.0)
    assert bench.speed == 0.0


# -- the first contradiction and its consequences -------------------------------------------


def test_the_first_contradiction_stays():
    bench = Bench(PLAIN).begun()
    bench.lie = JUMPS["lost"]
    bench.hold(0.5, 5.0)
    first = bench.observer.doubt
    assert first is not None
    bench.lie = None
    bench.hold(1.0, 5.0)
    bench.lie = changed("torque_nm", -1.0)
    bench.hold(5.0, 5.0)
    assert bench.observer.doubt is first


def test_a_torque_beyond_its_limit_is_false_even_at_standstill():
    """This is the only rule at standstill, where static friction may hold any torque."""
    bench = Bench(PLAIN, lie=changed("torque_nm", offset=1.3 * LIMITS.torque_nm))
    bench.hold(0.2, 0.0)
    assert bench.observer.doubt.signals == frozenset({Signal.TORQUE})
    assert "520 N·m is beyond the torque limit of 400 N·m" in bench.observer.doubt.what
    within = Bench(PLAIN, lie=changed("torque_nm", offset=1.2 * LIMITS.torque_nm))
    within.hold(0.2, 0.0)
    assert within.observer.doubt is None             # a ripple may exceed the limit


@pytest.mark.parametrize("speed", [0.0, 4.0])
def test_a_stop_knows_whether_the_shaft_turned_when_it_began(speed):
    bench = Bench(PLAIN)
    bench.ramp(speed)
    bench.hold(1.0, speed)
    bench.observer.begin_stop()
    assert bench.observer.turned is (speed > 0.0)


def test_a_contradiction_states_the_report_the_reason_and_the_next_step():
    bench = Bench(PLAIN).begun()
    bench.lie = JUMPS["lost"]
    bench.hold(0.5, 5.0)
    doubt = bench.observer.doubt
    assert "rad/s" in doubt.what and "N·m" in doubt.what and "kg·m²" in doubt.what
    assert "encoder" in doubt.helps


def test_a_speed_that_was_lost_is_not_believed_again():
    bench = Bench(PLAIN).begun()
    bench.sensor = lambda _: 0.0
    bench.found_after(3.0, lambda: bench.hold(0.02, 5.0))
    bench.quick_stop(20.0)
    assert not bench.observer.reports_trusted


@pytest.mark.parametrize("rig", [PLAIN, WITH_POSITION])
def test_a_speed_that_stays_frozen_is_not_believed_again(rig):
    bench = Bench(rig).begun()
    bench.lie = frozen(bench, "speed_rad_s")
    bench.ramp(2.0)
    bench.hold(2.0, 2.0)
    assert bench.observer.doubt is not None
    bench.lie = lambda one: one._replace(speed_rad_s=0.0)    # as with a gateway that detects it late
    bench.quick_stop(0.1)
    if not rig.position_count:
        bench.quick_stop(10.0)
        assert not bench.observer.reports_trusted


def test_a_position_that_lives_stands_in_for_a_lost_speed():
    bench = Bench(WITH_POSITION).begun()
    bench.lie = JUMPS["lost"]
    bench.hold(0.5, 5.0)
    assert not bench.observer.reports_trusted
    assert bench.quick_stop(8.0) == ""
    assert bench.observer.reports_trusted
    sample = bench.samples[-1]
    assert abs(bench.observer.speed_rad_s(sample)) < 0.05 and bench.observer.angle_quiet(0.05)
    assert bench.observer.angle_stands(0.05)
    assert not bench.observer.angle_stands(1e-6)               # one count of this position is more


def test_without_a_position_there_is_no_constant_position():
    bench = Bench(PLAIN).begun()
    bench.quick_stop(8.0)
    assert bench.observer.angle_quiet(0.05) and not bench.observer.angle_stands(0.05)


def test_a_position_that_moves_is_no_standstill():
    bench = Bench(WITH_POSITION).begun()
    bench.lie = JUMPS["lost"]
    bench.hold(2.0, 5.0)
    assert not bench.observer.angle_quiet(0.05) and not bench.observer.angle_stands(0.05)


@pytest.mark.parametrize("left", [0.1, 0.4])
def test_after_a_lost_load_the_speed_of_the_lighter_shaft_is_valid(left):
    bench = Bench(PLAIN).begun()
    bench.excite(4.0, 5.0, 1.0)
    bench.rig = replace(PLAIN, inertia=left * PLAIN.inertia, coulomb=left * PLAIN.coulomb, viscous=left * PLAIN.viscous)
    for _ in range(round(4.0 / PLAIN.period_s)):
        bench.cycle(Command(Mode.TORQUE, 0.0, 100.0))
        if bench.observer.doubt is not None:
            break
    assert bench.observer.doubt is not None
    assert bench.fastest < 1.5 * LIMITS.speed_max_rad_s
    assert bench.quick_stop(12.0) == ""
    assert bench.observer.reports_trusted                 # it fell as the speed of a shaft does
    assert bench.observer.doubt.lighter
    assert "load" in bench.observer.doubt.helps


# -- missing feedback -------------------------------------------


@pytest.mark.heavy(but_first=2)
@pytest.mark.parametrize("gap_s", [0.6, 3.0])
@pytest.mark.parametrize("seen", ["nothing", "stale samples"])
def test_a_gap_in_the_feedback_restarts_the_comparison(gap_s, seen):
    """The motion during the gap is unknown. Reports after the gap are compared only with each other."""
    bench = Bench(WITH_POSITION).begun()
    see = bench.observer.see
    last = bench.samples[-1]
    if seen == "nothing":
        bench.observer.see = lambda *_: None
    else:
        bench.observer.see = lambda command, sample: see(command, last._replace(time_s=sample.time_s, fresh=False))
    before = bench.speed
    bench.hold(gap_s, 8.0)
    assert abs(bench.speed - before) > 0.5
    bench.observer.see = see
    bench.hold(5.0, bench.speed)
    assert bench.observer.doubt is None
    bench.lie = JUMPS["lost"]
    assert bench.found_after(1.0, lambda: bench.hold(0.02, 8.0)) is not None


@pytest.mark.heavy(but_first=2)
@pytest.mark.parametrize("signal", ["speed_rad_s", "torque_nm"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_value_that_is_no_number_is_left_out(signal, value):
    bench = Bench(PLAIN).begun()
    for cycle in range(300):
        bench.lie = changed(signal, 0.0, value) if cycle % 7 == 0 else None
        bench.hold(bench.rig.period_s, 5.0 + 0.002 * cycle)
    assert bench.observer.doubt is None
    bench.lie = JUMPS["lost"]
    assert bench.found_after(1.0, lambda: bench.hold(0.02, 5.0)) is not None


# -- against a quick stop ----------------------------------------

FAULTS = {
    "polarity": {"polarity": -1.0}, "stuck": {"stuck_nm": 200.0}, "inverted": {"inverted_stop": True},
}


@pytest.mark.heavy(but_first=2)
@pytest.mark.parametrize("rig", [PLAIN, WITH_POSITION])
@pytest.mark.parametrize("name", FAULTS)
def test_a_shaft_that_accelerates_against_the_quick_stop_is_seen_in_two_ways(name, rig):
    """Both come before the shaft exceeds the limit by what the torque adds within 2 s."""
    bench = Bench(rig).begun()
    for what, value in FAULTS[name].items():
        setattr(bench, what, value)
    how = bench.quick_stop(12.0)
    assert len(how.split("; ")) >= 2, how
    assert bench.fastest <= 1.2 * LIMITS.speed_max_rad_s


@pytest.mark.heavy(but_first=2)
@pytest.mark.parametrize("rig", [PLAIN, WITH_POSITION])
@pytest.mark.parametrize("value", [0.0, 5.0])
def test_a_sensor_that_is_dead_in_the_stop_is_seen_in_two_ways(value, rig):
    bench = Bench(rig).begun()
    bench.sensor = lambda _: value
    bench.hold(0.3, 5.0)
    how = bench.quick_stop(20.0)
    assert len(how.split("; ")) >= 2, how
    assert bench.fastest <= 1.2 * LIMITS.speed_max_rad_s


def test_with_a_dead_sensor_a_tenth_of_the_torque_limit_counts_as_pushing():
    """With an unknown speed, friction may be less than estimated. Here it holds 155 N·m, not 100 N·m."""
    bench = Bench(STIFF).begun()
    bench.sensor = lambda _: 0.0
    bench.hold(0.3, 5.0)
    bench.stuck_nm = 100.0
    assert "push the shaft on" in bench.quick_stop(4.0)


def test_one_kind_of_evidence_is_not_sufficient():
    """Only the reported speed rises; the shaft comes to standstill."""
    bench = Bench(PLAIN).begun()
    bench.state = PowerState.QUICK_STOP
    bench.lie = lambda one: one._replace(speed_rad_s=max(5.0, 10.0 - one.speed_rad_s))
    assert bench.quick_stop(6.0) == ""
    assert bench.samples[-1].speed_rad_s > 9.0
    assert abs(bench.speed) < 0.01


def test_a_speed_that_does_not_change_under_the_torque_limit_of_a_stop_is_doubted():
    """J is unknown, so any inertia would fit."""
    observer = Observer(LIMITS, PLAIN.period_s, PLAIN.speed_count)
    observer.begin_stop()
    for k in range(500):
        seen = sample(5.0 + 0.01 * (k % 2), -LIMITS.torque_nm, time_s=k * PLAIN.period_s, state=PowerState.QUICK_STOP)
        observer.see(REST, seen)
    assert observer.doubt is not None and observer.doubt.signals == {Signal.SPEED}
    assert "the torque limit, brake the shaft for 8 s" in observer.doubt.what


def test_no_runaway_is_reported_before_a_quick_stop_is_requested():
    bench = Bench(PLAIN, stuck_nm=None).begun()
    bench.stuck_nm = 200.0
    bench.hold(3.0, 5.0)
    assert bench.observer.runs_away(bench.samples[-1]) == ""


@pytest.mark.parametrize("name", ["stuck", "inverted"])
def test_above_a_drill_string_the_torque_is_left_on_below_the_speed_limit(name):
    """A released string turns back, so the torque is removed only above the speed limit."""
    rig = replace(WITH_POSITION, limits=replace(LIMITS, load="string", torque_ramp_nm_s=40.0))
    bench = Bench(rig).begun()
    for what, value in FAULTS[name].items():
        setattr(bench, what, value)
    how = bench.quick_stop(12.0)
    assert how
    assert bench.speed > LIMITS.speed_max_rad_s
    assert len(how.split("; ")) >= 2


# -- above a drill string, and later cases -------------------------------------------

ABOVE_A_STRING = replace(PLAIN, limits=replace(LIMITS, load="string", torque_ramp_nm_s=40.0))


def test_above_a_string_a_frozen_speed_at_the_torque_limit_is_found_within_seconds():
    """The drive accelerates with full torque, since the frozen speed stays below the setpoint."""
    bench = Bench(ABOVE_A_STRING)
    bench.first_levels()
    kept = bench.speed
    bench.sensor = lambda speed: kept
    bench.lie = frozen(bench, "speed_rad_s")
    after_s = bench.found_after(6.0, lambda: bench.cycle(Command(Mode.SPEED, kept + 3.0, 0.0)))
    assert after_s is not None and after_s < 3.0
    assert bench.observer.doubt.signals == {Signal.SPEED}


def test_above_a_string_a_frozen_speed_is_found_by_the_torque_that_should_have_moved_it():
    bench = Bench(ABOVE_A_STRING).begun()
    bench.excite(4.0, 5.0, 1.0)
    assert bench.observer.doubt is None
    bench.lie = frozen(bench, "speed_rad_s")
    assert bench.found_after(10.0, lambda: bench.excite(1.0, 5.0, 1.0)) is not None


def test_a_setpoint_that_steps_above_a_string_is_no_frozen_speed():
    """A lagging report hardly changes at first. This time does not count."""
    bench = Bench(replace(ABOVE_A_STRING, speed_lag_s=0.5, torque_lag_s=0.5)).begun()
    for speed in (5.0, 5.2, 5.0, 6.0, 5.0):
        bench.hold(4.0, speed)
    assert bench.observer.doubt is None


@pytest.mark.parametrize("step_rad_s", [0.8, -0.8])
def test_a_torque_step_at_the_end_of_stage_2_is_no_load_of_a_string(step_rad_s):
    """The speed responds after its lag. Only later points show the load."""
    bench = Bench(replace(ABOVE_A_STRING, speed_lag_s=0.4, limits=replace(ABOVE_A_STRING.limits, torque_nm=800.0)))
    bench.first_levels()
    bench.know(0.4, 0.5)
    bench.hold(0.04, 4.0 + step_rad_s)
    bench.ramp(4.0, 1.0)
    bench.ramp(4.0 - 2.0 * step_rad_s, 1.0)
    bench.hold(2.0, 4.0 - 2.0 * step_rad_s)
    assert bench.observer.doubt is None


def test_a_reported_standstill_despite_a_commanded_yield_is_not_believed():
    bench = Bench(ABOVE_A_STRING).begun()
    bench.ramp(0.0)
    bench.hold(2.0, 0.0)
    bench.observer.begin_stop()
    bench.lie = lambda reports: reports._replace(speed_rad_s=0.0)

    def swing():
        bench.hold(0.5, 0.5)
        bench.hold(0.5, -0.5)

    assert bench.found_after(10.0, swing) is not None
    assert bench.observer.doubt.signals == {Signal.SPEED}


def test_a_shaft_that_static_friction_holds_against_a_slow_yield_is_believed():
    bench = Bench(ABOVE_A_STRING).begun()
    bench.ramp(0.0)
    bench.hold(2.0, 0.0)
    bench.observer.begin_stop()
    bench.lie = lambda reports: reports._replace(speed_rad_s=0.0, torque_nm=0.1 * reports.torque_nm)
    for _ in range(8):
        bench.hold(0.5, 0.5)
        bench.hold(0.5, -0.5)
    assert bench.observer.doubt is None


def test_a_shaft_that_yields_is_believed():
    bench = Bench(ABOVE_A_STRING).begun()
    bench.ramp(0.0)
    bench.hold(2.0, 0.0)
    bench.observer.begin_stop()
    for _ in range(8):
        bench.hold(0.5, 0.5)
        bench.hold(0.5, -0.5)
    assert bench.observer.doubt is None


@pytest.mark.parametrize(("factor", "contradicts"), [(1.0, False), (0.05, True), (20.0, True)])
def test_a_scale_that_changed_within_stage_2_contradicts_the_first_ramp(factor, contradicts):
    bench = Bench(PLAIN)
    bench.first_levels()
    model = RigGuess(factor * PLAIN.inertia, PLAIN.viscous, PLAIN.coulomb, 0.15)
    bench.observer.know(model)
    assert (bench.observer.doubt is not None) is contradicts


def test_an_inverted_polarity_is_a_second_way_where_no_position_is_reported():
    """The motor torque is opposite to its current: the speed rises according to the opposite torque."""
    bench = Bench(PLAIN).begun()
    bench.polarity = -1.0
    how = bench.quick_stop(20.0)
    assert "opposite sign" in how or "does not follow" in how
    assert abs(bench.speed) < 2.0 * LIMITS.speed_max_rad_s


def test_a_position_that_is_no_longer_reported_is_not_used():
    bench = Bench(WITH_POSITION).begun()
    bench.lie = lambda reports: reports._replace(speed_rad_s=0.0)
    bench.hold(1.0, 5.0)
    assert bench.observer.doubt is not None
    bench.observer.begin_stop()
    bench.state = PowerState.QUICK_STOP
    bench.hold(4.0, 0.0)
    bench.lie = lambda reports: reports._replace(speed_rad_s=0.0, position_rad=None)
    bench.hold(3.0, 0.0)
    assert bench.observer.rate_rad_s is None
    assert not bench.observer.reports_trusted and not bench.observer.comes_down


def test_standstill_is_checked_more_strictly_once_a_report_was_in_doubt():
    bench = Bench(PLAIN).begun()
    assert bench.observer.rest_rad_s(0.05) == 0.05
    bench.lie = changed("speed_rad_s", 0.5)
    bench.hold(1.0, 5.0)
    assert bench.observer.doubt is not None
    assert bench.observer.rest_rad_s(1.0) < 0.5


def test_without_dry_friction_known_standstill_is_watched_for_the_longest_time():
    bench = Bench(replace(PLAIN, coulomb=0.0)).begun()
    assert bench.observer.shows_s(0.05, 1.0) == math.inf


def test_a_torque_like_frictions_at_standstill_makes_the_watch_longer():
    bench = Bench(PLAIN).begun()
    assert bench.observer.shows_s(0.05, 0.0) == 0.0
    watched_s = bench.observer.shows_s(0.05, PLAIN.coulomb)
    assert watched_s * 0.5 * PLAIN.coulomb / PLAIN.inertia >= 2.0 * 0.05
