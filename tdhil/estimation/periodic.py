"""Route of the frequency domain: from periodic excitation to a finding.

1. Whole periods, their lines, and B from the mean operating points. 2. Checks of the lines: are they possible, and are
enough of them clear of the scatter? 3. Selection of a candidate (`tdhil.estimation.candidates`).
"""

import contextlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from profiles import CodedText, MessageCode
from tdhil.config import identified_before_echo
from tdhil.estimation.candidates import (
    BEFORE_ECHO,
    BENT_FRICTION,
    CLEAR_LINES,
    LOAD_SWINGS,
    WEAK_LINES,
    FitRoute,
    ModelTrial,
    walk,
)
from tdhil.estimation.case import Case, Finding, PeriodicCase
from tdhil.estimation.cross_checks import Inertia, friction_curve
from tdhil.estimation.data_checks import check_motion
from tdhil.estimation.excitation_checks import check_lines, hints, undeclared_warning
from tdhil.estimation.frequency_domain import (
    LEAST_NU,
    RigidResult,
    ShaftModel,
    contradicted,
    fit_rigid,
    identify_before_echo,
    identify_bent,
    identify_compliant,
    known_of,
    may_swing,
    refuse_count,
    refuse_stick_slip,
    rigid_finding,
    settled_lines,
    shaft_model,
    unfiltered,
    usable_lines,
)
from tdhil.estimation.friction_levels import Levels, ViscousConstraint, measure_levels, tie_viscous
from tdhil.estimation.result import Refusal, Refused, doubtful
from tdhil.estimation.samples import Stretch, log_warnings, stretches
from tdhil.estimation.spectrum import PeriodLines, SpectralLine, period_lines, pooled_lines
from tdhil.recording import Excitation

_ROUGH_REL_SD = 0.1       # relative standard uncertainty of the rough inertia as a prior
_BEFORE_ECHO_HELPS = (
    "add --excitation prbs, which uses only the time before the echo. Or lift the bit off bottom, reduce the "
    "weight on it, raise the amplitude, or excite for more periods"
)
_ONE_LINE = Refusal(
    "one excited line can't test the paper's assumption that the reported signals are not filtered",
    "excite with more lines (a multisine)", entry=MessageCode.TOO_FEW_LINES,
)


def measured(case: Case, excitation: Excitation, reported: PeriodicCase | None = None) -> PeriodicCase:
    """Return the case with its whole periods, their lines, and B from the levels. Raises Refused without free
    motion. ``reported``: the case of the samples as reported, if those of ``case`` are corrected ones.
    """
    recording, samples = case.recording, case.samples
    check_motion(recording, excitation, samples)
    cut = stretches(samples, excitation.segments)
    quanta = (recording.speed_resolution_rad_s, recording.torque_resolution_nm)
    fits = tuple(period_lines(stretch, samples, quanta) for stretch in cut)
    rough = _rough(fits)
    levels = measure_levels(cut, fits, samples, recording.levels, rough)
    constraint = _tie(case, levels, rough)
    undeclared = undeclared_warning(cut, fits) if reported is None else reported.undeclared
    return PeriodicCase(
        recording=recording,
        options=case.options,
        aborted=case.aborted,
        samples=samples,
        paper=case.paper,
        periods_used=sum(len(stretch.periods) for stretch in cut),
        samples_used=sum(len(period) for stretch in cut for period in stretch.periods),
        warnings=(*case.warnings, *log_warnings(recording), *_warnings(cut), *hints(recording, undeclared, levels)),
        levels=levels,
        torque_ratios=case.torque_ratios,
        stretches=cut,
        fits=fits,
        constraint=constraint,
        every=pooled_lines(fits, constraint.slope if constraint is not None else 0.0, levels.warming.own),
        undeclared=undeclared,
    )


def clear_lines(case: PeriodicCase) -> PeriodicCase:
    """Return the case with the lines clear of their scatter. Raises Refused if they do not determine the inertia."""
    if _before_echo(case):
        refuse_stick_slip(case)
    check_lines(case)
    every = case.every
    if not every or max(line.nu for line in every) < LEAST_NU:
        raise Refused(
            f"{case.periods_used} usable whole periods are too few to know the scatter",
            "let each mean speed run for four periods or more after settling",
            entry=MessageCode.TOO_FEW_PERIODS,
        )
    if _before_echo(case):       # before the echo all lines are used; the likelihood weights each by its uncertainty
        return replace(case, lines=every, usable=every, sound=True)
    lines = tuple(line for line in every if line.excited and line.nu >= LEAST_NU)
    if not lines:
        raise _too_few(
            case, "no excited line is clearly above the scatter", "raise the amplitude, or excite for more periods")
    warnings = case.warnings
    if len(lines) < len(every):
        warnings = (*warnings, CodedText(
            f"{len(every) - len(lines)} of {len(every)} lines were too weak to be used",
            MessageCode.LINES_TOO_WEAK))
    return replace(case, lines=lines, usable=usable_lines(every, LEAST_NU), warnings=warnings, sound=True)


@dataclass(frozen=True)
class _LineWalk:
    """State of the walk over the rows of the lines. ``weak``: a line that is weak in one signal contradicted the
    fit.
    """

    case: PeriodicCase
    rigid: RigidResult | None = None
    weak: bool = False
    finding: Finding | Refusal | None = None
    ended: bool = False

    @property
    def asked(self) -> ShaftModel:
        return shaft_model(self.case.options.model)


def identify_lines(case: PeriodicCase) -> Finding:
    """Walk the rows of the lines (`tdhil.estimation.candidates`). Raises Refused if no row gives J."""
    finding = walk(FitRoute.LINES, _TRIALS, _LineWalk(case)).finding
    if isinstance(finding, Refusal):
        raise Refused(finding.reason, _BEFORE_ECHO_HELPS if _drowned(case) else finding.advice,
                      finding.entry)
    assert finding is not None
    return finding


def _try_before_echo(now: _LineWalk) -> _LineWalk:
    return replace(now, finding=identify_before_echo(now.case), ended=True)


def _try_clear_lines(now: _LineWalk) -> _LineWalk:
    return _with_rigid(now, now.case.lines)


def _try_weak_lines(now: _LineWalk) -> _LineWalk:
    return replace(_with_rigid(now, now.case.usable), weak=True)


def _with_rigid(now: _LineWalk, lines: tuple[SpectralLine, ...]) -> _LineWalk:
    """Fit the rigid shaft to the lines. Raises Refused for too few lines.

    The arithmetic may fail even for data that passed every check: then there is no rigid shaft.
    """
    case = now.case
    options, scale = case.options, case.recording.torque_scale_rel_sd
    priors, fixed = known_of(case.recording.lag_prior, len(lines), case.constraint)
    refusal = refuse_count(len(lines), case.constraint, priors)
    if not shaft_model(options.model).lags:
        priors, fixed = (), unfiltered()
        refusal = None if len(lines) > 1 else _ONE_LINE
    if refusal is not None:
        raise _too_few(case, refusal.reason, refusal.advice)
    rigid: RigidResult | None = None
    with contextlib.suppress(np.linalg.LinAlgError, FloatingPointError, ValueError):
        rigid = fit_rigid(lines, case.levels, case.constraint, priors, fixed, options.confidence, scale)
    return replace(now, rigid=rigid, finding=_advised(rigid_finding(rigid, case), case))


def _weak_lines_contradict(now: _LineWalk) -> bool:
    if now.rigid is None:
        return False
    weak = tuple(line for line in now.case.usable if all(line is not one for one in now.case.lines))
    return contradicted(now.rigid.fitted.problem, now.rigid.fitted.whole.theta, weak)


def _load_may_swing(now: _LineWalk) -> bool:
    if now.asked.compliant is not None:
        return True
    return now.asked.widened and (
        now.weak or now.case.recording.has_drill_string or (now.rigid is not None and may_swing(now.rigid)))


def _try_load(now: _LineWalk) -> _LineWalk:
    own = settled(now.case)
    if now.finding is None:
        found = identify_compliant(own)
    else:
        found = identify_compliant(own, now.finding, now.rigid is not None and now.rigid.first_order)
    if isinstance(found, Finding):
        found = replace(found, settled=own.every)
    return replace(now, finding=_advised(found, now.case))


def _is_bent(now: _LineWalk) -> bool:
    """Return whether the data reject linear friction, or allow it only just.

    An oscillating load leaves residuals that nonlinear friction explains too. In doubt, nonlinear friction is tried
    only after the load.
    """
    finding = now.finding
    if not isinstance(finding, Finding) or now.rigid is None or not now.asked.lags:
        return False
    return finding.rejected or (now.asked.widened and finding.compliant is None and doubtful(finding.residual))


def _try_bent(now: _LineWalk) -> _LineWalk:
    assert now.rigid is not None
    return replace(now, finding=identify_bent(now.case, now.rigid) or now.finding)


_TRIALS: Mapping[str, ModelTrial[_LineWalk]] = {
    BEFORE_ECHO: ModelTrial(lambda now: _before_echo(now.case), _try_before_echo),
    CLEAR_LINES: ModelTrial(lambda now: now.asked.compliant is None, _try_clear_lines),
    WEAK_LINES: ModelTrial(_weak_lines_contradict, _try_weak_lines),
    LOAD_SWINGS: ModelTrial(_load_may_swing, _try_load),
    BENT_FRICTION: ModelTrial(_is_bent, _try_bent),
}


def _advised(finding: Finding | Refusal, case: PeriodicCase) -> Finding | Refusal:
    """Return the finding. If a string covered lines, the advice for a wide interval is the motion before the echo."""
    if isinstance(finding, Refusal) or not _drowned(case):
        return finding
    return replace(finding, words=replace(finding.words, if_wide=_BEFORE_ECHO_HELPS))


def _before_echo(case: PeriodicCase) -> bool:
    """Return whether the time before the echo is used; False if the requested shaft is not a string."""
    excitation = case.recording.excitation
    return excitation is not None and identified_before_echo(excitation.kind) and shaft_model(case.options.model).piped


def _too_few(case: PeriodicCase, what: str, advice: str) -> Refused:
    """Return the refusal for too few clear lines; with a string of known pipe it states the scatter due to the
    string.
    """
    if not _drowned(case):
        return Refused(what, advice, MessageCode.TOO_FEW_LINES)
    weak = [line for line in case.every if not line.excited]
    best = max(weak, key=lambda line: float(np.max(np.abs(line.speed))) / math.sqrt(max(line.s_ww, 1e-300)))
    moved, scatter = float(np.max(np.abs(best.speed))), math.sqrt(best.s_ww)
    return Refused(
        f"{what}. At {best.hertz:.3g} Hz the excitation moves the speed by ±{moved:.2g} rad/s. The string moves "
        f"it by ±{scatter:.2g} rad/s, differently in each period",
        _BEFORE_ECHO_HELPS, entry=MessageCode.TOO_FEW_LINES,
    )


def _drowned(case: PeriodicCase) -> bool:
    """Return whether a string with a known pipe covers some lines, so that another excitation would determine more."""
    return case.recording.pipe is not None and any(not line.excited for line in case.every)


def settled(case: PeriodicCase) -> PeriodicCase:
    """Return the case without the residual oscillation of the shaft (`transient`)."""
    slope = case.constraint.slope if case.constraint is not None else 0.0
    every = settled_lines(case.fits, case.stretches, slope, case.levels.warming.own)
    usable = usable_lines(every, LEAST_NU)
    return replace(case, every=every, usable=usable) if usable else case


def _tie(case: Case, levels: Levels, rough_inertia: float) -> ViscousConstraint | None:
    """Return B from the levels. Curved friction makes it less certain, as a chord between two speeds."""
    constraint = tie_viscous(levels)
    if constraint is None:
        return None
    inertia = Inertia(rough_inertia, _ROUGH_REL_SD * rough_inertia)
    curve = friction_curve(case.recording, case.samples, levels, inertia, case.options)
    return replace(constraint, sd=math.hypot(constraint.sd, curve.viscous_spread_nm_s_rad))


def _rough(fits: tuple[PeriodLines, ...]) -> float:
    """Return |T|/(ω|W|) at the strongest line, kg·m²: a rough inertia, good enough to correct the levels for drift."""
    for fit in fits:
        if len(fit.speed):
            speed, torque = np.abs(fit.speed.mean(axis=0)), np.abs(fit.torque.mean(axis=0))
            strongest = int(np.argmax(speed))
            if speed[strongest] > 0.0:
                return float(torque[strongest] / (2.0 * math.pi * fit.lines_hz[strongest] * speed[strongest]))
    return 0.0


def _warnings(cut: tuple[Stretch, ...]) -> tuple[str, ...]:
    """Return warnings of missing periods, and of speeds at which friction jumps."""
    found = []
    for stretch in cut:
        segment = stretch.segment
        expected = round((segment.end_s - segment.start_s) / segment.period_s) - segment.settle_periods
        if len(stretch.periods) < expected:
            found.append(CodedText(
                f"{len(stretch.periods)} of {expected} periods about {segment.offset_rad_s:.3g} rad/s were usable",
                MessageCode.PERIODS_MISSING))
        speeds = [period.speed_rad_s for period in stretch.periods]
        if speeds and min(float(s.min()) for s in speeds) < 0.0 < max(float(s.max()) for s in speeds):
            found.append(CodedText(
                f"the speed about {segment.offset_rad_s:.3g} rad/s crossed zero: friction is not linear there",
                MessageCode.SPEED_CHANGES_SIGN))
    return tuple(found)
