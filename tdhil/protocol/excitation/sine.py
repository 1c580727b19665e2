"""Sine: the paper's equation 8, ω₁(t) = A sin(2π f t) + B, one line about one offset.

One line is two equations for inertia, friction, two lags and a skew: it tells the inertia only where the lags are
known.
"""

import math

from tdhil.run.excitation.signals import Shape

DEFAULT_FREQUENCY_HZ = 0.1   # lowest tone of the paper's field test (section 5.2)


def sine_shape() -> Shape:
    """One line, amplitude 1; a sine is a cosine that is a quarter late."""
    return Shape(harmonics=(1,), amplitudes=(1.0,), phases_rad=(1.5 * math.pi,))
