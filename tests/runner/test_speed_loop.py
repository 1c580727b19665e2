"""Response of a drive to its setpoint, estimated from ramps of an independent integration."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tdhil.runner.excitation import MotionLimits, RigGuess, fit_following, held_back_to, make_plan
from tdhil.runner.excitation.plan import PlanRequest

STEP_S = 0.001


def course(gain, integral, lag_s, period_s, ramp=np.inf, noise=0.0):
    """Return (time, setpoint, reported) of a PI speed loop on a bare shaft with J = 1, for a ramp."""
    speed = total = seen = reference = 0.0
    rows, every = [], round(period_s / STEP_S)
    rng = np.random.default_rng(1)
    wanted = 0.0
    for n in range(int(16.0 / STEP_S)):
        if n % every == 0:
            wanted = float(np.clip((n * STEP_S - 3.0) / 3.0, 0.0, 1.0))
            rows.append((n * STEP_S, wanted, seen + noise * rng.standard_normal()))
        reference += np.clip(wanted - reference, -ramp * STEP_S, ramp * STEP_S)
        error = reference - speed
        total += integral * error * STEP_S
        speed += (gain * error + total) * STEP_S
        seen += STEP_S / lag_s * (speed - seen) if lag_s else speed - seen
    return np.array(rows).T


def test_its_filters_are_scipys():
    from scipy.signal import lfilter

    from tdhil.runner.excitation.speed_loop import _GRID_S, _response

    rng = np.random.default_rng(3)
    for _ in range(20):
        wanted, (zero, first, second, lag) = rng.normal(size=300).cumsum(), np.exp(rng.uniform(-5.0, 1.5, 4))
        k = 2.0 / _GRID_S
        top = [1.0 + zero * k, 2.0, 1.0 - zero * k]
        bottom = [1.0 + first * k + second * k * k, 2.0 - 2.0 * second * k * k, 1.0 - first * k + second * k * k]
        late = lfilter([1.0, 1.0], [1.0 + lag * k, 1.0 - lag * k], lfilter(top, bottom, wanted))
        assert _response(wanted, zero, first, second, lag) == pytest.approx(late, rel=1e-9, abs=1e-12)


@pytest.mark.heavy
@settings(max_examples=6, deadline=None)
@given(gain=st.floats(1.5, 8.0), damping=st.floats(0.7, 1.3), period_s=st.sampled_from([0.02, 0.05, 0.1]))
def test_the_loop_is_estimated_from_a_ramp(gain, damping, period_s):
    integral = (0.5 * gain / damping) ** 2
    found = fit_following(*course(gain, integral, 0.3, period_s, noise=0.003), 0.3)
    hertz = np.array([0.05, 0.1, 0.2, 0.4])
    s = 2j * np.pi * hertz
    true = (gain * s + integral) / (s * s + gain * s + integral)
    assert np.abs(found.shaft(hertz)) == pytest.approx(np.abs(true), rel=0.1)
    assert found.reported(hertz) == pytest.approx(found.shaft(hertz) / (1.0 + 0.3 * s))


def test_a_ramp_in_the_drive_is_distinguished_from_a_drive_that_follows():
    assert held_back_to(*course(4.0, 4.0, 0.3, 0.05)) is None
    signals = course(4.0, 4.0, 0.3, 0.05, ramp=0.2)
    assert held_back_to(*signals) == pytest.approx(0.2, rel=0.08)
    assert fit_following(*signals, 0.3, 0.2) is not None


def test_no_loop_is_estimated_from_a_speed_that_does_not_follow():
    time, setpoint, reported = course(4.0, 4.0, 0.3, 0.05)
    assert fit_following(time, setpoint, np.random.default_rng(2).normal(size=len(time))) is None
    assert fit_following(time, 0.0 * setpoint, reported) is None
    assert held_back_to(time, 0.0 * setpoint, reported) is None
    assert held_back_to(time, setpoint, 0.0 * reported) is None


def test_a_plan_leaves_room_for_a_loop_that_overshoots():
    """A simulation of the loop shows that the shaft stays within the window, thanks to the margin of the plan."""
    limits = MotionLimits(0.5, 10.0, 1e6)
    following = fit_following(*course(1.5, 2.0, 0.0, 0.02))
    plain = make_plan(limits, RigGuess(1.0), PlanRequest(mode="speed"))
    aware = make_plan(limits, RigGuess(1.0, following=following), PlanRequest(mode="speed"))
    assert aware.segments[0].reference.amplitudes_rad_s[0] < plain.segments[0].reference.amplitudes_rad_s[0]
    for segment in aware.segments:
        reference = segment.reference
        hertz = np.array(reference.lines_hz)
        gains = following.shaft(hertz) * reference.amplitudes_rad_s * np.exp(1j * np.array(reference.phases_rad))
        time = np.linspace(0.0, reference.period_s, 2000)
        wave = reference.offset_rad_s + (np.exp(2j * np.pi * np.outer(time, hertz)) @ gains).real
        assert limits.usable_low_rad_s <= wave.min() <= wave.max() <= limits.usable_high_rad_s
