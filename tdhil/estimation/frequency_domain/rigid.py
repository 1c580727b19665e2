"""Rigid model fitted to the lines of a recording: values, intervals, conditions and texts."""

import math
from dataclasses import dataclass, replace

import numpy as np

from profiles import CodedText, MessageCode
from tdhil.estimation.case import Case, Finding, ModelWords
from tdhil.estimation.frequency_domain import signal_filters
from tdhil.estimation.frequency_domain.filter_order import FittedModel, fit_model
from tdhil.estimation.frequency_domain.frequency_response import ModelCurve
from tdhil.estimation.frequency_domain.inference import (
    budget_of,
    estimate,
    first_order_estimate,
    residual_of,
    standard_deviation,
    student_quantile,
)
from tdhil.estimation.frequency_domain.likelihood import Likelihood
from tdhil.estimation.frequency_domain.model import GaussianPrior, Model
from tdhil.estimation.frequency_domain.optimiser import Fixed, rigid_rivals, rigid_starts
from tdhil.estimation.frequency_domain.shafts import INERTIA, VISCOUS, shaft_model
from tdhil.estimation.frequency_domain.signal_filters import (
    AVERAGE,
    SKEW,
    SPEED_LAG,
    SPEED_SHAPE,
    TORQUE_LAG,
    TORQUE_SHAPE,
)
from tdhil.estimation.friction_levels import Levels, ViscousConstraint, coulomb_level
from tdhil.estimation.result import BudgetLine, Estimate, LinePoint, Refusal, ResidualTest, doubtful, rejects
from tdhil.estimation.spectrum import ComplexArray, SpectralLine
from tdhil.recording import LagPrior

# ---------------------------------------------------------------------------------------------------------------------
# Count of equations and unknowns before the fit: can these lines determine the inertia?
#
# Each distinct excited frequency gives two equations (real and imaginary part of T/ω). Two mean speeds add one (B), and
# each lag stated by the drive or the rig one. There are five unknowns: J, B, the two lags, and the skew. (The structure
# of the lags is unknown too; if the lines do not determine it, the interval is wide or open, but still valid.) At a
# second mean speed the same frequency gives the same equations: it reduces the scatter, but does not count.
#
# The parameters are those of the rigid model.


UNKNOWNS = 5              # J, B, two lags and the time offset
_AT = Model().at
_LEAST_SD_S = 1e-4     # s; a lag "known exactly" is known to 0.1 ms at best


def lag_priors(
    prior: LagPrior, speed_index: int = _AT(SPEED_LAG), torque_index: int = _AT(TORQUE_LAG)
) -> tuple[GaussianPrior, ...]:
    """Return the priors on the two lags; the indices are those in theta."""
    known = []
    if prior.speed_lag_s is not None:
        known.append(GaussianPrior(speed_index, prior.speed_lag_s, max(prior.speed_lag_sd_s, _LEAST_SD_S)))
    if prior.torque_lag_s is not None:
        known.append(GaussianPrior(torque_index, prior.torque_lag_s, max(prior.torque_lag_sd_s, _LEAST_SD_S)))
    return tuple(known)


def known_structure(prior: LagPrior) -> dict[int, float]:
    """Return the fixed parameters. A stated lag is first-order; if the manual states both lags, there is no average."""
    fixed = {}
    if prior.speed_lag_s is not None:
        fixed[_AT(SPEED_SHAPE)] = 0.0
    if prior.torque_lag_s is not None:
        fixed[_AT(TORQUE_SHAPE)] = 0.0
    if len(fixed) == 2:
        fixed[_AT(AVERAGE)] = 0.0
    return fixed


def unfiltered() -> dict[int, float]:
    """Return the paper's assumption: the reported signals are not filtered."""
    return {_AT(index): 0.0 for index in (SPEED_LAG, SPEED_SHAPE, TORQUE_LAG, TORQUE_SHAPE, AVERAGE, SKEW)}


def with_skew(
    priors: tuple[GaussianPrior, ...], lines: int, constraint: ViscousConstraint | None, sd_s: float
) -> tuple[GaussianPrior, ...]:
    """Add the stated skew if only the skew is missing from the count: both lags are known, both signals in one
    frame.
    """
    known = len(priors) + (constraint is not None) + 2 * lines
    if known < UNKNOWNS and len(priors) == 2:
        return (*priors, GaussianPrior(_AT(SKEW), 0.0, max(sd_s, _LEAST_SD_S)))
    return priors


def known_of(
    prior: LagPrior, lines: int, constraint: ViscousConstraint | None
) -> tuple[tuple[GaussianPrior, ...], dict[int, float]]:
    """Return the prior knowledge of a rigid shaft's reports: the priors, and the held parameters."""
    return with_skew(lag_priors(prior), lines, constraint, prior.skew_sd_s), known_structure(prior)


def refuse_count(lines: int, constraint: ViscousConstraint | None, priors: tuple[GaussianPrior, ...]) -> Refusal | None:
    """Return a refusal with the equations, the unknowns and the motion that would suffice; None if they suffice."""
    equations = 2 * lines + (constraint is not None) + len(priors)
    if equations >= UNKNOWNS:
        return None
    sources = [f"{lines} excited {'line gives' if lines == 1 else 'lines give'} {2 * lines} equations"]
    if constraint is not None:
        sources.append("two mean speeds give one")
    if priors:
        sources.append(f"what is known of the lags gives {len(priors)}")
    missing = "more lines (a multisine)" if constraint is not None else "more lines about two mean speeds (a multisine)"
    return Refusal(
        f"{', '.join(sources)}, but there are five unknowns: inertia, viscous friction, the lags of the reported speed "
        "and torque, and their time offset",
        f"excite with {missing}, or state the drive's speed and torque filters with their uncertainty",
        entry=MessageCode.TOO_FEW_LINES,
    )


# ---------------------------------------------------------------------------------------------------------------------
# Spectral lines for the report: the inertia that each frequency shows by itself, beside that of the model.
#
#     G = T/ω,    apparent inertia Im G/ω_k (the slope of torque over acceleration at that line),    damping Re G
#
# pooled over the segments, G = Σ P T W* / Σ P |W|², with variance v / Σ P |W|² (`likelihood`), half of it in each part.


def fitted_points(fitted: FittedModel, confidence: float) -> tuple[LinePoint, ...]:
    """Return the lines of a fit beside the likelier of its two solutions."""
    problem, theta = fitted.problem, fitted.likelier.theta
    return line_points(problem.unloaded(theta), problem.model.impedance(theta, problem.s), confidence)


def line_points(lines: tuple[SpectralLine, ...], fitted: ComplexArray, confidence: float) -> tuple[LinePoint, ...]:
    """Return one point for each line, in their order; ``fitted`` (K,) is the model's T/ω at them, N·m·s/rad."""
    found = []
    for line, model in zip(lines, fitted, strict=True):
        g = complex(model)
        weight = line.periods * np.abs(line.speed) ** 2
        energy = float(np.sum(weight))
        if not (energy > 0.0 and math.isfinite(energy)):
            continue
        seen = complex(np.sum(line.periods * line.torque * line.speed.conj())) / energy
        variance = line.s_tt + abs(g) ** 2 * line.s_ww - 2.0 * (g.conjugate() * line.s_tw).real
        sd = math.sqrt(max(variance, 0.0) / (2.0 * energy))
        half = student_quantile(confidence, max(2.0 * line.nu, 1.0)) * sd
        omega = 2.0 * math.pi * line.hertz
        found.append(
            LinePoint(
                hertz=line.hertz,
                apparent_inertia_kg_m2=_around(seen.imag / omega, half / omega),
                fitted_inertia_kg_m2=g.imag / omega,
                apparent_damping_nm_s_rad=_around(seen.real, half),
                fitted_damping_nm_s_rad=g.real,
                residual_sd=abs(seen - g) / (math.sqrt(2.0) * sd) if sd > 0.0 else 0.0,
            )
        )
    return tuple(found)


def _around(value: float, half: float) -> Estimate:
    return Estimate(value, value - half, value + half)


# ---------------------------------------------------------------------------------------------------------------------

RIGID = "rigid+lags"
_OPEN = Refusal(
    "the data do not separate the inertia from the lags of the reported signals",
    "raise the amplitude of the lowest lines, excite for more periods, and use two mean speeds",
)


@dataclass(frozen=True)
class RigidResult:
    """Result of a rigid shaft; ``inertia`` is infinite on a side that the data leave open."""

    inertia: Estimate
    viscous: Estimate
    coulomb: Estimate | None
    speed_lag_s: Estimate
    torque_lag_s: Estimate
    skew_s: Estimate
    residual: ResidualTest | None
    budget: tuple[BudgetLine, ...]
    first_order: bool          # True if first-order lags are the likelier solution
    fitted: FittedModel


def fit_rigid(
    lines: tuple[SpectralLine, ...],
    levels: Levels,
    constraint: ViscousConstraint | None,
    priors: tuple[GaussianPrior, ...],
    fixed: Fixed,
    confidence: float,
    torque_scale_rel_sd: float = 0.0,
) -> RigidResult:
    """Fit, test, and profile. ``fixed``: parameters of theta known for certain (see Model)."""
    inertia, residual, fitted = fit_inertia(lines, constraint, priors, fixed, confidence)
    if rejects(residual):      # values without intervals
        theta, at = fitted.whole.theta, fitted.problem.model.at
        point = [Estimate(float(x), float(x), float(x)) for x in theta]
        lags = (signal_filters.SPEED_LAG, signal_filters.TORQUE_LAG, signal_filters.SKEW)
        speed_lag, torque_lag, skew = (point[at(lag)] for lag in lags)
        return RigidResult(point[INERTIA], point[VISCOUS], None, speed_lag, torque_lag, skew, residual, (),
                           fitted.first_order, fitted)
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


def fit_inertia(
    lines: tuple[SpectralLine, ...],
    constraint: ViscousConstraint | None,
    priors: tuple[GaussianPrior, ...],
    fixed: Fixed,
    confidence: float,
) -> tuple[Estimate, ResidualTest | None, FittedModel]:
    """Return J only, as `fit_rigid`, in a third of the time; J has no width if the data reject the model."""
    fitted = fit_parameters(lines, constraint, priors, fixed)
    residual = residual_of(fitted)
    if rejects(residual):            # then no interval is reported, and none is computed
        value = float(fitted.whole.theta[INERTIA])
        return Estimate(value, value, value), residual, fitted
    return estimate(fitted, INERTIA, confidence), residual, fitted


def fit_parameters(
    lines: tuple[SpectralLine, ...],
    constraint: ViscousConstraint | None,
    priors: tuple[GaussianPrior, ...],
    fixed: Fixed,
) -> FittedModel:
    """Return the fit only, without test and interval."""
    problem = Likelihood(lines, Model(), constraint, priors)
    return fit_model(problem, fixed, rigid_starts(problem), rigid_rivals)


def lags_of(fitted: FittedModel, confidence: float) -> tuple[Estimate, Estimate, Estimate]:
    """Return the delay of slow motion in either report, and the additional delay of torque.

    If first-order lags are the likelier solution, the intervals are those of first-order lags. In the whole family,
    half of a moving average counts as delay, in either report; if an average was found, it is added back.
    """
    at = fitted.problem.model.at
    chosen = (signal_filters.SPEED_LAG, signal_filters.TORQUE_LAG, signal_filters.SKEW)
    if fitted.first_order:
        first = [first_order_estimate(fitted, at(index), confidence) for index in chosen]
        return first[0], first[1], first[2]
    speed, torque, skew = (estimate(fitted, at(index), confidence) for index in chosen)
    u = float(fitted.whole.theta[at(signal_filters.AVERAGE)])
    half = 0.5 * math.sqrt(abs(u))
    if u > 0.0:
        return speed, _shifted(torque, half), _shifted(skew, -half)
    return _shifted(speed, half), torque, _shifted(skew, half)


def _shifted(one: Estimate, by: float) -> Estimate:
    return Estimate(one.value + by, one.low + by, one.high + by)


def _coulomb(levels: Levels, fitted: FittedModel, confidence: float) -> Estimate | None:
    if len(levels.speed) == 0 or levels.dof < 1.0 or levels.direction == 0.0:
        return None
    free = [index for index in fitted.free if index not in fitted.simple_held]
    theta = fitted.likelier.theta
    sd_viscous, dof = standard_deviation(fitted.problem, theta, VISCOUS, free)
    value, sd = coulomb_level(levels, float(theta[INERTIA]), float(theta[VISCOUS]), sd_viscous)
    half = student_quantile(confidence, min(dof, levels.dof)) * sd
    return Estimate(value, value - half, value + half) if math.isfinite(half) else None


def rigid_finding(
    result: RigidResult | None, case: Case, what: str = "a rigid shaft with reporting lags"
) -> Finding | Refusal:
    """Return the finding of a rigid shaft; a refusal if its inertia stays open. ``what``: its name in messages."""
    if result is None or not (rejects(result.residual) or result.inertia.bounded):
        return _OPEN
    as_paper = not shaft_model(case.options.model).lags
    lines = fitted_points(result.fitted, case.options.confidence)
    bare = Finding(model=case.options.model if as_paper else RIGID, words=_words(result, as_paper, what),
                   residual=result.residual, lines=lines,
                   warnings=_caveats(result, as_paper, case.recording.has_drill_string),
                   curve=ModelCurve(result.fitted, case.options.confidence, result.residual))
    if bare.rejected:
        return bare
    found = replace(bare, inertia=result.inertia, conditions=_conditions(result, case), viscous_nm_s_rad=result.viscous,
                    coulomb_nm=result.coulomb, budget=result.budget)
    if as_paper:
        inertia = result.inertia if case.paper is None else _turned(
            result.inertia, case.paper.stepped.inertia_kg_m2
        )
        return replace(found, inertia=inertia, conditions=("no reporting lags",))
    return replace(found, speed_lag_s=result.speed_lag_s, torque_lag_s=result.torque_lag_s, skew_s=result.skew_s)


def _turned(estimate: Estimate, value: float) -> Estimate:
    """Return the interval, extended to contain another value."""
    return replace(estimate, value=value, low=min(estimate.low, value), high=max(estimate.high, value))


def _words(result: RigidResult, as_paper: bool, what: str) -> ModelWords:
    tied = result.fitted.problem.constraint is not None
    return ModelWords(
        "the paper's model, without lags," if as_paper else what,
        if_rejected="identify with the rigid model, which includes reporting lags" if as_paper else
        "look for a compliant load, play, or friction that changes with speed or time; try lower lines",
        if_wide="excite with more amplitude or for longer" + ("" if tied else ", and about two mean speeds"),
        spread="repeatability",
    )


def _conditions(result: RigidResult, case: Case) -> tuple[str, ...]:
    problem = result.fitted.problem
    skew = problem.model.at(signal_filters.SKEW)
    return (*of_reports(case.recording.lag_prior), *simultaneous(problem.priors, skew))


def simultaneous(priors: tuple[GaussianPrior, ...], skew: int) -> tuple[str, ...]:
    """Return the condition on an inertia for which the skew, of this index, was assumed to be known."""
    return tuple(f"speed and torque simultaneous to {p.sd * 1e3:.3g} ms (1 sd)" for p in priors if p.index == skew)


def of_reports(prior: LagPrior) -> list[str]:
    """Return the conditions on an inertia that come from the reports."""
    stated = [
        name for name, lag in (("speed", prior.speed_lag_s), ("torque", prior.torque_lag_s)) if lag is not None
    ]
    found = []
    if stated:
        by = f" by {prior.source}" if prior.source else ""
        found.append(f"reporting lags as stated{by}, first order: {', '.join(stated)}")
    if len(stated) < 2:
        found.append("unstated reporting filters: two poles, a moving average and a delay at most")
    return found


_TURNS_AS_ONE = CodedText(
    "the rig's load is a string, and it turns together with the motor at these frequencies. J is the inertia of "
    "motor, string and bit, not of the motor alone",
    MessageCode.STRING_MOVES_WITH_MOTOR)
_MAY_STAY_BEHIND = CodedText(
    "the rig's load is a string. These frequencies do not show whether it turns with the motor. J may be the "
    "inertia of the motor alone",
    MessageCode.LOAD_MAY_STAY_BEHIND)


def whose_load_may_stay_behind(finding: Finding) -> Finding:
    """Return a rigid shaft's finding with the caveat that the load may stay behind instead of turning as one."""
    return replace(
        finding, warnings=tuple(_MAY_STAY_BEHIND if one is _TURNS_AS_ONE else one for one in finding.warnings))


def _caveats(result: RigidResult, as_paper: bool, has_drill_string: bool) -> tuple[str, ...]:
    found = []
    if has_drill_string:
        found.append(_TURNS_AS_ONE)
    if result.fitted.problem.constraint is None:
        found.append(CodedText(
            "the shaft was excited about one mean speed only. Viscous friction comes from the excited lines, not "
            "from operating points",
            MessageCode.ONE_MEAN_SPEED))
    if not as_paper and not result.first_order and not rejects(result.residual):
        found.append(CodedText(
            "first-order lags do not explain the reported signals. Filters of two poles and moving averages do",
            MessageCode.LAGS_NOT_FIRST_ORDER))
    if result.residual is not None and doubtful(result.residual) and not rejects(result.residual):
        found.append(CodedText(
            f"the residuals are only just consistent with the model (p = {result.residual.p_value:.2g})",
            MessageCode.BARELY_CONSISTENT))
    return tuple(found)
