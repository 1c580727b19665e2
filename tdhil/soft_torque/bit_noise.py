r"""Random torque of the bit, estimated from recorded torque and speed of the top drive. No motion is commanded for it.

**Torque at the bit.** In the frequency domain, τ = T − jΩJω at the top of the string. A line with inertia m, compliance
y and drag d per metre carries speed and torque from its upper to its lower end (length L)::

    ω' = cosh γL ω − (jΩy/γ) sinh γL τ        γ² = jΩy (jΩm + d)
    τ' = cosh γL τ − ((jΩm + d)/γ) sinh γL ω

At the bit, J_L dω/dt = τ − b ω − T_f(ω) − n(t), so n = τ − (jΩJ_L + b + T_f'(ω₀)) ω for small motion about the mean
speed ω₀. The slope T_f' is that of the stated bit. The record cannot give it: all that moves the bit is n itself.

**Noise of the reports.** Noise and resolution of the reported signals are white. Their densities follow from the top
of the spectrum, where the reports' lags leave no motion. n is linear in both signals, so both densities give
a known part of the spectrum of n.

**Fit.** n is a first-order Gauss–Markov process: its density is 4σ²θ/(1 + (Ωθ)²). σ, and θ where the record shows it,
maximise Whittle's likelihood of the averaged spectrum (Hann windows with half overlap) in the band of the string's
lowest modes. The interval is the root of the sum of squares of the scatter, J, the torque scale, and the string's
tolerances.

**Held correlation time.** If the record does not show θ, it is held at the stated value. The record then determines the
density at the string's lowest mode, which excites stick-slip. σ is that of a noise with the held θ and this density.
Its interval contains the fits with a much shorter θ and with twice the θ, converted in the same way.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import exp, inf, log, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from tdhil.soft_torque.drill_string import NOISE_CORRELATION_S, BitFriction, DrillString
from tdhil.soft_torque.simulation import Array
from tdhil.soft_torque.torsional_severity import (
    STICK_SLIP_INDEX,
    SeverityRefused,
    SurfaceRecord,
    string_ends,
    turning_spans,
)
from tdhil.soft_torque.tuned_figures import in_squares, string_modes_hz
from tdhil.soft_torque.uncertainty import COVERAGE_K, Interval, StringFactors

ComplexArray = NDArray[np.complex128]

SEGMENT_PERIODS = 6.0
"""Length of a segment of the spectrum, in periods of the string's lowest mode."""
LEAST_SEGMENTS = 8
"""Least number of segments. They overlap by half."""
LOWEST_MODE_SHARE, HIGHEST_MODE_SHARE = 0.6, 3.5
"""Band of the fit, as multiples of the lowest mode's frequency. Below it the driller's set speed and weight on bit
change; above it the travel time of the waves is not known well enough."""
LEAST_SAMPLES = 5.0
"""Least number of samples in one period of the highest frequency of the band."""
WHITE_FROM = 0.5
"""Frequency from which the reports contain noise only, as a share of half of the sampling rate."""
OVERLAP_DOF = 0.947
"""Degrees of freedom of half-overlapping Hann windows, as a share of those of independent segments (Welch 1967)."""
NEIGHBOURS = 1.94
"""Variance of a mean over neighbouring frequencies of Hann windows, as a multiple of that of independent ones."""
MOST_REPORT_SHARE = 0.7
"""Largest part of the spectrum in the band that may come from the noise of the reports."""
MOST_MISFIT = 6.0
"""Largest mean square of the spectrum's deviations, in units of their variance. Above it the record contradicts string
or J. Values above 1 widen the interval."""
MOST_SPREAD = 2.5
"""Largest ratio of the ends of the interval to its value. A wider one is refused."""
MOST_CORRELATION_SPREAD = 1.6
"""Largest ratio of the ends of the interval of θ to its value. A wider θ is held at the stated value. With 3, a θ of
0.1 s was taken only from records whose scatter made it look longer: 0.20 to 0.29 s in 5 of 12."""
HELD_FACTORS = 0.01, 2.0
"""Ends of θ, as multiples of a held one, for the interval of σ: white in the band; and the longest one that a record of
600 s on the reference string does not show."""


@dataclass(frozen=True)
class BitNoiseEstimate:
    """Random torque of the bit in one record."""

    rms_nm: Interval
    """Root mean square, N·m. If the correlation time is held: that of a noise with the stated correlation time and the
    same density at the string's lowest mode."""
    correlation_s: Interval
    """Correlation time, s. If its ends are equal, it is the stated value."""
    band_hz: tuple[float, float]
    """Frequencies that were used."""
    segments: int
    report_share: float
    """Part of the spectrum in the band that comes from the noise of the reports."""

    @property
    def correlation_measured(self) -> bool:
        """True: the record determines the correlation time."""
        return self.correlation_s.high > self.correlation_s.low


@dataclass(frozen=True)
class _ReportSpectra:
    """Segments of the reported signals: spectra (segments, frequencies), and densities of their white noise."""

    hertz: Array
    speed: ComplexArray
    torque: ComplexArray
    per_density: float
    """Power of a line, divided by its density: Σ window²/rate."""
    speed_noise: float
    """Density of the noise of the reported speed, (rad/s)²/Hz, one-sided."""
    torque_noise: float
    mean_rad_s: float


def bit_noise_in(record: SurfaceRecord, string: DrillString, inertia: Interval) -> BitNoiseEstimate:
    """Return the random torque of the bit. Raises SeverityRefused if the record does not determine it.

    ``string``: with its bit, whose friction slope and correlation time are used. ``inertia``: J at the main shaft.
    """
    held_s = NOISE_CORRELATION_S if string.bit is None else string.bit.noise_correlation_s
    spectra = _spectra(record, string, inertia)
    value = _fitted(spectra, string, inertia.value, record, held_s)
    if value.report_share > MOST_REPORT_SHARE:
        raise SeverityRefused(
            f"the noise of the reports is {100.0 * value.report_share:.0f} % of the torque at the bit in this record, "
            f"and at most {100.0 * MOST_REPORT_SHARE:.0f} % are allowed",
            next_step="Record faster, with a finer resolution, or with shorter filters of the reports")
    if value.misfit > MOST_MISFIT:
        raise SeverityRefused(
            "the spectrum of the torque at the bit is not that of a noise: its deviation is "
            f"{value.misfit:.1f} times its scatter",
            next_step="Check length and sizes in string.yaml, J and the lags of the reports")
    moved = [[_fitted(spectra, string, end, record, held_s).rms for end in (inertia.low, inertia.high)]]
    moved.append([_fitted(replace(spectra, torque=end * spectra.torque, torque_noise=end**2 * spectra.torque_noise),
                          string, end * inertia.value, record, held_s).rms for end in record.scale_ends])
    moved += [[_fitted(spectra, end, inertia.value, record, held_s).rms for end in pair]
              for pair in (*string_ends(string), *_bit_ends(string))]
    if value.correlation_log_sd == 0.0:      # θ is held
        lowest_rad_s = np.array(2.0 * pi * string_modes_hz(string)[0])
        shorter, longer = (_fitted(spectra, string, inertia.value, record, factor * held_s, hold=True)
                           for factor in HELD_FACTORS)
        unit = _density(held_s, lowest_rad_s)
        moved.append([other.rms * sqrt(_density(other.correlation_s, lowest_rad_s) / unit)
                      for other in (shorter, longer)])
    wider = COVERAGE_K * value.log_sd * sqrt(max(1.0, value.misfit))
    rms = in_squares(Interval(value.rms, value.rms * exp(-wider), value.rms * exp(wider)), moved)
    if rms.low <= 0.0 or rms.high / value.rms > MOST_SPREAD or value.rms / rms.low > MOST_SPREAD:
        raise SeverityRefused(
            f"the bit's random torque of {value.rms:.0f} N·m lies between {max(0.0, rms.low):.0f} and {rms.high:.0f} "
            "N·m in this record, which is too wide", next_step="Name a longer record of steady rotation, or narrow the "
            "tolerances in string.yaml")
    wide = COVERAGE_K * value.correlation_log_sd
    correlation = Interval(value.correlation_s, value.correlation_s * exp(-wide), value.correlation_s * exp(wide))
    band_hz = float(spectra.hertz[0]), float(spectra.hertz[-1])
    return BitNoiseEstimate(rms, correlation, band_hz, len(spectra.speed), value.report_share)


def with_noise(string: DrillString, rms_nm: Interval, correlation_s: float) -> DrillString:
    """Return the string whose bit has this random torque, with its interval as tolerance. The bit must be stated."""
    assert string.bit is not None
    factor = max(rms_nm.high / rms_nm.value, rms_nm.value / rms_nm.low)
    return replace(string, bit=replace(string.bit, noise_nm=rms_nm.value, noise_correlation_s=correlation_s),
                   tolerance=replace(string.tolerance, noise_factor=factor))


# ---------------------------------------------------------------------------------------------------------------------
# Spectra of the record.


def _spectra(record: SurfaceRecord, string: DrillString, inertia: Interval) -> _ReportSpectra:
    """Return the segments in which the bit turns and never nearly stops."""
    mode = string_modes_hz(string)[0]
    period_s, highest = 1.0 / mode, HIGHEST_MODE_SHARE * mode
    step = float(np.median(np.diff(record.time_s))) if len(record.time_s) > 1 else inf
    if step * LEAST_SAMPLES * highest > 1.0:
        raise SeverityRefused(
            f"the record has a sample every {step:.3g} s, and the torque at the bit is needed up to {highest:.2g} Hz",
            next_step=f"Record at {LEAST_SAMPLES * highest:.2g} Hz or faster")
    size = round(SEGMENT_PERIODS * period_s / step)
    window, ramp = np.hanning(size), np.linspace(-1.0, 1.0, size)
    hertz: Array = np.asarray(np.fft.rfftfreq(size, step), dtype=np.float64)
    band = (hertz >= LOWEST_MODE_SHARE * mode) & (hertz <= highest)
    white = hertz >= WHITE_FROM * 0.5 / step
    per_density = 0.5 * float(np.sum(window**2)) / step
    rows: list[tuple[ComplexArray, ComplexArray, float, float, float]] = []
    sticks = False
    for begin_s, end_s, index in turning_spans(record, string, inertia.value):
        if index >= STICK_SLIP_INDEX:
            sticks = True
            continue
        inside = np.flatnonzero((record.time_s >= begin_s) & (record.time_s <= end_s))
        grid = np.arange(record.time_s[inside[0]], record.time_s[inside[-1]], step)
        speed, torque = (np.interp(grid, record.time_s[inside], one[inside])
                         for one in (record.speed_rad_s, record.torque_nm))
        for start in range(0, len(grid) - size + 1, size // 2):
            parts = [one[start : start + size] for one in (speed, torque)]
            levels = [one - one.mean() for one in parts]
            lines = [np.fft.rfft(window * (level - ramp * float(level @ ramp) / float(ramp @ ramp)))
                     for level in levels]
            noise = [float(np.mean(np.abs(one[white]) ** 2)) / per_density for one in lines]
            rows.append((lines[0][band], lines[1][band], noise[0], noise[1], float(parts[0].mean())))
    if len(rows) < LEAST_SEGMENTS:
        needed_s = 0.5 * (LEAST_SEGMENTS + 1) * SEGMENT_PERIODS * period_s
        why = " without stick-slip" if sticks else ""
        raise SeverityRefused(
            f"the record has {len(rows)} segments of steady rotation{why}; the estimate needs "
            f"{LEAST_SEGMENTS}, which is {needed_s:.0f} s without a pause", next_step="Use a longer record of steady "
            "rotation at a set speed above the critical one")
    speeds, torques, speed_noise, torque_noise, means = zip(*rows, strict=True)
    return _ReportSpectra(hertz[band], np.array(speeds), np.array(torques), per_density, float(np.median(speed_noise)),
                    float(np.median(torque_noise)), float(np.mean(means)))


# ---------------------------------------------------------------------------------------------------------------------
# Fit.


@dataclass(frozen=True)
class _FittedNoise:
    rms: float
    correlation_s: float
    log_sd: float
    correlation_log_sd: float
    report_share: float
    misfit: float


def _density(correlation_s: float, omega: Array) -> Array:
    """Return the one-sided density of a Gauss–Markov process of unit variance, 1/Hz."""
    found: Array = 4.0 * correlation_s / (1.0 + (omega * correlation_s) ** 2)
    return found


def _fitted(
    spectra: _ReportSpectra, string: DrillString, inertia: float, record: SurfaceRecord, held_s: float,
    *, hold: bool = False,
) -> _FittedNoise:
    """Return the best σ, and θ if the spectrum determines it; else, or with ``hold``, θ is ``held_s``."""
    from scipy.optimize import minimize

    omega = 2.0 * pi * spectra.hertz
    s: ComplexArray = np.asarray(1j * omega, dtype=np.complex128)
    ones: ComplexArray = np.ones(len(s), dtype=np.complex128)
    none: ComplexArray = np.zeros(len(s), dtype=np.complex128)
    load = s * string.bottom_inertia_kg_m2 + string.bottom_viscous_nm_s_rad + _slope(string.bit, spectra.mean_rad_s)

    # The matrix of a line from its lower to its upper end has the determinant 1. Its inverse has the same diagonal, and
    # the other elements with the other sign, which are those of a line of negative length.
    down = replace(string, lines=tuple(replace(line, length_m=-line.length_m) for line in reversed(string.lines)))

    def at_bit(speed: ComplexArray, torque: ComplexArray) -> ComplexArray:
        speed_below, torque_below = (np.asarray(one) for one in down.carried_up(s, speed, torque))
        found: ComplexArray = torque_below - load * speed_below
        return found

    per_torque = at_bit(none, (1.0 + s * record.torque_lag_s) * ones)
    per_speed = at_bit((1.0 + s * record.speed_lag_s) * ones, -s * inertia * (1.0 + s * record.speed_lag_s))
    seen = np.mean(np.abs(spectra.speed * per_speed + spectra.torque * per_torque) ** 2, axis=0) / spectra.per_density
    reports = spectra.speed_noise * np.abs(per_speed) ** 2 + spectra.torque_noise * np.abs(per_torque) ** 2
    weight = OVERLAP_DOF * len(spectra.speed) / NEIGHBOURS
    excess = max(float(np.mean(seen - reports)), 1e-6 * float(np.mean(seen)))

    def density(parts: Array) -> Array:
        found: Array = np.exp(2.0 * parts[0]) * _density(float(np.exp(parts[1])), omega)
        return found

    def whittle(parts: Array) -> float:
        model = density(parts) + reports
        return float(np.sum(np.log(model) + seen / model))

    def start(theta: float) -> float:
        return 0.5 * log(excess / float(np.mean(density(np.array([0.0, log(theta)])))))

    def information(parts: Array) -> Array:
        share = density(parts) / (density(parts) + reports)
        square = (omega * np.exp(parts[1])) ** 2
        slopes = np.stack([2.0 * share, share * (1.0 - square) / (1.0 + square)])
        found: Array = weight * slopes @ slopes.T
        return found

    bounds = [(start(held_s) - 5.0, start(held_s) + 5.0), (log(held_s) - 4.0, log(held_s) + 4.0)]
    best = minimize(whittle, [start(held_s), log(held_s)], method="L-BFGS-B", bounds=bounds).x
    spread = np.linalg.pinv(information(best))
    if hold or COVERAGE_K * sqrt(max(0.0, spread[1, 1])) > log(MOST_CORRELATION_SPREAD) or not (
            bounds[1][0] < best[1] < bounds[1][1]):
        bounds[1] = (log(held_s), log(held_s))
        best = minimize(whittle, [start(held_s), log(held_s)], method="L-BFGS-B", bounds=bounds).x
        spread = np.diag([1.0 / max(information(best)[0, 0], 1e-12), 0.0])
    model = density(best) + reports
    misfit = weight * NEIGHBOURS * float(np.mean((seen / model - 1.0) ** 2))
    return _FittedNoise(exp(best[0]), exp(best[1]), sqrt(max(0.0, spread[0, 0])), sqrt(max(0.0, spread[1, 1])),
                   float(np.median(reports / model)), misfit)


def _slope(bit: BitFriction | None, speed_rad_s: float) -> float:
    """Return dT_f/dω of the bit at that speed, N·m·s/rad."""
    if bit is None:
        return 0.0
    width = bit.stribeck_speed_rad_s
    falls = bit.static_nm - bit.coulomb_nm
    return -2.0 * falls * speed_rad_s / width**2 * exp(-min(700.0, (speed_rad_s / width) ** 2)) if width < inf else 0.0


def _bit_ends(string: DrillString) -> list[tuple[DrillString, DrillString]]:
    """Return the string at both ends of the tolerances of its bottom's inertia, drag and bit."""
    tolerance, bit = string.tolerance, string.bit
    share, factor = tolerance.bottom_inertia, tolerance.drag_factor
    factors = ((StringFactors(bottom=1.0 - share), StringFactors(bottom=1.0 + share)),
               (StringFactors(drag=1.0 / factor), StringFactors(drag=factor)))
    pairs = [(low.applied_to(string), high.applied_to(string)) for low, high in factors]
    if bit is not None and bit.stribeck_speed_rad_s < inf:
        pairs.append((replace(string, bit=replace(bit, stribeck_speed_rad_s=bit.stribeck_speed_rad_s
                                                  / tolerance.stribeck_factor)),
                      replace(string, bit=replace(bit, stribeck_speed_rad_s=bit.stribeck_speed_rad_s
                                                  * tolerance.stribeck_factor))))
    return [pair for pair in pairs if pair[0] != pair[1]]
