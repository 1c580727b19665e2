"""Smooth windows with their derivatives: nothing is to be left at their ends, nor of their first three slopes.

The taper is the smoothstep of degree 7, x⁴(35 − 84x + 70x² − 20x³); rising and falling ones add up to one.
"""

import numpy as np

from tdhil.recording.recording import FloatArray

_STEP = np.polynomial.Polynomial([0.0, 0.0, 0.0, 0.0, 35.0, -84.0, 70.0, -20.0])
_SLOPES = (_STEP, _STEP.deriv(1), _STEP.deriv(2), _STEP.deriv(3))


def flat_top(time: FloatArray, length: float, taper: float) -> FloatArray:
    """1 in the middle, up from 0 and down to ``length`` in ``taper`` s each; with three derivatives, (N, 4)."""
    rise = _smoothstep(time / taper, taper)
    fall = _smoothstep((length - time) / taper, taper) * np.array([1.0, -1.0, 1.0, -1.0])
    found: FloatArray = np.where((time < 0.5 * length)[:, None], rise, fall)
    return found


def times(u: FloatArray, w: FloatArray) -> FloatArray:
    """The product of two windows by Leibniz's rule, (N, 4)."""
    return np.stack([
        u[:, 0] * w[:, 0],
        u[:, 1] * w[:, 0] + u[:, 0] * w[:, 1],
        u[:, 2] * w[:, 0] + 2.0 * u[:, 1] * w[:, 1] + u[:, 0] * w[:, 2],
        u[:, 3] * w[:, 0] + 3.0 * u[:, 2] * w[:, 1] + 3.0 * u[:, 1] * w[:, 2] + u[:, 0] * w[:, 3],
    ], axis=1)


def _smoothstep(x: FloatArray, length: float) -> FloatArray:
    inside = np.clip(x, 0.0, 1.0)
    return np.stack([slope(inside) / length**order for order, slope in enumerate(_SLOPES)], axis=1)
