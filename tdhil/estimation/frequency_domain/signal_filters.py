"""What a drive does to the two signals that it reports, as a ratio: only what the reports do not share can be seen.

Torque and speed are reported through filters and delays of their own, T_rep = T·F_T, ω_rep = ω·F_w, and a line of the
excitation shows T_rep/ω_rep = (T/ω)·F_T/F_w. With s = jω,

    ln F_T/F_w = ln P(s; τ_w, ρ_w) − ln P(s; τ_T, ρ_T) + a(s; u) − d s,

    P = 1 + τ s + ρ (τ s)²        a filter of two poles and delay τ: ρ = 0 is first order, 1/4 two equal poles,
                                  1/2 a Butterworth filter; between 0 and 1/4 two unequal poles,
    a = ±ln sinc(ω √|u| / 2)      a moving average over √|u|, its delay taken out: over torque (+) for u > 0, over speed
                                  (−) for u < 0. Averages on both show as their difference,
    d                             all delay of torque beyond speed's: dead times, halves of averages, the frame's skew.

Every structure that drives are known to have is a point of this family, and it is smooth there: u passes through zero,
ρ = 0 is a plain bound. First order on both is ρ_w = ρ_T = u = 0. So the structure is not chosen before the fit; what
the data leave open of it goes into the interval like any other unknown (see rigid_result.py).

What is plausible of a drive enters softly, as Gaussians about zero: lags of about a second at most, averages of about a
second (`PLAUSIBLE`). Data overrule that easily where they speak; where they don't, it keeps the fit out of corners in
which long filters of both reports all but cancel, and where the descents would lose their way.

Why this many and no more: in the logarithm's series −κ₁ s + κ₂ s²/2 − κ₃ s³/6 + κ₄ s⁴/24 …, κ being differences of the
filters' cumulants, (d, τ_w, τ_T) already carry any κ₁, κ₂, κ₃. A wrong structure first shows in κ₄, which ρ_w, ρ_T and
u carry from three sides. What lies beyond is below (ωτ)⁵ at the lines.
"""

from typing import Final

import numpy as np

from tdhil.estimation.frequency_domain.spectrum import ComplexArray
from tdhil.recording import FloatArray

SPEED_LAG, SPEED_SHAPE, TORQUE_LAG, TORQUE_SHAPE, AVERAGE, SKEW = range(6)
COUNT: Final = 6
STRUCTURE: Final = (SPEED_SHAPE, TORQUE_SHAPE, AVERAGE)   # all zero: first-order lags

LAG_BOUND_S: Final = 2.0
SKEW_BOUND_S: Final = 1.0      # half an average of 1.4 s, and what the frame's own skew may add
SHAPE_BOUND: Final = 0.5
PLAUSIBLE: Final = ((SPEED_LAG, 1.0), (TORQUE_LAG, 1.0), (AVERAGE, 1.0))     # standard deviations about zero: s, s, s²
_AVERAGE_CYCLES = 0.8          # an average of w has a zero at 1/w: lines must stay below it


def log_ratio(phi: FloatArray, s: ComplexArray) -> ComplexArray:
    """Ln F_T/F_w, (K,); ``phi`` (6,) = τ_w (s), ρ_w, τ_T (s), ρ_T, u (s²), d (s)."""
    speed_lag, speed_shape, torque_lag, torque_shape, u, skew = phi.tolist()
    x = speed_lag * s
    y = torque_lag * s
    ratio: ComplexArray = np.log((1.0 + x + speed_shape * x * x) / (1.0 + y + torque_shape * y * y)) - skew * s
    if u != 0.0:
        ratio = ratio + np.sign(u) * np.log(np.sinc(np.abs(s) * np.sqrt(abs(u)) / (2.0 * np.pi)))
    return ratio


def filters(phi: FloatArray, s: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """F_w and F_T, (K,) each, as far as ``phi`` (6,) tells them apart; their ratio is that of `log_ratio`."""
    x, y = phi[SPEED_LAG] * s, phi[TORQUE_LAG] * s
    speed = 1.0 / (1.0 + x + phi[SPEED_SHAPE] * x * x)
    torque = np.exp(-phi[SKEW] * s) / (1.0 + y + phi[TORQUE_SHAPE] * y * y)
    u = float(phi[AVERAGE])
    average = np.sinc(np.abs(s) * np.sqrt(abs(u)) / (2.0 * np.pi))
    return (speed, torque * average) if u > 0.0 else (speed * average, torque)


def log_ratio_jacobian(phi: FloatArray, s: ComplexArray) -> ComplexArray:
    """∂ ln F_T/F_w / ∂phi, (K, 6).

    With y = ω √|u|/2: ∂a/∂u = (y cot y − 1)/(2|u|), which is −ω²/24 at u = 0.
    """
    found = np.empty((len(s), COUNT), dtype=np.complex128)
    values = phi.tolist()
    for lag, shape, sign in ((SPEED_LAG, SPEED_SHAPE, 1.0), (TORQUE_LAG, TORQUE_SHAPE, -1.0)):
        x = values[lag] * s
        poles = sign / (1.0 + x + values[shape] * x * x)
        found[:, lag] = (s + 2.0 * values[shape] * x * s) * poles
        found[:, shape] = x * x * poles
    quarter = 0.25 * np.abs(s) ** 2
    y2 = quarter * abs(values[AVERAGE])
    series = -1.0 / 6.0 - y2 / 90.0
    small = y2 < 1e-3
    if small.all():
        found[:, AVERAGE] = quarter * series
    else:
        y = np.sqrt(np.where(small, 1.0, y2))
        found[:, AVERAGE] = quarter * np.where(small, series, (y / np.tan(y) - 1.0) / (2.0 * y * y))
    found[:, SKEW] = -s
    return found


def bounds(s: ComplexArray) -> tuple[FloatArray, FloatArray]:
    """Least and greatest phi, (6,) each."""
    window = _AVERAGE_CYCLES * 2.0 * np.pi / float(np.max(np.abs(s)))
    widest = min(window, 2.0 * LAG_BOUND_S) ** 2
    low = np.array([0.0, 0.0, 0.0, 0.0, -widest, -SKEW_BOUND_S])
    high = np.array([LAG_BOUND_S, SHAPE_BOUND, LAG_BOUND_S, SHAPE_BOUND, widest, SKEW_BOUND_S])
    return low, high


def scales() -> FloatArray:
    """The natural size of each of phi, (6,)."""
    return np.array([0.1, 0.1, 0.1, 0.1, 0.05, 0.05])
