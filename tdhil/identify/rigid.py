"""A rigid shaft, seen through what the drive does to its signals.

The shaft: J dω/dt + B ω + T_c sgn ω = T + disturbance. About a mean speed that keeps its sign the Coulomb term is
constant, so at an excited line T = (J s + B) ω with s = jω_k. The drive reports

    ω_rep = ω · F(s; τ_w) · e^(−d_w s),    T_rep = T / (1 + τ_T s) · e^(−d_T s),

and only the ratio counts, so that with the skew d = d_T − d_w

    G(s) = T_rep / ω_rep = (J s + B) · Q(s; τ_w) / (1 + τ_T s) · e^(−d s),    Q = 1/F.

Whatever both reports share cancels. Q is the structure of the speed report; τ_w is its delay at low frequency in all:

    first order       Q = 1 + τ s
    two equal poles   Q = (1 + τ s / 2)²
    moving average    Q = x / (1 − e^(−x)), x = 2 τ s       (window of 2τ)

Jacobian (columns J, B, τ_w, τ_T, d), from d ln G:

    ∂G/∂J = s G/(J s + B),  ∂G/∂B = G/(J s + B),  ∂G/∂τ_w = G Q'/Q,  ∂G/∂τ_T = −s G/(1 + τ_T s),  ∂G/∂d = −s G.
"""

from enum import Enum

import numpy as np
from numpy.typing import NDArray

from tdhil.record.recording import FloatArray

ComplexArray = NDArray[np.complex128]

INERTIA, VISCOUS, SPEED_LAG, TORQUE_LAG, SKEW = range(5)


class SpeedReport(Enum):
    """How the drive filters the speed that it reports."""

    FIRST_ORDER = "first order"
    TWO_POLES = "two equal poles"
    MOVING_AVERAGE = "moving average"


def inverse_filter(report: SpeedReport, s: ComplexArray, lag_s: float) -> tuple[ComplexArray, ComplexArray]:
    """Q(s; τ) and ∂Q/∂τ, (K,) each."""
    if report is SpeedReport.FIRST_ORDER:
        return 1.0 + lag_s * s, s
    if report is SpeedReport.TWO_POLES:
        root = 1.0 + 0.5 * lag_s * s
        return root * root, s * root
    x = 2.0 * lag_s * s
    small = np.abs(x) < 1e-4
    safe = np.where(small, 1.0, x)
    gone = -np.expm1(-safe)                       # 1 − e^(−x)
    q = np.where(small, 1.0 + x / 2.0, safe / gone)
    slope = np.where(small, 0.5 + x / 6.0, (gone - safe * np.exp(-safe)) / gone**2)
    return q, 2.0 * s * slope


def impedance(theta: FloatArray, s: ComplexArray, report: SpeedReport) -> ComplexArray:
    """G(s), N·m·s/rad, (K,); theta = J (kg·m²), B (N·m·s/rad), τ_w, τ_T, d (s)."""
    inertia, viscous, speed_lag, torque_lag, skew = theta
    q, _ = inverse_filter(report, s, float(speed_lag))
    g: ComplexArray = (inertia * s + viscous) * q / (1.0 + torque_lag * s) * np.exp(-skew * s)
    return g


def impedance_jacobian(theta: FloatArray, s: ComplexArray, report: SpeedReport) -> ComplexArray:
    """∂G/∂theta, (K, 5)."""
    inertia, viscous, speed_lag, torque_lag, skew = theta
    q, q_slope = inverse_filter(report, s, float(speed_lag))
    rest = q / (1.0 + torque_lag * s) * np.exp(-skew * s)
    g = (inertia * s + viscous) * rest
    jacobian: ComplexArray = np.stack(
        [s * rest, rest, g * q_slope / q, -s * g / (1.0 + torque_lag * s), -s * g], axis=1
    )
    return jacobian
