"""Frequency response of the shaft as the drive reports it: G = ω/T at every excited line, with noise and distortion.

For a line with segment means W̄_s, T̄_s over P_s periods and the one-period covariance (`spectrum`),

    Z = T/ω = Σ P T̄ W̄* / Σ P |W̄|²,      var Z = v/Σ P |W̄|²,      v = S_TT + |Z|² S_WW − 2 Re(Z* S_TW),

if speed is clearer of its scatter than torque. Otherwise (at an antiresonance the motor hardly turns) G is estimated in
the same way, and Z = 1/G. The error is circular: relative magnitude and phase have the same uncertainty.

Three kinds of scatter separate noise from nonlinear distortion (the robust method of Pintelon and Schoukens, adapted to
one recording):

- From period to period, the motion repeats. What differs is noise.
- At harmonics that are not excited, a linear shaft has T = Z W, whatever the torque is. A mean of D = T − Z W over the
  periods that exceeds its scatter is distortion. Dry friction that crosses zero, backlash and symmetric saturation make
  odd harmonics; a curved characteristic makes even ones.
- Each mean speed and each set of phases is a realisation of its own. A linear shaft has the same Z in all of them.

One realisation of phases shows that there is distortion, and its size beside the lines. It does not show its share at
an excited line, which adds to the line with a fixed phase. That share is taken to be as large as at the nearest
unexcited harmonics. With several realisations (``--realisations``) the share at a line changes with the phases of the
other lines. Then Z scatters by it over the M sets of phases, and their mean has 1/M of its variance, known with
2 (M − 1) degrees of freedom.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from profiles import CodedText, MessageCode
from tdhil.estimation.case import PeriodicCase, ResponseCurve
from tdhil.estimation.frequency_domain.filter_order import FittedModel, excess_rise
from tdhil.estimation.frequency_domain.inference import covariance, student_quantile
from tdhil.estimation.result import (
    CurvePoint,
    DistortionTest,
    Estimate,
    FrequencyResponse,
    ResidualTest,
    ResponseLine,
    UnexcitedHarmonic,
)
from tdhil.estimation.spectrum import ComplexArray, SpectralLine, torque_lines, unexcited_lines
from tdhil.recording import FloatArray, IntArray

# ---------------------------------------------------------------------------------------------------------------------
# Fitted model, drawn through the lines


@dataclass(frozen=True)
class ModelCurve:
    """A fitted model over frequency, with its band in the quadratic approximation.

    If the residuals exceed their expectation, the band grows with them.
    """

    fitted: FittedModel
    confidence: float
    residual: ResidualTest | None

    def at(self, hertz: FloatArray) -> tuple[ComplexArray, FloatArray, FloatArray]:
        """Return T/ω (K,), N·m·s/rad, and the half-widths of its interval: relative magnitude, and phase, rad."""
        problem, theta = self.fitted.problem, self.fitted.likelier.theta
        free, covariance = self.covariance()
        s: ComplexArray = np.asarray(2j * np.pi * hertz, dtype=np.complex128)
        value, slopes = problem.model.impedance_jacobian(theta, s)
        relative = slopes[:, free] / value[:, None]
        quantile = student_quantile(self.confidence, max(2.0 * float(np.median(problem.nu)), 1.0))
        quantile *= math.sqrt(excess_rise(problem, len(free)) * self._excess)
        magnitude, phase = (
            quantile * np.sqrt(np.maximum(np.einsum("ki,ij,kj->k", part, covariance, part), 0.0))
            for part in (relative.real, relative.imag)
        )
        return value, magnitude, phase

    def covariance(self) -> tuple[list[int], FloatArray]:
        """Return the free parameters of the likelier fit (F,) and their covariance (F, F)."""
        problem, theta = self.fitted.problem, self.fitted.likelier.theta
        held = self.fitted.simple_held if self.fitted.first_order else self.fitted.fixed
        free = [index for index in range(problem.model.size) if index not in held]
        return free, covariance(problem, theta, free)

    @property
    def _excess(self) -> float:
        test = self.residual
        return 1.0 if test is None else max(1.0, test.statistic / max(test.degrees_of_freedom, 1.0))


@dataclass(frozen=True)
class _StraightLine:
    """Line B + J s through the spectral lines, if no model was fitted; uncertain by a half."""

    inertia_kg_m2: float
    viscous_nm_s_rad: float

    def at(self, hertz: FloatArray) -> tuple[ComplexArray, FloatArray, FloatArray]:
        value = self.viscous_nm_s_rad + 2j * np.pi * np.asarray(hertz, dtype=np.float64) * self.inertia_kg_m2
        half: FloatArray = np.full(len(value), 0.5)
        return np.asarray(value, dtype=np.complex128), half, half


# ---------------------------------------------------------------------------------------------------------------------
# From lines to the response

DETECTED_P = 0.001
"""p-value of the test for distortion below which it is detected. 0.1 % of linear shafts are below it."""

LEAST_SETS = 4
"""Least number of sets of phases whose scatter is taken for that of the distortion: six degrees of freedom."""

_RESOLVED_STEPS = 1.0    # distance from an oscillation that a period separates, in steps of 1/P (decision 0099)
_BESIDE_STEPS = 0.25     # distance below which the mean of a line scatters more than its periods show (decision 0099)
_BESIDE_VARIANCE = 8.0   # factor of its variance there (decision 0099)
_MOST_HARMONICS = 12     # most unexcited harmonics tested
_BEYOND = 3              # times the highest excited harmonic: end of third-order distortion
_SAMPLES_A_CYCLE = 8     # fewest samples per cycle of an unexcited harmonic
_NEIGHBOURS = 4          # unexcited harmonics used for an excited line
_CURVE_POINTS = 31       # fewest points of the curve; more where the curve turns
_CURVE_TURN = 0.35       # rad, or of ln |Z|, between two points, at most
_CURVE_PASSES = 3        # passes in which intervals are halved
_CURVE_SPAN = 1.25       # factor by which the curve extends beyond the lowest and the highest line


@dataclass(frozen=True)
class _PooledLine:
    """One line pooled over the segments: Z, the variance of a period's equation error, and Σ P|W̄|²."""

    line: SpectralLine
    z: complex
    variance: float
    energy: float
    noise_rel: float


def measure_response(
    case: PeriodicCase, curve: ResponseCurve | None, settled: tuple[SpectralLine, ...], model: str
) -> FrequencyResponse | None:
    """Return the response at all excited lines; None if no line has two periods for its scatter.

    ``settled``: the lines without residual oscillation, () for the lines of the case.
    """
    pooled = [one for line in settled or case.every if (one := _pooled(line)) is not None]
    if not pooled:
        return None
    hertz = np.array([one.line.hertz for one in pooled])
    drawn: ResponseCurve = curve or _straight(pooled)
    fitted, _, _ = drawn.at(hertz)
    off = np.abs(np.array([one.z for one in pooled]) / fitted - 1.0)
    noise = np.array([one.noise_rel for one in pooled])
    clear = noise < 0.5
    misfit = float(np.sqrt(np.mean(np.minimum(off[clear], 1.0) ** 2))) if np.any(clear) else 1.0
    harmonics, by_harmonics = _unexcited(case, drawn, misfit)
    by_speed = _between_speeds(pooled)
    p_value = _combined([p for p in (by_harmonics, by_speed) if p is not None])
    detected = p_value is not None and p_value < DETECTED_P
    power = {parity: sum(max(one.torque_nm**2 - one.noise_nm**2, 0.0) for one in harmonics
                         if one.harmonic % 2 == parity) for parity in (0, 1)}
    total = power[0] + power[1]
    distortion = DistortionTest(
        detected, p_value, by_harmonics, by_speed, power[1] / total if total > 0.0 else None, harmonics)
    confidence = case.options.confidence
    used = [stretch.segment for stretch, fit in zip(case.stretches, case.fits, strict=True) if len(fit.speed)]
    sets = list(dict.fromkeys(segment.phases_rad for segment in used))
    set_of = np.array([sets.index(segment.phases_rad) for segment in used])
    lines = tuple(
        _response_line(one, _LineDistortion.of(one, harmonics, detected, set_of),
                       None if curve is None else complex(value), confidence)
        for one, value in zip(pooled, fitted, strict=True)
    )
    return FrequencyResponse(
        confidence=confidence,
        model=model if curve is not None else "none",
        lines=lines,
        curve=() if curve is None else _drawn(curve, hertz),
        distortion=distortion,
        mean_speeds_rad_s=tuple(dict.fromkeys(segment.offset_rad_s for segment in used)),
        realisations=len(sets),
    )


def _pooled(line: SpectralLine) -> _PooledLine | None:
    weight_w = float(np.sum(line.periods * np.abs(line.speed) ** 2))
    weight_t = float(np.sum(line.periods * np.abs(line.torque) ** 2))
    cross = complex(np.sum(line.periods * line.torque * line.speed.conj()))
    if not (weight_w > 0.0 and weight_t > 0.0 and abs(cross) > 0.0 and math.isfinite(weight_w + weight_t)):
        return None
    by_speed = weight_w * line.s_tt >= weight_t * line.s_ww      # True if speed is the clearer of the two
    z = cross / weight_w if by_speed else weight_t / cross.conjugate()
    alone = line.s_tt + abs(z) ** 2 * line.s_ww
    variance = max(alone - 2.0 * (z.conjugate() * line.s_tw).real, 1e-12 * alone)
    energy = weight_w if by_speed else weight_t / abs(z) ** 2
    beside = _BESIDE_VARIANCE if line.oscillation_steps < _BESIDE_STEPS else 1.0
    return _PooledLine(line, z, variance, energy, math.sqrt(beside * variance / (2.0 * energy)) / abs(z))


def _straight(lines: list[_PooledLine]) -> _StraightLine:
    omega = np.array([2.0 * math.pi * one.line.hertz for one in lines])
    z = np.array([one.z for one in lines])
    return _StraightLine(float(np.sum(z.imag * omega) / np.sum(omega**2)), float(np.median(z.real)))


@dataclass(frozen=True)
class _LineDistortion:
    """Distortion at one excited line, relative to it.

    ``rel``: of one set of phases. ``of_mean_rel``: of the mean of all sets, 0 if none was detected, known with
    ``freedom`` degrees of freedom.
    """

    rel: float
    of_mean_rel: float
    freedom: float

    @classmethod
    def of(
        cls, one: _PooledLine, harmonics: tuple[UnexcitedHarmonic, ...], detected: bool, set_of: IntArray
    ) -> _LineDistortion:
        """Return the distortion: measured with `LEAST_SETS` of phases, otherwise as large as beside the line.

        ``set_of``: (S,), the set of phases of each segment.
        """
        line = one.line
        speed = math.sqrt(one.energy / float(np.sum(line.periods)))
        sets = int(set_of.max()) + 1
        if sets >= LEAST_SETS and len(line.speed) == len(set_of):
            between = _excess_between(one, set_of)
            rel = math.sqrt(max(between, 0.0) / 2.0) / (speed * abs(one.z))
            return cls(rel, rel / math.sqrt(sets) if detected else 0.0, 2.0 * (sets - 1.0))
        between = _excess_between(one, np.arange(len(line.speed)))
        nearest = sorted(harmonics, key=lambda each: abs(each.hertz - line.hertz))[:_NEIGHBOURS]
        beside = float(np.mean([each.torque_nm**2 - each.noise_nm**2 for each in nearest])) if nearest else 0.0
        rel = math.sqrt(max(beside, between, 0.0) / 2.0) / (speed * abs(one.z))
        return cls(rel, rel if detected else 0.0, math.inf)


def _response_line(
    one: _PooledLine, distortion: _LineDistortion, fitted: complex | None, confidence: float
) -> ResponseLine:
    line, omega = one.line, 2.0 * math.pi * one.line.hertz
    spread = math.hypot(one.noise_rel, distortion.of_mean_rel)
    freedom = max(2.0 * line.nu, 1.0)
    if math.isfinite(distortion.freedom) and distortion.of_mean_rel > 0.0:
        # Welch and Satterthwaite (GUM, G.4.1)
        freedom = spread**4 / (one.noise_rel**4 / freedom + distortion.of_mean_rel**4 / distortion.freedom)
    half = student_quantile(confidence, freedom) * spread
    g = 1.0 / one.z
    turn = math.asin(half) if half < 1.0 else math.pi
    phase = math.atan2(g.imag, g.real)
    high = abs(g) / (1.0 - half) if half < 1.0 else math.inf
    inertia, width = one.z.imag / omega, half * abs(one.z) / omega
    # coherence |Σ T W*|²/(Σ|T|² Σ|W|²) over the periods
    counts = line.periods
    cross = complex(np.sum(counts * line.torque * line.speed.conj())) + line.nu * line.s_tw
    ww = float(np.sum(counts * np.abs(line.speed) ** 2)) + line.nu * line.s_ww
    tt = float(np.sum(counts * np.abs(line.torque) ** 2)) + line.nu * line.s_tt
    return ResponseLine(
        hertz=line.hertz,
        magnitude=Estimate(abs(g), abs(g) / (1.0 + half), high),
        phase_rad=Estimate(phase, phase - turn, phase + turn),
        apparent_inertia_kg_m2=Estimate(inertia, inertia - width, inertia + width),
        noise_rel=one.noise_rel,
        distortion_rel=distortion.rel,
        coherence=min(abs(cross) ** 2 / (ww * tt), 1.0),
        periods=round(float(np.sum(counts))),
        fitted_magnitude=None if fitted is None else 1.0 / abs(fitted),
        fitted_phase_rad=None if fitted is None else -math.atan2(fitted.imag, fitted.real),
        residual_sd=None if fitted is None else _residual(one, fitted),
    )


def _residual(one: _PooledLine, fitted: complex) -> float:
    line = one.line
    alone = line.s_tt + abs(fitted) ** 2 * line.s_ww
    variance = max(alone - 2.0 * (fitted.conjugate() * line.s_tw).real, 1e-12 * alone)
    return abs(one.z - fitted) * math.sqrt(one.energy / variance)


def _drawn(curve: ResponseCurve, hertz: FloatArray) -> tuple[CurvePoint, ...]:
    over = np.geomspace(hertz.min() / _CURVE_SPAN, hertz.max() * _CURVE_SPAN, _CURVE_POINTS)
    for _ in range(_CURVE_PASSES):
        steps = np.abs(np.diff(np.log(curve.at(over)[0])))
        wide = np.flatnonzero(steps > _CURVE_TURN)
        over = np.insert(over, wide + 1, np.sqrt(over[wide] * over[wide + 1]))
    points = []
    for one, z, magnitude, turn in zip(over.tolist(), *(part.tolist() for part in curve.at(over)), strict=True):
        size, phase = 1.0 / abs(z), -math.atan2(z.imag, z.real)
        inertia, half = z.imag / (2.0 * math.pi * one), math.hypot(magnitude * z.imag, turn * z.real) / (
            2.0 * math.pi * one)
        points.append(CurvePoint(
            one, Estimate(size, size / (1.0 + magnitude), size * (1.0 + magnitude)),
            Estimate(phase, phase - turn, phase + turn), Estimate(inertia, inertia - half, inertia + half)))
    return tuple(points)


# ---------------------------------------------------------------------------------------------------------------------
# Tests for distortion. For M means with weights estimated on ν complex degrees of freedom, Bartlett's form (2ν + M − 1)
# ln(1 + q/ν) ~ χ²(2M), as for the residuals (`inference`). Many small distortions show in the sum, one large distortion
# in the least p-value. Both count, at half the level each.


def _combined(p_values: list[float]) -> float | None:
    """Return the least p-value times the number of p-values (Bonferroni); None without any."""
    return min(1.0, len(p_values) * min(p_values)) if p_values else None


def _unexcited(
    case: PeriodicCase, curve: ResponseCurve, misfit: float
) -> tuple[tuple[UnexcitedHarmonic, ...], float | None]:
    """Return the unexcited harmonics, and the p-value of all together; None without any.

    The test leaves out the part that an error of Z can explain: ``misfit``, relative, and the band of the curve.
    """
    from scipy.special import chdtrc

    columns: dict[float, list[tuple[int, ComplexArray, float, float]]] = {}
    slope = case.constraint.slope if case.constraint is not None else 0.0
    rates = case.levels.warming.own or (0.0,) * len(case.fits)
    for stretch, fit, rate in zip(case.stretches, case.fits, rates, strict=True):
        if len(fit.speed) < 2:
            continue
        harmonics = _harmonics(stretch.segment.lines_hz, stretch.segment.period_s, len(stretch.periods[0]))
        if not harmonics:
            continue
        lines = unexcited_lines(stretch, fit, harmonics)
        z, magnitude, turn = curve.at(np.array(lines.lines_hz))
        torque = torque_lines(lines, slope, rate)
        unsure = np.minimum(np.hypot(np.hypot(magnitude, turn), misfit), 1.0) * np.abs(z)
        for k, harmonic in enumerate(harmonics):
            error = torque[:, k] - z[k] * lines.speed[:, k]
            explained = float(unsure[k]) * abs(complex(lines.speed[:, k].mean()))
            rounding = len(error) * (lines.rounding[1] + abs(complex(z[k])) ** 2 * lines.rounding[0])
            columns.setdefault(round(lines.lines_hz[k], 9), []).append((harmonic, error, explained, rounding))
    found, statistic, freedom = [], 0.0, 0.0
    for hertz, parts in sorted(columns.items()):
        nu = float(sum(len(error) - 1 for _, error, _, _ in parts))
        scatter = sum(float(np.sum(np.abs(error - error.mean()) ** 2)) for _, error, _, _ in parts) / nu
        variance = scatter + float(np.mean([rounding for *_, rounding in parts]))
        beyond = [max(abs(complex(error.mean())) - explained, 0.0) for _, error, explained, _ in parts]
        size = float(np.mean(np.square(beyond)))
        noise = variance * float(np.mean([1.0 / len(error) for _, error, _, _ in parts]))
        if not variance > 0.0:
            continue
        q = sum(len(error) * one**2 for (_, error, _, _), one in zip(parts, beyond, strict=True)) / variance
        bartlett = (2.0 * nu + len(parts) - 1.0) * math.log1p(q / nu)
        statistic, freedom = statistic + bartlett, freedom + 2.0 * len(parts)
        p_value = float(chdtrc(2.0 * len(parts), bartlett))
        found.append(UnexcitedHarmonic(hertz, parts[0][0], math.sqrt(size), math.sqrt(noise), p_value))
    if not found:
        return (), None
    least = min(1.0, len(found) * min(one.p_value for one in found))
    return tuple(found), _combined([float(chdtrc(freedom, statistic)), least])


_CAUSES = frozenset(one.code for one in (
    MessageCode.BACKLASH_FOUND, MessageCode.FRICTION_NOT_LINEAR, MessageCode.LOAD_SWINGS_WIDELY,
    MessageCode.SPEED_CHANGES_SIGN))


def unexplained_distortion(detected: bool, warning_codes: Iterable[str]) -> bool:
    """Return whether a distortion was detected whose cause none of the warnings names. Codes as in the result."""
    return detected and _CAUSES.isdisjoint(warning_codes)


def distortion_warning(response: FrequencyResponse | None, warnings: tuple[str, ...]) -> tuple[str, ...]:
    """Return the warning of a distortion whose cause none of the warnings names; else ()."""
    codes = [one.entry.code for one in warnings if isinstance(one, CodedText)]
    if response is None or not unexplained_distortion(response.distortion.detected, codes):
        return ()
    test = response.distortion
    beside = test.by_speed is None or (test.by_harmonics is not None and test.by_harmonics <= test.by_speed)
    where, what = (
        ("at unexcited harmonics", "backlash of a coupling or a gear, a torque limit, or stick-slip") if beside else
        ("between the mean speeds", "friction or a load that changes with speed, or a limit"))
    return (CodedText(
        f"nonlinear distortion was detected {where} (p = {test.p_value:.1g}), and its cause was not found. Look for "
        f"{what}", MessageCode.DISTORTION_FOUND),)


def _harmonics(lines_hz: tuple[float, ...], period_s: float, samples: int) -> tuple[int, ...]:
    """Return harmonics of the period that are not excited; ``samples``: number in a period."""
    excited = {round(hertz * period_s) for hertz in lines_hz}
    highest = min(_BEYOND * max(excited), samples // _SAMPLES_A_CYCLE)
    return tuple(h for h in range(1, highest + 1) if h not in excited)[:_MOST_HARMONICS]


def _between_speeds(lines: list[_PooledLine]) -> float | None:
    """Return the p-value of one Z at all mean speeds; None for a single mean speed, or without a line that counts.

    Lines that a period does not separate from an oscillation do not count.
    """
    from scipy.special import chdtrc

    statistic, freedom, each = 0.0, 0.0, []
    for one in lines:
        more = len(one.line.speed) - 1
        if more < 1 or not one.line.excited or one.line.oscillation_steps < _RESOLVED_STEPS:
            continue
        left = one.line.torque - one.z * one.line.speed
        q = float(np.sum(one.line.periods * np.abs(left) ** 2)) / one.variance
        bartlett = (2.0 * one.line.nu + more - 1.0) * math.log1p(q / one.line.nu)
        statistic, freedom = statistic + bartlett, freedom + 2.0 * more
        each.append(float(chdtrc(2.0 * more, bartlett)))
    return _combined([float(chdtrc(freedom, statistic)), min(1.0, len(each) * min(each))]) if each else None


def _excess_between(one: _PooledLine, group_of: IntArray) -> float:
    """Return E|·|² of the torque difference between groups of segments, beyond noise, (N·m)². ``group_of``: (S,)."""
    more = int(group_of.max())
    if more < 1:
        return 0.0
    left = one.line.torque - one.z * one.line.speed
    counts = np.bincount(group_of, one.line.periods)
    means = (np.bincount(group_of, one.line.periods * left.real)
             + 1j * np.bincount(group_of, one.line.periods * left.imag)) / counts
    between = float(np.sum(counts * np.abs(means) ** 2)) / more
    return max(between - one.variance, 0.0) / float(np.mean(counts))
