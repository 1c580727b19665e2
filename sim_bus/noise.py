"""Seeded disturbances: white sensor and torque noise, and a load that wanders (Ornstein–Uhlenbeck).

The load obeys dx = −x/τ dt + sd √(2/τ) dW; sampled every h, exactly: x ← a x + sd √(1 − a²) n, a = e^(−h/τ).
White noise is given as it stands in a step of 2 ms; in a step of h its sd is √(2 ms/h) times as large, so
that its spectral density does not depend on the step.
"""

from collections.abc import Iterator
from math import exp, sqrt

import numpy as np

from sim_bus.params import NoiseParams

REFERENCE_STEP_S = 0.002
CHANNELS = 5
"""Independent normals per step: speed sensor, torque, load, reported speed, reported torque."""
_BLOCK = 2048


def normals(rng: np.random.Generator) -> Iterator[list[float]]:
    """Endless rows of standard normals, drawn in blocks (a draw per step would cost more than the plant)."""
    while True:
        yield from rng.standard_normal((_BLOCK, CHANNELS)).tolist()


class Disturbance:
    """The wandering load, and the sizes of the white noises for the step in use."""

    __slots__ = ("_decay", "_kick", "_params", "load_nm", "sensor_sd_rad_s", "torque_sd_nm")

    def __init__(self, params: NoiseParams) -> None:
        self._params = params
        self.load_nm = 0.0
        self.prepare(REFERENCE_STEP_S)

    def prepare(self, dt_s: float) -> None:
        """Fits the coefficients to a step of ``dt_s``."""
        params = self._params
        self._decay = exp(-dt_s / params.load_correlation_s)
        self._kick = params.load_nm * sqrt(1.0 - self._decay**2)
        scale = sqrt(REFERENCE_STEP_S / dt_s)
        self.sensor_sd_rad_s = params.speed_sensor_rad_s * scale
        self.torque_sd_nm = params.torque_nm * scale

    def wander(self, normal: float) -> float:
        """Moves the load by one step and returns it, N·m."""
        self.load_nm = self._decay * self.load_nm + self._kick * normal
        return self.load_nm
