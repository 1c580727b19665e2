"""A periodic motion before it is scaled: lines with relative amplitudes and phases, and the peaks they add up to."""

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

    Scaled so that its greatest deviation from the mean is 1; ``harmonics`` count whole cycles per period.
    """

    harmonics: tuple[int, ...]
    amplitudes: tuple[float, ...]
    phases_rad: tuple[float, ...]

    def deviation(self, phase_rad: float = 0.0) -> NDArray[np.float64]:
        """Return the deviation over one period, (1024,); every line turned on by ``phase_rad`` of its own argument."""
        return self._wave(np.asarray(self.amplitudes, dtype=np.complex128), phase_rad)

    def foreseen_deviation(self, period_s: float, foresight_s: float) -> NDArray[np.float64]:
        """Return deviation + foresight·its rate over a period, (1024,): Re Σ (1 + jω_k t_f) a_k e^(j(ω_k t + φ_k))."""
        omega = 2.0 * np.pi * np.asarray(self.harmonics, dtype=np.float64) / period_s
        return self._wave((1.0 + 1j * omega * foresight_s) * np.asarray(self.amplitudes), 0.0)

    def torque_deviation(self, period_s: float, inertia_kg_m2: float, viscous_nm_s_rad: float) -> NDArray[np.float64]:
        """(1024,) torque over one period, N·m per rad/s of peak speed: Re Σ (J jω_k + B) a_k e^(j(ω_k t + φ_k))."""
        omega = 2.0 * np.pi * np.asarray(self.harmonics, dtype=np.float64) / period_s
        return self._wave((viscous_nm_s_rad + 1j * omega * inertia_kg_m2) * np.asarray(self.amplitudes), 0.0)

    def followed(self, period_s: float, following: SpeedFollowing) -> "Shape":
        """Return the motion of the shaft for it as a setpoint under the drive's speed control."""
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
    """(1024, K) the lines of peak 1; kept: speed, rate and torque of one shape are needed one after another."""
    turns = 2.0 * np.pi * np.arange(_GRID) / _GRID
    arguments = np.outer(turns, harmonics) + np.asarray(phases_rad) + phase_rad
    lines: NDArray[np.complex128] = np.exp(1j * arguments)
    lines.flags.writeable = False
    return lines


@dataclass(frozen=True)
class PeriodicKind(ExcitationKind):
    """A periodic motion around one mean speed, or two.

    ``shape``: makes its lines. ``frequency_hz``: of the first of them if no other is requested.
    ``at_one_speed_s``: friction's slope isn't asked for, so that it has one mean speed, as many periods as that time
    holds, and its scatter decides nothing; 0: two mean speeds. ``tuned``: the design may choose other lines, fitted to
    the shaft's noise and lags.
    """

    shape: Callable[[], Shape] = field(kw_only=True)
    frequency_hz: float = field(kw_only=True)
    at_one_speed_s: float = 0.0
    tuned: bool = False

    @property
    def adaptive(self) -> bool:
        return self.at_one_speed_s == 0.0


def unit_peak(shape: Shape) -> Shape:
    """Return the shape scaled so that its greatest deviation is 1."""
    peak = float(np.max(np.abs(shape.deviation())))
    return Shape(shape.harmonics, tuple(a / peak for a in shape.amplitudes), shape.phases_rad)


def begun_at_rest(shape: Shape, period_s: float, inertia_kg_m2: float, viscous_nm_s_rad: float) -> Shape:
    """Return the same motion begun where its torque passes its mean.

    A ramp that ends there without acceleration hands over without a step of torque: next to nothing has to settle.
    """
    torque = shape.torque_deviation(period_s, inertia_kg_m2, viscous_nm_s_rad)
    start = int(np.argmin(np.abs(torque)))
    return shape.shifted(start / _GRID)


# ---------------------------------------------------------------------------------------------------------------------
# Multisine: four lines in one period, phased for a low crest of speed and of torque.
#
# Why these lines (notes of the design; figures for the field-like rig, J 104 kg·m², lags 0.40 s and 0.15 s):
#
# - G(jω) = (J s + B)(1 + τ_w s)/(1 + τ_T s) e^(−d s) is J s (1 + s(τ_w − τ_T − d) + O(s²)) at low frequency: its
# phase tells the lags' difference, its magnitude J and, at order ω², what the lags add to it. J is the limit of |G|/ω
# towards zero, so the strongest lines belong low; the weaker, higher ones tell the slope that has to be taken out. -
# Lines above 0.4 to 0.5 Hz make the filters' *structure* matter: were the speed filtered by a moving average and not
# by a first-order lag, lines up to 0.5 Hz would bias J by 1.2 %, lines up to 0.4 Hz by 0.8 %, and three lines up to
# 0.3 Hz by 0.4 % at a third more scatter. - A period of 10 s with lines from 0.1 Hz gives twice the periods of 20 s
# with lines from 0.05 Hz, hence weights that are better known (degrees of freedom) and half the time lost to
# settling, at the same Cramér-Rao bound.
#
# The phases minimise (crest of speed + crest of torque), found by a search over 60 starts with growing p-norms; the
# crest of torque is 1.31 (a single sine: 1.41), speed spans 3.13 times its rms from peak to peak (a sine: 2.83).


MULTISINE_FREQUENCY_HZ = 0.1   # of the lowest line
DEFAULT_PERIODS = 11         # at each mean speed, the first of them for settling


def multisine_shape() -> Shape:
    """Return harmonics 1 to 4, peak deviation 1."""
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
# One line is two equations for inertia, friction, two lags and a skew: it tells the inertia only where the lags are
# known.


SINE_FREQUENCY_HZ = 0.1   # lowest tone of the paper's field test (section 5.2)


def sine_shape() -> Shape:
    """Return one line, amplitude 1; a sine is a cosine delayed by a quarter."""
    return Shape(harmonics=(1,), amplitudes=(1.0,), phases_rad=(1.5 * math.pi,))


SINE = PeriodicKind(shape=sine_shape, frequency_hz=SINE_FREQUENCY_HZ, at_one_speed_s=100.0)


# ---------------------------------------------------------------------------------------------------------------------
# Step: the paper's equation 9, A₀ before and A₁ after, repeated as a square wave about the offset.
#
# A true step of speed needs unbounded torque and saturates the drive, and a saturated drive identifies nothing. So
# the square wave is band-limited: its odd harmonics 1 … 9, each (4/πm) sin(2π m f t), tapered by Lanczos' σ factors
# sin(x)/x, x = π m / 11, which keep the overshoot of the truncated series (Gibbs) at about 1 %. It reaches the new
# speed in about a tenth of a period.


STEP_FREQUENCY_HZ = 0.05   # of the square wave: each level lasts 10 s
_HARMONICS = (1, 3, 5, 7, 9)   # of the square wave: it has odd ones only


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
# The binary sequence of greatest length 63 (x⁶ + x⁵ + 1), one element lasting a 63rd of the period of 20 s, moved the
# motor by its torque alone; its lines up to 1.5 Hz, since what a drive reports of faster ones is mostly its filters.
# Held for a time h, an element has the spectrum sin(x)/x, x = π f h, and J s turns torque into speed.


PRBS_FREQUENCY_HZ = 0.05   # Hz; a period of 20 s
ECHOES_S = (0.7, 3.8)
"""Range of usable echo times, s. An earlier echo leaves the fastest line no cycle; a later one outlasts a period."""

_ORDER, _TAPS = 6, (6, 5)   # of the shift register, x⁶ + x⁵ + 1
_PRBS_LINES = 30          # lines of the sequence in use: up to 1.5 Hz


def tells_before_echo(echo_s: float) -> bool:
    """Return whether an echo after ``echo_s`` leaves enough time to identify J, and decays in time."""
    return ECHOES_S[0] <= echo_s <= ECHOES_S[1]


def prbs_shape() -> Shape:
    """Return harmonics 1 to 30, peak deviation of speed 1."""
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
