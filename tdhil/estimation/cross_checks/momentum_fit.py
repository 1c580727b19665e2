"""Inertia and friction from momentum balances: generalised least squares with a disturbance of unknown density.

Rows y = A x + e, x = (J, B, T_c), cov e = D C (`momentum.BalanceRow`: C is tridiagonal). D has two sources: the scatter
of the excited periods' mean torque (`friction_levels.Levels.density`), and the residuals of the rows. They are pooled,
unless the rows scatter more than the periods allow (F test, 1 %). In that case friction or load differ during the
changes of speed, and the interval uses the scatter of the rows.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from tdhil.estimation.cross_checks.momentum import KNOT_S, BalanceKind, BalanceRow, Balances, overlap_s
from tdhil.estimation.frequency_domain import CERTAIN, fisher_tail, student_quantile
from tdhil.estimation.setpoint_sampling import EXACT_READING, ReadingShare
from tdhil.recording import FloatArray

_ROWS_DIFFER_P = 0.01     # p-value below which the rows scatter more than the operating points
LEAST_DOF = 3.0           # least degrees of freedom of a scatter that is used
_BEND_SHOWS = 6.6         # of the density: decrease that shows nonlinear friction, χ² of one degree at 1 %
_UNSEEN_BEND = 0.03       # of J: standard deviation of the effect of undetected nonlinear friction on a balance
_LEAST_CHANGE = 0.1       # of the highest speed: rows with a smaller change of speed determine J too poorly


@dataclass(frozen=True)
class Density:
    """Mean square of the disturbance times duration, (N·m)²·s, and its degrees of freedom."""

    value: float
    dof: float


@dataclass(frozen=True)
class Delay:
    """Delay of the reported speed behind the reported torque, δ = τ_w − τ_T, s; ``known``: fitted or stated."""

    seconds: float
    sd_s: float
    known: bool


UNKNOWN_DELAY = Delay(0.0, 0.25, False)
"""Unknown delay: up to half a second either way, as two standard deviations."""


@dataclass(frozen=True)
class Resolution:
    """Standard deviation of a mean due to rounding: of speed, rad/s, and of torque, N·m."""

    speed_rad_s: float
    torque_nm: float


@dataclass(frozen=True)
class MomentumFit:
    """J, kg·m², its half-width at the requested confidence, and the delay's part in it (kg·m², one standard deviation).

    ``rows`` number of changes of speed used; ``density`` is pooled. ``bend``: change of J, kg·m², if friction has a
    part proportional to the square of the speed.
    """

    inertia: float
    half_width: float
    delay_sd: float
    viscous: float
    rows: int
    density: Density
    bend: float = 0.0


def fit_momentum(
    found: Balances, kind: BalanceKind, levels: Density, delay: Delay, resolution: Resolution, confidence: float,
    reading: ReadingShare = EXACT_READING,
) -> MomentumFit | None:
    """Return J from the rows of one kind. Other rows with nearly constant speed give friction. None if J is not
    determined.

    ``reading``: error of the impulse from sampling in step with a speed setpoint, as a share of J, for rows moved by
    the setpoint (`tdhil.estimation.setpoint_sampling`). Raises LinAlgError for a singular system.
    """
    fastest = max(abs(row.travel_rad) / row.time_s for row in found.rows)

    def changes(row: BalanceRow) -> bool:
        return abs(row.change_rad_s) >= _LEAST_CHANGE * fastest

    rows = [row for row in found.rows if row.kind is kind or not changes(row)]
    count = sum(1 for row in rows if row.kind is kind and changes(row))
    if count == 0 or len(rows) < 3:
        return None
    covariance = np.diag([row.energy_s for row in rows])
    for i, (earlier, later) in enumerate(pairwise(rows)):
        covariance[i, i + 1] = covariance[i + 1, i] = overlap_s(earlier, later)
    inverse = np.linalg.inv(np.linalg.cholesky(covariance))
    impulse = inverse @ np.array([row.impulse_nm_s for row in rows])

    def solve(delay_s: float, *more: FloatArray, prior: float = 0.0) -> tuple[FloatArray, FloatArray, float]:
        """Solve with further columns ``more`` beside J, B and T_c. ``prior``: inverse deviation of the last, in
        rows' units.
        """
        columns = np.column_stack([_design(rows, delay_s, found.direction, reading.value), *more])
        design = inverse @ columns
        if prior > 0.0:
            last = np.zeros((1, columns.shape[1]))
            last[0, -1] = prior
            design = np.concatenate([design, last])
        right = np.append(impulse, 0.0) if prior > 0.0 else impulse
        scale = np.maximum(np.linalg.norm(design, axis=0), 1e-300)
        normal = (design / scale).T @ (design / scale)
        if np.linalg.cond(normal) > 1e12:
            raise np.linalg.LinAlgError("friction and inertia cannot be separated")
        spread: FloatArray = np.linalg.inv(normal) / np.outer(scale, scale)
        x: FloatArray = spread @ (design.T @ right)
        return x, spread, float(np.sum((right - design @ x) ** 2))

    x, spread, rest = solve(delay.seconds)
    density = _pooled(levels, rest, len(rows) - 3)
    if density is None or not x[0] > 0.0:
        return None
    stepped = np.array([row.stepped_rad_s for row in rows])
    further: tuple[FloatArray, ...] = ()
    prior = 0.0
    if reading.sd > 0.0 and np.any(stepped):
        further, prior = (stepped,), math.sqrt(density.value) / (reading.sd * float(x[0]))
        x, spread, rest = solve(delay.seconds, *further, prior=prior)
        density = _pooled(levels, rest, len(rows) - 3) or density
        if not x[0] > 0.0:
            return None
    shifted = abs(float(solve(delay.seconds + delay.sd_s, *further, prior=prior)[0][0] - x[0]))
    design = inverse @ np.column_stack([_design(rows, delay.seconds, found.direction, reading.value), *further])
    gain = (spread @ design.T @ inverse)[0]                       # ∂J/∂(impulse of each row)
    edges = gain * float(x[0])
    # an error of speed from rounding at a knot has opposite signs in the two rows that share the knot
    knots = np.append(edges, 0.0) - np.append(0.0, edges)
    # the slope at the knot, multiplied by the delay, also has a rounding error, that of a sawtooth over the knot
    read = resolution.speed_rad_s * math.hypot(1.0, math.sqrt(12.0) * delay.seconds / KNOT_S)
    rounding = math.hypot(
        read * float(np.linalg.norm(knots)),
        resolution.torque_nm * float(np.linalg.norm(gain * np.array([row.time_s for row in rows]))),
    )
    scatter = math.sqrt(density.value * float(spread[0, 0]))
    half = math.hypot(
        student_quantile(confidence, density.dof) * scatter,
        student_quantile(confidence, CERTAIN) * math.hypot(shifted, rounding),
    )
    bent = _bent(solve, rows, delay.seconds, float(x[0]), further, prior, rest, density.value)
    return MomentumFit(float(x[0]), half, shifted, float(x[1]), count, density, bent)


def _bent(
    solve: Callable[..., tuple[FloatArray, FloatArray, float]], rows: list[BalanceRow], delay_s: float, inertia: float,
    further: tuple[FloatArray, ...], prior: float, rest: float, density: float,
) -> float:
    """Return the change of J, kg·m², due to friction with a part ∝ ω|ω|: the full change if the rows show that part.

    Otherwise the estimate of this part is mostly noise, and the change is limited to a share of J.
    """
    square = np.array([row.travel_rad * abs(row.travel_rad) / row.time_s for row in rows])
    try:
        x, _, left = solve(delay_s, square, *further, prior=prior)
    except np.linalg.LinAlgError:
        return _UNSEEN_BEND * inertia
    change = abs(float(x[0]) - inertia)
    return change if rest - left > _BEND_SHOWS * density else min(change, _UNSEEN_BEND * inertia)


def _design(rows: list[BalanceRow], delay_s: float, direction: float, share: float) -> FloatArray:
    """Return the design matrix (rows, 3) for J, B, T_c. ``share``: relative excess of J where a setpoint moved the
    shaft.
    """
    table = []
    for row in rows:
        delay = 0.0 if row.kind is BalanceKind.COASTING else delay_s
        table.append([
            row.change_rad_s + delay * row.change_rad_s2 + share * row.stepped_rad_s,
            row.travel_rad + delay * row.change_rad_s,
            direction * row.time_s,
        ])
    return np.array(table, dtype=np.float64)


def _pooled(levels: Density, rest: float, left: int) -> Density | None:
    own = rest / left if left > 0 else 0.0
    if levels.dof < 1.0 or not levels.value > 0.0:
        return Density(own, float(left)) if left >= LEAST_DOF else None
    if left > 0 and fisher_tail(own / levels.value, left, levels.dof) < _ROWS_DIFFER_P:
        return Density(own, float(left))
    total = levels.dof + left
    return Density((levels.dof * levels.value + rest) / total, total)
