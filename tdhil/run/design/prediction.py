"""The interval that the estimator itself would give: its own fit, on lines as they are expected.

Everything about how an interval comes to be (lag structures, weights known by estimate, priors) is asked of
`identify`, here and nowhere else in this room, so that what is predicted is what will be said.

Lines without noise fit exactly, and would give too narrow an interval: −2 ln L = Σ 2(ν + M) ln(1 + q/ν) has the
curvature (ν + M)/(ν + q), and q is about M where there is noise, but 0 here. So S is taken (ν + M)/ν times as large.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tdhil.estimation.frequency_domain.friction_levels import Levels, tie_viscous
from tdhil.estimation.frequency_domain.rigid import RigidResult, fit_rigid
from tdhil.estimation.frequency_domain.spectrum import Line
from tdhil.identify.lines.identifiable import known_of, refuse_count
from tdhil.protocol.design.noise import RIGID
from tdhil.recording.recording import FloatArray, LagPrior

_NINE_IN_TEN = 1.28
LEAST_NU = 2.0      # complex degrees of freedom of a line's weight, below which identification leaves it out


@dataclass(frozen=True)
class Evidence:
    """What a fit rests on: lines, levels, and what is stated of the lags."""

    lines: tuple[Line, ...]
    levels: Levels
    prior: LagPrior


@dataclass(frozen=True)
class Fitted:
    """The rigid model's parameters that the fit settled on, (8,), and J's relative half-width."""

    theta: FloatArray
    half_width: float


def fit(evidence: Evidence, confidence: float) -> Fitted | None:
    """The estimator's own fit; None where it would refuse."""
    tie = tie_viscous(evidence.levels)
    lines = tuple(line for line in evidence.lines if line.excited and line.nu >= LEAST_NU)
    priors, held = known_of(evidence.prior, len(lines), tie)
    if not lines or refuse_count(len(lines), tie, priors) is not None:
        return None
    try:
        found = fit_rigid(lines, evidence.levels, tie, priors, held, confidence)
    except (np.linalg.LinAlgError, FloatingPointError, ValueError):
        return None
    return _fitted(found)


def _fitted(found: RigidResult) -> Fitted | None:
    inertia = found.inertia
    half = 0.5 * (inertia.high - inertia.low) / inertia.value if inertia.value > 0.0 else math.inf
    theta = found.fitted.likelier.theta
    if not (half > 0.0 and np.all(np.isfinite(theta))):
        return None
    return Fitted(theta, half)


def noise_free(evidence: Evidence, fitted: Fitted) -> Evidence:
    """The same with torques that the parameters explain exactly, and scatter enlarged for what is missing."""
    lines = []
    for line in evidence.lines:
        g = complex(RIGID.impedance(fitted.theta, np.array([2j * np.pi * line.hertz]))[0])
        share = (line.nu + len(line.speed)) / max(line.nu, 1.0)
        lines.append(
            replace(line, torque=g * line.speed, s_ww=share * line.s_ww, s_tt=share * line.s_tt, s_tw=share * line.s_tw)
        )
    levels, theta = evidence.levels, fitted.theta
    coulomb = float(levels.weights @ (levels.torque - theta[0] * levels.drift - theta[1] * levels.speed))
    torque = coulomb + theta[1] * levels.speed + theta[0] * levels.drift
    return replace(evidence, lines=tuple(lines), levels=replace(levels, torque=torque))


def longer(evidence: Evidence, scale: float, scatter: float = 1.0) -> Evidence:
    """The same motion ``scale`` times as long, with ``scatter`` times the variance."""
    lines = []
    for line in evidence.lines:
        nu = line.nu + float(np.sum(line.periods)) * (scale - 1.0)
        lines.append(
            replace(
                line, periods=line.periods * scale, nu=nu,
                s_ww=scatter * line.s_ww, s_tt=scatter * line.s_tt, s_tw=scatter * line.s_tw,
            )
        )
    levels = evidence.levels
    dof = levels.dof * scale
    levels = replace(levels, duration=levels.duration * scale, density=scatter * levels.density, dof=dof)
    return replace(evidence, lines=tuple(lines), levels=levels)


def half_width(evidence: Evidence, confidence: float) -> float:
    """J's relative half-width; infinite where the estimator would refuse."""
    found = fit(evidence, confidence)
    return math.inf if found is None else found.half_width


def safe_half_width(evidence: Evidence, confidence: float) -> float:
    """The same, as noise leaves it in nine runs of ten.

    Quite another set of lags may explain the lines nearly as well. Without noise its −2 ln L is D₀ above the best, with
    noise D ~ N(D₀, 4 D₀); it widens the interval where D < t². That stays rarer than one in ten if √D₀ ≥ x + √(x² + t²)
    with x = 1.28. So the profile is followed up to there, and scaled back: a parabola gives the same as ever, a second
    valley within reach shows.
    """
    nu = [line.nu for line in evidence.lines if line.nu >= LEAST_NU]
    if not nu:
        return math.inf
    from scipy.special import stdtr, stdtrit

    dof = 2.0 * max(nu)
    usual = float(stdtrit(dof, 0.5 + 0.5 * confidence))
    reach = _NINE_IN_TEN + math.hypot(_NINE_IN_TEN, usual)
    found = fit(evidence, float(2.0 * stdtr(dof, reach) - 1.0))
    return math.inf if found is None else found.half_width * usual / reach


def whole_periods(lines: Sequence[Line]) -> float:
    """Periods that count in all segments together."""
    return float(np.sum(lines[0].periods)) if lines else 0.0
