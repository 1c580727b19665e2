"""What sampling in step with a stepped setpoint may do to J: against a brute-force simulation, and in the interval."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import cont2discrete, lfilter

from tdhil.estimation.setpoint_sampling import NEGLIGIBLE, worst_share
from tdhil.recording.recording import SteppedSetpoint

FINE = 64


def read_shares(stepped, lag_s):
    """J_read/J − 1 at every moment of a cycle, of a uniform acceleration in steps: the answers to all steps so far.

    The answer to one of them is made in the time domain by a library, not by residues.
    """
    top = np.array([stepped.zero_s, 1.0, 0.0])
    bottom = np.polymul([stepped.second_s2, stepped.first_s, 1.0], [lag_s, 1.0])
    numerator, denominator, _ = cont2discrete((top, bottom), stepped.period_s / FINE)
    cycles = int(100.0 / stepped.period_s)
    answer = lfilter(numerator.ravel(), denominator, np.ones(cycles * FINE))
    return stepped.period_s * answer.reshape(cycles, FINE).sum(axis=0) - 1.0


@settings(max_examples=30, deadline=None)
@given(
    gain=st.floats(1.0, 8.0), damping=st.floats(0.7, 1.5), period_s=st.sampled_from([0.05, 0.1]),
    lag_s=st.sampled_from([0.05, 0.15]),
)
def test_the_worst_share_is_the_worst_moment_s(gain, damping, period_s, lag_s):
    integral = (0.5 * gain / damping) ** 2
    stepped = SteppedSetpoint(period_s, gain / integral, gain / integral, 1.0 / integral)
    seen = float(np.max(np.abs(read_shares(stepped, lag_s))))
    assert worst_share(stepped, lag_s) == pytest.approx(seen, rel=0.1, abs=3e-4)


def test_it_vanishes_with_a_short_cycle_and_with_lag():
    loop = (1.0, 1.0, 0.35)
    shares = [worst_share(SteppedSetpoint(period_s, *loop), 0.15) for period_s in (0.1, 0.05, 0.02, 0.004)]
    assert shares == sorted(shares, reverse=True)
    assert shares[0] > 0.01
    assert shares[-1] < NEGLIGIBLE
    assert worst_share(SteppedSetpoint(0.1, *loop), 0.0) > 0.1 > worst_share(SteppedSetpoint(0.1, *loop), 0.05)
    assert np.isfinite(worst_share(SteppedSetpoint(0.1, 1.0, 1.0, 0.25), 0.5))      # poles that meet
