"""The verdict on a shaft whose friction bends over speed.

Its two parameters more, c and the bell's width, must lower −2 ln L by more than Schwarz's 2 ln n, as with the lags
(`lines/structure.py`): a rigid shaft that is rejected by chance doesn't bend.
"""

import math
from dataclasses import replace

import numpy as np

from tdhil.estimation.case import Finding, PeriodicCase
from tdhil.estimation.frequency_domain.friction_levels import ViscousTie, tie_viscous
from tdhil.estimation.frequency_domain.inference import student_quantile
from tdhil.estimation.frequency_domain.rigid import RIGID, RigidResult, lags_of, rigid_finding
from tdhil.estimation.frequency_domain.shafts import INERTIA
from tdhil.estimation.result import BudgetLine, Estimate, Refusal
from tdhil.identify.bent.fit import BentFit, Motion, fit_bends, inertia_of
from tdhil.identify.bent.wave import wave_of
from tdhil.identify.lines.budget import budget_of
from tdhil.identify.lines.fit import rigid_rivals
from tdhil.identify.lines.interval import estimate
from tdhil.identify.lines.residual import rejects

MODEL = f"{RIGID}, bent friction"
_MORE = 2      # parameters than with straight friction


def identify_bent(case: PeriodicCase, rigid: RigidResult) -> Finding | None:
    """``rigid``: the rigid shaft with straight friction, which the data contradict.

    None where this one does no better, or leaves the inertia open.
    """
    tie = tie_viscous(case.levels)
    if tie is None or rigid_rivals(rigid.fitted.simple.theta):
        return None
    waves = tuple(
        wave_of(fit, one.segment) for fit, one in zip(case.fits, case.stretches, strict=True) if len(fit.speed)
    )
    straight = rigid.fitted
    motion = Motion(waves, case.levels, straight.problem.lines, tie)
    try:
        found = fit_bends(motion, straight.problem.priors, straight.held, rigid)
        if not found or found[0].residual is None or rejects(found[0].residual):
            return None
        if straight.whole.objective - found[0].objective <= _MORE * math.log(found[0].fitted.problem.numbers):
            return None
        result = _result(found, tie, case.options.confidence, case.recording.torque_scale_rel_sd)
    except (np.linalg.LinAlgError, FloatingPointError, ValueError):
        return None
    finding = rigid_finding(result, case, "a rigid shaft whose friction is no straight line over speed")
    if isinstance(finding, Refusal):
        return None
    against = rigid.residual.p_value if rigid.residual is not None else 0.0
    return replace(
        finding,
        model=MODEL,
        bent=True,
        preface=f"the residuals contradict straight friction (p = {against:.1g}); ",
        warnings=(*finding.warnings, _told(found[0], motion)),
    )


def _result(found: list[BentFit], tie: ViscousTie, confidence: float, torque_scale_rel_sd: float) -> RigidResult:
    """As of a rigid shaft; ``viscous`` is the slope of friction between the two mean speeds, Coulomb's is not told."""
    best = found[0]
    own = estimate(best.fitted, INERTIA, confidence)
    inertia = inertia_of(found, own, confidence)
    speed_lag, torque_lag, skew = lags_of(best.fitted, confidence)
    chord = tie.slope - tie.slope_per_inertia * inertia.value
    half = student_quantile(confidence, tie.dof) * tie.sd
    return RigidResult(
        inertia=inertia,
        viscous=Estimate(chord, chord - half, chord + half),
        coulomb=None,
        speed_lag_s=speed_lag,
        torque_lag_s=torque_lag,
        skew_s=skew,
        residual=best.residual,
        budget=_budget(best, own, inertia, confidence, torque_scale_rel_sd),
        first_order=best.fitted.first_order,
        fitted=best.fitted,
    )


def _budget(
    best: BentFit, own: Estimate, inertia: Estimate, confidence: float, torque_scale_rel_sd: float
) -> tuple[BudgetLine, ...]:
    """Of the best shape's ``own`` interval, with a line more: what other shapes add to it."""
    *lines, scale = budget_of(best.fitted, own, confidence, torque_scale_rel_sd)
    grown = math.sqrt(max((inertia.high - inertia.low) ** 2 - (own.high - own.low) ** 2, 0.0))
    return (*lines, BudgetLine("friction's shape", 0.5 * grown, "other shapes that the data allow"), scale)


def _told(best: BentFit, motion: Motion) -> str:
    width = best.bend.width_rad_s
    shape = "with the square of speed" if width is None else f"by a bell of about {width:.2g} rad/s (Stribeck)"
    return (
        f"friction is no straight line over speed: it bends {shape}, which is allowed for; B is its slope between the "
        f"mean speeds {', '.join(f'{wave.mean:.3g}' for wave in motion.waves)} rad/s"
    )
