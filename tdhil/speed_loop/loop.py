r"""Open loop of a drive's speed controller, and its margins.

::

    L(s) = (P + I/s) · N(s) · H(s) · e^(−d s) · G(s)          H(s) = Π 1/(1 + τ_k s)

    rigid shaft    G = 1/(J s + B)
    two masses     G = (J_L s² + c s + k) / (J_r J_L s³ + ((J_r + J_L) c + B J_L) s² + ((J_r + J_L) k + B c) s + B k)
    notch          N = (s² + 2 ζ_z ω_n s + ω_n²) / (s² + 2 ζ_p ω_n s + ω_n²)

    J, J_r, J_L kg·m², B and P N·m·s/rad, I N·m/rad, k N·m/rad, c N·m·s/rad, τ and d s; all at the motor shaft.

Antiresonance ω_a and resonance ω_r describe the spring. The frequency response shows both directly:
k = J_r (ω_r² − ω_a²), J_L = k/ω_a².

**Margins.** The phase margin is the smallest distance of the phase from −180° where |L| = 1. The gain margin is the
smallest distance of |L| from 1, in dB and in both directions, where the phase is −180°. **Stability** follows from the
argument of 1 + L, which ends at 0 only if no pole has a positive real part (Nyquist's criterion). A loop that a
*lower* gain makes unstable is called conditionally stable: a torque limit lowers the gain for a while.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import log10, pi, sqrt

import numpy as np
from numpy.typing import NDArray

Reals = NDArray[np.float64]
Complexes = NDArray[np.complex128]

_POINTS_A_DECADE = 80
"""Number of points per decade of the common frequency grid."""
_AROUND = 100
"""Number of additional points around each resonance and antiresonance."""
_LOWEST, _HIGHEST = 2e-4, 30.0
"""Ends of the grid, in units of the reciprocal total lag. Below, only the integral acts; above, |L| is far below 1."""
_LEAST_LAG = 0.02
"""Smallest total lag that raises the upper end of the grid, as a share of the longest total lag."""
_BELOW_GAINS = 0.02
"""Lower end of the grid, in units of P/J and I/P."""


@dataclass(frozen=True)
class SpringLoad:
    """Load behind a spring, described by quantities of the motor's frequency response."""

    antiresonance_hz: float
    resonance_hz: float
    damping_nm_s_rad: float = 0.0
    """Damping c of the spring."""


@dataclass(frozen=True)
class LoopPlant:
    """Shaft and lags in the speed loop, at the motor shaft."""

    inertia_kg_m2: float
    """J of a rigid shaft, J_r of a shaft with a spring."""
    viscous_nm_s_rad: float = 0.0
    lags_s: tuple[float, ...] = ()
    """First-order lags inside the loop. The first is the filter of the measured speed; the others delay the torque."""
    dead_time_s: float = 0.0
    """Dead time of sampling and computation."""
    spring: SpringLoad | None = None

    @property
    def total_lag_s(self) -> float:
        """Total lag Στ, including the dead time."""
        return sum(self.lags_s) + self.dead_time_s

    @property
    def stiffness_nm_rad(self) -> float:
        """Stiffness k of the spring; 0 for a rigid shaft."""
        if self.spring is None:
            return 0.0
        return self.inertia_kg_m2 * (2.0 * pi) ** 2 * (self.spring.resonance_hz**2 - self.spring.antiresonance_hz**2)

    @property
    def load_kg_m2(self) -> float:
        """Inertia J_L of the load behind the spring; 0 for a rigid shaft."""
        if self.spring is None:
            return 0.0
        return self.stiffness_nm_rad / (2.0 * pi * self.spring.antiresonance_hz) ** 2

    @property
    def total_inertia_kg_m2(self) -> float:
        """Total inertia: J of a rigid shaft, J_r + J_L of a shaft with a spring."""
        return self.inertia_kg_m2 + self.load_kg_m2

    def shaft(self, s: Complexes) -> Complexes:
        """Return the shaft's transfer function G(s) = ω/T."""
        inertia, viscous, spring = self.inertia_kg_m2, self.viscous_nm_s_rad, self.spring
        if spring is None:
            return np.asarray(1.0 / (inertia * s + viscous), dtype=np.complex128)
        load, k, c = self.load_kg_m2, self.stiffness_nm_rad, spring.damping_nm_s_rad
        both = inertia + load
        under = (((inertia * load * s + both * c + viscous * load) * s + both * k + viscous * c) * s + viscous * k)
        return np.asarray(((load * s + c) * s + k) / under, dtype=np.complex128)

    def speed_filter(self, s: Complexes) -> Complexes:
        """Return the transfer function of the speed filter, which is the first lag."""
        return np.asarray(1.0 / (1.0 + (self.lags_s[0] if self.lags_s else 0.0) * s), dtype=np.complex128)

    def without_controller(self, s: Complexes) -> Complexes:
        """Return the open loop without controller, H(s) e^(−d s) G(s)."""
        through = self.shaft(s) * np.exp(-self.dead_time_s * s)
        for lag in self.lags_s:
            through = through / (1.0 + lag * s)
        return np.asarray(through, dtype=np.complex128)


@dataclass(frozen=True)
class NotchFilter:
    """Filter of the torque setpoint that lowers the gain around one frequency."""

    hertz: float
    numerator_damping: float
    """Numerator damping ζ_z."""
    denominator_damping: float
    """Denominator damping ζ_p. The gain at the centre frequency is ζ_z/ζ_p."""

    @property
    def depth_db(self) -> float:
        """Attenuation at the centre frequency, dB."""
        return 20.0 * log10(self.denominator_damping / self.numerator_damping)

    @property
    def width_hz(self) -> float | None:
        """Distance 2 f √(ζ_p² − 2 ζ_z²) between the frequencies of −3 dB, Hz; None: it is nowhere that deep."""
        square = self.denominator_damping**2 - 2.0 * self.numerator_damping**2
        return 2.0 * self.hertz * sqrt(square) if square > 0.0 else None

    def quantities(self) -> dict[str, float | None]:
        """Return the notch by each quantity that a drive's parameter may have (`profiles.NotchParameter.quantity`)."""
        return {"frequency_hz": self.hertz, "width_hz": self.width_hz, "depth_db": self.depth_db,
                "numerator_damping": self.numerator_damping, "denominator_damping": self.denominator_damping}

    def at(self, s: Complexes) -> Complexes:
        """Return the transfer function N(s)."""
        omega = 2.0 * pi * self.hertz
        over = s * s + 2.0 * self.numerator_damping * omega * s + omega**2
        return np.asarray(over / (s * s + 2.0 * self.denominator_damping * omega * s + omega**2), dtype=np.complex128)


@dataclass(frozen=True)
class PiGains:
    """Gains of the speed controller, at the motor shaft."""

    gain_nm_s_rad: float
    """Proportional gain P."""
    integral_nm_rad: float
    """Integral gain I."""
    notch: NotchFilter | None = None


@dataclass(frozen=True)
class SpeedLoopMargins:
    """Margins and bandwidth of one loop."""

    stable: bool
    phase_deg: float
    """Phase margin; infinite if |L| is nowhere 1."""
    gain_db: float
    """Gain margin; infinite if the phase is nowhere −180°."""
    bandwidth_hz: float
    """Frequency up to which the motor's speed follows the setpoint within 3 dB; 0 if it never does."""
    peak_sensitivity: float
    """Peak sensitivity M_s, the greatest |1/(1 + L)|."""
    conditional: bool
    """True if a lower gain makes the loop unstable."""

    def keeps(self, phase_deg: float, gain_db: float) -> bool:
        """Return whether the loop is stable, not conditionally stable, and has at least these margins."""
        return (self.stable and not self.conditional and self.phase_deg >= phase_deg and self.gain_db >= gain_db)


def frequency_grid(plants: Sequence[LoopPlant], slowest: PiGains | None = None) -> Reals:
    """Return angular frequencies, rad/s, that are sufficient for the margins of all these plants.

    ``slowest``: gains whose loop may be far slower than the lags.
    """
    lags = [plant.total_lag_s for plant in plants]
    low, high = _LOWEST / max(lags), _HIGHEST / max(min(lags), _LEAST_LAG * max(lags))
    if slowest is not None:
        total = max(plant.total_inertia_kg_m2 for plant in plants)
        gain, integral = slowest.gain_nm_s_rad, slowest.integral_nm_rad
        low = min(low, _BELOW_GAINS * gain / total, _BELOW_GAINS * integral / gain)
    marks = sorted({hertz for plant in plants if plant.spring is not None
                    for hertz in (plant.spring.antiresonance_hz, plant.spring.resonance_hz)})
    if marks:
        low, high = min(low, 0.02 * 2.0 * pi * marks[0]), max(high, 10.0 * 2.0 * pi * marks[-1])
    near = 1.0 + np.concatenate([-np.geomspace(0.3, 1e-4, _AROUND // 2), np.geomspace(1e-4, 0.3, _AROUND // 2)])
    points = round(_POINTS_A_DECADE * np.log10(high / low))
    parts = [np.geomspace(low, high, points), *(2.0 * pi * hertz * near for hertz in marks)]
    return np.unique(np.concatenate(parts))


def loop_response(plant: LoopPlant, gains: PiGains, omega_rad_s: Reals) -> Complexes:
    """Return the open loop L(jω)."""
    s: Complexes = np.asarray(1j * omega_rad_s, dtype=np.complex128)
    return controller_response(gains, s) * plant.without_controller(s)


def controller_response(gains: PiGains, s: Complexes) -> Complexes:
    """Return the controller's transfer function (P + I/s) N(s)."""
    found: Complexes = np.asarray(gains.gain_nm_s_rad + gains.integral_nm_rad / s, dtype=np.complex128)
    return found if gains.notch is None else found * gains.notch.at(s)


def speed_loop_margins(
    plants: Sequence[LoopPlant], gains: PiGains, omega_rad_s: Reals | None = None
) -> tuple[SpeedLoopMargins, ...]:
    """Return the margins of each plant with these gains."""
    omega = frequency_grid(plants, gains) if omega_rad_s is None else omega_rad_s
    filters = np.array([plant.speed_filter(np.asarray(1j * omega)) for plant in plants])
    return margins_of(np.array([loop_response(plant, gains, omega) for plant in plants]), filters, omega)


def margins_of(loops: Complexes, filters: Complexes, omega_rad_s: Reals) -> tuple[SpeedLoopMargins, ...]:
    """Return the margins of open loops (loop, frequency) on one grid, with linear interpolation between its points.

    ``filters``: the speed filter of each loop, which is in the feedback path.
    """
    log_gain = np.log(np.abs(loops))
    phase = np.unwrap(np.angle(loops), axis=1)
    phase -= 2.0 * pi * np.round((phase[:, :1] + 0.75 * pi) / (2.0 * pi))     # starts between −1.75π and 0.25π
    after = np.unwrap(np.angle(1.0 + loops), axis=1)
    after += 2.0 * pi * np.round((phase[:, :1] - after[:, :1]) / (2.0 * pi))   # 1 + L is as L where |L| is large
    stable = np.abs(after[:, -1]) < pi
    follows = np.log(np.abs(loops / (filters * (1.0 + loops)))) + 0.5 * np.log(2.0)
    peak = np.max(1.0 / np.abs(1.0 + loops), axis=1)
    above = (phase + pi) % (2.0 * pi)
    above = np.where(above > pi, above - 2.0 * pi, above)                      # distance from −180°, −π to π
    found = []
    for row in range(len(loops)):
        gains_at, share = _crossings(log_gain[row])
        distance = np.abs(above[row][gains_at] + share * (phase[row][gains_at + 1] - phase[row][gains_at]))
        ends, within = _crossings(follows[row])
        bandwidth = 0.0
        if ends.size:
            before, beyond = omega_rad_s[ends[0]], omega_rad_s[ends[0] + 1]
            bandwidth = float(before * (beyond / before) ** within[0]) / (2.0 * pi)
        near = np.abs(above[row]) < 0.5 * pi
        turned, part = _crossings(above[row])
        between = near[turned] & near[turned + 1]
        turned, part = turned[between], part[between]
        size = log_gain[row][turned] + part * (log_gain[row][turned + 1] - log_gain[row][turned])
        found.append(SpeedLoopMargins(
            bool(stable[row]),
            float(np.degrees(np.min(distance))) if distance.size else np.inf,
            float(20.0 / np.log(10.0) * np.min(np.abs(size))) if size.size else np.inf,
            bandwidth, float(peak[row]), bool(np.any(size > 0.0))))
    return tuple(found)


def _crossings(values: Reals) -> tuple[NDArray[np.int64], Reals]:
    """Return the index before each change of sign, and the crossing's share of the way to the next point."""
    at = np.flatnonzero((values[:-1] > 0.0) != (values[1:] > 0.0))
    share = values[at] / (values[at] - values[at + 1])
    return at, share
