"""Uncertainty budget, compared with GTC, the GUM Tree Calculator of the New Zealand metrology institute."""

import math

import numpy as np
import pytest

from tdhil.calibration import BodyRun, CalibrationCase, calibrate_torque

GTC = pytest.importorskip("GTC")
NU = 60.0


def test_gtc_gives_the_same_values_uncertainties_and_degrees_of_freedom():
    values, sd, shared = np.array([109.4, 167.2]), np.array([0.21, 0.33]), 0.0015
    covariance = np.diag(sd**2) + shared**2 * np.outer(values, values)
    runs = (BodyRun("without", 0.0), BodyRun("with", 55.0, 0.1))
    found = calibrate_torque(CalibrationCase(runs, values, covariance, np.diag(sd**2), NU, None))
    whole = np.sqrt(np.diag(covariance))
    first, second = GTC.multiple_ureal(values.tolist(), whole.tolist(), NU)
    GTC.set_correlation(float(covariance[0, 1] / whole[0] / whole[1]), first, second)
    body = GTC.ureal(55.0, 0.1)
    factor = body / (second - first)
    inertia = factor * first
    for ours, theirs in ((found.factor, factor), (found.inertia_kg_m2, inertia)):
        assert ours.value == pytest.approx(GTC.value(theirs), rel=1e-6)
        assert ours.standard_uncertainty == pytest.approx(GTC.uncertainty(theirs), rel=1e-6)
        assert ours.degrees_of_freedom == pytest.approx(GTC.dof(theirs), rel=1e-6)
        k = GTC.reporting.k_factor(ours.degrees_of_freedom, 95)
        assert ours.coverage_factor == pytest.approx(k, rel=1e-6)
    of_body = next(line for line in found.budget if line.source == "body of with")
    assert of_body.of_factor * found.factor.value == pytest.approx(abs(GTC.component(factor, body)), rel=1e-6)
    assert of_body.of_inertia * found.inertia_kg_m2.value == pytest.approx(abs(GTC.component(inertia, body)), rel=1e-6)
    total = math.sqrt(sum(line.of_inertia**2 for line in found.budget)) * found.inertia_kg_m2.value
    assert total == pytest.approx(GTC.uncertainty(inertia), rel=1e-6)
