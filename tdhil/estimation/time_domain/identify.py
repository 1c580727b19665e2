"""Any record in, Identification out: ramps, steps, pulses, coasting, a trace from a drive's own tool.

1. Was there motion, and torque that caused it?  2. Which stretches does the equation hold in?  3. What do they say,
seen through smooth windows at the frequencies that stand clear of the noise?  4. Is that a number?
"""

from dataclasses import replace

import numpy as np

from tdhil.estimation.case import Case, Finding, Words
from tdhil.estimation.frequency_domain.model import GaussianPrior
from tdhil.estimation.frequency_domain.signal_filters import LAG_BOUND_S, SKEW_BOUND_S
from tdhil.estimation.result import Estimate, Refused
from tdhil.estimation.samples import Samples
from tdhil.estimation.time_domain.equation import SKEW, SPEED_LAG, TORQUE_LAG
from tdhil.estimation.time_domain.solve import Solved, solve
from tdhil.estimation.time_domain.windows import joined, measure, windows
from tdhil.identify.faults.left_out import left_out_warnings, log_warnings
from tdhil.identify.lines.identifiable import lag_priors
from tdhil.identify.options import Options
from tdhil.identify.record_route.motion import check_signals, refuse_open
from tdhil.identify.record_route.stretches import Run, runs, thinned
from tdhil.identify.torque_scale import torque_scale_line
from tdhil.recording.recording import Recording

MODEL = "rigid+lags (time domain)"
_HIDDEN_S = 2.5        # before a stop, the reported speed may outlive the motion by so long
_LEAST_SKEW_SD_S = 1e-4
_WIDE = {
    "noise": "change the speed more often or by more, or record for longer",
    "friction model": "run at more speeds, so that friction is told from them",
}


def recorded(case: Case) -> Case:
    """The case with what is wrong with its record but leaves a number that stands."""
    recording = case.recording
    warnings = (*log_warnings(recording), *left_out_warnings(recording))
    # Pulses and coasting of our own have calm between them, which a foreign trace need not have.
    return replace(case, warnings=warnings, sound=recording.excitation is not None)


def identify_record(case: Case) -> Finding:
    """What a record without periodic excitation tells of a rigid shaft. Raises Refused where it leaves J open."""
    if case.options.model == "paper":
        raise Refused(
            "the paper's method takes the reported signals as they are; without periodic excitation nothing tests that",
            "identify with the rigid model, which includes reporting lags",
        )
    check_signals(case.recording, case.samples)
    few = thinned(case.samples)
    found = _runs(few, case.recording)
    solved = _solved(case.recording, few, found, case.options)
    if solved is None or _is_open(solved.inertia):
        refuse_open(few, found)
    inside = sum(run.length_s for run in found) / float(few.time_s[-1] - few.time_s[0])
    used = min(case.samples_used, round(inside * case.samples_used))
    return replace(_finding(solved, case), samples_used=used)


def _runs(samples: Samples, recording: Recording) -> tuple[Run, ...]:
    """What turns; a machine that stops every few seconds would have nothing left of it but for a shorter wait."""
    found: tuple[Run, ...] = ()
    for hidden in (_HIDDEN_S, 0.4 * _HIDDEN_S, 0.1 * _HIDDEN_S):
        found = runs(samples, recording.speed_resolution_rad_s, hidden)
        moving = sum(run.length_s for run in runs(samples, recording.speed_resolution_rad_s, 0.0))
        if sum(run.length_s for run in found) >= 0.5 * moving:
            break
    return found


def _solved(recording: Recording, samples: Samples, found: tuple[Run, ...], options: Options) -> Solved | None:
    """With what is known of the lags; if both are and it doesn't do, with the signals taken as simultaneous."""
    placed = windows(found)
    if not placed:
        return None
    bins = joined([measure(window) for window in placed])
    span = float(np.ptp(samples.torque_nm))
    known = lag_priors(recording.lag_prior, SPEED_LAG, TORQUE_LAG)
    choices: list[tuple[GaussianPrior, ...]] = [known]
    if len(known) == 2:
        choices.append((*known, GaussianPrior(SKEW, 0.0, max(recording.lag_prior.skew_sd_s, _LEAST_SKEW_SD_S))))
    solved = None
    for priors in choices:
        try:
            solved = solve(bins, placed, priors, span, options.confidence)
        except (np.linalg.LinAlgError, FloatingPointError, ValueError, OverflowError):
            solved = None
        if solved is not None and not _is_open(solved.inertia):
            return solved
    return solved


def _is_open(inertia: Estimate) -> bool:
    """Does the interval say nothing worth a number?"""
    return not inertia.bounded or inertia.low <= 0.0


def _finding(solved: Solved, case: Case) -> Finding:
    most = max(solved.budget, key=lambda line: line.half_width_kg_m2).source if solved.budget else ""
    words = Words(
        "a rigid shaft seen through reporting lags",
        "look for a compliant load, play, or friction that changes with speed or time; try slower motion",
        _WIDE.get(
            most, "state the filters of the drive's reported speed and torque with their uncertainty, or set them equal"
        ),
        "explains the record",
        digits=2,
    )
    bare = Finding(MODEL, words, solved.residual, warnings=_caveats(solved))
    if bare.rejected:
        return bare
    scale = torque_scale_line(solved.inertia.value, case.recording.torque_scale_rel_sd, case.options.confidence)
    return replace(
        bare,
        inertia=solved.inertia,
        conditions=_conditions(case.recording),
        viscous_nm_s_rad=solved.viscous,
        coulomb_nm=solved.coulomb,
        speed_lag_s=_told(solved.speed_lag_s, LAG_BOUND_S),
        torque_lag_s=_told(solved.torque_lag_s, LAG_BOUND_S),
        skew_s=_told(solved.skew_s, SKEW_BOUND_S),
        budget=(*solved.budget, scale),
    )


def _told(estimate: Estimate, bound: float) -> Estimate | None:
    """None for a lag that the record leaves open up to the bound."""
    return None if max(abs(estimate.low), abs(estimate.high)) >= bound * (1.0 - 1e-6) else estimate


def _conditions(recording: Recording) -> tuple[str, ...]:
    conditions = []
    prior = recording.lag_prior
    if lag_priors(prior):
        conditions.append(f"reporting lags as stated{f' by {prior.source}' if prior.source else ''}")
    if prior.speed_lag_s is None or prior.torque_lag_s is None:
        conditions.append(f"reporting lags below {LAG_BOUND_S:g} s")
    return tuple(conditions)


def _caveats(solved: Solved) -> tuple[str, ...]:
    found = []
    if solved.bent:
        found.append("friction is no straight line over speed: a part that grows with its square was fitted too")
    if solved.shaped:
        found.append("one-pole filters do not fit the reported signals; their structure was fitted too")
    return tuple(found)
