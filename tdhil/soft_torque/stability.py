r"""Margins, reserves and the linear stability limit. Each is computed from crossings of a frequency response.

::

    L = H·law/(J s + B + Z_s)        the drive's loop, opened at its torque, with the string coupled

**Phase and gain margin.** All crossings count. At each ω with |L| = 1, the phase margin is the angle between L and −1.
At each ω with Im L = 0 and Re L < 0, the gain margin is the factor −1/Re L. A string makes many crossings, and the
least value is the margin. The bit turns in one response and is stuck in the other; the smaller margin is reported.
(Textbook definitions: K. J. Åström and R. M. Murray, Feedback Systems, section 10.3.)

**Dead-time reserve.** With one more dead time T the loop is L e^(−sT). A pole is on the imaginary axis where
L(jω) e^(−jωT) = −1: |L| = 1 and T = (π + arg L mod 2π)/ω. The smallest T of all crossings is the reserve, if the loop
is stable without it. The loop may be stable again for a larger T; that is no reserve.

**Lag reserve.** With one more first-order lag τ a pole is on the axis where L/(1 + jωτ) = −1: Re L = −1 and
τ = −Im L/ω > 0. Again the smallest counts.

**Linear stability limit.** The bit's friction falls with its speed: at the mean speed Ω its slope is −σ(Ω). The load of
the bit is an impedance Z_b(s) of pipe and top drive, with the inertia and viscous friction of the bit included. A pole
is on the imaginary axis where Z_b(jω) = σ, that is Im Z_b = 0 and σ = Re Z_b. The smallest positive σ is the steepest
slope for which the system is stable. Steady rotation is unstable at the mean speeds at which the bit's slope is
steeper.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, log, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from tdhil.soft_torque.controller import SpeedController, TopDrive, control_law, impedance, inner_lags
from tdhil.soft_torque.crossover import highest_crossover
from tdhil.soft_torque.drill_string import BitFriction, Complex, DrillString

Reals = NDArray[np.float64]
Points = NDArray[np.int64]
"""Numbers of points of a grid of frequencies."""

LOWEST_RAD_S = 1e-3
STEPS_PER_MODE = 60
"""Number of frequencies between neighbouring modes of the string, which are π/T apart."""
STEPS_PER_WIDTH = 3
"""Number of frequencies within the half-width of a resonance, d/(2 m) rad/s."""
MOST_FREQUENCIES = 30_000
LOW_FREQUENCIES = 60
"""Number of frequencies below the even part of the grid."""
COARSER, LEAST_COARSE = 8, 200
"""Ratio of the steps of two successive grids, and least number of steps of the coarsest one."""
REFINEMENT, NEAR = 24, 1.5
"""Steps into which a step of the grid is divided, and the range |ln |L|| in which this is done."""

@dataclass(frozen=True)
class LoopMargins:
    """Stability margins of one loop with the string coupled: the smaller ones of a turning and a stuck bit."""

    stable: bool
    phase_deg: float
    """Phase margin: the least over all crossings. 0: the loop is unstable."""
    gain_db: float
    """Gain margin, dB: the least factor on L, up or down, that makes the loop unstable. 0: the loop is unstable."""
    dead_time_s: float
    """Smallest additional dead time that makes the loop unstable. Infinite: none does."""
    lag_s: float
    """Time constant of the smallest additional first-order lag that makes the loop unstable. Infinite: none does."""
    modulus: float
    """Least distance of L(jω) from −1."""


@dataclass(frozen=True)
class RequiredMargins:
    """Margins that the loop must have on every sampled truth."""

    phase_deg: float = 30.0
    gain_db: float = 6.0
    dead_time_s: float = 0.02
    """Dead-time reserve: ten control periods of 2 ms."""

    def failed(self, margins: LoopMargins) -> tuple[str, ...]:
        """Return a text with value and limit for each margin that is too small; () if none is."""
        if not margins.stable:
            return ("unstable",)
        found = []
        if margins.phase_deg < self.phase_deg:
            found.append(f"phase margin {below(margins.phase_deg, self.phase_deg, 0)}° (limit {self.phase_deg:g}°)")
        if margins.gain_db < self.gain_db:
            found.append(f"gain margin {below(margins.gain_db, self.gain_db, 1)} dB (limit {self.gain_db:g} dB)")
        if margins.dead_time_s < self.dead_time_s:
            value_ms, limit_ms = 1e3 * margins.dead_time_s, 1e3 * self.dead_time_s
            found.append(f"dead-time reserve {below(value_ms, limit_ms, 0)} ms (limit {limit_ms:g} ms)")
        return tuple(found)


def below(value: float, limit: float, digits: int) -> str:
    """Return a value with at least this number of decimals, and with more if it would print as its upper limit."""
    while digits < 6 and value < limit <= float(f"{value:.{digits}f}"):
        digits += 1
    return f"{value:.{digits}f}"


USUAL_MARGINS = RequiredMargins()
NO_MARGINS = RequiredMargins(0.0, 0.0, 0.0)
"""Required margins of zero: only stability is required."""


def least_of(every: Sequence[LoopMargins]) -> LoopMargins:
    """Return the least of each margin. The result is unstable if any loop is."""
    return LoopMargins(all(one.stable for one in every), *(
        min(getattr(one, name) for one in every)
        for name in ("phase_deg", "gain_db", "dead_time_s", "lag_s", "modulus")))


class StringResponse:
    """Speed and torque at the top of one string over a grid of frequencies. Each is computed once, if it is needed."""

    def __init__(self, string: DrillString, omega_rad_s: Reals) -> None:
        self.string, self.omega_rad_s = string, omega_rad_s
        even = omega_rad_s[LOW_FREQUENCIES:]
        step = float(even[1] - even[0]) if even.size > 1 else inf
        coarsest = min(2.0 * pi / string.echo_s / STEPS_PER_MODE, step * even.size / LEAST_COARSE)
        self.coarsest = COARSER ** max(0, int(log(coarsest / step, COARSER)))
        """Step of the coarsest grid, in steps of the whole one."""
        self._known: dict[bool, tuple[Complex, Complex, NDArray[np.bool_]]] = {}

    def at_top(self, points: Points, *, stuck: bool) -> tuple[Complex, Complex]:
        """Return (speed, torque) at the top, up to a common factor, at these points of the grid."""
        if stuck not in self._known:
            speed, torque = np.empty((2, self.omega_rad_s.size), dtype=np.complex128)
            self._known[stuck] = speed, torque, np.zeros(speed.size, dtype=bool)
        speed, torque, known = self._known[stuck]
        new = points[~known[points]]
        if new.size:
            speed[new], torque[new] = self.string.at_top(np.asarray(1j * self.omega_rad_s[new]), stuck=stuck)
            known[new] = True
        return speed[points], torque[points]


def response_of(string: DrillString, highest_rad_s: float) -> StringResponse:
    """Return the response on a grid that resolves every resonance of the string up to ``highest_rad_s``."""
    return StringResponse(string, _grid(string, highest_rad_s))


def _grid(string: DrillString, highest_rad_s: float) -> Reals:
    spacing = 2.0 * pi / string.echo_s
    widths = [line.drag_nm_s_rad_m / (2.0 * line.inertia_kg_m) for line in string.lines]
    step = spacing / STEPS_PER_MODE
    if min(widths) > 0.0:
        step = min(step, min(widths) / STEPS_PER_WIDTH)
    step = max(step, highest_rad_s / MOST_FREQUENCIES)
    low = np.geomspace(LOWEST_RAD_S, 10.0 * step, LOW_FREQUENCIES, endpoint=False)
    return np.concatenate([low, np.arange(10.0 * step, highest_rad_s, step)])


class StringResponses:
    """Frequency responses of strings. Each is computed once and kept: gains and J change only its range."""

    def __init__(self) -> None:
        self._known: dict[DrillString, StringResponse] = {}

    def of(self, string: DrillString, drive: TopDrive, law: SpeedController) -> StringResponse:
        """Return a response that covers all crossings of that loop."""
        top = highest_crossover(drive, law, string)
        known = self._known.get(string)
        if known is None or known.omega_rad_s[-1] < 0.98 * top:
            known = self._known[string] = response_of(string, 1.3 * top)
        return known


def loop_margins(
    drive: TopDrive, law: SpeedController, string: DrillString, response: StringResponse | None = None,
    stuck: bool = True, exact: bool = False,
) -> LoopMargins:
    """Return the margins of the loop.

    ``response``: Z_s of that string, if it was computed before. ``stuck`` False leaves the stuck bit out. ``exact``:
    the grid is refined wherever |L| is near 1, so the reserves are exact to a fraction of a millisecond.
    """
    top = highest_crossover(drive, law, string)
    if response is None or response.omega_rad_s[-1] < 0.98 * top:
        response = response_of(string, top)
    least = [inf, inf, inf, inf, inf]
    stable = True
    for is_stuck in (False, True) if stuck else (False,):
        points, fine = _deciding_points(drive, law, response, is_stuck, exact)
        omega = response.omega_rad_s[points]
        speed, torque = response.at_top(points, stuck=is_stuck)
        over, under = _fraction(drive, law, omega, speed, torque)
        loop = over / under
        # Nyquist criterion: rotor and string are passive, so L has no pole in the right half-plane, and the loop is
        # stable if L does not encircle −1. The phase of 1 + L begins between −180° and 0, because L has at most one
        # pole at the origin that is not balanced by losses. It ends at 0 if −1 is not encircled, otherwise at a
        # multiple of 360°. Numerator and denominator of 1 + L are smooth, so their phases are right even if a
        # resonance is sharper than the grid.
        phase = np.angle(1.0 + loop[0]) + _turn(over + under) - _turn(under)
        stable = stable and abs(float(phase)) < 0.5 * pi
        if exact:
            omega = _refined(omega, np.log(np.abs(loop)), np.searchsorted(points, fine))
            over, under = _fraction(drive, law, omega, *string.at_top(np.asarray(1j * omega), stuck=is_stuck))
            loop = over / under
        least = [min(pair) for pair in zip(least, _crossings(omega, loop), strict=True)]
    if not stable:
        return LoopMargins(False, 0.0, 0.0, 0.0, 0.0, least[4])
    return LoopMargins(True, *least)


def _fraction(
    drive: TopDrive, law: SpeedController, omega: Reals, speed: Complex, torque: Complex
) -> tuple[Complex, Complex]:
    """Return numerator and denominator of L. Both are as smooth as speed and torque at the top of the string."""
    s: Complex = np.asarray(1j * omega, dtype=np.complex128)
    return (s * inner_lags(drive, s) * control_law(law, s) * speed,
            s * ((drive.inertia_kg_m2 * s + drive.viscous_nm_s_rad) * speed + torque))


def _turn(values: Complex) -> float:
    """Return the angle, rad, through which a smooth function turns from the first to the last point."""
    return float(np.sum(np.angle(values[1:] * values[:-1].conj())))


def _refined(omega: Reals, size: Reals, steps: Points) -> Reals:
    """Return the grid with each of these steps divided into `REFINEMENT` steps if |ln |L|| is below `NEAR` there."""
    near = steps[np.minimum(np.abs(size[steps]), np.abs(size[steps + 1])) < NEAR]
    parts = np.arange(1, REFINEMENT) / REFINEMENT
    between = omega[near, None] + (omega[near + 1] - omega[near])[:, None] * parts
    merged: Reals = np.sort(np.concatenate([omega, between.ravel()]))
    return merged


# ---------------------------------------------------------------------------------------------------------------------
# Points that decide. Resonances of a lightly damped string are sharp in L, and need a fine grid. But L = N/D, and
# N = s H law ω and D = s ((J s + B) ω + τ) are as smooth as speed ω and torque τ at the top of the string: entire
# functions, which change over the spacing of the modes. So a coarse grid shows between which of its points N and D can
# make a crossing, a turn of the phase or the least distance from −1. Only these steps are refined.


def _deciding_points(
    drive: TopDrive, law: SpeedController, response: StringResponse, stuck: bool, exact: bool
) -> tuple[Points, Points]:
    """Return the points of the grid that may decide a margin, with a coarse grid between them.

    The second array has the points before the steps that may decide. Only ``exact`` margins need it.
    """
    omega, step = response.omega_rad_s, response.coarsest
    rows = np.arange(LOW_FREQUENCIES, omega.size, step)[None, :]
    taken, fine = np.zeros((2, omega.size), dtype=bool)
    for ends in (slice(0, LOW_FREQUENCIES), slice(rows[0, -1], None)):      # outside the coarsest grid
        taken[ends] = fine[ends] = True
    taken[rows] = True
    nearest = inf
    while step > 1 or exact:
        over, under = _fraction(drive, law, omega[rows], *response.at_top(rows, stuck=stuck))
        nearest = min(nearest, float(np.min(np.abs(1.0 + over / under), initial=inf)))
        steps = rows[:, :-1][_may_decide(over, under, nearest)]
        if step == 1:
            fine[steps] = True
            break
        step //= COARSER
        rows = steps[:, None] + step * np.arange(COARSER + 1)
        taken[rows] = True
    return np.flatnonzero(taken), np.flatnonzero(fine[:-1])


def _may_decide(over: Complex, under: Complex, nearest: float) -> NDArray[np.bool_]:
    """Return for each step of each row whether L = N/D may cross, turn, or come nearer to −1 than ``nearest``.

    Between two points, N and D are straight lines, to within their bend. |N|² − |D|², Im N D* and Re N D* + |D|² are
    then parabolas, and their range is exact.
    """
    n0, n1, d0, d1 = over[:, :-1], over[:, 1:], under[:, :-1], under[:, 1:]
    dn, dd, bend_n, bend_d = n1 - n0, d1 - d0, _bend(over), _bend(under)
    size_n, size_d = (np.maximum(np.abs(a), np.abs(b)) for a, b in ((n0, n1), (d0, d1)))
    square_n, square_d = ((2.0 * size + bend) * bend for size, bend in ((size_n, bend_n), (size_d, bend_d)))
    product = size_n * bend_d + size_d * bend_n + bend_n * bend_d
    cross = n0 * d0.conj(), n1 * d1.conj(), dn * dd.conj()
    of_n, of_d = ([np.abs(one) ** 2 for one in three] for three in ((n0, n1, dn), (d0, d1, dd)))
    found = _holds_zero([a - b for a, b in zip(of_n, of_d, strict=True)], square_n + square_d)
    found |= _holds_zero([one.real + own for one, own in zip(cross, of_d, strict=True)], product + square_d)
    negative = _range([one.real for one in cross])[0] <= product
    found |= _holds_zero([one.imag for one in cross], product) & negative
    # the phase of D or of D + N may turn by more than 30°
    sum0, bend = n0 + d0, bend_n + bend_d
    found |= (np.abs(dn + dd) + bend > 0.5 * np.abs(sum0)) | (np.abs(dd) + bend_d > 0.5 * np.abs(d0))
    # 1 + L runs along an arc, which is flat if D turns little
    ratio = (over + under) / under
    away, size = np.abs(ratio), np.minimum(np.abs(d0), np.abs(d1))
    least, most = np.minimum(away[:, :-1], away[:, 1:]), np.maximum(away[:, :-1], away[:, 1:])
    found |= least - np.abs(ratio[:, 1:] - ratio[:, :-1]) - 2.0 * (bend + most * bend_d) / size < nearest
    return found


def _bend(values: Complex) -> Reals:
    """Return twice the largest distance of each step of each row from a straight line, by the second differences."""
    second = np.abs(values[:, :-2] - 2.0 * values[:, 1:-1] + values[:, 2:])
    wide = np.concatenate([second[:, :1], second, second[:, -1:]], axis=1)
    bend: Reals = 0.25 * np.maximum(wide[:, :-1], wide[:, 1:])
    return bend


def _holds_zero(three: Sequence[Reals], slack: Reals) -> NDArray[np.bool_]:
    low, high = _range(three)
    return (low <= slack) & (high >= -slack)


def _range(three: Sequence[Reals]) -> tuple[Reals, Reals]:
    """Return the range of a parabola over a step, from its values at both ends and its quadratic coefficient."""
    first, last, square = three
    slope = last - first - square
    inside = (slope * square < 0.0) & (np.abs(slope) < 2.0 * np.abs(square))
    vertex = np.where(inside, first - 0.25 * slope**2 / np.where(inside, square, 1.0), first)
    return np.minimum(np.minimum(first, last), vertex), np.maximum(np.maximum(first, last), vertex)


def is_stable(
    string: DrillString, drive: TopDrive, law: SpeedController, response: StringResponse | None = None
) -> bool:
    """Return whether the closed system, with a turning bit, has no pole right of the imaginary axis or on it."""
    return loop_margins(drive, law, string, response, stuck=False).stable


def _crossings(omega: Reals, loop: Complex) -> tuple[float, float, float, float, float]:
    """Return (phase margin °, gain margin dB, dead time s, lag s, least |1 + L|), each the least of all crossings."""
    size = np.log(np.abs(loop))
    at, share = _zeros(size)
    phase = dead = inf
    if at.size:
        omega_at = omega[at] + share * (omega[at + 1] - omega[at])
        angle = np.angle(-_between(loop, at, share))
        phase = float(np.degrees(np.min(np.abs(angle))))
        # A crossing with a phase just above −180° allows little dead time. One just below allows almost a whole turn.
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
    """Return the index before each change of sign, and the position of the zero as a share of the step."""
    at = np.flatnonzero((values[:-1] < 0.0) != (values[1:] < 0.0))
    span = values[at] - values[at + 1]
    return at, values[at] / np.where(span == 0.0, 1.0, span)


def _between(values: Complex, at: NDArray[np.int64], share: Reals) -> Complex:
    mixed: Complex = values[at] + share * (values[at + 1] - values[at])
    return mixed


# ---------------------------------------------------------------------------------------------------------------------
# Impedance at the bit.


def bit_impedance(
    string: DrillString, top_impedance: Complex, s: Complex, through: tuple[Complex, ...] | None = None
) -> Complex:
    """Return Z_b(s), N·m·s/rad: the impedance on which the bit's dry friction acts.

    ``top_impedance``: Z(s) of top drive and controller. ``through``: the string's matrix, if it was computed before.
    """
    cosh_down, series, shunt, cosh_up = chain_of(string, s) if through is None else through
    # τ_top = −Z ω_top, with the speed at the bit 1: ω_top = A + Bτ, τ_top = C + Dτ
    torque = -(shunt + top_impedance * cosh_down) / (cosh_up + top_impedance * series)
    return s * string.bottom_inertia_kg_m2 + string.bottom_viscous_nm_s_rad - torque


def chain_of(string: DrillString, s: Complex) -> tuple[Complex, Complex, Complex, Complex]:
    """Return (A, B, C, D) with ω_top = A ω + B τ and τ_top = C ω + D τ; ω and τ at the bit; determinant 1."""
    free = _column(string, s, 1.0, 0.0)
    held = _column(string, s, 0.0, 1.0)
    return free[0], held[0], free[1], held[1]


def _column(string: DrillString, s: Complex, speed: float, torque: float) -> tuple[Complex, Complex]:
    return string.carried_up(s, np.full_like(s, speed), np.full_like(s, torque))


def steepest_slope(omega: Reals, from_bit: Complex) -> float:
    """Return the smallest σ, N·m·s/rad, for which a bit friction of slope −σ is unstable; infinite: none."""
    at, share = _zeros(from_bit.imag)
    if not at.size:
        return inf
    real = _between(from_bit, at, share).real
    real = real[real > 0.0]
    return float(real.min()) if real.size else inf


def bit_grid(string: DrillString) -> Reals:
    """Return frequencies, rad/s, for the impedance at the bit: the lowest four modes, finer at the lowest."""
    mode = pi / string.echo_s
    return np.concatenate([np.geomspace(0.02 * mode, mode, 160, endpoint=False), np.arange(mode, 8.0 * mode,
                                                                                       mode / 40.0)])


def linear_limit_rad_s(bit: BitFriction, slope_nm_s_rad: float) -> float:
    """Return the mean speed, rad/s, above which the bit's friction is less steep than −``slope_nm_s_rad``.

    0: the friction is never as steep. The magnitude of the slope of the Gaussian Stribeck law is
    2 (F_s − F_c) Ω/ω_s² e^−(Ω/ω_s)². It is largest at Ω = ω_s/√2 and falls above it.
    """
    falls, width = bit.static_nm - bit.coulomb_nm, bit.stribeck_speed_rad_s
    if falls <= 0.0 or slope_nm_s_rad == inf:
        return 0.0
    wanted = slope_nm_s_rad * width / (2.0 * falls)

    size, low, high = log(max(wanted, 1e-300)), 1.0 / sqrt(2.0), 30.0
    if log(low) - low * low - size <= 0.0:
        return 0.0
    while low < (middle := 0.5 * (low + high)) < high:      # to the last digit
        low, high = (middle, high) if log(middle) - middle * middle - size > 0.0 else (low, middle)
    return low * width


def linear_limit(string: DrillString, drive: TopDrive, law: SpeedController) -> float:
    """Return the linear stability limit, rad/s at the top. Below this speed, steady rotation is unstable.

    Raises ValueError if no bit is stated.
    """
    if string.bit is None:
        raise ValueError("no bit is stated")
    omega = bit_grid(string)
    s: Complex = np.asarray(1j * omega, dtype=np.complex128)
    slope = steepest_slope(omega, bit_impedance(string, impedance(drive, law, s), s))
    return linear_limit_rad_s(string.bit, slope)
