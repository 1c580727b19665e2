r"""Impedance of a top drive under a speed controller, at the top of the string.

::

    Z(s) = J s + B + H(s) [P + I/s − J_c s/(1 + τ_c s)]            H(s) = Π 1/(1 + τ_k s)

    J kg·m², B and P N·m·s/rad, I N·m/rad, τ s; all at one shaft. At the motor: divide by i², i = ω_motor/ω_main.

**Derivation.** The drive turns at ω and the string takes τ from it: J dω/dt = T − Bω − τ. The controller is
told the set speed Ω and makes T = H [P (Ω − ω) + I ∫(Ω − ω) + J_c dω/dt]: the last term gives back part of what
accelerating the rotor takes, from a derivative that has to be filtered, by τ_c. With Ω at rest −τ/ω is Z. H holds the
lags *inside* the loop: speed filter, torque loop, sampling. What the drive reports to a bus is smoothed once
more, which is no part of it unless the loop is closed over that bus.

**Reflection.** A wave that comes up brings b = ζω − τ, and a = τ + ζω goes down again. With τ = −Zω that is
a = (ζ − Z) ω and b = (ζ + Z) ω: |r| = |a/b| = |Z − ζ|/|Z + ζ|, below 1 where Re Z > 0. At the angular frequency ω0 at
which I = ω0² (J − J_c), rotor and I cancel (H = 1) and Z = P + B, so that P = ζ/a gives r = (1 − a)/(1 + a).

**Passive at low frequency.** With H ≈ 1 − s Στ, Re Z(jω → 0) = P + B − I Στ: positive for Στ < (P + B)/I only. With the
tuned gains and without B that is a < ζ/(ω0² (J − J_c) Στ): softer than that, and the lags feed slow swings.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import atan, atan2, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from tdhil.soft_torque.drill_string import Complex, DrillString
from tdhil.soft_torque.roots import count_right_of, roots_in

DERIVATIVE_FILTER_S = 0.05
"""τ_c: a derivative of a measured speed needs a filter; the loop's own lags come on top."""


@dataclass(frozen=True)
class TopDrive:
    """The machine, at the main shaft."""

    inertia_kg_m2: float
    viscous_nm_s_rad: float = 0.0
    coulomb_nm: float = 0.0
    inner_lags_s: tuple[float, ...] = ()
    """First-order lags inside the speed loop."""

    @property
    def total_lag_s(self) -> float:
        """Στ."""
        return sum(self.inner_lags_s)

    def with_inertia(self, inertia_kg_m2: float) -> TopDrive:
        """The same with another J."""
        return replace(self, inertia_kg_m2=inertia_kg_m2)


@dataclass(frozen=True)
class SpeedController:
    """Gains, at the main shaft."""

    gain_nm_s_rad: float
    """P."""
    integral_nm_rad: float
    """I."""
    compensated_kg_m2: float = 0.0
    """J_c."""
    derivative_filter_s: float = DERIVATIVE_FILTER_S

    def at_shaft(self, ratio: float) -> SpeedController:
        """The gains at a shaft that turns ``ratio`` times as fast: all divided by ratio²."""
        square = ratio * ratio
        return replace(self, gain_nm_s_rad=self.gain_nm_s_rad / square, integral_nm_rad=self.integral_nm_rad / square,
                       compensated_kg_m2=self.compensated_kg_m2 / square)


def inner_lags(drive: TopDrive, s: Complex) -> Complex:
    """H(s)."""
    through = np.ones_like(np.asarray(s, dtype=np.complex128))
    for lag in drive.inner_lags_s:
        through = through / (1.0 + lag * s)
    return through


def control_law(controller: SpeedController, s: Complex) -> Complex:
    """P + I/s − J_c s/(1 + τ_c s)."""
    back = controller.compensated_kg_m2 * s / (1.0 + controller.derivative_filter_s * s)
    return controller.gain_nm_s_rad + controller.integral_nm_rad / s - back


def impedance(drive: TopDrive, controller: SpeedController, s: Complex) -> Complex:
    """Z(s), N·m·s/rad."""
    s = np.asarray(s, dtype=np.complex128)
    return drive.inertia_kg_m2 * s + drive.viscous_nm_s_rad + inner_lags(drive, s) * control_law(controller, s)


def reflection(impedance_nm_s_rad: Complex, string_nm_s_rad: float) -> Complex:
    """The share that goes back, (Z − ζ)/(Z + ζ)."""
    return (impedance_nm_s_rad - string_nm_s_rad) / (impedance_nm_s_rad + string_nm_s_rad)


def reflection_at(drive: TopDrive, controller: SpeedController, string: DrillString, hertz: NDArray[np.float64]
                  ) -> NDArray[np.float64]:
    """|r(f)| at the top of the string."""
    along = 2j * pi * np.asarray(hertz, dtype=float)
    return np.abs(reflection(impedance(drive, controller, along), string.impedance_nm_s_rad))


# ---------------------------------------------------------------------------------------------------------------------
# The whole: top drive and string as one. Z ω = −τ and τ = Z_s ω, so that motions of their own are where Z + Z_s = 0.
# Multiplied by every denominator there is, F(s) = s Π(1 + τ_k s) (1 + τ_c s) [Z ω_top + τ_top] is analytic everywhere,
# and its roots are the poles, with none added but those of numerator and denominator that cancel (none does).


@dataclass(frozen=True)
class NaturalMode:
    """One natural motion."""

    pole_rad_s: complex

    @property
    def frequency_hz(self) -> float:
        """|s|/2π."""
        return abs(self.pole_rad_s) / (2.0 * pi)

    @property
    def damping(self) -> float:
        """Damping ratio, −Re s/|s|; below 0: it grows."""
        return -self.pole_rad_s.real / abs(self.pole_rad_s)


@dataclass(frozen=True)
class ClosedSystem:
    """Top drive, controller and string; the string alone with its top held where ``controller`` is None."""

    string: DrillString
    drive: TopDrive | None = None
    controller: SpeedController | None = None
    stuck: bool = False
    """True: the bit is stuck. False: it turns."""

    def characteristic(self, s: Complex) -> Complex:
        """F(s), whose roots are the poles."""
        s = np.asarray(s, dtype=np.complex128)
        speed, torque = self.string.at_top(s, stuck=self.stuck)
        if self.drive is None or self.controller is None:
            return speed
        drive, controller = self.drive, self.controller
        lags = np.ones_like(s)
        for lag in drive.inner_lags_s:
            lags = lags * (1.0 + lag * s)
        filtered = (1.0 + controller.derivative_filter_s * s) if controller.compensated_kg_m2 else np.ones_like(s)
        law = ((controller.gain_nm_s_rad * s + controller.integral_nm_rad) * filtered
               - controller.compensated_kg_m2 * s * s)
        rotor = (drive.inertia_kg_m2 * s + drive.viscous_nm_s_rad) * speed + torque
        return lags * filtered * s * rotor + law * speed

    def modes(self, below_hz: float) -> tuple[NaturalMode, ...]:
        """Return every oscillating mode up to |s| = 2π ``below_hz``, by frequency; damping of up to 0.98."""
        reach = 2.0 * pi * below_hz
        found = roots_in(self.characteristic, complex(-reach, 0.02 * reach), complex(0.25 * reach, reach), self._pace)
        swinging = [NaturalMode(pole) for pole in found if abs(pole) <= reach]
        return tuple(sorted(swinging, key=lambda mode: mode.frequency_hz))

    def is_stable(self, up_to_rad_s: float | None = None) -> bool:
        """Return whether no pole lies right of the imaginary axis, up to ``up_to_rad_s`` (default `reach_rad_s`)."""
        reach = self.reach_rad_s() if up_to_rad_s is None else up_to_rad_s
        return count_right_of(self.characteristic, reach, self._pace, most=200.0 / self.string.echo_s) == 0

    @property
    def _pace(self) -> float:
        """A fiftieth of the distance between neighbouring modes, π/T."""
        return 2.0 * pi / (50.0 * self.string.echo_s)

    def reach_rad_s(self) -> float:
        """How far up the imaginary axis an unstable pole is looked for.

        Beyond it |controller's part of Z| ≤ P + I/ω + J_c ω/√(1 + (τ_c ω)²), behind the lags, is less than a twentieth
        of the rotor's J ω, and ζ less than a tenth: a wave comes back with at most 4 · 0.05/(0.9² · 10) = 2.5 % more
        energy than it brought, and falling; the mud takes more than that from any string that is long enough to stick
        (reference case: 10 % an echo).
        """
        assert self.drive is not None and self.controller is not None
        drive, controller = self.drive, self.controller
        omega = 8.0 / self.string.echo_s
        while omega < 2000.0:
            through = 1.0
            for lag in drive.inner_lags_s:
                through /= sqrt(1.0 + (lag * omega) ** 2)
            back = controller.compensated_kg_m2 * omega / sqrt(1.0 + (controller.derivative_filter_s * omega) ** 2)
            law = controller.gain_nm_s_rad + controller.integral_nm_rad / omega + back
            rotor = drive.inertia_kg_m2 * omega
            if through * law <= 0.05 * rotor and self.string.impedance_nm_s_rad <= 0.1 * rotor:
                break
            omega *= 1.25
        return omega


# ---------------------------------------------------------------------------------------------------------------------
# Margins of the drive's own loop, the string hanging on it: L = H·law/(J s + B + Z_s), cut at the torque.


@dataclass(frozen=True)
class Margins:
    """Margins of the loop of the bare drive."""

    phase_deg: float | None
    """Without a string, at the crossover; None: the gain is below 1 everywhere."""
    crossover_rad_s: float | None
    modulus: float
    """Least distance of L(jω) from −1, the string on it: 1 is nothing to fear, 0.5 a gain of 2 either way."""


def margins(drive: TopDrive, controller: SpeedController, string: DrillString | None) -> Margins:
    """Phase margin of the bare drive and least distance from −1 with the string on it."""
    omega = np.geomspace(1e-3, 3e3, 6000)
    s: Complex = np.asarray(1j * omega, dtype=np.complex128)
    law = inner_lags(drive, s) * control_law(controller, s)
    rotor = drive.inertia_kg_m2 * s + drive.viscous_nm_s_rad
    bare = law / rotor
    phase = crossover = None
    over = np.flatnonzero((np.abs(bare[:-1]) >= 1.0) & (np.abs(bare[1:]) < 1.0))
    if over.size:
        k = int(over[-1])
        share = np.log(np.abs(bare[k])) / np.log(np.abs(bare[k]) / np.abs(bare[k + 1]))
        crossover = float(omega[k] * (omega[k + 1] / omega[k]) ** share)
        at = np.array([1j * crossover], dtype=np.complex128)
        rotor_at = drive.inertia_kg_m2 * at + drive.viscous_nm_s_rad
        loop = inner_lags(drive, at) * control_law(controller, at) / rotor_at
        phase = (float(np.degrees(np.angle(-loop[0]))) + 180.0) % 360.0 - 180.0
    whole = bare if string is None else law / (rotor + string.impedance_at(s))
    return Margins(phase, crossover, float(np.min(np.abs(1.0 + whole))))


def phase_lag_rad(drive: TopDrive, omega: float) -> float:
    """Return the phase lag of H at ``omega``, rad."""
    return sum(atan(lag * omega) for lag in drive.inner_lags_s)


def stiff_controller(drive: TopDrive, phase_margin_deg: float, integral_share: float = 0.1) -> SpeedController:
    """The stiffest PI that keeps the phase margin, I/P = ω_c/10: what a drive's own commissioning aims at.

    Phase of the loop at ω_c: −90° + arctan(B/(J ω_c)) − arctan(0.1) − Σ arctan(τ_k ω_c) = −180° + margin; it falls with
    ω_c, so that bisection finds it. P from |L| = 1. Raises ValueError where no lag limits it.
    """
    if drive.total_lag_s <= 0.0:
        raise ValueError("with no lag inside the loop there is no stiffest controller")
    wanted = phase_margin_deg * pi / 180.0

    def margin(omega: float) -> float:
        rotor = atan2(drive.inertia_kg_m2 * omega, drive.viscous_nm_s_rad)
        return pi - rotor - atan(integral_share) - phase_lag_rad(drive, omega)

    low, high = 1e-6 / drive.total_lag_s, 10.0 / drive.total_lag_s
    if not margin(low) > wanted > margin(high):
        raise ValueError(f"no speed loop behind {drive.total_lag_s:g} s has a phase margin of {phase_margin_deg:g}°")
    for _ in range(200):
        middle = sqrt(low * high)
        low, high = (middle, high) if margin(middle) > wanted else (low, middle)
    omega = sqrt(low * high)
    through = 1.0
    for lag in drive.inner_lags_s:
        through /= sqrt(1.0 + (lag * omega) ** 2)
    rotor = sqrt((drive.inertia_kg_m2 * omega) ** 2 + drive.viscous_nm_s_rad**2)
    gain = rotor / (through * sqrt(1.0 + integral_share**2))
    return SpeedController(gain, integral_share * omega * gain)


def tuned_controller(
    string: DrillString, inertia_kg_m2: float, softness: float, mode_hz: float, compensated_share: float = 0.0,
    derivative_filter_s: float = DERIVATIVE_FILTER_S,
) -> SpeedController:
    """P = ζ/a, I = ω² (J − J_c), for the J that is believed; ``softness`` is a."""
    compensated = compensated_share * inertia_kg_m2
    integral = (2.0 * pi * mode_hz) ** 2 * (inertia_kg_m2 - compensated)
    return SpeedController(string.impedance_nm_s_rad / softness, integral, compensated, derivative_filter_s)


def softest_allowed(string: DrillString, drive: TopDrive, mode_hz: float, compensated_share: float = 0.0) -> float:
    """ζ/(ω² (J − J_c) Στ): a beyond it makes Re Z negative at low frequencies; infinite without lags."""
    integral = (2.0 * pi * mode_hz) ** 2 * drive.inertia_kg_m2 * (1.0 - compensated_share)
    lag = drive.total_lag_s
    return string.impedance_nm_s_rad / (integral * lag) if lag * integral > 0.0 else float("inf")
