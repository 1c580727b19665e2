"""The rigid model fitted to the lines of a recording: best structure, intervals, and what they rest on."""

import math
from dataclasses import dataclass, replace

from tdhil.identify.fit import Box, Fit, best_fit, box, rough_inertia_of
from tdhil.identify.friction import Levels, ViscousTie, coulomb_level
from tdhil.identify.identification import Estimate, ResidualTest
from tdhil.identify.likelihood import GaussianPrior, Likelihood
from tdhil.identify.profile import profile_edge, standard_deviation, student_quantile
from tdhil.identify.residual import rejects, residual_test
from tdhil.identify.rigid import INERTIA, SKEW, SPEED_LAG, TORQUE_LAG, VISCOUS, SpeedReport
from tdhil.identify.spectrum import Line


@dataclass(frozen=True)
class Candidate:
    """One structure of the speed report with its best fit."""

    problem: Likelihood
    limits: Box
    fit: Fit


@dataclass(frozen=True)
class RigidResult:
    """``inertia`` is infinite on a side that the data leave open; ``structures`` are those allowed, simplest first."""

    inertia: Estimate
    viscous: Estimate
    coulomb: Estimate | None
    speed_lag_s: Estimate
    torque_lag_s: Estimate
    skew_s: Estimate
    residual: ResidualTest | None
    structures: tuple[SpeedReport, ...]


def fit_rigid(
    lines: tuple[Line, ...],
    levels: Levels,
    tie: ViscousTie | None,
    priors: tuple[GaussianPrior, ...],
    held: dict[int, float],
    reports: tuple[SpeedReport, ...],
    confidence: float,
) -> RigidResult:
    """Fit every structure; the interval of J is what any structure leaves open that the data don't contradict.

    The structure of the speed report is one more unknown, a discrete one, and is profiled out like the others: J lies
    where min over structures and other parameters of −2 ln L is within t² of the overall minimum. The value is that of
    the simplest structure within the same distance.
    """
    candidates = _candidates(lines, tie, priors, held, reports)
    lowest = min(candidate.fit.objective for candidate in candidates)
    best = min(candidates, key=lambda candidate: candidate.fit.objective)
    free = [index for index in range(5) if index not in held]
    _, dof = standard_deviation(best.problem, best.fit.theta, INERTIA, free)
    quantile = student_quantile(confidence, dof)
    allowed = [candidate for candidate in candidates if candidate.fit.objective - lowest <= quantile**2]
    chosen = allowed[0]
    residual = residual_test(best.problem, best.fit.theta, len(free))
    hopeless = rejects(residual)     # then no interval will be shown, and none is sought
    edges = [] if hopeless else [_edges(candidate, INERTIA, lowest, quantile, held, free) for candidate in allowed]
    found = float(chosen.fit.theta[INERTIA])
    inertia = Estimate(
        found, min((edge[0] for edge in edges), default=found), max((edge[1] for edge in edges), default=found)
    )

    def estimate(index: int) -> Estimate:
        value = float(chosen.fit.theta[index])
        if hopeless or index in held:
            return Estimate(value, value, value)
        _, own_dof = standard_deviation(chosen.problem, chosen.fit.theta, index, free)
        own = student_quantile(confidence, own_dof)
        low, high = _edges(chosen, index, chosen.fit.objective, own, held, free)
        return Estimate(value, low, high)

    viscous = estimate(VISCOUS)
    return RigidResult(
        inertia=inertia,
        viscous=viscous,
        coulomb=_coulomb(levels, chosen, free, confidence),
        speed_lag_s=estimate(SPEED_LAG),
        torque_lag_s=estimate(TORQUE_LAG),
        skew_s=estimate(SKEW),
        residual=residual,
        structures=tuple(candidate.problem.report for candidate in allowed),
    )


def _candidates(
    lines: tuple[Line, ...],
    tie: ViscousTie | None,
    priors: tuple[GaussianPrior, ...],
    held: dict[int, float],
    reports: tuple[SpeedReport, ...],
) -> list[Candidate]:
    found: list[Candidate] = []
    for report in reports:
        problem = Likelihood(lines, report, tie, priors)
        limits = box(problem, rough_inertia_of(problem))
        near = found[0].fit if found else None
        found.append(Candidate(problem, limits, best_fit(problem, limits, held, near)))
    return found


def _edges(
    candidate: Candidate, index: int, lowest: float, quantile: float, held: dict[int, float], free: list[int]
) -> tuple[float, float]:
    sd, _ = standard_deviation(candidate.problem, candidate.fit.theta, index, free)
    step = quantile * sd
    centre = abs(float(candidate.fit.theta[index]))
    natural = float(candidate.limits.scale[index])
    step = min(max(step, 1e-7 * natural), 0.5 * max(centre, natural))
    rise = quantile**2 - (candidate.fit.objective - lowest)
    low = profile_edge(candidate.problem, candidate.limits, candidate.fit, index, -step, rise, held)
    high = profile_edge(candidate.problem, candidate.limits, candidate.fit, index, step, rise, held)
    return low, high


def _coulomb(levels: Levels, chosen: Candidate, free: list[int], confidence: float) -> Estimate | None:
    if len(levels.speed) == 0 or levels.dof < 1.0 or levels.direction == 0.0:
        return None
    sd_viscous, dof = standard_deviation(chosen.problem, chosen.fit.theta, VISCOUS, free)
    value, sd = coulomb_level(
        levels, float(chosen.fit.theta[INERTIA]), float(chosen.fit.theta[VISCOUS]), sd_viscous
    )
    half = student_quantile(confidence, min(dof, levels.dof)) * sd
    return Estimate(value, value - half, value + half) if math.isfinite(half) else None


def widened(value: float, half: float, rel_sd: float, quantile: float) -> float:
    """A half-width with the torque scale's uncertainty added in quadrature: J is proportional to the scale."""
    return math.hypot(half, quantile * rel_sd * abs(value))


def turned(estimate: Estimate, value: float) -> Estimate:
    """The same interval stretched to hold another value too."""
    return replace(estimate, value=value, low=min(estimate.low, value), high=max(estimate.high, value))
