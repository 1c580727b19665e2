"""Shapes of periodic motions before scaling: lines with relative amplitudes and phases, and their common peaks."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tdhil.runner.excitation.reference import ExcitationKind
from tdhil.runner.excitation.speed_loop import SpeedFollowing

_GRID = 1024              # points of a period on which a peak is searched


@dataclass(frozen=True)
class Shape:
    """Deviation of speed from its mean, per unit: sum of amplitude·cos(2π harmonic t / period + phase).

    It is scaled to a largest deviation of 1. ``harmonics``: number of cycles per period.
    """

    harmonics: tuple[int, ...]
    amplitudes: tuple[float, ...]
    phases_rad: tuple[float, ...]

    def deviation(self, phase_rad: float = 0.0) -> NDArray[np.float64]:
        """Return the deviation over one period, (1024,), with ``phase_rad`` added to the phase of every line."""
        return self._wave(np.asarray(self.amplitudes, dtype=np.complex128), phase_rad)

    def foreseen_deviation(self, period_s: float, foresight_s: float) -> NDArray[np.float64]:
        """Return deviation + foresight·its rate over a period, (1024,): Re Σ (1 + jω_k t_f) a_k e^(j(ω_k t + φ_k))."""
        omega = 2.0 * np.pi * np.asarray(self.harmonics, dtype=np.float64) / period_s
        return self._wave((1.0 + 1j * omega * foresight_s) * np.asarray(self.amplitudes), 0.0)

    def torque_deviation(self, period_s: float, inertia_kg_m2: float, viscous_nm_s_rad: float) -> NDArray[np.float64]:
        """Return torque over a period, (1024,), N·m per rad/s of peak: Re Σ (J jω_k + B) a_k e^(j(ω_k t + φ_k))."""
        omega = 2.0 * np.pi * np.asarray(self.harmonics, dtype=np.float64) / period_s
        return self._wave((viscous_nm_s_rad + 1j * omega * inertia_kg_m2) * np.asarray(self.amplitudes), 0.0)

    def followed(self, period_s: float, following: SpeedFollowing) -> "Shape":
        """Return the motion of the shaft under the drive's speed control if this shape is the setpoint."""
        gains = following.shaft(np.asarray(self.harmonics, dtype=np.float64) / period_s)
        return Shape(
            self.harmonics,
            tuple(float(a) for a in np.asarray(self.amplitudes) * np.abs(gains)),
            tuple(float(phase) for phase in np.asarray(self.phases_rad) + np.angle(gains)),
        )

    def steepness(self, period_s: float) -> NDArray[np.float64]:
        """Return the acceleration over one period, (1024,), 1/s: rad/s² per rad/s of peak speed."""
        return self.torque_deviation(period_s, 1.0, 0.0)

    def shifted(self, share: float) -> "Shape":
        """Return the same motion begun ``share`` of a period later."""
        turned = tuple(
            float((phase + 2.0 * np.pi * harmonic * share) % (2.0 * np.pi))
            for harmonic, phase in zip(self.harmonics, self.phases_rad, strict=True)
        )
        return Shape(self.harmonics, self.amplitudes, turned)

    def _wave(self, weights: NDArray[np.complex128], phase_rad: float) -> NDArray[np.float64]:
        wave: NDArray[np.float64] = (_turned(self.harmonics, self.phases_rad, phase_rad) @ weights).real
        return wave


@lru_cache(maxsize=8)
def _turned(
    harmonics: tuple[int, ...], phases_rad: tuple[float, ...], phase_rad: float
) -> NDArray[np.complex128]:
    """Return the lines with peak 1, (1024, K). Cached, because speed, rate and torque of a shape are needed in turn."""
    turns = 2.0 * np.pi * np.arange(_GRID) / _GRID
    arguments = np.outer(turns, harmonics) + np.asarray(phases_rad) + phase_rad
    lines: NDArray[np.complex128] = np.exp(1j * arguments)
    lines.flags.writeable = False
    return lines


@dataclass(frozen=True)
class PeriodicKind(ExcitationKind):
    """Periodic motion about one mean speed or two.

    ``shape``: returns its lines. ``frequency_hz``: frequency of the lowest line if none is requested.
    ``at_one_speed_s``: duration at one mean speed, s, if the slope of friction is not needed; its scatter then decides
    nothing; 0: two mean speeds. ``tuned``: the design may choose other lines, according to the shaft's noise and lags.
    """

    shape: Callable[[], Shape] = field(kw_only=True)
    frequency_hz: float = field(kw_only=True)
    at_one_speed_s: float = 0.0
    tuned: bool = False

    @property
    def adaptive(self) -> bool:
        return self.at_one_speed_s == 0.0


def unit_peak(shape: Shape) -> Shape:
    """Return the shape scaled to a largest deviation of 1."""
    peak = float(np.max(np.abs(shape.deviation())))
    return Shape(shape.harmonics, tuple(a / peak for a in shape.amplitudes), shape.phases_rad)


_SETS = 256               # random sets of phases of which the best is taken


@lru_cache(maxsize=8)
def other_phases(shape: Shape, number: int) -> Shape:
    """Return the same lines with the phases of realisation ``number``; 0: the shape itself.

    Of `_SETS` random sets, seeded with the number, the one with the least sum of the crest factors of speed and torque.
    The peak is not scaled to 1: each realisation must have the same amplitudes.
    """
    if number == 0:
        return shape
    draws = np.random.default_rng(number).uniform(0.0, 2.0 * np.pi, (_SETS, len(shape.harmonics)))
    turns = np.outer(np.asarray(shape.harmonics), 2.0 * np.pi * np.arange(_GRID) / _GRID)
    speed = np.asarray(shape.amplitudes)
    torque = speed * np.asarray(shape.harmonics)
    crests = [
        sum(float(np.max(np.abs(size @ np.cos(turns + phases[:, None])))) / float(np.linalg.norm(size))
            for size in (speed, torque))
        for phases in draws
    ]
    return Shape(shape.harmonics, shape.amplitudes, tuple(float(phase) for phase in draws[int(np.argmin(crests))]))


def begun_at_rest(shape: Shape, period_s: float, inertia_kg_m2: float, viscous_nm_s_rad: float) -> Shape:
    """Return the same motion with its start where the torque passes its mean.

    A ramp that ends there without acceleration causes no step of torque, so almost nothing has to settle.
    """
    torque = shape.torque_deviation(period_s, inertia_kg_m2, viscous_nm_s_rad)
    start = int(np.argmin(np.abs(torque)))
    return shape.shifted(start / _GRID)


# ---------------------------------------------------------------------------------------------------------------------
# Multisine: four lines in one period, with phases for a low crest factor of speed and of torque.
#
# Reasons for these lines (figures for the field-like rig, J 104 kg·m², lags 0.40 s and 0.15 s):
#
# - At low frequency G(jω) = (J s + B)(1 + τ_w s)/(1 + τ_T s) e^(−d s) is J s (1 + s(τ_w − τ_T − d) + O(s²)). Its phase
#   gives the difference of the lags. Its magnitude gives J and, at order ω², the effect of the lags. J is the limit of
#   |G|/ω towards zero, so the strongest lines are low. The weaker, higher lines give the slope to be removed.
# - Lines above 0.4 to 0.5 Hz depend on the *structure* of the filters. If the speed were filtered by a moving average
#   and not by a first-order lag, lines up to 0.5 Hz would bias J by 1.2 %, lines up to 0.4 Hz by 0.8 %, and three lines
#   up to 0.3 Hz by 0.4 %, with a third more scatter.
# - A period of 10 s with lines from 0.1 Hz gives twice as many periods as one of 20 s with lines from 0.05 Hz: more
#   degrees of freedom for the weights, and half the time for settling, at the same Cramér-Rao bound.
#
# The phases minimise (crest factor of speed + of torque), found by a search over 60 starts with growing p-norms. The
# crest factor of torque is 1.31 (sine: 1.41); speed spans 3.13 times its rms from peak to peak (sine: 2.83).


MULTISINE_FREQUENCY_HZ = 0.1   # Hz; lowest line
DEFAULT_PERIODS = 11         # periods at each mean speed, the first of them for settling


def multisine_shape() -> Shape:
    """Return the multisine: harmonics 1 to 4, peak deviation 1."""
    return unit_peak(
        Shape(
            harmonics=(1, 2, 3, 4),
            amplitudes=(1.58, 0.85, 0.24, 0.24),
            phases_rad=(5.38116627, 1.33755537, 0.43554371, 5.81670456),
        )
    )


MULTISINE = PeriodicKind(shape=multisine_shape, frequency_hz=MULTISINE_FREQUENCY_HZ, tuned=True)


# ---------------------------------------------------------------------------------------------------------------------
# Sine: the paper's equation 8, ω₁(t) = A sin(2π f t) + B, one line about one offset.
#
# One line gives two equations for inertia, friction, two lags and a time offset: it determines the inertia only if the
# lags are known.


SINE_FREQUENCY_HZ = 0.1   # lowest tone of the paper's field test (section 5.2)


def sine_shape() -> Shape:
    """Return one line of amplitude 1; a sine is a cosine delayed by a quarter of a period."""
    return Shape(harmonics=(1,), amplitudes=(1.0,), phases_rad=(1.5 * math.pi,))


SINE = PeriodicKind(shape=sine_shape, frequency_hz=SINE_FREQUENCY_HZ, at_one_speed_s=100.0)


# ---------------------------------------------------------------------------------------------------------------------
# Step: the paper's equation 9, A₀ before and A₁ after, repeated as a square wave about the offset.
#
# A true step of speed needs unbounded torque and saturates the drive, and data of a saturated drive identify nothing.
# So the square wave is band-limited: its odd harmonics 1 … 9, each (4/πm) sin(2π m f t), are tapered by Lanczos' σ
# factors sin(x)/x, x = π m / 11. These keep the overshoot of the truncated series (Gibbs) at about 1 %. The wave
# reaches the new speed in about a tenth of a period.


STEP_FREQUENCY_HZ = 0.05   # Hz; square wave: each of its two speeds lasts 10 s
_HARMONICS = (1, 3, 5, 7, 9)   # a square wave has odd harmonics only


def step_shape() -> Shape:
    """Return odd harmonics of a square wave, peak deviation 1 (half of A₁ − A₀)."""
    taper = [math.pi * m / (_HARMONICS[-1] + 2) for m in _HARMONICS]
    return unit_peak(
        Shape(
            harmonics=_HARMONICS,
            amplitudes=tuple(4.0 / (math.pi * m) * math.sin(x) / x for m, x in zip(_HARMONICS, taper, strict=True)),
            phases_rad=(1.5 * math.pi,) * len(_HARMONICS),
        )
    )


STEP = PeriodicKind(shape=step_shape, frequency_hz=STEP_FREQUENCY_HZ)


# ---------------------------------------------------------------------------------------------------------------------
# Pseudo-random torque, for a drill string: lines so dense that the time before its echo can be separated from the time
# after it (`estimation.frequency_domain.before_echo`).
#
# The torque is the maximum-length binary sequence of 63 elements (x⁶ + x⁵ + 1) over the period of 20 s. Lines up to
# 1.5 Hz are used, because reports of faster lines show mostly the drive's filters. An element that is held for a time h
# has the spectrum sin(x)/x, x = π f h. Division by J s converts torque to speed.


PRBS_FREQUENCY_HZ = 0.05   # Hz; a period of 20 s
ECHOES_S = (0.7, 3.8)
"""Range of usable echo times, s. An earlier echo leaves the fastest line no cycle; a later one outlasts a period."""

_ORDER, _TAPS = 6, (6, 5)   # length and taps of the shift register, x⁶ + x⁵ + 1
_PRBS_LINES = 30          # lines of the sequence in use: up to 1.5 Hz


def leaves_time_before_echo(echo_s: float) -> bool:
    """Return whether an echo after ``echo_s`` leaves enough time to identify J, and decays in time."""
    return ECHOES_S[0] <= echo_s <= ECHOES_S[1]


def prbs_shape() -> Shape:
    """Return the pseudo-random motion: harmonics 1 to 30, peak deviation of speed 1."""
    register, sequence = [1] * _ORDER, []
    for _ in range(2**_ORDER - 1):
        sequence.append(2.0 * register[-1] - 1.0)
        register = [register[_TAPS[0] - 1] ^ register[_TAPS[1] - 1], *register[:-1]]
    harmonics = np.arange(1, _PRBS_LINES + 1)
    x = np.pi * harmonics / len(sequence)
    torque = np.fft.fft(sequence)[1 : _PRBS_LINES + 1] * np.sin(x) / x * np.exp(-1j * x)
    speed = torque / (1j * harmonics)
    return unit_peak(
        Shape(
            harmonics=tuple(int(harmonic) for harmonic in harmonics),
            amplitudes=tuple(float(one) for one in np.abs(speed)),
            phases_rad=tuple(float(one) for one in np.angle(speed)),
        )
    )


PRBS = PeriodicKind(
    shape=prbs_shape, frequency_hz=PRBS_FREQUENCY_HZ, at_one_speed_s=600.0, needs_torque_mode=True,
    why_torque_mode="a stiff speed loop suppresses a torque as quick as the echo",
)
