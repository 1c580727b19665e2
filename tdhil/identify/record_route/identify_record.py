"""Any record in, Identification out: ramps, steps, pulses, coasting, a trace from a drive's own tool.

1. Was there motion, and torque that caused it?  2. Which stretches does the equation hold in?  3. What do they say,
seen through smooth windows at the frequencies that stand clear of the noise?  4. Is that a number?
"""

import numpy as np

from tdhil.identify.faults.left_out import left_out_warnings
from tdhil.identify.faults.quality import Refusal
from tdhil.identify.identification import Identification, PaperEstimate
from tdhil.identify.lines.identifiable import lag_priors
from tdhil.identify.lines.model import GaussianPrior
from tdhil.identify.options import Options
from tdhil.identify.record_route.bins import joined, measure, windows
from tdhil.identify.record_route.conclusion import conclude_record, is_open
from tdhil.identify.record_route.equation import SKEW, SPEED_LAG, TORQUE_LAG
from tdhil.identify.record_route.motion import refuse_open, refuse_signals
from tdhil.identify.record_route.solve import Solved, solve
from tdhil.identify.record_route.stretches import Run, runs, thinned
from tdhil.identify.samples import Samples
from tdhil.identify.verdict import refused
from tdhil.record.recording import Recording

_HIDDEN_S = 2.5        # before a stop, the reported speed may outlive the motion by so long
_LEAST_SKEW_SD_S = 1e-4
_UNTESTED = Refusal(
    "the paper's method takes the reported signals as they are; without periodic excitation nothing tests that",
    "identify with the rigid model, which includes reporting lags",
)


def identify_record(
    recording: Recording, samples: Samples, options: Options, paper: PaperEstimate | None
) -> Identification:
    """Identify from a record without periodic excitation; refuses with reason and advice, never raises on bad data."""
    warnings = _warnings(recording)
    refusal = refuse_signals(recording, samples) if options.model != "paper" else _UNTESTED
    if refusal is not None:
        return refused(refusal, paper, 0, len(samples), warnings)
    few = thinned(samples)
    found = _runs(few, recording)
    solved = _solved(recording, few, found, options)
    if solved is None or is_open(solved.inertia):
        return refused(refuse_open(few, found), paper, 0, len(samples), warnings)
    inside = sum(run.length_s for run in found) / float(few.time_s[-1] - few.time_s[0])
    used = min(len(samples), round(inside * len(samples)))
    return conclude_record(solved, recording, options, paper, used, warnings)


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
        if solved is not None and not is_open(solved.inertia):
            return solved
    return solved


def _warnings(recording: Recording) -> tuple[str, ...]:
    found = []
    if not recording.complete:
        found.append("the log ended before the run did: partial data")
    stale = float((~recording.fresh).mean())
    if stale > 0.01:
        found.append(f"{stale:.1%} of the samples were stale and left out")
    return (*found, *left_out_warnings(recording))


