"""Friction over speed, at every steady speed that the run saw, and whether it is the straight line that B takes it for.

Over a stretch with weight w(t) (`momentum_rows`) the balance of momentum gives friction free of lags,

    T_f = (∫w T − J (Δω + δ Δα)) / ∫w     at     ω = ∫w ω / ∫w,     variance D ∫w² / (∫w)²,

D the disturbance's density, and what the uncertainty of J and δ makes of a drift. Stretches are those of steady or
slowly drifting speed between the motions, and the excited segments after settling.
About a segment's mean speed the shaft swings: the mean torque of a straight line is its value at the mean speed, but
that of a parabola c ω² is more by c var ω. So the swung points serve the test for a straight line, and are shown only
where there are too few others: then as unsure as c is, which all points tell together.

If friction bends (Stribeck), B between two mean speeds ω₁, ω₂ is a chord, and at either end the slope differs by
c (ω₂ − ω₁) from it: `viscous_spread_nm_s_rad`, which belongs in quadrature to the deviation of what ties B to
the levels.
"""

import math
from dataclasses import dataclass

import numpy as np

from tdhil.estimation.cross_checks.momentum import balances
from tdhil.estimation.cross_checks.momentum_fit import Delay, Density, Resolution, fit_momentum
from tdhil.estimation.frequency_domain.friction_levels import Levels
from tdhil.estimation.frequency_domain.inference import student_quantile
from tdhil.estimation.result import Estimate, FrictionPoint
from tdhil.estimation.samples import Samples
from tdhil.identify.beside.friction_curve_points import Inertia, Point, merged, steady_points
from tdhil.identify.beside.momentum_rows import Kind
from tdhil.identify.options import Options
from tdhil.recording.recording import FloatArray, Recording

_BENT_P = 0.01
_LEAST_SPEEDS = 3
_LEAST_DOF = 4.0


@dataclass(frozen=True)
class FrictionCurve:
    """``points``: () where fewer than three speeds were seen. ``p_value``: of a straight line; None if untested.

    ``viscous_spread_nm_s_rad``: one standard deviation by which the slope at the excited mean speeds may differ from
    the levels' B; 0 unless the curve is bent.
    """

    points: tuple[FrictionPoint, ...]
    p_value: float | None
    bent: bool
    viscous_spread_nm_s_rad: float

    @property
    def warnings(self) -> tuple[str, ...]:
        if not self.bent:
            return ()
        return (
            f"friction is no straight line over speed (p = {self.p_value:.1g}): its slope B differs by "
            f"±{self.viscous_spread_nm_s_rad:.2g} N·m·s/rad from one mean speed to the other, and J knows less of it",
        )


_NOTHING = FrictionCurve((), None, False, 0.0)


def friction_curve(
    recording: Recording, samples: Samples, levels: Levels, inertia: Inertia, options: Options
) -> FrictionCurve:
    """Points in rising speed. A rough inertia is enough: at slow drift there is little to take off. Never raises.

    ``levels``: of the excited segments, for the density of the disturbance.
    """
    try:
        density = _density(recording, samples, levels, inertia.delay)
        if density is None or not math.isfinite(inertia.value):
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
    spread = abs(bend) * float(np.ptp(_mean_speeds(points, levels))) if bent else 0.0
    return FrictionCurve(tuple(shown), p_value, bent, spread)


def _density(recording: Recording, samples: Samples, levels: Levels, delay: Delay) -> Density | None:
    """Of the excited periods; where they are too few, of these and of what balances of momentum leave."""
    own = Density(levels.density, levels.dof)
    if own.dof < _LEAST_DOF:
        found = balances(recording, samples)
        fit = None if found is None else fit_momentum(found, Kind.TURNING, own, delay, Resolution(0.0, 0.0), 0.95)
        own = own if fit is None else fit.density
    return own if own.dof >= _LEAST_DOF and own.value > 0.0 else None


def _columns(points: list[Point]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Per point (K,): speed and its square, the swing's part included, (K, 2); torque; 1/σ.

    With them come one column for each direction of rotation: Coulomb friction differs.
    """
    speed = np.array([point.speed for point in points])
    square = speed**2 + np.array([point.swing for point in points])
    weight = 1.0 / np.sqrt(np.array([point.variance for point in points]))
    ways = [np.asarray(np.sign(speed) == way, dtype=np.float64) for way in np.unique(np.sign(speed))]
    design = np.column_stack([speed, np.sign(speed) * square, *ways])
    return design, np.array([point.torque for point in points]), weight


def _straight(points: list[Point], density: Density) -> float:
    """The p-value of a straight line: F test of what it leaves against the disturbance's density."""
    from scipy.stats import f

    design, torque, weight = _columns(points)
    design = np.delete(design, 1, axis=1)
    left = len(points) - design.shape[1]
    if left < 1:
        return 1.0
    fitted = np.linalg.lstsq(design * weight[:, None], torque * weight, rcond=None)[0]
    rest = float(np.sum(((torque - design @ fitted) * weight) ** 2))
    return float(f.sf(rest / left, left, density.dof))


def _bend(points: list[Point]) -> tuple[float, float]:
    """Coefficient c of ω², N·m·s²/rad², and its standard deviation; 0 and 0 where the points are too few to tell."""
    design, torque, weight = _columns(points)
    if len(points) < design.shape[1]:
        return 0.0, 0.0
    weighted = design * weight[:, None]
    scale = np.maximum(np.linalg.norm(weighted, axis=0), 1e-300)
    spread = np.linalg.pinv((weighted / scale).T @ (weighted / scale), rcond=1e-9) / np.outer(scale, scale)
    fitted = spread @ weighted.T @ (torque * weight)
    return float(fitted[1]), math.sqrt(max(float(spread[1, 1]), 0.0))


def _mean_speeds(points: list[Point], levels: Levels) -> FloatArray:
    """The levels' mean speeds, between which B is a chord; without two of them, the whole curve's."""
    return levels.speed if len(levels.speed) > 1 else np.array([point.speed for point in points])
