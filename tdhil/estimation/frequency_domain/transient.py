"""Residual oscillation of a shaft during the counted periods, taken off their lines.

A string that an excitation sets swinging takes minutes to repeat itself: damped by little but the host's slow control,
the lines of its tenth period still differ from those of its first by more than all noise. Left in, this is a bias that
is the same in every line's mean, and a scatter that makes everything unsure.

But it is no noise. What is left of a linear system's beginning dies away in its own modes, x(t) = Re a e^(σt), with σ
shared by both signals and all segments, and a of each its own. A period that begins at t = pP has, in its line at
ω = 2π n/P,

    X = (2/P) ∫ x e^(−jωt) dt = (1/P) {a e^(σpP) (e^(σP) − 1)/(σ − jω) + the same of σ*, a*},

and its net change, which is taken off the lines of speed as a ramp (`spectrum`), takes j/ω (1/P) {a e^(σpP) (e^(σP) −
1) + …} off them, and B times that off those of torque. So all lines together tell the few a, also where a line lies so
near a mode that it alone could not be separated. Given σ, lines and a are linear (variable projection). Modes are
added one by one, as long as they gain more than Schwarz's ln n for each of their parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from tdhil.estimation.samples import Stretch
from tdhil.estimation.spectrum import ComplexArray, PeriodLines, SpectralLine, pooled_lines, torque_lines
from tdhil.recording import FloatArray

MOST_MODES = 3            # decaying modes, at most
_LEAST_PERIODS = 5        # periods that a transient needs
_OF_A_MODE = 4               # real numbers in a segment: the a of speed and that of torque
_PER_OCTAVE = 12          # frequencies tried per octave
_BEYOND = (0.3, 1.3)         # where modes are looked for, of the lowest and the highest line
_DECAYS = (0.05, 0.15, 0.4, 1.0, 2.0)   # decays tried, per period
_LEAST_DECAY = 0.02          # of ln x over a period: what dies away slower is drift, which ends of periods correct for
_STEPS = (0.2, 0.03)         # of the logarithm of a decay, of a frequency over the lowest line's: a descent's first
_ROUNDING = 1e-12         # least relative variance: below it is rounding


@dataclass(frozen=True)
class _ModeShare:
    """The modes' share of a segment: ``left`` of the signals, (2, P, K), and how the lines' means depend on it.

    ``mean`` (2, K): of the signals without it. ``uncertain`` (2, K): by how much the variance of a mean is larger for
    it, in variances of one period; ``fitted`` (2, K): complex degrees of freedom that it takes.
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
    begin_s: FloatArray      # of its periods, (P,)
    period_s: float
    omega: FloatArray        # (K,)
    viscous: float
    kept: dict[complex, ComplexArray] = field(default_factory=dict)      # columns by mode

    def without(self, modes: Sequence[complex]) -> ComplexArray:
        """Return the residual after modes and means, (2, P, K)."""
        return self._about_mean if not modes else self._fitted(modes)[0]

    @cached_property
    def _about_mean(self) -> ComplexArray:
        """The signals about their means over the periods, (2, P, K)."""
        return _centred(self.signals)

    def keep(self, modes: Sequence[complex]) -> None:
        """Compute the columns of these modes once: the search of the next one needs them with each of its trials."""
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
        """Return the residual, (2, P, K); amplitudes (M,), the inverse of their normal matrix, and their columns."""
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
        """(2, P, K, 4): the lines of a mode of speed with a = 1 and a = j, then of torque."""
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
    """About the mean over the periods."""
    about: ComplexArray = values - values.mean(axis=1, keepdims=True)
    return about


def settled_lines(
    fits: tuple[PeriodLines, ...], cut: tuple[Stretch, ...], viscous: float, warming_nm_s: tuple[float, ...] = ()
) -> tuple[SpectralLine, ...]:
    """Return `pooled_lines` without decaying oscillation; the same lines where there is none."""
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
    return tuple(_line(hertz, column, segments, swings, len(modes)) for column, hertz in enumerate(fits[0].lines_hz))


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
    """Those that are worth their parameters."""
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
    """−2 ln L with every line's variance concentrated out, but for a constant."""
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
    hertz: float, column: int, segments: Sequence[_ScaledSegment], swings: Sequence[_ModeShare], modes: int
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
    # σ is fitted as well: two real numbers a mode, shared by all lines and both signals.
    nu = max(1.0, nu - modes / (2.0 * len(segments[0].omega)))
    speed, torque = np.array(means).T
    covariance = scatter / nu
    return SpectralLine(
        hertz, speed, torque, np.array(counts), float(covariance[0, 0].real), float(covariance[1, 1].real),
        complex(covariance[1, 0]), nu,
    )
