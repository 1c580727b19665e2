r"""Candidate gains on a grid, ranked by the steepness of the falling bit friction with which they stay stable.

**Grid.** P = ζ/a, I = (φω)² (J − J_c), J_c = share · J. Softness a, frequency factor φ and share are free. Points
with an integral time P/I of more than eight periods of the string's lowest mode are left out: no search can judge them.

**Rank.** At the lowest mode, the bit is loaded by Re Z_b (`stability`). A bit that oscillates with amplitude A about
its mean speed Ω takes in as much energy as a friction slope of −σ_e, with σ_e = −(2/A) mean(T_f(Ω + A sin φ) sin φ)
(describing function; any text on nonlinear control). If σ_e < Re Z_b for every A up to Ω, no oscillation grows until
the bit stops. The lowest such Ω has the same order as the simulated critical speeds, and needs no simulation. The
linear stability limit is a lower bound of it. If no bit is stated, the bit of the reference case is used, because only
the order is needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from math import pi

import numpy as np

from tdhil.soft_torque.controller import SpeedController, impedance
from tdhil.soft_torque.critical_speed import longest_integral_time_s
from tdhil.soft_torque.drill_string import BitFriction, Complex, DrillString
from tdhil.soft_torque.stability import Reals, bit_grid, bit_impedance, chain_of, linear_limit_rad_s, steepest_slope
from tdhil.soft_torque.uncertainty import Truth

SOFTNESS_RANGE = (0.01, 10.0)
"""Softness a that may be requested, and that the search covers."""
SOFTNESSES = tuple(float(one) for one in np.geomspace(0.05, 2.0, 17))
"""Softness a of most drives."""
OUTER_SOFTNESSES = (0.01, 0.017, 0.029, 2.5, 3.2, 4.0, 5.0, 6.3, 8.0, 10.0)
"""Softness a of very heavy drives, and of light drives with long lags. They are tried if none of `SOFTNESSES` keeps
the margins, or if the best ones are at an end of that range."""
FREQUENCY_FACTORS = (0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.15)
SHARES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7)
"""Compensated shares of J."""
SUPPOSED_BIT = BitFriction(2500.0, 5000.0, 2.5)
"""Bit of the reference case. It is used for the ranking only, if no bit is stated."""
_PHASES = (np.arange(48) + 0.5) * 2.0 * np.pi / 48
_SPEEDS = np.linspace(0.5, 14.0, 200)
"""Mean speeds, in Stribeck speeds."""


@dataclass(frozen=True)
class Candidate:
    """Gains, and the softness, frequency factor and compensated share from which they were computed."""

    softness: float
    frequency_factor: float
    share: float
    controller: SpeedController


def candidates(
    string: DrillString, inertia_kg_m2: float, mode_hz: float, shares: Sequence[float],
    softnesses: Sequence[float] = SOFTNESSES, factors: Sequence[float] = FREQUENCY_FACTORS,
) -> list[Candidate]:
    """Return the controllers at all points of the grid whose integral time is short enough for a search under noise."""
    longest_s = longest_integral_time_s(mode_hz)
    grid = [
        Candidate(softness, factor, share, gains(string, inertia_kg_m2, mode_hz, softness, factor, share))
        for share in shares for factor in factors for softness in softnesses
    ]
    return [one for one in grid if one.controller.integral_time_s <= longest_s]


def gains(
    string: DrillString, inertia_kg_m2: float, mode_hz: float, softness: float, factor: float, share: float = 0.0
) -> SpeedController:
    """Return the gains P = ζ/a, I = (φω)² (J − J_c), J_c = share · J."""
    left = (1.0 - share) * inertia_kg_m2
    return SpeedController(string.impedance_nm_s_rad / softness, (2.0 * pi * factor * mode_hz) ** 2 * left,
                           share * inertia_kg_m2)


def ranked_speeds(truths: Sequence[Truth], laws: Sequence[SpeedController]) -> Reals:
    """Return the estimated critical speeds, rad/s, as an array (laws, truths). Use them for ranking only."""
    found = np.empty((len(laws), len(truths)))
    for column, truth in enumerate(truths):
        string = truth.string
        bit = string.bit or SUPPOSED_BIT
        omega = bit_grid(string)
        s: Complex = np.asarray(1j * omega, dtype=np.complex128)
        chain = chain_of(string, s)
        low = omega < 1.6 * pi / string.echo_s      # the second mode with the top held is always above this
        for row, law in enumerate(laws):
            seen = bit_impedance(string, impedance(truth.drive, law, s), s, chain)
            slope = steepest_slope(omega[low], seen[low])
            found[row, column] = max(free_speed(bit, slope), linear_limit_rad_s(bit, steepest_slope(omega, seen)))
    return found


def free_speed(bit: BitFriction, slope_nm_s_rad: float) -> float:
    """Return the lowest mean speed Ω, rad/s, above which σ_e stays below ``slope_nm_s_rad`` for every amplitude."""
    falls = bit.static_nm - bit.coulomb_nm
    if falls <= 0.0:
        return 0.0
    above = np.flatnonzero(_slopes() > slope_nm_s_rad * bit.stribeck_speed_rad_s / falls)
    return float(_SPEEDS[above[-1]]) * bit.stribeck_speed_rad_s if above.size else 0.0


@cache
def _slopes() -> Reals:
    """Return the largest σ_e over all amplitudes up to the mean speed, for `_SPEEDS`, in units of (F_s − F_c)/ω_s."""
    shares = np.linspace(0.05, 1.0, 24)
    amplitude = _SPEEDS[:, None] * shares
    speed = _SPEEDS[:, None, None] + amplitude[:, :, None] * np.sin(_PHASES)
    mean = np.mean(np.exp(-(speed**2)) * np.sin(_PHASES), axis=2)
    found: Reals = np.max(-2.0 / amplitude * mean, axis=1)
    return found
