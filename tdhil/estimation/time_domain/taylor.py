"""Truncated power series: a transfer function and its first derivatives at many frequencies.

A row (c_0, …, c_3) means c_0 + c_1 h + c_2 h² + c_3 h³, the function at s + h; c_n = H⁽ⁿ⁾(s)/n!. Products are truncated
too.
"""

import numpy as np
from numpy.typing import NDArray

from tdhil.recording import FloatArray

# ---------------------------------------------------------------------------------------------------------------------
# Smooth windows with their derivatives. Value and first three slopes are 0 at their ends.
#
# The taper is the smoothstep of degree 7, x⁴(35 − 84x + 70x² − 20x³). A rising and a falling taper add up to one.


_STEP = np.polynomial.Polynomial([0.0, 0.0, 0.0, 0.0, 35.0, -84.0, 70.0, -20.0])
_SLOPES = (_STEP, _STEP.deriv(1), _STEP.deriv(2), _STEP.deriv(3))


def flat_top(time: FloatArray, length: float, taper: float) -> FloatArray:
    """Return a window: 1 in the middle, tapers of ``taper`` s from 0 and down to 0 at ``length`` s; with 3
    derivatives (N, 4).
    """
    rise = _smoothstep(time / taper, taper)
    fall = _smoothstep((length - time) / taper, taper) * np.array([1.0, -1.0, 1.0, -1.0])
    found: FloatArray = np.where((time < 0.5 * length)[:, None], rise, fall)
    return found


def _smoothstep(x: FloatArray, length: float) -> FloatArray:
    inside = np.clip(x, 0.0, 1.0)
    return np.stack([slope(inside) / length**order for order, slope in enumerate(_SLOPES)], axis=1)


# ---------------------------------------------------------------------------------------------------------------------

ComplexArray = NDArray[np.complex128]
ORDERS = 4                # terms of the series


def polynomial(s: ComplexArray, *coefficients: float) -> ComplexArray:
    """Return c0 + c1 s + c2 s² (+ …, at most s³) at s + h, (M, 4)."""
    found = np.zeros((len(s), ORDERS), dtype=np.complex128)
    binomial = ((1,), (1, 1), (1, 2, 1), (1, 3, 3, 1))
    for power, coefficient in enumerate(coefficients):
        for order in range(power + 1):
            found[:, order] += coefficient * binomial[power][order] * s ** (power - order)
    return found


def exponential(s: ComplexArray, delay_s: float) -> ComplexArray:
    """Return e^(delay·s) at s + h, (M, 4)."""
    powers = np.array([1.0, delay_s, delay_s**2 / 2.0, delay_s**3 / 6.0])
    found: ComplexArray = np.exp(delay_s * s)[:, None] * powers
    return found


def product(a: ComplexArray, b: ComplexArray) -> ComplexArray:
    """Return the truncated Cauchy product."""
    found = np.zeros_like(a)
    for order in range(ORDERS):
        for part in range(order + 1):
            found[:, order] += a[:, part] * b[:, order - part]
    return found
