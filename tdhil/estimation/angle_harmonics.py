r"""Torque that depends on the angle of the shaft: cogging and eccentricity, found beside the model and taken out of J.

::

    T = J dω/dt + B ω + T_c + Σ a_n cos(n θ + φ_n)          θ = 0 at the first reading of the angle

Each term is a known signal of the reported angle, whose size is unknown. A periodic excitation repeats the speed, and
not the angle, except by chance. So everything that repeats from period to period is left out first: the excited lines,
nonlinear friction, and most of a model's errors. With the fitted model Z = T/ω and the filter F_T of the reported
torque, the rest obeys

    Y = T − Z W = F_T e^(−δ s) Σ (c_n C_n + s_n S_n) + noise,        c_n = a_n cos φ_n,  s_n = −a_n sin φ_n,

where T, W, C_n and S_n are the spectra of torque, speed, cos nθ and sin nθ over all periods of a segment. δ is the
delay of the reported speed behind the angle, beyond its filter. The derivative Ω of the angle gives a second rest,
Y' = T − (J s + B) F_T e^(−δ s) Ω, with the same harmonics and other noise. It does not depend on the filter of the
speed, so it counts in each band of frequencies in which it has not much more power. The spectrum of the noise is
estimated from the rest itself. The fit is linear, and weighted by this noise.

An order counts if it lowers −2 ln L by more than `LEAST_GAIN`. Its torque, as the drive reports it, is then subtracted
from the reported torque, and the recording is identified again. Both steps are repeated, so that J and the harmonics
are those of one fit. What the uncertainty of the harmonics adds to J is added to its interval.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from tdhil.estimation.case import Finding, PeriodicCase
from tdhil.estimation.cubic_spline import CubicSpline
from tdhil.estimation.frequency_domain import ModelCurve, filters
from tdhil.estimation.line_influence import LEAST_PERIODS, inertia_changes, segment_means, widened
from tdhil.estimation.result import AngleHarmonic, Estimate, LeastHarmonic, normal_quantile
from tdhil.estimation.samples import ALL_TIME, LONGEST_GAP, Samples, Stretch, angle_readings, usual_interval
from tdhil.estimation.spectrum import ComplexArray, unit_waves
from tdhil.recording import BoolArray, FloatArray, IntArray, Recording

LEAST_GAIN = 40.0
"""Least decrease of −2 ln L by the two parameters of an order. For white noise the probability of as much by chance is
e^(−20) for one order, and below 1e-6 for all of them."""

LEAST_COUNTS = 0.02
"""Least motion of the shaft by an order, counts of the angle, in the slowest segment. The rounding of the angle repeats
with the angle, so that no fit averages it out: over an hour it made orders of 0.01 counts
(`benchmarks/identify_speed.py`)."""

MOST_ORDERS = 8
"""Most orders in one fit."""

LEAST_ORDERS = (1, 2, 3, 4, 6, 8, 12, 18, 24, 36, 48, 72)
"""Orders whose detection limit is stated: eccentricity, and usual numbers of poles and slots."""

HIGHEST_ORDER = 256
"""Highest order tested."""

LOOK_POINTS = 65_536
"""Most points of a segment's grid in which orders are sought first, over its first whole periods. They are 11 minutes
at 100 Hz and 2 at 500 Hz, more than any segment of the study has (`benchmarks/harmonics_of_angle.py`). The rest of a
longer segment is used if an order stands out here."""

_BINS = 4096              # bins of a turn, in which the angle is sorted for the first look
_FIRST_LOOK = 0.5         # of LEAST_GAIN: least gain in the first look, which is approximate, for the exact one
_MOST_RATE_HZ = 500.0     # Hz; a faster recording is averaged down to it
_USED_BAND = 0.3          # of the rate: highest frequency used
_ANGLE_BAND = 0.25        # of the rate of the angle's readings: highest frequency of its derivative
_LOUDER = 4.0             # largest power of the rest by the angle over that by the speed, with which it is used
_TAPER = 0.25             # of a period: length of the taper at either end of a segment
_BAND_BINS = 24           # fewest spectral lines whose median gives the noise
_BAND_RATIO = 1.15        # ratio of the frequencies at the ends of such a band, where it has more lines
_MEDIAN = math.log(2.0)   # median of |x|² over its mean, complex Gaussian
_ROUNDS = 2               # rounds of harmonics and model
_STEP = 0.5               # sd: step of a parameter, for the slope of the harmonics over it
_FINER = 2                # grid points for one sample, on which the harmonics pass the filter
_SETTLED_S = 20.0         # s; after this time the longest filter has settled
_SEEN_SHARE = 0.98        # share of the time in which an order must be inside the used band
_BLOCK_S = 2.0            # s; blocks of time whose scores are independent: longer than load and filters remember
_SAME_RAD = 1e-9          # rad: a smaller difference of two readings is rounding of the arithmetic
_HIDES = normal_quantile(0.9)      # sd of the noise that hides an order of a larger amplitude in 5 of 100 runs
_SMALL = 1e-12            # relative: smaller eigenvalues of the normal matrix count as zero


@dataclass(frozen=True)
class HarmonicTorque:
    """Harmonics with their covariance. ``orders`` (H,); ``parts`` (2H,): c_n and s_n of each order in turn, N·m;
    ``covariance`` (2H, 2H).
    """

    orders: tuple[int, ...]
    parts: FloatArray
    covariance: FloatArray

    def estimates(self, confidence: float) -> tuple[AngleHarmonic, ...]:
        """Return amplitude and phase of every order with their intervals, in order of amplitude."""
        width = normal_quantile(confidence)
        found = []
        for k, order in enumerate(self.orders):
            own = self.covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2]
            c, s = self.parts[2 * k : 2 * k + 2]
            amplitude = math.hypot(c, s)
            along = np.array([c, s]) / amplitude
            across = np.array([-s, c]) / amplitude
            radial, turned = (width * math.sqrt(max(float(row @ own @ row), 0.0)) for row in (along, across))
            phase, half = math.atan2(-s, c), math.atan2(turned, amplitude)
            found.append(AngleHarmonic(
                order, Estimate(amplitude, max(amplitude - radial, 0.0), amplitude + radial),
                Estimate(phase, phase - half, phase + half)))
        return tuple(sorted(found, key=lambda one: -one.amplitude_nm.value))


# ---------------------------------------------------------------------------------------------------------------------
# Signals on a uniform grid, without what repeats


@dataclass(frozen=True)
class _Angle:
    """Angle of the shaft as a smooth function of time, from ``begin_s`` to ``end_s``."""

    spline: CubicSpline
    begin_s: float
    end_s: float
    times: FloatArray
    count_rad: float
    """One count of the readings: the smallest difference of two of their steps; 0 if none is seen."""

    @classmethod
    def of(cls, recording: Recording, spans: Sequence[tuple[float, float]]) -> _Angle | None:
        """Return the angle over spans of time, s; None if the drive reports none, or hardly any."""
        readings = angle_readings(recording, spans)
        if readings is None:
            return None
        times, turned = readings
        if len(times) < _BAND_BINS or not np.all(np.diff(times) > 0.0):
            return None
        spline = CubicSpline.through(times, turned)
        differences = np.diff(np.unique(np.diff(turned)))
        counts = differences[differences > _SAME_RAD]
        return cls(spline, float(times[0]), float(times[-1]), times, float(counts.min()) if len(counts) else 0.0)

    def at(self, time_s: FloatArray) -> FloatArray:
        """Return the angle (N,), rad."""
        return self.spline.at(time_s)

    def speed(self, time_s: FloatArray) -> FloatArray:
        """Return the derivative of the angle (N,), rad/s."""
        return self.spline.slope(time_s)

    def covers(self, begin_s: float, end_s: float, longest_gap_s: float) -> bool:
        """Return whether the angle is known in a span without a long gap."""
        if begin_s < self.begin_s - longest_gap_s or end_s > self.end_s + longest_gap_s:
            return False
        inside = self.times[(self.times >= begin_s - longest_gap_s) & (self.times <= end_s + longest_gap_s)]
        return len(inside) > 1 and float(np.max(np.diff(inside))) <= longest_gap_s


@dataclass(frozen=True)
class _GridSegment:
    """One segment on a grid of N points: spectra of torque and speed without what repeats, and the angle.

    ``hertz`` (K,) are the used frequencies, ``chosen`` their places in the spectrum of the N points.
    """

    angle_rad: FloatArray
    taper: FloatArray
    periods: int
    hertz: FloatArray
    chosen: slice
    torque: ComplexArray
    speed: ComplexArray
    turning: ComplexArray
    """Spectrum (K,) of the derivative of the angle."""
    angle_band: int
    """Number of the used frequencies at which the readings of the angle are close enough for its derivative."""
    rate_rad_s: float
    """Mean speed by the angle."""
    count_rad: float
    """One count of the angle's readings."""
    kept: dict[int, tuple[ComplexArray, ComplexArray]] = field(default_factory=dict)

    def repeats(self, signal: FloatArray) -> FloatArray:
        """Return a signal (N,) without its mean over the periods."""
        by_period = signal.reshape(self.periods, -1)
        found: FloatArray = (by_period - by_period.mean(axis=0)).reshape(-1)
        return found

    def spectrum(self, signal: FloatArray) -> ComplexArray:
        """Return the spectrum (K,) of a signal (N,) without what repeats."""
        found: ComplexArray = np.fft.rfft(self.taper * self.repeats(signal))[self.chosen]
        return found

    def waves(self, order: int) -> tuple[ComplexArray, ComplexArray]:
        """Return the spectra (K,) of cos nθ and of sin nθ, computed once."""
        if order not in self.kept:
            turned = order * self.angle_rad
            self.kept[order] = self.spectrum(np.cos(turned)), self.spectrum(np.sin(turned))
        return self.kept[order]


def _run(index: tuple[int, ...]) -> tuple[int, int]:
    """Return the first and the last place of the longest run of consecutive numbers."""
    breaks = [0, *(k + 1 for k in range(len(index) - 1) if index[k + 1] != index[k] + 1), len(index)]
    begin, end = max(itertools.pairwise(breaks), key=lambda span: span[1] - span[0])
    return begin, end - 1


def _first_periods(stretch: Stretch) -> Stretch:
    """Return the first periods of a stretch, up to `LOOK_POINTS`; the stretch itself if it has no more."""
    if not stretch.index:
        return stretch
    first, last = _run(stretch.index)
    interval = max(usual_interval(stretch.periods[first].time_s), 1.0 / _MOST_RATE_HZ)
    most = max(LEAST_PERIODS, int(LOOK_POINTS * interval / stretch.segment.period_s))
    if last - first < most:
        return stretch
    return replace(stretch, periods=stretch.periods[first : first + most], index=stretch.index[first : first + most])


def _span(stretch: Stretch) -> tuple[float, float]:
    """Return the begin of the first period of a stretch, and the end of its last one, s."""
    start_s, period_s = stretch.segment.start_s, stretch.segment.period_s
    return start_s + stretch.index[0] * period_s, start_s + (stretch.index[-1] + 1) * period_s


def _segment(stretch: Stretch, samples: Samples, angle: _Angle) -> _GridSegment | None:
    if not stretch.index:
        return None
    first, last = (stretch.index[k] for k in _run(stretch.index))
    periods, period_s = last - first + 1, stretch.segment.period_s
    begin = stretch.segment.start_s + first * period_s
    end = begin + periods * period_s
    inside = samples.between(begin - 1e-9, end - 1e-9)
    if periods < LEAST_PERIODS or not angle.covers(begin, end, LONGEST_GAP / max(stretch.segment.lines_hz)):
        return None
    interval = max(usual_interval(inside.time_s), 1.0 / _MOST_RATE_HZ)
    count = max(1, round(period_s / interval))
    step = period_s / count
    time: FloatArray = np.asarray(begin + step * np.arange(periods * count), dtype=np.float64)
    speed, torque = (_on_grid(time, step, inside.time_s, signal) for signal in (inside.speed_rad_s, inside.torque_nm))
    rise = max(1, round(_TAPER * count))
    taper: FloatArray = np.ones(len(time))
    edge = 0.5 - 0.5 * np.cos(math.pi * (np.arange(rise) + 0.5) / rise)
    taper[:rise], taper[-rise:] = edge, edge[::-1]
    hertz: FloatArray = np.asarray(np.fft.rfftfreq(len(time), step), dtype=np.float64)
    chosen = slice(1, int(np.searchsorted(hertz, _USED_BAND / step)))
    blank = np.zeros(0, dtype=np.complex128)
    band = int(np.searchsorted(hertz[chosen], _ANGLE_BAND / usual_interval(angle.times)))
    turned = angle.at(time)
    rate = float(turned[-1] - turned[0]) / float(time[-1] - time[0])
    bare = _GridSegment(turned, taper, periods, hertz[chosen], chosen, blank, blank, blank, band, rate, angle.count_rad)
    return replace(bare, torque=bare.spectrum(torque), speed=bare.spectrum(speed),
                   turning=bare.spectrum(angle.speed(time)))


def _on_grid(time: FloatArray, step: float, sampled_s: FloatArray, signal: FloatArray) -> FloatArray:
    """Return a signal on the grid: between two samples, or the mean about a point if there are several."""
    if len(sampled_s) < 2 * len(time):
        return np.interp(time, sampled_s, signal)
    place = np.clip(np.round((sampled_s - time[0]) / step).astype(np.int64), 0, len(time) - 1)
    number = np.bincount(place, minlength=len(time))
    total = np.bincount(place, weights=signal, minlength=len(time))
    return np.where(number > 0, total / np.maximum(number, 1), np.interp(time, sampled_s, signal))


# ---------------------------------------------------------------------------------------------------------------------
# The fit


def _bands(hertz: FloatArray) -> list[tuple[int, int]]:
    """Return bands [begin, end) of the frequencies, each with enough lines for its noise."""
    ends = [0]
    while ends[-1] < len(hertz):
        wide = int(np.searchsorted(hertz, _BAND_RATIO * hertz[ends[-1]]))
        ends.append(max(wide, ends[-1] + _BAND_BINS))
    ends[-1] = len(hertz)
    if len(ends) > 2 and ends[-1] - ends[-2] < _BAND_BINS:
        del ends[-2]
    return list(itertools.pairwise(ends))


def _noise(hertz: FloatArray, rest: ComplexArray) -> FloatArray:
    """Return the spectrum of the noise, E|Y|² (K,), from medians over bands; a narrow peak does not change it."""
    power, spans = np.abs(rest) ** 2, _bands(hertz)
    level = np.array([np.median(power[a:b]) / _MEDIAN for a, b in spans])
    middle = np.array([math.sqrt(hertz[a] * hertz[b - 1]) for a, b in spans])
    floor = 1e-20 * float(np.max(power, initial=0.0)) + 1e-300
    found: FloatArray = np.exp(np.interp(np.log(hertz), np.log(middle), np.log(np.maximum(level, floor))))
    return found


@dataclass(frozen=True)
class _WeighedSegment:
    """One segment as a model sees it: Y or Y' (K,), the filter of the torque F (K,), and E|noise|² (K,)."""

    segment: _GridSegment
    rest: ComplexArray
    through: ComplexArray
    noise: FloatArray

    def columns(self, orders: Sequence[int]) -> ComplexArray:
        """Return F C_n and F S_n of every order, (K, 2H)."""
        waves = [self.through * wave for order in orders for wave in self.segment.waves(order)]
        return np.stack(waves, axis=1) if waves else np.zeros((len(self.rest), 0), dtype=np.complex128)

    def matched(self, rest: ComplexArray) -> FloatArray:
        """Return the signal (N,) whose product with cos nθ, summed and times N, is the score of c_n for a rest (K,)."""
        count = len(self.segment.angle_rad)
        whole = np.zeros(count // 2 + 1, dtype=np.complex128)
        whole[self.segment.chosen] = self.through.conj() * rest / self.noise
        return self.segment.repeats(self.segment.taper * np.fft.irfft(whole, count))


@dataclass(frozen=True)
class _View:
    """The segments as one model sees them. ``impedance``: T/ω (K,) of its shaft at s (K,), N·m·s/rad."""

    seen: tuple[_WeighedSegment, ...]
    impedance: Callable[[ComplexArray], ComplexArray]

    @classmethod
    def of(cls, segments: tuple[_GridSegment, ...], curve: ModelCurve, theta: FloatArray, delay_s: float) -> _View:
        model = curve.fitted.problem.model
        found = []
        for one in segments:
            s: ComplexArray = np.asarray(2j * np.pi * one.hertz, dtype=np.complex128)
            through = filters(theta[model.mechanical :], s)[1] * np.exp(-delay_s * s)
            by_speed = one.torque - model.impedance(theta, s) * one.speed
            by_angle = one.torque - model.shaft.impedance(theta[: model.mechanical], s) * through * one.turning
            # By the angle in each band in which it has no more than `_LOUDER` times the power of that by the speed: the
            # harmonics in it do not depend on the filter of the speed.
            rest = by_speed.copy()
            for begin, end in _bands(one.hertz):
                if end <= one.angle_band:
                    loud, quiet = (float(np.median(np.abs(by[begin:end]) ** 2)) for by in (by_angle, by_speed))
                    if loud <= _LOUDER * quiet:
                        rest[begin:end] = by_angle[begin:end]
            found.append(_WeighedSegment(one, rest, through, np.ones(len(s))))
        return cls(tuple(found), partial(model.shaft.impedance, theta[: model.mechanical]))

    def least_nm(self, order: int) -> float:
        """Return the amplitude of an order that moves the shaft by `LEAST_COUNTS` where this needs least, N·m."""
        segments = [seen.segment for seen in self.seen]
        omega = order * np.array([abs(one.rate_rad_s) for one in segments])
        impedance = np.abs(self.impedance(np.asarray(1j * omega, dtype=np.complex128)))
        return LEAST_COUNTS * min(one.count_rad for one in segments) * float(np.min(impedance * omega))

    def weighted(self, torque: HarmonicTorque | None) -> tuple[_WeighedSegment, ...]:
        """Return the segments with the noise that is left without the harmonics found so far."""
        found = []
        for seen in self.seen:
            left = seen.rest if torque is None else seen.rest - seen.columns(torque.orders) @ torque.parts
            found.append(replace(seen, noise=_noise(seen.segment.hertz, left)))
        return tuple(found)


def _fit(seen: tuple[_WeighedSegment, ...], orders: Sequence[int]) -> HarmonicTorque:
    """Return the weighted least squares of the orders. An order that the angle cannot show has an infinite variance."""
    count = 2 * len(orders)
    normal, right = np.zeros((count, count)), np.zeros(count)
    for one in seen:
        columns = one.columns(orders)
        weighted = 2.0 * columns.conj() / one.noise[:, None]
        normal += (weighted.T @ columns).real
        right += (weighted.T @ one.rest).real
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    inverse = np.linalg.pinv(normal * np.outer(scale, scale), rcond=_SMALL, hermitian=True) * np.outer(scale, scale)
    parts = inverse @ right
    return HarmonicTorque(tuple(orders), parts, _robust(seen, orders, parts, inverse))


def _robust(
    seen: tuple[_WeighedSegment, ...], orders: Sequence[int], parts: FloatArray, inverse: FloatArray
) -> FloatArray:
    """Return the covariance of the parts, raised where their scatter over time is larger than that of the noise.

    Rounding makes tones that come and go with the speed: they are no noise of a spectrum. The scores of blocks of time
    scatter with them. Their covariance between ``inverse`` on both sides is that of the parts, whatever the noise is.
    """
    meat = np.zeros_like(inverse)
    for one in seen:
        segment, count = one.segment, len(one.segment.angle_rad)
        signal = one.matched(one.rest - one.columns(orders) @ parts)
        blocks = max(2, round(segment.hertz[0] ** -1 / _BLOCK_S))
        ends = np.linspace(0, count, blocks + 1).astype(np.int64)[:-1]
        scores = np.stack([count * np.add.reduceat(signal * wave, ends) for order in orders
                           for wave in (np.cos(order * segment.angle_rad), np.sin(order * segment.angle_rad))])
        meat += scores @ scores.T
    seen_variance = np.diag(inverse @ meat @ inverse).reshape(-1, 2).sum(axis=1)
    assumed = np.diag(inverse).reshape(-1, 2).sum(axis=1)
    raised = np.repeat(np.sqrt(np.maximum(seen_variance / np.maximum(assumed, 1e-300), 1.0)), 2)
    found: FloatArray = inverse * np.outer(raised, raised)
    return found


def _gains(torque: HarmonicTorque, view: _View) -> FloatArray:
    """Return the decrease of −2 ln L by each order (H,); 0 for an order that may be the rounding of the angle."""
    gains = []
    for k, order in enumerate(torque.orders):
        own = slice(2 * k, 2 * k + 2)
        part = torque.parts[own]
        gain = float(part @ np.linalg.pinv(torque.covariance[own, own]) @ part)
        gains.append(gain if math.hypot(*part) >= view.least_nm(order) else 0.0)
    return np.array(gains)


def _candidates(seen: tuple[_WeighedSegment, ...], torque: HarmonicTorque | None) -> list[int]:
    """Return the orders that may stand out, the clearest first. One pass for all orders: the weighted rest is averaged
    over the angle, and the orders are the spectrum of this mean.
    """
    sums, energy = np.zeros(HIGHEST_ORDER + 1, dtype=np.complex128), np.zeros(HIGHEST_ORDER + 1)
    orders = np.arange(HIGHEST_ORDER + 1)
    whole_band, total = np.zeros(HIGHEST_ORDER + 1), 0.0
    for one in seen:
        segment, count = one.segment, len(one.segment.angle_rad)
        rest = one.rest if torque is None else one.rest - one.columns(torque.orders) @ torque.parts
        signal = one.matched(rest)
        place = np.floor(np.mod(segment.angle_rad, 2.0 * np.pi) * (_BINS / (2.0 * np.pi))).astype(np.int64) % _BINS
        mean = np.fft.rfft(np.bincount(place, weights=signal, minlength=_BINS))[: HIGHEST_ORDER + 1]
        sums += count * mean * np.exp(-1j * np.pi * orders / _BINS)
        places, inside, weights = _places(segment, orders)
        sensitivity = np.abs(one.through) ** 2 / one.noise
        at = np.interp(places, np.arange(len(sensitivity)), sensitivity)
        energy += 0.5 * count * (np.where(inside, at, 0.0) @ weights)
        whole_band += inside @ weights
        total += float(np.sum(weights))
    gain = np.where(energy > 0.0, np.abs(sums) ** 2 / np.maximum(energy, 1e-300), 0.0)
    gain[(whole_band < _SEEN_SHARE * total) | (orders == 0)] = 0.0
    known = set() if torque is None else set(torque.orders)
    likely = [int(n) for n in np.argsort(-gain) if gain[n] > _FIRST_LOOK * LEAST_GAIN and int(n) not in known]
    return likely[:MOST_ORDERS]


def _places(segment: _GridSegment, orders: IntArray) -> tuple[FloatArray, BoolArray, FloatArray]:
    """Return the frequencies of orders, in lines of the used band, (O, B) for B speeds; whether they are inside; the
    share of time (B,) of the speeds.
    """
    # in lines of the segment's spectrum: n dθ N/2π, with dθ the angle of one step
    weights, edges = np.histogram(np.abs(np.gradient(segment.angle_rad)), bins=64, weights=segment.taper**2)
    rate = 0.5 * (edges[1:] + edges[:-1])
    places = np.multiply.outer(orders, rate) * (len(segment.angle_rad) / (2.0 * np.pi)) - segment.chosen.start
    return places, (places >= 0.0) & (places <= len(segment.hertz) - 1.0), weights


def _least(view: _View, torque: HarmonicTorque | None) -> tuple[LeastHarmonic, ...]:
    """Return the detection limits of `LEAST_ORDERS`, as far as the used band has them: the limit of the search, and
    above it the part of the noise that may hide an order.
    """
    seen, orders = view.weighted(torque), np.array(LEAST_ORDERS)
    found = [_places(one.segment, orders) for one in seen]
    share = sum(inside @ weights for _, inside, weights in found) / sum(float(np.sum(one)) for *_, one in found)
    known = () if torque is None else torque.orders
    looked_for = [int(n) for n in orders[share >= _SEEN_SHARE]]
    fitted = _fit(seen, (*known, *(n for n in looked_for if n not in known)))
    variance = dict(zip(fitted.orders, np.diag(fitted.covariance).reshape(-1, 2).mean(axis=1).tolist(), strict=True))
    return tuple(LeastHarmonic(n, max(math.sqrt(LEAST_GAIN * variance[n]), view.least_nm(n))
                               + _HIDES * math.sqrt(variance[n])) for n in looked_for if variance[n] > 0.0)


def _search(view: _View) -> HarmonicTorque | None:
    """Return all orders that stand out; None without one. The clearest order of each look is added, and those that do
    not stand out any more are left out.
    """
    found: HarmonicTorque | None = None
    for _ in range(MOST_ORDERS):
        seen = view.weighted(found)
        known = () if found is None else found.orders
        best: HarmonicTorque | None = None
        most = 0.0
        for order in _candidates(seen, found):
            tried = _fit(seen, (*known, order))
            gain = float(_gains(tried, view)[-1])
            if gain > max(LEAST_GAIN, most):
                best, most = tried, gain
        if best is None:
            break
        found = _fit(view.weighted(best), best.orders)
    if found is None:
        return None
    kept = tuple(n for n, gain in zip(found.orders, _gains(found, view), strict=True) if gain > LEAST_GAIN)
    return _fit(view.weighted(found), kept) if kept else None


# ---------------------------------------------------------------------------------------------------------------------
# The model's part in the uncertainty, and the delay of the speed behind the angle


@dataclass(frozen=True)
class _AngleLines:
    """Lines of the reported speed and of the derivative of the angle, (K,), rad/s, at ``omega`` (K,), rad/s."""

    omega: FloatArray
    speed: ComplexArray
    turning: ComplexArray

    @classmethod
    def of(cls, case: PeriodicCase, stretches: Sequence[Stretch], angle: _Angle) -> _AngleLines:
        """Return the lines over the periods of the stretches, which are those of the case or a part of them."""
        rates, speeds, turnings = [], [], []
        for whole, stretch, fit in zip(case.stretches, stretches, case.fits, strict=True):
            if not len(fit.speed):
                continue
            omega = 2.0 * np.pi * np.array(fit.lines_hz)
            times = [period.time_s for period in stretch.periods]
            own = np.array([_lines(time, angle.speed(time), stretch.segment.start_s, omega) for time in times])
            rates.append(omega)
            speeds.append(fit.speed[np.isin(whole.index, stretch.index)].mean(axis=0))
            turnings.append(own.mean(axis=0))
        return cls(np.concatenate(rates), np.concatenate(speeds), np.concatenate(turnings))

    def delay(self, phi: FloatArray) -> tuple[float, float]:
        """Return the delay of the reported speed behind the angle beyond its filter, and its standard deviation, s.

        At an excited line, W = Ω F_w e^(−δ s). ``phi`` (6,): the parameters of the reports.
        """
        s: ComplexArray = np.asarray(1j * self.omega, dtype=np.complex128)
        ratio: ComplexArray = self.speed / (self.turning * filters(phi, s)[0])
        phase = np.arctan2(ratio.imag, ratio.real)
        weight = np.abs(self.speed) ** 2
        power = float(np.sum(weight * self.omega**2))
        delay = -float(np.sum(weight * self.omega * phase)) / power
        left = phase + delay * self.omega
        return delay, math.sqrt(float(np.sum(weight * left**2)) / max(len(phase) - 1, 1) / power)


def _lines(time: FloatArray, signal: FloatArray, start_s: float, omega: FloatArray) -> ComplexArray:
    """Return the lines (K,) of a signal over one period, from sums; the samples are nearly uniform."""
    centred = signal - signal.mean()
    found: ComplexArray = unit_waves(np.multiply.outer(-omega, time - start_s)) @ centred * (2.0 / len(time))
    return found


@dataclass(frozen=True)
class _FittedShaft:
    """A fitted model: its curve, theta (P,), the covariance of its free parameters, and the delay with its sd, s."""

    curve: ModelCurve
    theta: FloatArray
    free: tuple[int, ...]
    covariance: FloatArray
    delay_s: float
    delay_sd_s: float

    @classmethod
    def of(cls, lines: _AngleLines, curve: ModelCurve) -> _FittedShaft:
        theta = curve.fitted.likelier.theta
        free, covariance = curve.covariance()
        return cls(curve, theta, tuple(free), covariance, *lines.delay(theta[curve.fitted.problem.model.mechanical :]))


def _fitted(seen: _SeenAngle, model: _FittedShaft) -> HarmonicTorque | None:
    """Return the harmonics beside a model, with the model's part in their covariance; None without any."""
    found = _search(seen.view(model))
    if found is None:
        return None

    def parts(theta: FloatArray, delay_s: float) -> FloatArray:
        view = seen.view(replace(model, theta=theta, delay_s=delay_s))
        return _fit(view.weighted(found), found.orders).parts

    covariance = found.covariance.copy()
    slope = (parts(model.theta, model.delay_s + model.delay_sd_s) - found.parts)
    covariance += np.outer(slope, slope)
    root = np.sqrt(np.maximum(np.diag(model.covariance), 0.0))
    slopes = np.zeros((len(found.parts), len(model.free)))
    for column, index in enumerate(model.free):
        if root[column] > 0.0:
            theta = model.theta.copy()
            theta[index] += _STEP * root[column]
            delay_s, _ = seen.lines.delay(theta[model.curve.fitted.problem.model.mechanical :])
            slopes[:, column] = (parts(theta, delay_s) - found.parts) / (_STEP * root[column])
    return replace(found, covariance=covariance + slopes @ model.covariance @ slopes.T)


def _through_filter(
    samples: Samples, angle: _Angle, torque: HarmonicTorque, model: _FittedShaft
) -> FloatArray:
    """Return the torque of the harmonics as the drive reports it at the samples (N,), N·m; 0 before the first angle."""
    begin, end = max(angle.begin_s, float(samples.time_s[0])), min(angle.end_s, float(samples.time_s[-1]))
    step = max(usual_interval(samples.time_s), 1.0 / _MOST_RATE_HZ) / _FINER
    time = begin + step * np.arange(max(2, math.ceil((end - begin) / step) + 1))
    turned = angle.at(np.minimum(time, end))
    exact = np.zeros(len(time))
    for k, order in enumerate(torque.orders):
        exact += torque.parts[2 * k] * np.cos(order * turned) + torque.parts[2 * k + 1] * np.sin(order * turned)
    size = 1 << math.ceil(math.log2(len(time) + _SETTLED_S / step))      # zeros behind the end: no wave comes round
    s: ComplexArray = np.asarray(2j * np.pi * np.fft.rfftfreq(size, step), dtype=np.complex128)
    mechanical = model.curve.fitted.problem.model.mechanical
    through = filters(model.theta[mechanical:], s)[1] * np.exp(-model.delay_s * s)
    reported = np.fft.irfft(np.fft.rfft(exact, size) * through, size)[: len(time)]
    return np.interp(samples.time_s, time, reported, left=0.0, right=float(reported[-1]))


def _widened(
    case: PeriodicCase, finding: Finding, segments: dict[int, _GridSegment], torque: HarmonicTorque, delay_s: float
) -> Finding:
    """Return the finding with the part of the harmonics in the uncertainty of J.

    The finding's own model counts: without the harmonics, the data may select another one than with them.
    """
    curve = finding.curve
    if finding.inertia is None or not isinstance(curve, ModelCurve):
        return finding
    theta, mechanical = curve.fitted.likelier.theta, curve.fitted.problem.model.mechanical
    by_segment = {}      # reported lines of each part of the torque, 1 N·m
    for number, segment in segments.items():
        omega: FloatArray = np.asarray(2.0 * np.pi * np.array(case.fits[number].lines_hz), dtype=np.float64)
        s: ComplexArray = np.asarray(1j * omega, dtype=np.complex128)
        count = len(segment.angle_rad) // segment.periods
        period_s = case.stretches[number].segment.period_s
        time: FloatArray = np.asarray(period_s / count * np.arange(count), dtype=np.float64)
        waves = [wave(order * segment.angle_rad) for order in torque.orders for wave in (np.cos, np.sin)]
        own = np.array([_lines(time, wave.reshape(segment.periods, -1).mean(axis=0), 0.0, omega) for wave in waves])
        by_segment[number] = own * filters(theta[mechanical:], s)[1] * np.exp(-s * delay_s)
    lines = segment_means(case, curve, by_segment)
    if not lines:
        return finding
    rows = inertia_changes(curve, theta, lines).sum(axis=1)
    half = normal_quantile(case.options.confidence) * math.sqrt(max(float(rows @ torque.covariance @ rows), 0.0))
    return widened(finding, half, "harmonics of the angle", "their amplitudes and phases")


@dataclass(frozen=True)
class _SeenAngle:
    """Angle of the shaft as a function of time, on the grid of each segment, and at the excited lines."""

    angle: _Angle
    segments: dict[int, _GridSegment]
    lines: _AngleLines

    @classmethod
    def of(cls, case: PeriodicCase, stretches: tuple[Stretch, ...]) -> _SeenAngle | None:
        """Return the angle over the stretches of the case, or over a part of them; None if it is not known there."""
        whole = stretches is case.stretches
        spans = ALL_TIME if whole else tuple(_span(one) for one in stretches if one.index)
        angle = _Angle.of(case.recording, spans)
        if angle is None:
            return None
        segments = {number: found for number, stretch in enumerate(stretches)
                    if (found := _segment(stretch, case.samples, angle)) is not None}
        return cls(angle, segments, _AngleLines.of(case, stretches, angle)) if segments else None

    def view(self, model: _FittedShaft) -> _View:
        """Return the segments as a fitted model sees them."""
        return _View.of(tuple(self.segments.values()), model.curve, model.theta, model.delay_s)


Again = Callable[[Samples], tuple[PeriodicCase, Finding]]
"""Function that identifies the recording with other samples."""


def without_harmonics(case: PeriodicCase, finding: Finding, again: Again) -> tuple[PeriodicCase, Finding]:
    """Return the case and the finding without the torque that depends on the angle, and with its harmonics.

    Without a reported angle both are returned unchanged. If no order stands out, the finding only states this. Raises
    Refused if ``again`` does.
    """
    curve, raw = finding.curve, case.samples
    if not isinstance(curve, ModelCurve):
        return case, finding
    first = tuple(_first_periods(stretch) for stretch in case.stretches)
    long = any(one is not stretch for one, stretch in zip(first, case.stretches, strict=True))
    seen = _SeenAngle.of(case, first if long else case.stretches)
    if seen is not None and long:
        view = seen.view(_FittedShaft.of(seen.lines, curve))
        if _search(view) is None:
            return case, replace(finding, harmonics=(), least_harmonics=_least(view, None))
        seen = _SeenAngle.of(case, case.stretches)
    if seen is None:
        return case, finding
    torque: HarmonicTorque | None = None
    for _ in range(_ROUNDS):
        model = _FittedShaft.of(seen.lines, curve)
        torque = _fitted(seen, model)
        if torque is None:
            return case, replace(finding, harmonics=(), least_harmonics=_least(seen.view(model), None))
        clean = replace(raw, torque_nm=raw.torque_nm - _through_filter(raw, seen.angle, torque, model))
        case, finding = again(clean)
        if not isinstance(finding.curve, ModelCurve):
            break
        curve = finding.curve
    assert torque is not None
    finding = _widened(case, finding, seen.segments, torque, model.delay_s)
    return case, replace(finding, harmonics=torque.estimates(case.options.confidence),
                         least_harmonics=_least(seen.view(model), torque))
