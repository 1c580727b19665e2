r"""Impedance of a top drive under a speed controller, at the top of the string.

::

    Z(s) = J s + B + H(s) [P + I/s − J_c s/(1 + τ_c s)]            H(s) = Π 1/(1 + τ_k s)

    J kg·m², B and P N·m·s/rad, I N·m/rad, τ s; all at one shaft. At the motor: divide by i², i = ω_motor/ω_main.

**Derivation.** The drive turns at ω, and the string takes the torque τ from it: J dω/dt = T − Bω − τ. From the set
speed Ω the controller makes T = H [P (Ω − ω) + I ∫(Ω − ω) + J_c dω/dt]. The last term compensates part of the torque
that accelerates the rotor. It uses a derivative, which needs the filter τ_c. For a constant Ω, Z = −τ/ω. H contains
the lags *inside* the loop: speed filter, torque loop, sampling. The values that the drive reports over a bus are
filtered once more. That filter is not part of H, unless the loop is closed over the bus.

**Reflection.** The wave b = ζω − τ comes up, and the wave a = τ + ζω goes down. With τ = −Zω, a = (ζ − Z) ω and
b = (ζ + Z) ω. So |r| = |a/b| = |Z − ζ|/|Z + ζ|, which is below 1 if Re Z > 0. At the angular frequency ω0 with
I = ω0² (J − J_c), rotor and integral cancel (H = 1), and Z = P + B. Therefore P = ζ/a gives r = (1 − a)/(1 + a).

**Passive at low frequency.** With H ≈ 1 − s Στ, Re Z(jω → 0) = P + B − I Στ. It is positive only if Στ < (P + B)/I.
With the tuned gains and without B this means a < ζ/(ω0² (J − J_c) Στ). With a softer controller, the lags put energy
into slow oscillations.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import atan, atan2, inf, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from tdhil.soft_torque.drill_string import Complex, DrillString
from tdhil.soft_torque.roots import count_right_of, roots_in

DERIVATIVE_FILTER_S = 0.05
"""Time constant τ_c, s, of the filter for the derivative of the measured speed. The loop's own lags are added to it."""


@dataclass(frozen=True)
class TopDrive:
    """Inertia, friction and lags of the top drive, at the main shaft."""

    inertia_kg_m2: float
    viscous_nm_s_rad: float = 0.0
    coulomb_nm: float = 0.0
    inner_lags_s: tuple[float, ...] = ()
    """Time constants of the first-order lags inside the speed loop."""

    @property
    def total_lag_s(self) -> float:
        """Sum of the lags Στ, s."""
        return sum(self.inner_lags_s)

    def with_inertia(self, inertia_kg_m2: float) -> TopDrive:
        """Return this drive with another J."""
        return replace(self, inertia_kg_m2=inertia_kg_m2)


@dataclass(frozen=True)
class SpeedController:
    """Gains of the speed controller, at the main shaft."""

    gain_nm_s_rad: float
    """Proportional gain P."""
    integral_nm_rad: float
    """Integral gain I."""
    compensated_kg_m2: float = 0.0
    """Compensated inertia J_c."""
    derivative_filter_s: float = DERIVATIVE_FILTER_S

    @property
    def integral_time_s(self) -> float:
        """Return the integral time Tn = P/I, s; infinite without integral action."""
        return self.gain_nm_s_rad / self.integral_nm_rad if self.integral_nm_rad > 0.0 else inf

    def at_shaft(self, ratio: float) -> SpeedController:
        """Return the gains at a shaft that turns ``ratio`` times as fast: all are divided by ratio²."""
        square = ratio * ratio
        return replace(self, gain_nm_s_rad=self.gain_nm_s_rad / square, integral_nm_rad=self.integral_nm_rad / square,
                       compensated_kg_m2=self.compensated_kg_m2 / square)


def inner_lags(drive: TopDrive, s: Complex) -> Complex:
    """Return H(s), the frequency response of all lags inside the loop."""
    through = np.ones_like(np.asarray(s, dtype=np.complex128))
    for lag in drive.inner_lags_s:
        through = through / (1.0 + lag * s)
    return through


def control_law(controller: SpeedController, s: Complex) -> Complex:
    """Return P + I/s − J_c s/(1 + τ_c s), the controller without lags, N·m·s/rad."""
    back = controller.compensated_kg_m2 * s / (1.0 + controller.derivative_filter_s * s)
    return controller.gain_nm_s_rad + controller.integral_nm_rad / s - back


def impedance(drive: TopDrive, controller: SpeedController, s: Complex) -> Complex:
    """Return the impedance Z(s) of the top drive under its controller, N·m·s/rad."""
    s = np.asarray(s, dtype=np.complex128)
    return drive.inertia_kg_m2 * s + drive.viscous_nm_s_rad + inner_lags(drive, s) * control_law(controller, s)


def reflection(impedance_nm_s_rad: Complex, string_nm_s_rad: float) -> Complex:
    """Return the reflection coefficient (Z − ζ)/(Z + ζ)."""
    return (impedance_nm_s_rad - string_nm_s_rad) / (impedance_nm_s_rad + string_nm_s_rad)


def reflection_at(drive: TopDrive, controller: SpeedController, string: DrillString, hertz: NDArray[np.float64]
                  ) -> NDArray[np.float64]:
    """Return the magnitude |r(f)| of the reflection coefficient at the top of the string."""
    along = 2j * pi * np.asarray(hertz, dtype=float)
    return np.abs(reflection(impedance(drive, controller, along), string.impedance_nm_s_rad))


# ---------------------------------------------------------------------------------------------------------------------
# Closed system of top drive and string. Z ω = −τ and τ = Z_s ω, so the poles are the roots of Z + Z_s = 0.
# F(s) = s Π(1 + τ_k s) (1 + τ_c s) [Z ω_top + τ_top] is this sum multiplied by every denominator. It is analytic
# everywhere, and its roots are the poles. A root that is not a pole would need a numerator and a denominator that
# cancel; none do.


@dataclass(frozen=True)
class NaturalMode:
    """One natural mode: a pole of the closed system."""

    pole_rad_s: complex

    @property
    def frequency_hz(self) -> float:
        """Natural frequency |s|/2π, Hz."""
        return abs(self.pole_rad_s) / (2.0 * pi)

    @property
    def damping(self) -> float:
        """Damping ratio −Re s/|s|. Below 0 the oscillation grows."""
        return -self.pole_rad_s.real / abs(self.pole_rad_s)


@dataclass(frozen=True)
class ClosedSystem:
    """Closed system of top drive, controller and string. If ``controller`` is None: the string with its top held."""

    string: DrillString
    drive: TopDrive | None = None
    controller: SpeedController | None = None
    stuck: bool = False
    """True: the bit is stuck. False: it turns."""

    def characteristic(self, s: Complex) -> Complex:
        """Return the characteristic function F(s), whose roots are the poles."""
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
        """Return all oscillating modes up to ``below_hz`` with a damping ratio of up to 0.98, sorted by frequency."""
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
        """Step of the search for roots, rad/s: a fiftieth of the distance π/T between neighbouring modes."""
        return 2.0 * pi / (50.0 * self.string.echo_s)

    def reach_rad_s(self) -> float:
        """Return the highest frequency, rad/s, up to which unstable poles are searched.

        Above it the controller's part of Z, |Z_c| ≤ P + I/ω + J_c ω/√(1 + (τ_c ω)²) behind the lags, is less than a
        twentieth of the rotor's J ω, and ζ is less than a tenth of it. A reflected wave then has at most
        4 · 0.05/(0.9² · 10) = 2.5 % more energy than the arriving one, and less at higher frequencies. In any string
        that is long enough for stick-slip, the mud takes more energy than that (reference case: 10 % an echo).
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
# Margins of the drive's speed loop with the string coupled: L = H·law/(J s + B + Z_s), opened at the torque.


@dataclass(frozen=True)
class Margins:
    """Margins of the speed loop: phase of the bare drive, modulus with the string coupled."""

    phase_deg: float | None
    """Phase margin without a string, at the crossover. None: the gain is below 1 everywhere."""
    crossover_rad_s: float | None
    modulus: float
    """Least distance of L(jω) from −1 with the string coupled (modulus margin). 1 is ample. 0.5 allows a gain factor
    of 2, up or down."""


def margins(drive: TopDrive, controller: SpeedController, string: DrillString | None) -> Margins:
    """Return the phase margin of the bare drive, and the least distance from −1 with the string coupled."""
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
    """Return the stiffest PI controller that keeps the phase margin, with I/P = ω_c/10.

    The usual commissioning of a drive aims at such a controller. Phase of the loop at the crossover ω_c:
    −90° + arctan(B/(J ω_c)) − arctan(0.1) − Σ arctan(τ_k ω_c) = −180° + margin. The phase falls with ω_c, so bisection
    finds ω_c. P follows from |L| = 1. Raises ValueError if no lag limits the gain, or if no gain has this margin.
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
    """Return P = ζ/a, I = ω² (J − J_c) for the estimated J. ``softness`` is a."""
    compensated = compensated_share * inertia_kg_m2
    integral = (2.0 * pi * mode_hz) ** 2 * (inertia_kg_m2 - compensated)
    return SpeedController(string.impedance_nm_s_rad / softness, integral, compensated, derivative_filter_s)


def softest_allowed(string: DrillString, drive: TopDrive, mode_hz: float, compensated_share: float = 0.0) -> float:
    """Return ζ/(ω² (J − J_c) Στ). A larger a makes Re Z negative at low frequencies. Infinite without lags."""
    integral = (2.0 * pi * mode_hz) ** 2 * drive.inertia_kg_m2 * (1.0 - compensated_share)
    lag = drive.total_lag_s
    return string.impedance_nm_s_rad / (integral * lag) if lag * integral > 0.0 else float("inf")
