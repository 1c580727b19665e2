"""The rigid model fitted to the lines of a recording: values, intervals, and what they rest on."""

import math
from dataclasses import dataclass, replace

from tdhil.identify.identification import BudgetLine, Estimate, ResidualTest
from tdhil.identify.lines import reports
from tdhil.identify.lines.budget import budget_of
from tdhil.identify.lines.fit import Held, rigid_rivals, rigid_starts
from tdhil.identify.lines.friction import Levels, ViscousTie, coulomb_level
from tdhil.identify.lines.interval import estimate, first_order_estimate
from tdhil.identify.lines.likelihood import Likelihood
from tdhil.identify.lines.model import GaussianPrior, Model
from tdhil.identify.lines.profile import standard_deviation, student_quantile
from tdhil.identify.lines.residual import rejects, residual_of
from tdhil.identify.lines.shaft import INERTIA, VISCOUS
from tdhil.identify.lines.spectrum import Line
from tdhil.identify.lines.structure import Fitted, fit_model


@dataclass(frozen=True)
class RigidResult:
    """``inertia`` is infinite on a side that the data leave open."""

    inertia: Estimate
    viscous: Estimate
    coulomb: Estimate | None
    speed_lag_s: Estimate
    torque_lag_s: Estimate
    skew_s: Estimate
    residual: ResidualTest | None
    budget: tuple[BudgetLine, ...]
    first_order: bool          # first-order lags are the likelier answer
    fitted: Fitted


def fit_rigid(
    lines: tuple[Line, ...],
    levels: Levels,
    tie: ViscousTie | None,
    priors: tuple[GaussianPrior, ...],
    held: Held,
    confidence: float,
    torque_scale_rel_sd: float = 0.0,
) -> RigidResult:
    """Fit, test, and profile. ``held``: parameters of theta known for certain (see Model)."""
    problem = Likelihood(lines, Model(), tie, priors)
    fitted = fit_model(problem, held, rigid_starts(problem), rigid_rivals)
    residual = residual_of(fitted)
    if rejects(residual):            # then no interval will be shown, and none is sought
        return _bare(fitted, residual)
    inertia = estimate(fitted, INERTIA, confidence)
    viscous = estimate(fitted, VISCOUS, confidence)
    speed_lag, torque_lag, skew = lags_of(fitted, confidence)
    return RigidResult(
        inertia=inertia,
        viscous=viscous,
        coulomb=_coulomb(levels, fitted, confidence),
        speed_lag_s=speed_lag,
        torque_lag_s=torque_lag,
        skew_s=skew,
        residual=residual,
        budget=budget_of(fitted, inertia, confidence, torque_scale_rel_sd),
        first_order=fitted.first_order,
        fitted=fitted,
    )


def _bare(fitted: Fitted, residual: ResidualTest | None) -> RigidResult:
    """Of a model that the data reject: the values, for whoever wants to look, without width."""
    theta, at = fitted.whole.theta, fitted.problem.model.at
    point = [Estimate(float(x), float(x), float(x)) for x in theta]
    speed, torque, skew = (point[at(i)] for i in (reports.SPEED_LAG, reports.TORQUE_LAG, reports.SKEW))
    return RigidResult(
        point[INERTIA], point[VISCOUS], None, speed, torque, skew, residual, (), fitted.first_order, fitted
    )


def lags_of(fitted: Fitted, confidence: float) -> tuple[Estimate, Estimate, Estimate]:
    """Delay of slow motion in either report, and what torque is late besides.

    Where first-order lags are the answer, their intervals are those of first-order lags. The whole family counts half
    of a moving average among the delays, whichever report it stands in; where one was found it is given back.
    """
    at = fitted.problem.model.at
    chosen = (reports.SPEED_LAG, reports.TORQUE_LAG, reports.SKEW)
    if fitted.first_order:
        first = [first_order_estimate(fitted, at(index), confidence) for index in chosen]
        return first[0], first[1], first[2]
    speed, torque, skew = (estimate(fitted, at(index), confidence) for index in chosen)
    u = float(fitted.whole.theta[at(reports.AVERAGE)])
    half = 0.5 * math.sqrt(abs(u))
    if u > 0.0:
        return speed, _shifted(torque, half), _shifted(skew, -half)
    return _shifted(speed, half), torque, _shifted(skew, half)


def _shifted(one: Estimate, by: float) -> Estimate:
    return Estimate(one.value + by, one.low + by, one.high + by)


def _coulomb(levels: Levels, fitted: Fitted, confidence: float) -> Estimate | None:
    if len(levels.speed) == 0 or levels.dof < 1.0 or levels.direction == 0.0:
        return None
    free = [index for index in fitted.free if index not in fitted.simple_held]
    theta = fitted.likelier.theta
    sd_viscous, dof = standard_deviation(fitted.problem, theta, VISCOUS, free)
    value, sd = coulomb_level(levels, float(theta[INERTIA]), float(theta[VISCOUS]), sd_viscous)
    half = student_quantile(confidence, min(dof, levels.dof)) * sd
    return Estimate(value, value - half, value + half) if math.isfinite(half) else None


def turned(estimate: Estimate, value: float) -> Estimate:
    """The same interval stretched to hold another value too."""
    return replace(estimate, value=value, low=min(estimate.low, value), high=max(estimate.high, value))
