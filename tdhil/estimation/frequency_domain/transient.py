"""What a shaft that swings still does of its own while the periods are counted, taken off their lines.

A string that an excitation sets swinging takes minutes to repeat itself: damped by little but the host's slow control,
the lines of its tenth period still differ from those of its first by more than all noise. Left in, this is a bias that
is the same in every line's mean, and a scatter that makes everything unsure.

But it is no noise. What is left of a linear system's beginning dies away in its own modes, so that lines of one segment
go from period to period as

    X_p = X + Σ_n A_n z_n^p,      z_n = e^(s_n P), |z_n| < 1,

with z_n shared by all lines, both signals and all segments, and A_n of each alone. Given z_n, X and A_n are linear
(variable projection), and X's covariance is that of the residuals times c = [(VᴴV)⁻¹]₀₀, V = (1, z_n^p): the mean of
1/c periods. Modes are added one by one, as long as their parameters gain more than Schwarz's ln n each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tdhil.estimation.spectrum import ComplexArray, Line, PeriodLines, pooled_lines, torque_lines
from tdhil.recording import FloatArray

MOST_MODES = 2
_LEAST_LEFT = 3              # periods of a segment, beyond what is fitted to them
_SLOWEST = 0.9               # |z|: slower than this is drift, which ends of periods are corrected for
_RADII = (0.1, 0.25, 0.4, 0.55, 0.7, 0.85)
_TURNS = 16


@dataclass(frozen=True)
class _Segment:
    """Lines of P periods, speed beside torque, (P, 2K), each divided by its scatter; ``number`` (P,) of the periods."""

    values: ComplexArray
    number: FloatArray

    def basis(self, modes: Sequence[complex]) -> ComplexArray:
        """(P, 1 + modes)."""
        constant = np.ones_like(self.number, dtype=np.complex128)
        return np.stack([constant, *(mode**self.number for mode in modes)], axis=1)

    def left(self, modes: Sequence[complex]) -> ComplexArray:
        """(P, 2K): what the best of them leave."""
        v = self.basis(modes)
        q, _ = np.linalg.qr(v)
        rest: ComplexArray = self.values - q @ (q.conj().T @ self.values)
        return rest


def settled_lines(
    fits: tuple[PeriodLines, ...], viscous: float, warming_nm_s: tuple[float, ...] = ()
) -> tuple[Line, ...]:
    """As `pooled_lines`, without what dies away; those very lines where nothing does."""
    plain = pooled_lines(fits, viscous, warming_nm_s)
    rates = warming_nm_s or (0.0,) * len(fits)
    if not fits or len({fit.lines_hz for fit in fits}) != 1 or min(len(fit.speed) for fit in fits) < _LEAST_LEFT + 2:
        return plain
    torques = [torque_lines(fit, viscous, rate) for fit, rate in zip(fits, rates, strict=True)]
    segments = [_scaled(np.concatenate([fit.speed, torque], axis=1)) for fit, torque in zip(fits, torques, strict=True)]
    modes = _modes(segments)
    if not modes:
        return plain
    return tuple(
        _line(hertz, column, fits, torques, segments, modes) for column, hertz in enumerate(fits[0].lines_hz)
    )


def _scaled(values: ComplexArray) -> _Segment:
    late = values[len(values) // 2 :]
    scatter = np.sqrt(np.mean(np.abs(late - late.mean(axis=0)) ** 2, axis=0))
    floor = 1e-12 * float(np.max(np.abs(values)))
    return _Segment(values / np.maximum(scatter, floor), np.arange(len(values), dtype=np.float64))


def _modes(segments: Sequence[_Segment]) -> tuple[complex, ...]:
    """Those that are worth their parameters."""
    found: tuple[complex, ...] = ()
    now = _misfit(segments, found)
    numbers = 2.0 * sum(segment.values.size for segment in segments)
    columns = sum(segment.values.shape[1] for segment in segments)
    periods = min(len(segment.number) for segment in segments)
    while len(found) < MOST_MODES and periods - len(found) - 2 >= _LEAST_LEFT:
        more = _refined(segments, min(
            ((*found, mode) for mode in _grid()), key=lambda modes: _misfit(segments, modes)
        ))
        then = _misfit(segments, more)
        if now - then <= (2.0 * columns + 2.0) * np.log(numbers):
            break
        found, now = more, then
    return found


def _misfit(segments: Sequence[_Segment], modes: Sequence[complex]) -> float:
    """−2 ln L with every line's variance concentrated out, but for a constant."""
    total = 0.0
    for segment in segments:
        squares = np.mean(np.abs(segment.left(modes)) ** 2, axis=0)
        total += 2.0 * len(segment.number) * float(np.sum(np.log(np.maximum(squares, 1e-20))))
    return total


def _grid() -> list[complex]:
    return [complex(radius * np.exp(2j * np.pi * turn / _TURNS)) for radius in _RADII for turn in range(_TURNS)]


def _refined(segments: Sequence[_Segment], modes: tuple[complex, ...]) -> tuple[complex, ...]:
    from scipy.optimize import minimize

    def unpacked(x: FloatArray) -> tuple[complex, ...]:
        z = x[0::2] + 1j * x[1::2]
        size = np.abs(z)
        return tuple(complex(one) for one in z * np.minimum(1.0, _SLOWEST / np.maximum(size, 1e-9)))

    def misfit(x: FloatArray) -> float:
        return _misfit(segments, unpacked(x))

    start = np.array([part for mode in modes for part in (mode.real, mode.imag)])
    best = minimize(
        misfit, start, method="Nelder-Mead",
        options={"xatol": 1e-4, "fatol": 1e-3, "maxiter": 200 * len(start)},
    )
    return unpacked(np.asarray(best.x, dtype=np.float64))


def _line(
    hertz: float, column: int, fits: Sequence[PeriodLines], torques: Sequence[ComplexArray],
    segments: Sequence[_Segment], modes: tuple[complex, ...],
) -> Line:
    nu = s_ww = s_tt = 0.0
    s_tw = 0.0 + 0.0j
    speeds, means, counts = [], [], []
    for fit, torque, segment in zip(fits, torques, segments, strict=True):
        v = segment.basis(modes)
        inverse = np.linalg.inv(v.conj().T @ v)
        both = np.stack([fit.speed[:, column], torque[:, column]], axis=1)
        solved = inverse @ (v.conj().T @ both)
        left = both - v @ solved
        nu += len(v) - v.shape[1]
        s_ww += float(np.sum(np.abs(left[:, 0]) ** 2))
        s_tt += float(np.sum(np.abs(left[:, 1]) ** 2))
        s_tw += complex(np.sum(left[:, 1] * left[:, 0].conj()))
        speeds.append(solved[0, 0])
        means.append(solved[0, 1])
        counts.append(1.0 / float(inverse[0, 0].real))
    # z is fitted as well: two real numbers a mode, shared by all lines and both signals.
    nu = max(1.0, nu - len(modes) / (2.0 * len(fits[0].lines_hz)))
    return Line(hertz, np.array(speeds), np.array(means), np.array(counts), s_ww / nu, s_tt / nu, s_tw / nu, nu)
