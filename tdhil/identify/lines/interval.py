"""The interval of one parameter of a fitted model: its profile over the whole family of lag structures.

While first-order lags are the likelier answer, what lies within one standard deviation of theirs is part of it: where
the whole family's fit follows noise away from them, its own interval follows too. (Their whole interval would be too
much: on the plants of the coverage study with first-order lags 2 % would miss, not 5 %; without them it is 5 %, with
one standard deviation 4 %, and the value is never at the interval's edge.)
"""

import math

from tdhil.estimation.frequency_domain.filter_order import Fitted, excess_rise, unit
from tdhil.estimation.frequency_domain.inference import profile_edge, standard_deviation, student_quantile
from tdhil.estimation.frequency_domain.optimiser import Fit
from tdhil.estimation.result import Estimate
from tdhil.identify.lines.fit import Held, minimise
from tdhil.recording.recording import FloatArray


def quantile_of(fitted: Fitted, index: int, confidence: float) -> float:
    """The root of how far −2 ln L may rise: Student's quantile, enlarged for what is fitted besides.

    Its degrees of freedom are those of the first-order fit (the whole family's would be spread over directions that the
    data hardly speak of). Student's quantile allows for the weights' own uncertainty if nothing else is fitted; what is
    refitted all along the profile is allowed for by `excess_rise`.
    """
    free = [i for i in range(fitted.problem.model.size) if i not in fitted.simple_held]
    if index not in free:
        free = fitted.free
    _, dof = standard_deviation(fitted.problem, fitted.simple.theta, index, free)
    return student_quantile(confidence, dof) * math.sqrt(excess_rise(fitted.problem, len(fitted.free)))


def estimate(fitted: Fitted, index: int, confidence: float, behind: float = 0.0) -> Estimate:
    """Value and interval of theta[index]; infinite on a side that the data leave open. Held: no width.

    ``behind``: by how much −2 ln L lies above that of another model's fit, to which this one is a rival.
    """
    value = fitted.value(unit(fitted, index))
    if index in fitted.held:
        return Estimate(value, value, value)
    quantile = quantile_of(fitted, index, confidence)
    if behind >= quantile**2:
        return Estimate(value, value, value)
    seen = [value, *_edges(fitted, fitted.whole, fitted.held, index, quantile, behind)]
    if behind == 0.0 and fitted.first_order and fitted.simple is not fitted.whole and index not in fitted.simple_held:
        seen += _edges(fitted, fitted.simple, fitted.simple_held, index, 1.0, 0.0)
    for rival in fitted.rivals:
        further = behind + rival.objective - fitted.whole.objective
        if further < quantile**2:
            seen += _edges(fitted, rival, fitted.held, index, quantile, further)
    return Estimate(value, min(seen), max(seen))


def first_order_estimate(fitted: Fitted, index: int, confidence: float) -> Estimate:
    """Value and interval of theta[index] if the lags are first order: for the lags themselves, whose meaning it is.

    (Over the whole family a lag is open above, since what both reports share can't be seen.)
    """
    value = float(fitted.simple.theta[index])
    if index in fitted.simple_held:
        return Estimate(value, value, value)
    quantile = quantile_of(fitted, index, confidence)
    low, high = _edges(fitted, fitted.simple, fitted.simple_held, index, quantile, 0.0)
    return Estimate(value, min(low, value), max(high, value))


def _edges(
    fitted: Fitted, fit: Fit, held: Held, index: int, quantile: float, behind: float
) -> tuple[float, float]:
    problem, limits = fitted.problem, fitted.limits
    sd, _ = standard_deviation(problem, fit.theta, index, [i for i in range(len(fit.theta)) if i not in held])
    natural = float(limits.scale[index])
    step = min(max(quantile * sd, 1e-7 * natural), 0.3 * max(abs(float(fit.theta[index])), natural))

    def refit(start: FloatArray, value: float) -> Fit:
        return minimise(problem, limits, start, {**held, index: value})

    rise = quantile**2 - behind
    low, high = (profile_edge(refit, limits, fit, index, side * step, rise) for side in (-1.0, 1.0))
    return low, high


def half_width_first_order(fitted: Fitted, index: int, confidence: float, known: tuple[int, ...] = ()) -> float:
    """Half-width in the quadratic approximation, with first-order lags and the parameters ``known`` at their values."""
    free = [i for i in range(fitted.problem.model.size) if i not in fitted.simple_held and i not in known]
    if index not in free:
        return 0.0
    sd, dof = standard_deviation(fitted.problem, fitted.simple.theta, index, free)
    return student_quantile(confidence, dof) * sd
