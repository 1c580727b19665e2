"""The mechanics behind a line: T/ω of the shaft itself, before the drive's reports have changed either.

About a mean speed that keeps its sign Coulomb friction is constant, and the shaft is linear: T = Z(s) ω, s = jω.
"""

from typing import Protocol

import numpy as np

from tdhil.estimation.frequency_domain.spectrum import ComplexArray
from tdhil.recording.recording import FloatArray


class Shaft(Protocol):
    """A mechanical impedance Z(s; m), m (M,).

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
        """Z, N·m·s/rad, (K,)."""
        ...

    def jacobian(self, m: FloatArray, s: ComplexArray) -> ComplexArray:
        """∂Z/∂m, (K, M)."""
        ...

    def bounds(self, rough_inertia: float, s: ComplexArray) -> tuple[FloatArray, FloatArray]:
        """Least and greatest m, (M,) each."""
        ...

    def scales(self, rough_inertia: float, s: ComplexArray) -> FloatArray:
        """The natural size of each of m, (M,)."""
        ...


INERTIA, VISCOUS = range(2)     # of every shaft: the motor's own inertia first, a viscous friction second


class RigidShaft:
    """J dω/dt + B ω + T_c sgn ω = T: Z = J s + B."""

    names = ("inertia", "viscous")
    inertia_row = np.array([1.0, 0.0])
    viscous_row = np.array([0.0, 1.0])

    def impedance(self, m: FloatArray, s: ComplexArray) -> ComplexArray:
        z: ComplexArray = m[INERTIA] * s + m[VISCOUS]
        return z

    def jacobian(self, m: FloatArray, s: ComplexArray) -> ComplexArray:
        return np.stack([s, np.ones_like(s)], axis=1)

    def bounds(self, rough_inertia: float, s: ComplexArray) -> tuple[FloatArray, FloatArray]:
        return np.array([1e-6 * rough_inertia, -np.inf]), np.array([1e6 * rough_inertia, np.inf])

    def scales(self, rough_inertia: float, s: ComplexArray) -> FloatArray:
        return np.array([rough_inertia, rough_inertia * float(np.median(np.abs(s)))])
