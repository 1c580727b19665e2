"""The verdict on a record, in the words that the frequency route uses."""

from tdhil.identify.identification import Estimate, Identification, PaperEstimate, Verdict
from tdhil.identify.lines.identifiable import lag_priors
from tdhil.identify.lines.reports import LAG_BOUND_S, SKEW_BOUND_S
from tdhil.identify.lines.residual import rejects
from tdhil.identify.options import Options
from tdhil.identify.record_route.solve import Solved
from tdhil.identify.torque_scale import torque_scale_line, with_total
from tdhil.record.recording import Recording

MODEL = "rigid+lags (time domain)"


def is_open(inertia: Estimate) -> bool:
    """Does the interval say nothing worth a number?"""
    return not inertia.bounded or inertia.low <= 0.0


def conclude_record(
    solved: Solved,
    recording: Recording,
    options: Options,
    paper: PaperEstimate | None,
    samples_used: int,
    warnings: tuple[str, ...],
) -> Identification:
    """A number with its interval, or the model rejected."""
    rejected = rejects(solved.residual)
    found = solved.inertia
    scale = recording.torque_scale_rel_sd
    inertia = with_total(found, scale, options.confidence, _conditions(recording))
    relative = 0.5 * (found.high - found.low) / found.value
    verdict = Verdict.VALID if relative <= options.tolerance else Verdict.VALID_WIDE
    if rejected:
        verdict = Verdict.MODEL_REJECTED
    reason, advice = _words(verdict, solved, options, relative)
    return Identification(
        verdict=verdict,
        model=MODEL,
        reason=reason,
        advice=advice,
        inertia=None if rejected else inertia,
        viscous_nm_s_rad=None if rejected else solved.viscous,
        coulomb_nm=None if rejected else solved.coulomb,
        speed_lag_s=None if rejected else _told(solved.speed_lag_s, LAG_BOUND_S),
        torque_lag_s=None if rejected else _told(solved.torque_lag_s, LAG_BOUND_S),
        skew_s=None if rejected else _told(solved.skew_s, SKEW_BOUND_S),
        paper=paper,
        residual=solved.residual,
        samples_used=samples_used,
        warnings=(*warnings, *_caveats(solved)),
        budget=() if rejected else (*solved.budget, torque_scale_line(found.value, scale, options.confidence)),
    )


def _told(estimate: Estimate, bound: float) -> Estimate | None:
    """None for a lag that the record leaves open up to the bound."""
    return None if max(abs(estimate.low), abs(estimate.high)) >= bound * (1.0 - 1e-6) else estimate


def _conditions(recording: Recording) -> tuple[str, ...]:
    conditions = ["torque scale exact"]
    prior = recording.lag_prior
    if lag_priors(prior):
        conditions.append(f"reporting lags as stated{f' by {prior.source}' if prior.source else ''}")
    if prior.speed_lag_s is None or prior.torque_lag_s is None:
        conditions.append(f"reporting lags below {LAG_BOUND_S:g} s")
    return tuple(conditions)


def _words(verdict: Verdict, solved: Solved, options: Options, relative: float) -> tuple[str, str]:
    p = f" (p = {solved.residual.p_value:.2g})" if solved.residual is not None else ", untested"
    what = "a rigid shaft seen through reporting lags"
    if verdict is Verdict.MODEL_REJECTED:
        return (f"the residuals contradict {what}{p}",
                "look for a compliant load, play, or friction that changes with speed or time; try slower motion")
    fits = f"{what} explains the record{p}"
    if verdict is Verdict.VALID:
        return fits, "identical filters on reported speed and torque, or known ones, would sharpen this further"
    most = max(solved.budget, key=lambda line: line.half_width_kg_m2).source
    advice = {
        "noise": "change the speed more often or by more, or record for longer",
        "friction model": "run at more speeds, so that friction is told from them",
    }.get(most, "state the filters of the drive's reported speed and torque with their uncertainty, or set them equal")
    return f"{fits}, but the interval is ±{relative:.2%}, wider than ±{options.tolerance:.2%}", advice


def _caveats(solved: Solved) -> tuple[str, ...]:
    found = []
    if solved.bent:
        found.append("friction is no straight line over speed: a part that grows with its square was fitted too")
    if solved.shaped:
        found.append("one-pole filters do not fit the reported signals; their structure was fitted too")
    return tuple(found)
