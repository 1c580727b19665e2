"""Residual oscillation in the modes of a compliant shaft: removed from its spectral lines, or unchanged without one."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from tdhil.estimation.frequency_domain.transient import settled_lines
from tdhil.estimation.samples import Samples, Stretch
from tdhil.estimation.spectrum import PeriodLines, period_lines, pooled_lines
from tdhil.recording import Segment

LINES = (0.1, 0.2, 0.3, 0.4, 0.6)
TORQUES = np.array([1200.0, 800.0, 600.0, 500.0, 400.0]) * np.exp(1j * np.arange(5))
PERIOD_S, STEP_S, PERIODS = 10.0, 0.02, 10
MOTOR, LOAD, SPRING, DAMPING, HOLD = 1500.0, 500.0, 480.0, 4.0, 600.0
AT_A_LINE = 592.2     # spring with a resonance of both ends at 0.2 Hz
"""HOLD: gain that holds the top at its mean speed, N·m·s/rad. It damps and is a part of the torque."""


def impedance(hertz, stiffness=SPRING):
    s = 2j * np.pi * np.asarray(hertz)
    spring = stiffness / s + DAMPING
    return MOTOR * s + 1.0 / (1.0 / (LOAD * s) + 1.0 / spring)


def swinging(seed, speed_noise=1e-4, torque_noise=0.5, settled=False, stiffness=SPRING):
    """Return samples of (torque, speed) from standstill, by the exact solution with the state (ω_r, ω_L, twist)."""
    a = np.array([[-(DAMPING + HOLD) / MOTOR, DAMPING / MOTOR, -stiffness / MOTOR],
                  [DAMPING / LOAD, -DAMPING / LOAD, stiffness / LOAD], [1.0, -1.0, 0.0]])
    b = np.array([1.0 / MOTOR, 0.0, 0.0])
    time = STEP_S * np.arange(round(PERIODS * PERIOD_S / STEP_S))
    # Steady response of each tone plus the initial transient: x = Σ Re X_k e^(jωt) + e^(At) x_0.
    answers = np.array([np.linalg.solve(2j * np.pi * hz * np.eye(3) - a, b * one) for hz, one in
                        zip(LINES, TORQUES, strict=True)])
    waves = np.exp(2j * np.pi * np.outer(time, LINES))
    speed = (waves @ answers[:, 0]).real
    if not settled:
        free, step = -answers.sum(axis=0).real, expm(a * STEP_S)
        left = np.empty(len(time))
        for at in range(len(time)):
            left[at], free = free[0], step @ free
        speed = speed + left
    torque = (waves @ TORQUES).real - HOLD * speed
    rng = np.random.default_rng(seed)
    return time, speed + speed_noise * rng.standard_normal(len(time)), torque + torque_noise * rng.standard_normal(
        len(time))


def fits_of(seed, **options):
    time, speed, torque = swinging(seed, **options)
    samples = Samples(time, 5.0 + speed, 200.0 + torque)
    segment = Segment(0.0, PERIODS * PERIOD_S, PERIOD_S, 0, 5.0, LINES, (0.1,) * 5, (0.0,) * 5)
    cut = (np.split(signal, PERIODS) for signal in (time, 5.0 + speed, 200.0 + torque))
    periods = tuple(Samples(*one) for one in zip(*cut, strict=True))
    stretch = Stretch(segment, periods, tuple(range(PERIODS)))
    return (period_lines(stretch, samples),), (stretch,)


def off(lines, stiffness=SPRING):
    """Return the relative error of T/W at every line."""
    return np.array([abs(line.torque[0] / line.speed[0] / impedance(line.hertz, stiffness) - 1.0) for line in lines])


@pytest.mark.heavy
def test_the_lines_with_a_residual_oscillation_are_those_of_the_shaft():
    fits, cut = fits_of(1)
    plain, settled = pooled_lines(fits, 0.0), settled_lines(fits, cut, 0.0)
    assert np.max(off(plain)) > 0.02
    assert np.max(off(settled)) < 0.002
    assert all(one.s_ww < 0.01 * other.s_ww for one, other in zip(settled, plain, strict=True))
    assert all(7.0 < line.periods[0] < 10.0 for line in settled)       # all lines together determine it
    assert all(7.5 <= line.nu < 9.0 for line in settled)


@pytest.mark.heavy
def test_a_line_at_the_resonance_is_left_to_the_others():
    settled = settled_lines(*fits_of(1, stiffness=AT_A_LINE), 0.0)
    others = [line for line in settled if line.hertz != 0.2]
    assert len(others) == 4
    assert np.max(off(others, AT_A_LINE)) < 0.002
    assert all(line.periods[0] > 6.0 for line in others)
    assert [round(line.oscillation_steps, 1) for line in settled] == [1.0, 0.0, 1.0, 2.0, 4.0]      # 1/P is 0.1 Hz


@pytest.mark.long(but_first=2)
@pytest.mark.heavy
@pytest.mark.parametrize("seed", range(4))
def test_their_scatter_covers_their_error(seed):
    settled = settled_lines(*fits_of(seed), 0.0)
    for line in settled:
        g = impedance(line.hertz)
        error = line.torque[0] - g * line.speed[0]
        variance = line.s_tt + abs(g) ** 2 * line.s_ww - 2.0 * (np.conj(g) * line.s_tw).real
        assert abs(error) ** 2 * line.periods[0] < 25.0 * variance


def test_without_a_residual_oscillation_the_lines_are_unchanged():
    fits, cut = fits_of(2, settled=True)
    settled = settled_lines(fits, cut, 3.0)
    assert all(_alike(one, other) for one, other in zip(settled, pooled_lines(fits, 3.0), strict=True))


def test_a_few_periods_are_left_unchanged():
    (whole,), cut = fits_of(3)
    fits = (PeriodLines(LINES, *(getattr(whole, name)[:4] for name in
                                 ("speed", "torque", "ramp", "speed_mean", "torque_mean", "drift"))),)
    settled = settled_lines(fits, cut, 0.0)
    assert all(_alike(one, other) for one, other in zip(settled, pooled_lines(fits, 0.0), strict=True))


def _alike(one, other):
    return all(np.array_equal(a, b) for a, b in zip(vars(one).values(), vars(other).values(), strict=True))


def test_lines_without_the_oscillation_keep_the_allowance_for_repeating_rounding():
    """Rounding that repeats in each period affects the mean of a line and is not in the scatter."""
    fits, cut = fits_of(1)
    coarse = tuple(replace(fit, rounding=(1e-6, 0.04)) for fit in fits)
    fine, rounded = settled_lines(fits, cut, 0.0), settled_lines(coarse, cut, 0.0)
    for one, other in zip(fine, rounded, strict=True):
        assert other.s_ww - one.s_ww == pytest.approx(1e-6 * PERIODS, rel=1e-6)
        assert other.s_tt - one.s_tt == pytest.approx(0.04 * PERIODS, rel=1e-6)
        assert np.array_equal(one.speed, other.speed)
