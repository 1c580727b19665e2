"""Parts of a plant of the coverage benchmark: shaft, filters of the drive's reports, noise, sampling.

Only data, and the frequency responses that follow from them. The estimator uses none of this module.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from profiles.quantities import RAD_S_PER_RPM
from tdhil.recording import FloatArray

ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class ReportFilter:
    """Filter of a drive's report: H(s) = Π 1/(1 + τ s) · (1 − e^(−w s))/(w s) · e^(−d s).

    ``lags_s``: τ of every pole; ``average_s``: w of a moving average, 0 for none; ``delay_s``: d.
    """

    lags_s: tuple[float, ...] = ()
    average_s: float = 0.0
    delay_s: float = 0.0

    def response(self, s: ComplexArray) -> ComplexArray:
        """Return H(s), (K,)."""
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
class PlantNoise:
    """Standard deviations. The load is coloured (first order, ``load_time_s``); ripple and sensor are white per step.

    Ripple is real torque at the shaft. The sensor's noise is in the speed before the drive's filter. The reported noise
    is added after the filters, sample by sample, before rounding to the quantum.
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
class HostSampling:
    """Sampling by the host. Time stamps are correct except for ``stamp_error_s`` (uniform, either sign).

    ``jitter_s``: of the instants, uniform, either sign. Speed is taken ``speed_after_s`` and torque ``torque_after_s``
    after the stamped instant. ``dropped``: share of samples without new values. ``command_s``: interval between torque
    commands, which are held.
    """

    rate_hz: float = 100.0
    jitter_s: float = 0.0
    stamp_error_s: float = 0.0
    speed_after_s: float = 0.0
    torque_after_s: float = 0.0
    dropped: float = 0.0
    command_s: float = 0.01


@dataclass(frozen=True)
class NonlinearFriction:
    """Friction besides its straight line, at positive speed: bell·exp(−(ω/width)²) + square·ω²."""

    bell_nm: float = 0.0
    width_rad_s: float = 1.0
    square_nm_s2_rad2: float = 0.0

    def torque(self, speed: FloatArray) -> FloatArray:
        """Return the friction torque against the rotation, N·m."""
        found: FloatArray = self.bell_nm * np.exp(-((speed / self.width_rad_s) ** 2))
        found += self.square_nm_s2_rad2 * speed * speed
        return found


@dataclass(frozen=True)
class CoveragePlant:
    """Plant J dω/dt + B ω + T_c + bend = T + load at positive speed, seen through two reports.

    ``lowest_hz``: lowest line of the multisine. ``model_true``: the plant has exactly a first-order lag on either
    report and a skew. ``degenerate``: the lags are equal or absent, so that they cannot be separated.
    """

    name: str
    about: str
    inertia_kg_m2: float
    viscous_nm_s_rad: float
    coulomb_nm: float
    window_rad_s: tuple[float, float]
    torque_limit_nm: float
    speed_report: ReportFilter
    torque_report: ReportFilter
    noise: PlantNoise
    reading: HostSampling = field(default_factory=HostSampling)
    lowest_hz: float = 0.1
    step_s: float = 0.002
    motor_lag_s: float = 0.010
    bend: NonlinearFriction | None = None
    model_true: bool = False
    degenerate: bool = False

    @property
    def bound_applies(self) -> bool:
        """Return whether the RMSE is compared with the Cramér-Rao bound."""
        return self.model_true and not self.degenerate

    @property
    def skew_s(self) -> float:
        """Delay of the torque report relative to the speed report, without lags and averages, s."""
        reading = self.reading
        return (self.torque_report.delay_s - reading.torque_after_s) - (
            self.speed_report.delay_s - reading.speed_after_s
        )


# ---------------------------------------------------------------------------------------------------------------------
# Plants of the coverage benchmark, small to large within each family.
#
# The lags are those of real drives: 6.4/3.2 ms (Altivar), 30/8 ms and none (servo drives), a 100 ms average (Sinamics),
# 0.5/0.1 s (ACS880), 0.40/0.15 s (from the paper's field slopes). The noise of the field rig is that of the design's
# notes, scaled to the torque and speed of the others.


RPM = RAD_S_PER_RPM
FIELD_NOISE = PlantNoise(3.0, 0.5, 10.0, 0.02, 0.003, 2.0, 0.1 * RPM, 1.0)


def _lag(*lags_s: float, delay_s: float = 0.0, average_s: float = 0.0) -> ReportFilter:
    return ReportFilter(lags_s, average_s, delay_s)


FLEET: tuple[CoveragePlant, ...] = (
    CoveragePlant(
        "servo", "bare servo motor, 1 kHz CAN", 0.01, 0.002, 0.05, (20.0, 200.0), 3.0,
        _lag(0.030), _lag(0.008), PlantNoise(0.01, 0.05, 0.05, 0.2, 0.02, 0.005, 0.1 * RPM, 0.003),
        HostSampling(rate_hz=1000.0, jitter_s=0.0001, command_s=0.001),
        lowest_hz=0.5, step_s=0.0005, motor_lag_s=0.001, model_true=True,
    ),
    CoveragePlant(
        "unfiltered", "servo axis that filters nothing", 0.8, 0.05, 1.5, (10.0, 100.0), 60.0,
        _lag(), _lag(), PlantNoise(0.3, 0.3, 1.0, 0.05, 0.01, 0.1, 0.1 * RPM, 0.05),
        HostSampling(rate_hz=250.0, command_s=0.004), lowest_hz=0.2, motor_lag_s=0.002, model_true=True,
        degenerate=True,
    ),
    CoveragePlant(
        "coarse", "speed in whole rpm, torque in percent, one sample in twenty lost", 12.0, 0.6, 10.0, (5.0, 60.0),
        200.0, _lag(0.12), _lag(0.03), PlantNoise(1.0, 0.4, 3.0, 0.05, 0.01, 0.5, 1.0 * RPM, 2.0),
        HostSampling(rate_hz=100.0, jitter_s=0.002, dropped=0.05), lowest_hz=0.2, model_true=True,
    ),
    CoveragePlant(
        "field", "the notes' field-like rig", 104.0, 8.0, 60.0, (0.5, 10.0), 400.0,
        _lag(0.40), _lag(0.15), FIELD_NOISE, HostSampling(jitter_s=0.004), model_true=True,
    ),
    CoveragePlant(
        "long_filter", "a speed filter twice as long as the field rig's", 104.0, 8.0, 60.0, (0.5, 10.0), 400.0,
        _lag(0.80), _lag(0.15), FIELD_NOISE, HostSampling(jitter_s=0.004), model_true=True,
    ),
    CoveragePlant(
        "skewed", "speed 40 ms late besides its lag", 250.0, 15.0, 90.0, (0.5, 12.0), 900.0,
        _lag(0.20, delay_s=0.040), _lag(0.10), PlantNoise(8.0, 0.8, 20.0, 0.02, 0.004, 4.0, 0.1 * RPM, 2.0),
        HostSampling(rate_hz=250.0, jitter_s=0.001, command_s=0.004), model_true=True,
    ),
    CoveragePlant(
        "paper", "the paper's simulated inertia", 900.0, 74.3, 82.4, (1.0, 11.0), 4500.0,
        _lag(0.25), _lag(0.10), PlantNoise(25.0, 0.5, 60.0, 0.01, 0.003, 10.0, 0.1 * RPM, 5.0),
        HostSampling(jitter_s=0.004), model_true=True,
    ),
    CoveragePlant(
        "heavy", "large top drive, filters at a drive's defaults", 3000.0, 120.0, 400.0, (0.5, 12.0), 6000.0,
        _lag(0.50), _lag(0.10), PlantNoise(60.0, 1.5, 120.0, 0.01, 0.003, 30.0, 0.1 * RPM, 20.0),
        HostSampling(rate_hz=50.0, jitter_s=0.005, command_s=0.02), lowest_hz=0.05, model_true=True,
    ),
    CoveragePlant(
        "matched", "equal lags on both reports, 5 ms skew", 104.0, 8.0, 60.0, (0.5, 10.0), 400.0,
        _lag(0.15), _lag(0.15, delay_s=0.005), FIELD_NOISE, HostSampling(jitter_s=0.004), model_true=True,
        degenerate=True,
    ),
    CoveragePlant(
        "two_poles", "speed through two unequal poles", 60.0, 4.0, 40.0, (1.0, 20.0), 400.0,
        _lag(0.20, 0.07), _lag(0.10), PlantNoise(3.0, 0.5, 8.0, 0.02, 0.004, 2.0, 0.1 * RPM, 1.0),
        HostSampling(jitter_s=0.004),
    ),
    CoveragePlant(
        "average", "speed as a moving average", 180.0, 12.0, 70.0, (0.5, 12.0), 700.0,
        _lag(average_s=0.40), _lag(0.08), PlantNoise(6.0, 0.5, 15.0, 0.02, 0.003, 3.0, 0.1 * RPM, 2.0),
        HostSampling(jitter_s=0.003),
    ),
    CoveragePlant(
        "average_lag", "speed as a moving average behind a lag", 104.0, 8.0, 60.0, (0.5, 10.0), 400.0,
        _lag(0.10, average_s=0.50), _lag(0.15), FIELD_NOISE, HostSampling(jitter_s=0.004),
    ),
    CoveragePlant(
        "both_averages", "two moving averages of different length", 30.0, 1.5, 25.0, (2.0, 30.0), 300.0,
        _lag(average_s=0.30), _lag(average_s=0.10), PlantNoise(2.0, 0.4, 5.0, 0.03, 0.004, 1.0, 0.1 * RPM, 0.5),
        HostSampling(rate_hz=250.0, jitter_s=0.001, command_s=0.004), lowest_hz=0.2,
    ),
    CoveragePlant(
        "modbus", "10 Hz, speed read 40 ms before torque, stamps to 5 ms, command in steps of 0.1 s", 350.0, 20.0,
        150.0, (0.5, 12.0), 1200.0, _lag(0.30), _lag(0.10),
        PlantNoise(10.0, 0.6, 25.0, 0.02, 0.003, 5.0, 0.1 * RPM, 3.0),
        HostSampling(10.0, 0.010, 0.005, -0.020, 0.020, 0.0, 0.1),
    ),
    CoveragePlant(
        "torque_average", "torque as a moving average, longer than the speed's lag", 104.0, 8.0, 60.0, (0.5, 10.0),
        400.0, _lag(0.20), _lag(average_s=0.60), FIELD_NOISE, HostSampling(jitter_s=0.004),
    ),
    CoveragePlant(
        "torque_poles", "torque through two equal poles", 104.0, 8.0, 60.0, (0.5, 10.0), 400.0,
        _lag(0.10), _lag(0.25, 0.25), FIELD_NOISE, HostSampling(jitter_s=0.004),
    ),
    CoveragePlant(
        "long_poles", "speed through two long poles", 104.0, 8.0, 60.0, (0.5, 10.0), 400.0,
        _lag(0.50, 0.30), _lag(0.15), FIELD_NOISE, HostSampling(jitter_s=0.004),
    ),
    CoveragePlant(
        "three_poles", "speed through three poles, one more than any model has", 104.0, 8.0, 60.0, (0.5, 10.0), 400.0,
        _lag(0.20, 0.20, 0.20), _lag(0.15), FIELD_NOISE, HostSampling(jitter_s=0.004),
    ),
    CoveragePlant(
        "dead_time", "speed merely late, by 0.3 s", 104.0, 8.0, 60.0, (0.5, 10.0), 400.0,
        _lag(delay_s=0.30), _lag(), FIELD_NOISE, HostSampling(jitter_s=0.004),
    ),
    CoveragePlant(
        "long_average", "speed as a moving average over 1 s", 104.0, 8.0, 60.0, (0.5, 10.0), 400.0,
        _lag(average_s=1.0), _lag(0.15), FIELD_NOISE, HostSampling(jitter_s=0.004),
    ),
    CoveragePlant(
        "crossed", "the long lag on torque, a short one on speed", 40.0, 3.0, 30.0, (1.0, 20.0), 300.0,
        _lag(0.10), _lag(0.40), PlantNoise(2.0, 0.5, 6.0, 0.02, 0.004, 1.5, 0.1 * RPM, 0.8),
        HostSampling(jitter_s=0.004),
    ),
    CoveragePlant(
        "modbus_poles", "10 Hz, instants 40 ms apart, speed through two poles", 350.0, 20.0, 150.0, (0.5, 12.0), 1200.0,
        _lag(0.30, 0.10), _lag(0.10), PlantNoise(10.0, 0.6, 25.0, 0.02, 0.003, 5.0, 0.1 * RPM, 3.0),
        HostSampling(10.0, 0.010, 0.005, -0.020, 0.020, 0.0, 0.1),
    ),
    CoveragePlant(
        "stribeck", "friction that falls by 24 N·m from rest to 3 rad/s, then rises", 104.0, 8.0, 60.0, (0.5, 10.0),
        400.0, _lag(0.40), _lag(0.15), FIELD_NOISE, HostSampling(jitter_s=0.004), bend=NonlinearFriction(24.0, 1.5),
    ),
    CoveragePlant(
        "fan", "half of the friction's slope goes with the square of speed", 104.0, 4.0, 60.0, (0.5, 10.0), 400.0,
        _lag(0.40), _lag(0.15), FIELD_NOISE, HostSampling(jitter_s=0.004),
        bend=NonlinearFriction(square_nm_s2_rad2=0.6),
    ),
    # plants that gave wide intervals, or refusals of sound runs, on randomly drawn rigs (benchmarks/random_rigs.py)
    CoveragePlant(
        "short_matched", "5 ms on both reports", 104.0, 8.0, 60.0, (0.5, 10.0), 400.0, _lag(0.005), _lag(0.005),
        FIELD_NOISE, HostSampling(jitter_s=0.004), model_true=True, degenerate=True,
    ),
    CoveragePlant(
        "short_heavy", "6.4 and 3.2 ms on a large top drive", 3000.0, 120.0, 400.0, (0.5, 12.0), 6000.0, _lag(0.0064),
        _lag(0.0032), PlantNoise(60.0, 1.5, 120.0, 0.01, 0.003, 30.0, 0.1 * RPM, 20.0),
        HostSampling(rate_hz=50.0, jitter_s=0.005, command_s=0.02), lowest_hz=0.05, model_true=True, degenerate=True,
    ),
    CoveragePlant(
        "both_long", "long lags on both reports", 104.0, 8.0, 60.0, (0.5, 10.0), 400.0, _lag(0.70), _lag(0.55),
        FIELD_NOISE, HostSampling(jitter_s=0.004), model_true=True,
    ),
    CoveragePlant(
        "stribeck_short", "friction that falls by 24 N·m, behind lags of 5 ms", 104.0, 8.0, 60.0, (0.5, 10.0), 400.0,
        _lag(0.005), _lag(0.005), FIELD_NOISE, HostSampling(jitter_s=0.004), bend=NonlinearFriction(24.0, 1.5),
    ),
    CoveragePlant(
        "fan_lag", "nearly all of the friction's slope goes with the square of speed, behind 0.3 s", 104.0, 1.0, 60.0,
        (0.5, 10.0), 400.0, _lag(0.30), _lag(0.05), FIELD_NOISE, HostSampling(jitter_s=0.004),
        bend=NonlinearFriction(square_nm_s2_rad2=1.0),
    ),
    CoveragePlant(
        "register", "whole rpm, ten times a second, in little noise", 350.0, 20.0, 150.0, (0.5, 12.0), 1200.0,
        _lag(0.30), _lag(0.10), PlantNoise(5.0, 0.6, 5.0, 0.001, 0.001, 2.0, 1.0 * RPM, 3.0),
        HostSampling(10.0, command_s=0.1),
    ),
    CoveragePlant(
        "calm_coarse", "speed in half rpm, torque in percent, hardly any noise", 104.0, 8.0, 60.0, (0.5, 10.0), 400.0,
        _lag(0.40), _lag(0.15), PlantNoise(0.6, 0.5, 1.0, 0.001, 0.0, 0.2, 0.5 * RPM, 4.0),
    ),
    CoveragePlant(
        "late_torque", "torque read 60 ms after speed", 250.0, 15.0, 90.0, (0.5, 12.0), 900.0, _lag(0.20), _lag(0.10),
        PlantNoise(8.0, 0.8, 20.0, 0.02, 0.004, 4.0, 0.1 * RPM, 2.0), HostSampling(20.0, 0.005, torque_after_s=0.060),
        model_true=True,
    ),
    CoveragePlant(
        "late_speed", "speed read 60 ms after torque, both hardly filtered", 104.0, 8.0, 60.0, (0.5, 10.0), 400.0,
        _lag(0.010), _lag(0.005), FIELD_NOISE, HostSampling(20.0, 0.005, speed_after_s=0.060), model_true=True,
        degenerate=True,
    ),
    CoveragePlant(
        "three_poles_torque", "torque through three poles", 104.0, 8.0, 60.0, (0.5, 10.0), 400.0, _lag(0.10),
        _lag(0.15, 0.12, 0.10), FIELD_NOISE, HostSampling(jitter_s=0.004),
    ),
    CoveragePlant(
        "three_poles_both", "both signals through three poles", 104.0, 8.0, 60.0, (0.5, 10.0), 400.0,
        _lag(0.22, 0.15, 0.10), _lag(0.10, 0.06, 0.04), FIELD_NOISE, HostSampling(jitter_s=0.004),
    ),
    CoveragePlant(
        "slow_load", "a load of 12 N·m that wanders in eight seconds", 104.0, 8.0, 60.0, (0.5, 10.0), 400.0, _lag(0.30),
        _lag(0.10), PlantNoise(12.0, 8.0, 10.0, 0.02, 0.003, 2.0, 0.1 * RPM, 1.0), HostSampling(jitter_s=0.004),
        model_true=True,
    ),
)
