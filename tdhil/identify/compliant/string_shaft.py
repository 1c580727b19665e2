r"""A drill string: torsional waves between the motor and what turns at the bottom; two masses are its limit.

Along the string, per length, the wave equation of a bar with drag and inner friction (d'Alembert; Chen and Géradin
1995), s = jω, is −∂τ/∂x = (b/L) ω, −∂ω/∂x = (a/L) τ, with the totals

    b = J_s s + D       inertia J_s = ρ I L and drag of the string
    a = s/(k + c s)     compliance, k = G I/L its static stiffness.

The solution is waves e^(±√(ab) x/L); with the end's impedance Z_e = J_e s + B_e at the bottom, the top sees

    Z_s = (Z_e + √(b/a) tanh √(ab)) / (1 + Z_e √(a/b) tanh √(ab)) = (Z_e + b q)/(1 + Z_e a q)
    q = tanh √x / √x,    x = a b,

and the motor Z = J_r s + B_r + Z_s. Without drag √(b/a) is the characteristic impedance I √(Gρ) = √(J_s k), √(ab) = s T
with the delay T = L √(ρ/G) = √(J_s/k). A string that weighs nothing (b = 0, q = 1) leaves two masses, `two_mass.py`,
and that is how it is parametrised: with the load J_L = J_s + J_e and the string's share of it, η = J_s/J_L,

    m = J_r, B, J_L, ω_a, c, B_L, η        k = ω_a² J_L (1 − 2η/3),    J_s = η J_L,    J_e = (1 − η) J_L,

η = 0 two masses, η = 1 a free bottom. J_e + J_s/3 is what a string's swing weighs by Rayleigh, so that ω_a stays near
the lowest antiresonance (10 % off at worst) whatever η. Friction below, B_L, is taken as shared between string and
bottom as their inertias are (D = η B_L): where along the string a weak drag acts can't be told from the top.
"""

import math

import numpy as np

from tdhil.estimation.frequency_domain.shafts import INERTIA
from tdhil.estimation.frequency_domain.spectrum import ComplexArray
from tdhil.identify.compliant.two_mass import DAMPING, LOAD, LOAD_VISCOUS, SWING, TwoMassShaft
from tdhil.recording.recording import FloatArray

STRING_SHARE = 6         # in m
_RAYLEIGH = 2.0 / 3.0


class StringShaft:
    """J_r, B, J_L, ω_a (rad/s), c, B_L, η."""

    names: tuple[str, ...] = (*TwoMassShaft.names, "string_share")
    inertia_row = np.append(TwoMassShaft.inertia_row, 0.0)
    viscous_row = np.append(TwoMassShaft.viscous_row, 0.0)

    def impedance(self, m: FloatArray, s: ComplexArray) -> ComplexArray:
        load, damping, share = m[LOAD], m[DAMPING], m[STRING_SHARE]
        a = s / (stiffness(m) + damping * s)
        hung = load * s + m[LOAD_VISCOUS]
        end, string = (1.0 - share) * hung, share * hung
        q, _ = _q(a * string)
        z: ComplexArray = m[0] * s + m[1] - m[LOAD_VISCOUS] + (end + string * q) / (1.0 + end * a * q)
        return z

    def jacobian(self, m: FloatArray, s: ComplexArray) -> ComplexArray:
        """Chain rule through Z_e, a, b: of Z_s = N/D, N = Z_e + b q, D = 1 + Z_e a q; ∂a/∂k = −a²/s, ∂a/∂c = −a²."""
        load, swing, share = m[LOAD], m[SWING], m[STRING_SHARE]
        light = 1.0 - _RAYLEIGH * share
        a = s / (stiffness(m) + m[DAMPING] * s)
        hung = load * s + m[LOAD_VISCOUS]
        end, string = (1.0 - share) * hung, share * hung
        q, slope = _q(a * string)
        n, d = end + string * q, 1.0 + end * a * q
        by_q = (string - n * end * a / d) / d
        by_end = (1.0 - n * a * q / d) / d
        by_string = q / d + by_q * slope * a
        by_a = -n * end * q / d**2 + by_q * slope * string
        by_stiffness, by_damping = -by_a * a**2 / s, -by_a * a**2
        by_hung = (1.0 - share) * by_end + share * by_string
        by_share = hung * (by_string - by_end) - by_stiffness * swing**2 * load * _RAYLEIGH
        return np.stack(
            [s, np.ones_like(s), s * by_hung + by_stiffness * swing**2 * light,
             2.0 * by_stiffness * swing * load * light, by_damping, by_hung - 1.0, by_share],
            axis=1,
        )

    def bounds(self, rough_inertia: float, s: ComplexArray) -> tuple[FloatArray, FloatArray]:
        low, high = TwoMassShaft().bounds(rough_inertia, s)
        return np.append(low, 0.0), np.append(high, 1.0)

    def scales(self, rough_inertia: float, s: ComplexArray) -> FloatArray:
        return np.append(TwoMassShaft().scales(rough_inertia, s), 0.3)


def stiffness(m: FloatArray) -> float:
    """k, N·m/rad, from the motor to the bottom."""
    return float(m[SWING] ** 2 * m[LOAD] * (1.0 - _RAYLEIGH * m[STRING_SHARE]))


def resonances(m: FloatArray) -> tuple[float, float]:
    """Lowest (antiresonance, resonance) of the motor's speed without damping, rad/s.

    With x = √(J_s/k) ω and β = J_e/J_s, the string carries Z_s/s = J_s g, g = (β + tan x/x)/(1 − β x tan x): its pole,
    then the first x beyond it where J_r + J_s g = 0, each the one root of a monotonic function in its interval.
    """
    from scipy.optimize import brentq

    share, load = float(m[STRING_SHARE]), float(m[LOAD])
    if share < 1e-6:
        swing = math.sqrt(stiffness(m) / load)
        return swing, swing * math.sqrt(1.0 + load / float(m[INERTIA]))
    string = share * load
    beta, motor = (1.0 - share) / share, float(m[INERTIA]) / string
    delay = math.sqrt(string / stiffness(m))

    def pole(x: float) -> float:
        return math.cos(x) - beta * x * math.sin(x)

    def zero(x: float) -> float:
        return motor * pole(x) + beta * math.cos(x) + math.sin(x) / x

    held = float(brentq(pole, 1e-12, 0.5 * math.pi + 1e-12))
    # just above the pole Z_s/s is −∞; it has risen through −J_r before it is 0, at or before π
    free = float(brentq(zero, held, math.pi))
    return held / delay, free / delay


def _q(x: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """The even function tanh √x/√x and its derivative, (1 − x q² − q)/(2x); by series where x is small."""
    small = np.abs(x) < 1e-3
    safe = np.where(small, 1.0, x)
    root = np.sqrt(safe)
    q = np.where(small, 1.0 - x / 3.0 + 2.0 * x**2 / 15.0 - 17.0 * x**3 / 315.0, np.tanh(root) / root)
    slope = np.where(
        small, -1.0 / 3.0 + 4.0 * x / 15.0 - 17.0 * x**2 / 105.0, (1.0 - safe * q**2 - q) / (2.0 * safe)
    )
    return q, slope
