"""Recording in, Identification out: the order of the questions.

1. Are these samples at all?  2. Was there motion that a limit did not shape?  3. Can these lines tell the inertia?
4. Which inertia, with what interval?  5. Do the residuals allow the model?  The paper's method is computed wherever
there are samples, and shown beside whatever comes out.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from tdhil.identify.bent.fit import Motion
from tdhil.identify.bent.verdict import identify_bent
from tdhil.identify.bent.wave import wave_of
from tdhil.identify.beside.friction_curve import friction_curve
from tdhil.identify.beside.friction_curve_points import Inertia
from tdhil.identify.beside.second_look import with_second_look
from tdhil.identify.compliant.choice import may_swing, usable_lines
from tdhil.identify.compliant.verdict import identify_compliant
from tdhil.identify.faults.line_faults import hints, refuse_lines
from tdhil.identify.faults.quality import Refusal, refuse_motion, refuse_samples
from tdhil.identify.identification import Identification, Verdict
from tdhil.identify.lines.fit import Held
from tdhil.identify.lines.friction import Levels, ViscousTie, measure_levels, tie_viscous
from tdhil.identify.lines.identifiable import known_structure, lag_priors, refuse_count, unfiltered, with_skew
from tdhil.identify.lines.model import GaussianPrior
from tdhil.identify.lines.residual import contradicted
from tdhil.identify.lines.rigid_result import RigidResult, fit_rigid
from tdhil.identify.lines.spectrum import Line, PeriodLines, period_lines, pooled_lines
from tdhil.identify.options import Options
from tdhil.identify.paper_method import paper_estimate
from tdhil.identify.record_route import identify_record
from tdhil.identify.samples import Samples, Stretch, excited_window, stretches, usable_samples
from tdhil.identify.stepped import with_stepping
from tdhil.identify.torque_scale import widened_most_by_scale
from tdhil.identify.verdict import Evidence, conclude, refused
from tdhil.record.recording import Recording, Stage, aborted_stage, before_abort

_ROUGH_REL_SD = 0.1
_LEAST_NU = 2.0     # complex degrees of freedom of the weights; fewer and the interval means nothing


def identify(recording: Recording, options: Options | None = None) -> Identification:
    """Identify the inertia. Pure: on one machine the same recording gives the same bits. Never raises: it refuses."""
    options = options or Options()
    stage, kept = aborted_stage(recording), before_abort(recording)
    found = with_stepping(_identify(kept, options), kept, options)
    if found.verdict is Verdict.VALID and found.inertia is not None and widened_most_by_scale(found.inertia):
        found = replace(found, advice="the drive's torque, checked against a known one, would sharpen this most")
    return found if stage is None else _of_an_aborted_run(found, stage)


def _of_an_aborted_run(found: Identification, stage: Stage) -> Identification:
    """The abort goes before whatever the rest of the data says: without it they might have said something else."""
    cause = f" ({stage.detail})" if stage.detail else ""
    if found.inertia is not None:
        said = f"the run was aborted in stage {stage.name}{cause}: the result is from what was recorded before"
        return replace(found, warnings=(said, *found.warnings))
    return replace(
        found,
        reason=f"the run was aborted in stage {stage.name}{cause}; what was recorded before can't tell: {found.reason}",
        advice="mend what ended the run, and run it again",
    )


def _identify(recording: Recording, options: Options) -> Identification:
    refusal = refuse_samples(recording)
    if refusal is not None:
        return refused(refusal, None, 0, 0, ())
    samples = usable_samples(recording)
    paper = paper_estimate(_excited_parts(recording, samples))
    excitation = recording.excitation
    if excitation is None or not excitation.segments:
        record = identify_record(recording, samples, options, paper)
        # Pulses and coasting of our own have calm between them, which a foreign trace need not have.
        return record if excitation is None else with_second_look(record, recording, samples, None, options)
    refusal = refuse_motion(recording, samples)
    if refusal is not None:
        return refused(refusal, paper, 0, len(samples), ())
    cut = stretches(samples, excitation.segments)
    fits = tuple(period_lines(stretch, samples) for stretch in cut)
    periods = sum(len(stretch.periods) for stretch in cut)
    used = sum(len(period) for stretch in cut for period in stretch.periods)
    warnings = _warnings(recording, cut)
    rough = _rough(fits)
    levels = measure_levels(cut, fits, samples, recording.levels, rough)
    tie = _tie(recording, samples, levels, rough, options)
    warnings = (*warnings, *hints(recording, cut, fits, levels))
    every = pooled_lines(fits, tie.slope if tie is not None else 0.0, levels.warming.own)
    refusal = refuse_lines(samples, recording.speed_resolution_rad_s, cut, fits, every)
    if refusal is not None:
        return refused(refusal, paper, periods, used, warnings)
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
    evidence = Evidence(paper, periods, used, warnings)
    usable = usable_lines(every, _LEAST_NU)
    rigid = _Rigid()
    if options.model not in ("two-mass", "string"):
        rigid = _rigid(recording, options, evidence, lines, levels, tie)
        weak = tuple(line for line in usable if all(line is not one for one in lines))
        if rigid.result is not None and contradicted(
            rigid.result.fitted.problem, rigid.result.fitted.whole.theta, weak
        ):
            lines = usable
            rigid = replace(_rigid(recording, options, evidence, lines, levels, tie), doubted=options.model == "auto")
    found = rigid.said
    if found is None or rigid.doubted:
        found = _compliant(recording, options, evidence, usable, levels, tie, found)
    if found.verdict is Verdict.MODEL_REJECTED and rigid.result is not None and options.model in ("auto", "rigid"):
        waves = tuple(wave_of(fit, one.segment) for fit, one in zip(fits, cut, strict=True) if len(fit.speed))
        bent = Motion(waves, levels, lines, tie_viscous(levels))
        found = identify_bent(recording, options, evidence, bent, rigid.priors, rigid.held, rigid.result) or found
    return with_second_look(found, recording, samples, levels, options)


@dataclass(frozen=True)
class _Rigid:
    """What a rigid shaft makes of the lines; ``doubted``: another one should be tried."""

    said: Identification | None = None
    result: RigidResult | None = None
    priors: tuple[GaussianPrior, ...] = ()
    held: Held = field(default_factory=dict)
    doubted: bool = False


def _rigid(
    recording: Recording,
    options: Options,
    evidence: Evidence,
    lines: tuple[Line, ...],
    levels: Levels,
    tie: ViscousTie | None,
) -> _Rigid:
    priors: tuple[GaussianPrior, ...] = ()
    held: Held = {}
    if options.model == "paper":
        refusal = None if len(lines) > 1 else _one_line_paper()
        held = unfiltered()
    else:
        priors = with_skew(lag_priors(recording.lag_prior), len(lines), tie, recording.lag_prior.skew_sd_s)
        refusal = refuse_count(len(lines), tie, priors)
        held = known_structure(recording.lag_prior)
    if refusal is not None:
        return _Rigid(refused(refusal, evidence.paper, evidence.periods, evidence.samples, evidence.warnings))
    result = _fitted(lines, levels, tie, priors, held, options.confidence, recording.torque_scale_rel_sd)
    found = conclude(result, recording, options, evidence, tie, priors)
    doubted = options.model == "auto" and result is not None and may_swing(result, lines, tie, priors, held)
    return _Rigid(found, result, priors, held, doubted)


def _compliant(
    recording: Recording,
    options: Options,
    evidence: Evidence,
    lines: tuple[Line, ...],
    levels: Levels,
    tie: ViscousTie | None,
    rigid: Identification | None,
) -> Identification:
    priors = with_skew(lag_priors(recording.lag_prior), len(lines), tie, recording.lag_prior.skew_sd_s)
    held = known_structure(recording.lag_prior)
    return identify_compliant(recording, options, evidence, lines, levels, tie, priors, held, rigid)


def _tie(
    recording: Recording, samples: Samples, levels: Levels, rough_inertia: float, options: Options
) -> ViscousTie | None:
    """B from the levels; the less sure, the more the friction curve is bent: between two speeds it is a chord."""
    tie = tie_viscous(levels)
    if tie is None:
        return None
    curve = friction_curve(recording, samples, levels, Inertia(rough_inertia, _ROUGH_REL_SD * rough_inertia), options)
    return replace(tie, sd=math.hypot(tie.sd, curve.viscous_spread_nm_s_rad))


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
    confidence: float,
    torque_scale_rel_sd: float,
) -> RigidResult | None:
    """None if the arithmetic breaks down, which only data can cause that passed every test before."""
    try:
        return fit_rigid(lines, levels, tie, priors, held, confidence, torque_scale_rel_sd)
    except (np.linalg.LinAlgError, FloatingPointError, ValueError):
        return None


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
