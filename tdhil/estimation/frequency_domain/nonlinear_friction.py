"""Verdict on a shaft with nonlinear friction over speed.

Its two additional parameters, c and the width of the bell, must lower −2 ln L by more than Schwarz's 2 ln n, as for the
lags (`filter_order`). A rigid shaft that is rejected, or in doubt, only by chance does not become nonlinear by this.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from profiles import CodedText, MessageCode
from tdhil.estimation.case import Finding, PeriodicCase
from tdhil.estimation.frequency_domain import signal_filters
from tdhil.estimation.frequency_domain.filter_order import FittedModel, fit_model
from tdhil.estimation.frequency_domain.inference import (
    budget_of,
    estimate,
    quantile_of,
    residual_of,
    student_quantile,
)
from tdhil.estimation.frequency_domain.likelihood import Likelihood, TorqueLoad
from tdhil.estimation.frequency_domain.model import GaussianPrior, Model
from tdhil.estimation.frequency_domain.optimiser import Fit, Fixed, box, minimise, rigid_rivals, rough_inertia_of
from tdhil.estimation.frequency_domain.rigid import RIGID, RigidResult, lags_of, rigid_finding
from tdhil.estimation.frequency_domain.shafts import INERTIA, RIGID_COUNT, VISCOUS, RigidShaft
from tdhil.estimation.friction_levels import Levels, ViscousConstraint, slope_over_speed, tie_viscous
from tdhil.estimation.result import BudgetLine, Estimate, Refusal, ResidualTest, rejects
from tdhil.estimation.spectrum import ComplexArray, PeriodLines, SpectralLine
from tdhil.recording import FloatArray, Segment

# ---------------------------------------------------------------------------------------------------------------------
# Shapes of friction over speed besides a straight line.
#
#     T_f(ω) = T_c sgn ω + B ω + c g(ω)
#
# g is Stribeck's bell, exp(−(ω/ω_s)²), with ω_s on a grid, or the parabola ω |ω| of a fan and of churned oil, which
# wide bells resemble. One shape with either sign of c is used, not a sum: the speeds of one run can hardly separate
# two. A further shape is a class with `over` and `words`, and its place in `bends`.


_WIDTHS = 9               # number of widths tried
_NARROWEST, _WIDEST = 0.35, 1.0     # of the slowest and of the fastest speed: a narrower or wider bell is not visible


class Bend(Protocol):
    """Shape of nonlinear friction over speed."""

    @property
    def words(self) -> str:
        """Return how friction bends, for the warning of the result: "it bends …"."""
        ...

    def over(self, speed: FloatArray) -> FloatArray:
        """Return the shape g at speeds, rad/s."""
        ...


@dataclass(frozen=True)
class Bell:
    """Stribeck's bell, exp(−(ω/ω_s)²)."""

    width_rad_s: float

    @property
    def words(self) -> str:
        return f"by a bell of about {self.width_rad_s:.2g} rad/s (Stribeck)"

    def over(self, speed: FloatArray) -> FloatArray:
        bell: FloatArray = np.sign(speed) * np.exp(-((speed / self.width_rad_s) ** 2))
        return bell


@dataclass(frozen=True)
class Parabola:
    """The parabola ω |ω| of a fan and of churned oil."""

    words = "with the square of speed"

    def over(self, speed: FloatArray) -> FloatArray:
        parabola: FloatArray = speed * np.abs(speed)
        return parabola


def bends(slowest_rad_s: float, fastest_rad_s: float) -> tuple[Bend, ...]:
    """Return all shapes to try for a run between two speeds of one direction, both in magnitude."""
    widths = np.geomspace(_NARROWEST * slowest_rad_s, _WIDEST * fastest_rad_s, _WIDTHS)
    return (*(Bell(float(width)) for width in widths), Parabola())


# ---------------------------------------------------------------------------------------------------------------------
# Rigid shaft whose friction has a third parameter, c, of a given shape.


BEND = 2                  # position of c in the parameters


@dataclass(frozen=True)
class BentShaft:
    """Rigid shaft with nonlinear friction, m = J, B, c.

    ``chord``: rise of the levels' slope of friction over speed with c. ``typical``: c of a nonlinear part as large as B
    ω, over B. c is not in the impedance, because its torque at a line is not proportional to the speed there
    (`likelihood.TorqueLoad`).
    """

    chord: float
    typical: float

    names = ("inertia", "viscous", "bend")
    inertia_row = np.array([1.0, 0.0, 0.0])

    @property
    def viscous_row(self) -> FloatArray:
        return np.array([0.0, 1.0, self.chord])

    def impedance(self, m: FloatArray, s: ComplexArray) -> ComplexArray:
        z: ComplexArray = m[INERTIA] * s + m[VISCOUS]
        return z

    def jacobian(self, m: FloatArray, s: ComplexArray) -> ComplexArray:
        return np.stack([s, np.ones_like(s), np.zeros_like(s)], axis=1)

    def bounds(self, rough_inertia: float, s: ComplexArray) -> tuple[FloatArray, FloatArray]:
        low, high = RigidShaft().bounds(rough_inertia, s)
        return np.append(low, -np.inf), np.append(high, np.inf)

    def scales(self, rough_inertia: float, s: ComplexArray) -> FloatArray:
        plain = RigidShaft().scales(rough_inertia, s)
        return np.append(plain, plain[VISCOUS] * self.typical)


# ---------------------------------------------------------------------------------------------------------------------
# Effect of nonlinear friction at the lines: the true speed over a period, its friction, and the lines of that friction.
#
# The lines of the reported speed, W_k, divided by the filter of the report, are those of the shaft's speed,
#
#     ω(t) = ω̄ + Re Σ_k W_k/F_w(s_k) e^(jω_k t),
#
# which repeats with the segment's period. Friction follows it at once, so c g(ω(t)) has the lines
#
#     G_k = 2/N Σ_n g(ω(t_n)) e^(−jω_k t_n)    and the mean    ḡ,
#
# and the drive reports them through the torque's filter: T_k = F_T (J s + B) W_k/F_w + c F_T G_k. The first term shows
# only F_T/F_w. The second term is a correction, for which the fitted filters are accurate enough.


_POINTS = 16      # points per cycle of the fastest line


@dataclass(frozen=True)
class SegmentWave:
    """One segment: ``lines_hz`` (K,) in any order, ``speed`` (K,) complex as reported, its mean, and its period."""

    lines_hz: tuple[float, ...]
    speed: ComplexArray
    mean: float
    period_s: float

    @cached_property
    def _s(self) -> ComplexArray:
        """Return s = jω of the lines, (K,)."""
        return 2j * math.pi * np.asarray(self.lines_hz)

    @cached_property
    def _turned(self) -> ComplexArray:
        """Return e^(jω_k t_n), (N, K): each line makes a whole number of turns in a period."""
        turns = np.round(np.asarray(self.lines_hz) * self.period_s)
        count = _POINTS * int(max(turns.max(), 1.0))
        turned: ComplexArray = np.exp(2j * math.pi / count * np.multiply.outer(np.arange(count), turns))
        return turned

    def over_period(self, phi: FloatArray) -> FloatArray:
        """Return the speed of the shaft behind the report ``phi`` (6,) (`signal_filters`), (N,) rad/s."""
        found: FloatArray = self.mean + (self._turned @ (self.speed / signal_filters.filters(phi, self._s)[0])).real
        return found

    def through(self, bend: Bend, phi: FloatArray) -> tuple[ComplexArray, float]:
        """Return F_T G (K,) and ḡ."""
        torque = bend.over(self.over_period(phi))
        lines = torque @ self._turned.conj() * (2.0 / len(torque))
        return signal_filters.filters(phi, self._s)[1] * lines, float(torque.mean())


def wave_of(fit: PeriodLines, segment: Segment) -> SegmentWave:
    """Return the mean wave over all periods."""
    return SegmentWave(fit.lines_hz, fit.speed.mean(axis=0), float(fit.speed_mean.mean()), segment.period_s)


# ---------------------------------------------------------------------------------------------------------------------
# Fit of a rigid shaft with nonlinear friction: every shape in turn, with the filters of its wave.
#
# The lines of the friction depend on the filters, and these on the fit; a few rounds make them consistent. The shape
# with the best fit is selected. The interval contains every shape that the data do not contradict, relative to its own
# −2 ln L.


_ROUNDS = 3               # rounds of reweighting
_HOPELESS = 40.0    # of −2 ln L behind the best with first-order lags: such a shape is dropped
_FINE = 0.0005       # of a bell's width: tolerance of its search
_SHORT_S = 0.02     # s; a shorter common lag hardly changes the wave
_SLOWEST = 0.1      # of the mean speed: nearer to standstill friction is of another kind


@dataclass(frozen=True)
class ShaftMotion:
    """Motion of the shaft: a wave for each segment, the levels (the segments' first, in their order), the lines."""

    waves: tuple[SegmentWave, ...]
    levels: Levels
    lines: tuple[SpectralLine, ...]
    constraint: ViscousConstraint | None


@dataclass(frozen=True)
class BentFit:
    """Fit of one shape."""

    bend: Bend
    fitted: FittedModel
    residual: ResidualTest | None

    @property
    def objective(self) -> float:
        return self.fitted.whole.objective


def fit_bends(motion: ShaftMotion, priors: tuple[GaussianPrior, ...], fixed: Fixed,
              rigid: RigidResult) -> list[BentFit]:
    """Return the fits of every shape, the best first; none if the shaft comes too near to standstill. ``priors``,
    ``fixed``: as for rigid.
    """
    # with first-order lags only: the whole family of filters, made to explain nonlinear friction, ends in corners
    starts = starts_of(motion, rigid.fitted.simple.theta)
    if not starts or len({float(np.sign(wave.mean)) for wave in motion.waves}) != 1:
        return []
    speeds = [wave.over_period(start[RIGID_COUNT:]) * np.sign(wave.mean) for start in starts for wave in motion.waves]
    slowest = min(float(np.min(speed)) for speed in speeds)
    priors = tuple(replace(prior, index=prior.index + 1) for prior in priors)
    fixed = {index + 1: value for index, value in fixed.items()}
    fastest = max(float(np.max(speed)) for speed in speeds)

    def near(bend: Bend, theta: FloatArray) -> _Near:
        """Return the fit with first-order lags, one descent in each round, from the end of the last one."""
        for _ in range(_ROUNDS):
            problem = _problem(bend, motion, priors, theta[BEND + 1 :])
            first_order = {**dict.fromkeys(problem.model.structure, 0.0), **fixed}
            fit = minimise(problem, box(problem, rough_inertia_of(problem)), theta, first_order)
            theta = fit.theta
        return bend, problem, fit

    tried = [near(bend, np.insert(starts[0], BEND, 0.0)) for bend in bends(slowest, fastest)]
    tried += _between(tried, near)
    tried = [one for one in tried if _keeps_turning(motion, one[2].theta[BEND + 1 :])]
    least = min((fit.objective for _, _, fit in tried), default=0.0)
    found = [
        BentFit(bend, whole := fit_model(problem, fixed, [fit.theta]), residual_of(whole, 1))
        for bend, problem, fit in tried
        if fit.objective <= least + _HOPELESS
    ]
    return sorted(found, key=lambda one: one.objective)


def starts_of(motion: ShaftMotion, straight: FloatArray) -> list[FloatArray]:
    """Return the start values: the straight fit, and the same without the common lag of both reports.

    A straight fit may use long, nearly cancelling lags to imitate the shape of the friction. They change the ratio of
    the filters little, but the wave after removal of such a lag is far too large. Only starts whose wave keeps the
    shaft turning are used.
    """
    apart = _apart(straight, RIGID_COUNT)
    return [theta for theta in (straight, apart) if theta is not None and _keeps_turning(motion, theta[RIGID_COUNT:])]


def _keeps_turning(motion: ShaftMotion, phi: FloatArray) -> bool:
    """Return whether the shaft behind the reports ``phi`` (6,) stays away from standstill."""
    least = _SLOWEST * min(abs(wave.mean) for wave in motion.waves)
    return all(np.min(wave.over_period(phi) * np.sign(wave.mean)) > least for wave in motion.waves)


def inertia_of(found: Sequence[BentFit], best: Estimate, confidence: float) -> Estimate:
    """Return ``best``, of the best shape, with an interval that covers the other shapes. ``found``: the best shape
    first.
    """
    rise = quantile_of(found[0].fitted, INERTIA, confidence) ** 2
    low, high = [best.low], [best.high]
    for one in found[1:]:
        behind = one.objective - found[0].objective
        if behind < rise:
            other = estimate(one.fitted, INERTIA, confidence, behind)
            low.append(other.low)
            high.append(other.high)
    return Estimate(best.value, min(low), max(high))


_Near = tuple[Bend, Likelihood, Fit]


def _between(tried: list[_Near], near: Callable[[Bend, FloatArray], _Near]) -> list[_Near]:
    """Return the best bell between the neighbours of the grid's best, each started from the best result so far."""
    bells = [(bend.width_rad_s, fit) for bend, _, fit in tried if isinstance(bend, Bell)]
    best = min(range(len(bells)), key=lambda number: bells[number][1].objective)
    around = (math.log(bells[max(best - 1, 0)][0]), math.log(bells[min(best + 1, len(bells) - 1)][0]))
    lowest = bells[best][1]
    seen: list[_Near] = []

    def objective(log_width: float) -> float:
        nonlocal lowest
        seen.append(near(Bell(math.exp(log_width)), lowest.theta))
        fit = seen[-1][2]
        lowest = fit if fit.objective < lowest.objective else lowest
        return fit.objective

    from scipy.optimize import minimize_scalar

    minimize_scalar(objective, bounds=around, method="bounded", options={"xatol": _FINE, "maxiter": 20})
    return [min(seen, key=lambda one: one[2].objective)]


def _apart(theta: FloatArray, mechanical: int) -> FloatArray | None:
    """Return theta without the common lag of both reports; None if that lag is very short."""
    lags = [mechanical + signal_filters.SPEED_LAG, mechanical + signal_filters.TORQUE_LAG]
    shared = float(np.min(theta[lags]))
    if shared < _SHORT_S:
        return None
    found = theta.copy()
    found[lags] -= shared
    return found


def _problem(bend: Bend, motion: ShaftMotion, priors: tuple[GaussianPrior, ...], phi: FloatArray) -> Likelihood:
    """Return the problem with the lines of the friction for the filters ``phi`` (6,)."""
    seen = [wave.through(bend, phi) for wave in motion.waves]
    by_hertz = [
        {round(hertz, 9): line for hertz, line in zip(wave.lines_hz, lines, strict=True)}
        for wave, (lines, _) in zip(motion.waves, seen, strict=True)
    ]
    entries = np.array([own[line.hertz] for line in motion.lines for own in by_hertz if line.hertz in own])
    levels = motion.levels
    friction = np.concatenate([[mean for _, mean in seen], bend.over(levels.speed[len(seen) :])])
    typical = float(np.mean(np.abs(levels.speed)) / np.max(np.abs(friction)))
    shaft = BentShaft(slope_over_speed(levels, friction), typical)
    return Likelihood(motion.lines, Model(shaft), motion.constraint, priors, TorqueLoad(BEND, entries))


# ---------------------------------------------------------------------------------------------------------------------

MODEL = f"{RIGID}, bent friction"
_MORE = 2      # additional parameters compared with straight friction


def identify_bent(case: PeriodicCase, rigid: RigidResult) -> Finding | None:
    """Return the finding with nonlinear friction. ``rigid``: the rigid shaft with straight friction, rejected or in
    doubt.

    None if this fit is not better, or leaves the inertia open.
    """
    constraint = tie_viscous(case.levels)
    if constraint is None or rigid_rivals(rigid.fitted.simple.theta):
        return None
    waves = tuple(
        wave_of(fit, one.segment) for fit, one in zip(case.fits, case.stretches, strict=True) if len(fit.speed)
    )
    straight = rigid.fitted
    motion = ShaftMotion(waves, case.levels, straight.problem.lines, constraint)
    try:
        found = fit_bends(motion, straight.problem.priors, straight.fixed, rigid)
        if not found or found[0].residual is None or rejects(found[0].residual):
            return None
        if straight.whole.objective - found[0].objective <= _MORE * math.log(found[0].fitted.problem.numbers):
            return None
        result = _result(found, constraint, case.options.confidence, case.recording.torque_scale_rel_sd)
    except (np.linalg.LinAlgError, FloatingPointError, ValueError):
        return None
    finding = rigid_finding(result, case, "a rigid shaft with nonlinear friction")
    if isinstance(finding, Refusal):
        return None
    against = rigid.residual.p_value if rigid.residual is not None else 0.0
    means = ", ".join(f"{wave.mean:.3g}" for wave in waves)
    warning = CodedText(
        f"friction is not linear in speed: it bends {found[0].bend.words}. The model includes this. B is its slope "
        f"between the mean speeds {means} rad/s",
        MessageCode.FRICTION_NOT_LINEAR,
    )
    speak = "contradict" if rejects(rigid.residual) else "cast doubt on"
    return replace(
        finding,
        model=MODEL,
        bent=True,
        preface=f"the residuals {speak} linear friction (p = {against:.1g}); ",
        warnings=(*finding.warnings, warning),
    )


def _result(
    found: list[BentFit], constraint: ViscousConstraint, confidence: float, torque_scale_rel_sd: float
) -> RigidResult:
    """Return the result like a rigid one; ``viscous``: slope of friction between the mean speeds; no Coulomb."""
    best = found[0]
    own = estimate(best.fitted, INERTIA, confidence)
    inertia = inertia_of(found, own, confidence)
    speed_lag, torque_lag, skew = lags_of(best.fitted, confidence)
    chord = constraint.slope - constraint.slope_per_inertia * inertia.value
    half = student_quantile(confidence, constraint.dof) * constraint.sd
    return RigidResult(
        inertia=inertia,
        viscous=Estimate(chord, chord - half, chord + half),
        coulomb=None,
        speed_lag_s=speed_lag,
        torque_lag_s=torque_lag,
        skew_s=skew,
        residual=best.residual,
        budget=_budget(best, own, inertia, confidence, torque_scale_rel_sd),
        first_order=best.fitted.first_order,
        fitted=best.fitted,
    )


def _budget(
    best: BentFit, own: Estimate, inertia: Estimate, confidence: float, torque_scale_rel_sd: float
) -> tuple[BudgetLine, ...]:
    """Return the budget of the best shape's ``own`` interval, and one more line: the contribution of other shapes."""
    *lines, scale = budget_of(best.fitted, own, confidence, torque_scale_rel_sd)
    grown = math.sqrt(max((inertia.high - inertia.low) ** 2 - (own.high - own.low) ** 2, 0.0))
    return (*lines, BudgetLine("friction's shape", 0.5 * grown, "other shapes that the data allow"), scale)
