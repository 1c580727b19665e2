"""From numbers to a conclusion: which verdict, why, and what the number rests on."""

import math
from dataclasses import dataclass

from tdhil.identify.faults.quality import Refusal
from tdhil.identify.identification import Identification, InertiaEstimate, PaperEstimate, Verdict
from tdhil.identify.lines.friction import ViscousTie
from tdhil.identify.lines.line_points import fitted_points
from tdhil.identify.lines.model import GaussianPrior, Model
from tdhil.identify.lines.reports import SKEW
from tdhil.identify.lines.residual import REJECT_P, rejects
from tdhil.identify.lines.rigid_result import RigidResult, turned
from tdhil.identify.options import Options
from tdhil.identify.torque_scale import with_total
from tdhil.record.recording import LagPrior, Recording

RIGID = "rigid+lags"
_RIGID_WORDS = "a rigid shaft seen through reporting lags"


@dataclass(frozen=True)
class Evidence:
    """What was there to conclude from."""

    paper: PaperEstimate | None
    periods: int
    samples: int
    warnings: tuple[str, ...]


def refused(
    refusal: Refusal,
    paper: PaperEstimate | None,
    periods: int,
    samples: int,
    warnings: tuple[str, ...],
) -> Identification:
    """No number, a reason and advice."""
    return Identification(
        verdict=Verdict.NOT_IDENTIFIABLE,
        model="none",
        reason=refusal.reason,
        advice=refusal.advice,
        inertia=None,
        viscous_nm_s_rad=None,
        coulomb_nm=None,
        speed_lag_s=None,
        torque_lag_s=None,
        skew_s=None,
        paper=paper,
        periods_used=periods,
        samples_used=samples,
        warnings=warnings,
    )


def conclude(
    result: RigidResult | None,
    recording: Recording,
    options: Options,
    evidence: Evidence,
    tie: ViscousTie | None,
    priors: tuple[GaussianPrior, ...],
    words: str = _RIGID_WORDS,
) -> Identification:
    """The verdict on a fitted rigid model; ``words``: which, for the reader."""
    rejected = result is not None and rejects(result.residual)
    if result is None or not (rejected or result.inertia.bounded):
        return refused(
            Refusal(
                "the data leave the inertia open: it can't be told from the lags of the reported signals",
                "excite with more amplitude at the lowest lines, for longer, and about two mean speeds",
            ),
            evidence.paper,
            evidence.periods,
            evidence.samples,
            evidence.warnings,
        )
    as_paper = options.model == "paper"
    test = result.residual
    inertia = None if rejected else _inertia(result, recording, options, evidence, priors)
    relative = 0.5 * (inertia.high - inertia.low) / inertia.value if inertia is not None else math.inf
    verdict = Verdict.VALID if relative <= options.tolerance else Verdict.VALID_WIDE
    if inertia is None:
        verdict = Verdict.MODEL_REJECTED
    reason, advice = _words(verdict, result, options, tie, relative, words)
    kept = not rejected
    return Identification(
        verdict=verdict,
        model="paper" if as_paper else RIGID,
        reason=reason,
        advice=advice,
        inertia=inertia,
        viscous_nm_s_rad=result.viscous if kept else None,
        coulomb_nm=result.coulomb if kept else None,
        speed_lag_s=result.speed_lag_s if kept and not as_paper else None,
        torque_lag_s=result.torque_lag_s if kept and not as_paper else None,
        skew_s=result.skew_s if kept and not as_paper else None,
        paper=evidence.paper,
        residual=test,
        periods_used=evidence.periods,
        samples_used=evidence.samples,
        warnings=(*evidence.warnings, *_caveats(result, tie, as_paper)),
        budget=result.budget if kept else (),
        lines=fitted_points(result.fitted, options.confidence),
    )


def _inertia(
    result: RigidResult,
    recording: Recording,
    options: Options,
    evidence: Evidence,
    priors: tuple[GaussianPrior, ...],
) -> InertiaEstimate:
    estimate = result.inertia
    if options.model == "paper" and evidence.paper is not None:
        estimate = turned(estimate, evidence.paper.stepped.inertia_kg_m2)
    conditions = _conditions(result, options, recording, priors)
    return with_total(estimate, recording.torque_scale_rel_sd, options.confidence, conditions)


def _conditions(
    result: RigidResult, options: Options, recording: Recording, priors: tuple[GaussianPrior, ...]
) -> tuple[str, ...]:
    conditions = ["torque scale exact"]
    if options.model == "paper":
        return (*conditions, "no reporting lags")
    conditions += of_reports(recording.lag_prior)
    skew = Model().at(SKEW)
    conditions += [f"speed and torque simultaneous to {p.sd * 1e3:g} ms (1 sd)" for p in priors if p.index == skew]
    return tuple(conditions)


def of_reports(prior: LagPrior) -> list[str]:
    """What an inertia is conditional on, of the reports."""
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


def _words(
    verdict: Verdict, result: RigidResult, options: Options, tie: ViscousTie | None, relative: float, words: str
) -> tuple[str, str]:
    what = "the paper's model, without lags," if options.model == "paper" else words
    p_value = result.residual.p_value if result.residual is not None else None
    if verdict is Verdict.MODEL_REJECTED:
        advice = (
            "identify with the rigid model, which includes reporting lags"
            if options.model == "paper"
            else "look for a compliant load, play, or friction that changes with speed or time; try lower lines"
        )
        return f"the residuals contradict {what} (p = {p_value:.1g})", advice
    fits = f"{what} explains the data" + (f" (p = {p_value:.2g})" if p_value is not None else ", untested")
    if verdict is Verdict.VALID:
        return fits, "identical filters on reported speed and torque, or known ones, would sharpen this further"
    advice = "excite with more amplitude or for longer" + (", and about two mean speeds" if tie is None else "")
    return f"{fits}, but the repeatability is ±{relative:.2%}, wider than ±{options.tolerance:.2%}", advice


def _caveats(result: RigidResult, tie: ViscousTie | None, as_paper: bool) -> tuple[str, ...]:
    found = []
    if tie is None:
        found.append("only one mean speed: viscous friction rests on the lines, not on levels")
    if not as_paper and not result.first_order:
        found.append("first-order lags do not explain the reports; filters of two poles and moving averages do")
    if result.residual is not None and REJECT_P <= result.residual.p_value < 0.01:
        found.append(f"the residuals are only just consistent with the model (p = {result.residual.p_value:.2g})")
    return tuple(found)
