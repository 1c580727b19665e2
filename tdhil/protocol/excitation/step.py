"""Step: the paper's equation 9, A₀ before and A₁ after, repeated as a square wave about the offset.

A true step of speed needs unbounded torque and saturates the drive, and a saturated drive identifies nothing. So the
square wave is band-limited: its odd harmonics 1 … 9, each (4/πm) sin(2π m f t), tapered by Lanczos' σ factors
sin(x)/x, x = π m / 11, which keep the overshoot of the truncated series (Gibbs) at about 1 %. It reaches the new speed
in about a tenth of a period.
"""

import math

from tdhil.run.excitation.signals import Shape, unit_peak

DEFAULT_FREQUENCY_HZ = 0.05   # of the square wave: each level lasts 10 s
_HARMONICS = (1, 3, 5, 7, 9)


def step_shape() -> Shape:
    """Odd harmonics of a square wave, peak deviation 1 (half of A₁ − A₀)."""
    taper = [math.pi * m / (_HARMONICS[-1] + 2) for m in _HARMONICS]
    return unit_peak(
        Shape(
            harmonics=_HARMONICS,
            amplitudes=tuple(4.0 / (math.pi * m) * math.sin(x) / x for m, x in zip(_HARMONICS, taper, strict=True)),
            phases_rad=(1.5 * math.pi,) * len(_HARMONICS),
        )
    )
