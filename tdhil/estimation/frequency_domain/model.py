"""Shaft with the filters of a drive's reports: G(s) = Z(s; m) · exp(ln F_T/F_w(s; phi)), theta = (m, phi)."""

from collections.abc import Callable, Set
from dataclasses import dataclass, field

import numpy as np

from tdhil.estimation.frequency_domain import signal_filters
from tdhil.estimation.frequency_domain.shafts import RigidShaft, Shaft
from tdhil.estimation.spectrum import ComplexArray
from tdhil.recording import FloatArray


@dataclass(frozen=True)
class GaussianPrior:
    """Gaussian prior of one parameter, given by its index in theta."""

    index: int
    mean: float
    sd: float


@dataclass(frozen=True)
class Model:
    """Model with theta (P,): the M parameters of the shaft, then the six of the reports."""

    shaft: Shaft = field(default_factory=RigidShaft)

    @property
    def mechanical(self) -> int:
        """Return M, the number of parameters of the shaft."""
        return len(self.shaft.names)

    @property
    def size(self) -> int:
        """Return P, the number of parameters."""
        return self.mechanical + signal_filters.COUNT

    @property
    def rigid(self) -> bool:
        """True if the shaft has no spring."""
        return "load_inertia" not in self.shaft.names

    def at(self, report: int) -> int:
        """Return the index in theta of a parameter of the reports."""
        return self.mechanical + report

    @property
    def structure(self) -> tuple[int, ...]:
        """Return the parameters that are zero for first-order lags."""
        return tuple(self.at(index) for index in signal_filters.STRUCTURE)

    def plausible(self, stated: Set[int]) -> tuple[GaussianPrior, ...]:
        """Return the prior on the reports' parameters, except stated ones."""
        soft = ((self.at(index), sd) for index, sd in signal_filters.PLAUSIBLE)
        return tuple(GaussianPrior(index, 0.0, sd) for index, sd in soft if index not in stated)

    @property
    def inertia_row(self) -> FloatArray:
        """Return the row (P,) of the inertia that turns with mean speed."""
        return np.concatenate([self.shaft.inertia_row, np.zeros(signal_filters.COUNT)])

    @property
    def viscous_row(self) -> FloatArray:
        """Return the row (P,) of the friction slope that levels show."""
        return np.concatenate([self.shaft.viscous_row, np.zeros(signal_filters.COUNT)])

    def impedance(self, theta: FloatArray, s: ComplexArray) -> ComplexArray:
        """Return G, N·m·s/rad, (K,)."""
        return self.seen(theta, s)[0]

    def impedance_jacobian(self, theta: FloatArray, s: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """Return G (K,) and ∂G/∂theta (K, P)."""
        g, slopes = self.seen(theta, s)
        return g, slopes().T

    def seen(self, theta: FloatArray, s: ComplexArray) -> tuple[ComplexArray, Callable[[], ComplexArray]]:
        """Return G (K,), and a function that gives ∂G/∂theta (P, K) on demand."""
        mechanical = len(theta) - signal_filters.COUNT
        m = theta[:mechanical]
        reports = signal_filters.FilterRatio(theta[mechanical:], s)
        g: ComplexArray = self.shaft.impedance(m, s) * reports.value

        def slopes() -> ComplexArray:
            found = np.empty((len(theta), len(s)), dtype=np.complex128)
            np.multiply(self.shaft.jacobian(m, s).T, reports.value, out=found[:mechanical])
            np.multiply(reports.log_slopes(), g, out=found[mechanical:])
            return found

        return g, slopes

    def bounds(self, rough_inertia: float, s: ComplexArray) -> tuple[FloatArray, FloatArray]:
        """Return the least and greatest theta, (P,) each."""
        low_m, high_m = self.shaft.bounds(rough_inertia, s)
        low, high = signal_filters.bounds(s)
        return np.concatenate([low_m, low]), np.concatenate([high_m, high])

    def scales(self, rough_inertia: float, s: ComplexArray) -> FloatArray:
        """Return the natural size of each parameter, (P,)."""
        return np.concatenate([self.shaft.scales(rough_inertia, s), signal_filters.scales()])
