"""Small-sample uncertainty of a joint fit: the rule, compared with a weighted mean with estimated weights."""

from __future__ import annotations

import numpy as np
import pytest

from tdhil.estimation.shared_filters import _inverse, _shares, rise_by_weights, satterthwaite

DOF = [(4.0, 4.0), (6.0, 12.0, 30.0), (3.0, 18.0, 18.0, 18.0)]
LINES, RUNS = 20, 40_000


def parts_of(weights, dof):
    return [(np.array([0]), np.array([[weight]]), nu) for weight, nu in zip(weights, dof, strict=True)]


def shares_of(weights, dof):
    inverse = _inverse(np.array([[sum(weights)]]), [0])
    return _shares(inverse[0], inverse, parts_of(weights, dof), [0])


@pytest.mark.parametrize("dof", DOF)
def test_the_increase_is_half_of_meier_s_for_a_weighted_mean(dof):
    """Meier (Biometrics 9, 1953): (1/W)(1 + 4 Σ p (1 − p)/n), p = w/W. `Likelihood.information` has the other half."""
    weights = np.arange(1.0, len(dof) + 1.0)
    share = weights / weights.sum()
    assert rise_by_weights(shares_of(weights, dof)) == pytest.approx(1.0 + 2.0 * np.sum(share * (1.0 - share) / dof))


@pytest.mark.parametrize("nu", [6.0, *(pytest.param(one, marks=pytest.mark.heavy) for one in (10.0, 20.0))])
def test_the_stated_variance_is_that_of_a_mean_with_estimated_weights(nu):
    """The ratio of the mean stated variance to the variance of the estimates is 1, for 20 lines of a complex signal.

    A weight is a reciprocal variance from χ² with 2ν degrees of freedom, times (ν − 1)/ν, as that of a line in the fit.
    """
    rng, dof = np.random.default_rng(3), np.full(LINES, 2.0 * nu)
    true_sd = np.linspace(1.0, 3.0, LINES)
    values = rng.normal(size=(RUNS, LINES)) * true_sd
    variances = true_sd**2 * rng.chisquare(dof, size=(RUNS, LINES)) / dof
    weights = (nu - 1.0) / nu / variances
    estimates = (weights * values).sum(axis=1) / weights.sum(axis=1)
    stated = [rise_by_weights(shares_of(one, dof)) / one.sum() for one in weights[:2000]]
    assert np.mean(stated) / np.var(estimates) == pytest.approx(1.0, abs=0.05)


def test_one_line_alone_has_its_own_degrees_of_freedom_and_no_increase():
    shares = shares_of([2.0], [7.0])
    assert satterthwaite(shares) == pytest.approx(7.0) and rise_by_weights(shares) == pytest.approx(1.0)
