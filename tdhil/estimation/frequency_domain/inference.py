"""Intervals from the profile likelihood: all values that the data do not contradict, with all other parameters
refitted.

The quadratic approximation fails for equal lags, or at a bound: there the likelihood is flat along a curved valley. The
profile P(x) = min over the other parameters of −2 ln L follows the valley, and needs no derivative at a bound. The
interval is {x: P(x) ≤ P_min + t²}, with Student's quantile t: chi-square would assume known weights.

The valley forks where a second pole begins: the fit with one pole, refitted along the profile, stays at ρ = 0. A fit
with two poles lies beyond a ridge, and is lower further out. An edge is valid only if no such other fit is lower.
"""

import math
from collections.abc import Callable, Iterable, Iterator

import numpy as np

from tdhil.estimation.frequency_domain import signal_filters
from tdhil.estimation.frequency_domain.filter_order import FittedModel, excess_rise, unit
from tdhil.estimation.frequency_domain.likelihood import Likelihood
from tdhil.estimation.frequency_domain.optimiser import Box, Fit, Fixed, lowest, minimise, other_poles
from tdhil.estimation.frequency_domain.shafts import INERTIA
from tdhil.estimation.result import REJECT_P, BudgetLine, Estimate, InertiaEstimate, ResidualTest
from tdhil.estimation.spectrum import SpectralLine
from tdhil.recording import FloatArray

# ---------------------------------------------------------------------------------------------------------------------
# Test of the residuals against the scatter between periods. If it fails, the model is wrong, and J would be too.
#
# For M segment means with weights estimated on ν complex degrees of freedom, q/M follows F(2M, 2ν). Bartlett's form of
# its logarithm,
#
#     (2ν + M − 1) ln(1 + q/ν)  ~  χ²(2M),
#
# is valid far into the tail, where sums of F are not. The constraint of B by the levels, t(n), adds (n − ½) ln(1 +
# z²/n) ~ χ²(1), and each prior on the lags adds χ²(1). Their sum at the best parameters has one degree of freedom less
# for each free parameter, except for parameters at a bound.


AT_BOUND = 1e-6      # of the natural scale: nearer to a bound counts as at the bound


def residual_of(fitted: FittedModel, chosen: int = 0) -> ResidualTest | None:
    """Return the test of the whole family's fit; free parameters inside their bounds count as fitted.

    ``chosen``: number of parameters fitted in addition, by a choice among models.
    """
    theta, limits = fitted.whole.theta, fitted.limits
    near = AT_BOUND * limits.scale
    inside = (theta > limits.low + near) & (theta < limits.high - near)
    return residual_test(fitted.problem, theta, int(np.count_nonzero(inside[fitted.free])) + chosen)


def contradicted(problem: Likelihood, theta: FloatArray, others: tuple[SpectralLine, ...]) -> bool:
    """Return whether lines that were not fitted contradict theta (P,). For lines that were too weak in one signal.

    At its antiresonance an oscillating shaft stands still while the torque continues: that line has nearly no speed,
    and the most information. Each line is tested alone, by Bartlett's form; theta is nearly exact for lines as weak as
    these.
    """
    from scipy.special import chdtrc

    if not others:
        return False
    beside = Likelihood(others, problem.model, None, ())
    _, q = beside.weighted(theta)
    m, nu = beside.segments, beside.nu
    p_values = chdtrc(2.0 * m, (2.0 * nu + m - 1.0) * np.log1p(q / nu))
    return bool(np.min(p_values) < REJECT_P / len(others))


def residual_test(problem: Likelihood, theta: FloatArray, fitted: int) -> ResidualTest | None:
    """Return the sum against its expectation; None if the number of fitted parameters reaches that of the
    measurements.
    """
    _, q = problem.weighted(theta)
    m, nu = problem.segments, problem.nu
    measured = 2.0 * float(np.sum(m)) + len(problem.priors)
    statistic = float(np.sum((2.0 * nu + m - 1.0) * np.log1p(q / nu)))
    statistic += float(sum(((theta[p.index] - p.mean) / p.sd) ** 2 for p in problem.priors))
    beliefs, _ = problem.beliefs(theta)
    measured += len(beliefs)
    statistic += float(beliefs @ beliefs)
    if problem.constraint is not None:
        n = problem.constraint.dof
        measured += 1.0
        statistic += max(n - 0.5, 0.5) * math.log1p(problem.tie_error(theta) ** 2 / n)
    left = measured - fitted
    if left < 1.0:
        return None
    from scipy.special import chdtrc

    return ResidualTest(statistic=statistic, degrees_of_freedom=left, p_value=float(chdtrc(left, statistic)))


# ---------------------------------------------------------------------------------------------------------------------

# Tails and quantiles are from scipy.special: scipy.stats gives the same bits, but takes a second to load.

_TRIES = 14               # trial values of one bound of the interval
_CLOSE = 5e-3     # of t: tolerance of the interval's edge


def student_quantile(confidence: float, dof: float) -> float:
    """Return the two-sided quantile of Student's t."""
    from scipy.special import stdtrit

    return float(stdtrit(dof, 0.5 + 0.5 * confidence))


def fisher_tail(ratio: float, dof_above: float, dof_below: float) -> float:
    """Return the probability that Fisher's F exceeds ``ratio`` by chance."""
    from scipy.special import fdtrc

    return float(fdtrc(dof_above, dof_below, ratio)) if not ratio <= 0.0 else 1.0


def covariance(problem: Likelihood, theta: FloatArray, free: list[int]) -> FloatArray:
    """Return the covariance (F, F) of the ``free`` parameters, by the quadratic approximation."""
    whole, _ = problem.information(theta)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(whole)[free], 1e-300))
    inverse = np.linalg.pinv(whole[np.ix_(free, free)] * np.outer(scale, scale), rcond=1e-13, hermitian=True)
    found: FloatArray = inverse * np.outer(scale, scale)
    return found


def standard_deviation(problem: Likelihood, theta: FloatArray, index: int, free: list[int]) -> tuple[float, float]:
    """Return the sd of theta[index], quadratic, and its degrees of freedom (Satterthwaite).

    var = cᵀ F c with c = F⁻¹ e_i: a sum over the parts of F, each as uncertain as the weight used for it.
    """
    whole, parts = problem.information(theta)
    chosen = np.ix_(free, free)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(whole)[free], 1e-300))
    inverse = np.linalg.pinv(whole[chosen] * np.outer(scale, scale), rcond=1e-13, hermitian=True)
    column = inverse[:, free.index(index)] * scale * scale[free.index(index)]
    shares = np.array([column @ part[chosen] @ column for part, _ in parts])
    variance = float(np.sum(shares))
    uncertain = float(np.sum([share**2 / dof for share, (_, dof) in zip(shares, parts, strict=True)]))
    dof = variance**2 / uncertain if uncertain > 0.0 else math.inf
    return math.sqrt(max(variance, 0.0)), max(1.0, min(dof, 1e6))


Refit = Callable[[FloatArray, float], Fit]
"""Function that returns the best fit with the parameter held at a value, from a start (P,) nearby."""

Others = Callable[[Fit, float], Iterable[Fit]]
"""Function that returns other fits with the parameter held at a value, which may be lower than the first one found."""


def profile_edge(
    refit: Refit, limits: Box, best: Fit, index: int, step: float, rise: float, others: Others
) -> float:
    """Return the value at which the profile has risen by ``rise`` in the direction of ``step``; a bound or ±inf without
    it.

    Searches the root of √(P − P_best) − √rise, a straight line for a quadratic likelihood.
    """
    target = math.sqrt(max(rise, 0.0))
    if target == 0.0:
        return float(best.theta[index])
    centre = float(best.theta[index])
    bound = float(limits.high[index] if step > 0.0 else limits.low[index])
    inside, inside_root, inside_theta = centre, 0.0, best.theta
    outside: tuple[float, float] | None = None

    def root_of(fit: Fit) -> float:
        return math.sqrt(max(fit.objective - best.objective, 0.0))

    x = centre + step
    for _ in range(_TRIES):
        x = min(x, bound) if step > 0.0 else max(x, bound)
        fit = refit(inside_theta, x)
        root = root_of(fit)
        if abs(root - target) <= _CLOSE * target:
            fit = lowest([fit, *others(fit, x)])
            root = root_of(fit)
            if root >= (1.0 - _CLOSE) * target:
                return x
            outside = None           # that point belongs to the higher valley
        if root < target:
            if x == bound:
                return bound
            inside, inside_root, inside_theta = x, root, fit.theta
        else:
            outside = (x, root)
        if outside is None:
            stretch = min(max(target / root if root > 0.0 else 4.0, 1.2), 4.0)
            x = centre + (x - centre) * stretch
        else:
            share = (target - inside_root) / (outside[1] - inside_root)
            x = inside + min(max(share, 0.05), 0.95) * (outside[0] - inside)
    return x if outside is not None else math.copysign(math.inf, step)


# ---------------------------------------------------------------------------------------------------------------------
# Interval of one parameter of a fitted model: its profile over the whole family of lag structures.
#
# If first-order lags are the likelier solution, their interval is joined. A prior limits the common lag of both reports
# (`signal_filters.shared_lag`). Of two solutions that the data hardly distinguish, this prior prefers the one in which
# a report has no lag, only delay and an average. The fit of the whole family is there in one of ten runs of the field
# rig, and its profile excludes the other solution, which is the truth. With the whole family alone, 7.2 % of 249
# intervals of that rig missed; with the first-order ones joined, 3.6 %, for 5 % more width. On the fifteen plants of
# the coverage study with first-order lags (750 runs) it was 3.2 % instead of 4.3 %, for 2 % more width. An average of
# the two was tried instead; it misses if a second pole is just not visible (docs/explanation/accuracy.md).


def quantile_of(fitted: FittedModel, index: int, confidence: float) -> float:
    """Return the root of the allowed rise of −2 ln L: Student's quantile, enlarged for the fitted parameters.

    Its degrees of freedom are those of the first-order fit, because those of the whole family would include directions
    with little information in the data. Student's quantile accounts for the uncertainty of the weights if nothing else
    is fitted; `excess_rise` accounts for the parameters that are refitted along the profile.
    """
    free = [i for i in range(fitted.problem.model.size) if i not in fitted.simple_held]
    if index not in free:
        free = fitted.free
    _, dof = standard_deviation(fitted.problem, fitted.simple.theta, index, free)
    return student_quantile(confidence, dof) * math.sqrt(excess_rise(fitted.problem, len(fitted.free)))


def estimate(fitted: FittedModel, index: int, confidence: float, behind: float = 0.0) -> Estimate:
    """Return value and interval of theta[index]; infinite on a side that the data leave open. A fixed one has no width.

    ``behind``: amount by which −2 ln L exceeds that of another model's fit.
    """
    value = fitted.value(unit(fitted, index))
    if index in fitted.fixed:
        return Estimate(value, value, value)
    quantile = quantile_of(fitted, index, confidence)
    if behind >= quantile**2:
        return Estimate(value, value, value)
    seen = [value, *_edges(fitted, fitted.whole, fitted.fixed, index, quantile, behind)]
    if behind == 0.0 and fitted.first_order and fitted.simple is not fitted.whole and index not in fitted.simple_held:
        seen += _edges(fitted, fitted.simple, fitted.simple_held, index, quantile, 0.0)
    for rival in fitted.rivals:
        further = behind + rival.objective - fitted.whole.objective
        if further < quantile**2:
            seen += _edges(fitted, rival, fitted.fixed, index, quantile, further)
    return Estimate(value, min(seen), max(seen))


def first_order_estimate(fitted: FittedModel, index: int, confidence: float) -> Estimate:
    """Return value and interval of theta[index] for first-order lags: used for the lags themselves.

    (In the whole family a lag has no upper limit, because the common part of both reports is not visible.)
    """
    value = float(fitted.simple.theta[index])
    if index in fitted.simple_held:
        return Estimate(value, value, value)
    quantile = quantile_of(fitted, index, confidence)
    low, high = _edges(fitted, fitted.simple, fitted.simple_held, index, quantile, 0.0)
    return Estimate(value, min(low, value), max(high, value))


def _edges(
    fitted: FittedModel, fit: Fit, fixed: Fixed, index: int, quantile: float, behind: float
) -> tuple[float, float]:
    problem, limits = fitted.problem, fitted.limits
    sd, _ = standard_deviation(problem, fit.theta, index, [i for i in range(len(fit.theta)) if i not in fixed])
    natural = float(limits.scale[index])
    step = min(max(quantile * sd, 1e-7 * natural), 0.3 * max(abs(float(fit.theta[index])), natural))

    def refit(start: FloatArray, value: float) -> Fit:
        return minimise(problem, limits, start, {**fixed, index: value})

    rise = quantile**2 - behind
    def others(fit: Fit, value: float) -> Iterator[Fit]:
        held = {**fixed, index: value}
        for start in other_poles(problem, fit.theta, held):
            yield minimise(problem, limits, start, held, fit.objective)

    low, high = (profile_edge(refit, limits, fit, index, side * step, rise, others) for side in (-1.0, 1.0))
    return low, high


def half_width_first_order(fitted: FittedModel, index: int, confidence: float, known: tuple[int, ...] = ()) -> float:
    """Return the half-width by the quadratic approximation, with first-order lags and with the parameters ``known``
    fixed.
    """
    free = [i for i in range(fitted.problem.model.size) if i not in fitted.simple_held and i not in known]
    if index not in free:
        return 0.0
    sd, dof = standard_deviation(fitted.problem, fitted.simple.theta, index, free)
    return student_quantile(confidence, dof) * sd


# ---------------------------------------------------------------------------------------------------------------------
# Torque scale of the drive, to which J is proportional: its effect on an interval, and its line of the budget.


CERTAIN = 1e6
"""Degrees of freedom that count as infinite: those of an input whose stated uncertainty is taken as exact."""


def scale_half_width(value: float, rel_sd: float, confidence: float) -> float:
    """Return the half-width, from the torque scale alone, of a quantity proportional to the scale."""
    return student_quantile(confidence, CERTAIN) * rel_sd * abs(value)


def with_total(
    one: Estimate, rel_sd: float, confidence: float, conditional_on: tuple[str, ...]
) -> InertiaEstimate:
    """Return J with both intervals: from the data, and with the uncertainty of the scale in quadrature."""
    scale = scale_half_width(one.value, rel_sd, confidence)
    return InertiaEstimate(
        value=one.value,
        low=one.low,
        high=one.high,
        low_total=one.value - math.hypot(one.value - one.low, scale),
        high_total=one.value + math.hypot(one.high - one.value, scale),
        confidence=confidence,
        conditional_on=conditional_on,
    )


def torque_scale_line(value: float, rel_sd: float, confidence: float) -> BudgetLine:
    """Return the line of the torque scale, the last line of a budget."""
    half = scale_half_width(value, rel_sd, confidence)
    return BudgetLine("torque scale", half, "of the drive; not in the repeatability")


def widened_most_by_scale(inertia: InertiaEstimate) -> bool:
    """Return whether the torque scale adds more to the total interval than all other sources together."""
    repeatable, total = inertia.high - inertia.low, inertia.high_total - inertia.low_total
    return total > 0.0 and total * total > 2.0 * repeatable * repeatable


# ---------------------------------------------------------------------------------------------------------------------
# Uncertainty budget of J: contribution of each unknown to the half-width, line by line.
#
# Unknowns are freed one group after another: J alone (noise), then the skew (timing), the lags, the friction, and last
# the structure of the lags. A line is the contribution of its group in quadrature: √(h_n² − h_(n−1)²); together they
# give the interval. Friction comes after the lags, because without lags a line separates J and B by itself (imaginary
# and real part); only lags mix the two.


def budget_of(
    fitted: FittedModel, inertia: Estimate, confidence: float, torque_scale_rel_sd: float
) -> tuple[BudgetLine, ...]:
    """Return the lines in the order of the groups. The torque scale is last: it is only in the total interval."""
    model = fitted.problem.model
    lags = (model.at(signal_filters.SPEED_LAG), model.at(signal_filters.TORQUE_LAG))
    timing = (model.at(signal_filters.SKEW),)
    friction = tuple(range(1, model.mechanical))
    half = 0.5 * (inertia.high - inertia.low)
    grown = (
        ("noise", half_width_first_order(fitted, INERTIA, confidence, (*lags, *timing, *friction)),
         "scatter from period to period"),
        ("timing", half_width_first_order(fitted, INERTIA, confidence, (*lags, *friction)),
         "time offset between speed and torque"),
        ("lags", half_width_first_order(fitted, INERTIA, confidence, friction),
         "time constants of the reporting filters"),
        ("friction model", half_width_first_order(fitted, INERTIA, confidence),
         "its slope" + ("" if fitted.problem.constraint is None else ", known from the operating points")),
        ("lag structure", half, "filters of two poles, moving averages"),
    )
    return (*grown_lines(grown, half), torque_scale_line(inertia.value, torque_scale_rel_sd, confidence))


def grown_lines(grown: Iterable[tuple[str, float, str]], half: float) -> tuple[BudgetLine, ...]:
    """Return the contribution of each step in quadrature.

    ``grown``: (source, half-width with it free, note); ``half``: the last half-width.
    """
    found, before = [], 0.0
    for source, reached, note in grown:
        total = min(max(reached, before), max(half, before))
        found.append(BudgetLine(source, math.sqrt(max(total**2 - before**2, 0.0)), note))
        before = total
    return tuple(found)
