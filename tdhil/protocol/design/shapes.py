"""Candidate multisines: which lines, how strong, phased so that they fit the most motion into the limits."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np

from tdhil.recording.recording import FloatArray
from tdhil.run.excitation.reference import DriveMode, MachineLimits, RigGuess
from tdhil.run.excitation.signals import Shape, unit_peak

HIGHEST_TURN = 0.24    # of 1/τ, Hz: the highest line, where τ is the longest lag that must be reckoned with
LINES_LIMIT_HZ = (0.1, 2.0)
"""The highest line, Hz: not below the first (a rig would take an hour), not above the second (structure, backlash)."""

SLOPES = (1.0, 1.5, 2.0)                               # amplitude ~ harmonic^−slope
_HARMONICS = ((1, 2, 3, 4), (1, 2, 3, 5), (1, 2, 3, 4, 5), (1, 2, 3, 4, 6), (1, 2, 3, 4, 5, 6), (1, 3, 5, 7, 9))
_REACHES = (0.8, 1.0)                                  # of the highest line that is allowed
_GRID = 128
_TURN = 2.0 * np.pi * np.arange(_GRID) / _GRID
_POPULATION, _KEPT, _ROUNDS, _STEP_RAD = 96, 6, 5, 0.8


@dataclass(frozen=True)
class Proposal:
    """Lowest line and harmonics, with amplitudes ~ harmonic^−slope."""

    lowest_hz: float
    harmonics: tuple[int, ...]
    slope: float

    @property
    def amplitudes(self) -> tuple[float, ...]:
        """Relative to the first line's."""
        return tuple(float(harmonic) ** -self.slope for harmonic in self.harmonics)


def highest_line_hz(longest_lag_s: float) -> float:
    """Above a quarter of 1/τ what nobody can know of a lag τ matters too much: the notes of `identify.reports`."""
    return float(np.clip(HIGHEST_TURN / max(longest_lag_s, 1e-3), *LINES_LIMIT_HZ))


def proposals(highest_hz: float, slope: float) -> Iterator[Proposal]:
    """From few lines in a short period to many in a long one, none above ``highest_hz``."""
    for harmonics, reach in product(_HARMONICS, _REACHES):
        yield Proposal(reach * highest_hz / harmonics[-1], harmonics, slope)


def phased(proposal: Proposal, limits: MachineLimits, guess: RigGuess, mode: DriveMode) -> Shape:
    """The proposal with phases that allow the greatest amplitude within speed window and torque limit, peak 1.

    A search over random phases, narrowed around the best ones; seeded, so that the same rig gets the same motion.
    """
    fit = _Room(proposal, limits, guess, mode)
    rng = np.random.default_rng(len(proposal.harmonics))
    phases = rng.uniform(0.0, 2.0 * np.pi, (_POPULATION, len(proposal.harmonics)))
    room = fit.of(phases)
    for turn in range(_ROUNDS):
        best = phases[np.argsort(-room, kind="stable")[:_KEPT]]
        around = np.repeat(best, _POPULATION // _KEPT - 1, axis=0)
        phases = np.concatenate([best, around + rng.normal(0.0, _STEP_RAD * 0.5**turn, around.shape)])
        room = fit.of(phases)
    chosen = phases[int(np.argmax(room))] % (2.0 * np.pi)
    return unit_peak(Shape(proposal.harmonics, proposal.amplitudes, tuple(float(phase) for phase in chosen)))


class _Room:
    """How much of a proposal fits, by its phases."""

    def __init__(self, proposal: Proposal, limits: MachineLimits, guess: RigGuess, mode: DriveMode) -> None:
        harmonics, amplitudes = np.array(proposal.harmonics), np.array(proposal.amplitudes)
        omega = 2.0 * np.pi * proposal.lowest_hz * harmonics
        foresight = limits.foresight_s if mode == "torque" else 0.0
        self._turns = np.exp(1j * np.outer(_TURN, harmonics))
        self._speed = amplitudes.astype(np.complex128)
        self._ahead = amplitudes * (1.0 + 1j * omega * foresight)
        self._torque = amplitudes * (guess.viscous_nm_s_rad + 1j * omega * guess.inertia_kg_m2)
        self._both_ends = mode == "speed" and guess.following is not None
        if self._both_ends and guess.following is not None:     # what the shaft makes of the setpoint
            gains = guess.following.shaft(proposal.lowest_hz * harmonics)
            self._ahead, self._torque = amplitudes * gains, self._torque * gains
        steady = max(guess.steady_torque_nm(limits.usable_low_rad_s), guess.steady_torque_nm(limits.usable_high_rad_s))
        self._speed_room = (limits.usable_high_rad_s - limits.usable_low_rad_s) / guess.speed_swing_factor(mode)
        self._torque_room = max(limits.usable_torque_nm - steady, 1e-9) / guess.torque_swing_factor(mode)

    def of(self, phases: FloatArray) -> FloatArray:
        """The amplitude that fits, (C,), for phases (C, K)."""
        turned = np.exp(1j * phases.T)
        speed, ahead, torque = (
            (self._turns @ (weights[:, None] * turned)).real for weights in (self._speed, self._ahead, self._torque)
        )
        lowest = np.minimum(ahead.min(axis=0), speed.min(axis=0)) if self._both_ends else speed.min(axis=0)
        span = np.maximum(ahead.max(axis=0), speed.max(axis=0)) - lowest
        room: FloatArray = np.minimum(self._speed_room / span, self._torque_room / np.abs(torque).max(axis=0))
        return room
