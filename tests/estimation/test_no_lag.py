"""Cases in which a descent could stall: no lag, where a short lag acts by its square only; bounds; ridges."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from tdhil.estimation.frequency_domain import fit_inertia, signal_filters
from tdhil.estimation.frequency_domain.inference import quantile_of
from tdhil.estimation.frequency_domain.likelihood import Likelihood
from tdhil.estimation.frequency_domain.model import Model
from tdhil.estimation.frequency_domain.optimiser import box, descend, minimise, rough_inertia_of
from tdhil.estimation.frequency_domain.shafts import INERTIA
from tests.estimation.test_two_mass import synthetic

AT = Model().at
AVERAGE_S = 0.645
HERTZ = (0.2, 0.4, 0.6, 0.8)


class Averaged:
    """Rigid shaft whose reported speed is also a moving average, without its delay of half the window."""

    def impedance(self, hz):
        return (104.0 * 2j * np.pi * hz + 8.0) / np.sinc(hz * AVERAGE_S)


def truth_of(speed_lag, torque_lag):
    theta = np.zeros(Model().size)
    theta[:2] = 104.0, 8.0
    theta[AT(signal_filters.SPEED_LAG)], theta[AT(signal_filters.TORQUE_LAG)] = speed_lag, torque_lag
    theta[AT(signal_filters.AVERAGE)] = -(AVERAGE_S**2)
    return theta


@pytest.mark.parametrize("seed", range(4))
def test_a_descent_that_begins_without_a_lag_finds_it(seed):
    """The oracle is scipy, started at the true values. A descent from the best fit without torque lag is as low."""
    truth = truth_of(0.215, 0.136)
    lines, constraint = synthetic(Averaged(), seed, 0.3, HERTZ, lags=(0.215, 0.136))
    problem = Likelihood(lines, Model(), constraint, ())
    limits = box(problem, rough_inertia_of(problem))
    inside = 1e-6 * limits.scale
    best = least_squares(problem.residuals, np.clip(truth, limits.low + inside, limits.high - inside),
                         bounds=(limits.low, limits.high), x_scale=limits.scale, xtol=1e-12)
    without = minimise(problem, limits, truth, {AT(signal_filters.TORQUE_LAG): 0.0})
    found = minimise(problem, limits, without.theta, {})
    assert found.objective <= 2.0 * best.cost + 0.1      # an interval ends at a rise of four


class Rigid:
    """Shaft with 104 kg·m² and 8 N·m·s/rad."""

    def impedance(self, hz):
        return 104.0 * 2j * np.pi * hz + 8.0


@pytest.mark.parametrize("seed", range(4, 8))
@pytest.mark.parametrize("share", [0.985, 1.015])
def test_a_descent_along_bounds_finds_the_minimum(seed, share):
    """J is fixed away from its best value, as in a profile. The oracle is scipy, started at the end of the descent."""
    lines, constraint = synthetic(Rigid(), seed, 0.3, (0.1, 0.2, 0.3, 0.5, 0.7, 1.0), lags=(0.4, 0.15))
    problem = Likelihood(lines, Model(), constraint, ())
    limits = box(problem, rough_inertia_of(problem))
    start = np.zeros(Model().size)
    start[:2] = 104.0, 8.0
    start[AT(signal_filters.SPEED_LAG)], start[AT(signal_filters.TORQUE_LAG)] = 0.4, 0.15
    start = minimise(problem, limits, start, {}).theta
    start[INERTIA] *= share
    start[AT(signal_filters.SPEED_SHAPE)] = 0.25
    free = np.arange(len(start)) != INERTIA
    found = descend(problem.at, start, free, limits)
    inside = 1e-7 * limits.scale

    def with_free(theta):
        whole = start.copy()
        whole[free] = theta
        return whole

    best = least_squares(
        lambda theta: problem.residuals(with_free(theta)),
        np.clip(found.theta, limits.low + inside, limits.high - inside)[free],
        jac=lambda theta: problem.linearised(with_free(theta))[1][:, free],
        bounds=(limits.low[free], limits.high[free]), x_scale=limits.scale[free], xtol=1e-13, ftol=1e-13, gtol=1e-13,
    )
    assert found.objective <= 2.0 * best.cost + 5e-4


class ThreePoles:
    """Rigid shaft whose reported speed and torque both pass through three poles."""

    def impedance(self, hz):
        s = 2j * np.pi * hz
        poles = [np.prod([1.0 + lag * s for lag in lags], axis=0) for lags in ((0.22, 0.15, 0.1), (0.1, 0.06, 0.04))]
        return (104.0 * s + 8.0) * poles[0] / poles[1]


@pytest.mark.heavy
@pytest.mark.parametrize("seed", [
    0, pytest.param(1, marks=pytest.mark.heavy), *(pytest.param(seed, marks=pytest.mark.long) for seed in range(2, 6)),
])
def test_no_fit_beyond_a_ridge_is_lower_at_an_edge(seed):
    """A descent from a filter with one pole does not reach a filter with two poles and an average."""
    lines, constraint = synthetic(ThreePoles(), seed, 0.8, (0.1, 0.2, 0.3, 0.4, 0.5, 0.6), lags=(0.0, 0.0))
    inertia, _, fitted = fit_inertia(lines, constraint, (), {}, 0.95)
    rise = quantile_of(fitted, INERTIA, 0.95) ** 2
    rng = np.random.default_rng(seed)
    for edge in (inertia.low, inertia.high):
        for _ in range(20):
            start = fitted.whole.theta.copy()
            start[INERTIA] = edge
            start[2:] = rng.uniform((0.0, 0.0, 0.0, 0.0, -0.3, -0.3), (0.6, 0.5, 0.4, 0.5, 0.3, 0.3))
            other = minimise(fitted.problem, fitted.limits, start, {INERTIA: edge})
            assert other.objective > fitted.whole.objective + 0.9 * rise
