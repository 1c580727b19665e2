"""A report without lag is where descents could stand still: a short lag is felt through its square alone."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from tdhil.estimation.frequency_domain import signal_filters
from tdhil.estimation.frequency_domain.likelihood import Likelihood
from tdhil.estimation.frequency_domain.model import Model
from tdhil.estimation.frequency_domain.optimiser import box, minimise, rough_inertia_of
from tests.estimation.test_two_mass import synthetic

AT = Model().at
AVERAGE_S = 0.645
HERTZ = (0.2, 0.4, 0.6, 0.8)


class Averaged:
    """A rigid shaft whose speed is shown as a moving average besides, its delay of half the window left out."""

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
    """scipy, begun at the truth, is the oracle; a descent from the best fit without torque's lag gets as low."""
    truth = truth_of(0.215, 0.136)
    lines, constraint = synthetic(Averaged(), seed, 0.3, HERTZ, lags=(0.215, 0.136))
    problem = Likelihood(lines, Model(), constraint, ())
    limits = box(problem, rough_inertia_of(problem))
    inside = 1e-6 * limits.scale
    best = least_squares(problem.residuals, np.clip(truth, limits.low + inside, limits.high - inside),
                         bounds=(limits.low, limits.high), x_scale=limits.scale, xtol=1e-12)
    without = minimise(problem, limits, truth, {AT(signal_filters.TORQUE_LAG): 0.0})
    found = minimise(problem, limits, without.theta, {})
    assert found.objective <= 2.0 * best.cost + 0.1      # an interval ends where it has risen by four
