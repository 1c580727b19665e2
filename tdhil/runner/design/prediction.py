"""Prediction of the interval of J: the estimator's own fit, on expected spectral lines.

All parts of an interval (lag structures, estimated weights, priors) come from `identify`, here and nowhere else in this
room. So the prediction agrees with the later result.

Lines without noise fit exactly, and would give too narrow an interval: −2 ln L = Σ 2(ν + M) ln(1 + q/ν) has the
curvature (ν + M)/(ν + q), and q is about M with noise, but 0 here. So S is multiplied by (ν + M)/ν.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from tdhil.estimation import Levels, Samples, SpectralLine, Stretch, period_lines, tie_viscous
from tdhil.estimation.frequency_domain import (
    LEAST_NU,
    SPEED_LAG,
    TORQUE_LAG,
    Model,
    fit_inertia,
    known_of,
    refuse_count,
)
from tdhil.recording import FloatArray, LagPrior, Segment
from tdhil.runner.excitation import Plan

# ---------------------------------------------------------------------------------------------------------------------
# Disturbance of the equation of motion: assumed from the machine's limits, or measured at steady speed.
#
# The error of the estimator at a line is that of T − G W. With the load disturbance (density S_L, correlation time τ_L)
# and the speed sensor's white noise (density S_ω) its density, with the lag τ_T of the torque report, is
#
#     S(f) = (S_L/(1 + (ω τ_L)²) + |J s + B|² S_ω) / (1 + (ω τ_T)²),     s = jω,
#
# for any control of the shaft: the drive's own torque is in both signals and cancels. Densities are two-sided, per Hz.
# A line that is fitted to one period of length L then has E|r|² = 4 S/L, and a mean over L has the variance S(0)/L.


RIGID = Model()
"""Model of the shaft for plans; theta (8,) = (J, B) and the six parameters of the reports."""

LOAD_SHARE = 0.0075       # standard deviation of the load if it is not measured, share of the torque limit
LOAD_TIME_S = 0.5         # s; correlation time of the load if it is not measured
SENSOR_SHARE = 0.002      # standard deviation of the speed sensor in 2 ms, share of the highest speed
_SENSOR_STEP_S = 0.002    # s; the step of `SENSOR_SHARE`
SPEED_LAG_S = 0.40        # s; assumed lag of the reported speed, if none is stated
TORQUE_LAG_S = 0.15       # s; assumed lag of the reported torque, if none is stated
_LOW_LINES = 3            # lowest lines of a stretch, which give the density of the load
_HIGH_LINES = 9           # number of lines of a stretch; the lines above the lowest give the density of the sensor
_LEAST_SHARE = 1e-3       # least density, share of the assumed one: below it other errors determine the interval


@dataclass(frozen=True)
class NoiseDensity:
    """Noise densities of the load, S_L in (N·m)²·s, and of the speed sensor, S_ω in (rad/s)²·s."""

    load_nm2_s: float
    speed_rad2_s: float
    load_time_s: float = LOAD_TIME_S
    source: Literal["assumed", "measured"] = "assumed"

    @property
    def load_sd_nm(self) -> float:
        """Return the standard deviation of the load disturbance, N·m: S_L = 2 sd² τ_L."""
        return math.sqrt(0.5 * self.load_nm2_s / self.load_time_s)

    def error_density(self, hertz: FloatArray, theta: FloatArray) -> FloatArray:
        """Return S of T − G W, (N·m)²·s, at frequencies (K,); theta (8,) of the rigid model."""
        omega = 2.0 * np.pi * np.asarray(hertz, dtype=np.float64)
        shaft = (theta[0] * omega) ** 2 + theta[1] ** 2
        load = self.load_nm2_s / (1.0 + (omega * self.load_time_s) ** 2)
        lag = float(theta[RIGID.at(TORQUE_LAG)])
        density: FloatArray = (load + shaft * self.speed_rad2_s) / (1.0 + (omega * lag) ** 2)
        return density


def assumed_noise(torque_limit_nm: float, speed_max_rad_s: float, load_sd_nm: float | None = None) -> NoiseDensity:
    """Return noise as typical shares of the machine's limits, or with a stated load disturbance ``load_sd_nm``."""
    load = LOAD_SHARE * torque_limit_nm if load_sd_nm is None else load_sd_nm
    return NoiseDensity(2.0 * load**2 * LOAD_TIME_S, (SENSOR_SHARE * speed_max_rad_s) ** 2 * _SENSOR_STEP_S)


def assumed_theta(inertia_kg_m2: float, viscous_nm_s_rad: float, prior: LagPrior) -> FloatArray:
    """Return the parameters of `RIGID`, (8,), with first-order lags: stated, else assumed."""
    theta = np.zeros(RIGID.size)
    theta[:2] = inertia_kg_m2, viscous_nm_s_rad
    theta[RIGID.at(SPEED_LAG)] = SPEED_LAG_S if prior.speed_lag_s is None else prior.speed_lag_s
    theta[RIGID.at(TORQUE_LAG)] = TORQUE_LAG_S if prior.torque_lag_s is None else prior.torque_lag_s
    return theta


def measured_noise(steady: tuple[Samples, ...], theta: FloatArray, fallback: NoiseDensity) -> NoiseDensity:
    """Return densities from stretches of steady speed, at the harmonics of each stretch's own length.

    The error's line e = T − G W uses spectra and cross spectrum of both signals, and does not depend on the control of
    the speed: |e|² L/4 is an estimate of S with two degrees of freedom. The lowest lines of all stretches give S_L,
    with the assumed correlation time; the next ones give the added |J s + B|² S_ω. With lags other than theta's, some
    of the drive's own torque remains in e, so the estimate is rather too large than too small.
    """
    frequencies: list[FloatArray] = []
    readings: list[FloatArray] = []
    for samples in steady:
        if len(samples) < 4 * _HIGH_LINES:
            continue
        interval = float(np.median(np.diff(samples.time_s)))
        begin, length = float(samples.time_s[0]), float(samples.time_s[-1] - samples.time_s[0]) + interval
        harmonics = np.arange(1.0, _HIGH_LINES + 1.0) / length
        lines = tuple(float(one) for one in harmonics)
        segment = Segment(begin, begin + length, length, 0, float(np.mean(samples.speed_rad_s)), lines, (), ())
        try:
            found = period_lines(Stretch(segment, (samples,), (0,)), samples)
        except np.linalg.LinAlgError:       # the samples can't separate these frequencies
            continue
        torque = found.torque[0] - theta[1] * found.drift[0] * found.ramp[0]
        s = 2j * np.pi * harmonics.astype(np.complex128)
        error = torque - RIGID.impedance(theta, s) * found.speed[0]
        frequencies.append(harmonics)
        readings.append(np.abs(error) ** 2 * length / 4.0)
    if not readings:
        return fallback
    hertz, density = np.concatenate(frequencies), np.concatenate(readings)
    low = np.concatenate([np.arange(len(part)) < _LOW_LINES for part in readings])
    unit_load = NoiseDensity(1.0, 0.0).error_density(hertz, theta)
    unit_speed = NoiseDensity(0.0, 1.0).error_density(hertz, theta)
    load = float(np.mean(density[low] / unit_load[low]))
    speed = float(np.mean((density[~low] - load * unit_load[~low]) / unit_speed[~low])) if np.any(~low) else 0.0
    if not (math.isfinite(load) and math.isfinite(speed)):
        return fallback
    return NoiseDensity(max(load, _LEAST_SHARE * fallback.load_nm2_s), max(speed, 0.0), source="measured")


# ---------------------------------------------------------------------------------------------------------------------

_NINE_IN_TEN = 1.28       # standard deviations: one-sided 90 % quantile of the normal distribution


@dataclass(frozen=True)
class Evidence:
    """Data of a fit: lines, operating points, and stated lags."""

    lines: tuple[SpectralLine, ...]
    levels: Levels
    prior: LagPrior


@dataclass(frozen=True)
class FittedRigid:
    """The fitted parameters of the rigid model, (8,), and the relative half-width of J."""

    theta: FloatArray
    half_width: float


def fit(evidence: Evidence, confidence: float) -> FittedRigid | None:
    """Return the estimator's own fit; None if it would refuse."""
    constraint = tie_viscous(evidence.levels)
    lines = tuple(line for line in evidence.lines if line.excited and line.nu >= LEAST_NU)
    priors, held = known_of(evidence.prior, len(lines), constraint)
    if not lines or refuse_count(len(lines), constraint, priors) is not None:
        return None
    try:
        inertia, _, found = fit_inertia(lines, constraint, priors, held, confidence)
    except (np.linalg.LinAlgError, FloatingPointError, ValueError):
        return None
    half = 0.5 * (inertia.high - inertia.low) / inertia.value if inertia.value > 0.0 else math.inf
    theta = found.likelier.theta
    if not (half > 0.0 and np.all(np.isfinite(theta))):
        return None
    return FittedRigid(theta, half)


def noise_free(evidence: Evidence, fitted: FittedRigid) -> Evidence:
    """Return the data with torques that the parameters explain exactly, and scatter enlarged accordingly."""
    lines = []
    for line in evidence.lines:
        g = complex(RIGID.impedance(fitted.theta, np.array([2j * np.pi * line.hertz]))[0])
        share = (line.nu + len(line.speed)) / max(line.nu, 1.0)
        lines.append(
            replace(line, torque=g * line.speed, s_ww=share * line.s_ww, s_tt=share * line.s_tt, s_tw=share * line.s_tw)
        )
    levels, theta = evidence.levels, fitted.theta
    coulomb = float(levels.weights @ (levels.torque - theta[0] * levels.drift - theta[1] * levels.speed))
    torque = coulomb + theta[1] * levels.speed + theta[0] * levels.drift
    return replace(evidence, lines=tuple(lines), levels=replace(levels, torque=torque))


def longer(evidence: Evidence, scale: float, scatter: float = 1.0, at_last: bool = False) -> Evidence:
    """Return the data of a motion ``scale`` times as long, with ``scatter`` times the variance.

    ``at_last``: the whole extension belongs to the last segment.
    """
    lines = []
    for line in evidence.lines:
        more = float(np.sum(line.periods)) * (scale - 1.0)
        lines.append(
            replace(
                line, periods=_grown(line.periods, scale, at_last), nu=line.nu + more,
                s_ww=scatter * line.s_ww, s_tt=scatter * line.s_tt, s_tw=scatter * line.s_tw,
            )
        )
    levels = evidence.levels
    dof = levels.dof * scale
    duration = _grown(levels.duration, scale, at_last)
    levels = replace(levels, duration=duration, density=scatter * levels.density, dof=dof)
    return replace(evidence, lines=tuple(lines), levels=levels)


def _grown(lengths: FloatArray, scale: float, at_last: bool) -> FloatArray:
    """Return lengths of segments, (S,), that add up to ``scale`` times the sum."""
    if not at_last:
        return lengths * scale
    grown = lengths.copy()
    grown[-1] += (scale - 1.0) * np.sum(lengths)
    return grown


def half_width(evidence: Evidence, confidence: float) -> float:
    """Return the relative half-width of J; infinite if the estimator would refuse."""
    found = fit(evidence, confidence)
    return math.inf if found is None else found.half_width


def safe_half_width(evidence: Evidence, confidence: float) -> float:
    """Return the relative half-width of J that nine of ten runs do not exceed.

    A different set of lags may explain the lines almost as well. Without noise its −2 ln L is D₀ above the best, with
    noise D ~ N(D₀, 4 D₀). It widens the interval if D < t². This has a probability below 10 % if √D₀ ≥ x + √(x² + t²)
    with x = 1.28. So the profile is followed to that value, and the width is scaled back: for a parabola nothing
    changes, and a second minimum within reach widens the interval.
    """
    nu = [line.nu for line in evidence.lines if line.nu >= LEAST_NU]
    if not nu:
        return math.inf
    from scipy.special import stdtr, stdtrit

    dof = 2.0 * max(nu)
    usual = float(stdtrit(dof, 0.5 + 0.5 * confidence))
    reach = _NINE_IN_TEN + math.hypot(_NINE_IN_TEN, usual)
    found = fit(evidence, float(2.0 * stdtr(dof, reach) - 1.0))
    return math.inf if found is None else found.half_width * usual / reach


def whole_periods(lines: Sequence[SpectralLine]) -> float:
    """Return the evaluated periods in all segments together."""
    return float(np.sum(lines[0].periods)) if lines else 0.0


# ---------------------------------------------------------------------------------------------------------------------
# Prediction for a plan: the lines and operating points that follow from its motion and the noise.


def predicted(plan: Plan, theta: FloatArray, noise: NoiseDensity, prior: LagPrior) -> Evidence:
    """Return lines without noise and their expected covariance.

    In torque mode the disturbance is in the speed only, because the host commands the torque. In speed mode it is in
    the torque only. In both modes T − G W has the variance 4 S/L of `noise`.
    """
    reference = plan.segments[0].reference
    hertz = np.array(reference.lines_hz)
    s = 2j * np.pi * hertz.astype(np.complex128)
    g = RIGID.impedance(theta, s)
    counts = np.array([float(segment.periods - segment.settle_periods) for segment in plan.segments])
    nu = float(np.sum(counts - 1.0))
    variance = 4.0 * noise.error_density(hertz, theta) / reference.period_s
    amplitudes = np.array([segment.reference.amplitudes_rad_s for segment in plan.segments])
    seen = amplitudes / (1.0 + s * theta[RIGID.at(SPEED_LAG)]) * plan.followed(hertz)
    in_speed = plan.mode == "torque"
    lines = []
    for k, line_hz in enumerate(reference.lines_hz):
        gain = float(abs(g[k])) ** 2
        s_ww, s_tt = (variance[k] / gain, 1e-6 * variance[k]) if in_speed else (1e-6 * variance[k] / gain, variance[k])
        lines.append(SpectralLine(line_hz, seen[:, k], g[k] * seen[:, k], counts, float(s_ww), float(s_tt), 0j, nu))
    speeds = np.array([segment.reference.offset_rad_s for segment in plan.segments])
    torques = np.array([segment.reference.mean_torque_nm for segment in plan.segments])
    still = float(noise.error_density(np.zeros(1), theta)[0])
    levels = Levels(speeds, torques, np.zeros(len(speeds)), counts * reference.period_s, still, nu)
    return noise_free(Evidence(tuple(lines), levels, prior), FittedRigid(theta, 0.0))


def expected_half_width(plan: Plan, theta: FloatArray, noise: NoiseDensity, prior: LagPrior,
                        confidence: float) -> float:
    """Return the expected relative half-width of J after this plan, also with other lags than the assumed ones."""
    return safe_half_width(predicted(plan, theta, noise, prior), confidence)
