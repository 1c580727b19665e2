r"""Severity of torsional oscillation from recorded torque and speed of the top drive. No motion is commanded for it.

**Torque of the string.** τ = T − J α at the top of the string. The friction of the top drive is nearly constant, and a
constant has no effect on the results. The lags τ_ω and τ_T of the reported values are corrected: each spectrum is
multiplied by 1 + jΩτ below the highest frequency that is used.

**Downhole speed.** A line with travel time T and impedance ζ carries a = τ + ζω down and b = ζω − τ up, unchanged. So

    ω(L, t) = ½ (ω(0, t−T) + ω(0, t+T)) + (τ(0, t−T) − τ(0, t+T))/(2ζ)
    τ(L, t) = ½ (τ(0, t−T) + τ(0, t+T)) + ζ (ω(0, t−T) − ω(0, t+T))/2

section by section down to the bit (d'Alembert; the mud's drag is lumped between parts). These equations hold for any
motion of both ends. They need a record of length T before and after the time t.

**Severity index.** Half of the peak-to-peak downhole speed, divided by the mean speed, in windows of one period of the
string's lowest mode. 0 is steady rotation, 1 and more is stick-slip. A window counts as *stick-slip* if the index
reaches `STICK_SLIP_INDEX` and the bit nearly stops.

**Reflection.** At the top, a = r b. If the motion of the top is excited by the string, r is the cross spectrum of a and
b divided by the spectrum of b, in the band of the oscillation. A soft-torque controller makes |r| small in this band.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import ceil, inf, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from profiles import MessageCode, TdhilError
from tdhil.soft_torque.controller import SpeedController, TopDrive, reflection_at
from tdhil.soft_torque.drill_string import DrillString
from tdhil.soft_torque.simulation import Array
from tdhil.soft_torque.tuned_figures import in_squares, string_modes_hz
from tdhil.soft_torque.uncertainty import Interval, StringFactors, student_factor

Flags = NDArray[np.bool_]

STEPS_PER_PERIOD = 80.0
"""Samples of the common grid in one period of the lowest mode."""
LEAST_SAMPLES_PER_PERIOD = 16.0
"""Least number of samples of the record in one period of the lowest mode. Fewer do not resolve the downhole speed."""
HARMONICS = 8.0
"""Highest frequency that is used, as a multiple of the lowest mode's. The jump of a bit that breaks away needs some
harmonics."""
GAP_PERIODS = 0.1
"""Longest gap within a gapless part of the record, in periods of the lowest mode."""
LEAST_PERIODS = 3.0
"""Least length of a gapless part that is used, in periods of the lowest mode."""
HELD_TIMES, LEAST_FROZEN, RESTS, SWING_PARTS = 5.0, 8, 3.0, 16
"""Least length of a frozen signal: times that of the usual values (90 of 100 last no longer), samples, and rests of a
rounded crest. Number of means in a period from which the motion beside it is found."""
PART_S = 0.3
"""Longest travel time, s, between two places of a line at which the mud's drag is lumped."""
TURNING_SHARE = 0.5
"""Least speed of the top in a window, divided by its mean speed there. Below it, the string is starting or
stopping."""
LEAST_SPEED_RAD_S = 0.5
"""Least mean speed of the main shaft, rad/s (5 rpm). Below it, the string does not count as turning."""
STICK_SLIP_INDEX, STOPPED_SHARE = 0.9, 0.2
"""Least severity index of stick-slip, and the share of the mean speed below which such a bit counts as nearly stopped.
Source: strings of 1,000 to 6,000 m, simulated with bit noise (benchmarks/severity_from_surface.py)."""
AT_RISK_INDEX = 0.5
"""Severity index from which a window counts as at risk of stick-slip."""
HYSTERESIS = 0.3
"""Distance from the mean that a cycle must pass on both sides, as a share of the amplitude."""
MOST_PERIOD_SCATTER = 0.3
"""Largest relative deviation of a cycle's length from the median. Cycles that deviate more are not counted."""
LEAST_CYCLES = 3
SEGMENT_PERIODS, LEAST_SEGMENTS, LEAST_COHERENCE = 4.0, 6, 0.5
"""Length of the segments of the spectra in periods, least number of segments, and least coherence of a and b."""
BAND_SHARE = 0.25
"""Half-width of the band of the oscillation, as a share of its frequency."""
TINY = 1e-30
"""Least divisor, N⁴·m⁴, for the spectra of a record without motion."""
REFLECTION_TOLERANCE = 0.1
"""Largest distance of the expected |r| from the measured interval. It accounts for lags that are not known exactly."""


NOT_IDENTIFIABLE = 9
"""Exit code: the record does not determine the requested quantity."""


class SeverityRefused(TdhilError):
    """Refusal: the record does not determine the torsional motion of the string. The message gives the reason."""

    entry = MessageCode.SEVERITY_REFUSED

    exit_code = NOT_IDENTIFIABLE


@dataclass(frozen=True)
class SurfaceRecord:
    """Reported torque and speed of the drive, referred to the main shaft; shape (N,), with increasing times."""

    time_s: Array
    speed_rad_s: Array
    torque_nm: Array
    speed_lag_s: float = 0.0
    """First-order time constant of the reported speed."""
    torque_lag_s: float = 0.0
    """First-order time constant of the reported torque."""
    scale_ends: tuple[float, float] = (1.0, 1.0)
    """Both ends of the interval of the torque scale, as factors. J has the same scale error."""


@dataclass(frozen=True)
class StickSlipEpisode:
    """Episode of stick-slip, in times of the record."""

    start_s: float
    end_s: float
    index: float
    """Largest severity index in the episode."""


@dataclass(frozen=True)
class ReflectionCheck:
    """Reflection |r| at the top in the band of the oscillation, measured and expected from the gains."""

    from_hz: float
    to_hz: float
    measured: Interval
    coherence: float
    expected: float | None

    @property
    def verdict(self) -> str:
        """Return ``as expected``, ``reflects more``, ``reflects less``, or ``not compared``."""
        if self.expected is None:
            return "not compared"
        if self.measured.low > self.expected + REFLECTION_TOLERANCE:
            return "reflects more"
        if self.measured.high < self.expected - REFLECTION_TOLERANCE:
            return "reflects less"
        return "as expected"


@dataclass(frozen=True)
class SeverityCourse:
    """Signals over time for plots, shape (M,) each; NaN where a value is unknown."""

    time_s: Array
    top_rad_s: Array
    torque_nm: Array
    """Torque of the string at its top."""
    bit_rad_s: Array
    index: Array


@dataclass(frozen=True)
class Severity:
    """Result for one record; speeds and torques at the main shaft."""

    turning_s: float
    """Total time in which the string turns and its downhole speed is known."""
    mean_rad_s: float
    index: Interval
    """Median severity index of all windows, or of the windows in stick-slip if there are any. The interval is over J,
    the torque scale and the string's tolerances."""
    index_worst: float
    """Severity index that 5 % of the windows exceed."""
    stick_slip_share: float
    """Share of the turning time in stick-slip."""
    at_risk_share: float
    """Share of the turning time with a severity index of `AT_RISK_INDEX` or more."""
    episodes: tuple[StickSlipEpisode, ...]
    period_s: Interval | None
    """Period of the oscillation. None: there is no regular oscillation."""
    cycles: int
    downhole_rad_s: Interval
    """Half of the peak-to-peak downhole speed, median of the same windows as ``index``."""
    torque_nm: Interval
    """Half of the peak-to-peak string torque, median of the same windows as ``index``; over J and the torque scale."""
    window_s: float
    """Length of a window: one period of the string's lowest mode."""
    reflection: ReflectionCheck | None
    reflection_refused: str
    course: SeverityCourse
    left_out: tuple[str, ...] = ()
    """Sentences on the time in which a signal was frozen. It was left out."""

    @property
    def level(self) -> str:
        """Return ``stick-slip``, ``at risk`` or ``smooth``."""
        if self.episodes:
            return "stick-slip"
        return "at risk" if self.at_risk_share > 0.05 else "smooth"


@dataclass(frozen=True)
class _GaplessPart:
    """Part of the record without gaps on the common grid: speed, its derivative and torque, corrected for lags."""

    time_s: Array
    speed: Array
    slope: Array
    torque: Array


@dataclass(frozen=True)
class _Windows:
    """Figures of the window around each sample. ``used``: the string turns, and its downhole speed is known."""

    bit: Array
    swing: Array
    torque_swing: Array
    index: Array
    stuck: Flags
    used: Flags


def severity(
    record: SurfaceRecord, string: DrillString, inertia: Interval,
    expected: tuple[TopDrive, SpeedController] | None = None,
) -> Severity:
    """Return the severity of the torsional oscillation. Raises SeverityRefused if the record is not sufficient.

    ``expected``: top drive and controller that should be active, for the check of the reflection.
    """
    period = 1.0 / string_modes_hz(string)[0]
    record, left_out = _measured(record, period)
    stretches = _stretches(record, period)
    speed, pulls = (np.concatenate([getattr(one, name) for one in stretches]) for name in ("speed", "torque"))
    mean, pull = float(speed.mean()), float(pulls.mean())
    if mean * pull < 0.0 and abs(mean) > LEAST_SPEED_RAD_S:
        raise SeverityRefused(
            f"the mean torque is {pull:.4g} N·m and the mean speed {mean:.4g} rad/s: the top drive would brake",
            next_step="One of them has the wrong sign. Correct it in a copy of the record")
    step = float(stretches[0].time_s[1] - stretches[0].time_s[0])
    found = [_windows(one, string, inertia.value, period, step) for one in stretches]
    used = np.concatenate([one.used for one in found])
    if not used.any():
        raise SeverityRefused("the string does not turn steadily anywhere in this record",
                              next_step="Name a record of rotation at a steady set speed")
    stuck = np.concatenate([one.stuck for one in found])
    index = np.concatenate([one.index for one in found])
    chosen = stuck if stuck.any() else used

    def medians(cases: Sequence[_Windows]) -> list[float]:
        return [float(np.nanmedian(np.concatenate([getattr(one, name) for one in cases])[chosen]))
                for name in ("index", "swing", "torque_swing")]

    value = medians(found)
    by_inertia = [medians([_windows(one, string, end, period, step) for one in stretches])
                  for end in (inertia.low, inertia.high)]
    by_string = [[medians([_windows(one, end, inertia.value, period, step) for one in stretches]) for end in pair]
                 for pair in string_ends(string)]
    by_scale = [[medians([_windows(replace(one, torque=end * one.torque), string, end * inertia.value, period, step)
                          for one in stretches]) for end in record.scale_ends]]
    index_of, swing, torque = (
        in_squares(Interval(value[at], min(value[at], *(one[at] for one in by_inertia)),
                            max(value[at], *(one[at] for one in by_inertia))),
                   [[one[at] for one in pair] for pair in (by_scale + by_string if at < 2 else by_scale)])
        for at in range(3))
    times = np.concatenate([one.time_s for one in stretches])
    cycles = np.concatenate([_cycles(one, windows, bool(stuck.any()), period)
                             for one, windows in zip(stretches, found, strict=True)])
    period_found = _period(cycles)
    # without a regular oscillation, the band is that of the string's lowest mode
    band_s = period if period_found is None else period_found.value
    check, refused = _reflection(stretches, string, inertia, band_s, step, expected)
    return Severity(
        turning_s=float(np.count_nonzero(used)) * step, mean_rad_s=float(np.mean(speed[used])), index=index_of,
        index_worst=float(np.quantile(index[used], 0.95)), stick_slip_share=float(np.mean(stuck[used])),
        at_risk_share=float(np.mean(index[used] >= AT_RISK_INDEX)), episodes=_episodes(times, index, stuck, step),
        period_s=period_found, cycles=len(cycles), downhole_rad_s=swing, torque_nm=torque, window_s=period,
        reflection=check, reflection_refused=refused,
        course=_course(stretches, found, inertia.value), left_out=left_out)


def turning_spans(
    record: SurfaceRecord, string: DrillString, inertia_kg_m2: float
) -> tuple[tuple[float, float, float], ...]:
    """Return (begin, end, largest severity index) of the spans of rotation, s in the record's time.

    A span ends where the string stops turning, and where stick-slip begins or ends. Raises SeverityRefused.
    """
    period = 1.0 / string_modes_hz(string)[0]
    spans = []
    for stretch in _stretches(_measured(record, period)[0], period):
        step = float(stretch.time_s[1] - stretch.time_s[0])
        found = _windows(stretch, string, inertia_kg_m2, period, step)
        high = found.used & (np.nan_to_num(found.index) >= STICK_SLIP_INDEX)
        state = np.where(found.used, np.where(high, 2, 1), 0)
        edges = np.flatnonzero(np.diff(np.concatenate([[-1], state, [-1]])))
        spans += [(float(stretch.time_s[a]), float(stretch.time_s[b - 1]), float(np.nanmax(found.index[a:b])))
                  for a, b in pairwise(edges.tolist()) if state[a] > 0]
    return tuple(spans)


# ---------------------------------------------------------------------------------------------------------------------
# The record without frozen signals, on one grid.


def _measured(record: SurfaceRecord, period_s: float) -> tuple[SurfaceRecord, tuple[str, ...]]:
    """Return the record without the time in which a signal is frozen, and a sentence for each such signal."""
    good, said, time = np.ones(len(record.time_s), dtype=np.bool_), [], record.time_s
    for name, signal in (("torque", record.torque_nm), ("speed", record.speed_rad_s)):
        runs = _frozen(time, signal, period_s) if len(time) else []
        for first, last in runs:
            good[first + 1:last] = False
        if runs:
            said.append(f"The reported {name} did not change for {sum(time[b - 1] - time[a] for a, b in runs):.3g} s, "
                        f"first at {time[runs[0][0]]:.6g} s. This time was left out.")
    return replace(record, time_s=time[good], speed_rad_s=record.speed_rad_s[good],
                   torque_nm=record.torque_nm[good]), tuple(said)


def _frozen(time: Array, signal: Array, period_s: float) -> list[tuple[int, int]]:
    """Return the runs [first, last) of equal values that last too long for a signal that is held or rounded.

    Such a run is longer than a gap that is bridged, than the usual values by `HELD_TIMES`, and than `RESTS` times the
    rest of an oscillation of amplitude A, rounded to q, about its crest: √(2q/A)/π periods. A is the least of both
    sides, each the median of three periods beside the run. Below 2 q, a signal may rest for any time.
    """
    values = np.unique(signal)
    steps = np.diff(values)[np.diff(values) > 1e-9 * np.abs(values[1:])]
    edges = np.concatenate([[0], np.flatnonzero(np.diff(signal)) + 1, [len(signal)]])
    area = np.concatenate([[0.0], np.cumsum(0.5 * (signal[1:] + signal[:-1]) * np.diff(time))])
    lasting = time[edges[1:] - 1] - time[edges[:-1]]
    least_s = max(GAP_PERIODS * period_s, HELD_TIMES * float(np.quantile(lasting, 0.9)))
    found, quantum = [], float(steps.min(initial=inf))
    for at in np.flatnonzero((lasting > least_s) & (np.diff(edges) >= LEAST_FROZEN)):
        first, last = int(edges[at]), int(edges[at + 1])
        swings = _swing(time, area, time[first], -period_s), _swing(time, area, time[last - 1], period_s)
        amplitude = min((one for one in swings if one is not None), default=0.0)
        if amplitude > 2.0 * quantum and lasting[at] > RESTS * sqrt(2.0 * quantum / amplitude) / pi * period_s:
            found.append((first, last))
    return found


def _swing(time: Array, area: Array, begin_s: float, length_s: float) -> float | None:
    """Return the amplitude to and fro, 0 for a ramp, as the median of up to three spans; ``area``: ∫ signal dt."""
    at = begin_s + length_s * np.arange(3 * SWING_PARTS + 1) / SWING_PARTS
    means = (np.diff(np.interp(at, time, area)) / (length_s / SWING_PARTS)).reshape(3, SWING_PARTS)
    swings = 0.25 * (np.abs(np.diff(means)).sum(axis=1) - np.abs(means[:, -1] - means[:, 0]))
    inside = (at[SWING_PARTS::SWING_PARTS] >= time[0]) & (at[SWING_PARTS::SWING_PARTS] <= time[-1])
    return float(np.median(swings[inside])) if inside.any() else None


def _stretches(record: SurfaceRecord, period_s: float) -> list[_GaplessPart]:
    time = record.time_s
    if len(time) < LEAST_PERIODS * LEAST_SAMPLES_PER_PERIOD:
        raise SeverityRefused(f"the record has {len(time)} samples, which is less than {LEAST_PERIODS:g} periods of"
                              " the string", next_step="Name a longer record")
    usual = float(np.median(np.diff(time)))
    if usual > period_s / LEAST_SAMPLES_PER_PERIOD:
        raise SeverityRefused(
            f"the record has a sample every {usual:.3g} s. The string's lowest mode has a period of {period_s:.3g} s,"
            f" and needs {LEAST_SAMPLES_PER_PERIOD:.0f} samples in it",
            next_step=f"Record at {LEAST_SAMPLES_PER_PERIOD / period_s:.2g} Hz or faster")
    step = max(usual, period_s / STEPS_PER_PERIOD)
    ends = np.flatnonzero(np.diff(time) > max(GAP_PERIODS * period_s, 3.0 * usual)) + 1
    found = []
    for part in np.split(np.arange(len(time)), ends):
        if time[part[-1]] - time[part[0]] < LEAST_PERIODS * period_s:
            continue
        own = time[part]
        grid = np.arange(own[0], own[-1], step)
        speed, torque = (_on_grid(own, signal[part], grid, step, usual)
                         for signal in (record.speed_rad_s, record.torque_nm))
        highest = min(HARMONICS / period_s, 0.4 / step)
        clean, slope = _without_lag(speed, step, record.speed_lag_s, highest, round(2.0 * period_s / step))
        pull, _ = _without_lag(torque, step, record.torque_lag_s, highest, round(2.0 * period_s / step))
        found.append(_GaplessPart(grid, clean, slope, pull))
    if not found:
        raise SeverityRefused(f"no part of the record is free of gaps for {LEAST_PERIODS:g} periods of the string, "
                              f"{LEAST_PERIODS * period_s:.0f} s", next_step="Name a longer record")
    return found


def _on_grid(time: Array, signal: Array, grid: Array, step: float, usual: float) -> Array:
    """Return the signal on the grid: means over each step if the record is faster than the grid, else interpolated."""
    if usual > 0.6 * step:
        return np.asarray(np.interp(grid, time, signal))
    cells = np.rint((time - grid[0]) / step).astype(np.int64)
    inside = (cells >= 0) & (cells < len(grid))
    count = np.bincount(cells[inside], minlength=len(grid))
    total = np.bincount(cells[inside], weights=signal[inside], minlength=len(grid))
    known = count > 0
    return np.asarray(np.interp(grid, grid[known], total[known] / count[known]))


def _without_lag(signal: Array, step: float, lag_s: float, highest_hz: float, pad: int) -> tuple[Array, Array]:
    """Return the signal corrected for a first-order lag, and its derivative, both below ``highest_hz``."""
    from scipy.fft import irfft, next_fast_len, rfft

    pad = min(pad, len(signal) - 1)
    # point reflection at both ends, so that value and slope are continuous there
    whole = np.concatenate([2.0 * signal[0] - signal[pad:0:-1], signal, 2.0 * signal[-1] - signal[-2:-pad - 2:-1]])
    rise = np.linspace(whole[0], whole[-1], len(whole))
    size = next_fast_len(len(whole), real=True)
    spectrum = rfft(whole - rise, size)
    hertz = np.fft.rfftfreq(size, step)
    keep = 0.5 + 0.5 * np.cos(pi * np.clip(2.0 * hertz / highest_hz - 2.0, 0.0, 1.0))
    along = 2j * pi * hertz
    spectrum = spectrum * keep * (1.0 + along * lag_s)
    slope_of_rise = (whole[-1] - whole[0]) / ((len(whole) - 1) * step)
    cut = slice(pad, pad + len(signal))
    value = (irfft(spectrum, size)[:len(whole)] + rise)[cut] + lag_s * slope_of_rise
    slope = irfft(spectrum * along, size)[:len(whole)][cut] + slope_of_rise
    return np.asarray(value), np.asarray(slope)


# ---------------------------------------------------------------------------------------------------------------------
# Downhole speed.


def downhole_speed(speed: Array, torque: Array, step_s: float, string: DrillString) -> Array:
    """Return the speed at the bit on the same grid, from speed and string torque at the top; NaN at both ends."""
    count = len(speed)
    at = np.arange(count, dtype=float)
    for line in string.lines:
        parts = max(1, ceil(line.delay_s / PART_S))
        zeta, shift = line.impedance_nm_s_rad, line.delay_s / parts / step_s
        drag = line.drag_nm_s_rad_m * line.length_m / parts
        for _ in range(parts):
            torque = torque - 0.5 * drag * speed
            early = [np.interp(at - shift, at, one, left=np.nan) for one in (speed, torque)]
            late = [np.interp(at + shift, at, one, right=np.nan) for one in (speed, torque)]
            speed = 0.5 * (early[0] + late[0]) + (early[1] - late[1]) / (2.0 * zeta)
            torque = 0.5 * (early[1] + late[1]) + 0.5 * zeta * (early[0] - late[0]) - 0.5 * drag * speed
    return speed


def _windows(stretch: _GaplessPart, string: DrillString, inertia: float, period_s: float, step: float) -> _Windows:
    from scipy.ndimage import maximum_filter1d, minimum_filter1d, uniform_filter1d

    torque = stretch.torque - inertia * stretch.slope
    bit = downhole_speed(stretch.speed, torque, step, string)
    size = max(3, round(period_s / step))
    known = np.isfinite(bit)
    high, low = maximum_filter1d(np.where(known, bit, -inf), size), minimum_filter1d(np.where(known, bit, inf), size)
    mean = uniform_filter1d(stretch.speed, size)
    slowest = minimum_filter1d(stretch.speed, size)
    whole = uniform_filter1d(known.astype(float), size) > 0.999
    used = whole & (mean > LEAST_SPEED_RAD_S) & (slowest > TURNING_SHARE * mean)
    swing = np.where(used, 0.5 * (high - low), np.nan)
    index = np.where(used, swing / np.where(used, mean, 1.0), np.nan)
    stuck = used & (np.nan_to_num(index) >= STICK_SLIP_INDEX) & (low <= STOPPED_SHARE * mean)
    torque_swing = 0.5 * (maximum_filter1d(torque, size) - minimum_filter1d(torque, size))
    return _Windows(bit, swing, torque_swing, index, stuck, used)


def string_ends(string: DrillString) -> list[tuple[DrillString, DrillString]]:
    """Return the string at both ends of each tolerance on which the downhole speed depends."""
    tolerance = string.tolerance
    factors = (
        [StringFactors(length=1.0 + sign * tolerance.length) for sign in (-1.0, 1.0)],
        [StringFactors(shear=one) for one in tolerance.shear],
        [StringFactors(wear=one) for one in tolerance.polar],
        [StringFactors(outer=1.0 + sign * tolerance.outer_diameter) for sign in (-1.0, 1.0)],
        [StringFactors(inner=1.0 + sign * tolerance.inner_diameter) for sign in (-1.0, 1.0)],
    )
    pairs = [(low.applied_to(string), high.applied_to(string)) for low, high in factors]
    return [pair for pair in pairs if pair[0] != pair[1]]


# ---------------------------------------------------------------------------------------------------------------------
# Cycles and episodes.


def _cycles(stretch: _GaplessPart, windows: _Windows, in_stick_slip: bool, period_s: float) -> Array:
    """Return the lengths, s, of the cycles of the downhole speed, from one rising crossing of the mean to the next."""
    from scipy.ndimage import uniform_filter1d

    step = float(stretch.time_s[1] - stretch.time_s[0])
    where = windows.stuck if in_stick_slip else windows.used
    size = round(3.0 * period_s / step)
    known, bit = np.isfinite(windows.bit), windows.bit
    filled = np.where(known, bit, bit[known].mean() if known.any() else 0.0)
    off = filled - uniform_filter1d(filled, size)
    band = HYSTERESIS * np.nan_to_num(windows.swing, nan=inf)
    side = np.where(off > band, 1, np.where(off < -band, -1, 0))
    clear = np.flatnonzero(side)
    turns = [(int(a), int(b)) for a, b in pairwise(clear) if side[a] < 0 < side[b]]
    rises = []
    for a, b in turns:
        at = a + int(np.flatnonzero(off[a:b + 1] <= 0.0)[-1])
        before, after = off[at], off[min(at + 1, len(off) - 1)]
        rises.append((at + (before / (before - after) if before != after else 0.0), where[at]))
    lengths = [(late - early) * step for (early, one), (late, other) in pairwise(rises)
               if one and other and bool(where[round(0.5 * (early + late))])]
    return np.array(lengths)


def _period(cycles: Array) -> Interval | None:
    """Return the mean length of the cycles with its 95 % interval, or None if the cycles are not one oscillation."""
    if len(cycles) < LEAST_CYCLES:
        return None
    middle = float(np.median(cycles))
    alike = cycles[np.abs(cycles - middle) < MOST_PERIOD_SCATTER * middle]
    if len(alike) < max(LEAST_CYCLES, 0.6 * len(cycles)):
        return None
    mean = float(alike.mean())
    half = student_factor(len(alike) - 1) * float(alike.std(ddof=1)) / sqrt(len(alike))
    return Interval(mean, mean - half, mean + half)


def _episodes(time_s: Array, index: Array, stuck: Flags, step: float) -> tuple[StickSlipEpisode, ...]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], stuck, [False]]).astype(np.int8)))
    jumps = set((np.flatnonzero(np.diff(time_s) > 1.5 * step) + 1).tolist())
    found: list[StickSlipEpisode] = []
    for first, last in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        cuts = [first, *sorted(cut for cut in jumps if first < cut < last), last]
        found += [StickSlipEpisode(float(time_s[a]), float(time_s[b - 1]), float(np.nanmax(index[a:b])))
                  for a, b in pairwise(cuts)]
    return tuple(found)


# ---------------------------------------------------------------------------------------------------------------------
# Reflection at the top.


def _reflection(
    stretches: Sequence[_GaplessPart], string: DrillString, inertia: Interval, period_s: float, step: float,
    expected: tuple[TopDrive, SpeedController] | None,
) -> tuple[ReflectionCheck | None, str]:
    hertz = 1.0 / period_s
    values, coherence = [], 0.0
    for end in (inertia.value, inertia.low, inertia.high):
        spectra = np.concatenate([_segments(one, string.impedance_nm_s_rad, end, hertz, step) for one in stretches])
        if len(spectra) < LEAST_SEGMENTS:
            return None, (f"the record is shorter than {LEAST_SEGMENTS} segments of {SEGMENT_PERIODS:g} periods, "
                          f"{0.5 * (LEAST_SEGMENTS + 1) * SEGMENT_PERIODS * period_s:.0f} s")
        cross, down, up = spectra.sum(axis=0)
        coherence = float(abs(cross) ** 2 / max(down.real * up.real, TINY))
        if coherence < LEAST_COHERENCE:
            return None, (f"the waves up and down have a coherence of {coherence:.2f} at {hertz:.3g} Hz, below "
                          f"{LEAST_COHERENCE:g}: something other than the string moves the top")
        whole = abs(cross) / up.real
        # jackknife over the segments; half of them overlap
        rest = spectra.sum(axis=0)[None] - spectra
        each = np.abs(rest[:, 0]) / rest[:, 2].real
        count = len(each)
        half = 1.96 * sqrt(2.0) * sqrt((count - 1) / count * float(np.sum((each - each.mean()) ** 2)))
        values.append((float(whole), half))
    value, half = values[0]
    low = value - sqrt(half**2 + max(0.0, *(value - other for other, _ in values[1:])) ** 2)
    high = value + sqrt(half**2 + max(0.0, *(other - value for other, _ in values[1:])) ** 2)
    wanted = None
    if expected is not None:
        wanted = float(reflection_at(*expected, string, np.array([hertz]))[0])
    return ReflectionCheck((1.0 - BAND_SHARE) * hertz, (1.0 + BAND_SHARE) * hertz,
                           Interval(value, max(0.0, low), high), coherence, wanted), ""


def _segments(stretch: _GaplessPart, zeta: float, inertia: float, hertz: float, step: float) -> NDArray[np.complex128]:
    """Return (segments, 3), summed over the band: cross spectrum of the waves down and up, and both spectra."""
    size = round(SEGMENT_PERIODS / hertz / step)
    if len(stretch.speed) < size:
        return np.empty((0, 3), dtype=np.complex128)
    torque = stretch.torque - inertia * stretch.slope
    starts = range(0, len(torque) - size + 1, max(1, size // 2))
    window = np.hanning(size)
    frequencies = np.fft.rfftfreq(size, step)
    band = np.abs(frequencies - hertz) <= BAND_SHARE * hertz
    found = []
    for start in starts:
        speed, pull = stretch.speed[start:start + size], torque[start:start + size]
        if speed.min() < TURNING_SHARE * speed.mean():
            continue
        ramp = np.linspace(-1.0, 1.0, size)
        speed, pull = (one - one.mean() - ramp * (one @ ramp) / (ramp @ ramp) for one in (speed, pull))
        down, up = (np.fft.rfft(window * one)[band] for one in (pull + zeta * speed, zeta * speed - pull))
        found.append([np.sum(down * up.conj()), np.sum(np.abs(down) ** 2), np.sum(np.abs(up) ** 2)])
    return np.array(found, dtype=np.complex128).reshape(-1, 3)


def _course(stretches: Sequence[_GaplessPart], found: Sequence[_Windows], inertia: float) -> SeverityCourse:
    """Return the signals of all gapless parts, joined with a NaN between two parts."""
    def joined(rows: Sequence[Array]) -> Array:
        return np.concatenate([part for row in rows for part in (row, np.full(1, np.nan))])[:-1]

    return SeverityCourse(joined([one.time_s for one in stretches]), joined([one.speed for one in stretches]),
                  joined([one.torque - inertia * one.slope for one in stretches]),
                  joined([one.bit for one in found]), joined([one.index for one in found]))
