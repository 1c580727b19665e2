"""Comparison of commanded, demanded and reported torque: do they agree within the drive's torque scale?

A reported torque with a wrong scale gives an inertia that is wrong by the same factor, and no residual shows it.
However, the host knows the torque that it commands, and many drives report their own torque demand. In torque mode the
reported torque y follows the commanded torque x through the drive's torque loop and its reporting filter,

    A(d/dt) y = k x + c,     A = 1 + a₁ d/dt + a₂ d²/dt² + a₃ d³/dt³,

with the ratio k of both scales and an offset c. At low frequencies A is the inverse of the lags between x and y: a₁ is
their sum. For one pole, two poles, a moving average or a dead time, a₂ is between 0 and a₁²/2, and a₃ between 0 and
a₁³/6. Through smooth windows (`tdhil.estimation.time_domain`) the equation is linear in k, c and the a. Therefore k
needs no model of the lags and no steady torque, and parts of the recording with an active limit are left out. In speed
mode x is the drive's torque demand.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from profiles import CodedText, MessageCode
from profiles.quantities import printed_interval
from tdhil.estimation.case import Case
from tdhil.estimation.frequency_domain import student_quantile
from tdhil.estimation.result import Estimate, Refusal, Refused, TorqueRatio, normal_quantile
from tdhil.estimation.samples import Samples, excited_window, good_samples, usual_interval
from tdhil.estimation.time_domain import (
    CLEAR,
    LEAST_BINS,
    LEAST_DOF,
    NARROW,
    Bins,
    OneWayStretch,
    joined,
    measure,
    place_windows,
    polynomial,
    smoothed,
    thinned,
)
from tdhil.recording import BoolArray, FloatArray, Recording

# ---------------------------------------------------------------------------------------------------------------------
# Ratio of two torques in one part of a recording.


_RATE_HZ = 50.0           # Hz; rate of the compared averages. Both signals have the same average, so its effect cancels
_GAP_STEPS, _GAP_S = 4.5, 0.05     # missing samples, s; a longer gap begins a new stretch
_LEAST_S = 4.0            # s; least duration of a stretch; a shorter one has no frequencies below those of the lags
_ROUNDS = 4               # rounds of reweighting
_PHASE_RAD = 0.9          # rad; phase of the lags up to which a cubic is their inverse
_LEAST_LAG_S = 0.02       # s; least lag used for the bounds of its square and cube
_SQUARE, _SQUARE_SD = 0.25, 0.2        # a₂/a₁²: one pole 0, two poles up to 1/4, moving average 1/3, dead time 1/2
_CUBE, _CUBE_SD = 0.05, 0.06           # a₃/a₁³: one and two poles 0, dead time 1/6
_RATIO, _OFFSET, _FIRST, _SECOND, _THIRD = range(5)


@dataclass(frozen=True)
class _RatioFit:
    """Ratio k with its standard deviation and degrees of freedom, and the possible bias from noise in the reference."""

    ratio: float
    sd: float
    dof: float
    lean: float

    def half_width(self, confidence: float) -> float:
        """Return the half-width of the coverage interval with probability ``confidence``."""
        return student_quantile(confidence, self.dof) * self.sd + self.lean


def _ratio(time_s: FloatArray, reference_nm: FloatArray, torque_nm: FloatArray) -> _RatioFit | None:
    """Return k of ``torque_nm`` over ``reference_nm``, (N,) each; None if the reference moves too little."""
    bins = joined([
        measure(window) for window in place_windows(tuple(_stretches(Samples(time_s, reference_nm, torque_nm))))
    ])
    if len(bins) < LEAST_BINS:
        return None
    keep = np.ones(len(bins), dtype=np.bool_)
    variance = bins.energy.copy()
    x = np.zeros(5)
    spread = np.zeros((5, 5))
    lag_s = 0.0
    for number in range(_ROUNDS):
        x, spread, leverage = _solved(bins.chosen(keep), variance[keep], lag_s, bounded=number > 0)
        lag_s = max(float(x[_FIRST]), 0.0)
        taken = np.zeros(len(bins))
        taken[keep] = leverage
        left = _left(bins, x)
        power, _ = smoothed(bins.hertz, np.abs(left) ** 2 / (bins.energy * np.maximum(1.0 - taken, 0.05)))
        variance = bins.energy * np.maximum(power, 1e-12 * float(np.max(np.abs(bins.torque[:, 0]) ** 2 / bins.energy)))
        explained, _ = smoothed(bins.hertz, np.abs(x[_RATIO] * bins.speed[:, 0]) ** 2 / bins.energy, NARROW)
        keep = explained * bins.energy > CLEAR * variance
        keep &= bins.hertz <= _PHASE_RAD / (2.0 * math.pi * max(lag_s, _LEAST_LAG_S))
        if np.count_nonzero(keep) < LEAST_BINS:
            return None
    chosen, variance = bins.chosen(keep), variance[keep]
    x, spread, _ = _solved(chosen, variance, lag_s, bounded=True)
    if not (math.isfinite(float(x[_RATIO])) and x[_RATIO] != 0.0):
        return None
    seen = float(np.sum(np.abs(x[_RATIO] * chosen.speed[:, 0]) ** 2 / variance))
    lean = abs(float(x[_RATIO])) * len(chosen) / seen
    sd = math.sqrt(max(float(spread[_RATIO, _RATIO]), 0.0))
    return _RatioFit(float(x[_RATIO]), sd, max(2.0 * len(chosen) - len(x), LEAST_DOF), lean)


def _stretches(samples: Samples) -> Iterator[OneWayStretch]:
    """Yield the parts without gaps, averaged to some fifty samples a second."""
    if len(samples) < 2:
        return
    longest = max(_GAP_STEPS * usual_interval(samples.time_s), _GAP_S)
    edges = [0, *(np.flatnonzero(np.diff(samples.time_s) > longest) + 1).tolist(), len(samples)]
    for first, last in pairwise(edges):
        part = Samples(samples.time_s[first:last], samples.speed_rad_s[first:last], samples.torque_nm[first:last])
        if len(part) > 1 and part.time_s[-1] - part.time_s[0] >= _LEAST_S:
            yield OneWayStretch(thinned(part, most=1), 1.0)


def _operators(bins: Bins) -> list[FloatArray]:
    """Return d/dt, d²/dt² and d³/dt³ of the torque in every bin (M,)."""
    return [
        np.einsum("mn,mn->m", polynomial(bins.s, *(0.0,) * power, 1.0), bins.torque) for power in range(1, 4)
    ]


def _left(bins: Bins, x: FloatArray) -> FloatArray:
    """Return the residual of the equation in every bin (M,), as torque: divided by the inverse of the lags."""
    first, second, third = _operators(bins)
    left = bins.torque[:, 0] + x[_FIRST] * first + x[_SECOND] * second + x[_THIRD] * third
    left = left - x[_RATIO] * bins.speed[:, 0] - x[_OFFSET] * bins.level[:, 0]
    s = bins.s
    return np.asarray(left / (1.0 + x[_FIRST] * s + x[_SECOND] * s**2 + x[_THIRD] * s**3))


def _solved(
    bins: Bins, variance: FloatArray, lag_s: float, *, bounded: bool
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return k, c and the a (5,), their covariance (5, 5), and the leverage of each bin (M,).

    ``bounded``: a₂ and a₃ are kept near the values of filters with a total lag of ``lag_s``.
    """
    first, second, third = _operators(bins)
    s = bins.s
    lag = max(lag_s, _LEAST_LAG_S)
    # the noise is in the reported torque, and A acts on it too
    by_lag = 1.0 + lag * s if bounded else np.ones(len(s))
    weight = np.sqrt(np.where(bins.hertz > 0.0, 2.0, 1.0) / variance) / np.abs(by_lag)
    columns = np.column_stack([bins.speed[:, 0], bins.level[:, 0], -first, -second, -third]) * weight[:, None]
    known = bins.torque[:, 0] * weight
    rows = [columns.real, columns.imag]
    right = [known.real, known.imag]
    if bounded:
        prior = np.zeros((2, 5))
        prior[0, _SECOND], prior[1, _THIRD] = 1.0 / (_SQUARE_SD * lag**2), 1.0 / (_CUBE_SD * lag**3)
        rows.append(prior)
        right.append(np.array([_SQUARE / _SQUARE_SD, _CUBE / _CUBE_SD]))
    else:
        columns[:, [_SECOND, _THIRD]] = 0.0
        rows = [columns.real, columns.imag]
    design = np.concatenate(rows)
    sizes = np.linalg.norm(design, axis=0)
    scale = np.where(sizes > 0.0, sizes, 1.0)
    u, sizes, vt = np.linalg.svd(design / scale, full_matrices=False)
    kept = sizes > 1e-9 * max(float(sizes[0]), 1e-300)
    inverse = vt[kept].T / sizes[kept]
    x = inverse @ (u[:, kept].T @ np.concatenate(right)) / scale
    leverage = np.sum(u[:, kept] ** 2, axis=1)
    count = len(bins)
    each = np.where(bins.hertz > 0.0, 0.5, 1.0) * (leverage[:count] + leverage[count : 2 * count])
    return x, inverse @ inverse.T / np.outer(scale, scale), each


# ---------------------------------------------------------------------------------------------------------------------
# Selection of the compared parts of a recording, and the consequences of the comparison.


COMMANDED, DEMANDED = "commanded", "demanded"
_FALSE_ALARM = 1e-3
"""Probability that the noise of the ratio alone makes sound signals contradict; the allowance for the scale is
added.
"""

_NEGLIGIBLE = 0.01
"""Difference of the ratio from 1 that counts as none. Setpoints are rounded, and a torque loop keeps a small error."""

_FITS = 0.2
"""Share of the ratio's difference from 1: two signals with a smaller difference agree with each other."""

_ADVICE = (
    "check the units of torque in the profile (per_lsb of setpoint and reported torque) and the rated torque; or "
    "calibrate the torque, or state a larger torque_scale_rel_sd in rig.yaml"
)


def torque_ratios(recording: Recording, confidence: float) -> tuple[TorqueRatio, ...]:
    """Return reported over commanded torque in torque mode, and reported over demanded torque in speed mode.

    Uses the excited segments, or the whole recording without segments. Returns () without a known setpoint, or if the
    setpoint moves too little. Never raises.
    """
    commanded, demanded = recording.commanded_torque_nm, recording.demanded_torque_nm
    if commanded is None and demanded is None:
        return ()
    good = good_samples(recording) & ~recording.limited & _within(recording)
    in_torque = np.zeros(len(good), dtype=np.bool_) if commanded is None else np.isfinite(commanded)
    found = []
    for name, reference, part in ((COMMANDED, commanded, in_torque), (DEMANDED, demanded, ~in_torque)):
        if reference is None:
            continue
        one = _compared(recording, name, reference, good & part & np.isfinite(reference), confidence)
        found += [] if one is None else [one]
    return tuple(found)


def _within(recording: Recording) -> BoolArray:
    """Return (N,) True in the excited segments after settling; True everywhere without segments."""
    time = recording.time_s
    segments = () if recording.excitation is None else recording.excitation.segments
    inside = np.full(len(time), not segments)
    for segment in segments:
        start, end = excited_window(segment)
        inside |= (time >= start) & (time < end)
    return inside


def _compared(
    recording: Recording, name: str, reference: FloatArray, chosen: BoolArray, confidence: float
) -> TorqueRatio | None:
    if not np.any(chosen):
        return None
    time, torque = recording.time_s[chosen], recording.torque_nm[chosen] - recording.torque_offset_nm
    wanted = reference[chosen]
    other = recording.demanded_torque_nm if name == COMMANDED else None
    between = None if other is None else other[chosen]
    if between is not None and not bool(np.all(np.isfinite(between))):
        between = None
    try:
        fit = _ratio(time, wanted, torque)
        off = fit is not None and abs(fit.ratio - 1.0) > max(fit.half_width(1.0 - _FALSE_ALARM), _NEGLIGIBLE)
        of_demand = _ratio(time, wanted, between) if off and between is not None else None
    except (np.linalg.LinAlgError, FloatingPointError, ValueError, ZeroDivisionError):
        return None
    if fit is None:
        return None
    half, surely = fit.half_width(confidence), fit.half_width(1.0 - _FALSE_ALARM)
    return TorqueRatio(
        name, Estimate(fit.ratio, fit.ratio - half, fit.ratio + half), surely, _rms(wanted),
        None if between is None else _rms(between), _rms(torque), None if of_demand is None else of_demand.ratio,
    )


def _rms(signal: FloatArray) -> float:
    return math.sqrt(float(np.mean(signal**2)))


def torques_compared(case: Case) -> Case:
    """Return the case with the ratios of its torque signals."""
    return replace(case, torque_ratios=torque_ratios(case.recording, case.options.confidence))


def torques_judged(case: Case) -> Case:
    """Return the case, with a wider torque scale if a ratio differs from 1 by less than that scale allows.

    Raises Refused if a ratio differs by more: J would be wrong by that factor, and the true torque is unknown. A torque
    calibration fixes the scale of the reported torque. The ratio to the commanded torque is no surer by it: the scale
    of before is allowed, and the calibrated scale stays.
    """
    before = case.recording.torque_agreement_rel_sd
    scale = case.recording.torque_scale_rel_sd if before is None else before
    refusal = torque_contradiction(case.torque_ratios, scale)
    if refusal is not None:
        raise Refused(refusal.reason, refusal.advice, refusal.entry)
    worst = _worst(case.torque_ratios)
    if worst is None:
        return case
    if before is not None:
        warning = CodedText(f"{_sentence(worst)}; the torque calibration is that of the reported torque, and stays",
                            MessageCode.TORQUE_SIGNALS_DIFFER)
        return replace(case, warnings=(*case.warnings, warning))
    widened = replace(
        case.recording, torque_scale_rel_sd=math.hypot(scale, abs(worst.ratio.value - 1.0) / normal_quantile(0.95)))
    warning = (
        CodedText(f"{_sentence(worst)}; the uncertainty of the torque scale was widened from {100 * scale:.2f} % to "
        f"{100 * widened.torque_scale_rel_sd:.2f} % (1 sd)",
        MessageCode.TORQUE_SIGNALS_DIFFER)
    )
    return replace(case, recording=widened, warnings=(*case.warnings, warning))


def torque_contradiction(found: tuple[TorqueRatio, ...], scale_rel_sd: float) -> Refusal | None:
    """Return the contradiction if a ratio differs from 1 by more than the torque scale allows; else None.

    ``scale_rel_sd``: standard uncertainty of the torque scale, as a share.
    """
    worst, allowed = _worst(found), normal_quantile(0.95) * scale_rel_sd
    if worst is None or abs(worst.ratio.value - 1.0) <= allowed + worst.surely:
        return None
    return Refusal(_contradiction(worst, allowed), _advice(worst), entry=MessageCode.TORQUE_SCALE_DOUBTFUL)


def _worst(found: tuple[TorqueRatio, ...]) -> TorqueRatio | None:
    """Return the ratio that differs most from 1; None if none differs by more than chance and rounding explain."""
    off = [one for one in found if abs(one.ratio.value - 1.0) > max(one.surely, _NEGLIGIBLE)]
    return max(off, key=lambda one: abs(one.ratio.value - 1.0), default=None)


def _sentence(found: TorqueRatio) -> str:
    ratio = found.ratio
    interval = printed_interval(ratio.low, ratio.high)
    return f"the reported torque is {ratio.value:.4g} ({interval}) of the {found.reference} torque"


def _contradiction(found: TorqueRatio, allowed: float) -> str:
    values = [f"{found.reference} {found.reference_rms_nm:.4g}"]
    if found.demanded_rms_nm is not None:
        values.append(f"demanded {found.demanded_rms_nm:.4g}")
    values.append(f"reported {found.reported_rms_nm:.4g} N·m")
    which = ""      # signal that differs from the other two, if three are known
    if found.demanded_ratio is not None:
        tolerance = _FITS * abs(found.ratio.value - 1.0)
        if abs(found.demanded_ratio - 1.0) < tolerance:
            which = "; the demanded torque agrees with the commanded one, but the reported torque does not"
        elif abs(found.ratio.value / found.demanded_ratio - 1.0) < tolerance:
            which = "; demanded and reported torque agree, but the commanded torque does not"
        else:
            which = "; no two of the three agree"
    return (
        f"the drive's torque signals contradict each other ({', '.join(values)}, root mean square): {_sentence(found)},"
        f" and the torque scale allows ±{allowed:.2g}{which}; everything that comes from the reported torque"
        " may be wrong by that factor"
    )


def _advice(found: TorqueRatio) -> str:
    if found.reference == DEMANDED:
        return f"{_ADVICE}. A run in torque mode shows which of the two is wrong"
    return _ADVICE
