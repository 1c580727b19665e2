"""The verdict on a shaft that is not rigid: what stands, why, and what the run could not tell."""

import math
from dataclasses import replace

import numpy as np

from tdhil.identify.compliant.choice import Chosen, choose
from tdhil.identify.compliant.fit import SLOWEST_SEEN, CompliantFit
from tdhil.identify.compliant.result import CompliantResult, result_of
from tdhil.identify.faults.refusal import Refusal
from tdhil.identify.identification import Estimate, Identification, InertiaEstimate, Verdict
from tdhil.identify.lines.fit import Held
from tdhil.identify.lines.friction import Levels, ViscousTie
from tdhil.identify.lines.line_points import fitted_points
from tdhil.identify.lines.model import GaussianPrior
from tdhil.identify.lines.residual import REJECT_P
from tdhil.identify.lines.spectrum import Line
from tdhil.identify.options import Options
from tdhil.identify.torque_scale import with_total
from tdhil.identify.verdict import Evidence, of_reports, refused
from tdhil.record.recording import Recording

_LOOK_FOR = "look for play, a bit that sticks, or friction that changes with speed or time"
_NAMES = {"two-mass": "two masses on a spring", "string": "a string with a mass at its end"}


def identify_compliant(
    recording: Recording,
    options: Options,
    evidence: Evidence,
    lines: tuple[Line, ...],
    levels: Levels,
    tie: ViscousTie | None,
    priors: tuple[GaussianPrior, ...],
    held: Held,
    rigid: Identification | None = None,
) -> Identification:
    """Two masses or the string. ``rigid``: the verdict on a rigid shaft that the data contradict or throw doubt on,
    under auto; it stands where no other shaft does better.
    """
    try:
        chosen = choose(options.model, lines, tie, priors, held)
        if isinstance(chosen, Refusal):
            return _refused(chosen, evidence) if rigid is None else _still_rigid(
                rigid, rigid.reason, f"{rigid.advice}; {chosen.advice}, for a shaft that is not rigid to be identified"
            )
        if chosen.rejected:
            return _rejected(chosen, evidence) if rigid is None else _still_rigid(
                rigid, f"{rigid.reason}, and two masses or a string do no better", _LOOK_FOR
            )
        found = result_of(chosen, levels, options.confidence, recording.torque_scale_rel_sd)
    except (np.linalg.LinAlgError, FloatingPointError, ValueError):
        return rigid or _refused(_open(), evidence)
    if not found.inertia.bounded and not _told(found.shaft.total_inertia):
        # a rigid shaft that is only doubted gives a number, which would be wrong: see `may_swing`
        return rigid if rigid is not None and rigid.inertia is None else _refused(_open(), evidence)
    return _stands(chosen, found, recording, options, evidence, rigid)


def _still_rigid(rigid: Identification, reason: str, advice: str) -> Identification:
    """The rigid shaft's verdict, with what else was tried where it is rejected."""
    return replace(rigid, reason=reason, advice=advice) if rigid.verdict is Verdict.MODEL_REJECTED else rigid


def _stands(
    chosen: Chosen,
    found: CompliantResult,
    recording: Recording,
    options: Options,
    evidence: Evidence,
    rigid: Identification | None,
) -> Identification:
    fit = chosen.fit
    told = found.inertia.bounded
    inertia = _inertia(found.inertia, chosen, recording, options) if told else None
    relative = 0.5 * (found.inertia.high - found.inertia.low) / found.inertia.value if told else math.inf
    verdict = Verdict.VALID if relative <= options.tolerance else Verdict.VALID_WIDE
    reason, advice = _words(fit, rigid, relative, options)
    if inertia is None:
        verdict = Verdict.NOT_IDENTIFIABLE
        reason += f", but the motor's inertia can't be told from the load's{_together(found.shaft.total_inertia)}"
        advice = "excite lines on both sides of the resonance, and well above it, where the motor turns alone"
    return Identification(
        verdict=verdict,
        model=name_of(fit),
        reason=reason,
        advice=advice,
        inertia=inertia,
        viscous_nm_s_rad=found.viscous,
        coulomb_nm=found.coulomb,
        speed_lag_s=found.speed_lag_s,
        torque_lag_s=found.torque_lag_s,
        skew_s=found.skew_s,
        paper=evidence.paper,
        residual=fit.residual,
        periods_used=evidence.periods,
        samples_used=evidence.samples,
        warnings=(*evidence.warnings, *_caveats(fit, found)),
        budget=found.budget if told else (),
        compliant=found.shaft,
        lines=fitted_points(fit.fitted, options.confidence),
    )


def _told(total: Estimate | None) -> bool:
    return total is not None and total.bounded


def _together(total: Estimate | None) -> str:
    if total is None:
        return ""
    return f"; together they are {total.value:.4g} kg·m² ({total.low:.4g} to {total.high:.4g})"


def name_of(fit: CompliantFit) -> str:
    """As ``--model`` has it."""
    return "string" if fit.is_string else "two-mass"


def _inertia(one: Estimate, chosen: Chosen, recording: Recording, options: Options) -> InertiaEstimate:
    if chosen.fit.is_string:
        shaft = "the motor turns a uniform string"
    else:
        shaft = "the spring weighs nothing" if chosen.beside is None else "the motor turns a spring or a uniform string"
    slowest_hz = SLOWEST_SEEN * min(line.hertz for line in chosen.fit.fitted.problem.lines)
    seen = f"its lowest swing is above {slowest_hz:.3g} Hz"
    conditions = ("torque scale exact", shaft, seen, *of_reports(recording.lag_prior))
    return with_total(one, recording.torque_scale_rel_sd, options.confidence, conditions)


def _words(fit: CompliantFit, rigid: Identification | None, relative: float, options: Options) -> tuple[str, str]:
    what = _NAMES[name_of(fit)]
    tested = f" (p = {fit.residual.p_value:.2g})" if fit.residual is not None else ", untested"
    reason = f"{what} explain{'s' if fit.is_string else ''} the data{tested}"
    if rigid is not None and rigid.verdict is Verdict.MODEL_REJECTED:
        reason = f"{rigid.reason}; {reason}"
    elif rigid is not None:
        reason = f"{reason}, much better than the lags of a rigid shaft do"
    if relative <= options.tolerance:
        return reason, "identical filters on reported speed and torque, or known ones, would sharpen this further"
    if math.isfinite(relative):
        reason += f", but the interval is ±{relative:.2%}, wider than ±{options.tolerance:.2%}"
    return reason, "state the drive's speed and torque filters, or excite with more amplitude above the resonance"


def _caveats(fit: CompliantFit, found: CompliantResult) -> tuple[str, ...]:
    said = ["J is the motor's side of the spring, J_r; what a slow motion feels is J_r + J_L"]
    if not _told(found.shaft.total_inertia):
        said.append("J_r + J_L is left open on one side: a slower line, well below the resonance, would show it")
    hertz = [line.hertz for line in fit.fitted.problem.lines]
    for name, one in (("resonance", found.shaft.resonance_hz), ("antiresonance", found.shaft.antiresonance_hz)):
        if one is not None and min(hertz) <= one.value <= max(hertz):
            article = "an" if name == "antiresonance" else "a"
            said.append(f"{article} {name} at {one.value:.3g} Hz lies inside the excited band")
    if fit.fitted.problem.tie is None:
        said.append("only one mean speed: viscous friction rests on the lines, not on levels")
    if not fit.fitted.first_order:
        said.append("first-order lags do not explain the reports; filters of two poles and moving averages do")
    if fit.residual is not None and REJECT_P <= fit.residual.p_value < 0.01:
        said.append(f"the residuals are only just consistent with the model (p = {fit.residual.p_value:.2g})")
    return tuple(said)


def _refused(refusal: Refusal, evidence: Evidence) -> Identification:
    return refused(refusal, evidence.paper, evidence.periods, evidence.samples, evidence.warnings)


def _open() -> Refusal:
    return Refusal(
        "the lines bend as those of a shaft that swings do, and leave its inertia open",
        "excite with more amplitude, for longer, on both sides of the resonance",
    )


def _rejected(chosen: Chosen, evidence: Evidence) -> Identification:
    test = chosen.fit.residual
    why = f" (p = {test.p_value:.1g})" if test is not None else ""
    refusal = Refusal(f"the residuals contradict {_NAMES[name_of(chosen.fit)]}{why}", f"{_LOOK_FOR}; try --model auto")
    plain = _refused(refusal, evidence)
    return replace(plain, verdict=Verdict.MODEL_REJECTED, model=name_of(chosen.fit), residual=test)
