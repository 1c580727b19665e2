"""Friction over speed, at every steady speed of the run, and the test whether it is the straight line that B assumes.

Over a stretch with weight w(t) (`momentum.BalanceRow`), the momentum balance gives friction without an effect of the
lags:

    T_f = (∫w T − J (Δω + δ Δα)) / ∫w     at     ω = ∫w ω / ∫w,     variance D ∫w² / (∫w)²,

D is the density of the disturbance. The uncertainty of J and δ adds to the variance if the speed drifts. The stretches
are those of steady or slowly drifting speed between the motions, and the excited segments after settling. In an excited
segment the speed oscillates about its mean. The mean torque of a straight line is its value at the mean speed, but that
of a parabola c ω² is larger by c var ω. Points of excited segments are therefore used to test for a straight line. They
are shown only if there are too few others, with the uncertainty of c, which all points determine together.

If friction is nonlinear (Stribeck), B between two mean speeds ω₁, ω₂ is the slope of a chord. At either end the slope
differs from it by c (ω₂ − ω₁): `viscous_spread_nm_s_rad`, which adds in quadrature to the standard deviation of B from
the levels.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from profiles import CodedText, MessageCode
from tdhil.estimation.cross_checks.momentum import (
    KNOT_S,
    BalanceKind,
    BalanceRow,
    Span,
    balances,
    block_means,
    drifting_spans,
    periodic_segments,
    through,
)
from tdhil.estimation.cross_checks.momentum_fit import UNKNOWN_DELAY, Delay, Density, Resolution, fit_momentum
from tdhil.estimation.frequency_domain import fisher_tail, student_quantile
from tdhil.estimation.friction_levels import Levels
from tdhil.estimation.result import Estimate, FrictionPoint, Options
from tdhil.estimation.samples import Samples, excited_window
from tdhil.recording import FloatArray, Recording

# ---------------------------------------------------------------------------------------------------------------------
# Points of a friction curve: friction torque over each stretch of steady or slowly drifting speed.
#
# `tdhil.estimation.cross_checks.friction_by_speed` explains how a momentum balance gives a point.


_ALIKE = 0.01             # share of the highest speed: closer speeds are merged
_SWING_LEFT = 0.25        # share that knots of one period leave if it is 10 % off, and the oscillation decays


@dataclass(frozen=True)
class Inertia:
    """Known J, kg·m², rough or final, with its standard deviation, and the delay between the reports.

    ``swing_s``: period in which the load of a compliant shaft oscillates; 0 for a rigid one.
    """

    value: float
    sd: float
    delay: Delay = UNKNOWN_DELAY
    swing_s: float = 0.0


@dataclass(frozen=True)
class FrictionStretch:
    """Speed (rad/s) and friction torque (N·m) of one stretch, or of several at one speed."""

    speed: float
    torque: float
    variance: float           # (N·m)²
    swing: float              # var ω of the excitation, (rad/s)²


def steady_points(recording: Recording, samples: Samples, inertia: Inertia, density: float) -> list[FrictionStretch]:
    """Return one point for each stretch, in order of kind and time; ``density`` of the disturbance, (N·m)²·s."""
    blocks = block_means(samples)
    if blocks is None:
        return []
    segments = periodic_segments(recording)
    found = []
    for span in drifting_spans(blocks, segments):
        row = through(samples, span.start_s, span.end_s, min(KNOT_S, span.duration_s / 4.0))
        point = None if row is None else _point(row, inertia, density, 0.0)
        if point is not None and inertia.swing_s > 0.0:
            point = _without_swing(samples, span, inertia, density, point)
        found += [point] if point is not None else []
    for segment in segments:
        start, end = excited_window(segment)
        whole = math.floor((end - start) / segment.period_s + 1e-6)
        if whole < 2:
            continue
        row = through(samples, start, start + whole * segment.period_s, segment.period_s, periodic=True)
        swing = 0.5 * sum(a * a for a in segment.amplitudes_rad_s)
        found += [_point(row, inertia, density, max(swing, 1e-12))] if row is not None else []
    return found


def _without_swing(
    samples: Samples, span: Span, inertia: Inertia, density: float, short: FrictionStretch
) -> FrictionStretch | None:
    """Return the point of a stretch at whose ends the load still oscillates; None if it is too short.

    The momentum of the load is not that of J at the motor's speed. Knots of one period change the torque of the point;
    `_SWING_LEFT` of this change is uncertain. ``short``: the point with the usual knots.
    """
    if span.duration_s < 2.0 * inertia.swing_s:
        return None
    row = through(samples, span.start_s, span.end_s, max(KNOT_S, inertia.swing_s))
    if row is None:
        return None
    point = _point(row, inertia, density, 0.0)
    return replace(point, variance=point.variance + (_SWING_LEFT * (point.torque - short.torque)) ** 2)


def _point(row: BalanceRow, inertia: Inertia, density: float, swing: float) -> FrictionStretch:
    change = row.change_rad_s + inertia.delay.seconds * row.change_rad_s2
    variances = (
        density * row.energy_s,
        (inertia.sd * change) ** 2,
        (inertia.value * inertia.delay.sd_s * row.change_rad_s2) ** 2,
    )
    torque = (row.impulse_nm_s - inertia.value * change) / row.time_s
    return FrictionStretch(row.travel_rad / row.time_s, torque, sum(variances) / row.time_s**2, swing)


def merged(points: list[FrictionStretch]) -> list[FrictionStretch]:
    """Return the points in order of speed, with neighbours of one speed merged by weight, if both are steady or both
    excited.
    """
    ordered = sorted(points, key=lambda point: point.speed)
    fastest = max((abs(point.speed) for point in ordered), default=0.0)
    found: list[FrictionStretch] = []
    for point in ordered:
        near = [k for k, other in enumerate(found)
                if point.speed - other.speed < _ALIKE * fastest and (other.swing > 0.0) == (point.swing > 0.0)]
        if not near:
            found.append(point)
            continue
        other = found[near[-1]]
        mine, theirs = 1.0 / point.variance, 1.0 / other.variance
        share = mine / (mine + theirs)
        found[near[-1]] = replace(
            other,
            speed=other.speed + share * (point.speed - other.speed),
            torque=other.torque + share * (point.torque - other.torque),
            variance=1.0 / (mine + theirs),
        )
    return sorted(found, key=lambda point: point.speed)


# ---------------------------------------------------------------------------------------------------------------------

_BENT_P = 0.01            # p-value of a straight line over speed, below which friction counts as nonlinear
_LEAST_SPEEDS = 3         # fewest speeds for a test: two speeds fit any straight line
_LEAST_DOF = 4.0          # least degrees of freedom of a scatter that is used


@dataclass(frozen=True)
class FrictionCurve:
    """Friction curve. ``points``: () for fewer than three speeds. ``p_value``: of a straight line; None if untested.

    ``viscous_spread_nm_s_rad``: standard deviation of the difference between the slope at the excited mean speeds and B
    of the levels; 0 if the curve is straight.
    """

    points: tuple[FrictionPoint, ...]
    p_value: float | None
    bent: bool
    viscous_spread_nm_s_rad: float

    @property
    def warnings(self) -> tuple[str, ...]:
        if not self.bent:
            return ()
        return (CodedText(
            f"friction is not linear in speed (p = {self.p_value:.1g}): its slope B differs by "
            f"±{self.viscous_spread_nm_s_rad:.2g} N·m·s/rad between the mean speeds. The interval of J includes this",
            MessageCode.FRICTION_NOT_LINEAR),)


_NOTHING = FrictionCurve((), None, False, 0.0)


def friction_curve(
    recording: Recording, samples: Samples, levels: Levels, inertia: Inertia, options: Options
) -> FrictionCurve:
    """Return the friction curve. A rough inertia is enough: at slow drift its term is small. Never raises.

    ``levels``: mean operating points of the excited segments, for the density of the disturbance.
    """
    try:
        density = Density(levels.density, levels.dof)
        if density.dof < _LEAST_DOF:      # too few excited periods: also from residuals of momentum balances
            found = balances(recording, samples)
            fit = None if found is None else fit_momentum(found, BalanceKind.TURNING, density, inertia.delay,
                                                          Resolution(0.0, 0.0), 0.95)
            density = density if fit is None else fit.density
        if not (density.dof >= _LEAST_DOF and density.value > 0.0 and math.isfinite(inertia.value)):
            return _NOTHING
        points = merged(steady_points(recording, samples, inertia, density.value))
        if len(points) < _LEAST_SPEEDS:
            return _NOTHING
        p_value = _straight(points, density)
        bent = p_value < _BENT_P
        bend, bend_sd = _bend(points)
    except (np.linalg.LinAlgError, FloatingPointError, ValueError, ZeroDivisionError):
        return _NOTHING
    if sum(1 for point in points if point.swing == 0.0) >= _LEAST_SPEEDS:
        points = [point for point in points if point.swing == 0.0]
    quantile = student_quantile(options.confidence, density.dof)
    unsure = max(abs(bend), bend_sd)
    shown = []
    for point in points:
        half = quantile * math.hypot(math.sqrt(point.variance), unsure * point.swing)
        torque = Estimate(point.torque, point.torque - half, point.torque + half)
        shown.append(FrictionPoint(point.speed, torque))
    # between the mean speeds of the levels B is a chord; with fewer than two levels, between those of the curve
    speeds = levels.speed if len(levels.speed) > 1 else np.array([point.speed for point in points])
    spread = abs(bend) * float(np.ptp(speeds)) if bent else 0.0
    return FrictionCurve(tuple(shown), p_value, bent, spread)


def _columns(points: list[FrictionStretch]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return for each point (K,): speed and its square (including the oscillation), (K, 2); torque; 1/σ.

    One more column for each direction of rotation has its Coulomb friction.
    """
    speed = np.array([point.speed for point in points])
    square = speed**2 + np.array([point.swing for point in points])
    weight = 1.0 / np.sqrt(np.array([point.variance for point in points]))
    ways = [np.asarray(np.sign(speed) == way, dtype=np.float64) for way in np.unique(np.sign(speed))]
    design = np.column_stack([speed, np.sign(speed) * square, *ways])
    return design, np.array([point.torque for point in points]), weight


def _straight(points: list[FrictionStretch], density: Density) -> float:
    """Return the p-value of a straight line: F test of its residuals against the density of the disturbance."""
    design, torque, weight = _columns(points)
    design = np.delete(design, 1, axis=1)
    left = len(points) - design.shape[1]
    if left < 1:
        return 1.0
    fitted = np.linalg.lstsq(design * weight[:, None], torque * weight, rcond=None)[0]
    rest = float(np.sum(((torque - design @ fitted) * weight) ** 2))
    return fisher_tail(rest / left, left, density.dof)


def _bend(points: list[FrictionStretch]) -> tuple[float, float]:
    """Return the coefficient c of ω², N·m·s²/rad², and its standard deviation; 0 and 0 for too few points."""
    design, torque, weight = _columns(points)
    if len(points) < design.shape[1]:
        return 0.0, 0.0
    weighted = design * weight[:, None]
    scale = np.maximum(np.linalg.norm(weighted, axis=0), 1e-300)
    spread = np.linalg.pinv((weighted / scale).T @ (weighted / scale), rcond=1e-9) / np.outer(scale, scale)
    fitted = spread @ weighted.T @ (torque * weight)
    return float(fitted[1]), math.sqrt(max(float(spread[1, 1]), 0.0))
