"""Evaluation of samples as in the paper's sections 4.3 (α, line, J) and 3.4.1 (amplitude, gain, phase)."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

import numpy as np

from tdhil.estimation import LineFit, line_fit
from tdhil.recording import FloatArray


def backward_difference(time_s: FloatArray, speed_rad_s: FloatArray) -> FloatArray:
    """Return α = (ω1 − ω0)/(t1 − t0), rad/s² (equation 16): one value less than samples."""
    return np.diff(speed_rad_s) / np.diff(time_s)


def torque_line(time_s: FloatArray, speed_rad_s: FloatArray, torque_nm: FloatArray) -> LineFit:
    """Return T = Jα + b by least squares (section 4.3): slope J, intercept b = T_c + B·mean speed (the paper:
    "damping").

    α belongs to the middle of an interval Ts, the torque to its end, as in a log. In steady state T(t + Ts/2) ≈ T(t) +
    (Ts/2)(J dα/dt + B α): dα/dt is uncorrelated with α, and B α adds B·Ts/2 to the slope (0.037 kg·m² at 74.3 N·m·s/rad
    and 1 ms).
    """
    fit = line_fit(backward_difference(time_s, speed_rad_s), torque_nm[1:])
    if fit is None:
        raise ValueError("the speed never changes, so it gives no inertia")
    return fit


def amplitude(signal: FloatArray) -> float:
    """Return half of largest less smallest value (equation 11)."""
    return 0.5 * float(signal.max() - signal.min())


def gain(output: FloatArray, given: FloatArray) -> float:
    """Return A_out/A_in. Equation 12 prints A_in/A_out; the paper's text and figures (0.96 for a lagging sine) mean
    this.
    """
    return amplitude(output) / amplitude(given)


def rising_zeros(time_s: FloatArray, signal: FloatArray) -> FloatArray:
    """Return the times at which the signal's alternating part rises through zero, by linear interpolation.

    The alternating part is taken about the middle of largest and smallest value, which does not depend on a whole
    number of periods.
    """
    swing = signal - 0.5 * float(signal.max() + signal.min())
    before = np.flatnonzero((swing[:-1] < 0.0) & (swing[1:] >= 0.0))
    rise = swing[before + 1] - swing[before]
    return np.asarray(time_s[before] - swing[before] * (time_s[before + 1] - time_s[before]) / rise)


def phase_by_zeros(time_s: FloatArray, output: FloatArray, given: FloatArray, frequency_hz: float) -> float:
    """Return φ = 2πf(t_out − t_in), rad (equation 13): positive for a lagging output, in [−π, π); mean over all pairs.

    Each rise of the input is paired with the nearest rise of the output; nan without one.
    """
    starts, ends = rising_zeros(time_s, given), rising_zeros(time_s, output)
    if len(starts) == 0 or len(ends) == 0:
        return float("nan")
    away = ends[np.newaxis, :] - starts[:, np.newaxis]
    nearest = away[np.arange(len(starts)), np.abs(away).argmin(axis=1)]
    cycles = nearest[np.abs(nearest) <= 0.5 / frequency_hz] * frequency_hz
    return float(2.0 * pi * cycles.mean()) if len(cycles) else float("nan")


def fundamental(time_s: FloatArray, signal: FloatArray, frequency_hz: float) -> complex:
    """Return the coefficient c of Re(c e^{j2πft}) in the signal.

    Least squares on [1, cos, sin]. For whole periods of evenly spaced samples this equals the Fourier coefficient (2/N)
    Σ x e^{−j2πft}, but neither is required.
    """
    turn = 2.0 * pi * frequency_hz * time_s
    columns = np.column_stack((np.ones_like(turn), np.cos(turn), np.sin(turn)))
    _, real, imaginary = np.linalg.lstsq(columns, signal, rcond=None)[0]
    return complex(real, -imaginary)


@dataclass(frozen=True)
class Response:
    """Response of the speed to a sine; lags are positive."""

    amplitude_in_rad_s: float
    amplitude_out_rad_s: float
    gain: float
    lag_zeros_deg: float
    """Phase lag from the zero crossings, degrees."""
    gain_fundamental: float
    lag_fundamental_deg: float
    """Phase lag from the fundamental's Fourier coefficient, degrees: robust against noise and harmonics."""

    @property
    def amplitude_difference_rad_s(self) -> float:
        """Difference A_in − A_out, rad/s."""
        return self.amplitude_in_rad_s - self.amplitude_out_rad_s


def response(time_s: FloatArray, given: FloatArray, output: FloatArray, frequency_hz: float) -> Response:
    """Return equations 11 to 13, and gain and phase of the fundamental."""
    ratio = fundamental(time_s, output, frequency_hz) / fundamental(time_s, given, frequency_hz)
    return Response(
        amplitude(given), amplitude(output), gain(output, given),
        float(np.degrees(phase_by_zeros(time_s, output, given, frequency_hz))),
        abs(ratio), float(-np.degrees(np.angle(ratio))),
    )


def settled_periods(steps: int, sample_period_s: float, period_s: float) -> slice | None:
    """Return the last whole periods of a record's second half, both end samples included; None if no period fits.

    The start-up is over by then, and over whole periods speed and acceleration are uncorrelated.
    """
    periods = int(0.5 * steps * sample_period_s / period_s + 1e-9)
    if periods < 1:
        return None
    return slice(steps - round(periods * period_s / sample_period_s), steps + 1)
