r"""Margins, reserves and the linear stability limit: every number is a crossing of a frequency response.

::

    L = H·law/(J s + B + Z_s)        the drive's loop, cut at its torque, with the string on it

**Phase and gain margin.** All crossings count: at each ω with |L| = 1 the angle between L and −1, at each ω with
Im L = 0 and Re L < 0 the factor −1/Re L. A string makes many crossings, and the least of them is the margin. The bit
turns in one response and is stuck in the other; the smaller margin is reported. (Textbook definitions: K. J. Åström
and R. M. Murray, Feedback Systems, section 10.3.)

**Dead-time reserve.** With one more dead time T the loop is L e^(−sT). A pole is on the imaginary axis where
L(jω) e^(−jωT) = −1: |L| = 1 and T = (π + arg L mod 2π)/ω. The smallest T of all crossings is the reserve, if the loop
is stable without it. The loop may be stable again for a larger T; that is no reserve.

**Lag reserve.** With one more first-order lag τ a pole is on the axis where L/(1 + jωτ) = −1: Re L = −1 and
τ = −Im L/ω > 0. Again the smallest counts.

**Linear stability limit.** The bit's friction falls with its speed: at the mean speed Ω its slope is −σ(Ω). Seen from
the bit, pipe and top drive are an impedance Z_b(s), its own inertia and viscous friction included. A pole is on the
axis where Z_b(jω) = σ: Im Z_b = 0 and σ = Re Z_b. The smallest positive one is the steepest slope that the whole
bears; steady rotation is unstable at the mean speeds at which the bit's own slope is steeper.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, log, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from tdhil.soft_torque.controller import (
    SpeedController,
    TopDrive,
    control_law,
    impedance,
    inner_lags,
)
from tdhil.soft_torque.drill_string import BitFriction, Complex, DrillString

Reals = NDArray[np.float64]

LOWEST_RAD_S = 1e-3
STEPS_PER_MODE = 60
"""Frequencies between neighbouring modes of the string, π/T apart."""
STEPS_PER_WIDTH = 3
"""Frequencies within the half-width of a resonance, d/(2 m) rad/s."""
MOST_FREQUENCIES = 30_000
REFINEMENT, NEAR = 24, 1.5
LEAST_GAIN = 0.2
"""|L| below which no margin of interest is left (14 dB); beyond the last frequency with more nothing is looked at."""


@dataclass(frozen=True)
class LoopMargins:
    """Distance of one loop from instability, the string on it, for a bit that turns and one that is stuck."""

    stable: bool
    phase_deg: float
    """Least over all crossings; 0 where the loop is unstable."""
    gain_db: float
    """Least factor on L, up or down, in dB; 0 where the loop is unstable."""
    dead_time_s: float
    """Smallest further dead time that destabilises; infinite: none does."""
    lag_s: float
    """Smallest further first-order lag that destabilises; infinite: none does."""
    modulus: float
    """Least distance of L(jω) from −1."""


@dataclass(frozen=True)
class RequiredMargins:
    """Margins that every sampled case has to keep."""

    phase_deg: float = 30.0
    gain_db: float = 6.0
    dead_time_s: float = 0.02
    """Ten control periods of 2 ms."""

    def failed(self, margins: LoopMargins) -> tuple[str, ...]:
        """Return what is thin, each with its number and the limit; () if nothing is."""
        if not margins.stable:
            return ("unstable",)
        found = []
        if margins.phase_deg < self.phase_deg:
            found.append(f"phase margin {margins.phase_deg:.0f}° (limit {self.phase_deg:.0f}°)")
        if margins.gain_db < self.gain_db:
            found.append(f"gain margin {margins.gain_db:.1f} dB (limit {self.gain_db:g} dB)")
        if margins.dead_time_s < self.dead_time_s:
            found.append(f"dead-time reserve {1e3 * margins.dead_time_s:.0f} ms (limit {1e3 * self.dead_time_s:.0f} "
                         "ms)")
        return tuple(found)


USUAL_MARGINS = RequiredMargins()
NO_MARGINS = RequiredMargins(0.0, 0.0, 0.0)
"""Stability alone."""


def least_of(every: Sequence[LoopMargins]) -> LoopMargins:
    """Return the least of each margin; unstable if one is."""
    return LoopMargins(all(one.stable for one in every), *(
        min(getattr(one, name) for one in every)
        for name in ("phase_deg", "gain_db", "dead_time_s", "lag_s", "modulus")))


@dataclass(frozen=True)
class StringResponse:
    """Z_s of one string over one grid of frequencies, for a bit that turns and one that is stuck."""

    string: DrillString
    omega_rad_s: Reals
    turning: Complex
    stuck: Complex


def response_of(string: DrillString, highest_rad_s: float) -> StringResponse:
    """Return Z_s on a grid that resolves every resonance of the string up to ``highest_rad_s``."""
    omega = _grid(string, highest_rad_s)
    s: Complex = np.asarray(1j * omega, dtype=np.complex128)
    return StringResponse(string, omega, string.impedance_at(s), string.impedance_at(s, stuck=True))


def _grid(string: DrillString, highest_rad_s: float) -> Reals:
    spacing = 2.0 * pi / string.echo_s
    widths = [line.drag_nm_s_rad_m / (2.0 * line.inertia_kg_m) for line in string.lines]
    step = spacing / STEPS_PER_MODE
    if min(widths) > 0.0:
        step = min(step, min(widths) / STEPS_PER_WIDTH)
    step = max(step, highest_rad_s / MOST_FREQUENCIES)
    low = np.geomspace(LOWEST_RAD_S, 10.0 * step, 60, endpoint=False)
    return np.concatenate([low, np.arange(10.0 * step, highest_rad_s, step)])


def highest_crossover(drive: TopDrive, law: SpeedController) -> float:
    """Return the frequency, rad/s, above which |L| of the bare drive stays below half of `LEAST_GAIN`.

    The string's own impedance adds to the rotor's: near an antiresonance it may cancel a part of Jω, no more than
    (the factor of two) half of it at such frequencies.
    """
    omega = np.geomspace(0.05, 3e3, 2000)
    s: Complex = np.asarray(1j * omega, dtype=np.complex128)
    bare = np.abs(inner_lags(drive, s) * control_law(law, s) / (drive.inertia_kg_m2 * s))
    above = np.flatnonzero(bare > 0.5 * LEAST_GAIN)
    return float(omega[min(above[-1] + 1, omega.size - 1)]) if above.size else 1.0


def loop_margins(
    drive: TopDrive, law: SpeedController, string: DrillString, response: StringResponse | None = None,
    stuck: bool = True, exact: bool = False,
) -> LoopMargins:
    """Return the margins of the loop.

    ``response``: Z_s of that string, worked out before. ``stuck`` False leaves the stuck bit out. ``exact``: reserves
    to a fraction of a millisecond, on a grid that is refined wherever |L| is near 1.
    """
    top = highest_crossover(drive, law)
    if response is None or response.omega_rad_s[-1] < 0.98 * top:
        response = response_of(string, top)
    omega = response.omega_rad_s
    s: Complex = np.asarray(1j * omega, dtype=np.complex128)
    through = inner_lags(drive, s) * control_law(law, s)
    rotor = drive.inertia_kg_m2 * s + drive.viscous_nm_s_rad
    least = [inf, inf, inf, inf, inf]
    stable = True
    loads = ((False, response.turning), (True, response.stuck))
    for is_stuck, load in loads if stuck else loads[:1]:
        loop = through / (rotor + load)
        stable = stable and _encircles_nothing(loop)
        found = _crossings(omega, loop)
        if exact:
            near = _refined(omega, np.log(np.abs(loop)))
            fine: Complex = np.asarray(1j * near, dtype=np.complex128)
            own = inner_lags(drive, fine) * control_law(law, fine) / (
                drive.inertia_kg_m2 * fine + drive.viscous_nm_s_rad + string.impedance_at(fine, stuck=is_stuck))
            found = _crossings(near, own)
        least = [min(pair) for pair in zip(least, found, strict=True)]
    if not stable:
        return LoopMargins(False, 0.0, 0.0, 0.0, 0.0, least[4])
    return LoopMargins(True, *least)


def _refined(omega: Reals, size: Reals) -> Reals:
    """The grid with `REFINEMENT` steps for one wherever |L| is within `NEAR` (natural logarithm) of 1."""
    near = np.flatnonzero(np.minimum(np.abs(size[:-1]), np.abs(size[1:])) < NEAR)
    parts = np.arange(1, REFINEMENT) / REFINEMENT
    between = omega[near, None] + (omega[near + 1] - omega[near])[:, None] * parts
    merged: Reals = np.sort(np.concatenate([omega, between.ravel()]))
    return merged


def _encircles_nothing(loop: Complex) -> bool:
    """Nyquist: rotor and string are passive, so that L has no pole on the right and may not encircle −1.

    The phase of 1 + L begins between −180° and 0 (L has at most one pole at the origin that isn't balanced by losses),
    and ends at 0 if nothing was encircled, at a multiple of 360° else.
    """
    end = float(np.unwrap(np.angle(1.0 + loop))[-1])
    return abs(end) < 0.5 * pi


def is_stable(string: DrillString, drive: TopDrive, law: SpeedController) -> bool:
    """Return whether the closed system, with a turning bit, has no pole right of the imaginary axis or on it."""
    return loop_margins(drive, law, string, stuck=False).stable


def _crossings(omega: Reals, loop: Complex) -> tuple[float, float, float, float, float]:
    """(phase margin °, gain margin dB, dead time s, lag s, least |1 + L|), each the least of all crossings."""
    size = np.log(np.abs(loop))
    at, share = _zeros(size)
    phase = dead = inf
    if at.size:
        omega_at = omega[at] + share * (omega[at + 1] - omega[at])
        angle = np.angle(-_between(loop, at, share))
        phase = float(np.degrees(np.min(np.abs(angle))))
        # a crossing with the phase just above −180° bears little dead time, one just below nearly a whole turn
        dead = float(np.min(np.mod(angle, 2.0 * pi) / omega_at))
    gain = inf
    at, share = _zeros(loop.imag)
    if at.size:
        real = _between(loop, at, share).real
        real = real[real < 0.0]
        if real.size:
            gain = float(np.min(np.abs(20.0 * np.log10(-real))))
    lag = inf
    at, share = _zeros(loop.real + 1.0)
    if at.size:
        value = _between(loop, at, share)
        tau = -value.imag / (omega[at] + share * (omega[at + 1] - omega[at]))
        tau = tau[tau > 0.0]
        lag = float(tau.min()) if tau.size else inf
    return phase, gain, dead, lag, float(np.min(np.abs(1.0 + loop)))


def _zeros(values: Reals) -> tuple[NDArray[np.int64], Reals]:
    """Indices before each change of sign, and the share of the step at which it is."""
    at = np.flatnonzero((values[:-1] < 0.0) != (values[1:] < 0.0))
    span = values[at] - values[at + 1]
    return at, values[at] / np.where(span == 0.0, 1.0, span)


def _between(values: Complex, at: NDArray[np.int64], share: Reals) -> Complex:
    mixed: Complex = values[at] + share * (values[at + 1] - values[at])
    return mixed


# ---------------------------------------------------------------------------------------------------------------------
# From the bit.


def bit_impedance(
    string: DrillString, top_impedance: Complex, s: Complex, through: tuple[Complex, ...] | None = None
) -> Complex:
    """Return Z_b(s): what the bit's dry friction works on; N·m·s/rad.

    ``top_impedance``: Z(s) of top drive and controller. ``through``: the string's matrix, worked out before.
    """
    cosh_down, series, shunt, cosh_up = chain_of(string, s) if through is None else through
    # τ_top = −Z ω_top, with the speed at the bit 1: ω_top = A + Bτ, τ_top = C + Dτ
    torque = -(shunt + top_impedance * cosh_down) / (cosh_up + top_impedance * series)
    return s * string.bottom_inertia_kg_m2 + string.bottom_viscous_nm_s_rad - torque


def chain_of(string: DrillString, s: Complex) -> tuple[Complex, Complex, Complex, Complex]:
    """Return (A, B, C, D) with ω_top = A ω + B τ and τ_top = C ω + D τ of the bit's end; determinant 1."""
    free = _column(string, s, 1.0, 0.0)
    held = _column(string, s, 0.0, 1.0)
    return free[0], held[0], free[1], held[1]


def _column(string: DrillString, s: Complex, speed: float, torque: float) -> tuple[Complex, Complex]:
    return string.carried_up(s, np.full_like(s, speed), np.full_like(s, torque))


def steepest_slope(omega: Reals, from_bit: Complex) -> float:
    """Return the smallest σ, N·m·s/rad, at which a falling bit friction of slope −σ destabilises; infinite: none."""
    at, share = _zeros(from_bit.imag)
    if not at.size:
        return inf
    real = _between(from_bit, at, share).real
    real = real[real > 0.0]
    return float(real.min()) if real.size else inf


def bit_grid(string: DrillString) -> Reals:
    """Frequencies, rad/s, over which a bit is looked at from: its lowest four modes, and finer at the lowest."""
    mode = pi / string.echo_s
    return np.concatenate([np.geomspace(0.02 * mode, mode, 160, endpoint=False), np.arange(mode, 8.0 * mode,
                                                                                       mode / 40.0)])


def linear_limit_rad_s(bit: BitFriction, slope_nm_s_rad: float) -> float:
    """Return the mean speed above which the bit's slope is less steep than that; 0: it never is as steep.

    The slope of the Gaussian Stribeck law is 2 (F_s − F_c) Ω/ω_s² e^−(Ω/ω_s)², steepest at Ω = ω_s/√2, and falls
    beyond.
    """
    falls, width = bit.static_nm - bit.coulomb_nm, bit.stribeck_speed_rad_s
    if falls <= 0.0 or slope_nm_s_rad == inf:
        return 0.0
    wanted = slope_nm_s_rad * width / (2.0 * falls)

    def excess(x: float) -> float:
        return log(x) - x * x - log(max(wanted, 1e-300))

    low, high = 1.0 / sqrt(2.0), 30.0
    if excess(low) <= 0.0:
        return 0.0
    for _ in range(80):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if excess(middle) > 0.0 else (low, middle)
    return low * width


def linear_limit(string: DrillString, drive: TopDrive, law: SpeedController) -> float:
    """Return the linear stability limit, rad/s at the top: below it steady rotation is unstable.

    Raises ValueError where no bit is stated.
    """
    if string.bit is None:
        raise ValueError("no bit is stated")
    omega = bit_grid(string)
    s: Complex = np.asarray(1j * omega, dtype=np.complex128)
    slope = steepest_slope(omega, bit_impedance(string, impedance(drive, law, s), s))
    return linear_limit_rad_s(string.bit, slope)
