"""Fit of a compliant shaft to spectral lines, and the intervals of the requested quantities."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from tdhil.estimation.frequency_domain import signal_filters
from tdhil.estimation.frequency_domain.filter_order import FittedModel, excess_rise, fit_model
from tdhil.estimation.frequency_domain.inference import covariance, estimate, residual_of
from tdhil.estimation.frequency_domain.likelihood import Likelihood
from tdhil.estimation.frequency_domain.model import GaussianPrior, Model
from tdhil.estimation.frequency_domain.optimiser import Apart, Fit, Fixed, box, minimise, rough_inertia_of
from tdhil.estimation.frequency_domain.shafts import (
    DAMPING,
    INERTIA,
    LOAD,
    RIGID_COUNT,
    STRING_SHARE,
    SWING,
    VISCOUS,
    Believing,
    Shaft,
    string_resonances,
    string_stiffness,
)
from tdhil.estimation.friction_levels import ViscousConstraint
from tdhil.estimation.result import REJECT_P, Estimate, ResidualTest, ShaftCovariance
from tdhil.estimation.spectrum import ComplexArray, SpectralLine
from tdhil.recording import FloatArray

# ---------------------------------------------------------------------------------------------------------------------
# Start values for a compliant shaft: linear least squares over a grid of resonances.
#
# For a given oscillation of the load, the shaft below the motor is J_L H(s) with a known H. With first-order lags and a
# skew d, the equation of a line, Z = J_r s + B + J_L H, is linear: with T' = T e^(ds),
#
#     T' = (J_r τ_w) s² W + (J_r + B τ_w) s W + B W + (J_L τ_w) s H W + J_L H W − τ_T s T',
#
# with six real unknowns. τ_w is then the ratio of the quadratic terms to the linear ones. The oscillation lies on a
# grid over the band and around it, with little and with much damping. The string's share of the load lies on another
# grid.
#
# No line may have more weight than the coarse grid allows: with errors as small as they are, a resonance that is wrong
# by some per cent fits as badly as none. Therefore the lines first get larger errors. The best starts of the grid are
# minimised with these, where the valleys are wide, and the best results are the starts of the real descents.


_PER_OCTAVE = 24                         # resonances of the grid: steps of 3 %, finer than _BLUR
_BEYOND = (0.6, 2.0)                     # ends of the grid, as multiples of the lowest and highest line
_RATIOS = (0.01, 0.1)                    # damping ratios of the grid, of critical damping
_SHARES = (0.08, 0.15, 0.22, 0.3, 0.38, 0.46, 0.55, 0.65, 0.8, 1.0)
"""String's shares of the load on the grid, from a heavy bit to a free bottom. Neighbours are about `_ALIKE` apart: a
coarser grid misses valleys, a finer one only costs time."""
_SKEWS = (-0.05, 0.0, 0.05)              # time offsets of the grid, s; a choice: the descent refines them
_BLUR = 0.08                             # relative error that is assumed for every line
_ALIKE = (0.15, 0.12)                    # octaves of the oscillation, share of the string: closer starts are equal
_TRIED, _KEPT = 24, 5
"""Starts that are minimised with the larger errors, and the best of them that are minimised as they are. A choice:
each costs a descent, and with too few the deepest valley is missed."""


def compliant_starts(problem: Likelihood, fixed: Fixed) -> list[FloatArray]:
    """Return the most promising theta, (P,) each; for `TwoMassShaft` and `StringShaft`."""
    lines = tuple(
        replace(line, s_tt=line.s_tt + _BLUR**2 * float(np.mean(np.abs(line.torque) ** 2 * line.periods)))
        for line in problem.lines
    )
    blurred = Likelihood(lines, problem.model, problem.constraint, problem.priors)
    limits = box(problem, rough_inertia_of(problem))
    first_order = {**dict.fromkeys(problem.model.structure, 0.0), **fixed}
    fits = [minimise(blurred, limits, start, first_order) for start in _proposals(blurred)]
    return [fit.theta for fit in sorted(fits, key=lambda fit: fit.objective)[:_KEPT]]


def _proposals(problem: Likelihood) -> list[FloatArray]:
    """Return the best point of every neighbourhood of the grid, in order of misfit."""
    shapes = _shapes(problem)
    hung = np.array([problem.model.shaft.impedance(shape, problem.s) for shape in shapes])[:, problem.owner]
    solved = [_solved(problem, hung, skew) for skew in _SKEWS]
    misfits = np.array([misfit for misfit, _ in solved])           # (skews, shapes)
    found: list[FloatArray] = []
    kept: list[FloatArray] = []
    for flat in np.argsort(misfits, axis=None, kind="stable"):
        skew_at, at = (int(i) for i in np.unravel_index(flat, misfits.shape))
        shape = shapes[at]
        alike = (abs(np.log2(shape[SWING] / other[SWING])) < _ALIKE[0]
                 and np.all(np.abs(shape[STRING_SHARE:] - other[STRING_SHARE:]) < _ALIKE[1]) for other in kept)
        if not np.isfinite(misfits[skew_at, at]) or any(alike):
            continue
        theta = _theta(problem, shape, solved[skew_at][1][at], _SKEWS[skew_at])
        if theta is not None:
            found.append(theta)
            kept.append(shape)
        if len(found) == _TRIED:
            break
    return found


def _shapes(problem: Likelihood) -> list[FloatArray]:
    """Return mechanical parameters with only a load of 1 kg·m², for every oscillation of the grid."""
    omega = np.abs(problem.s)
    low, high = _BEYOND[0] * float(np.min(omega)), _BEYOND[1] * float(np.max(omega))
    swings = np.geomspace(low, high, max(2, round(_PER_OCTAVE * np.log2(high / low))))
    size = problem.model.mechanical
    shapes = []
    for share in _SHARES if size > STRING_SHARE else (0.0,):
        for ratio in _RATIOS:
            for swing in swings:
                shape = np.zeros(size)
                shape[LOAD], shape[SWING], shape[DAMPING] = 1.0, swing, 2.0 * ratio * swing
                shape[STRING_SHARE:] = share
                shapes.append(shape)
    return shapes


def _solved(problem: Likelihood, hung: ComplexArray, skew: float) -> tuple[FloatArray, FloatArray]:
    """Return misfit (H,) and unknowns (H, 6) for every shape; ``hung`` (H, N): H(s) of each shape at every
    observation.
    """
    w, s = problem.speed, problem.s[problem.owner]
    lines = len(problem.s)
    ratio = problem.torque / w
    mean = (np.bincount(problem.owner, ratio.real, lines) + 1j * np.bincount(problem.owner, ratio.imag, lines))
    weight = problem.root_periods / np.sqrt(problem.variance(mean / problem.segments))[problem.owner]
    torque = problem.torque * np.exp(skew * s)
    plain = np.broadcast_to(np.stack([s * s * w, s * w, w, -s * torque], axis=1), (len(hung), len(w), 4))
    columns = np.concatenate([plain, (hung * s * w)[:, :, None], (hung * w)[:, :, None]], axis=2) * weight[:, None]
    design = np.concatenate([columns.real, columns.imag], axis=1)
    target = np.concatenate([(torque * weight).real, (torque * weight).imag])
    scale = np.maximum(np.linalg.norm(design, axis=1), 1e-300)     # (H, 6)
    design = design / scale[:, None, :]
    normal = np.swapaxes(design, 1, 2) @ design + 1e-10 * np.eye(design.shape[2])
    x = np.linalg.solve(normal, (np.swapaxes(design, 1, 2) @ target)[:, :, None])[:, :, 0]
    left = target - (design @ x[:, :, None])[:, :, 0]
    return np.sum(left**2, axis=1), x / scale


def _theta(problem: Likelihood, shape: FloatArray, x: FloatArray, skew: float) -> FloatArray | None:
    """Return the unknowns as parameters; None if an inertia is negative."""
    quadratic, linear, viscous, torque_lag, load_late, load = (float(value) for value in x)
    size = linear**2 + load**2
    speed_lag = (quadratic * linear + load_late * load) / size if size > 0.0 else 0.0
    speed_lag = float(np.clip(speed_lag, 0.0, signal_filters.LAG_BOUND_S))
    inertia = linear - viscous * speed_lag
    if inertia <= 0.0 or load <= 0.0:
        return None
    mechanical = shape.copy()
    mechanical[INERTIA], mechanical[VISCOUS], mechanical[LOAD] = inertia, viscous, load
    mechanical[DAMPING] *= load
    phi = np.zeros(signal_filters.COUNT)
    phi[signal_filters.SPEED_LAG] = speed_lag
    phi[signal_filters.TORQUE_LAG] = float(np.clip(torque_lag, 0.0, signal_filters.LAG_BOUND_S))
    phi[signal_filters.SKEW] = skew
    theta = np.concatenate([mechanical, phi])
    for prior in problem.priors:
        theta[prior.index] = prior.mean
    return theta


# ---------------------------------------------------------------------------------------------------------------------
# The same shaft with one parameter replaced by a derived quantity: total inertia, stiffness, or a resonance. Its
# interval is then a profile like any other (`inference.estimate`), with bounds and curved valleys.
#
# The parameter m_i is replaced by u, with m_i = h(u, the others); the others keep their places. By the chain rule ∂Z/∂u
# = ∂Z/∂m_i ∂h/∂u, and every other slope gets the additional term ∂Z/∂m_i ∂h/∂m_j.


@dataclass(frozen=True)
class ParameterView:
    """Replacement of one parameter. ``of`` m: the quantity in place of m[index]; ``back``: (m[index], its gradient
    (M,)).
    """

    index: int
    of: Callable[[FloatArray], float]
    back: Callable[[FloatArray], tuple[float, FloatArray]]


def _light(m: FloatArray) -> float:
    """Return 1 − 2η/3, the share of the load that oscillates (`shafts.py`); 1 for two lumps."""
    return 1.0 - 2.0 / 3.0 * float(m[STRING_SHARE]) if len(m) > STRING_SHARE else 1.0


def _total_back(m: FloatArray) -> tuple[float, FloatArray]:
    slope = np.zeros(len(m))
    slope[INERTIA], slope[LOAD] = 1.0, -1.0
    return float(m[INERTIA] - m[LOAD]), slope


def _stiffness_back(m: FloatArray) -> tuple[float, FloatArray]:
    """Return ω_a = √(k/(J_L (1 − 2η/3))), rad/s, and its gradient."""
    swing = math.sqrt(max(float(m[SWING]), 1e-300) / (float(m[LOAD]) * _light(m)))
    slope = np.zeros(len(m))
    slope[SWING], slope[LOAD] = 0.5 * swing / max(float(m[SWING]), 1e-300), -0.5 * swing / float(m[LOAD])
    if len(m) > STRING_SHARE:
        slope[STRING_SHARE] = swing / (3.0 * _light(m))
    return swing, slope


def _resonance_back(m: FloatArray) -> tuple[float, FloatArray]:
    """Return ω_a = Ω/√(1 + J_L/J_r), rad/s, and its gradient."""
    motor, load = float(m[INERTIA]), float(m[LOAD])
    swing = float(m[SWING]) / math.sqrt(1.0 + load / motor)
    slope = np.zeros(len(m))
    slope[SWING] = swing / float(m[SWING])
    slope[LOAD] = -0.5 * swing / (motor + load)
    slope[INERTIA] = 0.5 * swing * load / (motor * (motor + load))
    return swing, slope


def string_view(exponent: float) -> ParameterView:
    """Return the view with a string's z = ζ T^(−exponent) in place of J_L; ζ = √(J_s k), travel time T = √(J_s/k).

    An exponent of −1 gives J_s, 0 gives ζ, 1 gives k. With J_s = η J_L and k = ω_a² J_L (1 − 2η/3), z is J_L times a
    factor of ω_a and η.
    """

    def factor(m: FloatArray) -> tuple[float, float, float]:
        """Return (z/J_L, ∂ln/∂ω_a, ∂ln/∂η)."""
        share, swing, light = max(float(m[STRING_SHARE]), _LIGHTEST), float(m[SWING]), _light(m)
        value = swing ** (1.0 + exponent) * math.sqrt(share * light) * (share / light) ** (-0.5 * exponent)
        of_light = -2.0 / 3.0 / light
        by_share = 0.5 * (1.0 / share + of_light) - 0.5 * exponent * (1.0 / share - of_light)
        return value, (1.0 + exponent) / swing, by_share

    def back(m: FloatArray) -> tuple[float, FloatArray]:
        value, by_swing, by_share = factor(m)
        load, slope = float(m[LOAD]) / value, np.zeros(len(m))
        slope[LOAD], slope[SWING], slope[STRING_SHARE] = 1.0 / value, -load * by_swing, -load * by_share
        return load, slope

    return ParameterView(LOAD, lambda m: float(m[LOAD]) * factor(m)[0], back)


_LIGHTEST = 1e-6     # η of a string with negligible weight
TOTAL = ParameterView(INERTIA, lambda m: float(m[INERTIA] + m[LOAD]), _total_back)
STIFFNESS = ParameterView(SWING, lambda m: float(m[SWING] ** 2 * m[LOAD] * _light(m)), _stiffness_back)
RESONANCE = ParameterView(SWING, lambda m: float(m[SWING] * math.sqrt(1.0 + m[LOAD] / m[INERTIA])), _resonance_back)


class ViewedShaft:
    """Compliant shaft with one parameter replaced by a view."""

    def __init__(self, inner: Shaft, view: ParameterView) -> None:
        self.inner, self.view = inner, view
        self.names = inner.names
        self.inertia_row = inner.inertia_row
        if view is TOTAL:      # the same linear combination of m in the parameters of the view
            self.inertia_row = inner.inertia_row.copy()
            self.inertia_row[view.index] = 0.0
            self.inertia_row += inner.inertia_row[view.index] * _total_back(np.ones(len(inner.names)))[1]
        self.viscous_row = inner.viscous_row

    def impedance(self, m: FloatArray, s: ComplexArray) -> ComplexArray:
        return self.inner.impedance(self._inside(m)[0], s)

    def jacobian(self, m: FloatArray, s: ComplexArray) -> ComplexArray:
        inside, slope = self._inside(m)
        found = self.inner.jacobian(inside, s)
        replaced = found[:, self.view.index].copy()
        found[:, self.view.index] = 0.0
        viewed: ComplexArray = found + replaced[:, None] * slope
        return viewed

    def bounds(self, rough_inertia: float, s: ComplexArray) -> tuple[FloatArray, FloatArray]:
        low, high = self.inner.bounds(rough_inertia, s)
        if self.view is STIFFNESS:
            at = self.view.index
            low[at], high[at] = 1e-3 * rough_inertia * low[at] ** 2, 1e3 * rough_inertia * high[at] ** 2
        return low, high

    def scales(self, rough_inertia: float, s: ComplexArray) -> FloatArray:
        scales = self.inner.scales(rough_inertia, s)
        if self.view is STIFFNESS:
            scales[self.view.index] = rough_inertia * float(np.median(np.abs(s))) ** 2
        return scales

    def beliefs(self, m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the prior residuals of the inner shaft; empty without a prior."""
        if not isinstance(self.inner, Believing):
            return np.zeros(0), np.zeros((0, len(m)))
        inside, slope = self._inside(m)
        off, slopes = self.inner.beliefs(inside)
        by_index = slopes[:, self.view.index].copy()
        slopes[:, self.view.index] = 0.0
        return off, slopes + by_index[:, None] * slope

    def _inside(self, m: FloatArray) -> tuple[FloatArray, FloatArray]:
        inside = m.copy()
        inside[self.view.index], slope = self.view.back(m)
        return inside, slope


def viewed(fitted: FittedModel, view: ParameterView) -> FittedModel:
    """Return the same fits in the parameters of the view; `view.index` is the index of the interval."""
    old = fitted.problem
    problem = Likelihood(old.lines, Model(ViewedShaft(old.model.shaft, view)), old.constraint, old.priors)
    size = old.model.mechanical

    def seen(fit: Fit) -> Fit:
        theta = fit.theta.copy()
        theta[view.index] = view.of(fit.theta[:size])
        return Fit(theta, fit.objective)

    simple = seen(fitted.simple)
    whole = simple if fitted.whole is fitted.simple else seen(fitted.whole)
    limits = box(problem, rough_inertia_of(problem))
    return replace(fitted, problem=problem, limits=limits, simple=simple, whole=whole)


# ---------------------------------------------------------------------------------------------------------------------

SLOWEST_SEEN = 0.5        # of the lowest line: a slower oscillation is not visible
_HEAVIER = (0.02, 0.2, 0.4, 0.7)      # shares of the load at the start of a string's descents; the first: two masses


@dataclass(frozen=True)
class CompliantFit:
    """Fit of two lumps or the string, with the test of its residuals."""

    fitted: FittedModel
    residual: ResidualTest | None

    @property
    def is_string(self) -> bool:
        return self.fitted.problem.model.mechanical > STRING_SHARE

    @property
    def mechanical(self) -> FloatArray:
        """Return the shaft's m (M,) of the likelier structure of lags."""
        return self.fitted.likelier.theta[: self.fitted.problem.model.mechanical]


@dataclass(frozen=True)
class CompliantIntervals:
    """Intervals of one fit; infinite on a side that the data leave open. SI units, resonances in Hz."""

    inertia: Estimate
    viscous: Estimate
    total: Estimate
    load: Estimate
    stiffness: Estimate
    damping: Estimate
    antiresonance: Estimate
    resonance: Estimate


def fit_compliant(
    shaft: Shaft,
    lines: tuple[SpectralLine, ...],
    constraint: ViscousConstraint | None,
    priors: tuple[GaussianPrior, ...],
    fixed: Fixed,
    near: CompliantFit | None = None,
) -> CompliantFit:
    """Fit and test. ``priors`` and ``fixed`` have the indices of a rigid shaft, and are moved to those of this shaft.

    ``near``: two lumps already fitted, which give additional starts for a string.
    """
    model = Model(shaft)
    moved = model.mechanical - RIGID_COUNT
    priors = tuple(replace(prior, index=prior.index + moved) for prior in priors)
    fixed = {index + moved: value for index, value in fixed.items()}
    problem = Likelihood(lines, model, constraint, priors)
    starts = compliant_starts(problem, fixed)
    if near is not None:
        # Two masses fit J_L (1 − η/3) as J_L, and J_r + η J_L/3 as J_r: a third of a spring with the share η of the
        # load's inertia seems to turn with the motor.
        two, strings = near.fitted.simple.theta, []
        for share in _HEAVIER:
            theta = np.insert(two, STRING_SHARE, [share, 0.5])
            theta[LOAD] = two[LOAD] / (1.0 - share / 3.0)
            theta[INERTIA] = max(two[INERTIA] - share / 3.0 * theta[LOAD], 0.1 * two[INERTIA])
            strings.append(theta)
        starts = [*strings, *starts]
    fitted = fit_model(problem, fixed, starts, apart=too_slow(problem))
    return CompliantFit(fitted, residual_of(fitted))


def too_slow(problem: Likelihood) -> Apart:
    """Return the condition for a shaft with a lowest oscillation below the lines: it must gain more than chance does.

    A string always has such an alternative: at multiples of a frequency f, tan ωT is the same for T + 1/(2f), a wave
    that takes longer by half a period (10 s at 0.05 Hz: 32 km of pipe). The difference between the two is scatter, and
    rounding decides whether a descent finds the alternative.
    """
    slowest = SLOWEST_SEEN * float(np.min(np.abs(problem.s)))
    size = problem.model.mechanical

    def stands(theta: FloatArray) -> bool:
        return (string_resonances(theta[:size])[0] if size > STRING_SHARE else float(theta[SWING])) < slowest

    return Apart(stands, chance_gain())


def chance_gain() -> float:
    """Return the drop of −2 ln L by one more parameter that is as unlikely as rejecting a true model, χ²(1)."""
    from scipy.special import chdtri

    return float(chdtri(1.0, REJECT_P))


def inertias(fit: CompliantFit, confidence: float) -> dict[str, Estimate]:
    """Return the quantities that the string's weight changes most, named as in `CompliantIntervals`."""
    fitted = fit.fitted
    return {
        "inertia": estimate(fitted, INERTIA, confidence),
        "total": estimate(viewed(fitted, TOTAL), INERTIA, confidence),
        "load": estimate(fitted, LOAD, confidence),
        "stiffness": estimate(viewed(fitted, STIFFNESS), SWING, confidence),
    }


def intervals(fit: CompliantFit, confidence: float) -> CompliantIntervals:
    """Return each interval by its own profile, for any values of the others."""
    fitted = fit.fitted
    swing = estimate(fitted, SWING, confidence)
    free = estimate(viewed(fitted, RESONANCE), SWING, confidence)
    held_hz, free_hz = _hertz(fit)
    return CompliantIntervals(
        **inertias(fit, confidence),
        viscous=estimate(fitted, VISCOUS, confidence),
        damping=estimate(fitted, DAMPING, confidence),
        antiresonance=_scaled(swing, held_hz),
        resonance=_scaled(free, free_hz),
    )


def shaft_covariance(fit: CompliantFit) -> ShaftCovariance:
    """Return the covariance of J_r, k, the antiresonance, J_L, and of c for two lumps.

    It is that of the fit with first-order lags, by the slopes of the quantities over the parameters. A value that is
    fixed has no variance.
    """
    fitted = fit.fitted
    theta = fitted.simple.theta
    m = theta[: fitted.problem.model.mechanical]
    free = [index for index in range(fitted.problem.model.size) if index not in fitted.simple_held]
    two_lumps = len(m) <= STRING_SHARE
    k = float(m[SWING] ** 2 * m[LOAD]) if two_lumps else string_stiffness(m)
    slopes: dict[str, dict[int, float]] = {
        "inertia_kg_m2": {INERTIA: 1.0},
        "stiffness_nm_rad": {SWING: 2.0 * k / float(m[SWING]), LOAD: k / float(m[LOAD])},
        "antiresonance_hz": {SWING: _hertz(fit)[0]},
        "load_inertia_kg_m2": {LOAD: 1.0},
    }
    if two_lumps:
        slopes["damping_nm_s_rad"] = {DAMPING: 1.0}
    else:
        slopes["stiffness_nm_rad"][STRING_SHARE] = -2.0 / 3.0 * k / _light(m)
    rows = np.zeros((len(slopes), len(theta)))
    for at, row in enumerate(slopes.values()):
        for index, slope in row.items():
            rows[at, index] = slope
    rows = rows[:, free]
    found = excess_rise(fitted.problem, len(fitted.free)) * rows @ covariance(fitted.problem, theta, free) @ rows.T
    return ShaftCovariance(tuple(slopes), tuple(tuple(float(one) for one in row) for row in found))


def _hertz(fit: CompliantFit) -> tuple[float, float]:
    """Return the factors for the two frequencies of the parametrisation: exact for two lumps.

    Those of a string differ by a few per cent, by a factor that hardly depends on the uncertain parameters.
    """
    turn = 0.5 / math.pi
    if not fit.is_string:
        return turn, turn
    fixed, loose = string_resonances(fit.mechanical)
    m = fit.mechanical
    plain = float(m[SWING]), float(m[SWING] * np.sqrt(1.0 + m[LOAD] / m[INERTIA]))
    return turn * fixed / plain[0], turn * loose / plain[1]


def _scaled(one: Estimate, by: float) -> Estimate:
    return Estimate(one.value * by, one.low * by, one.high * by)
