"""What a plant of the coverage benchmark is made of: shaft, what its drive does to its reports, noise, reading.

Data only, with the frequency responses that follow from them. Nothing here is shared with the estimator.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class Report:
    """How a drive shows one of its signals: H(s) = Π 1/(1 + τ s) · (1 − e^(−w s))/(w s) · e^(−d s).

    ``lags_s``: τ of every pole; ``average_s``: w of a moving average, 0 for none; ``delay_s``: d.
    """

    lags_s: tuple[float, ...] = ()
    average_s: float = 0.0
    delay_s: float = 0.0

    def response(self, s: ComplexArray) -> ComplexArray:
        """H(s), (K,)."""
        h: ComplexArray = np.exp(-self.delay_s * s)
        for lag in self.lags_s:
            h = h / (1.0 + lag * s)
        if self.average_s > 0.0:
            x = np.where(np.abs(s) < 1e-9, 1e-9, s) * self.average_s
            h = h * -np.expm1(-x) / x
        return h

    @property
    def total_delay_s(self) -> float:
        """Delay of slow motion, s."""
        return sum(self.lags_s) + 0.5 * self.average_s + self.delay_s


@dataclass(frozen=True)
class Noise:
    """Standard deviations. The load is coloured (first order, ``load_time_s``); ripple and sensor are white per step.

    Ripple is torque that truly turns the shaft; the sensor's noise is in speed before the drive's filter; the reported
    noise is added after the filters, sample by sample, before rounding to the quantum.
    """

    load_nm: float = 0.0
    load_time_s: float = 0.5
    ripple_nm: float = 0.0
    sensor_rad_s: float = 0.0
    reported_speed_rad_s: float = 0.0
    reported_torque_nm: float = 0.0
    speed_quantum_rad_s: float = 0.0
    torque_quantum_nm: float = 0.0


@dataclass(frozen=True)
class Reading:
    """How the host samples. Stamps are true but for ``stamp_error_s`` (uniform, either way).

    ``jitter_s``: uniform, either way, of the instants. Speed is taken ``speed_after_s`` and torque ``torque_after_s``
    after the stamped instant. ``dropped``: share of samples that bring nothing new. ``command_s``: the torque command
    is renewed this often and held between.
    """

    rate_hz: float = 100.0
    jitter_s: float = 0.0
    stamp_error_s: float = 0.0
    speed_after_s: float = 0.0
    torque_after_s: float = 0.0
    dropped: float = 0.0
    command_s: float = 0.01


@dataclass(frozen=True)
class Bend:
    """Friction besides its straight line, at positive speed: bell·exp(−(ω/width)²) + square·ω²."""

    bell_nm: float = 0.0
    width_rad_s: float = 1.0
    square_nm_s2_rad2: float = 0.0

    def torque(self, speed: FloatArray) -> FloatArray:
        """N·m against rotation."""
        found: FloatArray = self.bell_nm * np.exp(-((speed / self.width_rad_s) ** 2))
        found += self.square_nm_s2_rad2 * speed * speed
        return found


@dataclass(frozen=True)
class CoveragePlant:
    """J dω/dt + B ω + T_c + bend = T + load at positive speed, seen through two reports.

    ``lowest_hz``: lowest line of the multisine. ``model_true``: a first-order lag on either report and a skew are the
    whole truth. ``degenerate``: the lags are equal or absent, so that they can't be told apart.
    """

    name: str
    about: str
    inertia_kg_m2: float
    viscous_nm_s_rad: float
    coulomb_nm: float
    window_rad_s: tuple[float, float]
    torque_limit_nm: float
    speed_report: Report
    torque_report: Report
    noise: Noise
    reading: Reading = field(default_factory=Reading)
    lowest_hz: float = 0.1
    step_s: float = 0.002
    motor_lag_s: float = 0.010
    bend: Bend | None = None
    model_true: bool = False
    degenerate: bool = False

    @property
    def bound_applies(self) -> bool:
        """Is the RMSE held against the Cramér-Rao bound?"""
        return self.model_true and not self.degenerate

    @property
    def skew_s(self) -> float:
        """Delay of the torque report beyond the speed report's, lags and averages aside, s."""
        reading = self.reading
        return (self.torque_report.delay_s - reading.torque_after_s) - (
            self.speed_report.delay_s - reading.speed_after_s
        )
