r"""Torque calibration against a reference sensor: a straight line with errors in both (York).

Pairs of reference torque T and reported torque R, each with its standard uncertainty, are fitted by

    T = κ R + a,        minimum of Σ ((x_i − X_i)²/u(x_i)² + (y_i − Y_i)²/u(y_i)²),    x = R, y = T,

with the true points (X_i, Y_i) on the line. Source: D. York, N. M. Evensen, M. L. Martínez and J. De Basabe Delgado
(2004), Unified equations for the slope, intercept, and standard errors of the best straight line, Am. J. Phys. 72, 367,
equations 13; without correlation of the errors. The standard errors are those of that paper. If the pairs scatter more
than stated, the errors are multiplied by √(χ²/(n − 2)) and have n − 2 degrees of freedom.

**Hysteresis.** Readings with rising and with falling torque differ if there is friction between the sensor and the
shaft. The mean of R − line over each direction is reported. Half of their difference is the half-width h of a
rectangular error that both directions share: it adds h/√3 over the mean torque to the relative uncertainty of κ.

**Scale of the reference.** All pairs share the sensor's error of scale, which no number of pairs averages out (GUM
F.1.2.3). It is a line of its own, so the uncertainty of a pair is that of its reading.
"""

import math
from dataclasses import dataclass

import numpy as np

from profiles.quantities import printed_share
from tdhil.calibration.added_body import (
    CONTRADICTED_P,
    FactorLine,
    MeasuredValue,
    compared,
    effective_degrees_of_freedom,
    measured_value,
)
from tdhil.calibration.reference import ASSUMED_REFERENCE_REL_SD
from tdhil.estimation import ResidualTest, normal_quantile
from tdhil.estimation.frequency_domain import CERTAIN
from tdhil.recording import FloatArray

LEAST_PAIRS = 3
_ROUNDS, _CLOSE = 200, 1e-15
UP, DOWN = "up", "down"


@dataclass(frozen=True)
class TorquePairs:
    """Pairs ``reported_nm`` and ``reference_nm`` (n,), their standard uncertainties, and ``direction``: up or down."""

    reported_nm: FloatArray
    reported_sd_nm: FloatArray
    reference_nm: FloatArray
    reference_sd_nm: FloatArray
    direction: tuple[str, ...]


@dataclass(frozen=True)
class PairsFit:
    """Result: ``factor`` κ and ``offset_nm`` a with ``covariance`` of both (2, 2); residuals (n,) of T over the line,
    N·m.

    ``hysteresis_nm``: reading with rising torque less reading with falling torque, about the line; None with one
    direction. ``refusal``: reason why the factor is unusable, '' if it is usable; ``too_wide``: because its interval is
    wider than that of the stated torque scale. ``spread``: √(χ²/(n − 2)) if above 1, else 1.
    """

    factor: MeasuredValue
    offset_nm: MeasuredValue
    covariance: FloatArray
    residuals_nm: FloatArray
    scatter: ResidualTest
    spread: float
    hysteresis_nm: float | None
    refusal: str = ""
    budget: tuple[FactorLine, ...] = ()
    too_wide: bool = False
    warnings: tuple[str, ...] = ()


def line_with_errors_in_both(
    x: FloatArray, x_sd: FloatArray, y: FloatArray, y_sd: FloatArray
) -> tuple[float, float, FloatArray, float]:
    """Return slope, intercept, their covariance (2, 2) and χ² by York's equations. Raises ValueError for no line."""
    if len(x) < LEAST_PAIRS or not float(np.ptp(x)) > 0.0:
        raise ValueError(f"{LEAST_PAIRS} pairs at two torques or more are needed")
    slope = float(np.polyfit(x, y, 1)[0])
    wx, wy = 1.0 / x_sd**2, 1.0 / y_sd**2
    for _ in range(_ROUNDS):
        weight = wx * wy / (wx + slope**2 * wy)
        x_mean, y_mean = float(weight @ x / weight.sum()), float(weight @ y / weight.sum())
        u, v = x - x_mean, y - y_mean
        beta = weight * (u / wy + slope * v / wx)
        before, slope = slope, float((weight * beta) @ v / ((weight * beta) @ u))
        if abs(slope - before) <= _CLOSE * abs(slope):
            break
    intercept = y_mean - slope * x_mean
    adjusted = x_mean + beta
    centre = float(weight @ adjusted / weight.sum())
    slope_var = 1.0 / float(weight @ (adjusted - centre) ** 2)
    covariance = np.array([[slope_var, -centre * slope_var],
                           [-centre * slope_var, 1.0 / float(weight.sum()) + centre**2 * slope_var]])
    return slope, intercept, covariance, float(weight @ (y - slope * x - intercept) ** 2)


def calibrate_pairs(
    pairs: TorquePairs, confidence: float = 0.95, *, reference_rel_sd: float = ASSUMED_REFERENCE_REL_SD,
    scale_rel_sd: float = 0.02,
) -> PairsFit:
    """Return κ from pairs of reference and reported torque. Raises ValueError for too few pairs.

    ``reference_rel_sd``: standard uncertainty of the sensor's scale; ``scale_rel_sd``: stated for the torque scale
    before this calibration.
    """
    from scipy.special import chdtrc

    slope, intercept, covariance, chi2 = line_with_errors_in_both(
        pairs.reported_nm, pairs.reported_sd_nm, pairs.reference_nm, pairs.reference_sd_nm)
    if slope == 0.0:
        raise ValueError("the reference torque is the same in all pairs: check the sensor and its column")
    left = pairs.reference_nm - slope * pairs.reported_nm - intercept
    more = len(left) - 2
    up = np.array([one == UP for one in pairs.direction])
    hysteresis = None
    if up.any() and not up.all():
        hysteresis = float(left[up].mean() - left[~up].mean())
    spread = max(1.0, math.sqrt(chi2 / more))
    covariance = covariance * spread**2
    dof = float(more) if spread > 1.0 else CERTAIN
    size = float(np.sqrt(np.mean(pairs.reported_nm**2)))
    of_hysteresis = abs(hysteresis or 0.0) / 2.0 / math.sqrt(3.0) / size
    factor_sd = math.hypot(math.sqrt(covariance[0, 0]), of_hysteresis, reference_rel_sd * abs(slope))
    statistic = ResidualTest(chi2, float(more), float(chdtrc(more, chi2)))
    budget = [FactorLine("scatter of the pairs" if spread > 1.0 else "stated uncertainty of the pairs",
                         "Student" if spread > 1.0 else "normal", dof, math.sqrt(covariance[0, 0]) / abs(slope))]
    if hysteresis is not None:
        budget.append(FactorLine("hysteresis", "rectangular", CERTAIN, of_hysteresis / abs(slope)))
    budget.append(FactorLine("scale of the reference", "normal", CERTAIN, reference_rel_sd))
    effective = effective_degrees_of_freedom([(line.of_factor, line.degrees_of_freedom) for line in budget])
    factor = measured_value(slope, factor_sd, effective, confidence)
    refusal, assumed = "", normal_quantile(confidence) * scale_rel_sd
    impossible, warnings = compared(factor, scale_rel_sd, assumed, "the reference")
    too_wide = not impossible and not factor.half_width_share <= assumed
    if too_wide:
        refusal = (f"the pairs leave κ at {printed_share(factor.half_width_share)}, and the stated torque scale leaves"
                   f" ±{100 * assumed:.1f} %: measure larger torques, or more pairs")
    elif impossible:
        refusal = f"{impossible}; check units, signs, and the shaft that the reference stands at"
    elif statistic.p_value < CONTRADICTED_P and abs(hysteresis or 0.0) < float(np.std(left)) and _bent(pairs, left):
        refusal = "the reference torque is no straight line over the reported one: its residuals are curved"
    return PairsFit(factor, measured_value(intercept, math.sqrt(covariance[1, 1]), dof, confidence), covariance, left,
                    statistic, spread, hysteresis, refusal, tuple(budget), too_wide, () if refusal else warnings)


def _bent(pairs: TorquePairs, left: FloatArray) -> bool:
    """Return True if a parabola explains most of the residuals."""
    if len(left) < LEAST_PAIRS + 2 or len(np.unique(pairs.reported_nm)) < LEAST_PAIRS + 1:
        return False
    curved = left - np.polyval(np.polyfit(pairs.reported_nm, left, 2), pairs.reported_nm)
    return bool(curved @ curved < 0.25 * (left @ left))
