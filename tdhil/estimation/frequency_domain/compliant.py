"""Verdict on a shaft that is not rigid: the selected model, the reason, and what the run could not determine."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from profiles import CodedText, MessageCode
from profiles.quantities import printed_interval
from tdhil.estimation.candidates import (
    A_STRING,
    BY_DIFFERENCE,
    KNOWN_PIPE,
    REQUESTED,
    SCALED_PIPE,
    TWO_MASSES,
    FitRoute,
    ModelTrial,
    walk,
)
from tdhil.estimation.case import Finding, ModelWords, PeriodicCase
from tdhil.estimation.frequency_domain import signal_filters
from tdhil.estimation.frequency_domain.compliant_fit import (
    SLOWEST_SEEN,
    CompliantFit,
    CompliantIntervals,
    chance_gain,
    fit_compliant,
    inertias,
    intervals,
    shaft_covariance,
)
from tdhil.estimation.frequency_domain.filter_order import likeliest
from tdhil.estimation.frequency_domain.frequency_response import ModelCurve
from tdhil.estimation.frequency_domain.inference import (
    fisher_tail,
    grown_lines,
    half_width_first_order,
    standard_deviation,
    student_quantile,
    torque_scale_line,
)
from tdhil.estimation.frequency_domain.likelihood import LEAST_NU
from tdhil.estimation.frequency_domain.model import GaussianPrior
from tdhil.estimation.frequency_domain.optimiser import Fixed
from tdhil.estimation.frequency_domain.rigid import (
    RigidResult,
    fitted_points,
    known_of,
    lags_of,
    of_reports,
    whose_load_may_stay_behind,
)
from tdhil.estimation.frequency_domain.shafts import (
    ANY_IMPEDANCE,
    DAMPING,
    DRAG_SHARE,
    INERTIA,
    LOAD,
    LOAD_VISCOUS,
    STRING,
    STRING_SHARE,
    SWING,
    TWO_MASS,
    VISCOUS,
    KnownStringShaft,
    Shaft,
    ShaftModel,
    StringShaft,
    TwoMassShaft,
    like_the_pipe,
    shaft_model,
    unlike_the_pipe,
)
from tdhil.estimation.friction_levels import Levels, ViscousConstraint, coulomb_level
from tdhil.estimation.result import DOUBT_P, REJECT_P, BudgetLine, Compliant, Estimate, Refusal, rejects
from tdhil.estimation.spectrum import SIGNIFICANT, SpectralLine
from tdhil.recording import Pipe

# ---------------------------------------------------------------------------------------------------------------------
# Selection between two masses and a string: the simplest model that the residuals allow; equal fits widen the interval.
#
# Two masses are a string without weight. A light string is, to first order in its weight, two masses with different
# shares of the same total: a third of it seems to turn with the motor. Only its second oscillation, near half of the
# wave's frequency 1/T, distinguishes them. If two masses explain the data, J_r and J_L are theirs, but their intervals
# also contain every string that the data do not contradict (`result_of`; for one whose lowest oscillation the lines can
# resolve, `too_slow`). J_r + J_L is the same in both. Only with ``--model two-mass`` the weight of the spring is
# assumed to be 0.
#
# The error is small if two masses are kept too long. If they are given up too early, J_r changes by the weight of the
# string. The gain of the string must therefore be as improbable by chance as residuals that reject a model (χ²(1); half
# of that at the bound η = 0). Each model has the structure of lags that fits it best.


_DOUBT = 0.3                 # p of the residual test above which a rigid shaft is not in doubt
_MUCH = 9.0                  # gain of −2 ln L, for one parameter more than the lags of the rigid shaft have
_REPORTS = 3                 # unknowns besides the shaft: two lags and the skew
_BY_PIPE = 2                 # parameters known with a known pipe: its inertia and its stiffness
_LEAST_LOAD = 0.01           # of the total: a smaller load depends on the error of one line
_NEAR = (SLOWEST_SEEN, 2.0)  # visible oscillations: multiples of the lowest and the highest line


@dataclass(frozen=True)
class Chosen:
    """Selected model. ``fit``: selected, or the last one tried if ``rejected``; ``beside``: the string beside two
    masses.

    ``pipe``: the fit uses the stated sizes of the pipe; ``other_pipe``: it does not, because the data contradict them.
    ``unlike_hz``: lines that differ between the mean speeds, weighted by that difference. ``impedance_ratio``: of the
    string to the pipe, if only this ratio contradicts the pipe.
    """

    fit: CompliantFit
    beside: CompliantFit | None = None
    rejected: bool = False
    pipe: Pipe | None = None
    other_pipe: bool = False
    unlike_hz: tuple[float, ...] = ()
    impedance_ratio: float | None = None


def usable_lines(every: tuple[SpectralLine, ...], least_nu: float) -> tuple[SpectralLine, ...]:
    """Return the lines with speed or torque clear of its scatter: at a resonance one of the two nearly vanishes.

    The likelihood treats both in the same way, so one is enough.
    """
    return tuple(line for line in every if line.nu >= least_nu and np.all(
        (np.abs(line.speed) ** 2 * line.periods > SIGNIFICANT * line.s_ww)
        | (np.abs(line.torque) ** 2 * line.periods > SIGNIFICANT * line.s_tt)))


@dataclass(frozen=True)
class _LoadWalk:
    """State of the walk over the rows of the load.

    ``near``: two masses fitted beside a pipe that is ``contradicted``. ``two``: two masses, if they are tried.
    ``counted``: lines are already weighted by the difference of the mean speeds.
    """

    asked: str
    lines: tuple[SpectralLine, ...]
    constraint: ViscousConstraint | None
    priors: tuple[GaussianPrior, ...]
    fixed: Fixed
    pipe: Pipe | None
    is_string: bool
    counted: bool = False
    near: CompliantFit | None = None
    contradicted: bool = False
    chosen: Chosen | Refusal | None = None
    ended: bool = False

    @property
    def model(self) -> ShaftModel:
        return shaft_model(self.asked)

    def countable(self, model: ShaftModel, known: int = 0) -> bool:
        """Return whether the lines give as many equations as this shaft has unknowns."""
        return _refuse_count(model, self.lines, self.constraint, self.priors, known) is None

    def fitted(self, shaft: Shaft, near: CompliantFit | None = None) -> CompliantFit:
        return fit_compliant(shaft, self.lines, self.constraint, self.priors, self.fixed, near)

    def with_pipe(self, pipe: Pipe | None) -> "_LoadWalk":
        """Return the walk with this pipe; it has ended if the lines are then too few for the simplest shaft."""
        simplest = self.model if self.model.compliant is not None else (
            STRING if self.is_string and pipe is None else TWO_MASS)
        refusal = _refuse_count(simplest, self.lines, self.constraint, self.priors)
        return replace(self, chosen=refusal, ended=refusal is not None)


def choose(
    asked: str, lines: tuple[SpectralLine, ...], constraint: ViscousConstraint | None,
    priors: tuple[GaussianPrior, ...],
    fixed: Fixed, pipe: Pipe | None = None, is_string: bool = False
) -> Chosen | Refusal:
    """Walk the rows of the load (`tdhil.estimation.candidates`). ``asked``: the name of the requested model;
    ``priors`` and ``fixed`` as with a rigid shaft. ``is_string``: rig.yaml declares a string, so two masses never
    stand without the string beside them.
    """
    return _chosen_of(_LoadWalk(asked, lines, constraint, priors, fixed, pipe, is_string))


def _chosen_of(begin: _LoadWalk) -> Chosen | Refusal:
    chosen = walk(FitRoute.LOAD, _TRIALS, begin.with_pipe(begin.pipe)).chosen
    assert chosen is not None
    return chosen


def _try_pipe(standing: _LoadWalk) -> _LoadWalk:
    """Fit the string with the known pipe. If the data contradict it, the other rows are tried without it."""
    assert standing.pipe is not None
    near = standing.fitted(TwoMassShaft())
    known = standing.fitted(KnownStringShaft(standing.pipe), near)
    if not rejects(known.residual) and plausible(known):
        # few lines with undocumented filters may hide a wrong impedance in their residuals
        scaled, ratio = _scaled_pipe(standing, near)
        if not likeliest(known.fitted) - likeliest(scaled.fitted) > chance_gain():
            ratio = None
        return replace(standing, chosen=Chosen(known, pipe=standing.pipe, impedance_ratio=ratio), ended=True)
    return replace(standing.with_pipe(None), near=near, contradicted=True)


def _try_requested(standing: _LoadWalk) -> _LoadWalk:
    assert standing.model.compliant is not None
    forced = standing.fitted(standing.model.compliant())
    return replace(standing, chosen=Chosen(forced, rejected=rejects(forced.residual)))


def _try_two_masses(standing: _LoadWalk) -> _LoadWalk:
    two = standing.fitted(TwoMassShaft())
    if two.residual is None:      # a shaft that replaces a contradicted one must be testable too
        refusal = Refusal(
            f"{len(standing.lines)} excited lines leave nothing to test two masses on a spring with",
            "excite more lines about two mean speeds, from well below the resonance to well above it",
            entry=MessageCode.TOO_FEW_LINES,
        )
        return replace(standing, chosen=refusal, ended=True)
    return replace(standing, chosen=Chosen(two, rejected=rejects(two.residual) or not plausible(two)))


def _try_string(standing: _LoadWalk) -> _LoadWalk:
    """Fit the string; it stands beside two masses that the data allow and that it does not clearly exceed."""
    two = standing.chosen.fit if isinstance(standing.chosen, Chosen) else None
    string = standing.fitted(StringShaft(), two)
    # Two masses stay unless the string gains more over them than one parameter gains by chance. Each model has the
    # structure of lags that it needs: with filters of two poles and averages, two masses may imitate a string with
    # first-order lags. These parameters are counted.
    if (two is not None and not rejects(two.residual)
            and not likeliest(two.fitted) - likeliest(string.fitted) > chance_gain()):
        return replace(standing, chosen=Chosen(two, string, rejected=not plausible(two)))
    return replace(standing, chosen=Chosen(string, rejected=rejects(string.residual) or not plausible(string)))


def _try_scaled_pipe(standing: _LoadWalk) -> _LoadWalk:
    """Compare the impedance of a string with the travel time of the contradicted pipe to that of the pipe."""
    assert isinstance(standing.chosen, Chosen)
    _, ratio = _scaled_pipe(standing, standing.near)
    return replace(standing, chosen=replace(standing.chosen, other_pipe=True, impedance_ratio=ratio))


def _scaled_pipe(standing: _LoadWalk, near: CompliantFit | None) -> tuple[CompliantFit, float | None]:
    """Return the string with the pipe's travel time and a free impedance, and its ratio to that of the pipe.

    The ratio is None within its allowed range, or if that string is contradicted, too.
    """
    assert standing.pipe is not None
    scaled = KnownStringShaft(standing.pipe, ANY_IMPEDANCE)
    fit = standing.fitted(scaled, near)
    ratio = scaled.impedance_ratio(fit.mechanical)
    found = not rejects(fit.residual) and plausible(fit) and not like_the_pipe(ratio)
    return fit, ratio if found else None


# Near the antiresonance the motor nearly stands still and the load oscillates most, possibly faster than the mean
# speed. Its dry friction then changes sign twice a period at the slower mean speed, but never at the faster one. In one
# case 30 N·m of it at the end of a string changed T/ω of that line by 15 %, and that of its harmonics by less, and a
# correct shaft was rejected. Such a line has little information about J_r (the motor stands still), but shows the
# frequency of the oscillation. Therefore, if no oscillating shaft is allowed, and this line differs between mean speeds
# beyond its scatter, the lines that differ are weighted by their difference, which with two mean speeds is a variance
# on one complex degree of freedom. All others, at least half of the lines, must fit as usual.


_BY_THE_SWING = 0.1          # of its frequency: distance of the line from the oscillation


def _try_by_difference(standing: _LoadWalk) -> _LoadWalk:
    """Select again, with lines weighted by the difference between the mean speeds."""
    assert isinstance(standing.chosen, Chosen)
    lines = standing.lines
    swing_hz = float(standing.chosen.fit.mechanical[SWING]) / (2.0 * math.pi)
    counted = tuple(_by_difference(line) for line in lines)
    unlike = tuple(line.hertz for line, before in zip(counted, lines, strict=True) if line is not before)
    if len(unlike) > len(lines) // 2 or not any(abs(hz / swing_hz - 1.0) <= _BY_THE_SWING for hz in unlike):
        return standing
    again = _chosen_of(_LoadWalk(standing.asked, counted, standing.constraint, standing.priors, standing.fixed,
                                 standing.pipe, standing.is_string, counted=True))
    if not isinstance(again, Chosen) or again.rejected:
        return standing
    return replace(standing, chosen=replace(again, unlike_hz=unlike))


_TRIALS: Mapping[str, ModelTrial[_LoadWalk]] = {
    KNOWN_PIPE: ModelTrial(
        lambda now: now.pipe is not None and now.model.piped and now.countable(STRING, _BY_PIPE), _try_pipe),
    REQUESTED: ModelTrial(lambda now: now.model.compliant is not None, _try_requested),
    TWO_MASSES: ModelTrial(lambda now: now.model.compliant is None, _try_two_masses),
    A_STRING: ModelTrial(lambda now: now.model.compliant is None and now.countable(STRING), _try_string),
    SCALED_PIPE: ModelTrial(lambda now: now.contradicted, _try_scaled_pipe),
    BY_DIFFERENCE: ModelTrial(
        lambda now: isinstance(now.chosen, Chosen) and now.chosen.rejected and not now.counted, _try_by_difference),
}


def _by_difference(line: SpectralLine) -> SpectralLine:
    """Return the line with the scatter of T/ω between the segments, if it exceeds the scatter between their periods."""
    weight = line.periods * np.abs(line.speed) ** 2
    g = complex(np.sum(line.periods * line.torque * line.speed.conj()) / np.sum(weight))
    apart = float(np.sum(line.periods * np.abs(line.torque - g * line.speed) ** 2))
    variance = line.s_tt + abs(g) ** 2 * line.s_ww - 2.0 * (g.conjugate() * line.s_tw).real
    free = len(line.speed) - 1
    if free < 1 or not variance > 0.0:
        return line
    ratio = apart / free / variance
    if fisher_tail(ratio, 2.0 * free, 2.0 * line.nu) >= REJECT_P:
        return line
    return replace(line, s_ww=ratio * line.s_ww, s_tt=ratio * line.s_tt, s_tw=ratio * line.s_tw,
                   nu=max(float(free), LEAST_NU))


def may_swing(rigid: RigidResult) -> bool:
    """Return whether another shaft is tried: if the rigid one is rejected, or if an oscillating load with first-order
    lags explains the data much better than a rigid shaft with any lags.

    A resonance just above the band changes the lines as filters of two poles would, and may pass the residual test with
    an inertia far too low. This is checked only if first-order lags do not suffice and the test is in doubt; a rigid
    shaft with first-order lags is not affected.
    """
    fitted, problem = rigid.fitted, rigid.fitted.problem
    if rejects(rigid.residual):
        return True
    if rigid.first_order or rigid.residual is None or rigid.residual.p_value > _DOUBT:
        return False
    if _refuse_count(TWO_MASS, problem.lines, problem.constraint, problem.priors) is not None:
        return False
    try:
        two = fit_compliant(TwoMassShaft(), problem.lines, problem.constraint, problem.priors, fitted.fixed)
    except (np.linalg.LinAlgError, FloatingPointError, ValueError):
        return False
    return fitted.whole.objective - two.fitted.simple.objective > _MUCH


def plausible(fit: CompliantFit) -> bool:
    """Return whether the lines show an oscillation, and not just one bad line explained by a load."""
    omega = np.abs(fit.fitted.problem.s)
    m = fit.mechanical
    near = _NEAR[0] * float(np.min(omega)) <= m[SWING] <= _NEAR[1] * float(np.max(omega))
    return bool(near and m[LOAD] >= _LEAST_LOAD * (m[INERTIA] + m[LOAD]))


# If rig.yaml declares a string, a string hangs on the shaft for any residuals. With undocumented filters of two poles
# and averages, a rigid shaft can explain the effect of a string on few lines. Of 58 random strings and two-mass shafts,
# identified with four lines, 14 intervals contained neither the motor's inertia nor, for some, the total inertia. A
# rigid shaft is therefore accepted only if there are enough lines to test a string, first-order lags explain them, and
# no string with a visible oscillation gives the motor's inertia.
#
# Everything turns as one only if the load in the fit oscillates too fast for the lines. If the fit has no load, or
# leaves both inertias open, a load may also oscillate below the lines and stay behind. The result states which of the
# two it is. Of ten such results of `benchmarks/healthy_runs.py` (seeds 1 to 390) that stated the total inertia, three
# held the motor's only.


def _turns_as_one(fit: CompliantFit) -> bool:
    """Return whether the load in the fit oscillates too fast for the lines."""
    return bool(fit.mechanical[SWING] > _NEAR[1] * float(np.max(np.abs(fit.fitted.problem.s))))


def _light(fit: CompliantFit) -> bool:
    """Return whether the load in the fit is negligible."""
    m = fit.mechanical
    return bool(m[LOAD] < _LEAST_LOAD * (m[INERTIA] + m[LOAD]))


def _as_rigid(rigid: Finding | Refusal | None, fit: CompliantFit) -> Finding | Refusal | None:
    """Return the rigid shaft with the caveat on what its inertia is."""
    return rigid if _turns_as_one(fit) or not isinstance(rigid, Finding) else whose_load_may_stay_behind(rigid)


def _refuse_count(
    model: ShaftModel,
    lines: tuple[SpectralLine, ...],
    constraint: ViscousConstraint | None,
    priors: tuple[GaussianPrior, ...],
    known: int = 0,
) -> Refusal | None:
    """Return the refusal if equations are fewer than unknowns, as `rigid.refuse_count`; ``known``: known values of
    the load.
    """
    assert model.compliant is not None
    equations = 2 * len(lines) + (constraint is not None) + len(priors) + known
    unknowns = len(model.compliant().names) + _REPORTS
    if equations >= unknowns:
        return None
    wanted = math.ceil(0.5 * (unknowns - (constraint is not None) - len(priors)))
    return Refusal(
        f"{len(lines)} excited lines, mean speeds and known lags give {equations} equations, but "
        f"{model.have or model.text + ' has'} {unknowns} unknowns",
        f"excite at least {wanted} lines, from well below the resonance to well above it",
        entry=MessageCode.TOO_FEW_LINES,
    )


# ---------------------------------------------------------------------------------------------------------------------
# Results of a compliant shaft's fit: J_r, J_L, k and the other parameters, with intervals and their budget.


@dataclass(frozen=True)
class CompliantResult:
    """Result of a compliant shaft. ``inertia``: J_r, infinite on a side that the data leave open. ``viscous``,
    ``coulomb``: of both ends.

    ``by_model``: the largest contribution to the interval is a string that the data do not exclude beside two masses.
    """

    inertia: Estimate
    shaft: Compliant
    viscous: Estimate
    coulomb: Estimate | None
    speed_lag_s: Estimate
    torque_lag_s: Estimate
    skew_s: Estimate
    budget: tuple[BudgetLine, ...]
    by_model: bool


def result_of(chosen: Chosen, levels: Levels, confidence: float, torque_scale_rel_sd: float) -> CompliantResult:
    """Return the intervals of the selected model; those of two masses also contain the values of a string."""
    alone = intervals(chosen.fit, confidence)
    fixed = alone
    if chosen.beside is not None:
        for name, other in inertias(chosen.beside, confidence).items():
            two: Estimate = getattr(alone, name)
            united = Estimate(two.value, min(two.low, other.low), max(two.high, other.high))
            fixed = replace(fixed, **{name: united})
    speed_lag, torque_lag, skew = lags_of(chosen.fit.fitted, confidence)
    *own, by_model = _budget(chosen.fit, alone.inertia, fixed.inertia, confidence)
    lines = own if by_model.half_width_kg_m2 == 0.0 else [*own, by_model]
    return CompliantResult(
        inertia=fixed.inertia,
        shaft=Compliant(
            total_inertia=fixed.total if fixed.total.finite else None,
            load_inertia=_unless_open(fixed.load),
            stiffness_nm_rad=_unless_open(fixed.stiffness),
            damping_nm_s_rad=None if chosen.fit.is_string else _unless_open(fixed.damping),
            resonance_hz=_unless_open(fixed.resonance),
            antiresonance_hz=_unless_open(fixed.antiresonance),
            covariance=shaft_covariance(chosen.fit),
        ),
        viscous=fixed.viscous,
        coulomb=_coulomb(levels, chosen.fit, fixed, confidence),
        speed_lag_s=speed_lag,
        torque_lag_s=torque_lag,
        skew_s=skew,
        budget=(*lines, torque_scale_line(fixed.inertia.value, torque_scale_rel_sd, confidence)),
        by_model=by_model.half_width_kg_m2 > max(line.half_width_kg_m2 for line in own),
    )


def _unless_open(one: Estimate) -> Estimate | None:
    return one if one.bounded else None


def _coulomb(levels: Levels, fit: CompliantFit, fixed: CompliantIntervals, confidence: float) -> Estimate | None:
    """Return the Coulomb friction of both ends, from the levels: it is in the mean torque only."""
    if len(levels.speed) == 0 or levels.dof < 1.0 or levels.direction == 0.0:
        return None
    fitted = fit.fitted
    free = [index for index in fitted.free if index not in fitted.simple_held]
    sd_viscous, dof = standard_deviation(fitted.problem, fitted.simple.theta, VISCOUS, free)
    value, sd = coulomb_level(levels, fixed.total.value, fixed.viscous.value, sd_viscous)
    half = student_quantile(confidence, min(dof, levels.dof)) * sd
    return Estimate(value, value - half, value + half) if math.isfinite(half) else None


def _budget(fit: CompliantFit, alone: Estimate, fixed: Estimate, confidence: float) -> tuple[BudgetLine, ...]:
    """Return the budget, as `budget_of` for a rigid shaft: one group after another is freed, and adds in quadrature;
    the model of the shaft is the last.
    """
    at = fit.fitted.problem.model.at
    lags, timing = (at(signal_filters.SPEED_LAG), at(signal_filters.TORQUE_LAG)), (at(signal_filters.SKEW),)
    friction = (VISCOUS, DAMPING, LOAD_VISCOUS)
    spring = (LOAD, SWING, *((STRING_SHARE, DRAG_SHARE) if fit.is_string else ()))

    def half(*known: int) -> float:
        return half_width_first_order(fit.fitted, INERTIA, confidence, known)

    grown = (
        ("noise", half(*lags, *timing, *spring, *friction), "scatter from period to period"),
        ("friction", half(*lags, *timing, *spring), "viscous friction at both ends and in the spring"),
        ("spring", half(*lags, *timing), "the load's inertia, the stiffness" + (
            ", the string's share" if fit.is_string else "")),
        ("timing", half(*lags), "time offset between speed and torque"),
        ("lags", half(), "time constants of the reporting filters"),
        ("lag structure", 0.5 * (alone.high - alone.low), "filters of two poles, moving averages"),
        ("shaft model", 0.5 * (fixed.high - fixed.low), "a spring that weighs something: a string"),
    )
    return grown_lines(grown, 0.5 * (fixed.high - fixed.low))


# ---------------------------------------------------------------------------------------------------------------------

_LOOK_FOR = "look for play, a bit that sticks, or friction that changes with speed or time"
_OPEN = Refusal(
    "the excited lines show a load that oscillates, but do not determine its inertia",
    "raise the amplitude, excite for more periods, and excite lines on both sides of the resonance",
)
_UNSEEN = Refusal(
    "the rig's load is a string, and the excited lines do not separate its inertia from that of the motor",
    "raise the amplitude, excite for more periods, and excite lines from below the lowest resonance of the "
    "string to well above it",
)
_WIDE = "state the drive's speed and torque filters, or excite with more amplitude above the resonance"
_WHICH = (
    "add --model two-mass for a coupling or a light shaft, or --model string for a drill string; the data allow "
    "both. Or raise the amplitude above the resonance"
)


def identify_compliant(
    case: PeriodicCase, rigid: Finding | Refusal | None = None, plain_lags: bool = False
) -> Finding | Refusal:
    """Identify two masses or the string. ``rigid``: finding of a rigid shaft that the data contradict or doubt, or
    whose load is declared a string, under auto; it is kept if no other shaft is better. ``plain_lags``: it explains
    the data with first-order lags.
    """
    result = None
    contradicted = rigid if isinstance(rigid, Finding) and rigid.rejected else None
    is_string = rigid is not None and contradicted is None and case.recording.has_drill_string
    try:
        chosen = _chosen(case)
        if isinstance(chosen, Chosen) and not chosen.rejected:
            result = result_of(chosen, case.levels, case.options.confidence, case.recording.torque_scale_rel_sd)
    except (np.linalg.LinAlgError, FloatingPointError, ValueError):
        return _OPEN if is_string else rigid or _OPEN
    if isinstance(chosen, Refusal):
        if is_string:
            return Refusal(f"the rig's load is a string: {chosen.reason}", chosen.advice, chosen.entry)
        if contradicted is None:
            return rigid or chosen
        advice = f"{contradicted.words.if_rejected}. If the load oscillates: {chosen.advice}"
        return replace(contradicted, words=replace(contradicted.words, if_rejected=advice))
    if result is None:
        if is_string and not rejects(chosen.fit.residual):
            unseen = plain_lags and (_light(chosen.fit) or _turns_as_one(chosen.fit))
            return (_as_rigid(rigid, chosen.fit) if unseen else None) or _UNSEEN
        if contradicted is None:
            name = name_of(chosen.fit, case.options.model)
            return (None if is_string else rigid) or Finding(
                model=name, words=_words(name), residual=chosen.fit.residual)
        words = replace(contradicted.words, if_rejected=_LOOK_FOR)
        return replace(contradicted, words=words, remark=", and two masses or a string do no better")
    if result.inertia.bounded or _bounded(result.shaft.total_inertia):
        return _stands(chosen, result, case, rigid)
    if is_string:
        return (_as_rigid(rigid, chosen.fit) if plain_lags else None) or _UNSEEN
    # a rigid shaft that is only in doubt gives a number, which would be wrong: see `may_swing`
    return rigid if isinstance(rigid, Refusal) else contradicted or _OPEN


def _chosen(case: PeriodicCase) -> Chosen | Refusal:
    """Apply `choose` to the usable lines."""
    recording = case.recording
    priors, fixed = known_of(recording.lag_prior, len(case.usable), case.constraint)
    return choose(
        case.options.model, case.usable, case.constraint, priors, fixed, recording.pipe, recording.has_drill_string)


def _stands(chosen: Chosen, result: CompliantResult, case: PeriodicCase, rigid: Finding | Refusal | None) -> Finding:
    """Return the finding of a selected shaft, without J if only the sum of both inertias is known."""
    fit = chosen.fit
    name = name_of(fit, case.options.model)
    finding = Finding(
        model=name,
        words=_words(name),
        residual=fit.residual,
        conditions=(*_conditions(chosen), *of_reports(case.recording.lag_prior)),
        viscous_nm_s_rad=result.viscous,
        coulomb_nm=result.coulomb,
        speed_lag_s=result.speed_lag_s,
        torque_lag_s=result.torque_lag_s,
        skew_s=result.skew_s,
        compliant=result.shaft,
        lines=fitted_points(fit.fitted, case.options.confidence),
        warnings=_caveats(chosen, result),
        curve=ModelCurve(fit.fitted, case.options.confidence, fit.residual),
    )
    if isinstance(rigid, Finding) and rigid.rejected:
        finding = replace(finding, preface=f"{rigid.contradicted}; ")
    elif rigid is not None and not case.recording.has_drill_string:
        finding = replace(finding, remark=", much better than the lags of a rigid shaft do")
    if chosen.impedance_ratio is not None:
        # a J that does not stand gets no further figures, as for residuals that contradict the model
        return Finding(
            model=name, words=finding.words, residual=fit.residual, lines=finding.lines, curve=finding.curve,
            contradiction=unlike_the_pipe(chosen.impedance_ratio))
    if result.inertia.bounded:
        words = replace(finding.words, if_wide=_WHICH) if result.by_model else finding.words
        return replace(finding, inertia=result.inertia, budget=result.budget, words=words)
    total = result.shaft.total_inertia
    together = "" if total is None else (
        f"; together they are {total.value:.4g} kg·m² ({printed_interval(total.low, total.high)}) with an exact torque"
        " scale")
    return replace(finding, refusal=Refusal(
        f"{finding.explained}, but cannot separate the inertia of the motor from that of the load{together}",
        "excite lines on both sides of the resonance, and well above it, where the motor turns alone",
    ))


def _bounded(total: Estimate | None) -> bool:
    return total is not None and total.bounded


def name_of(fit: CompliantFit, asked: str) -> str:
    """Return the name as in ``--model``: the requested model, or the one of the two candidates that was selected."""
    if shaft_model(asked).compliant is not None:
        return asked
    return "string" if fit.is_string else "two-mass"


def _words(name: str) -> ModelWords:
    model = shaft_model(name)
    return ModelWords(model.text, f"{_LOOK_FOR}; try --model auto", _WIDE, model.explain)


_OTHER_PIPE = CodedText(
    "the data contradict the pipe's sizes in rig.yaml. tdhil did not use these sizes. Check load.length_m and "
    "both diameters",
    MessageCode.OTHER_PIPE,
)


def _conditions(chosen: Chosen) -> tuple[str, ...]:
    if chosen.pipe is not None:
        sizes = f"{chosen.pipe.source}, to {100.0 * chosen.pipe.rel_sd:.2g} % (1 sd)"
        shaft = f"the motor turns a uniform string, its pipe as in {sizes}"
    elif chosen.fit.is_string:
        shaft = "the motor turns a uniform string"
    else:
        shaft = "the spring weighs nothing" if chosen.beside is None else "the motor turns a spring or a uniform string"
    slowest_hz = SLOWEST_SEEN * min(line.hertz for line in chosen.fit.fitted.problem.lines)
    return shaft, f"its lowest swing is above {slowest_hz:.3g} Hz"


def _caveats(chosen: Chosen, found: CompliantResult) -> tuple[str, ...]:
    fit = chosen.fit
    said = [_OTHER_PIPE] if chosen.other_pipe else []
    if chosen.unlike_hz:
        where = ", ".join(f"{hz:.3g}" for hz in chosen.unlike_hz)
        said.append(CodedText(
            "the load responds differently at the two mean speeds; it may turn back at the slower one. tdhil "
            f"includes this difference in the uncertainty of the lines at {where} Hz",
            MessageCode.LOAD_SWINGS_WIDELY))
    said += [CodedText(
        "J is J_r, the inertia on the motor's side of the spring. A slow motion has to accelerate J_r + J_L",
        MessageCode.MOTOR_SIDE_ONLY)]
    if not _bounded(found.shaft.total_inertia):
        said.append(CodedText(
            "the interval of J_r + J_L is open on one side. Excite a line well below the resonance to bound it",
            MessageCode.TOTAL_INERTIA_OPEN))
    hertz = [line.hertz for line in fit.fitted.problem.lines]
    for name, one in (("resonance", found.shaft.resonance_hz), ("antiresonance", found.shaft.antiresonance_hz)):
        if one is not None and min(hertz) <= one.value <= max(hertz):
            article = "an" if name == "antiresonance" else "a"
            said.append(CodedText(
                f"{article} {name} at {one.value:.3g} Hz lies inside the excited band",
                MessageCode.RESONANCE_IN_BAND))
    if fit.fitted.problem.constraint is None:
        said.append(CodedText(
            "the shaft was excited about one mean speed only. Viscous friction comes from the excited lines, not "
            "from operating points",
            MessageCode.ONE_MEAN_SPEED))
    if not fit.fitted.first_order:
        said.append(CodedText(
            "first-order lags do not explain the reported signals. Filters of two poles and moving averages do",
            MessageCode.LAGS_NOT_FIRST_ORDER))
    if fit.residual is not None and REJECT_P <= fit.residual.p_value < DOUBT_P:
        said.append(CodedText(
            f"the residuals are only just consistent with the model (p = {fit.residual.p_value:.2g})",
            MessageCode.BARELY_CONSISTENT))
    return tuple(said)
