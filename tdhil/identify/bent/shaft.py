"""A rigid shaft whose friction has a third parameter, c, of a shape that is given."""

from dataclasses import dataclass

import numpy as np

from tdhil.estimation.frequency_domain.shafts import INERTIA, VISCOUS, RigidShaft
from tdhil.estimation.frequency_domain.spectrum import ComplexArray
from tdhil.recording.recording import FloatArray

BEND = 2


@dataclass(frozen=True)
class BentShaft:
    """m = J, B, c.

    ``chord``: how much the levels' slope of friction over speed rises with c; ``typical``: c of a bend as large as B ω
    is, over B. c is not in the impedance: what it adds at a line does not go with the speed there (`likelihood.Load`).
    """

    chord: float
    typical: float

    names = ("inertia", "viscous", "bend")
    inertia_row = np.array([1.0, 0.0, 0.0])

    @property
    def viscous_row(self) -> FloatArray:
        return np.array([0.0, 1.0, self.chord])

    def impedance(self, m: FloatArray, s: ComplexArray) -> ComplexArray:
        z: ComplexArray = m[INERTIA] * s + m[VISCOUS]
        return z

    def jacobian(self, m: FloatArray, s: ComplexArray) -> ComplexArray:
        return np.stack([s, np.ones_like(s), np.zeros_like(s)], axis=1)

    def bounds(self, rough_inertia: float, s: ComplexArray) -> tuple[FloatArray, FloatArray]:
        low, high = RigidShaft().bounds(rough_inertia, s)
        return np.append(low, -np.inf), np.append(high, np.inf)

    def scales(self, rough_inertia: float, s: ComplexArray) -> FloatArray:
        plain = RigidShaft().scales(rough_inertia, s)
        return np.append(plain, plain[VISCOUS] * self.typical)
