"""Ratio of the filters on the two signals that a drive reports. The common part of both filters is not visible.

Torque and speed are reported with their own filters and delays, T_rep = T·F_T, ω_rep = ω·F_w. A line of the excitation
shows T_rep/ω_rep = (T/ω)·F_T/F_w. With s = jω,

    ln F_T/F_w = ln P(s; τ_w, ρ_w) − ln P(s; τ_T, ρ_T) + a(s; u) − d s,

    P = 1 + τ s + ρ (τ s)²        a filter of two poles and delay τ: ρ = 0 is first order, 1/4 two equal poles,
                                  1/2 a Butterworth filter; between 0 and 1/4 two unequal poles,
    a = ±ln sinc(ω √|u| / 2)      a moving average over √|u|, its delay taken out: over torque (+) for u > 0, over speed
                                  (−) for u < 0. Averages on both show as their difference,
    d                             all delay of torque beyond speed's: dead times, halves of averages, the frame's skew.

Every known structure of a drive is a point of this family, and the family is smooth there: u passes through zero, and ρ
= 0 is a simple bound. First order on both is ρ_w = ρ_T = u = 0. The structure is therefore not chosen before the fit.
Its uncertainty is part of the interval, like that of any other unknown (see inference.py).

Plausible values of a drive are Gaussian priors about zero: lags of about a second at most, averages of about a second
(`PLAUSIBLE`). Informative data easily override them. Without such data, the priors keep the fit out of corners in which
long filters of both reports nearly cancel, and in which descents do not converge.

The number of parameters follows from the series of the logarithm, −κ₁ s + κ₂ s²/2 − κ₃ s³/6 + κ₄ s⁴/24 …, in which κ
are differences of the filters' cumulants: (d, τ_w, τ_T) already give any κ₁, κ₂, κ₃. A wrong structure first shows in
κ₄, which ρ_w, ρ_T and u adjust in three ways. The remaining terms are below (ωτ)⁵ at the lines.
"""

import math
from typing import Final

import numpy as np

from tdhil.estimation.spectrum import ComplexArray
from tdhil.recording import FloatArray

SPEED_LAG, SPEED_SHAPE, TORQUE_LAG, TORQUE_SHAPE, AVERAGE, SKEW = range(6)
COUNT: Final = 6               # parameters of a ratio: those of the line above
STRUCTURE: Final = (SPEED_SHAPE, TORQUE_SHAPE, AVERAGE)   # all are zero for first-order lags

LAG_BOUND_S: Final = 2.0       # s; five times the longest lag that explains the paper's field slopes, 0.40 s
SKEW_BOUND_S: Final = 1.0      # s; half an average of 1.4 s, and the skew of the frame itself
SHAPE_BOUND: Final = 0.5       # 0: one pole; 0.25: two equal poles; 0.5: two poles as of Butterworth, ζ = 1/(2√ρ)
PLAUSIBLE: Final = ((SPEED_LAG, 1.0), (TORQUE_LAG, 1.0), (AVERAGE, 1.0))     # standard deviations about zero: s, s, s²
_AVERAGE_CYCLES = 0.8          # cycles: an average of w has a zero at 1/w, and lines must be below it

_SIGNS: Final = np.array([[1.0], [-1.0]])      # signs of ln P in the ratio: speed, torque
_SERIES: Final = 1e-3                          # y² below which a is computed by its series


class FilterRatio:
    """F_T/F_w at some lines and its slopes, by Horner's rule and without logarithms, because a result needs thousands.

    ``phi`` (6,) = τ_w (s), ρ_w, τ_T (s), ρ_T, u (s²), d (s); ``s`` (K,). ``value`` (K,).
    """

    def __init__(self, phi: FloatArray, s: ComplexArray) -> None:
        poles = phi[:AVERAGE].reshape(2, 2)                             # of speed and of torque: lag, shape
        self._s, self._shapes = s, poles[:, 1:]
        self._u, skew = float(phi[AVERAGE]), float(phi[SKEW])
        self._x = poles[:, :1] * s
        self._poles = 1.0 + self._x * (1.0 + self._shapes * self._x)
        value: ComplexArray = self._poles[0] / self._poles[1] * np.exp(-skew * s)
        if self._u != 0.0:
            half = 0.5 * math.sqrt(abs(self._u)) * np.abs(s.imag)
            sinc = np.sin(half) / half
            value = value * sinc if self._u > 0.0 else value / sinc
        self.value = value

    def log_slopes(self) -> ComplexArray:
        """Return ∂ ln F_T/F_w / ∂phi, (6, K).

        With y = ω √|u|/2: ∂a/∂u = (y cot y − 1)/(2|u|), which is −ω²/24 at u = 0.
        """
        s, x, u = self._s, self._x, self._u
        found = np.empty((COUNT, len(s)), dtype=np.complex128)
        by = _SIGNS / self._poles
        found[SPEED_LAG:TORQUE_SHAPE:2] = (1.0 + 2.0 * self._shapes * x) * s * by
        found[SPEED_SHAPE:AVERAGE:2] = x * x * by
        quarter = 0.25 * s.imag * s.imag
        y2 = quarter * abs(u)
        by_u = -1.0 / 6.0 - y2 / 90.0
        if y2.max() >= _SERIES:
            far = np.maximum(y2, _SERIES)
            y = np.sqrt(far)
            by_u = np.where(y2 < _SERIES, by_u, (y / np.tan(y) - 1.0) / (2.0 * far))
        found[AVERAGE] = quarter * by_u
        found[SKEW] = -s
        return found


def filters(phi: FloatArray, s: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """Return F_w and F_T, (K,) each, as far as ``phi`` (6,) separates them; their ratio is that of `FilterRatio`."""
    x, y = phi[SPEED_LAG] * s, phi[TORQUE_LAG] * s
    speed = 1.0 / (1.0 + x + phi[SPEED_SHAPE] * x * x)
    torque = np.exp(-phi[SKEW] * s) / (1.0 + y + phi[TORQUE_SHAPE] * y * y)
    u = float(phi[AVERAGE])
    average = np.sinc(np.abs(s) * np.sqrt(abs(u)) / (2.0 * np.pi))
    return (speed, torque * average) if u > 0.0 else (speed * average, torque)


# ---------------------------------------------------------------------------------------------------------------------
# Prior on the common lag of both reports, which the lines hardly show.
#
# With equal lags on both, F_T/F_w = 1 for any length of them. With τ_w = c + δ, τ_T = c and the delay δ compensated,
#
#     ln F_T/F_w = ln(1 + δ s/(1 + c s)) − δ s  ≈  −δ c s²/(1 + c s),
#
# which is a product: lines determine δ c, and c only if δ c (ω c)² is clear of the noise. Otherwise c rises to any
# bound, noise at the slowest lines determines δ/c there, and J follows, because far above 1/c the ratio is the number 1
# + δ/c. A flat prior makes this likely: of all lags up to a second, most are long. However, a lag is a scale: if the
# lines can show such a lag, no size is likelier than another in the logarithm (reference prior 1/c). Below that the
# prior is flat. Therefore
#
#     −2 ln p = ln(1 + (c/c₀)²),    c = √2 τ_w τ_T/√(τ_w² + τ_T²),    c₀ = 0.2/ω of the fastest line,
#
# is added to the likelihood. c is the shorter lag if they differ much, and either of them if they are equal. One long
# lag has no penalty. Two long lags have a penalty of about five, which their difference must explain: if it is clear of
# the noise, it explains hundreds, and c changes by a fifth of its standard deviation. If it is not, the data do not
# distinguish them from no lags. In between, at long lags that differ by less than a few percent, the interval may be as
# wide as without this prior.


_UNSEEN = 0.2          # rad at the fastest line
_ROUND = 0.1           # of c₀: c is made smooth about zero over this width


def unseen_lag(fastest_rad_s: float) -> float:
    """Return c₀, s."""
    return _UNSEEN / fastest_rad_s


def shared_lag(speed_lag_s: float, torque_lag_s: float, unseen_s: float) -> tuple[float, float, float]:
    """Return the residual whose square is −2 ln p of two lags, and its slopes by each of them."""
    a, b = speed_lag_s, torque_lag_s
    square = a * a + b * b + (_ROUND * unseen_s) ** 2
    root = math.sqrt(square)
    x = math.sqrt(2.0) * a * b / root / unseen_s
    by_a, by_b = (math.sqrt(2.0) * other * (square - own * own) / (square * root * unseen_s) for own, other in
                  ((a, b), (b, a)))
    if abs(x) < 1e-6:
        value, slope = x, 1.0
    else:
        value = math.copysign(math.sqrt(math.log1p(x * x)), x)
        slope = x / (1.0 + x * x) / value
    return value, slope * by_a, slope * by_b


def bounds(s: ComplexArray) -> tuple[FloatArray, FloatArray]:
    """Return the least and greatest phi, (6,) each."""
    window = _AVERAGE_CYCLES * 2.0 * np.pi / float(np.max(np.abs(s)))
    widest = min(window, 2.0 * LAG_BOUND_S) ** 2
    low = np.array([0.0, 0.0, 0.0, 0.0, -widest, -SKEW_BOUND_S])
    high = np.array([LAG_BOUND_S, SHAPE_BOUND, LAG_BOUND_S, SHAPE_BOUND, widest, SKEW_BOUND_S])
    return low, high


def scales() -> FloatArray:
    """Return the natural size of each parameter of phi, (6,)."""
    return np.array([0.1, 0.1, 0.1, 0.1, 0.05, 0.05])
