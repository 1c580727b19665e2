"""Truncated power series: a transfer function and its first derivatives at many frequencies.

A row (c_0, …, c_3) stands for c_0 + c_1 h + c_2 h² + c_3 h³, the function at s + h; c_n = H⁽ⁿ⁾(s)/n!. Products are
truncated alike.
"""

import numpy as np
from numpy.typing import NDArray

ComplexArray = NDArray[np.complex128]
ORDERS = 4


def polynomial(s: ComplexArray, *coefficients: float) -> ComplexArray:
    """c0 + c1 s + c2 s² (+ …, at most s³) at s + h, (M, 4)."""
    found = np.zeros((len(s), ORDERS), dtype=np.complex128)
    binomial = ((1,), (1, 1), (1, 2, 1), (1, 3, 3, 1))
    for power, coefficient in enumerate(coefficients):
        for order in range(power + 1):
            found[:, order] += coefficient * binomial[power][order] * s ** (power - order)
    return found


def exponential(s: ComplexArray, delay_s: float) -> ComplexArray:
    """e^(delay·s) at s + h, (M, 4)."""
    powers = np.array([1.0, delay_s, delay_s**2 / 2.0, delay_s**3 / 6.0])
    found: ComplexArray = np.exp(delay_s * s)[:, None] * powers
    return found


def product(a: ComplexArray, b: ComplexArray) -> ComplexArray:
    """Cauchy product, truncated."""
    found = np.zeros_like(a)
    for order in range(ORDERS):
        for part in range(order + 1):
            found[:, order] += a[:, part] * b[:, order - part]
    return found
