r"""Frequency above which the open loop of a drive and its string stays small, whatever the string's resonances are.

::

    L = H·law/(J s + B + Z_s)        |L| ≤ |H·law|/m(ω)        m(ω) = lower bound of |jωJ + B + Z_s(jω)|

**Why the rotor alone is no bound.** Above each antiresonance, Im Z_s is negative, and at one frequency it cancels all
of Jω. Only the losses are left there: B and Re Z_s. A lightly damped string has a small Re Z_s, so |L| may exceed 1 far
above the crossover of the bare drive.

**Derivation.** In one section, the reflection seen with the section's own impedance Z_c = (m s + d)/γ is
w = (Z − Z_c)/(Z + Z_c) = w_end e^(−2γL), so |w| ≤ q = |w_end| e^(−2 Re γ L): an echo loses energy on its way down and
up. The end of the last section is any passive load, Re Z ≥ 0, whatever the bit does. With φ = −arg Z_c this means
|w_end| ≤ √((1 + sin φ)/(1 − sin φ)), which is 1 without drag. The loads |w| ≤ q are a disc in the plane of Z::

    centre Z_c (1 + q²)/(1 − q²)        radius 2 |Z_c| q/(1 − q²)

A bilinear map takes it to a disc in the plane of the next section's w. The largest |w| there is |w_end| of the next
section, and so on up to the top. Z_s is in the last disc, so m is the distance of −(B + jωJ) from it, and at least B.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tdhil.soft_torque.controller import SpeedController, TopDrive, control_law, inner_lags
from tdhil.soft_torque.drill_string import Complex, DrillString

Reals = NDArray[np.float64]

LEAST_GAIN = 0.1
"""Least |L| of interest. A smaller |L| has a gain margin above `MOST_GAIN_DB`. The grid of `stability` ends above the
last frequency at which |L| may be larger."""
MOST_GAIN_DB = 20.0
"""Largest gain margin, dB, that is searched: −20 log `LEAST_GAIN`."""
_OMEGA = np.geomspace(0.05, 3e3, 1000)
_ALL_REFLECTED = 1.0 - 1e-9
"""Largest q, for a string without any loss: its disc is the right half-plane."""


@lru_cache(maxsize=1024)
def highest_crossover(drive: TopDrive, law: SpeedController, string: DrillString) -> float:
    """Return the frequency, rad/s, above which |L| stays below `LEAST_GAIN`, by the bound of this module."""
    s: Complex = np.asarray(1j * _OMEGA, dtype=np.complex128)
    centre, radius = _loads(string)
    rotor = drive.inertia_kg_m2 * s + drive.viscous_nm_s_rad
    least = np.maximum(np.abs(rotor + centre) - radius, drive.viscous_nm_s_rad)
    above = np.flatnonzero(np.abs(inner_lags(drive, s) * control_law(law, s)) > LEAST_GAIN * least)
    return float(_OMEGA[min(above[-1] + 1, _OMEGA.size - 1)]) if above.size else 1.0


@lru_cache(maxsize=256)
def _loads(string: DrillString) -> tuple[Complex, Reals]:
    """Return centre and radius of the disc with Z_s, N·m·s/rad, at every frequency of the search."""
    s: Complex = np.asarray(1j * _OMEGA, dtype=np.complex128)
    centre: Complex | None = None
    radius: Reals = np.zeros(s.size)
    for line in reversed(string.lines):
        shunt = line.inertia_kg_m * s + line.drag_nm_s_rad_m
        root = np.sqrt(line.compliance_rad_nm_m * s * shunt)
        own: Complex = shunt / root
        if centre is None:
            sine = np.abs(own.imag) / np.abs(own)
            end = np.sqrt((1.0 + sine) / (1.0 - sine))
        else:
            # w = 1 − 2 Z_c/(Z + Z_c): the disc of 1/(Z + Z_c) has its centre at (c + Z_c)*/(|c + Z_c|² − R²)
            moved = centre + own
            power = (np.abs(moved) - radius) * (np.abs(moved) + radius)
            end = np.abs(1.0 - 2.0 * own * moved.conj() / power) + 2.0 * np.abs(own) * radius / power
        share = np.minimum(end * np.exp(-2.0 * line.length_m * root.real), _ALL_REFLECTED)
        centre = own * (1.0 + share**2) / (1.0 - share**2)
        radius = 2.0 * np.abs(own) * share / (1.0 - share**2)
    assert centre is not None
    return centre, radius
