"""Cramér-Rao bound of the inertia, from the true parameters and the noise at the lines; uses no code of the estimator.

Over P whole periods of length L at one mean speed, the lines W_k of reported speed and T_k of reported torque obey
T_k = G_k W_k + r_k, with

    G = (J s + B) H_T(s)/H_w(s) e^(−d s),   E|r_k|² = 4 S_k/(P L).

W_k is a nuisance parameter, free at every line and mean speed. Concentrated out of the Gaussian likelihood of (T_k,
W_k), for any covariance of theirs, it leaves the information about theta

    F = 2 Re Σ_k |W_k|² (∂G_k/∂theta)ᴴ (∂G_k/∂theta) / E|r_k|²,

and the mean torque T̄ = B ω̄ + T_c + r₀, E r₀² = S_0/(P L), adds (∂T̄/∂theta)ᵀ(∂T̄/∂theta) P L/S_0. S is the density
(per Hz, two-sided) of r = T − G W on the sampled signals:

- the load, once: in T − G W it appears as −H_T·load (speed responds to it, the reported torque does not contain it);
- ripple turns the shaft and is reported: it cancels at the line, but its aliases at the line do not;
- the sensor's noise, through H_w, times |G|², and its aliases;
- the noise added to each report and the rounding (q²/12), white over the samples.

theta = (J, B, T_c, every lag, every average's width, the skew): derivatives by central differences.

This bound assumes that the number of poles and averages of each signal is known. For a drive without such data, more
parameters must be separated: with P = Π (1 + τ s) of each report,

    ln H_T/H_w − d s = ln P_w − ln P_T + a(s; u) − d s,    theta = (J, B, T_c, p₁ and p₂ of P_w, of P_T, u, d),

p₁ and p₂ are the coefficients of s and s² in P, and u is the square of an average's width, over either signal.
Plausible values count as measurements: p₁ with 1 s, u with 1 s², and p₂ with the standard deviation of a uniform
distribution between 0 (one pole) and p₁²/2 (a Butterworth filter). For equal poles the first bound is lower than
possible: they count as one unknown, because to first order only their sum is visible (the information about each of
them is singular).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tdhil.recording import FloatArray
from tdhil.studies.coverage.plants import ComplexArray, CoveragePlant, ReportFilter
from tdhil.studies.coverage.simulate import quiet_shaft

_FOLDS = 30              # multiples of the sampling rate whose aliases are included, on either side
_SINGULAR = 1e-10        # of the scaled information: below it the bound is not a number
_KNOWN_LAGS = [0, 1, 2, -1]
_PLAUSIBLE = 1.0         # s of a lag, s² of an average's square: standard deviations
_PLAUSIBLE_SHAPE = 0.5 / np.sqrt(12.0)     # of p₂/p₁²: uniform between 0 and 1/2
_SHORTEST_S = 1e-3
_ROUGH = np.array([-0.8, -0.4, 0.0, 0.4, 0.8])    # five equal shares of the rough inertia's error


@dataclass(frozen=True)
class WatchedSpeed:
    """Measured lines at one mean speed: ``speed`` (K,) complex, reported, rad/s, over ``seconds`` of whole periods."""

    mean_rad_s: float
    speed: ComplexArray
    seconds: float


def theta_of(plant: CoveragePlant) -> FloatArray:
    """Return (J, B, T_c, speed lags, speed average, torque lags, torque average, skew)."""
    parts = [plant.inertia_kg_m2, plant.viscous_nm_s_rad, plant.coulomb_nm]
    for report in (plant.speed_report, plant.torque_report):
        parts += [*report.lags_s, *([report.average_s] if report.average_s > 0.0 else [])]
    return np.array([*parts, plant.skew_s])


def impedance_of(plant: CoveragePlant, theta: FloatArray, s: ComplexArray) -> ComplexArray:
    """Return G(s) as the host measures it, (K,); the plant states which lags theta has."""
    rest = list(theta[3:-1])
    shown = []
    for report in (plant.speed_report, plant.torque_report):
        lags = tuple(float(rest.pop(0)) for _ in report.lags_s)
        shown.append(ReportFilter(lags, float(rest.pop(0)) if report.average_s > 0.0 else 0.0))
    shaft = theta[0] * s + theta[1]
    seen: ComplexArray = shaft * shown[1].response(s) / shown[0].response(s) * np.exp(-theta[-1] * s)
    return seen


def density(plant: CoveragePlant, hertz: FloatArray) -> FloatArray:
    """Return S of T − G W at the lines, (N·m)²/Hz, (K,)."""
    noise, rate = plant.noise, plant.reading.rate_hz
    s = 2j * np.pi * hertz.astype(np.complex128)
    g2 = np.abs(impedance_of(plant, theta_of(plant), s)) ** 2
    ripple, sensor = noise.ripple_nm**2 * plant.step_s, noise.sensor_rad_s**2 * plant.step_s
    total = np.zeros(len(hertz))
    for fold in range(-_FOLDS, _FOLDS + 1):
        f: ComplexArray = 2j * np.pi * (hertz + fold * rate).astype(np.complex128)
        if abs(fold) * rate > 0.5 / plant.step_s:
            continue
        load = 2.0 * noise.load_nm**2 * noise.load_time_s / (1.0 + np.abs(f * noise.load_time_s) ** 2)
        h_t, h_w = (np.abs(report.response(f)) ** 2 for report in (plant.torque_report, plant.speed_report))
        total += g2 * h_w * sensor
        if fold == 0:
            total += h_t * load
        else:
            shaft = np.abs(plant.inertia_kg_m2 * f + plant.viscous_nm_s_rad) ** 2
            total += h_t * ripple + g2 * h_w * (load + ripple) / shaft
    speed_white = noise.reported_speed_rad_s**2 + noise.speed_quantum_rad_s**2 / 12.0
    torque_white = noise.reported_torque_nm**2 + noise.torque_quantum_nm**2 / 12.0
    kept = rate * (1.0 - plant.reading.dropped)
    result: FloatArray = total + (torque_white + g2 * speed_white) / kept
    return result


def slopes_of(plant: CoveragePlant, hertz: FloatArray) -> ComplexArray:
    """Return ∂G/∂theta for a known structure of the filters, (K, n)."""
    theta = theta_of(plant)
    s = 2j * np.pi * hertz.astype(np.complex128)
    columns = []
    for index in range(len(theta)):
        by = np.zeros(len(theta))
        by[index] = 1e-5 * max(abs(theta[index]), 0.01)
        rise = impedance_of(plant, theta + by, s) - impedance_of(plant, theta - by, s)
        columns.append(rise / (2.0 * by[index]))
    slopes: ComplexArray = np.stack(columns, axis=1)
    return slopes


def slopes_of_unknown(plant: CoveragePlant, hertz: FloatArray) -> tuple[ComplexArray, FloatArray]:
    """Return ∂G/∂theta for an unknown structure, (K, 9), and the information from plausible values, (9, 9)."""
    s: ComplexArray = 2j * np.pi * hertz.astype(np.complex128)
    g = impedance_of(plant, theta_of(plant), s)
    one = np.ones_like(s)
    shaft: ComplexArray = plant.inertia_kg_m2 * s + plant.viscous_nm_s_rad
    columns: list[ComplexArray] = [s / shaft, one / shaft, 0.0 * s]
    sd = [np.inf] * 3
    for report, sign in ((plant.speed_report, 1.0), (plant.torque_report, -1.0)):
        polynomial = np.prod([1.0 + lag * s for lag in report.lags_s], axis=0) * one
        columns += [sign * s / polynomial, sign * s * s / polynomial]
        delay_s = max(sum(report.lags_s) + 0.5 * report.average_s, _SHORTEST_S)
        sd += [_PLAUSIBLE, _PLAUSIBLE_SHAPE * delay_s**2]
    average_s = max(plant.speed_report.average_s, plant.torque_report.average_s, _SHORTEST_S)
    half = np.minimum(0.5 * np.abs(s) * average_s, 0.9 * np.pi)
    columns += [0.125 * np.abs(s) ** 2 * (half / np.tan(half) - 1.0) / half**2, -s]
    sd += [_PLAUSIBLE, np.inf]
    return np.stack(columns, axis=1) * g[:, None], np.diag(np.array(sd) ** -2.0)


def information(
    plant: CoveragePlant, hertz: FloatArray, watched: list[WatchedSpeed], slopes: ComplexArray | None = None
) -> FloatArray:
    """Return the Fisher information about theta, (n, n); ``slopes`` (K, n): of another theta than that of known
    filters.
    """
    slopes = slopes_of(plant, hertz) if slopes is None else slopes
    at_lines, at_rest = density(plant, hertz), float(density(plant, np.zeros(1))[0])
    count = slopes.shape[1]
    found = np.zeros((count, count))
    for one in watched:
        weight = np.abs(one.speed) ** 2 * one.seconds / (4.0 * at_lines)
        found += 2.0 * (slopes.conj().T @ (weight[:, None] * slopes)).real
        level = np.zeros(count)
        level[1], level[2] = one.mean_rad_s, 1.0
        found += np.outer(level, level) * one.seconds / at_rest
    return found


def bound_of(fisher: FloatArray) -> float | None:
    """Return the least standard deviation of the first parameter; None if the parameters cannot be separated."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(fisher), 1e-300))
    scaled = fisher * np.outer(scale, scale)
    if float(np.linalg.eigvalsh(scaled)[0]) < _SINGULAR:
        return None
    return float(np.sqrt(np.linalg.inv(scaled)[0, 0]) * scale[0])


@dataclass(frozen=True)
class Bounds:
    """Least standard deviations of J, kg·m²: for a known and for an unknown structure of the filters.

    If the lags cannot be separated, ``known`` assumes known lags; it is then not a bound for tdhil's estimator.
    ``unknown`` is never smaller, because the structure of a plant may have more than its theta.
    """

    known: float | None
    unknown: float | None


def cramer_rao(plant: CoveragePlant, periods: int) -> Bounds:
    """Return the roots of the mean variance over rough inertias, which set the amplitude."""
    asked, shaft = quiet_shaft(plant, _ROUGH, periods)
    known: list[float | None] = []
    unknown: list[float | None] = []
    for run, segments in enumerate(asked.segments):
        hertz = np.array(segments[0].lines_hz)
        watched = []
        for segment in segments:
            first = segment.start_s + segment.settle_periods * segment.period_s
            rows = slice(round(first / shaft.step_s), round(segment.end_s / shaft.step_s))
            speed = shaft.speed[rows, run]
            time = np.arange(rows.start, rows.stop) * shaft.step_s
            turned: ComplexArray = np.exp(-2j * np.pi * np.outer(hertz, time)).astype(np.complex128)
            lines: ComplexArray = (turned @ speed.astype(np.complex128)) * (2.0 / len(time))
            lines = lines * plant.speed_report.response(2j * np.pi * hertz.astype(np.complex128))
            watched.append(WatchedSpeed(float(speed.mean()), lines, segment.end_s - first))
        fisher = information(plant, hertz, watched)
        known.append(bound_of(fisher[np.ix_(_KNOWN_LAGS, _KNOWN_LAGS)] if plant.degenerate else fisher))
        slopes, plausible = slopes_of_unknown(plant, hertz)
        unknown.append(bound_of(information(plant, hertz, watched, slopes) + plausible))
    structure_known, structure_unknown = _pooled(known), _pooled(unknown)
    if structure_known is not None and structure_unknown is not None:
        structure_unknown = max(structure_known, structure_unknown)
    return Bounds(structure_known, structure_unknown)


def _pooled(sds: list[float | None]) -> float | None:
    known = [sd for sd in sds if sd is not None]
    return float(np.sqrt(np.mean(np.square(known)))) if len(known) == len(sds) else None
