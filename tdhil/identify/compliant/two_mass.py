r"""Two masses on a torsion spring, seen from the motor (the paper's figure 7, which it draws and then drops).

    J_r dω_r/dt = T − B_r ω_r − τ      J_L dω_L/dt = τ − B_L ω_L      dτ/dt = k (ω_r − ω_L) + c d(ω_r − ω_L)/dt

At s = jω the spring says ω_r − ω_L = a τ with the compliance a = s/(k + c s), the load τ = Z_L ω_L, Z_L = J_L s + B_L.
So ω_r = (1/Z_L + a) τ: speeds add up, as voltages do in a row,

    Z = T/ω_r = J_r s + B_r + Z_L/(1 + a Z_L) = J_r s + B_r + (J_L s + B_L)(k + c s)/(J_L s² + (B_L + c) s + k).

Dry friction at either end is a constant torque while both keep turning one way: it is in the mean, not in the lines.

Where Z is large, the load swings by itself at √(k/J_L) and holds the motor still (antiresonance of the motor's
speed). Where Z is small, above it, the ends swing against each other at √(k (1/J_r + 1/J_L)) and little torque moves
much (resonance).

Below both, Z → (J_r + J_L) s + B_r + B_L: what turns with mean speed, and what the levels show. Parameters, chosen so
that lines speak of them one by one:

    m = J_r, B = B_r + B_L, J_L, ω_a = √(k/J_L), c, B_L            k = ω_a² J_L.

c and B_L damp alike and can hardly be told apart.
"""

import numpy as np

from tdhil.estimation.frequency_domain.spectrum import ComplexArray
from tdhil.recording.recording import FloatArray

LOAD, SWING, DAMPING, LOAD_VISCOUS = range(2, 6)    # in m, after shaft.py's INERTIA and VISCOUS

_SLOWEST, _FASTEST = 0.2, 10.0     # swing, of the lowest and of the highest line
_SMALL_LOSS = 0.03                 # damping's natural size, of J ω


class TwoMassShaft:
    """J_r, B, J_L, ω_a (rad/s), c, B_L."""

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
        """With D = 1 + a Z_L: ∂(Z_L/D)/∂Z_L = 1/D², ∂(Z_L/D)/∂a = −Z_L²/D², ∂a/∂k = −a²/s, ∂a/∂c = −a²."""
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
    """k, N·m/rad, of two lumps."""
    return float(m[SWING] ** 2 * m[LOAD])


def resonances(m: FloatArray) -> tuple[float, float]:
    """(antiresonance, resonance) of the motor's speed without damping, rad/s."""
    return float(m[SWING]), float(m[SWING] * np.sqrt(1.0 + m[LOAD] / m[0]))
