"""How much disturbs the equation of motion: assumed from the machine's size, or measured at steady speed.

What an estimator fights with at a line is the error of T − G W. With the load disturbance (density S_L, correlated over
τ_L) and the speed sensor's white noise (density S_ω) it has, behind the lag τ_T of the torque report, the density

    S(f) = (S_L/(1 + (ω τ_L)²) + |J s + B|² S_ω) / (1 + (ω τ_T)²),     s = jω,

whatever regulates the shaft: torque that the drive itself makes is in both signals and cancels. Densities are
two-sided, per Hz. A line fitted to one period of length L then has E|r|² = 4 S/L, a mean over L the variance S(0)/L.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from tdhil.estimation.frequency_domain.model import Model
from tdhil.estimation.frequency_domain.signal_filters import SPEED_LAG, TORQUE_LAG
from tdhil.estimation.frequency_domain.spectrum import period_lines
from tdhil.estimation.samples import Samples, Stretch
from tdhil.recording.recording import FloatArray, LagPrior, Segment

RIGID = Model()
"""The model that plans are made with; theta (8,) = (J, B) and the six parameters of the reports."""

LOAD_SHARE = 0.0075        # of the torque limit: sd of the load where nobody has measured it
LOAD_TIME_S = 0.5
SENSOR_SHARE = 0.002       # of the highest speed: sd of the speed sensor in 2 ms
_SENSOR_STEP_S = 0.002
SPEED_LAG_S = 0.40         # what a drive's smoothing of its speed, and of its torque, may be where nobody says
TORQUE_LAG_S = 0.15
_LOW_LINES = 3             # of a stretch: its lowest lines tell the load
_HIGH_LINES = 9            # … those behind them, up to this one, what grows with frequency
_LEAST_SHARE = 1e-3        # of the assumed density: less than that, and something else will set the interval


@dataclass(frozen=True)
class Noise:
    """Densities S_L, (N·m)²·s, and S_ω, (rad/s)²·s; the load's correlation time, s."""

    load_nm2_s: float
    speed_rad2_s: float
    load_time_s: float = LOAD_TIME_S
    source: Literal["assumed", "measured"] = "assumed"

    @property
    def load_sd_nm(self) -> float:
        """Standard deviation of the load disturbance: S_L = 2 sd² τ_L."""
        return math.sqrt(0.5 * self.load_nm2_s / self.load_time_s)

    def error_density(self, hertz: FloatArray, theta: FloatArray) -> FloatArray:
        """S of T − G W, (N·m)²·s, at frequencies (K,); theta (8,) of the rigid model."""
        omega = 2.0 * np.pi * np.asarray(hertz, dtype=np.float64)
        shaft = (theta[0] * omega) ** 2 + theta[1] ** 2
        load = self.load_nm2_s / (1.0 + (omega * self.load_time_s) ** 2)
        lag = float(theta[RIGID.at(TORQUE_LAG)])
        density: FloatArray = (load + shaft * self.speed_rad2_s) / (1.0 + (omega * lag) ** 2)
        return density


def assumed_noise(torque_limit_nm: float, speed_max_rad_s: float, load_sd_nm: float | None = None) -> Noise:
    """Shares of what the machine can do, which is what a range of machines show; or a load that somebody states."""
    load = LOAD_SHARE * torque_limit_nm if load_sd_nm is None else load_sd_nm
    return Noise(2.0 * load**2 * LOAD_TIME_S, (SENSOR_SHARE * speed_max_rad_s) ** 2 * _SENSOR_STEP_S)


def assumed_theta(inertia_kg_m2: float, viscous_nm_s_rad: float, prior: LagPrior) -> FloatArray:
    """(8,): first-order lags, as stated, else what they may be."""
    theta = np.zeros(RIGID.size)
    theta[:2] = inertia_kg_m2, viscous_nm_s_rad
    theta[RIGID.at(SPEED_LAG)] = SPEED_LAG_S if prior.speed_lag_s is None else prior.speed_lag_s
    theta[RIGID.at(TORQUE_LAG)] = TORQUE_LAG_S if prior.torque_lag_s is None else prior.torque_lag_s
    return theta


def measured_noise(steady: tuple[Samples, ...], theta: FloatArray, fallback: Noise) -> Noise:
    """Densities from stretches of steady speed, at the harmonics of each stretch's own length.

    The error's line e = T − G W takes spectra and cross spectrum of the two signals at once, and stays the same under
    whatever regulates the speed: |e|² L/4 is a reading of S with two degrees of freedom. The lowest lines of all
    stretches tell S_L with the correlation time assumed, the next ones what |J s + B|² S_ω adds. With lags other than
    theta's some of the drive's own torque stays in e, so that the reading errs on the high side.
    """
    frequencies: list[FloatArray] = []
    readings: list[FloatArray] = []
    for samples in steady:
        read = _readings(samples, theta)
        if read is not None:
            frequencies.append(read[0])
            readings.append(read[1])
    if not readings:
        return fallback
    hertz, density = np.concatenate(frequencies), np.concatenate(readings)
    low = np.concatenate([np.arange(len(part)) < _LOW_LINES for part in readings])
    unit_load = Noise(1.0, 0.0).error_density(hertz, theta)
    unit_speed = Noise(0.0, 1.0).error_density(hertz, theta)
    load = float(np.mean(density[low] / unit_load[low]))
    speed = float(np.mean((density[~low] - load * unit_load[~low]) / unit_speed[~low])) if np.any(~low) else 0.0
    if not (math.isfinite(load) and math.isfinite(speed)):
        return fallback
    return Noise(max(load, _LEAST_SHARE * fallback.load_nm2_s), max(speed, 0.0), source="measured")


def _readings(samples: Samples, theta: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Frequencies and readings of S, (K,) each, of one stretch; None if it is too short to tell."""
    if len(samples) < 4 * _HIGH_LINES:
        return None
    interval = float(np.median(np.diff(samples.time_s)))
    begin, length = float(samples.time_s[0]), float(samples.time_s[-1] - samples.time_s[0]) + interval
    hertz = np.arange(1.0, _HIGH_LINES + 1.0) / length
    lines = tuple(float(one) for one in hertz)
    segment = Segment(begin, begin + length, length, 0, float(np.mean(samples.speed_rad_s)), lines, (), ())
    try:
        found = period_lines(Stretch(segment, (samples,), (0,)), samples)
    except np.linalg.LinAlgError:       # samples that do not tell these frequencies apart
        return None
    torque = found.torque[0] - theta[1] * found.drift[0] * found.ramp[0]
    s = 2j * np.pi * hertz.astype(np.complex128)
    error = torque - RIGID.impedance(theta, s) * found.speed[0]
    readings: FloatArray = np.abs(error) ** 2 * length / 4.0
    return hertz, readings
