"""The verdict on a shaft that is not rigid: what stands, why, and what the run could not tell."""

from dataclasses import replace

import numpy as np

from tdhil.estimation.case import Finding, PeriodicCase, Words
from tdhil.estimation.frequency_domain.compliant_fit import SLOWEST_SEEN, CompliantFit
from tdhil.estimation.frequency_domain.rigid import of_reports
from tdhil.estimation.result import Estimate, Refusal
from tdhil.identify.compliant.choice import Chosen, choose
from tdhil.identify.compliant.result import CompliantResult, result_of
from tdhil.identify.lines.identifiable import known_of
from tdhil.identify.lines.line_points import fitted_points
from tdhil.identify.lines.residual import REJECT_P

_LOOK_FOR = "look for play, a bit that sticks, or friction that changes with speed or time"
_OPEN = Refusal(
    "the lines bend as those of a shaft that swings do, and leave its inertia open",
    "excite with more amplitude, for longer, on both sides of the resonance",
)
_WIDE = "state the drive's speed and torque filters, or excite with more amplitude above the resonance"
_WORDS = {
    "two-mass": Words("two masses on a spring", f"{_LOOK_FOR}; try --model auto", _WIDE, "explain the data"),
    "string": Words("a string with a mass at its end", f"{_LOOK_FOR}; try --model auto", _WIDE),
}


def identify_compliant(case: PeriodicCase, rigid: Finding | Refusal | None = None) -> Finding | Refusal:
    """Two masses or the string. ``rigid``: what was found of a rigid shaft that the data contradict or throw doubt on,
    under auto; it stands where no other shaft does better.
    """
    told = None
    contradicted = rigid if isinstance(rigid, Finding) and rigid.rejected else None
    priors, held = known_of(case.recording.lag_prior, len(case.usable), case.tie)
    try:
        chosen = choose(case.options.model, case.usable, case.tie, priors, held)
        if isinstance(chosen, Chosen) and not chosen.rejected:
            told = result_of(chosen, case.levels, case.options.confidence, case.recording.torque_scale_rel_sd)
    except (np.linalg.LinAlgError, FloatingPointError, ValueError):
        return rigid or _OPEN
    if isinstance(chosen, Refusal):
        if contradicted is None:
            return rigid or chosen
        advice = f"{contradicted.words.if_rejected}; {chosen.advice}, for a shaft that is not rigid to be identified"
        return replace(contradicted, words=replace(contradicted.words, if_rejected=advice))
    if told is None:
        if contradicted is None:
            name = name_of(chosen.fit)
            return rigid or Finding(name, _WORDS[name], chosen.fit.residual)
        words = replace(contradicted.words, if_rejected=_LOOK_FOR)
        return replace(contradicted, words=words, remark=", and two masses or a string do no better")
    if told.inertia.bounded or _told(told.shaft.total_inertia):
        return _stands(chosen, told, case, rigid)
    # a rigid shaft that is only doubted gives a number, which would be wrong: see `may_swing`
    return rigid if isinstance(rigid, Refusal) else contradicted or _OPEN


def _stands(chosen: Chosen, told: CompliantResult, case: PeriodicCase, rigid: Finding | Refusal | None) -> Finding:
    """What is told of the shaft; without J where only the sum of both inertias is."""
    fit = chosen.fit
    name = name_of(fit)
    finding = Finding(
        model=name,
        words=_WORDS[name],
        residual=fit.residual,
        conditions=(*_conditions(chosen), *of_reports(case.recording.lag_prior)),
        viscous_nm_s_rad=told.viscous,
        coulomb_nm=told.coulomb,
        speed_lag_s=told.speed_lag_s,
        torque_lag_s=told.torque_lag_s,
        skew_s=told.skew_s,
        compliant=told.shaft,
        lines=fitted_points(fit.fitted, case.options.confidence),
        warnings=_caveats(fit, told),
    )
    if isinstance(rigid, Finding) and rigid.rejected:
        finding = replace(finding, preface=f"{rigid.contradicted}; ")
    elif rigid is not None:
        finding = replace(finding, remark=", much better than the lags of a rigid shaft do")
    if told.inertia.bounded:
        return replace(finding, inertia=told.inertia, budget=told.budget)
    together = _together(told.shaft.total_inertia)
    return replace(finding, refusal=Refusal(
        f"{finding.explained}, but the motor's inertia can't be told from the load's{together}",
        "excite lines on both sides of the resonance, and well above it, where the motor turns alone",
    ))


def _told(total: Estimate | None) -> bool:
    return total is not None and total.bounded


def _together(total: Estimate | None) -> str:
    if total is None:
        return ""
    return f"; together they are {total.value:.4g} kg·m² ({total.low:.4g} to {total.high:.4g})"


def name_of(fit: CompliantFit) -> str:
    """As ``--model`` has it."""
    return "string" if fit.is_string else "two-mass"


def _conditions(chosen: Chosen) -> tuple[str, ...]:
    if chosen.fit.is_string:
        shaft = "the motor turns a uniform string"
    else:
        shaft = "the spring weighs nothing" if chosen.beside is None else "the motor turns a spring or a uniform string"
    slowest_hz = SLOWEST_SEEN * min(line.hertz for line in chosen.fit.fitted.problem.lines)
    return shaft, f"its lowest swing is above {slowest_hz:.3g} Hz"


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
