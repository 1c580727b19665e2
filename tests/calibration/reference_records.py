"""Synthetic records of drive torque and a reference sensor, each with its own filter, rate and time.

The filters are solved sample by sample on a fine grid, without code of the estimation.
"""

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from tdhil.calibration import TorqueRecord

FINE_S = 0.002


@dataclass(frozen=True)
class SensorBench:
    """One case. ``factor``: true over reported torque. ``time_offset_s``: sensor time relative to the log."""

    factor: float = 0.95
    offset_nm: float = 1.5
    time_offset_s: float = 37.2
    report_lag_s: float = 0.15
    sensor_lag_s: float = 0.05
    report_rate_hz: float = 100.0
    sensor_rate_hz: float = 61.0
    report_noise_nm: float = 1.5
    sensor_noise_nm: float = 1.0
    swing_nm: float = 100.0
    duration_s: float = 240.0
    slow_noise_nm: float = 0.0
    """Noise of the sensor, correlated over 3 s."""


def random_bench(rng):
    """Return a bench of the study with random scale, offset, noise, delay, rate and low-pass filter of the sensor."""
    return SensorBench(
        factor=rng.uniform(0.92, 1.08), offset_nm=rng.uniform(-5.0, 5.0), time_offset_s=rng.uniform(-500.0, 500.0),
        report_lag_s=rng.uniform(0.0, 0.3), sensor_lag_s=rng.uniform(0.0, 0.5),
        report_rate_hz=rng.choice([50.0, 100.0, 250.0]), sensor_rate_hz=rng.uniform(15.0, 150.0),
        report_noise_nm=np.exp(rng.uniform(np.log(0.3), np.log(6.0))),
        sensor_noise_nm=np.exp(rng.uniform(np.log(0.3), np.log(6.0))), swing_nm=rng.uniform(40.0, 200.0),
        duration_s=rng.uniform(120.0, 400.0), slow_noise_nm=rng.uniform(0.0, 0.5))


def true_torque(rng, time_s, swing_nm):
    """Return ramps between steady torques, a multisine in the second half, and a random torque of the rig."""
    end = time_s[-1]
    ramps = np.interp(time_s, end * np.array([0.0, 0.05, 0.1, 0.25, 0.3, 0.45, 0.5, 0.96, 1.0]),
                      swing_nm * np.array([0.0, 0.0, 0.9, 0.9, 0.55, 0.55, 0.7, 0.7, 0.0]))
    lines, period = np.array([1, 2, 3, 5, 7, 10, 14]) / 20.0, (time_s > 0.5 * end) & (time_s < 0.95 * end)
    waves = sum(np.cos(2.0 * np.pi * hz * time_s + phase)
                for hz, phase in zip(lines, rng.uniform(0.0, 2.0 * np.pi, len(lines)), strict=True))
    rig = lfilter([FINE_S / 0.5], [1.0, FINE_S / 0.5 - 1.0], rng.standard_normal(len(time_s)))
    return ramps + 0.05 * swing_nm * waves * period + 0.01 * swing_nm * rig / rig.std()


def lagging(signal, lag_s):
    """Apply a first-order low-pass filter."""
    pole = np.exp(-FINE_S / lag_s) if lag_s > 0.0 else 0.0
    return lfilter([1.0 - pole], [1.0, -pole], signal)


def records(bench, rng):
    """Return (record of the drive, record of the sensor)."""
    fine = np.arange(0.0, bench.duration_s, FINE_S)
    torque = true_torque(rng, fine, bench.swing_nm)
    report_s = np.arange(0.5, bench.duration_s - 0.5, 1.0 / bench.report_rate_hz)
    report_s = report_s + 0.1 / bench.report_rate_hz * rng.uniform(-1.0, 1.0, len(report_s))
    reported = np.interp(report_s, fine, lagging(torque, bench.report_lag_s)) / bench.factor
    sensor_s = np.arange(0.05 * bench.duration_s, bench.duration_s - 1.0, 1.0 / bench.sensor_rate_hz)
    slow = lfilter([1.0], [1.0, FINE_S / 3.0 - 1.0], rng.standard_normal(len(fine)))
    seen = lagging(torque, bench.sensor_lag_s) + bench.offset_nm + bench.slow_noise_nm * slow / slow.std()
    seen = np.interp(sensor_s, fine, seen)
    return (
        TorqueRecord(report_s, reported + bench.report_noise_nm * rng.standard_normal(len(report_s))),
        TorqueRecord(sensor_s + bench.time_offset_s, seen + bench.sensor_noise_nm * rng.standard_normal(len(sensor_s))),
    )
