"""Fits with first-order lags and with the whole family of filters, and the weight of each.

The family of report filters (signal_filters.py) is fitted twice: with first-order lags only, and complete. The first
fit is more precise if it is true, and biased if not. The second is right in both cases, and less precise. It is
preferred if its three additional parameters lower −2 ln L by more than Schwarz's 3 ln n, with n real numbers fitted.
Near this limit both count:

    weight of the first-order fit = 1/(1 + e^((D/r − 3 ln n)/2)),    D = −2 ln L_first + 2 ln L_whole ≥ 0,

with r, the factor by which −2 ln L changes too much, because its weights are estimates (`excess_rise`). This weight is
for the value. An interval always uses the whole family.

The descents of the whole family begin near the first-order fit. Lower minima far from it occur sometimes, in corners
where the filters of the two reports nearly cancel. They are fits to noise, and using them increases scatter and reduces
coverage (tried on the plants of the coverage study).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from tdhil.estimation.frequency_domain.likelihood import Likelihood
from tdhil.estimation.frequency_domain.optimiser import (
    Apart,
    Box,
    Fit,
    Fixed,
    best_fit,
    box,
    minimise,
    rough_inertia_of,
)
from tdhil.estimation.frequency_domain.signal_filters import AVERAGE, SPEED_SHAPE, TORQUE_SHAPE
from tdhil.recording import FloatArray

# start values of the whole family, besides the first-order fit
_SHAPES = ((SPEED_SHAPE, 0.25), (TORQUE_SHAPE, 0.25), (AVERAGE, 0.1), (AVERAGE, -0.1))


@dataclass(frozen=True)
class FittedModel:
    """Two fits of one model. ``fixed``: parameters that are known exactly, for any structure."""

    problem: Likelihood
    limits: Box
    fixed: Fixed
    simple: Fit             # fit with first-order lags
    whole: Fit              # fit with the whole family
    simple_weight: float    # weight of the first-order fit, 0 to 1
    rivals: tuple[Fit, ...] = ()     # other minima of the whole family

    @property
    def simple_held(self) -> Fixed:
        """Parameters held in the first-order fit."""
        return {**dict.fromkeys(self.problem.model.structure, 0.0), **self.fixed}

    @property
    def free(self) -> list[int]:
        """Return the free parameters of the whole family."""
        return [index for index in range(self.problem.model.size) if index not in self.fixed]

    @property
    def first_order(self) -> bool:
        """True if the first-order fit is the likelier one."""
        return self.simple_weight >= 0.5

    @property
    def likelier(self) -> Fit:
        """Return the likelier of the two fits."""
        return self.simple if self.first_order else self.whole

    def value(self, row: FloatArray) -> float:
        """Return the estimate of a linear combination of theta, row (P,)."""
        share = self.simple_weight
        return float(share * (row @ self.simple.theta) + (1.0 - share) * (row @ self.whole.theta))


def fit_model(
    problem: Likelihood,
    fixed: Fixed,
    starts: Sequence[FloatArray],
    rivals_of: Callable[[FloatArray], list[FloatArray]] | None = None,
    apart: Apart | None = None,
) -> FittedModel:
    """Fit ``problem`` from several ``starts`` (P,) each; ``rivals_of``: start values of other possible minima.

    ``apart``: solutions that are accepted only with more gain than a stated minimum.
    """
    model = problem.model
    limits = box(problem, rough_inertia_of(problem))
    first_order = {**dict.fromkeys(model.structure, 0.0), **fixed}
    simple = best_fit(problem, limits, first_order, starts, apart)
    open_structure = [index for index in model.structure if index not in fixed]
    others = tuple(minimise(problem, limits, start, fixed) for start in (rivals_of(simple.theta) if rivals_of else []))
    if not open_structure:
        return FittedModel(problem, limits, fixed, simple, simple, 1.0, others)
    begin = [simple.theta]
    for shape, value in _SHAPES:
        if model.at(shape) not in fixed:
            begin.append(simple.theta.copy())
            begin[-1][model.at(shape)] = value
    whole = best_fit(problem, limits, fixed, begin, apart, [simple])
    gain = (simple.objective - whole.objective) / excess_rise(problem, model.size - len(fixed))
    weight = simple_weight(gain, len(open_structure), problem.numbers)
    return FittedModel(problem, limits, fixed, simple, whole, weight, others)


def simple_weight(gain: float, more: int, numbers: int) -> float:
    """Return the weight of the fit with ``more`` fewer parameters; ``gain``: decrease of −2 ln L by these
    parameters.
    """
    return 1.0 / (1.0 + math.exp(min(0.5 * (gain - more * math.log(numbers)), 700.0)))


def excess_rise(problem: Likelihood, fitted: int) -> float:
    """Return the excess change of −2 ln L over χ²: 1 + p/(4ν), p parameters ``fitted``, ν complex d.o.f. of a weight.

    Fitted parameters follow those lines whose scatter is small by chance. The factor was measured, on first-order and
    on other plants: without it 7 to 8 % of the intervals miss instead of 5 %. (Parameters held by priors are not
    counted.)
    """
    nu = float(np.median(problem.nu))
    return 1.0 + (fitted - problem.held) / (4.0 * max(nu, 1.0))


def likeliest(fitted: FittedModel) -> float:
    """Return −2 ln L with first-order lags, or of the whole family plus Schwarz's penalty for its structure."""
    price = len([index for index in fitted.problem.model.structure if index not in fitted.fixed])
    rise = excess_rise(fitted.problem, len(fitted.free))
    whole = fitted.whole.objective + rise * price * math.log(fitted.problem.numbers)
    return min(fitted.simple.objective, whole)


def unit(fitted: FittedModel, index: int) -> FloatArray:
    """Return the row (P,) that selects one parameter."""
    row = np.zeros(fitted.problem.model.size)
    row[index] = 1.0
    return row
