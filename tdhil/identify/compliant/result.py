"""What a compliant shaft's fit says in the end: J_r, J_L, k and the rest, with intervals; their budget."""

import math
from dataclasses import dataclass, replace

from tdhil.estimation.frequency_domain import signal_filters
from tdhil.estimation.frequency_domain.compliant_fit import CompliantFit, CompliantIntervals, inertias, intervals
from tdhil.estimation.frequency_domain.friction_levels import Levels, coulomb_level
from tdhil.estimation.frequency_domain.inference import standard_deviation, student_quantile
from tdhil.estimation.frequency_domain.rigid import lags_of
from tdhil.estimation.frequency_domain.shafts import INERTIA, VISCOUS
from tdhil.estimation.result import BudgetLine, Compliant, Estimate
from tdhil.identify.compliant.choice import Chosen
from tdhil.identify.compliant.string_shaft import STRING_SHARE
from tdhil.identify.compliant.two_mass import DAMPING, LOAD, LOAD_VISCOUS, SWING
from tdhil.identify.lines.budget import grown_lines
from tdhil.identify.lines.interval import half_width_first_order
from tdhil.identify.torque_scale import torque_scale_line


@dataclass(frozen=True)
class CompliantResult:
    """``inertia``: J_r, infinite on a side that the data leave open. ``viscous``, ``coulomb``: of both ends."""

    inertia: Estimate
    shaft: Compliant
    viscous: Estimate
    coulomb: Estimate | None
    speed_lag_s: Estimate
    torque_lag_s: Estimate
    skew_s: Estimate
    budget: tuple[BudgetLine, ...]


def result_of(chosen: Chosen, levels: Levels, confidence: float, torque_scale_rel_sd: float) -> CompliantResult:
    """Of the model that stands; where two masses stand, their intervals hold what a string would say too."""
    alone = intervals(chosen.fit, confidence)
    held = alone if chosen.beside is None else _united(alone, inertias(chosen.beside, confidence))
    speed_lag, torque_lag, skew = lags_of(chosen.fit.fitted, confidence)
    return CompliantResult(
        inertia=held.inertia,
        shaft=Compliant(
            total_inertia=held.total if held.total.finite else None,
            load_inertia=_unless_open(held.load),
            stiffness_nm_rad=_unless_open(held.stiffness),
            damping_nm_s_rad=None if chosen.fit.is_string else _unless_open(held.damping),
            resonance_hz=_unless_open(held.resonance),
            antiresonance_hz=_unless_open(held.antiresonance),
        ),
        viscous=held.viscous,
        coulomb=_coulomb(levels, chosen.fit, held, confidence),
        speed_lag_s=speed_lag,
        torque_lag_s=torque_lag,
        skew_s=skew,
        budget=_budget(chosen.fit, alone.inertia, held.inertia, confidence, torque_scale_rel_sd),
    )


def _unless_open(one: Estimate) -> Estimate | None:
    return one if one.bounded else None


def _united(one: CompliantIntervals, others: dict[str, Estimate]) -> CompliantIntervals:
    """The values of ``one``, and all that either holds."""
    held = {}
    for name, other in others.items():
        own: Estimate = getattr(one, name)
        held[name] = Estimate(own.value, min(own.low, other.low), max(own.high, other.high))
    return replace(one, **held)


def _coulomb(levels: Levels, fit: CompliantFit, held: CompliantIntervals, confidence: float) -> Estimate | None:
    """Dry friction of both ends, from the levels: it is in the mean torque only."""
    if len(levels.speed) == 0 or levels.dof < 1.0 or levels.direction == 0.0:
        return None
    fitted = fit.fitted
    free = [index for index in fitted.free if index not in fitted.simple_held]
    sd_viscous, dof = standard_deviation(fitted.problem, fitted.simple.theta, VISCOUS, free)
    value, sd = coulomb_level(levels, held.total.value, held.viscous.value, sd_viscous)
    half = student_quantile(confidence, min(dof, levels.dof)) * sd
    return Estimate(value, value - half, value + half) if math.isfinite(half) else None


def _budget(
    fit: CompliantFit, alone: Estimate, held: Estimate, confidence: float, torque_scale_rel_sd: float
) -> tuple[BudgetLine, ...]:
    """As `budget.py` has it for a rigid shaft: set free one group after another, each its share in squares."""
    at = fit.fitted.problem.model.at
    lags, timing = (at(signal_filters.SPEED_LAG), at(signal_filters.TORQUE_LAG)), (at(signal_filters.SKEW),)
    friction = (VISCOUS, DAMPING, LOAD_VISCOUS)
    spring = (LOAD, SWING, *((STRING_SHARE,) if fit.is_string else ()))

    def half(*known: int) -> float:
        return half_width_first_order(fit.fitted, INERTIA, confidence, known)

    grown = (
        ("noise", half(*lags, *timing, *spring, *friction), "scatter from period to period, everything else known"),
        ("friction", half(*lags, *timing, *spring), "viscous friction at both ends and in the spring"),
        ("spring", half(*lags, *timing), "the load's inertia, the stiffness" + (
            ", the string's share" if fit.is_string else "")),
        ("timing", half(*lags), "skew between speed and torque"),
        ("lags", half(), "time constants of the reports' filters"),
        ("lag structure", 0.5 * (alone.high - alone.low), "filters of two poles, moving averages"),
        ("shaft model", 0.5 * (held.high - held.low), "a spring that weighs something: a string"),
    )
    lines = grown_lines(grown, 0.5 * (held.high - held.low))
    told = (line for line in lines if line.source != "shaft model" or line.half_width_kg_m2 > 0.0)
    return (*told, torque_scale_line(held.value, torque_scale_rel_sd, confidence))
