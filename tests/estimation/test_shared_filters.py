"""The uncertainty of the joint fit of several runs: it must be that of its errors, with few periods as with many."""

import math

import numpy as np
import pytest

from tdhil.estimation import shared_filters
from tdhil.estimation.frequency_domain.filter_order import FittedModel
from tdhil.estimation.frequency_domain.likelihood import Likelihood
from tdhil.estimation.frequency_domain.model import Model
from tdhil.estimation.frequency_domain.optimiser import Fit, box, rough_inertia_of
from tdhil.estimation.friction_levels import ViscousConstraint
from tdhil.estimation.spectrum import SpectralLine

HERTZ = 0.1 * np.array([1.0, 2.0, 3.0, 4.0, 6.0])
VISCOUS, SPEED_LAG, TORQUE_LAG = 8.0, 0.3, 0.1
VISCOUS_SD = 0.2


def theta_of(inertia: float) -> np.ndarray:
    return np.array([inertia, VISCOUS, SPEED_LAG, 0.0, TORQUE_LAG, 0.0, 0.0, 0.0])


def drawn(inertia: float, periods: int, rng: np.random.Generator) -> FittedModel:
    """One run: lines of a load that disturbs each period anew, at two mean speeds, fitted at the truth."""
    theta, model, lines = theta_of(inertia), Model(), []
    s = 2j * np.pi * HERTZ
    impedance = model.impedance(theta, s)
    for hertz, g, amplitude in zip(HERTZ, impedance, 180.0 / inertia * (0.1 / HERTZ) ** 2, strict=True):
        sd = math.sqrt(3.6 / (1.0 + (math.pi * hertz) ** 2) / 2.0)
        load, own = (sd * size * (rng.standard_normal((2, periods)) + 1j * rng.standard_normal((2, periods)))
                     for size in (1.0, 0.05))
        torque = g * amplitude + own
        speed = (torque - load) / g
        dw, dt = (signal - signal.mean(axis=1, keepdims=True) for signal in (speed, torque))
        nu = 2.0 * (periods - 1)
        lines.append(SpectralLine(
            float(hertz), speed.mean(axis=1), torque.mean(axis=1), np.full(2, float(periods)),
            float(np.sum(np.abs(dw) ** 2)) / nu, float(np.sum(np.abs(dt) ** 2)) / nu,
            complex(np.sum(dt * dw.conj())) / nu, nu))
    dof = 2.0 * periods - 2.0
    tie = ViscousConstraint(VISCOUS + VISCOUS_SD * rng.standard_normal(), 0.0,
                            VISCOUS_SD * math.sqrt(rng.chisquare(dof) / dof), dof)
    problem = Likelihood(tuple(lines), model, tie, ())
    fit = Fit(theta, problem.objective(theta))
    return FittedModel(problem, box(problem, rough_inertia_of(problem)), {}, fit, fit, 1.0)


@pytest.mark.heavy
@pytest.mark.parametrize("periods", [(3, 3), (10, 6)])
def test_the_stated_uncertainty_is_that_of_the_errors(monkeypatch, periods):
    monkeypatch.setattr(shared_filters, "_fitted", lambda run: run)
    rng, scaled = np.random.default_rng(28), []
    true = np.array([100.0, 200.0])
    for _ in range(150):
        runs = [drawn(inertia, many, rng) for inertia, many in zip(true, periods, strict=True)]
        found = shared_filters.identify_together(runs)
        row = np.array([1.0, -1.0]) / found.inertia_kg_m2
        error = float(np.array([1.0, -1.0]) @ np.log(found.inertia_kg_m2 / true))
        scaled.append(error / math.sqrt(row @ found.covariance @ row))
    assert 0.85 < math.sqrt(np.mean(np.square(scaled))) < 1.15


@pytest.mark.parametrize(("lines", "dof"), [(1, 6.0), (2, 6.0), (5, 40.0)])
def test_only_a_choice_among_estimated_weights_adds_uncertainty(lines, dof):
    """Equal lines that determine one value: Kenward and Roger's term is 2/n of the variance, less the mean's own."""
    shares = [shared_filters._Share(1.0 / lines, 1.0 / lines**2, dof)] * lines
    assert shared_filters._rise_by_weights(shares) == pytest.approx(1.0 + 2.0 / dof * (1.0 - 1.0 / lines))
    assert shared_filters._satterthwaite(shares) == pytest.approx(lines * dof)


def test_an_exact_part_adds_none():
    assert shared_filters._rise_by_weights([shared_filters._Share(1.0, 0.5, math.inf)]) == 1.0
