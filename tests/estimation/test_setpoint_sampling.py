"""Error of J from sampling in step with a stepped setpoint: compared with a simulation, and in the interval."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import cont2discrete, lfilter

from tdhil.estimation.setpoint_sampling import (
    EXACT_READING,
    NEGLIGIBLE,
    ReadMoment,
    reading_share,
    usual_loops,
    worst_share,
)
from tdhil.recording.recording import SteppedSetpoint

FINE = 64


def read_shares(stepped, lag_s, longest_s=100.0):
    """Return J_read/J − 1 at every time within a cycle, for a uniform acceleration in steps, from all step responses.

    A library computes the step response in the time domain, not by residues.
    """
    top = np.array([stepped.zero_s, 1.0, 0.0])
    bottom = np.polymul([stepped.second_s2, stepped.first_s, 1.0], [lag_s, 1.0])
    numerator, denominator, _ = cont2discrete((top, bottom), stepped.period_s / FINE)
    cycles = int(longest_s / stepped.period_s)
    answer = lfilter(numerator.ravel(), denominator, np.ones(cycles * FINE))
    return stepped.period_s * answer.reshape(cycles, FINE).sum(axis=0) - 1.0


@settings(max_examples=30, deadline=None)
@given(
    gain=st.floats(1.0, 8.0), damping=st.floats(0.7, 1.5), period_s=st.sampled_from([0.05, 0.1]),
    lag_s=st.sampled_from([0.05, 0.15]),
)
def test_the_worst_share_is_that_at_the_worst_time(gain, damping, period_s, lag_s):
    integral = (0.5 * gain / damping) ** 2
    stepped = SteppedSetpoint(period_s, gain / integral, gain / integral, 1.0 / integral)
    seen = float(np.max(np.abs(read_shares(stepped, lag_s))))
    assert worst_share(stepped, lag_s) == pytest.approx(seen, rel=0.1, abs=3e-4)


def test_a_slow_response_counts_to_its_end():
    slow = SteppedSetpoint(0.25, 32.2, 58.2, 95.0)      # a pole at 0.017 rad/s: 9 % of its response remains after 40 s
    assert worst_share(slow, 0.05) == pytest.approx(float(np.max(np.abs(read_shares(slow, 0.05, 600.0)))), rel=0.1)


def test_an_unstable_loop_may_add_any_share():
    unstable = SteppedSetpoint(0.1, 1.0, -1.0, 1.0)
    assert worst_share(unstable, 0.1) == 0.5
    assert reading_share((*usual_loops(0.1), unstable), None, 0.1).sd == 0.5


def test_it_vanishes_with_a_short_cycle_and_with_lag():
    loop = (1.0, 1.0, 0.35)
    shares = [worst_share(SteppedSetpoint(period_s, *loop), 0.15) for period_s in (0.1, 0.05, 0.02, 0.004)]
    assert shares == sorted(shares, reverse=True)
    assert shares[0] > 0.01
    assert shares[-1] < NEGLIGIBLE
    assert worst_share(SteppedSetpoint(0.1, *loop), 0.0) > 0.1 > worst_share(SteppedSetpoint(0.1, *loop), 0.05)
    assert np.isfinite(worst_share(SteppedSetpoint(0.1, 1.0, 1.0, 0.25), 0.5))      # a double pole


def pi_loop(period_s, gain=3.0, integral=1.0):
    """Return H of a PI loop without friction, with gains divided by J."""
    return SteppedSetpoint(period_s, gain / integral, gain / integral, 1.0 / integral)


def staircase_skew(period_s, lag_s, after_s):
    """Return the time by which a torque with one setpoint per cycle is read later than it acts, s, for a slow ramp."""
    fine = period_s / 256
    held = np.repeat(np.arange(4000) * period_s, 256)
    keep = np.exp(-fine / lag_s)
    told = lfilter([1.0 - keep], [1.0, -keep], held)
    time = np.arange(len(held)) * fine
    at = 256 * 3000 + round(after_s / fine)
    acts = time[at] - 0.5 * period_s - lag_s       # a straight line through the steps, after the lag
    return acts - told[at]


@pytest.mark.parametrize("after", [0.1, 0.3, 0.5, 0.8])
@pytest.mark.parametrize("lag_s", [1e-5, 0.01, 0.03])
def test_the_skew_of_torque_mode_gives_the_error_of_a_ramp_in_speed_mode(after, lag_s):
    period_s = 1.0 / 15.0
    stepped = pi_loop(period_s)
    skew = staircase_skew(period_s, lag_s, after * period_s)
    found = reading_share([stepped], ReadMoment(skew, 0.001, lag_s))
    shares = read_shares(stepped, lag_s)
    assert found.value == pytest.approx(shares[round(after * FINE)], abs=max(3.0 * found.sd, 2e-3))
    assert found.sd < 0.35 * np.max(np.abs(shares))


def test_without_a_skew_every_time_is_equally_likely():
    stepped = pi_loop(0.1)
    found = reading_share([stepped], None)
    assert abs(found.value) < 0.1 * found.sd
    assert found.sd == pytest.approx(float(np.std(read_shares(stepped, 0.0))), rel=0.05)


def test_a_negligible_share_is_none():
    moment = ReadMoment(0.0, 0.001, 0.15)
    assert reading_share([pi_loop(0.004)], moment) == EXACT_READING
    assert reading_share(usual_loops(0.004), None, 0.15) == EXACT_READING


def test_an_unknown_loop_gives_a_wider_interval():
    moment = ReadMoment(-0.014, 0.001, 0.0)
    known = reading_share([pi_loop(1.0 / 15.0)], moment)
    usual = reading_share(usual_loops(1.0 / 15.0), moment)
    assert usual.sd > 1.5 * known.sd
    assert abs(usual.value - known.value) < usual.sd
