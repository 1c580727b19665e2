r"""Torque calibration against the recording of a reference sensor: time offset, common band, line with errors in both.

The drive reports R = T/κ, the sensor Y = T + a, each with its own low-pass filter and its own time base.

**Time offset.** The largest correlation of both records over all offsets gives a coarse value. Least squares refine it.

**Common band.** Both signals pass the same Gaussian average, taken at the samples' own times, so nothing is
interpolated and nothing is aliased. Its width follows from the slower sampling and from the difference of both filters.
In cumulants, that difference is a delay, a variance v and a third moment. With x, the average of R,

    y(t + d) = a + κ (x + β₁ x′ + β₂ x″ + β₃ x‴),        β₁ → 0 by choice of the offset d,  β₂ = v/2.

κ is then the ratio of constant torques, for any low-pass filters. A single frequency cannot separate κ from β₂; its
interval is then wide.

**Errors in both.** After removal of the parts of a, x′, x″ and x‴, κ is the slope of Deming's line. The ratio of both
noises is estimated from the samples. Low-pass filters may hide it, so the regressions with all noise in one signal
bound κ; the distance to them is a rectangular error in the budget. Noise of R is also in its derivatives, which matters
if these are nearly proportional to R: one of the bounds subtracts it from the normal equations.

**Interval.** Residuals are correlated. The variance of κ is Σ_k c_x(k) γ(k)/c_x(0)², with the autocorrelation c_x of
the torque and the autocovariance γ of the residuals: that of least squares with correlated errors. It equals the
variance for n_eff independent samples.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from profiles.quantities import printed_share
from tdhil.calibration.added_body import (
    FactorLine,
    MeasuredValue,
    compared,
    effective_degrees_of_freedom,
    measured_value,
)
from tdhil.estimation import normal_quantile
from tdhil.estimation.frequency_domain import CERTAIN
from tdhil.recording import FloatArray

LEAST_OVERLAP_S = 20.0
"""Shortest common part of both records, s."""
LEAST_CORRELATION = 0.9
"""Smallest correlation of both averaged torques at the best time offset."""
LEAST_SWING_COUNTS = 20.0
"""Smallest swing of either torque, as a multiple of its own noise in the average or of its own count."""
ASSUMED_REFERENCE_REL_SD = 0.003
"""Standard uncertainty of a sensor's scale if none is stated: accuracy class 0.5, rectangular (0.5 %/√3)."""
_ASSUMED = (f"the standard uncertainty of the sensor's scale was assumed to be {100 * ASSUMED_REFERENCE_REL_SD:.1f} %"
            " (accuracy class 0.5); state it with --reference-sd")
LEAST_OWN_SHARE = 0.1
"""Least share of the torque's variance that its derivatives do not explain. A tone has none, steps have nearly all."""
_COARSE_S = 0.25             # s; width of the average for the correlation
_PER_WIDTH = 2.0             # grid points for one width of the average
_REACH = 4.0                 # reach of a Gaussian average, in its widths
_NARROWEST_S = 0.1
_WIDER_THAN_FILTERS = 2.0    # width of the average over √|v|
_WIDEST_SHARE = 0.02         # width of the average, of the overlap
_ROUNDS, _CLOSE = 12, 1e-4
_CLEARLY = 0.02              # difference of correlation that is significant
_TERMS = 4                   # terms beside κ: offset, and three derivatives
_LEAST_EFFECTIVE = 3.0 * _TERMS
_ALIKE = (0.01, 100.0)       # bounds of the estimated ratio of the noise variances
_SWING = (2.5, 97.5)         # percentiles that define a swing
_MOST_PLOTTED = 400
_AT_ONCE = 1_000_000         # numbers computed in one piece of the average


@dataclass(frozen=True)
class TorqueRecord:
    """Torque over its own rising time, of the drive or the sensor; ``count_nm``: its resolution, 0 if unknown."""

    time_s: FloatArray
    torque_nm: FloatArray
    count_nm: float = 0.0


@dataclass(frozen=True)
class ReferenceSeries:
    """Averaged torques (n,) with the residual of the fit, reduced for figures; ``time_s`` of the drive's log."""

    time_s: FloatArray
    reported_nm: FloatArray
    reference_nm: FloatArray
    residual_nm: FloatArray


@dataclass(frozen=True)
class ReferenceFit:
    """Result: ``factor`` κ and ``offset_nm`` a; None if a ``refusal`` leaves them unknown.

    ``time_offset_s``: time in the sensor's record less time in the log. ``average_s``: width of the Gaussian average.
    ``filter_s``: square root of the difference of the filters' variances, positive if the sensor is slower.
    ``effective_samples``: number of independent samples for κ, of ``samples`` averages. ``swing_nm``: of the sensor.
    """

    refusal: str = ""
    advice: str = ""
    factor: MeasuredValue | None = None
    offset_nm: MeasuredValue | None = None
    time_offset_s: float = math.nan
    correlation: float = math.nan
    overlap_s: float = 0.0
    average_s: float = math.nan
    filter_s: float = math.nan
    swing_nm: float = math.nan
    samples: int = 0
    effective_samples: float = math.nan
    budget: tuple[FactorLine, ...] = ()
    series: ReferenceSeries | None = None
    warnings: tuple[str, ...] = ()


def scale_of_reference(stated_rel_sd: float | None) -> tuple[float, tuple[str, ...]]:
    """Return the relative standard uncertainty of a sensor's scale, and a warning if it is assumed.

    ``stated_rel_sd``: None if none is stated.
    """
    return (ASSUMED_REFERENCE_REL_SD, (_ASSUMED,)) if stated_rel_sd is None else (stated_rel_sd, ())


def calibrate_reference(
    drive: TorqueRecord, sensor: TorqueRecord, *, reference_rel_sd: float = ASSUMED_REFERENCE_REL_SD,
    scale_rel_sd: float = 0.02, confidence: float = 0.95,
) -> ReferenceFit:
    """Return κ from the recordings of the drive and of a sensor in one run, or the reason of a refusal.

    ``reference_rel_sd``: standard uncertainty of the sensor's scale; ``scale_rel_sd``: stated for the torque scale
    before this calibration. Raises ValueError for a recording that is not finite or whose time does not rise.
    """
    for name, one in (("the drive's log", drive), ("the reference", sensor)):
        _check(name, one)
    for name, one in (("drive's torque", drive), ("reference torque", sensor)):
        swing = _swing(one.torque_nm)
        if swing <= LEAST_SWING_COUNTS * one.count_nm or swing == 0.0:
            return ReferenceFit(f"the {name} varies too little: by {swing:.3g} N·m"
                                + (f", and its resolution is {one.count_nm:.3g} N·m" if one.count_nm else ""),
                                "change the torque in the record by as much as the rig allows")
    shortest = min(float(np.ptp(drive.time_s)), float(np.ptp(sensor.time_s)))
    if shortest < LEAST_OVERLAP_S:
        return ReferenceFit(f"the records have no overlap of {LEAST_OVERLAP_S:g} s: the shorter one lasts"
                            f" {shortest:.3g} s", "record the sensor during the whole run")
    offset_s, correlation = _coarse_offset(drive, sensor)
    if correlation <= -LEAST_CORRELATION:
        return ReferenceFit(f"the reference has the opposite sign (correlation {correlation:.2f})",
                            "reverse the sign of one torque", correlation=correlation, time_offset_s=offset_s)
    if not correlation >= LEAST_CORRELATION:
        return ReferenceFit(
            f"the correlation of both torques is too low: {correlation:.2f} at the best time offset (limit"
            f" {LEAST_CORRELATION:g})", "check that both records are of the same run and the same shaft, and change the"
            " torque more", correlation=correlation, time_offset_s=offset_s)
    fit = _refined(drive, sensor, offset_s)
    if fit is None or fit.effective < _LEAST_EFFECTIVE:
        return ReferenceFit("the common part of the records is too short for their slow torque",
                            "record for longer, with more changes of torque", correlation=correlation,
                            time_offset_s=offset_s)
    return _judged(drive, sensor, fit, correlation, reference_rel_sd, scale_rel_sd, confidence)


def _check(name: str, one: TorqueRecord) -> None:
    if not (np.all(np.isfinite(one.time_s)) and np.all(np.isfinite(one.torque_nm))):
        raise ValueError(f"{name} holds a value that is no number")
    if len(one.time_s) < 2 or not np.all(np.diff(one.time_s) > 0.0):
        raise ValueError(f"the time of {name} does not rise")


def _swing(torque: FloatArray) -> float:
    low, high = np.percentile(torque, _SWING)
    return float(high - low)


# ---------------------------------------------------------------------------------------------------------------------
# Average of samples at their own times.


def _averaged(one: TorqueRecord, at_s: FloatArray, width_s: float) -> FloatArray:
    """Return the Gaussian average (n,) at rising times ``at_s``; NaN if samples are missing within its reach."""
    time, torque = one.time_s, one.torque_nm
    spans = np.gradient(time)
    first, last = (np.searchsorted(time, at_s + sign * _REACH * width_s) for sign in (-1.0, 1.0))
    gaps = np.concatenate([[0], np.cumsum(np.diff(time) > width_s)])        # number of gaps before each sample
    whole = (at_s - _REACH * width_s >= time[0]) & (at_s + _REACH * width_s <= time[-1]) & (last - first > 1)
    whole &= gaps[np.maximum(last - 1, 0)] == gaps[np.clip(first - 1, 0, len(time) - 1)]
    found = np.full(len(at_s), np.nan)
    most = int(np.max((last - first)[whole], initial=1))
    for some in np.array_split(np.flatnonzero(whole), max(1, int(np.count_nonzero(whole)) * most // _AT_ONCE)):
        index = first[some, None] + np.arange(most)
        inside = index < last[some, None]
        index = np.minimum(index, len(time) - 1)
        weight = inside * spans[index] * np.exp(-0.5 * ((time[index] - at_s[some, None]) / width_s) ** 2)
        found[some] = np.sum(weight * torque[index], axis=1) / np.sum(weight, axis=1)
    return found


def _grid(start_s: float, end_s: float, step_s: float) -> FloatArray:
    count = max(int((end_s - start_s) / step_s), 1)
    return np.asarray(start_s + step_s * np.arange(count), dtype=np.float64)


def _coarse_offset(drive: TorqueRecord, sensor: TorqueRecord) -> tuple[float, float]:
    """Return the time offset with the largest correlation, or with a clearly larger negative one, and that correlation.

    Searches every offset with an overlap of at least half of the shorter record and `LEAST_OVERLAP_S`.
    """
    from scipy.signal import fftconvolve

    width = max(_COARSE_S, 2.0 * _slowest(drive), 2.0 * _slowest(sensor))
    step = width / _PER_WIDTH
    x, y = (_averaged(one, _grid(one.time_s[0], one.time_s[-1], step), width) for one in (drive, sensor))
    products = {}
    known_x, known_y = np.isfinite(x), np.isfinite(y)
    middle = float(np.nanmean(x)), float(np.nanmean(y))
    x, y = np.where(known_x, x - middle[0], 0.0), np.where(known_y, y - middle[1], 0.0)
    ones_x, ones_y = known_x.astype(np.float64), known_y.astype(np.float64)
    for name, a, b in (("n", ones_x, ones_y), ("x", x, ones_y), ("y", ones_x, y), ("xx", x * x, ones_y),
                       ("yy", ones_x, y * y), ("xy", x, y)):
        # Σ_t a(t) b(t + lag) for lags from −(len(a) − 1) to len(b) − 1
        products[name] = np.asarray(fftconvolve(b, a[::-1]), dtype=np.float64)
    n = products["n"]
    least = max(LEAST_OVERLAP_S / step, 0.5 * min(len(x), len(y)))
    enough = n >= min(least, float(n.max()))
    n = np.maximum(n, 1.0)
    xy = products["xy"] - products["x"] * products["y"] / n
    xx, yy = (products[2 * one] - products[one] ** 2 / n for one in ("x", "y"))
    size = np.sqrt(np.maximum(xx, 0.0) * np.maximum(yy, 0.0))
    floor = 1e-9 * math.sqrt(float(np.sum(x * x)) * float(np.sum(y * y)))
    r = np.where(enough & (size > floor), xy / np.maximum(size, max(floor, 1e-300)), 0.0)
    best, opposite = int(np.argmax(r)), int(np.argmin(r))
    if -r[opposite] > r[best] + _CLEARLY:       # a tone correlates with both signs, half a period apart
        best = opposite
    lag = best - (len(x) - 1)
    return float(sensor.time_s[0] - drive.time_s[0] + lag * step), float(r[best])


def _slowest(one: TorqueRecord) -> float:
    """Return the usual interval between samples, s: nine of ten intervals are not longer."""
    return float(np.percentile(np.diff(one.time_s), 90.0))


# ---------------------------------------------------------------------------------------------------------------------
# Fit of κ, offset and time offset.


@dataclass(frozen=True)
class _Fitted:
    slope: float
    low: float                  # κ with all noise in the sensor
    high: float                 # κ with all noise in the drive's report, its derivatives taken as exact
    reported: float             # κ with all noise in the drive's report and its derivatives
    own_share: float            # share of the torque's variance that its derivatives do not explain
    sd: float
    effective: float
    offset: float
    offset_sd: float
    delay_s: float
    width_s: float
    variance_s2: float
    time_s: FloatArray
    x: FloatArray
    y: FloatArray
    left: FloatArray


def _refined(drive: TorqueRecord, sensor: TorqueRecord, offset_s: float) -> _Fitted | None:
    """Return the fit in the widest band that the sampling and the difference of the filters allow."""
    narrowest = max(_NARROWEST_S, 2.0 * _slowest(drive), 2.0 * _slowest(sensor))
    width, found = max(narrowest, _COARSE_S), None
    for _ in range(_ROUNDS):
        found = _fitted(drive, sensor, offset_s, width)
        if found is None:
            return None
        offset_s = found.delay_s
        overlap = float(np.ptp(found.time_s))
        wanted = max(narrowest, _WIDER_THAN_FILTERS * math.sqrt(abs(found.variance_s2)))
        wanted = min(wanted, max(narrowest, _WIDEST_SHARE * overlap))
        if wanted <= 1.1 * width and wanted >= width / 1.5:
            return found
        width = max(wanted, width / 1.5) if wanted < width else wanted
    return found


def _fitted(drive: TorqueRecord, sensor: TorqueRecord, offset_s: float, width_s: float) -> _Fitted | None:
    """Return the fit with one average, its time offset refined from ``offset_s``."""
    from scipy.interpolate import make_interp_spline

    step = width_s / _PER_WIDTH
    margin = _REACH * width_s
    start = max(drive.time_s[0], sensor.time_s[0] - offset_s) + margin
    end = min(drive.time_s[-1], sensor.time_s[-1] - offset_s) - margin
    if end - start < LEAST_OVERLAP_S / 2.0:
        return None
    # four points a width: a spline of degree 5 through such a smooth signal has errors far below its noise
    fine = _grid(start - 0.5 * margin, end + 0.5 * margin, 0.5 * step)
    reported = _averaged(drive, fine, width_s)
    referred = _averaged(sensor, fine + offset_s, width_s)
    good = np.isfinite(reported) & np.isfinite(referred)
    if np.count_nonzero(good) < 4 * int(_LEAST_EFFECTIVE):
        return None
    curves = [make_interp_spline(fine, np.interp(fine, fine[good], one[good]), k=5) for one in (reported, referred)]
    near = np.convolve(~good, np.ones(5), "same") > 0.5
    points = fine[2:-2:2]
    usable = ~near[2:-2:2] & (points >= start) & (points <= end)
    points = points[usable]
    if len(points) < 2 * int(_LEAST_EFFECTIVE):
        return None
    x = curves[0](points)
    others = np.column_stack([np.ones_like(x), *(curves[0].derivative(order)(points) for order in (1, 2, 3))])
    shift = 0.0
    for _ in range(_ROUNDS):
        y = curves[1](points + shift)
        solution = np.linalg.lstsq(np.column_stack([x, others]), y, rcond=None)[0]
        if not solution[0] > 0.0:
            break
        step_s = float(np.clip(solution[2] / solution[0], -width_s, width_s))
        shift = float(np.clip(shift - step_s, -0.4 * margin, 0.4 * margin))
        if abs(step_s) < _CLOSE * width_s:
            break
    # variance of the sensor's average over that of the drive's, from second differences of the samples
    power = []
    for one in (sensor, drive):
        sd = max(float(np.median(np.abs(np.diff(one.torque_nm, 2)))) / 0.6745 / math.sqrt(6.0),
                 one.count_nm / math.sqrt(12.0))
        power.append(sd**2 * _slowest(one))
    ratio = float(np.clip(power[0] / power[1], *_ALIKE)) if power[1] > 0.0 and power[0] > 0.0 else 1.0
    return _line(points, x, y, others, ratio, offset_s + shift, width_s)


def _line(
    points: FloatArray, x: FloatArray, y: FloatArray, others: FloatArray, ratio: float, delay_s: float, width_s: float
) -> _Fitted | None:
    """Return Deming's line through x and y without the other terms, with the variance of correlated residuals."""
    basis = np.linalg.qr(others)[0]
    u, v = x - basis @ (basis.T @ x), y - basis @ (basis.T @ y)
    uu, vv, uv = float(u @ u), float(v @ v), float(u @ v)
    if not (uv > 0.0 and uu > 0.0):
        return None
    low, high = uv / uu, vv / uv
    difference = vv - ratio * uu
    slope = (difference + math.sqrt(difference**2 + 4.0 * ratio * uv**2)) / (2.0 * uv)
    left = v - slope * u
    steps = np.diff(points)
    even = float(np.min(steps))
    place = np.rint((points - points[0]) / even).astype(np.int64)
    variance = _long_run(u, left, place)
    plain = float(left @ left) / len(left) * uu
    effective = min(len(left) * plain / variance, float(len(left))) if variance > 0.0 else float(len(left))
    if effective <= _TERMS + 1.0:
        return None
    grown = effective / (effective - _TERMS - 1.0)
    sd = math.sqrt(max(variance, plain) * grown) / uu
    terms = np.linalg.lstsq(others, y - slope * x, rcond=None)[0]
    noise = math.sqrt(float(left @ left) / len(left) * grown * len(left) / effective)
    offset_sd = math.hypot(noise / math.sqrt(len(left)), sd * abs(float(np.mean(x))))
    rest = math.sqrt(float(left @ left) / (len(left) - _TERMS - 1.0)) / slope
    reported = _all_noise_reported(x, y, others, rest, width_s)
    own_share = uu / max(float(np.sum((x - np.mean(x)) ** 2)), 1e-300)
    return _Fitted(slope, low, high, reported, own_share, sd, effective, float(terms[0]), offset_sd, delay_s, width_s,
                   2.0 * float(terms[2]) / slope, points, x, y, left)


def _all_noise_reported(x: FloatArray, y: FloatArray, others: FloatArray, fit_noise: float, width_s: float) -> float:
    """Return κ if all residuals were white noise of the reported torque and so of its derivatives; inf if no κ fits.

    Least squares with noisy regressors: the expected part of the noise is subtracted from the normal equations. The
    derivatives a and b of white noise of density S behind the average have the covariance ±S Γ((a + b + 1)/2)/(2π σ^(a
    + b + 1)).
    """
    orders = (0, None, None, 2, None)      # the odd derivatives have another phase and do not affect κ
    noise = np.zeros((len(orders), len(orders)))
    for i, a in enumerate(orders):
        for j, b in enumerate(orders):
            if a is not None and b is not None and (a + b) % 2 == 0:
                size = math.gamma(0.5 * (a + b + 1)) / (math.sqrt(math.pi) * width_s ** (a + b))
                noise[i, j] = (-1.0) ** ((a - b) // 2) * size      # as a multiple of the variance of the average
    design = np.column_stack([x, others])
    scale = 1.0 / np.linalg.norm(design, axis=0)
    normal = (design.T @ design - len(x) * fit_noise**2 * noise) * np.outer(scale, scale)
    if float(np.linalg.eigvalsh(normal)[0]) <= 0.0:
        return math.inf
    return float((np.linalg.solve(normal, (design.T @ y) * scale) * scale)[0])


def _long_run(u: FloatArray, left: FloatArray, place: FloatArray) -> float:
    """Return Σ_k c_u(k) γ(k), the variance of Σ u·residual; γ: autocovariance of the residuals, without gaps."""
    count = int(place[-1]) + 1
    full_u, full_r, there = np.zeros(count), np.zeros(count), np.zeros(count)
    full_u[place], full_r[place], there[place] = u, left, 1.0
    size = 1 << (2 * count - 1).bit_length()

    def autocorrelation(one: FloatArray) -> FloatArray:
        return np.asarray(np.fft.irfft(np.abs(np.fft.rfft(one, size)) ** 2, size)[:count])

    pairs = np.maximum(autocorrelation(there), 1.0)
    gamma = autocorrelation(full_r) / pairs
    c = autocorrelation(full_u)
    # the correlation of the residuals ends where it first falls below its scatter; lags up to twice that count, with
    # decreasing weight
    negligible = np.flatnonzero(gamma < 2.0 / math.sqrt(len(left)) * gamma[0])
    ends = int(negligible[0]) if len(negligible) else count
    reach = min(max(2 * ends, 4 * int(_PER_WIDTH)), count // 4)
    k = np.arange(1, reach)
    fading = np.where(k <= reach // 2, 1.0, 2.0 * (1.0 - k / reach))
    return float(c[0] * gamma[0] + 2.0 * np.sum(fading * c[1:reach] * gamma[1:reach]))


# ---------------------------------------------------------------------------------------------------------------------


def _judged(
    drive: TorqueRecord, sensor: TorqueRecord, fit: _Fitted, correlation: float, reference_rel_sd: float,
    scale_rel_sd: float, confidence: float,
) -> ReferenceFit:
    """Return the result with budget, interval, and the refusal if there is one."""
    k = fit.slope
    if not math.isfinite(fit.reported):
        return ReferenceFit("the torque varies too little for its noise: its scale and the low-pass filters look alike",
                            "change the torque by more, or record for longer", correlation=correlation,
                            time_offset_s=fit.delay_s)
    if fit.own_share < LEAST_OWN_SHARE:
        return ReferenceFit("the torque holds too few frequencies: its scale and the low-pass filters look alike",
                            "change the torque in steps, with some seconds of steady torque between them",
                            correlation=correlation, time_offset_s=fit.delay_s)
    wide = _fitted(drive, sensor, fit.delay_s, 2.0 * fit.width_s)
    of_band = 0.0
    if wide is not None:
        own = max(wide.sd**2 - fit.sd**2, 0.0)
        of_band = math.sqrt(max((wide.slope - k) ** 2 - own, 0.0))
    of_noise = max(fit.high - k, k - fit.low, abs(fit.reported - fit.low), 0.0) / math.sqrt(3.0)
    dof = fit.effective - _TERMS - 1.0
    budget = (
        FactorLine("scatter of both torques", "Student", dof, fit.sd / k),
        FactorLine("share of the noise in either torque", "rectangular", CERTAIN, of_noise / k),
        FactorLine("filters of both torques", "normal", CERTAIN, of_band / k),
        FactorLine("scale of the reference", "normal", CERTAIN, reference_rel_sd),
    )
    whole = math.sqrt(sum(line.of_factor**2 for line in budget))
    effective = effective_degrees_of_freedom([(line.of_factor, line.degrees_of_freedom) for line in budget])
    factor = measured_value(k, whole * k, effective, confidence)
    chosen = np.unique(np.linspace(0, len(fit.time_s) - 1, _MOST_PLOTTED).round().astype(np.int64))
    found = ReferenceFit(
        factor=factor, offset_nm=measured_value(fit.offset, fit.offset_sd, dof, confidence),
        time_offset_s=fit.delay_s, correlation=correlation, overlap_s=float(np.ptp(fit.time_s)), average_s=fit.width_s,
        filter_s=math.copysign(math.sqrt(abs(fit.variance_s2)), fit.variance_s2), swing_nm=_swing(fit.y),
        samples=len(fit.time_s), effective_samples=fit.effective, budget=budget,
        series=ReferenceSeries(fit.time_s[chosen], fit.x[chosen], fit.y[chosen], fit.left[chosen]),
    )
    assumed = normal_quantile(confidence) * scale_rel_sd
    if factor.half_width_share > assumed:
        return replace(
            found, refusal=f"the torque varies too little: {found.swing_nm:.3g} N·m leave κ at"
            f" {printed_share(factor.half_width_share)}, and the stated torque scale leaves ±{100 * assumed:.1f} %",
            advice="change the torque by more, in steps and slowly, or record for longer")
    reason, warnings = compared(factor, scale_rel_sd, assumed, "the reference")
    advice = "check the unit of the reference, and the shaft that it stands at (--at)" if reason else ""
    return replace(found, refusal=reason, advice=advice, warnings=warnings)
