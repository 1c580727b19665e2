"""Identification of a recording: the order of the checks and fits.

1. Are the samples usable? 2. Was there motion, and did no limit shape it? 3. Do the lines determine the inertia? 4.
Which inertia, with which interval? 5. Do the residuals allow the model? If there are samples, the result of the paper's
method is reported too.
"""

from dataclasses import replace
from functools import partial

from tdhil.estimation.angle_harmonics import without_harmonics
from tdhil.estimation.backlash import with_backlash
from tdhil.estimation.case import Case, Finding, PeriodicCase
from tdhil.estimation.conclude import conclude
from tdhil.estimation.cross_checks import (
    angle_checked,
    cross_checked,
    jump_checked,
    level_checked,
    torques_compared,
    torques_judged,
)
from tdhil.estimation.data_checks import check_known, check_samples
from tdhil.estimation.frequency_domain import distortion_warning, measure_response
from tdhil.estimation.impedance import measure_impedance, refusal
from tdhil.estimation.paper_method import paper_estimate
from tdhil.estimation.periodic import clear_lines, identify_lines, measured
from tdhil.estimation.result import DriveImpedance, Identification, Options, Refused
from tdhil.estimation.samples import Samples, excited_window, usable_samples
from tdhil.estimation.setpoint_sampling import stretched
from tdhil.estimation.stated_lags import with_lags_checked
from tdhil.estimation.time_domain import identify_record, recorded
from tdhil.recording import Excitation, LagPrior, Recording, aborted_stage, before_abort


def identify(recording: Recording, options: Options | None = None) -> Identification:
    """Identify the inertia. Never raises: it refuses. On one machine the same recording gives the same bits."""
    case = Case(before_abort(recording), options or Options(), aborted_stage(recording))
    found_with_lags: Finding | None = None
    try:
        case = torques_compared(sampled(case))
        case = torques_judged(case)
        excitation = case.recording.excitation
        if excitation is None or not excitation.segments:
            case = recorded(case)
            finding = found_with_lags = identify_record(case)
            finding = with_lags_checked(case, finding, partial(_recorded_again, case))
        else:
            # the case is built step by step, so that a refusal contains the counts so far
            bare = case
            case = periodic = measured(case, excitation)
            case = periodic = clear_lines(periodic)
            finding = identify_lines(periodic)
            case, finding = without_harmonics(periodic, finding, partial(_again, bare, excitation, periodic))
            finding = found_with_lags = with_backlash(case, finding)
            finding = with_lags_checked(case, finding, partial(_without_lags, case, bare, excitation))
    except Refused as refused:
        finding = found_with_lags or Finding(refusal=refused.refusal)      # the check of the lags identifies once more
    seen = finding
    if case.sound:
        finding = cross_checked(finding, case)
    finding = jump_checked(level_checked(angle_checked(finding, case), case), case)
    found = conclude(case, stretched(finding, case.recording))
    if isinstance(case, PeriodicCase):
        response = measure_response(case, seen.curve, seen.settled, seen.model)
        found = replace(found, frequency_response=response,
                        warnings=(*found.warnings, *distortion_warning(response, found.warnings)))
    return replace(found, impedance=_impedance(case, finding, found))


def _impedance(case: Case, finding: Finding, found: Identification) -> DriveImpedance | None:
    """Measure the drive's impedance if the run asks for it; else None. A run without J is refused."""
    asked = case.recording.impedance
    if asked is None:
        return None
    if finding.contradiction.reason:
        return refusal(asked, found.reason, found.advice)
    if isinstance(case, PeriodicCase):
        return measure_impedance(case)
    return refusal(asked, finding.refusal.reason, finding.refusal.advice)


def _again(
    case: Case, excitation: Excitation, reported: PeriodicCase, samples: Samples
) -> tuple[PeriodicCase, Finding]:
    """Return the periodic case with other samples, and its finding. Raises Refused as the first time."""
    found = clear_lines(measured(replace(case, samples=samples), excitation, reported))
    return found, identify_lines(found)


def _without_lags(case: PeriodicCase, bare: Case, excitation: Excitation, prior: LagPrior) -> Finding:
    """Return the finding of the same periodic samples with another statement of the lags. Raises Refused."""
    other = replace(bare, recording=replace(bare.recording, lag_prior=prior))
    return _again(other, excitation, case, case.samples)[1]


def _recorded_again(case: Case, prior: LagPrior) -> Finding:
    """Return the finding of the same record with another statement of the lags. Raises Refused."""
    return identify_record(replace(case, recording=replace(case.recording, lag_prior=prior)))


def sampled(case: Case) -> Case:
    """Return the case with its samples and the result of the paper's method, after settling (all samples without
    excitation).

    Raises Refused for unusable samples.
    """
    check_samples(case.recording)
    check_known(case.recording)
    samples = usable_samples(case.recording)
    parts = [samples]
    if case.recording.excitation is not None and case.recording.excitation.segments:
        parts = [samples.between(*excited_window(segment)) for segment in case.recording.excitation.segments]
    return replace(case, samples=samples, paper=paper_estimate(tuple(parts)), samples_used=len(samples))
