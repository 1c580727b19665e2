"""Residual oscillation of a shaft during the counted periods, subtracted from their lines.

An excited string takes minutes to reach periodic motion. Damped by little more than the host's slow control, its lines
in the tenth period still differ from those in the first by more than all noise. Without correction this is a common
bias in the mean of every line, and a scatter that makes all values uncertain.

However, it is not noise. The transient of a linear system decays in its own modes, x(t) = Re a e^(σt), with σ common to
both signals and all segments, and a different a for each. A period that begins at t = pP has, in its line at ω = 2π
n/P,

    X = (2/P) ∫ x e^(−jωt) dt = (1/P) {a e^(σpP) (e^(σP) − 1)/(σ − jω) + the same of σ*, a*},

and its net change, which is subtracted from the lines of speed as a ramp (`spectrum`), reduces them by j/ω (1/P) {a
e^(σpP) (e^(σP) − 1) + …}, and those of torque by B times that. All lines together therefore determine the few a, also
if a line is too near a mode to be separated alone. For a given σ, lines and a are linear (variable projection). Modes
are added one by one while each gains more than Schwarz's ln n for each of its parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from tdhil.estimation.samples import Stretch
from tdhil.estimation.spectrum import (
    FLOOR,
    ComplexArray,
    PeriodLines,
    SpectralLine,
    mean_rounding,
    pooled_lines,
    torque_lines,
)
from tdhil.recording import FloatArray

MOST_MODES = 3            # decaying modes, at most
_LEAST_PERIODS = 5        # fewest periods for a transient
_OF_A_MODE = 4               # real numbers of a mode in a segment: the a of speed and that of torque
_PER_OCTAVE = 12          # frequencies tried per octave
_BEYOND = (0.3, 1.3)         # search range of the modes, as multiples of the lowest and the highest line
_DECAYS = (0.05, 0.15, 0.4, 1.0, 2.0)   # decays tried, per period
_LEAST_DECAY = 0.02          # of ln x over a period: a slower decay is drift, which the ends of the periods correct
_STEPS = (0.2, 0.03)         # first steps of a descent: of ln(decay), of frequency over the lowest line's
_ROUNDING = 1e-12         # least relative variance: below it is rounding
_OUTLASTS = 1.0           # decay of ln x per period, below which an oscillation outlasts it (decision 0099)


@dataclass(frozen=True)
class _ModeShare:
    """Contribution of the modes to a segment: ``left`` of the signals, (2, P, K), and its effect on the lines' means.

    ``mean`` (2, K): mean of the signals without the modes. ``uncertain`` (2, K): increase of the variance of a mean, in
    variances of one period. ``fitted`` (2, K): complex degrees of freedom used.
    """

    left: ComplexArray
    mean: ComplexArray
    uncertain: FloatArray
    fitted: FloatArray


@dataclass(frozen=True)
class _ScaledSegment:
    """Lines of P periods, speed and torque, (2, P, K), each divided by its scatter, (2, K)."""

    signals: ComplexArray
    scatter: FloatArray
    begin_s: FloatArray      # start of its periods, (P,)
    period_s: float
    omega: FloatArray        # (K,)
    viscous: float
    kept: dict[complex, ComplexArray] = field(default_factory=dict)      # columns by mode

    def without(self, modes: Sequence[complex]) -> ComplexArray:
        """Return the residual after modes and means, (2, P, K)."""
        return self._about_mean if not modes else self._fitted(modes)[0]

    @cached_property
    def _about_mean(self) -> ComplexArray:
        """Return the signals about their means over the periods, (2, P, K)."""
        return _centred(self.signals)

    def keep(self, modes: Sequence[complex]) -> None:
        """Compute the columns of these modes once: the search for the next mode needs them in each trial."""
        for mode in modes:
            if mode not in self.kept:
                self.kept[mode] = self._columns(mode)

    def swing(self, modes: Sequence[complex]) -> _ModeShare:
        """Return the contribution of the modes."""
        left, amplitudes, inverse, columns = self._fitted(modes)
        means, about = columns.mean(axis=1), _centred(columns)
        variance = np.maximum(np.mean(np.abs(left) ** 2, axis=1), _ROUNDING)
        parts = (about.real, about.imag)
        middle = np.sum([np.einsum("ipkm,ik,ipkn->mn", part, 0.5 * variance, part) for part in parts], axis=0)
        covariance = inverse @ middle @ inverse
        at_mean = (means.real, means.imag)
        uncertain = np.sum([np.einsum("ikm,mn,ikn->ik", part, covariance, part) for part in at_mean], axis=0)
        fitted = np.sum([np.einsum("ipkm,mn,ipkn->ik", part, 0.5 * inverse, part) for part in parts], axis=0)
        return _ModeShare(left, self.signals.mean(axis=1) - means @ amplitudes, uncertain / variance, fitted)

    def _fitted(self, modes: Sequence[complex]) -> tuple[ComplexArray, FloatArray, FloatArray, ComplexArray]:
        """Return the residual (2, P, K), amplitudes (M,), the inverse of their normal matrix, and their columns."""
        kept = self.kept
        columns = np.concatenate([kept[mode] if mode in kept else self._columns(mode) for mode in modes], axis=-1)
        about, signals = _centred(columns), self._about_mean
        size = about.shape[-1]
        table, wanted = about.reshape(-1, size), signals.ravel()
        normal = (table.conj().T @ table).real
        scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
        inverse = np.linalg.inv(normal * np.outer(scale, scale) + _ROUNDING * np.eye(size)) * np.outer(scale, scale)
        amplitudes: FloatArray = inverse @ (table.conj().T @ wanted).real
        return signals - about @ amplitudes, amplitudes, inverse, columns

    def _columns(self, mode: complex) -> ComplexArray:
        """Return (2, P, K, 4): the lines of a mode of speed with a = 1 and a = j, then of torque."""
        of_speed, of_torque, of_both = [], [], []
        for sigma in (mode, mode.conjugate()):
            change = np.exp(sigma * self.begin_s)[:, None] * (np.exp(sigma * self.period_s) - 1.0) / self.period_s
            own, ramp = change / (sigma - 1j * self.omega), change * 1j / self.omega
            of_speed.append(own - ramp)
            of_both.append(-self.viscous * ramp)
            of_torque.append(own)
        table: ComplexArray = np.zeros((2, *of_torque[0].shape, 4), dtype=np.complex128)
        for row, first, (one, other) in ((0, 0, of_speed), (1, 0, of_both), (1, 2, of_torque)):
            table[row, :, :, first], table[row, :, :, first + 1] = one + other, 1j * (one - other)
        table /= self.scatter[:, None, :, None]
        return table


def _centred(values: ComplexArray) -> ComplexArray:
    """Return the values about their mean over the periods."""
    about: ComplexArray = values - values.mean(axis=1, keepdims=True)
    return about


def settled_lines(
    fits: tuple[PeriodLines, ...], cut: tuple[Stretch, ...], viscous: float, warming_nm_s: tuple[float, ...] = ()
) -> tuple[SpectralLine, ...]:
    """Return `pooled_lines` without decaying oscillation; the same lines if there is none."""
    plain = pooled_lines(fits, viscous, warming_nm_s)
    rates = warming_nm_s or (0.0,) * len(fits)
    if not fits or len({fit.lines_hz for fit in fits}) != 1 or min(len(fit.speed) for fit in fits) < _LEAST_PERIODS:
        return plain
    segments = [
        _segment(fit, torque_lines(fit, viscous, rate), stretch, viscous)
        for fit, stretch, rate in zip(fits, cut, rates, strict=True)
    ]
    modes = _modes(segments)
    if not modes:
        return plain
    swings = [segment.swing(modes) for segment in segments]
    rounding = mean_rounding(fits)       # it repeats in each period, so that the scatter does not show it
    return tuple(
        _line(hertz, column, segments, swings, modes, rounding) for column, hertz in enumerate(fits[0].lines_hz))


def _segment(fit: PeriodLines, torque: ComplexArray, stretch: Stretch, viscous: float) -> _ScaledSegment:
    values = np.stack([fit.speed, torque])
    scatter = np.sqrt(np.mean(np.abs(_centred(values[:, values.shape[1] // 2 :])) ** 2, axis=1))
    scatter = np.maximum(scatter, _ROUNDING * np.max(np.abs(values), axis=(1, 2))[:, None])
    period_s = stretch.segment.period_s
    begin_s = period_s * (np.array(stretch.index, dtype=np.float64) - stretch.index[0])
    return _ScaledSegment(
        values / scatter[:, None, :], scatter, begin_s, period_s, 2.0 * np.pi * np.array(fit.lines_hz), viscous
    )


def _modes(segments: Sequence[_ScaledSegment]) -> tuple[complex, ...]:
    """Return the modes that gain more than their parameters cost."""
    found: tuple[complex, ...] = ()
    now = _misfit(segments, found)
    numbers = 2.0 * sum(segment.signals.size for segment in segments)
    price = (2.0 + _OF_A_MODE * len(segments)) * float(np.log(numbers))
    grid = _grid(segments[0])
    while len(found) < MOST_MODES:
        for segment in segments:
            segment.keep(found)
        more = _refined(segments, min(((*found, mode) for mode in grid), key=lambda modes: _misfit(segments, modes)))
        then = _misfit(segments, more)
        if now - then <= price:
            break
        found, now = more, then
    return found


def _misfit(segments: Sequence[_ScaledSegment], modes: Sequence[complex]) -> float:
    """Return −2 ln L with every line's variance concentrated out, up to a constant."""
    total = 0.0
    for segment in segments:
        left = segment.without(modes)
        squares = np.mean(np.abs(left) ** 2, axis=1)
        total += 2.0 * left.shape[1] * float(np.sum(np.log(np.maximum(squares, 1e-20))))
    return total


def _grid(segment: _ScaledSegment) -> list[complex]:
    low, high = _BEYOND[0] * segment.omega.min(), _BEYOND[1] * segment.omega.max()
    turns = np.geomspace(low, high, round(_PER_OCTAVE * np.log2(high / low)))
    return [complex(-decay / segment.period_s, turn) for turn in turns for decay in _DECAYS]


def _refined(segments: Sequence[_ScaledSegment], modes: tuple[complex, ...]) -> tuple[complex, ...]:
    from scipy.optimize import minimize

    period_s, omega = segments[0].period_s, float(segments[0].omega.min())

    def unpacked(x: FloatArray) -> tuple[complex, ...]:
        return tuple(
            complex(-(_LEAST_DECAY + np.exp(decay)) / period_s, turn * omega)
            for decay, turn in zip(x[0::2], x[1::2], strict=True)
        )

    def misfit(x: FloatArray) -> float:
        return _misfit(segments, unpacked(x))

    start = np.array([part for mode in modes for part in (
        float(np.log(max(-mode.real * period_s - _LEAST_DECAY, 1e-3))), mode.imag / omega
    )])
    simplex = np.vstack([start, start + np.diag(np.tile(_STEPS, len(modes)))])
    best = minimize(
        misfit, start, method="Nelder-Mead",
        options={"xatol": 1e-4, "fatol": 1e-3, "maxiter": 200 * len(start), "initial_simplex": simplex},
    )
    return unpacked(np.asarray(best.x, dtype=np.float64))


def _line(
    hertz: float, column: int, segments: Sequence[_ScaledSegment], swings: Sequence[_ModeShare],
    modes: Sequence[complex], rounding: FloatArray,
) -> SpectralLine:
    nu, means, counts = 0.0, [], []
    scatter = np.zeros((2, 2), dtype=np.complex128)
    for segment, swing in zip(segments, swings, strict=True):
        periods, size = len(segment.begin_s), segment.scatter[:, column]
        left = swing.left[:, :, column] * size[:, None]
        scatter += left @ left.conj().T
        means.append(swing.mean[:, column] * size)
        counts.append(1.0 / (1.0 / periods + float(np.max(swing.uncertain[:, column]))))
        nu += periods - 1.0 - float(np.max(swing.fitted[:, column]))
    # σ is fitted as well: two real numbers a mode, common to all lines and both signals.
    nu = max(1.0, nu - len(modes) / (2.0 * len(segments[0].omega)))
    speed, torque = np.array(means).T
    covariance = scatter / nu
    s_ww, s_tt = (float(covariance[k, k].real) + float(rounding[k]) + FLOOR * float(np.max(np.abs(means) ** 2))
                  for k, means in enumerate((speed, torque)))
    return SpectralLine(hertz, speed, torque, np.array(counts), s_ww, s_tt, complex(covariance[1, 0]), nu,
                        _oscillation_steps(hertz, modes, segments[0].period_s))


def _oscillation_steps(hertz: float, modes: Sequence[complex], period_s: float) -> float:
    """Return the distance to the nearest mode that outlasts a period, in steps of 1/P; inf without one.

    Noise drives such a mode too, and its amplitude continues into the next periods.
    """
    return min((abs(mode.imag / (2.0 * np.pi) - hertz) * period_s for mode in modes
                if -mode.real * period_s < _OUTLASTS), default=np.inf)
