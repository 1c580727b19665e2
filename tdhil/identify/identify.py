"""Recording in, Identification out: the order of the questions.

1. Are these samples at all?  2. Was there motion that a limit did not shape?  3. Can these lines tell the inertia?
4. Which inertia, with what interval?  5. Do the residuals allow the model?  The paper's method is computed wherever
there are samples, and shown beside whatever comes out.
"""

import math

import numpy as np

from tdhil.identify.friction import Levels, ViscousTie, measure_levels, tie_viscous
from tdhil.identify.identifiable import lag_priors, refuse_count, with_skew
from tdhil.identify.identification import Identification
from tdhil.identify.likelihood import GaussianPrior
from tdhil.identify.options import Options
from tdhil.identify.paper_method import paper_estimate
from tdhil.identify.quality import Refusal, refuse_motion, refuse_samples
from tdhil.identify.rigid import SKEW, SPEED_LAG, TORQUE_LAG, SpeedReport
from tdhil.identify.rigid_result import RigidResult, fit_rigid
from tdhil.identify.samples import Samples, Stretch, excited_window, stretches, usable_samples
from tdhil.identify.spectrum import Line, PeriodLines, period_lines, pooled_lines
from tdhil.identify.verdict import Evidence, conclude, refused
from tdhil.record.recording import Recording

_LEAST_NU = 2.0     # complex degrees of freedom of the weights; fewer and the interval means nothing


def identify(recording: Recording, options: Options | None = None) -> Identification:
    """Identify the inertia. Pure: the same recording gives the same bits. Never raises on bad data: it refuses."""
    options = options or Options()
    refusal = refuse_samples(recording)
    if refusal is not None:
        return refused(refusal, None, 0, 0, ())
    samples = usable_samples(recording)
    paper = paper_estimate(_excited_parts(recording, samples))
    refusal = refuse_motion(recording, samples)
    excitation = recording.excitation
    if refusal is not None or excitation is None:
        return refused(refusal or Refusal("there was no excitation", ""), paper, 0, len(samples), ())
    cut = stretches(samples, excitation.segments)
    fits = tuple(period_lines(stretch, samples) for stretch in cut)
    periods = sum(len(stretch.periods) for stretch in cut)
    used = sum(len(period) for stretch in cut for period in stretch.periods)
    warnings = _warnings(recording, cut)
    levels = measure_levels(cut, fits, samples, recording.levels, _rough(fits))
    tie = tie_viscous(levels)
    every = pooled_lines(fits, tie.slope if tie is not None else 0.0)
    if not every or max(line.nu for line in every) < _LEAST_NU:
        short = Refusal(
            f"{periods} usable whole periods are too few to know the scatter",
            "let each mean speed run for four periods or more after settling",
        )
        return refused(short, paper, periods, used, warnings)
    lines = tuple(line for line in every if line.excited and line.nu >= _LEAST_NU)
    if not lines:
        unclear = Refusal("no excited line stands clear of the scatter", "excite with more amplitude, or for longer")
        return refused(unclear, paper, periods, used, warnings)
    if len(lines) < len(every):
        warnings = (*warnings, f"{len(every) - len(lines)} of {len(every)} lines were too weak to be used")
    return _rigid(recording, options, Evidence(paper, periods, used, warnings), lines, levels, tie)


def _rigid(
    recording: Recording,
    options: Options,
    evidence: Evidence,
    lines: tuple[Line, ...],
    levels: Levels,
    tie: ViscousTie | None,
) -> Identification:
    priors: tuple[GaussianPrior, ...] = ()
    held: dict[int, float] = {}
    reports: tuple[SpeedReport, ...] = (SpeedReport.FIRST_ORDER,)
    if options.model == "paper":
        refusal = None if len(lines) > 1 else _one_line_paper()
        held = {SPEED_LAG: 0.0, TORQUE_LAG: 0.0, SKEW: 0.0}
    else:
        priors = with_skew(lag_priors(recording.lag_prior), len(lines), tie, recording.lag_prior.skew_sd_s)
        refusal = refuse_count(len(lines), tie, priors)
        reports = _reports(recording, len(lines), tie, priors)
    if refusal is not None:
        return refused(refusal, evidence.paper, evidence.periods, evidence.samples, evidence.warnings)
    result = _fitted(lines, levels, tie, priors, held, reports, options.confidence)
    return conclude(result, recording, options, evidence, tie, priors)


def _rough(fits: tuple[PeriodLines, ...]) -> float:
    """|T|/(ω|W|) at the strongest line: the inertia's size, enough to correct the levels for drift."""
    for fit in fits:
        if len(fit.speed):
            speed, torque = np.abs(fit.speed.mean(axis=0)), np.abs(fit.torque.mean(axis=0))
            strongest = int(np.argmax(speed))
            if speed[strongest] > 0.0:
                return float(torque[strongest] / (2.0 * math.pi * fit.lines_hz[strongest] * speed[strongest]))
    return 0.0


def _fitted(
    lines: tuple[Line, ...],
    levels: Levels,
    tie: ViscousTie | None,
    priors: tuple[GaussianPrior, ...],
    held: dict[int, float],
    reports: tuple[SpeedReport, ...],
    confidence: float,
) -> RigidResult | None:
    """None if the arithmetic breaks down, which only data can cause that passed every test before."""
    try:
        return fit_rigid(lines, levels, tie, priors, held, reports, confidence)
    except (np.linalg.LinAlgError, FloatingPointError, ValueError):
        return None


def _reports(
    recording: Recording, lines: int, tie: ViscousTie | None, priors: tuple[GaussianPrior, ...]
) -> tuple[SpeedReport, ...]:
    """A stated speed lag is a first-order one, and so is one that the count leaves no room to question."""
    if recording.lag_prior.speed_lag_s is not None or 2 * lines + (tie is not None) + len(priors) <= 5:
        return (SpeedReport.FIRST_ORDER,)
    return tuple(SpeedReport)


def _excited_parts(recording: Recording, samples: Samples) -> tuple[Samples, ...]:
    """The excitation after settling; the whole run where there was none."""
    if recording.excitation is None or not recording.excitation.segments:
        return (samples,)
    windows = [excited_window(segment) for segment in recording.excitation.segments]
    return tuple(samples.between(start, end) for start, end in windows)


def _one_line_paper() -> Refusal:
    return Refusal(
        "one excited line can't test the paper's assumption that the reported signals are not filtered",
        "excite with more lines (a multisine)",
    )


def _warnings(recording: Recording, cut: tuple[Stretch, ...]) -> tuple[str, ...]:
    found = []
    if not recording.complete:
        found.append("the log ended before the run did: partial data")
    stale = float((~recording.fresh).mean())
    if stale > 0.01:
        found.append(f"{stale:.1%} of the samples were stale and left out")
    for stretch in cut:
        segment = stretch.segment
        expected = round((segment.end_s - segment.start_s) / segment.period_s) - segment.settle_periods
        if len(stretch.periods) < expected:
            found.append(
                f"{len(stretch.periods)} of {expected} periods about {segment.offset_rad_s:.3g} rad/s were usable"
            )
        speeds = [period.speed_rad_s for period in stretch.periods]
        if speeds and min(float(s.min()) for s in speeds) < 0.0 < max(float(s.max()) for s in speeds):
            found.append(f"the speed about {segment.offset_rad_s:.3g} rad/s crossed zero: friction is not linear there")
    return tuple(found)
