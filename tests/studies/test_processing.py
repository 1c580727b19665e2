"""Equations 7, 11 to 13 and 16 against closed forms."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal

from tdhil.studies.paper.processing import (
    amplitude,
    backward_difference,
    fundamental,
    gain,
    phase_by_zeros,
    response,
    rising_zeros,
    settled_periods,
    torque_line,
)

TIME = np.arange(0.0, 10.0, 0.001)


def test_backward_difference_is_exact_for_a_ramp_and_central_for_a_parabola():
    assert np.allclose(backward_difference(TIME, 3.0 * TIME + 1.0), 3.0)
    assert np.allclose(backward_difference(TIME, TIME**2), 2.0 * (TIME[1:] - 0.0005))


def test_the_line_gives_inertia_and_intercept():
    speed = 5.0 + np.sin(2.0 * np.pi * 0.5 * TIME)
    torque = np.empty_like(speed)
    torque[0] = 0.0
    torque[1:] = 104.0 * backward_difference(TIME, speed) + 73.0
    fit = torque_line(TIME, speed, torque)
    assert fit.inertia_kg_m2 == pytest.approx(104.0)
    assert fit.intercept_nm == pytest.approx(73.0)


def test_pairing_with_the_later_torque_adds_half_a_sample_of_viscous_friction():
    """With exact samples of T = Jα + Bω, the slope over whole periods is J + B·Ts/2."""
    step_s, turn = 0.01, 2.0 * np.pi * 0.5
    time = np.arange(0.0, 10.0 + step_s / 2, step_s)
    fit = torque_line(time, np.sin(turn * time), 100.0 * turn * np.cos(turn * time) + 80.0 * np.sin(turn * time))
    assert fit.inertia_kg_m2 == pytest.approx(100.0 + 80.0 * step_s / 2, rel=2e-4)


def test_without_motion_there_is_no_line():
    with pytest.raises(ValueError, match="never changes"):
        torque_line(TIME, np.ones_like(TIME), TIME)


def test_gain_is_output_over_input_not_the_printed_equation_12():
    assert amplitude(3.0 + 2.0 * np.sin(TIME)) == pytest.approx(2.0, abs=1e-6)
    assert gain(0.5 * np.sin(TIME), np.sin(TIME)) == pytest.approx(0.5)


@pytest.mark.heavy
@given(
    lag=st.floats(-3.0, 3.0), size=st.floats(0.01, 10.0), offset=st.floats(-10.0, 10.0),
    frequency=st.sampled_from([0.5, 1.0, 2.0]),
)
def test_both_phases_find_the_lag_of_a_sine(lag, size, offset, frequency):
    given_ = np.sin(2.0 * np.pi * frequency * TIME)
    output = offset + size * np.sin(2.0 * np.pi * frequency * TIME - lag)
    found = response(TIME, given_, output, frequency)
    assert np.radians(found.lag_zeros_deg) == pytest.approx(lag, abs=1e-3)
    assert np.radians(found.lag_fundamental_deg) == pytest.approx(lag, abs=1e-6)
    assert found.gain_fundamental == pytest.approx(size)
    assert found.gain == pytest.approx(size, rel=1e-4)


def test_against_the_frequency_response_of_a_filter():
    lowpass = signal.TransferFunction([1.0], [0.2, 1.0])
    asked = np.sin(2.0 * np.pi * TIME)
    _, output, _ = signal.lsim(lowpass, asked, TIME)
    _, expected = signal.freqresp(lowpass, [2.0 * np.pi])
    window = slice(5000, 10000)
    found = response(TIME[window], asked[window], output[window], 1.0)
    assert found.gain_fundamental == pytest.approx(abs(expected[0]), rel=1e-4)
    assert found.lag_fundamental_deg == pytest.approx(-np.degrees(np.angle(expected[0])), abs=0.01)
    assert found.lag_zeros_deg == pytest.approx(found.lag_fundamental_deg, abs=0.05)


def test_the_fundamental_is_insensitive_to_harmonics_and_noise():
    rng = np.random.default_rng(3)
    pure = np.sin(2.0 * np.pi * TIME)
    dirty = pure + 0.3 * np.sin(6.0 * np.pi * TIME + 1.0) + 0.05 * rng.standard_normal(len(TIME))
    ratio = fundamental(TIME, dirty, 1.0) / fundamental(TIME, pure, 1.0)
    assert abs(np.angle(ratio)) < 0.005
    assert abs(phase_by_zeros(TIME, dirty, pure, 1.0)) > 0.05


def test_the_fundamental_is_the_fourier_coefficient_over_whole_periods():
    wave = signal.sawtooth(2.0 * np.pi * TIME)
    fourier = 2.0 / len(TIME) * np.sum(wave * np.exp(-2j * np.pi * TIME))
    assert fundamental(TIME, wave, 1.0) == pytest.approx(fourier, abs=1e-9)


def test_without_a_crossing_there_is_no_phase():
    assert np.isnan(phase_by_zeros(TIME, np.ones_like(TIME), np.sin(TIME), 1.0))
    assert len(rising_zeros(TIME, np.zeros_like(TIME))) == 0


def test_settled_periods():
    assert settled_periods(10_000, 0.001, 1.0) == slice(5000, 10_001)
    assert settled_periods(25_000, 0.001, 10.0) == slice(15_000, 25_001)
    assert settled_periods(10_000, 0.001, 5.1) is None
