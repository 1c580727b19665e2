"""Mechanics of the shaft: T/ω before the filters of the drive's reports.

If the speed does not change its sign, Coulomb friction is constant, and the shaft is linear: T = Z(s) ω, s = jω.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from profiles import MessageCode
from tdhil.config import MODELS, load
from tdhil.estimation.result import Refusal
from tdhil.estimation.spectrum import ComplexArray
from tdhil.recording import FloatArray, Pipe

# ---------------------------------------------------------------------------------------------------------------------
# Two masses on a torsion spring, seen from the motor (figure 7 of the paper, which does not use it further).
#
#     J_r dω_r/dt = T − B_r ω_r − τ      J_L dω_L/dt = τ − B_L ω_L      dτ/dt = k (ω_r − ω_L) + c d(ω_r − ω_L)/dt
#
# At s = jω the spring gives ω_r − ω_L = a τ with the compliance a = s/(k + c s), and the load τ = Z_L ω_L with Z_L =
# J_L s + B_L. Therefore ω_r = (1/Z_L + a) τ: speeds add, as voltages in series do,
#
#     Z = T/ω_r = J_r s + B_r + Z_L/(1 + a Z_L) = J_r s + B_r + (J_L s + B_L)(k + c s)/(J_L s² + (B_L + c) s + k).
#
# Dry friction at either end is a constant torque while both ends turn in one direction: it is in the mean, not in the
# lines.
#
# Where Z is large, the load oscillates at √(k/J_L) and the motor stands still (antiresonance of the motor's speed). At
# a higher frequency Z is small: the ends oscillate against each other at √(k (1/J_r + 1/J_L)), and a small torque gives
# a large motion (resonance).
#
# Below both, Z → (J_r + J_L) s + B_r + B_L: the total inertia, and the friction that the levels show. The parameters
# are chosen so that the lines determine them nearly independently:
#
#     m = J_r, B = B_r + B_L, J_L, ω_a = √(k/J_L), c, B_L            k = ω_a² J_L.
#
# c and B_L damp in the same way and can hardly be separated.


LOAD, SWING, DAMPING, LOAD_VISCOUS = range(2, 6)    # positions in m, after shaft.py's INERTIA and VISCOUS

_SLOWEST, _FASTEST = 0.2, 10.0     # bounds of the oscillation, as multiples of the lowest and of the highest line
_SMALL_LOSS = 0.03                 # natural size of the damping, over J ω


class TwoMassShaft:
    """Two masses; m = J_r, B, J_L, ω_a (rad/s), c, B_L."""

    names: tuple[str, ...] = ("inertia", "viscous", "load_inertia", "swing_rad_s", "damping", "load_viscous")
    inertia_row = np.array([1.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    viscous_row = np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0])

    def impedance(self, m: FloatArray, s: ComplexArray) -> ComplexArray:
        inertia, viscous, load, swing, damping, load_viscous = m
        hung = load * s + load_viscous
        spring = swing**2 * load + damping * s
        z: ComplexArray = inertia * s + viscous - load_viscous + hung / (1.0 + hung * s / spring)
        return z

    def jacobian(self, m: FloatArray, s: ComplexArray) -> ComplexArray:
        """Return the slopes by m: D = 1 + a Z_L, ∂(Z_L/D)/∂Z_L = 1/D², ∂(Z_L/D)/∂a = −Z_L²/D², ∂a/∂k = −a²/s, ∂a/∂c
        = −a².
        """
        _, _, load, swing, damping, load_viscous = m
        a = s / (swing**2 * load + damping * s)
        hung = load * s + load_viscous
        d = 1.0 + a * hung
        by_hung = 1.0 / d**2
        by_damping = (a * hung / d) ** 2
        by_stiffness = by_damping / s
        one = np.ones_like(s)
        by_load = s * by_hung + swing**2 * by_stiffness
        by_swing = 2.0 * swing * load * by_stiffness
        return np.stack([s, one, by_load, by_swing, by_damping, by_hung - 1.0], axis=1)

    def bounds(self, rough_inertia: float, s: ComplexArray) -> tuple[FloatArray, FloatArray]:
        omega = np.abs(s)
        loss = 10.0 * rough_inertia * float(np.max(omega))
        low = np.array([1e-6 * rough_inertia, -np.inf, 1e-6 * rough_inertia, _SLOWEST * float(np.min(omega)), 0.0, 0.0])
        high = np.array([1e6 * rough_inertia, np.inf, 1e6 * rough_inertia, _FASTEST * float(np.max(omega)), loss, loss])
        return low, high

    def scales(self, rough_inertia: float, s: ComplexArray) -> FloatArray:
        omega = float(np.median(np.abs(s)))
        loss = _SMALL_LOSS * rough_inertia * omega
        return np.array([rough_inertia, rough_inertia * omega, rough_inertia, omega, loss, loss])


def stiffness(m: FloatArray) -> float:
    """Return k of two lumps, N·m/rad."""
    return float(m[SWING] ** 2 * m[LOAD])


def resonances(m: FloatArray) -> tuple[float, float]:
    """Return (antiresonance, resonance) of the motor's speed without damping, rad/s."""
    return float(m[SWING]), float(m[SWING] * np.sqrt(1.0 + m[LOAD] / m[0]))


# ---------------------------------------------------------------------------------------------------------------------

class Shaft(Protocol):
    """Mechanical impedance Z(s; m), m (M,).

    ``inertia_row`` and ``viscous_row`` (M,): the inertia that turns with mean speed, and the friction slope that
    levels of mean torque show, as linear combinations of m.
    """

    @property
    def names(self) -> tuple[str, ...]: ...
    @property
    def inertia_row(self) -> FloatArray: ...
    @property
    def viscous_row(self) -> FloatArray: ...
    def impedance(self, m: FloatArray, s: ComplexArray) -> ComplexArray:
        """Return Z, N·m·s/rad, (K,)."""
        ...

    def jacobian(self, m: FloatArray, s: ComplexArray) -> ComplexArray:
        """Return ∂Z/∂m, (K, M)."""
        ...

    def bounds(self, rough_inertia: float, s: ComplexArray) -> tuple[FloatArray, FloatArray]:
        """Return the least and greatest m, (M,) each."""
        ...

    def scales(self, rough_inertia: float, s: ComplexArray) -> FloatArray:
        """Return the natural size of each parameter of m, (M,)."""
        ...


INERTIA, VISCOUS = range(2)     # positions in m of every shaft: inertia of the motor, viscous friction


class RigidShaft:
    """Rigid shaft J dω/dt + B ω + T_c sgn ω = T: Z = J s + B."""

    names = ("inertia", "viscous")
    inertia_row = np.array([1.0, 0.0])
    viscous_row = np.array([0.0, 1.0])

    def impedance(self, m: FloatArray, s: ComplexArray) -> ComplexArray:
        z: ComplexArray = m[INERTIA] * s + m[VISCOUS]
        return z

    def jacobian(self, m: FloatArray, s: ComplexArray) -> ComplexArray:
        found = np.ones((len(s), 2), dtype=np.complex128)
        found[:, INERTIA] = s
        return found

    def bounds(self, rough_inertia: float, s: ComplexArray) -> tuple[FloatArray, FloatArray]:
        return np.array([1e-6 * rough_inertia, -np.inf]), np.array([1e6 * rough_inertia, np.inf])

    def scales(self, rough_inertia: float, s: ComplexArray) -> FloatArray:
        return np.array([rough_inertia, rough_inertia * float(np.median(np.abs(s)))])


RIGID_COUNT = len(RigidShaft.names)


# ---------------------------------------------------------------------------------------------------------------------
# Drill string: torsional waves between the motor and the inertia at the bottom; two masses are its limit.
#
# Along the string, per length, the wave equation of a bar with drag and inner friction (d'Alembert; Chen and Géradin
# 1995), s = jω, is −∂τ/∂x = (b/L) ω, −∂ω/∂x = (a/L) τ, with the totals
#
#     b = J_s s + D       inertia J_s = ρ I L and drag of the string
#     a = s/(k + c s)     compliance, k = G I/L its static stiffness.
#
# The solution is waves e^(±√(ab) x/L). With the impedance Z_e = J_e s + B_e at the bottom, the impedance at the top is
#
#     Z_s = (Z_e + √(b/a) tanh √(ab)) / (1 + Z_e √(a/b) tanh √(ab)) = (Z_e + b q)/(1 + Z_e a q)
#     q = tanh √x / √x,    x = a b,
#
# and the motor Z = J_r s + B_r + Z_s. Without drag √(b/a) is the characteristic impedance I √(Gρ) = √(J_s k), √(ab) = s
# T with the delay T = L √(ρ/G) = √(J_s/k). A string without weight (b = 0, q = 1) gives two masses. The parameters
# follow this: the load J_L = J_s + J_e and the string's share of it, η = J_s/J_L,
#
#     m = J_r, B, J_L, ω_a, c, B_L, η, δ     k = ω_a² J_L (1 − 2η/3),    J_s = η J_L,    J_e = (1 − η) J_L,
#
# η = 0 means two masses, η = 1 a free bottom. By Rayleigh the effective inertia of the oscillation is J_e + J_s/3, so
# ω_a is near the lowest antiresonance (10 % off at worst) for any η. The string's drag is a part D = δ B_L of the
# friction B_L below the motor. In the oscillation the bottom moves most, so a loss there has more effect than the same
# loss along the string; the levels show only the sum of both.


STRING_SHARE, DRAG_SHARE = 6, 7         # positions in m
_RAYLEIGH = 2.0 / 3.0                   # part of J_s that takes no part in the oscillation: 1 − 1/3, by Rayleigh


class StringShaft:
    """Drill string; m = J_r, B, J_L, ω_a (rad/s), c, B_L, η, δ."""

    names: tuple[str, ...] = (*TwoMassShaft.names, "string_share", "drag_share")
    inertia_row = np.append(TwoMassShaft.inertia_row, [0.0, 0.0])
    viscous_row = np.append(TwoMassShaft.viscous_row, [0.0, 0.0])

    def impedance(self, m: FloatArray, s: ComplexArray) -> ComplexArray:
        a = s / (string_stiffness(m) + m[DAMPING] * s)
        end, string = _end_and_string(m, s)
        q, _ = _q(a * string)
        z: ComplexArray = m[0] * s + m[1] - m[LOAD_VISCOUS] + (end + string * q) / (1.0 + end * a * q)
        return z

    def jacobian(self, m: FloatArray, s: ComplexArray) -> ComplexArray:
        """Return the slopes by m, with the chain rule through Z_e, a, b: Z_s = N/D, N = Z_e + b q, D = 1 + Z_e a q;
        ∂a/∂k = −a²/s, ∂a/∂c = −a².
        """
        load, swing, share, drag_share = m[LOAD], m[SWING], m[STRING_SHARE], m[DRAG_SHARE]
        light = 1.0 - _RAYLEIGH * share
        a = s / (string_stiffness(m) + m[DAMPING] * s)
        end, string = _end_and_string(m, s)
        q, slope = _q(a * string)
        n, d = end + string * q, 1.0 + end * a * q
        by_q = (string - n * end * a / d) / d
        by_end = (1.0 - n * a * q / d) / d
        by_string = q / d + by_q * slope * a
        by_a = -n * end * q / d**2 + by_q * slope * string
        by_stiffness, by_damping = -by_a * a**2 / s, -by_a * a**2
        by_load = (1.0 - share) * by_end + share * by_string
        by_viscous = (1.0 - drag_share) * by_end + drag_share * by_string
        by_share = load * s * (by_string - by_end) - by_stiffness * swing**2 * load * _RAYLEIGH
        found = np.empty((len(m), len(s)), dtype=np.complex128)
        found[INERTIA], found[VISCOUS] = s, 1.0
        found[LOAD] = s * by_load + by_stiffness * swing**2 * light
        found[SWING] = 2.0 * by_stiffness * swing * load * light
        found[DAMPING], found[LOAD_VISCOUS] = by_damping, by_viscous - 1.0
        found[STRING_SHARE], found[DRAG_SHARE] = by_share, m[LOAD_VISCOUS] * (by_string - by_end)
        return found.T

    def bounds(self, rough_inertia: float, s: ComplexArray) -> tuple[FloatArray, FloatArray]:
        low, high = TwoMassShaft().bounds(rough_inertia, s)
        return np.append(low, [0.0, 0.0]), np.append(high, [1.0, 1.0])

    def scales(self, rough_inertia: float, s: ComplexArray) -> FloatArray:
        return np.append(TwoMassShaft().scales(rough_inertia, s), [0.3, 0.3])


@runtime_checkable
class Believing(Protocol):
    """Shaft with prior knowledge; ``held``: number of its parameters held by this knowledge more than by the lines."""

    @property
    def held(self) -> int: ...
    def beliefs(self, m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the deviation of m from the prior knowledge, in standard deviations, (R,), and its slopes, (R, M)."""
        ...


class KnownStringShaft(StringShaft):
    """String with a known pipe: ζ = √(J_s k) to its tolerance, and the travel time √(J_s/k) to a third of that.

    An error of the pipe's section changes J_s and k equally, and does not change the wave speed, which is that of
    steel.
    """

    held = 0

    def __init__(self, pipe: Pipe, impedance_rel_sd: float | None = None) -> None:
        """Set the pipe. ``impedance_rel_sd``: of ζ, instead of the pipe's; the travel time keeps the pipe's
        uncertainty.
        """
        self.pipe = pipe
        self.impedance_rel_sd = pipe.rel_sd if impedance_rel_sd is None else impedance_rel_sd

    def impedance_ratio(self, m: FloatArray) -> float:
        """Return ζ of the fit over that of the pipe."""
        inertia = float(m[STRING_SHARE] * m[LOAD])
        return math.sqrt(inertia * string_stiffness(m)) / self.pipe.impedance_nm_s_rad

    def beliefs(self, m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the deviations and slopes, from ln J_s = ln η + ln J_L, ln k = 2 ln ω_a + ln J_L + ln(1 − 2η/3)."""
        share, load, swing = max(float(m[STRING_SHARE]), 1e-6), float(m[LOAD]), float(m[SWING])
        light = 1.0 - _RAYLEIGH * share
        inertia = math.log(share * load / self.pipe.inertia_kg_m2)
        spring = math.log(swing**2 * load * light / self.pipe.stiffness_nm_rad)
        by_inertia, by_spring = np.zeros(len(m)), np.zeros(len(m))
        by_inertia[STRING_SHARE], by_inertia[LOAD] = 1.0 / share, 1.0 / load
        by_spring[STRING_SHARE], by_spring[LOAD], by_spring[SWING] = -_RAYLEIGH / light, 1.0 / load, 2.0 / swing
        sds = np.array([self.impedance_rel_sd, self.pipe.rel_sd / DELAY_SURER])
        off = np.array([0.5 * (inertia + spring), 0.5 * (inertia - spring)]) / sds
        slopes = np.stack([0.5 * (by_inertia + by_spring), 0.5 * (by_inertia - by_spring)]) / sds[:, None]
        return off, slopes


ANY_IMPEDANCE = 1.0
"""Relative standard deviation of the prior of ζ: so wide that the data decide."""
_PIPE_RATIOS = (0.75, 1.33)
"""Allowed ratios of ζ to that of the pipe, for waves with the pipe's travel time. G of 61 instead of 79 GPa gives
0.88; worn pipe and the torque scale change the ratio by a tenth. A ratio outside means a wrong scale or a wrong
section."""


def like_the_pipe(impedance_ratio: float) -> bool:
    """Return whether a string with this ratio of ζ to that of the pipe may be the pipe."""
    return _PIPE_RATIOS[0] <= impedance_ratio <= _PIPE_RATIOS[1]


def unlike_the_pipe(impedance_ratio: float) -> Refusal:
    """Return the contradiction of a string with this ratio of ζ to that of the pipe."""
    least, most = _PIPE_RATIOS
    return Refusal(
        f"the string has {impedance_ratio:.2f} times the characteristic impedance of the pipe in rig.yaml (limits"
        f" {least:g} to {most:g}), and its travel time is that of the pipe: the scale of torque or speed is wrong by"
        " this factor, or the pipe's diameters are",
        "compare the diameters in rig.yaml with the pipe, and the rated torque and the speed unit with the drive; then"
        " run it again",
        MessageCode.STRING_IMPEDANCE_DIFFERS,
    )


DELAY_SURER = 3.0
"""Uncertainty of the pipe's impedance over that of its travel time. An assumption: the section of the pipe varies,
and the wave speed is that of steel."""


def _end_and_string(m: FloatArray, s: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """Return Z_e and b."""
    share, drag_share = m[STRING_SHARE], m[DRAG_SHARE]
    end: ComplexArray = (1.0 - share) * m[LOAD] * s + (1.0 - drag_share) * m[LOAD_VISCOUS]
    string: ComplexArray = share * m[LOAD] * s + drag_share * m[LOAD_VISCOUS]
    return end, string


def string_stiffness(m: FloatArray) -> float:
    """Return k from the motor to the bottom, N·m/rad."""
    return float(m[SWING] ** 2 * m[LOAD] * (1.0 - _RAYLEIGH * m[STRING_SHARE]))


def string_resonances(m: FloatArray) -> tuple[float, float]:
    """Return the lowest (antiresonance, resonance) of the motor's speed without damping, rad/s.

    With x = √(J_s/k) ω and β = J_e/J_s, the string has Z_s/s = J_s g, g = (β + tan x/x)/(1 − β x tan x). The
    antiresonance is its pole, the resonance the first x beyond it with J_r + J_s g = 0. Each is the only root of a
    monotonic function in its interval.
    """
    from scipy.optimize import brentq

    share, load = float(m[STRING_SHARE]), float(m[LOAD])
    if share < 1e-6:
        swing = math.sqrt(string_stiffness(m) / load)
        return swing, swing * math.sqrt(1.0 + load / float(m[INERTIA]))
    string = share * load
    beta, motor = (1.0 - share) / share, float(m[INERTIA]) / string
    delay = math.sqrt(string / string_stiffness(m))

    def pole(x: float) -> float:
        return math.cos(x) - beta * x * math.sin(x)

    def zero(x: float) -> float:
        return motor * pole(x) + beta * math.cos(x) + math.sin(x) / x

    fixed = float(brentq(pole, 1e-12, 0.5 * math.pi + 1e-12))
    # just above the pole Z_s/s is −∞; it passes −J_r before it reaches 0, at or before π
    free = float(brentq(zero, fixed, math.pi))
    return fixed / delay, free / delay


def _q(x: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """Return the even function tanh √x/√x and its derivative, (1 − x q² − q)/(2x); by a series for small x."""
    small = np.abs(x) < 1e-3
    few = True in small.tolist()     # rarely the case
    safe: ComplexArray = np.where(small, 1.0, x) if few else x
    root: ComplexArray = np.sqrt(safe)
    q = np.tanh(root) / root
    if few:
        q = np.where(small, 1.0 - x / 3.0 + 2.0 * x**2 / 15.0 - 17.0 * x**3 / 315.0, q)
    slope: ComplexArray = (1.0 - safe * q**2 - q) / (2.0 * safe)
    if few:
        slope = np.where(small, -1.0 / 3.0 + 4.0 * x / 15.0 - 17.0 * x**2 / 105.0, slope)
    return q, slope


# ---------------------------------------------------------------------------------------------------------------------

@dataclass(frozen=True)
class ShaftModel:
    """A model of the shaft, by name in `tdhil.config.registry.MODELS`.

    ``compliant``: makes a shaft with an oscillating load, whose m begins like that of two masses; None: rigid.
    ``text``: name of a compliant shaft in messages; ``explain``: verb if it explains the data; ``have``: subject and
    verb for the unknowns of its fit. ``lags``: the reports have lags. ``widened``: other shafts are tried if a rigid
    one is rejected or in doubt. ``piped``: a pipe of known sizes is used.
    """

    compliant: Callable[[], Shaft] | None = None
    text: str = ""
    explain: str = "explains the data"
    have: str = ""
    lags: bool = True
    widened: bool = False
    piped: bool = False


AUTO = ShaftModel(widened=True, piped=True)
RIGID = ShaftModel()
TWO_MASS = ShaftModel(
    TwoMassShaft, "two masses on a spring", "explain the data", "two masses on a spring behind a drive's reports have"
)
STRING = ShaftModel(
    StringShaft, "a string with a mass at its end", have="a string behind a drive's reports has", piped=True
)
PAPER = ShaftModel(lags=False)


def shaft_model(name: str) -> ShaftModel:
    """Return the model with this name. Raises KeyError for an unknown name."""
    found: ShaftModel = load(MODELS, name)
    return found
