"""Momentum cross-check: J by momentum balances of the same run instead of spectral lines, and whether the two agree.

The lines give J from the oscillation of torque and speed, and need the lags of the reports. The balances give J from
the torque of a change between two steady speeds (ramps of stages 2 and 3, the change to stage 5 and between its mean
speeds, plateaus of a square wave), or from the deceleration by friction alone. Lags have little effect on them. Both
routes share the friction and the torque scale, but use different stretches of the run, so their errors are nearly
independent.

Error model: density of the disturbance over the time of a change, friction from all steady stretches, rounding, and B·δ
of the reports' delays. δ is fitted or stated, else unknown within ±0.5 s (two standard deviations).
"""

import math
from dataclasses import replace

import numpy as np

from profiles import CodedText, MessageCode
from profiles.quantities import printed_interval
from tdhil.config import has_plateaus
from tdhil.estimation.case import Case, Finding
from tdhil.estimation.cross_checks.friction_by_speed import Inertia, friction_curve
from tdhil.estimation.cross_checks.level_torque import least_torque_scale_change
from tdhil.estimation.cross_checks.momentum import BalanceKind, Balances, balances
from tdhil.estimation.cross_checks.momentum_fit import (
    LEAST_DOF,
    UNKNOWN_DELAY,
    Delay,
    Density,
    MomentumFit,
    Resolution,
    fit_momentum,
)
from tdhil.estimation.cross_checks.run_up import run_up_inertia
from tdhil.estimation.cross_checks.speed_loop import speed_loop
from tdhil.estimation.frequency_domain import CERTAIN, student_quantile
from tdhil.estimation.result import OPEN, Estimate, Refusal, SecondOpinion, normal_quantile
from tdhil.estimation.samples import acquisitions, usual_interval
from tdhil.estimation.setpoint_sampling import ReadingShare, ReadMoment, reading_share, usual_loops
from tdhil.recording import FloatArray, SteppedSetpoint

_FALSE_ALARM = 0.01       # share of sound runs with a false warning; more frequent warnings would be ignored
_WORTH_A_FIT = 0.005
"""Least share of J that reading in step may add with a usual speed loop, for a fit of the drive's own loop."""

Fitted = tuple[tuple[SecondOpinion, MomentumFit], ...]
_CONTRADICTION = 1e-3
"""Probability of withdrawing a sound result, given noise and undetected nonlinear friction: once for the balances of
the run, once for its run-up.
"""

_DETECTED = 0.95
"""Probability with which a change of scale of the stated size contradicts J."""

_ALIKE = 0.05
"""Share of J: a smaller difference does not count. Friction drifts between stages by a few percent of J's torque."""


def cross_checked(finding: Finding, case: Case) -> Finding:
    """Return the finding with cross-checks and friction curve. Never raises. The curve needs excited segments.

    Refused data get no cross-check, because a cross-check would give a number from them (`Case.sound`).
    """
    fitted = _fitted_opinions(case, finding)
    opinions = tuple(opinion for opinion, _ in fitted)
    warnings = (*finding.warnings, *disagreements(opinions, finding))
    # If a signal changes its scale during the run, the balances of the whole run contradict one another, and their
    # interval becomes so wide that J agrees with it. The balances before stage 5 do not have this problem.
    begun = next((stage.start_s for stage in acquisitions(case.recording)), None)
    before: Fitted = ()
    if begun is not None:
        earlier = replace(
            case, recording=replace(case.recording, excitation=None), samples=case.samples.between(-math.inf, begun))
        before = tuple((replace(opinion, route=f"{opinion.route} before stage 5"), fit)
                       for opinion, fit in _fitted_opinions(earlier, finding, alone=True))
    against = (*fitted, *before)
    reference, confidence = reference_inertia(finding), case.options.confidence
    run_up = run_up_opinion(case, finding)
    if opinions and before and reference is not None and reference.finite and reference.value > 0.0:
        shown = [(stage, _least_scale_change(found[0], len(group), reference, confidence))
                 for stage, group, found in (("5", against, before), ("2", run_up, run_up)) if found]
        words = ", ".join(f"of ±{100 * least:.0f} % or more at stage {stage}" for stage, least in shown)
        opinions = (replace(
            opinions[0], note=f"{opinions[0].note}; detects a change of scale {words}",
            least_scale_change=max(least for _, least in shown)), *opinions[1:])
    elif (case.recording.has_drill_string and finding.inertia is not None
            and all(one.agrees is None for one in opinions)):
        # no momentum balance can be compared with J
        hidden = least_torque_scale_change(case.recording, case.samples)
        what = ("a change in the scale of torque or speed" if hidden is None else
                f"a change of less than {100 * hidden:.0f} % in the scale of torque or speed after stage 2, or any "
                "change within it")
        warnings = (*warnings, CodedText(
            f"this run does not show {what}. If a scale changed, J has an error of that size",
            MessageCode.SCALE_CHANGE_HIDDEN))
        if opinions and hidden is not None:
            opinions = (replace(opinions[0], least_scale_change=hidden), *opinions[1:])
    inertia = _inertia(case, finding, opinions)
    contradiction = _contradiction(against, finding, confidence)
    if not contradiction.reason:
        # a scale that changes after the run-up of stage 2 changes J and all later balances alike
        contradiction = _contradiction(run_up, finding, confidence)
    if contradiction.reason:
        # a withdrawn J gets no further figures, as for residuals that contradict the model
        finding = finding.taken_back(contradiction)
    if inertia is None or case.levels is None:
        return replace(finding, second_opinions=opinions, warnings=warnings)
    curve = friction_curve(case.recording, case.samples, case.levels, inertia, case.options)
    # if nonlinear friction is part of the model, J accounts for it
    warnings = (*warnings, *(() if finding.bent else curve.warnings))
    return replace(finding, second_opinions=opinions, friction_curve=curve.points, warnings=warnings)


def _inertia(case: Case, finding: Finding, opinions: tuple[SecondOpinion, ...]) -> Inertia | None:
    """Return J of everything that turns, with its standard deviation: from the finding, else from a momentum
    cross-check.
    """
    known = reference_inertia(finding)
    if known is None and opinions:
        known = opinions[0].inertia_kg_m2
    if known is None:
        return None
    sd = _sd(case, known)
    finite = math.isfinite(known.value) and math.isfinite(sd)
    return Inertia(known.value, sd, _known_delay(case, finding), _swing_s(finding)) if finite else None


def _swing_s(finding: Finding) -> float:
    """Return the period in which the load of a compliant shaft oscillates at constant speed of the motor, s; else 0."""
    shaft = finding.compliant
    known = None if shaft is None else shaft.antiresonance_hz or shaft.resonance_hz
    return 0.0 if known is None or not known.value > 0.0 else 1.0 / known.value


def second_opinions(case: Case, finding: Finding) -> tuple[SecondOpinion, ...]:
    """Return J by every route of the run; () without one. Uses the J and lags of the finding, if it has them. Never
    raises.
    """
    return tuple(opinion for opinion, _ in _fitted_opinions(case, finding))


def _fitted_opinions(case: Case, finding: Finding, *, alone: bool = False) -> Fitted:
    levels = case.levels
    try:
        found = balances(case.recording, case.samples, alone=alone or levels is None or levels.dof < LEAST_DOF)
        opinions = () if found is None else _opinions(case, found, finding)
    except (np.linalg.LinAlgError, FloatingPointError, ValueError, ZeroDivisionError):
        return ()
    share = _FALSE_ALARM / max(1, len(opinions))
    return tuple(
        (replace(opinion, agrees=_agrees(opinion.inertia_kg_m2, finding, case.options.confidence, share)), fit)
        for opinion, fit in opinions
    )


def run_up_opinion(case: Case, finding: Finding) -> Fitted:
    """Return J by the run-up of stage 2; () above a drill string, for a compliant shaft, and without known lags. Never
    raises.
    """
    speed, torque, skew = finding.speed_lag_s, finding.torque_lag_s, finding.skew_s
    delay = _known_delay(case, finding)
    if speed is None or torque is None or skew is None or not delay.known:
        return ()
    if case.levels is None or case.recording.has_drill_string or finding.compliant is not None:
        return ()
    confidence = case.options.confidence
    lags_s = (max(speed.value - skew.value, 0.0), max(torque.value, 0.0))
    density = Density(case.levels.density, case.levels.dof)
    try:
        fit = run_up_inertia(
            case.recording, case.samples, lags_s, delay, density, confidence, _reading(case, finding))
    except (np.linalg.LinAlgError, FloatingPointError, ValueError, ZeroDivisionError):
        return ()
    if fit is None or (own := _own_inertia(fit)) is None:
        return ()
    return ((SecondOpinion("run-up of stage 2", own, _agrees(own, finding, confidence, _CONTRADICTION), ""), fit),)


def _contradiction(opinions: Fitted, finding: Finding, confidence: float) -> Refusal:
    """Return the contradiction of J beyond chance and beyond the effect of nonlinear friction on a balance; else
    nothing.

    Both values have the same torque scale, which cancels.
    """
    reference = reference_inertia(finding)
    for opinion, fit in opinions:
        own = opinion.inertia_kg_m2
        if reference is None or opinion.agrees is not False:
            continue
        apart = abs(own.value - reference.value)
        share = _CONTRADICTION / len(opinions)
        wider = _bent_by(own, fit, confidence)
        if apart > _ALIKE * reference.value and _agrees(wider, finding, confidence, share) is False:
            return Refusal(
                f"two methods contradict each other: J is {reference.value:.4g} kg·m² by the excitation and "
                f"{own.value:.4g} ({printed_interval(own.low, own.high)}) kg·m² by the {opinion.route}. The scale "
                "of a signal or the load changed during the run, or friction differs from the model",
                "check that the scales of speed and torque and the load stay the same in all stages. Then repeat "
                "the run", entry=MessageCode.METHODS_CONTRADICT,
            )
    return Refusal("", "")


def _own_inertia(fit: MomentumFit) -> Estimate | None:
    """Return J of a fit with its interval; None if its interval is open."""
    if not fit.half_width < OPEN * fit.inertia:
        return None
    return Estimate(fit.inertia, fit.inertia - fit.half_width, fit.inertia + fit.half_width)


def _least_scale_change(
    found: tuple[SecondOpinion, MomentumFit], count: int, reference: Estimate, confidence: float
) -> float:
    """Return the least relative change of a signal's scale that would contradict J with a probability of `_DETECTED`.

    ``count``: number of comparisons that share the probability of a false contradiction. The detection limit as in
    ISO 11843-1: the limit of the comparison, and above it the part of the noise that may hide the change.
    """
    own = _bent_by(found[0].inertia_kg_m2, found[1], confidence)
    half = math.hypot(own.high - own.value, 0.5 * (reference.high - reference.low)) / reference.value
    hides = student_quantile(2.0 * _DETECTED - 1.0, CERTAIN) / student_quantile(confidence, CERTAIN)
    return max(_ALIKE, _times_wider(confidence, _CONTRADICTION / count) * half) + hides * half


def _bent_by(own: Estimate, fit: MomentumFit, confidence: float) -> Estimate:
    """Return the interval of a balance, widened for the possible effect of nonlinear friction."""
    half = math.hypot(own.high - own.value, normal_quantile(confidence) * fit.bend)
    return Estimate(own.value, own.value - half, own.value + half)


def disagreements(opinions: tuple[SecondOpinion, ...], finding: Finding) -> tuple[str, ...]:
    """Return one warning for each momentum cross-check that contradicts the finding."""
    reference = reference_inertia(finding)
    if reference is None:
        return ()
    return tuple(
        CodedText(
            f"the momentum cross-check ({opinion.route}) does not agree: {opinion.inertia_kg_m2.value:.4g} "
            f"({printed_interval(opinion.inertia_kg_m2.low, opinion.inertia_kg_m2.high)}) kg·m² against "
            f"{reference.value:.4g}; friction, load or the torque scale may differ from the model",
            MessageCode.CROSS_CHECK_DISAGREES,
        )
        for opinion in opinions
        if opinion.agrees is False
    )


def _opinions(case: Case, found: Balances, finding: Finding) -> Fitted:
    recording, levels = case.recording, case.levels
    density = Density(0.0, 0.0) if levels is None else Density(levels.density, levels.dof)
    delay = _known_delay(case, finding)
    spans = (case.samples.between(span.start_s, span.end_s) for span in found.calm)
    calm = [part for part in spans if len(part) > 1]
    resolution = Resolution(_rounding(recording.speed_resolution_rad_s, [part.speed_rad_s for part in calm]),
                            _rounding(recording.torque_resolution_nm, [part.torque_nm for part in calm]))
    steps = recording.excitation is not None and has_plateaus(recording.excitation.kind)
    reading = _reading(case, finding)
    opinions = []
    for kind, route in ((BalanceKind.TURNING, "torque steps" if steps else "speed change"),
                        (BalanceKind.COASTING, "coast-down")):
        if kind is BalanceKind.COASTING and not any(row.kind is kind for row in found.rows):
            continue
        fit = fit_momentum(found, kind, density, delay, resolution, case.options.confidence, reading)
        if fit is None or (inertia := _own_inertia(fit)) is None:
            continue
        opinions.append((SecondOpinion(route, inertia, None, _note(fit, kind, delay)), fit))
    return tuple(opinions)


def _reading(case: Case, finding: Finding) -> ReadingShare:
    """Return the share that reading in step with a speed setpoint adds to J of the ramps, relative to J of stage 5.

    In torque mode stage 5 does not have this error, and its skew gives the moment of reading. Stage 5 in speed mode is
    read like the ramps. However, a ramp generator in the drive smooths the large steps of a ramp more than the small
    steps of stage 5, so the difference may be any part of the error.
    """
    recording = case.recording
    if recording.stepped_setpoint is None:
        return reading_share(_loops(case, finding), _moment(case, finding), _least_lag_s(case, finding))
    share = reading_share((recording.stepped_setpoint,), None, _least_lag_s(case, finding))
    return ReadingShare(0.0, share.sd / math.sqrt(3.0))


def _least_lag_s(case: Case, finding: Finding) -> float:
    """Return the shortest lag of the torque report that the data or the drive's documents allow, s."""
    if finding.torque_lag_s is not None:
        return max(finding.torque_lag_s.low, 0.0)
    prior = case.recording.lag_prior
    return 0.0 if prior.torque_lag_s is None else max(prior.torque_lag_s - 2.0 * prior.torque_lag_sd_s, 0.0)


def _sd(case: Case, estimate: Estimate) -> float:
    """Return the standard uncertainty of an estimate: half its interval over the quantile of its confidence."""
    return 0.5 * (estimate.high - estimate.low) / student_quantile(case.options.confidence, CERTAIN)


def _moment(case: Case, finding: Finding) -> ReadMoment | None:
    skew, lag = finding.skew_s, finding.torque_lag_s
    if skew is None or lag is None or not (skew.finite and lag.finite):
        return None
    return ReadMoment(skew.value, _sd(case, skew), max(lag.value, 0.0))


def _loops(case: Case, finding: Finding) -> tuple[SteppedSetpoint, ...]:
    """Return possible speed loops during the ramps: from the ramp of stage 2, else the usual loops."""
    period_s = usual_interval(case.samples.time_s)
    loops = usual_loops(period_s)
    reference, lag = reference_inertia(finding), finding.speed_lag_s
    usual = reading_share(loops, _moment(case, finding), _least_lag_s(case, finding))
    if reference is None or max(abs(usual.value), usual.sd) < _WORTH_A_FIT:
        return loops
    lag_s = lag.value if lag is not None else case.recording.lag_prior.speed_lag_s
    seen = None if lag_s is None else speed_loop(case.recording, case.samples, lag_s)
    if seen is None:
        return loops
    viscous = 0.0 if finding.viscous_nm_s_rad is None else finding.viscous_nm_s_rad.value
    integral = seen.integral_gain_nm_rad
    return tuple(
        SteppedSetpoint(period_s, gain / integral, (gain + viscous) / integral, reference.value / integral)
        for gain in seen.gain_nm_s_rad + math.sqrt(1.5) * seen.gain_sd_nm_s_rad * np.array([-1.0, 0.0, 1.0])
    )


def _known_delay(case: Case, finding: Finding) -> Delay:
    """Return the delay δ = τ_w − τ_T − skew: fitted, else stated, else unknown."""
    speed, torque, skew = finding.speed_lag_s, finding.torque_lag_s, finding.skew_s
    if speed is not None and torque is not None and skew is not None:
        value = speed.value - torque.value - skew.value
        sd = math.hypot(*(_sd(case, part) for part in (speed, torque, skew)))
        if math.isfinite(value) and sd < UNKNOWN_DELAY.sd_s:
            return Delay(value, sd, True)
    prior = case.recording.lag_prior
    if prior.speed_lag_s is not None and prior.torque_lag_s is not None:
        sd = math.hypot(prior.speed_lag_sd_s, prior.torque_lag_sd_s, prior.skew_sd_s)
        return Delay(prior.speed_lag_s - prior.torque_lag_s, sd, True)
    return UNKNOWN_DELAY


def _rounding(quantum: float, parts: list[FloatArray]) -> float:
    """Return the error of a mean from rounding to a quantum q, by the scatter σ of the signal at steady speed.

    Noise of standard deviation σ before the rounding acts as dither: the error of the mean is at most (q/π)
    e^(−2π²σ²/q²). Without noise it is uniform, with standard deviation q/√12.
    """
    if not quantum > 0.0:
        return 0.0
    seen = float(np.median([np.var(part) for part in parts])) if parts else 0.0
    before = max(0.0, seen - quantum**2 / 12.0)
    return quantum / math.sqrt(12.0) * math.exp(-2.0 * math.pi**2 * before / quantum**2)


def reference_inertia(finding: Finding) -> Estimate | None:
    """Return the inertia to compare with a momentum balance: everything that turns, also behind a compliant shaft."""
    return finding.inertia if finding.compliant is None else finding.compliant.total_inertia


def _agrees(own: Estimate, finding: Finding, confidence: float, miss_share: float) -> bool | None:
    """Return whether the difference is within two independent intervals. ``miss_share``: probability of a false no."""
    reference = reference_inertia(finding)
    if reference is None or not reference.finite:
        return None
    below = own.value < reference.value
    theirs = reference.value - reference.low if below else reference.high - reference.value
    ours = own.high - own.value
    return abs(own.value - reference.value) <= _times_wider(confidence, miss_share) * math.hypot(ours, theirs)


def _times_wider(confidence: float, miss_share: float) -> float:
    return student_quantile(1.0 - miss_share, CERTAIN) / student_quantile(confidence, CERTAIN)


def _note(fit: MomentumFit, kind: BalanceKind, delay: Delay) -> str:
    changes = f"{fit.rows} change{'s' if fit.rows > 1 else ''} of speed"
    if kind is BalanceKind.COASTING:
        return f"{changes} without torque, friction from steady speeds; free of every reporting lag"
    lags = f"delay between the reports {delay.seconds * 1e3:.0f} ± {delay.sd_s * 1e3:.0f} ms (1 sd)"
    if not delay.known:
        lags = "delay between the reports unknown, taken as 0 ± 250 ms (1 sd)"
    return f"{changes}, friction from steady speeds; {lags}, {fit.delay_sd:.2g} kg·m² of it"
