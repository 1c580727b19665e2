"""The conclusion drawn from a finding: verdict, reason and conditions. Only this module makes a verdict."""

import math
from dataclasses import replace

from profiles import CodedText, MessageCode
from tdhil.estimation.case import Case, Finding
from tdhil.estimation.frequency_domain import widened_most_by_scale, with_total
from tdhil.estimation.result import Identification, InertiaEstimate, Options, Verdict, normal_quantile

_SHARPER = "identical filters on reported speed and torque, or known filters, would reduce the uncertainty further"
_BY_SCALE = "a torque calibration (tdhil calibrate torque) reduces the uncertainty most"
_BY_SPEED = "a correct scale of speed and position in the profile (tdhil calibrate speed) reduces the uncertainty most"


def conclude(case: Case, finding: Finding) -> Identification:
    """Return the identification with its verdict. An aborted run is stated first, because it may have changed the data.

    ``valid``: the interval is within the tolerance. ``valid_wide``: it is bounded, but wider. ``model_rejected``: the
    p-value of the residuals, another signal or another route of the run contradicts J. ``not_identifiable``: a route
    refused.
    """
    of_speed, of_torque = finding.speed_scale_share / normal_quantile(0.95), case.recording.torque_scale_rel_sd
    scale_rel_sd = math.hypot(of_torque, of_speed)
    inertia = _inertia(case, finding, scale_rel_sd)
    verdict, reason, advice, entry = _judged(case.options, finding, inertia)
    by_scale = verdict is Verdict.VALID and inertia is not None and widened_most_by_scale(inertia)
    calibrate = by_scale and of_speed <= of_torque
    if by_scale:
        advice = _BY_SCALE if calibrate else _BY_SPEED
    warnings = (*case.warnings, *finding.warnings)
    stage = case.aborted
    if stage is not None:
        said = f"the run was {stage.aborted_text}"
        if inertia is not None:
            partial = f"{said}. The result uses the data recorded before"
            warnings = (CodedText(partial, MessageCode.RUN_ENDED_EARLY), *warnings)
        else:
            reason = f"{said}. The data recorded before do not suffice: {reason}"
            advice = "remove the cause of the abort, and repeat the run"
    return Identification(**finding.quantities() | {
        "verdict": verdict, "reason": reason, "advice": advice, "entry": entry, "inertia": inertia,
        "calibration_advised": calibrate,
        "warnings": warnings, "paper": case.paper, "torque_ratios": case.torque_ratios,
        "torque_scale_rel_sd": scale_rel_sd,
        "periods_used": case.periods_used,
        "samples_used": case.samples_used if finding.samples_used is None else finding.samples_used,
    })


def _inertia(case: Case, finding: Finding, scale_rel_sd: float) -> InertiaEstimate | None:
    """Return the inertia with the uncertainty of the scales of torque and speed in quadrature, and the uncertainty of
    the reading moment added. ``scale_rel_sd``: relative standard uncertainty of both scales together.
    """
    if finding.inertia is None:
        return None
    conditions = ("torque scale exact", *finding.conditions)
    total = with_total(finding.inertia, scale_rel_sd, case.options.confidence, conditions)
    half = finding.reading_kg_m2
    if half == 0.0:
        return total
    return replace(
        total,
        low=max(total.low - half, 0.0),
        high=total.high + half,
        low_total=max(total.low_total - half, 0.0),
        high_total=total.high_total + half,
    )


def _judged(
    options: Options, finding: Finding, inertia: InertiaEstimate | None
) -> tuple[Verdict, str, str, MessageCode]:
    """Return verdict, reason and advice, with their entry in the table of messages."""
    if finding.rejected:
        return Verdict.MODEL_REJECTED, finding.contradicted, finding.words.if_rejected, MessageCode.MODEL_REJECTED
    if finding.contradiction.reason:
        found = finding.contradiction
        return Verdict.MODEL_REJECTED, found.reason, found.advice, found.entry
    if finding.inertia is None or inertia is None:
        refused = finding.refusal
        return Verdict.NOT_IDENTIFIABLE, refused.reason, refused.advice, refused.entry
    wide = f"wider than ±{100 * options.tolerance:.2f} %"
    own = 0.5 * (finding.inertia.high - finding.inertia.low) / finding.inertia.value
    whole = 0.5 * (inertia.high - inertia.low) / inertia.value
    if not own <= options.tolerance:
        reason = f"{finding.explained}, but the {finding.words.spread} is ±{100 * own:.2f} %, {wide}"
        return Verdict.VALID_WIDE, reason, finding.advice or finding.words.if_wide, MessageCode.VALID_WIDE
    if whole > options.tolerance:
        reason = f"{finding.explained}, but the interval is ±{100 * whole:.2f} %, {wide}"
        return Verdict.VALID_WIDE, reason, finding.advice or _SHARPER, MessageCode.VALID_WIDE
    return Verdict.VALID, finding.explained, finding.advice or _SHARPER, MessageCode.VALID
