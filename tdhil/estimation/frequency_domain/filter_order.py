"""First-order lags or not: both answers fitted, and how much each weighs.

The reports' family (signal_filters.py) is fitted twice: with first-order lags alone, and whole. The first is the
sharper where it is true and biased where it isn't; the second is right in both cases and less sharp. Its three
parameters more must lower −2 ln L by more than Schwarz's 3 ln n, n real numbers fitted, to be preferred; about there,
both count:

    weight of the first-order fit = 1/(1 + e^((D/r − 3 ln n)/2)),    D = −2 ln L_first + 2 ln L_whole ≥ 0,

and r the share by which −2 ln L rises and falls too much, since its weights are estimates themselves (`excess_rise`).
That is for the value. An interval rests on the whole family always, whatever the weight.

The descents of the whole family begin near the first-order fit. Lower minima far from it exist now and then, in corners
where filters of the two reports all but cancel; they are noise fitted, and following them costs both scatter and
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

# where the whole family's descents begin, besides the first-order fit itself
_SHAPES = ((SPEED_SHAPE, 0.25), (TORQUE_SHAPE, 0.25), (AVERAGE, 0.1), (AVERAGE, -0.1))


@dataclass(frozen=True)
class FittedModel:
    """A model's two fits. ``fixed``: parameters that are known for certain, whatever the structure."""

    problem: Likelihood
    limits: Box
    fixed: Fixed
    simple: Fit             # first-order lags
    whole: Fit              # the whole family
    simple_weight: float    # of the first-order fit, 0 to 1
    rivals: tuple[Fit, ...] = ()     # other answers of the whole family, elsewhere

    @property
    def simple_held(self) -> Fixed:
        """Parameters held in the first-order fit."""
        return {**dict.fromkeys(self.problem.model.structure, 0.0), **self.fixed}

    @property
    def free(self) -> list[int]:
        """Parameters of the whole family that are free."""
        return [index for index in range(self.problem.model.size) if index not in self.fixed]

    @property
    def first_order(self) -> bool:
        """Are first-order lags the likelier answer?"""
        return self.simple_weight >= 0.5

    @property
    def likelier(self) -> Fit:
        """The likelier of the two answers."""
        return self.simple if self.first_order else self.whole

    def value(self, row: FloatArray) -> float:
        """The estimate of a linear combination of theta, row (P,)."""
        share = self.simple_weight
        return float(share * (row @ self.simple.theta) + (1.0 - share) * (row @ self.whole.theta))


def fit_model(
    problem: Likelihood,
    fixed: Fixed,
    starts: Sequence[FloatArray],
    rivals_of: Callable[[FloatArray], list[FloatArray]] | None = None,
    apart: Apart | None = None,
) -> FittedModel:
    """Fit ``problem`` from several ``starts`` (P,) each; ``rivals_of`` an answer: where another may be.

    ``apart``: answers that stand only where they gain more on the others than they must.
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
    """Return the weight of the answer with ``more`` fewer parameters; ``gain``: the drop of −2 ln L by them."""
    return 1.0 / (1.0 + math.exp(min(0.5 * (gain - more * math.log(numbers)), 700.0)))


def excess_rise(problem: Likelihood, fitted: int) -> float:
    """How much more than by χ² −2 ln L changes: 1 + p/(4ν), p parameters ``fitted``, ν complex d.o.f. of a weight.

    Parameters that are fitted lean on those lines whose scatter came out small by chance. The factor was measured, on
    first-order and on other plants alike: without it 7 to 8 % of the intervals miss instead of 5 %. (What is held by
    beliefs leans on those.)
    """
    nu = float(np.median(problem.nu))
    return 1.0 + (fitted - problem.held) / (4.0 * max(nu, 1.0))


def unit(fitted: FittedModel, index: int) -> FloatArray:
    """The row (P,) that picks one parameter."""
    row = np.zeros(fitted.problem.model.size)
    row[index] = 1.0
    return row
