"""Spectral lines of samples: speed and torque at each excited frequency, with their scatter.

Least squares on the actual time stamps of each period (tᶜ = time from the period's middle):

    x(t) = c + Σ_k (p_k cos ω_k t + q_k sin ω_k t),    X_k = p_k − j q_k,  so that x_k(t) = Re X_k e^(jω_k t).

Speed drifts from period to period: a load disturbance of white torque makes it wander. The integral of J dω/dt over a
period against e^(−jω_k t) is jω_k J W_k and an end term from the net change of speed Δ = ω(end) − ω(start). The ramp
(Δ/P) tᶜ is subtracted from the speed, and B (Δ/P) tᶜ from the torque. This removes the end term exactly, so that T_k −
G W_k is the line of the disturbance alone, independent from period to period. (A ramp fitted by least squares is not
suitable: it follows the wander within the period. Its errors are smaller in one period but alike in neighbouring ones,
which makes the scatter between periods too small, by up to a factor of two at the lowest line.)

Periods of one segment are equal except for disturbances. With x = (W, T) of period p, segment s,

    S_k = Σ_s Σ_p (x_sp − x̄_s)(x_sp − x̄_s)ᴴ / ν_k,   ν_k = Σ_s (P_s − 1),

is the covariance of one period (complex: E|·|² per period), the speed-torque cross term included. In closed loop, and
in torque mode, a disturbance is in both signals; the variance of T − G W is correct only with the cross term.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tdhil.estimation.samples import Samples, Stretch, thinned
from tdhil.recording import FloatArray

# ---------------------------------------------------------------------------------------------------------------------
# Speed at the two ends of a period, which gives its net change. `spectrum` explains why it is needed.


_EDGE_S = 0.1             # s; samples on either side of a period's end whose mean is the speed there
_EDGE_SAMPLES = 4         # fewest samples for the speed at one instant


class Edge:
    """Speed at an instant without the periodic motion: mean of the samples within 0.1 s, or of the nearest few."""

    def __init__(
        self, samples: Samples, start_s: float, lines_hz: tuple[float, ...], wave: NDArray[np.complex128]
    ) -> None:
        self.samples, self.start_s, self.wave = samples, start_s, wave
        self.omega = 2.0 * np.pi * np.asarray(lines_hz)

    def drift(self, begin_s: float, length_s: float) -> float:
        """Return the net change of speed per second over a period, rad/s²."""
        (begin, speed_begin), (end, speed_end) = self.speed(begin_s), self.speed(begin_s + length_s)
        return (speed_end - speed_begin) / (end - begin)

    def speed(self, at_s: float) -> tuple[float, float]:
        """Return the mean time of the samples used, s, and their mean speed, rad/s."""
        time = self.samples.time_s
        first, last = (int(i) for i in np.searchsorted(time, (at_s - _EDGE_S, at_s + _EDGE_S)))
        while last - first < min(_EDGE_SAMPLES, len(time)):
            first, last = max(first - 1, 0), min(last + 1, len(time))
        turned = np.exp(1j * np.outer(time[first:last] - self.start_s, self.omega))
        speed = float(np.mean(self.samples.speed_rad_s[first:last] - (turned @ self.wave).real))
        return float(np.mean(time[first:last])), speed


# ---------------------------------------------------------------------------------------------------------------------
# Rounding error that repeats with the motion. The scatter between periods does not contain it, and more periods do not
# average it out.
#
# A signal rounded to q has a mean square error of q²/12. With N samples with independent errors, the error of a line is
# 4 q²/(12 N) (complex: E|·|²). If the signal takes many samples for one step, these have one error together. It changes
# sign twice on a step, so N is at most twice the steps of a period, and the error has lines up to half of that.
#
# The share that repeats depends on where the samples lie on the wave: at the same instants in every period, in every
# second period, or elsewhere in each. It is measured at the harmonics h that are not excited. There, the lines of P
# periods have
#
#     E|mean|² = σ_h²/P + repeating part,      σ_h² their scatter,
#
# and the rounding error is equally large at all lines. Other repeating parts (harmonics of friction) are included in
# this bound. If noise of standard deviation σ is added before the rounding, the bound is the sawtooth of rounding
# smoothed by the noise, Σ_k e^(−4π²k²σ²/q²) q²/(2π²k²): a thousandth for σ = 0.4 q. This decides if the residuals are
# mostly noise.


_HARMONICS = np.arange(1.0, 9.0)
_SURE = 1.25            # times q²/12: largest part of the residuals' square that may be rounding
_LOOKED_AT = 40_000     # samples examined, in whole periods
_LOOKED_FOR = 32        # harmonics examined that are not excited
_FEWEST = 3             # fewest of these harmonics; with fewer there is no estimate
_UNDETECTED = 0.01      # share of the scatter of a segment's mean below which rounding is not examined further


def unit_waves(angle: FloatArray) -> NDArray[np.complex128]:
    """Return e^(jφ) of angles of any shape, rad, as `numpy.exp` gives it, in half its time."""
    waves: NDArray[np.complex128] = np.empty(angle.shape, dtype=np.complex128)
    np.cos(angle, out=waves.real)
    np.sin(angle, out=waves.imag)
    return waves


class PeriodInstants:
    """Instants of the first periods of a segment, and the unit waves there.

    Speed and torque are sampled at the same instants, so each wave is computed once for both.
    """

    def __init__(
        self, times: tuple[FloatArray, ...], period_s: float, start_s: float, lines_hz: tuple[float, ...]
    ) -> None:
        self.looked_at = slice(max(2, _LOOKED_AT // len(times[0])))
        self.period_s, self.lines_hz = period_s, lines_hz
        self._angles = [2.0 * np.pi * (time - start_s) for time in times[self.looked_at]]
        self._harmonics: FloatArray = np.zeros(0)
        self._at_harmonics: list[NDArray[np.complex128]] = []

    @cached_property
    def at_lines(self) -> list[NDArray[np.complex128]]:
        """Return e^(jω_k t) of each period, (N, K)."""
        return [unit_waves(np.multiply.outer(angle, self.lines_hz)) for angle in self._angles]

    def at_harmonics(self, harmonics: FloatArray) -> list[NDArray[np.complex128]]:
        """Return e^(−jω_h t) of each period, (H, N), for H harmonics of the period."""
        if not np.array_equal(harmonics, self._harmonics):
            self._harmonics = harmonics
            self._at_harmonics = [
                unit_waves(np.multiply.outer(-harmonics / self.period_s, angle)) for angle in self._angles
            ]
        return self._at_harmonics


def repeating_rounding(
    periods: tuple[FloatArray, ...], instants: PeriodInstants, wave: NDArray[np.complex128], scatter: float,
    quantum: float,
) -> float:
    """Return E|·|² of the error that rounding to ``quantum`` leaves in the mean of a line over ``periods``.

    ``wave`` (K,): the mean lines, with phase from the segment's start. ``scatter``: least variance of a line of one
    period.
    """
    if not quantum > 0.0:
        return 0.0
    count = min(len(periods[0]), 2.0 * float(np.sum(np.abs(np.diff(periods[0])))) / quantum)
    whole = 4.0 * quantum**2 / 12.0 / max(count, 1.0)
    if whole * len(periods) < _UNDETECTED * scatter:
        return 0.0
    rests = [
        signal - (turned @ wave).real
        for signal, turned in zip(periods[instants.looked_at], instants.at_lines, strict=True)
    ]
    rests = [rest - rest.mean() for rest in rests]
    noise = max(float(np.mean([np.var(rest) for rest in rests])) - _SURE * quantum**2 / 12.0, 0.0)
    smoothed = np.exp(-4.0 * np.pi**2 * _HARMONICS**2 * noise / quantum**2) / _HARMONICS**2
    most = whole * float(np.sum(smoothed) / np.sum(1.0 / _HARMONICS**2))
    first, last = round(instants.period_s * max(instants.lines_hz)) + 1.0, 0.5 * count
    if last < first + _FEWEST:
        return most
    harmonics = np.unique(np.round(np.geomspace(first, last, _LOOKED_FOR)))    # most of them are near the lines
    unexcited = np.array([2.0 * (turned @ rest) / len(rest)
                          for rest, turned in zip(rests, instants.at_harmonics(harmonics), strict=True)])
    again = np.abs(unexcited.mean(axis=0)) ** 2 - np.var(unexcited, axis=0, ddof=1) / len(unexcited)
    return min(max(float(np.mean(again)), 0.0), most)


# ---------------------------------------------------------------------------------------------------------------------

ComplexArray = NDArray[np.complex128]

SIGNIFICANT = 25.0       # |mean|² over its variance: a line less clear than 5 sd is not excited
BLOCK = 8192             # samples worked on at once
FLOOR = 1e-14            # relative variance below which scatter is rounding of the arithmetic
_BLOCKS_A_CYCLE = 20      # blocks per cycle of the fastest line, at least
_SAME = 4.0 * float(np.finfo(np.float64).eps)      # relative; closer frequencies count as equal


@dataclass(frozen=True)
class PeriodLines:
    """Lines of one stretch of P periods: ``speed``, ``torque``, ``ramp`` (P, K) complex, the rest (P,).

    ``drift`` is the net change of speed per second; it is subtracted from ``speed``, not yet from ``torque``. ``ramp``:
    the lines of tᶜ itself, s. ``rounding``: E|·|² of the rounding error in the mean lines of speed and torque.
    """

    lines_hz: tuple[float, ...]
    speed: ComplexArray
    torque: ComplexArray
    ramp: ComplexArray
    speed_mean: FloatArray
    torque_mean: FloatArray
    drift: FloatArray
    rounding: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class SpectralLine:
    """One spectral line: M segment means and the pooled covariance of a single period.

    ``speed``, ``torque`` (M,) complex; ``periods`` (M,) whole numbers; ``nu`` complex degrees of freedom.
    ``oscillation_steps``: distance to the nearest oscillation that outlasts a period P, in steps of 1/P.
    """

    hertz: float
    speed: ComplexArray
    torque: ComplexArray
    periods: FloatArray
    s_ww: float
    s_tt: float
    s_tw: complex             # E T W*
    nu: float
    oscillation_steps: float = np.inf

    @property
    def excited(self) -> bool:
        """True if both signals are clear of their scatter in every segment."""
        speed_clear = np.abs(self.speed) ** 2 * self.periods > SIGNIFICANT * self.s_ww
        torque_clear = np.abs(self.torque) ** 2 * self.periods > SIGNIFICANT * self.s_tt
        return bool(np.all(speed_clear & torque_clear))


def period_lines(stretch: Stretch, samples: Samples, quanta: tuple[float, float] = (0.0, 0.0)) -> PeriodLines:
    """Return the least-squares lines of every period of a stretch. ``samples``: all samples, for the speed at period
    ends.

    ``quanta``: resolution of speed and torque, rad/s and N·m.
    """
    segment = stretch.segment
    lines = segment.lines_hz
    count = len(lines)
    fits = [_fit(period, segment.start_s, lines) for period in stretch.periods]
    table: ComplexArray = np.array([fit[1] for fit in fits]).reshape(-1, 3, count)
    means = np.array([fit[0] for fit in fits]).reshape(-1, 3)
    wave = table[:, 0].mean(axis=0) if fits else np.zeros(count, dtype=np.complex128)
    # only within the segment: beyond its ends the motion differs
    edge = Edge(samples.between(segment.start_s - 1e-9, segment.end_s - 1e-9), segment.start_s, lines, wave)
    begins = [segment.start_s + number * segment.period_s for number in stretch.index]
    drift = np.array([edge.drift(begin, segment.period_s) for begin in begins])
    speed = table[:, 0] - drift[:, None] * table[:, 2]
    times = tuple(period.time_s for period in stretch.periods)
    instants = PeriodInstants(times, segment.period_s, segment.start_s, lines) if times else None
    rounding = [
        0.0 if instants is None or len(signals) < 2
        else repeating_rounding(signals, instants, seen.mean(axis=0), _least(seen), quantum)
        for signals, seen, quantum in (
            (tuple(period.speed_rad_s for period in stretch.periods), speed, quanta[0]),
            (tuple(period.torque_nm for period in stretch.periods), table[:, 1], quanta[1]),
        )
    ]
    return PeriodLines(
        lines_hz=lines,
        speed=speed,
        torque=table[:, 1],
        ramp=table[:, 2],
        speed_mean=means[:, 0] - drift * means[:, 2],
        torque_mean=means[:, 1],
        drift=drift,
        rounding=(rounding[0], rounding[1]),
    )


def unexcited_lines(stretch: Stretch, fit: PeriodLines, harmonics: tuple[int, ...]) -> PeriodLines:
    """Return lines at harmonics of the period that are not excited. ``fit``: lines of the excited ones.

    Means over short blocks replace the samples, so that a long recording takes little time. They reduce a line by less
    than 1 %, and do not mix lines.
    """
    segment = stretch.segment
    lines = tuple(harmonic / segment.period_s for harmonic in harmonics)
    excited = len(segment.lines_hz)
    every = (*segment.lines_hz, *lines)
    blocks = _BLOCKS_A_CYCLE * max(1, round(segment.period_s * max(every)))
    fits = [_fit(thinned(period, blocks), segment.start_s, every) for period in stretch.periods]
    table: ComplexArray = np.array([fit[1] for fit in fits]).reshape(-1, 3, len(every))[:, :, excited:]
    return PeriodLines(
        lines_hz=lines,
        speed=table[:, 0] - fit.drift[:, None] * table[:, 2],
        torque=table[:, 1],
        ramp=table[:, 2],
        speed_mean=fit.speed_mean,
        torque_mean=fit.torque_mean,
        drift=fit.drift,
        rounding=fit.rounding,
    )


def _least(lines: ComplexArray) -> float:
    """Return the smallest scatter of a line's periods (P, K)."""
    return float(np.min(np.sum(np.abs(lines - lines.mean(axis=0)) ** 2, axis=0))) / max(len(lines) - 1, 1)


def _fit(period: Samples, start_s: float, lines_hz: tuple[float, ...]) -> tuple[FloatArray, ComplexArray]:
    """Return the means (3,) and lines (3, K) of speed, torque and tᶜ in one period; phases count from ``start_s``."""
    count = len(lines_hz)
    time = period.time_s
    middle = 0.5 * (time[0] + time[-1])
    # normal equations are accurate and fast here, because the columns are nearly orthogonal; blocks keep the table of a
    # long period out of memory
    normal, right = np.zeros((1 + 2 * count, 1 + 2 * count)), np.zeros((1 + 2 * count, 3))
    for first in range(0, len(time), BLOCK):
        block = slice(first, first + BLOCK)
        turned = _turned(time[block] - start_s, lines_hz)
        design = np.empty((turned.shape[1], 1 + 2 * count))
        design[:, 0] = 1.0
        design[:, 1 : 1 + count], design[:, 1 + count :] = turned.real.T, turned.imag.T
        signals = np.column_stack([period.speed_rad_s[block], period.torque_nm[block], time[block] - middle])
        normal += design.T @ design
        right += design.T @ signals
    solution = np.linalg.solve(normal, right)
    lines: ComplexArray = (solution[1 : 1 + count] - 1j * solution[1 + count :]).T
    return solution[0], lines


def _turned(time_s: FloatArray, lines_hz: tuple[float, ...]) -> ComplexArray:
    """Return e^(jωt) of every line, (K, N). A line at the sum of two earlier ones is their product (ten times
    faster).
    """
    found: ComplexArray = np.empty((len(lines_hz), len(time_s)), dtype=np.complex128)
    for k, hertz in enumerate(lines_hz):
        pair = next(((a, b) for a in range(k) for b in range(a, k)
                     if abs(lines_hz[a] + lines_hz[b] - hertz) <= _SAME * hertz), None)
        if pair is not None:
            np.multiply(found[pair[0]], found[pair[1]], out=found[k])
        else:
            angle = (2.0 * np.pi * hertz) * time_s
            np.cos(angle, out=found[k].real)
            np.sin(angle, out=found[k].imag)
    return found


def pooled_lines(
    fits: tuple[PeriodLines, ...], viscous: float, warming_nm_s: tuple[float, ...] = ()
) -> tuple[SpectralLine, ...]:
    """Return the lines in order of frequency, pooled over the segments that have them; only lines with a known scatter.

    ``viscous``: B from the levels (0 if unknown), for the torque that a ramp of speed requires. ``warming_nm_s``: ramp
    of friction in each segment; 0 if left out.
    """
    rates = warming_nm_s or (0.0,) * len(fits)
    frequencies = sorted({round(hertz, 9) for fit in fits for hertz in fit.lines_hz})
    pooled = []
    for hertz in frequencies:
        speeds, torques, having = [], [], []
        for fit, rate in zip(fits, rates, strict=True):
            torque = torque_lines(fit, viscous, rate)
            for column, own in enumerate(fit.lines_hz):
                if round(own, 9) == hertz and len(fit.speed) > 0:
                    speeds.append(fit.speed[:, column])
                    torques.append(torque[:, column])
                    having.append(fit)
        line = _pool(hertz, speeds, torques, having)
        if line is not None:
            pooled.append(line)
    return tuple(pooled)


def mean_rounding(fits: Sequence[PeriodLines]) -> FloatArray:
    """Return E|·|² of the rounding of speed and torque, (2,), as for new in each period, mean of the segments."""
    found: FloatArray = np.mean([len(fit.speed) * np.asarray(fit.rounding) for fit in fits], axis=0)
    return found


def torque_lines(fit: PeriodLines, viscous: float, warming_nm_s: float) -> ComplexArray:
    """Return the torque lines (P, K) without the ramps due to the ramp of speed and to the warming of friction."""
    torque: ComplexArray = fit.torque - (viscous * fit.drift + warming_nm_s)[:, None] * fit.ramp
    return torque


def _pool(
    hertz: float, speeds: list[ComplexArray], torques: list[ComplexArray], having: list[PeriodLines]
) -> SpectralLine | None:
    """Return the pooled line; None without a known scatter. ``having``: the segments with this line."""
    nu = float(sum(len(speed) - 1 for speed in speeds))
    if nu < 1.0:
        return None
    s_ww = s_tt = 0.0
    s_tw = 0.0 + 0.0j
    for speed, torque in zip(speeds, torques, strict=True):
        dw, dt = speed - speed.mean(), torque - torque.mean()
        s_ww += float(np.sum(np.abs(dw) ** 2)) / nu
        s_tt += float(np.sum(np.abs(dt) ** 2)) / nu
        s_tw += complex(np.sum(dt * dw.conj())) / nu
    by_rounding = mean_rounding(having)
    s_ww += float(by_rounding[0])
    s_tt += float(by_rounding[1])
    mean_speed = np.array([speed.mean() for speed in speeds])
    mean_torque = np.array([torque.mean() for torque in torques])
    s_ww += FLOOR * float(np.max(np.abs(mean_speed) ** 2))
    s_tt += FLOOR * float(np.max(np.abs(mean_torque) ** 2))
    counts = np.array([float(len(speed)) for speed in speeds])
    return SpectralLine(hertz, mean_speed, mean_torque, counts, s_ww, s_tt, s_tw, nu)
