"""From bins to numbers: J and all else with intervals, the shares in J's uncertainty, and the test of the model."""

import math
from dataclasses import dataclass, replace

import numpy as np

from tdhil.estimation.frequency_domain.model import GaussianPrior
from tdhil.estimation.frequency_domain.optimiser import Fit
from tdhil.estimation.result import BudgetLine, Estimate, ResidualTest
from tdhil.estimation.time_domain.equation import (
    BACK,
    BEND,
    FORWARD,
    INERTIA,
    SKEW,
    SPEED_LAG,
    SPEED_SHAPE,
    TORQUE_LAG,
    TORQUE_SHAPE,
    VISCOUS,
)
from tdhil.estimation.time_domain.fit import Problem, covariance, minimise
from tdhil.estimation.time_domain.windows import Bins, Window
from tdhil.identify.record_route.interval import Spread, best_shapes, profile, spread, with_shapes
from tdhil.identify.record_route.misfit import local_test
from tdhil.identify.record_route.moments import block_scores
from tdhil.identify.record_route.search import search
from tdhil.recording.recording import FloatArray

_SURELY = 3.0       # times the reach², friction is taken as bent; from once it, both are held possible
_OF_REPORTS = (SPEED_LAG, TORQUE_LAG, SKEW, SPEED_SHAPE, TORQUE_SHAPE)


@dataclass(frozen=True)
class Solved:
    """What the bins say. ``bent``: friction grows with the square of the speed; ``shaped``: not one-pole filters."""

    inertia: Estimate
    viscous: Estimate
    coulomb: Estimate | None
    speed_lag_s: Estimate
    torque_lag_s: Estimate
    skew_s: Estimate
    residual: ResidualTest | None
    budget: tuple[BudgetLine, ...]
    bent: bool
    shaped: bool
    bins: int


@dataclass(frozen=True)
class Shaft:
    """One model of friction: its fit (structure of the filters free if ``shaped``), and J with its interval.

    ``scores`` (blocks, 10) are those of the fit with one-pole filters.
    """

    problem: Problem
    fit: Fit
    scores: FloatArray
    spread: Spread
    inertia: Estimate
    shaped: bool

    @property
    def reach(self) -> float:
        return self.spread.factor * self.spread.quantile


def solve(
    bins: Bins, placed: tuple[Window, ...], priors: tuple[GaussianPrior, ...], torque_span_nm: float, confidence: float
) -> Solved | None:
    """None where too few bins stand clear of the noise."""
    found = search(bins, priors, torque_span_nm)
    if found is None:
        return None
    stated = tuple(prior.index for prior in priors)
    straight = _shaft(found.problem, found.fit, placed, stated, confidence)
    bent_problem = replace(found.problem, free=(*found.problem.free, BEND))
    bent_fit = minimise(bent_problem, found.fit.theta)
    drop = found.fit.objective - bent_fit.objective
    chosen, value = straight, straight.inertia
    bent = drop > _SURELY * straight.reach**2
    if drop > straight.reach**2:
        curved = _shaft(bent_problem, bent_fit, placed, stated, confidence)
        other = curved.inertia
        if bent:
            chosen, value = curved, other
        else:
            value = Estimate(value.value, min(value.low, other.low), max(value.high, other.high))
    problem = chosen.problem
    residual = local_test(problem, chosen.fit.theta, chosen.spread.factor)
    shift = float(bent_fit.theta[INERTIA]) - float(found.fit.theta[INERTIA])
    budget = _budget(chosen, value, shift, bent, stated)

    def estimate(index: int) -> Estimate:
        return _estimate(chosen, index, confidence)

    return Solved(
        inertia=value,
        viscous=estimate(VISCOUS),
        coulomb=_coulomb(problem, chosen.fit, chosen.spread),
        speed_lag_s=estimate(SPEED_LAG),
        torque_lag_s=estimate(TORQUE_LAG),
        skew_s=estimate(SKEW),
        residual=residual,
        budget=budget,
        bent=bent,
        shaped=chosen.shaped,
        bins=len(problem.bins),
    )


def _shaft(
    problem: Problem, fit: Fit, placed: tuple[Window, ...], stated: tuple[int, ...], confidence: float
) -> Shaft:
    """J's interval over every structure of the filters; its value with one pole each, unless that is contradicted."""
    scores = block_scores(problem, placed, fit.theta)
    own = spread(problem, fit, scores, INERTIA, confidence)
    reach, scale = own.factor * own.quantile, float(problem.box.scale[INERTIA])
    open_problem = with_shapes(problem, stated)
    best = best_shapes(open_problem, fit)
    shaped = fit.objective - best.objective > reach**2
    wide = profile(open_problem, best, INERTIA, reach, min(max(reach * own.sd, 1e-7 * scale), 0.5 * scale))
    value = float((best if shaped else fit).theta[INERTIA])
    inertia = Estimate(value, min(wide.low, value) + min(own.lean, 0.0), max(wide.high, value) + max(own.lean, 0.0))
    return Shaft(open_problem if shaped else problem, best if shaped else fit, scores, own, inertia, shaped)


def _estimate(shaft: Shaft, index: int, confidence: float) -> Estimate:
    problem, fit = shaft.problem, shaft.fit
    own = spread(problem, fit, shaft.scores, index, confidence)
    reach, scale = own.factor * own.quantile, float(problem.box.scale[index])
    found = profile(problem, fit, index, reach, min(max(reach * own.sd, 1e-7 * scale), 10.0 * scale))
    return Estimate(found.value, min(found.low, found.value), max(found.high, found.value))


def _coulomb(problem: Problem, fit: Fit, own: Spread) -> Estimate | None:
    """T_c along the rotation; load included where it turned one way only."""
    both = [index for index in (FORWARD, BACK) if index in problem.free]
    if not both:
        return None
    direction = np.zeros(len(fit.theta))
    direction[FORWARD], direction[BACK] = (0.5, -0.5) if len(both) == 2 else (1.0, -1.0)
    direction[[index for index in (FORWARD, BACK) if index not in both]] = 0.0
    spread_of, _ = covariance(problem, fit.theta, problem.free)
    part = direction[list(problem.free)]
    half = own.factor * own.quantile * math.sqrt(max(float(part @ spread_of @ part), 0.0))
    value = float(direction @ fit.theta)
    return Estimate(value, value - half, value + half) if math.isfinite(half) else None


def _budget(
    shaft: Shaft, inertia: Estimate, shift: float, bent: bool, stated: tuple[int, ...]
) -> tuple[BudgetLine, ...]:
    """Noise with the lags held; what unknown lags add, what unknown structures add; the rest."""
    problem, fit, own = shaft.problem, shaft.fit, shaft.spread
    held = tuple(index for index in problem.free if index not in _OF_REPORTS)
    alone, _ = covariance(problem, fit.theta, held)
    reach = shaft.reach
    noise = reach * math.sqrt(max(float(alone[held.index(INERTIA), held.index(INERTIA)]), 0.0))
    one_pole = reach * own.sd
    whole = 0.5 * (inertia.high - inertia.low)
    lags = math.sqrt(max(one_pole**2 - noise**2, 0.0))
    structure = math.sqrt(max(whole**2 - one_pole**2, 0.0)) if math.isfinite(whole) else math.inf
    known = "as stated" if stated else "nothing was stated of them"
    return (
        BudgetLine("noise", noise, "load disturbance and noise of both signals, were the lags known"),
        BudgetLine("lags", lags, f"of the reported speed and torque, and their skew; {known}"),
        BudgetLine("lag structure", structure, "one pole, two, an average or a delay"),
        BudgetLine("friction model", abs(shift), "friction with and without a part that grows with the speed's square"
                   + ("; it has one" if bent else "")),
    )
