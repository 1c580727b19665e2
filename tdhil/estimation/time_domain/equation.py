r"""Equation of the shaft in every bin: the torque that the speed does not explain.

With ω = Q_w(s) ω_rep, T = Q_T(s) e^(ds) T_rep, and constant friction in each direction, the equation of the shaft is

    A T_rep = C ω_rep + c,      A = Q_T e^(ds),   C = (J s + B) Q_w,   Q = 1 + τ s + κ τ² s²,

with the delay d of the torque report relative to the speed report. Only the low frequencies of a filter matter: κ = 0
is one pole, up to ¼ two poles, ⅓ a moving average, ½ a delay. κ is a nuisance parameter within [0, ½].

If friction has a part c₂ ω|ω|, the term c₂ Q_w ω_rep|ω_rep| is added to C ω_rep. The speed of the shaft is ahead of the
reported speed, and so is its square: ω² = ω_rep² + τ_w d(ω_rep²)/dt + …, except for (τ_w dω_rep/dt)². Without Q_w, J
would be wrong by τ_w times the slope of friction, 2 c₂ ω.

The residual of a bin is e = (A T − C W − c Φ)/A, N·m·s: T_rep less the torque of the model for ω_rep.
"""

from dataclasses import dataclass

import numpy as np

from tdhil.estimation.time_domain.taylor import ComplexArray, exponential, polynomial, product
from tdhil.estimation.time_domain.windows import Bins
from tdhil.recording import FloatArray

INERTIA, VISCOUS, SPEED_LAG, TORQUE_LAG, SKEW, SPEED_SHAPE, TORQUE_SHAPE, FORWARD, BACK, BEND = range(10)
PARAMETERS = 10           # number of parameters of the equation


@dataclass(frozen=True)
class Evaluated:
    """Residuals ``error`` (M,), their slopes (M, 10), and G = C/A (M,)."""

    error: ComplexArray
    slopes: ComplexArray
    gain: ComplexArray


def evaluate(theta: FloatArray, bins: Bins) -> Evaluated:
    """Return the residual of every bin and its derivatives by theta."""
    inertia, viscous, lag_w, lag_t, skew, shape_w, shape_t = (float(value) for value in theta[:7])
    s = bins.s
    shaft, report = polynomial(s, viscous, inertia), polynomial(s, 1.0, lag_w, shape_w * lag_w**2)
    late, filtered = exponential(s, skew), polynomial(s, 1.0, lag_t, shape_t * lag_t**2)
    a, c = product(late, filtered), product(shaft, report)

    def of_speed(series: ComplexArray) -> ComplexArray:
        return np.asarray(np.einsum("mn,mn->m", series, bins.speed), dtype=np.complex128)

    def of_torque(series: ComplexArray) -> ComplexArray:
        return np.asarray(np.einsum("mn,mn->m", series, bins.torque), dtype=np.complex128)

    def of_bend(series: ComplexArray) -> ComplexArray:
        return np.asarray(np.einsum("mn,mn->m", series, bins.bend), dtype=np.complex128)

    first, bend, bent = a[:, 0], float(theta[BEND]), of_bend(report)
    error = (of_torque(a) - of_speed(c) - bins.level @ theta[FORWARD:BEND] - bend * bent) / first
    slopes = np.empty((len(s), PARAMETERS), dtype=np.complex128)
    slopes[:, INERTIA] = -of_speed(product(polynomial(s, 0.0, 1.0), report))
    slopes[:, VISCOUS] = -of_speed(report)
    for index, by in ((SPEED_LAG, polynomial(s, 0.0, 1.0, 2.0 * shape_w * lag_w)),
                      (SPEED_SHAPE, polynomial(s, 0.0, 0.0, lag_w**2))):
        slopes[:, index] = -of_speed(product(shaft, by)) - bend * of_bend(by)
    by_lag = product(late, polynomial(s, 0.0, 1.0, 2.0 * shape_t * lag_t))
    by_shape = product(late, polynomial(s, 0.0, 0.0, lag_t**2))
    by_skew = product(a, polynomial(s, 0.0, 1.0))
    for index, series in ((TORQUE_LAG, by_lag), (TORQUE_SHAPE, by_shape), (SKEW, by_skew)):
        slopes[:, index] = of_torque(series) - error * series[:, 0]
    slopes[:, FORWARD:BEND] = -bins.level
    slopes[:, BEND] = -bent
    slopes /= first[:, None]
    return Evaluated(error, slopes, c[:, 0] / first)


def scale_slopes(theta: FloatArray, bins: Bins, braking: ComplexArray) -> ComplexArray:
    """Return the derivatives (M, 2) of the residuals by J₁, if the inertia were J + J₁|ω|, and by r, if the reported
    torque were 1 + r times the torque wherever it brakes.

    The torque of J₁ is ½ J₁ d(ω|ω|)/dt; the square of the speed passes the filter as in `evaluate`. ``braking`` (M, 4):
    X_n of the reported torque where it opposes the rotation, and zero elsewhere.
    """
    s, (lag_w, lag_t, skew, shape_w, shape_t) = bins.s, (float(value) for value in theta[SPEED_LAG:FORWARD])
    by_speed = product(polynomial(s, 0.0, 0.5), polynomial(s, 1.0, lag_w, shape_w * lag_w**2))
    a = product(exponential(s, skew), polynomial(s, 1.0, lag_t, shape_t * lag_t**2))
    both = np.stack([np.einsum("mn,mn->m", by_speed, bins.bend), np.einsum("mn,mn->m", a, braking)], axis=1)
    return np.asarray(-both / a[:, :1], dtype=np.complex128)
