"""Stages 4 and 5 of a measurement of the drive's own impedance: a small pilot first, then the full amplitude.

The drive stays in its speed loop. With the *reference* it follows a multisine as in any run in speed mode (`acquire`).
With the *torque offset* its reference is constant, and a multisine of torque is added to its loop's. The resulting
motion is unknown in advance, since it is measured. So stage 4 is a pilot with a twentieth of the torque limit; its
speed and torque scale stage 5. The guard limits offset, speed window and torque all the time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers import Command, LimitHit, Mode, Sample
from profiles import MessageCode
from tdhil.recording import Excitation, Segment
from tdhil.runner.control_loop import ControlLoop
from tdhil.runner.excitation import (
    LEAST_COUNTED,
    MotionLimits,
    PeriodicReference,
    Plan,
    PlannedSegment,
    PlanRequest,
    RigGuess,
    Shape,
    make_plan,
    make_transition,
    unit_peak,
)
from tdhil.runner.settings import ControlAssumptions, MachineLimits
from tdhil.runner.stages.steady import trace, wait_until_steady

HARMONICS = (1, 2, 3, 5, 7, 10, 14, 20, 30)   # excited lines, multiples of 1/PERIOD_S
PHASES_RAD = (0.4081, 5.3094, 1.6031, 0.07, 3.2103, 0.7969, 5.0826, 4.208, 5.651)
"""Phases of the lines, rad: equal lines then have a crest factor of 1.75. Found by a search with growing p-norms."""
PERIOD_S = 20.0            # lines of 0.05 to 1.5 Hz: from string modes to the bandwidth of speed loops
COUNTED, SETTLE = 24, 2    # periods; the offset is faded in over the first settling period
DRAWS, SHARPNESS = 400, 1.0   # random sets of phases, the best is used; weight of the lines that determine |r|

LARGEST_SHARE = 0.4
"""Largest offset as a share of the torque limit; the rest is for the speed loop."""
PILOT_SHARE, PILOT_PERIODS = 0.05, 2   # offset of the pilot as a share of the torque limit; its periods
ROOM_SHARE = 0.9           # share of the room in speed and torque that a plan uses
FADE_S = 2.0               # s; fade-out at the end
RESERVE_S = 10.0           # s; reserved of the time limit, beside stage 5
DITHER_COUNTS, DITHER_TURNS = 3.0, 6.0 * 1.0103
"""A small sine on the reference: amplitude in counts of the reported speed, and cycles per period (no whole number, far
from every line). Without it a stiff loop's few counts of speed are rounded alike in every period."""


@dataclass(frozen=True)
class OffsetPlan:
    """Plan with a torque offset. ``plan``: expected motion, for display and log; the torque lines are commanded."""

    plan: Plan
    torque_amplitudes_nm: tuple[float, ...]
    peak_nm: float

    @property
    def phases_rad(self) -> tuple[float, ...]:
        """Return the phases of the torque's lines, rad."""
        return self.segment.reference.phases_rad

    @property
    def segment(self) -> PlannedSegment:
        return self.plan.segments[0]


Announce = Callable[[Excitation], None]


def largest_offset_nm(limits: MachineLimits) -> float:
    """Return the largest torque offset, N·m."""
    return LARGEST_SHARE * limits.torque_nm


def reference_plan(limits: MotionLimits, guess: RigGuess, wish: PlanRequest) -> Plan:
    """Return the multisine of the speed reference: lines of about equal torque, at one mean speed.

    Raises PlanRefused if it does not fit.
    """
    omega = 2.0 * math.pi * np.asarray(HARMONICS) / PERIOD_S
    shape = unit_peak(Shape(HARMONICS, tuple(1.0 / np.hypot(1.0, omega)), PHASES_RAD))
    middle = 0.5 * (limits.speed_low_rad_s + limits.speed_high_rad_s)
    return make_plan(limits, guess, replace(
        wish, kind="multisine", mode="speed", shape=shape, frequency_hz=1.0 / PERIOD_S,
        offsets_rad_s=wish.offsets_rad_s or (middle,), periods=wish.periods or SETTLE + COUNTED,
    ))


def run_pilot(
    loop: ControlLoop,
    limits: MachineLimits,
    room: MotionLimits,
    guess: RigGuess,
    assumptions: ControlAssumptions,
    wish: PlanRequest,
    string_nm_s_rad: float,
    speed_resolution_rad_s: float,
) -> OffsetPlan:
    """Run stage 4: go to the mean speed, run the pilot, and plan stage 5. Raises what the bench raises, and LimitHit.

    ``string_nm_s_rad``: ζ at the motor, 0 if unknown. The guard permits offsets from here until the run ends.
    """
    middle = 0.5 * (limits.speed_min_rad_s + limits.speed_max_rad_s)
    mean = wish.offsets_rad_s[0] if wish.offsets_rad_s else middle
    last = loop.last
    transition = make_transition(max(0.0, last.speed_rad_s if last else 0.0), mean, room, guess, "speed")
    for step in range(1, loop.cycles(transition.duration_s) + 1):
        loop.cycle(Command(Mode.SPEED, transition.reference(step * loop.period_s)[0], 0.0))
    steady = Command(Mode.SPEED, mean, 0.0)
    wait_until_steady(loop, steady, mean, max(2.0 * speed_resolution_rad_s, 0.01 * mean), timeout_s=60.0)
    loop.guard.allow_torque_offset(largest_offset_nm(limits))
    size = PILOT_SHARE * limits.torque_nm / _peak(np.ones(len(HARMONICS)), PHASES_RAD)
    drive = _WaveSender(loop, _ExcitationWave(np.full(len(HARMONICS), size), PHASES_RAD, mean, speed_resolution_rad_s))
    seen = drive.run(PILOT_PERIODS * PERIOD_S, fade_in_s=PERIOD_S)
    drive.fade_out(FADE_S)
    left_s = loop.guard.left_s(loop.now_s) - RESERVE_S
    work = partial(
        _planned, _answer(seen[-loop.cycles(PERIOD_S):]), size, mean, room, guess, assumptions.largest_speed_lag_s,
        wish, string_nm_s_rad, loop.guard.torque_offset_nm, max(0, math.floor(left_s / PERIOD_S)),
    )
    return loop.compute(work, steady)


def run_offset(loop: ControlLoop, plan: OffsetPlan, announce: Announce, speed_resolution_rad_s: float) -> None:
    """Run stage 5 with the torque offset, which is faded in, and faded out at the end."""
    segment = plan.segment
    sizes, mean = np.asarray(plan.torque_amplitudes_nm), segment.reference.offset_rad_s
    drive = _WaveSender(loop, _ExcitationWave(sizes, plan.phases_rad, mean, speed_resolution_rad_s))

    def recorded(start_s: float, end_s: float | None = None) -> Excitation:
        applied: Segment = replace(segment.recorded(start_s, end_s), torque_amplitudes_nm=plan.torque_amplitudes_nm)
        return Excitation(plan.plan.kind, plan.plan.mode, (applied,))

    start_s = drive.time_s + loop.period_s
    announce(recorded(start_s))
    drive.run(segment.duration_s, fade_in_s=PERIOD_S)
    announce(recorded(start_s, drive.time_s + 1.5 * loop.period_s))
    drive.fade_out(FADE_S)


# ---------------------------------------------------------------------------------------------------------------------

class _ExcitationWave:
    """Torque offset and speed reference over time; ``sizes`` (K,) N·m."""

    def __init__(
        self, sizes: NDArray[np.float64], phases_rad: Sequence[float], mean_rad_s: float, speed_resolution_rad_s: float
    ) -> None:
        self.mean_rad_s = mean_rad_s
        self._resolution_rad_s = speed_resolution_rad_s
        self._lines = [
            (2.0 * math.pi * harmonic / PERIOD_S, phase, float(size))
            for harmonic, phase, size in zip(HARMONICS, phases_rad, sizes, strict=True)
        ]

    def offset_nm(self, time_s: float) -> float:
        return math.fsum(size * math.cos(omega * time_s + phase) for omega, phase, size in self._lines)

    def speed_rad_s(self, time_s: float) -> float:
        turn = 2.0 * math.pi * DITHER_TURNS * time_s / PERIOD_S
        return self.mean_rad_s + DITHER_COUNTS * self._resolution_rad_s * math.sin(turn)


_POINTS = 1024               # of a period, at which a peak is sought
_GRID = np.exp(2j * np.pi * np.outer(np.arange(_POINTS), HARMONICS) / _POINTS)
BETWEEN = math.cos(math.pi * max(HARMONICS) / _POINTS)
"""Least share of its peak that a sum of these harmonics reaches on the grid, whose points are within π/`_POINTS` of any
instant. Next to its peak M, a trigonometric polynomial of degree n stays above M cos(n t) for |n t| < π (M. Riesz)."""


def _peak(lines: NDArray[Any], phases_rad: Sequence[float]) -> float:
    """Return the largest magnitude over a period of Σ Re a_k e^(j(ω_k t + φ_k)), with complex a_k."""
    return float(np.max(np.abs((_GRID @ (lines * np.exp(1j * np.asarray(phases_rad)))).real)))


class _WaveSender:
    """Sends a wave, cycle by cycle, timed from its beginning."""

    def __init__(self, loop: ControlLoop, wave: _ExcitationWave) -> None:
        self._loop, self._wave = loop, wave
        last = loop.last
        self.time_s = last.time_s if last else loop.now_s
        self._start_s = self.time_s + loop.period_s

    def run(self, duration_s: float, fade_in_s: float) -> list[Sample]:
        """Send the wave for a duration from its start, fading the offset in. Return the samples."""
        end_s, samples = self._start_s + duration_s, []
        while self.time_s + 1.5 * self._loop.period_s < end_s:
            at_s = self.time_s + self._loop.period_s - self._start_s
            samples.append(self._step(at_s, min(1.0, max(0.0, at_s / fade_in_s))))
        return samples

    def fade_out(self, fade_s: float) -> None:
        """Fade the offset out while the wave continues."""
        begun_s = self.time_s
        while self.time_s - begun_s < fade_s:
            at_s = self.time_s + self._loop.period_s
            self._step(at_s - self._start_s, max(0.0, 1.0 - (at_s - begun_s) / fade_s))
        self._loop.cycle(Command(Mode.SPEED, self._wave.mean_rad_s, 0.0))

    def _step(self, at_s: float, share: float) -> Sample:
        wave = self._wave
        sample = self._loop.cycle(Command(Mode.SPEED, wave.speed_rad_s(at_s), 0.0, share * wave.offset_nm(at_s)))
        self.time_s = sample.time_s
        return sample


# ---------------------------------------------------------------------------------------------------------------------
# Plan of stage 5 from the pilot.


def _answer(samples: list[Sample]) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Return the lines of speed and torque over the pilot's last period, for offset lines of phase 0, (K,)."""
    seen = trace(samples)
    omega = 2.0 * np.pi * np.asarray(HARMONICS) / PERIOD_S
    table = np.exp(-1j * (np.outer(seen.time_s - seen.time_s[0], omega) + np.asarray(PHASES_RAD)))
    return (
        2.0 * (seen.speed_rad_s - seen.speed_rad_s.mean()) @ table / len(table),
        2.0 * (seen.torque_nm - seen.torque_nm.mean()) @ table / len(table),
    )


def _planned(
    answer: tuple[NDArray[np.complex128], NDArray[np.complex128]],
    pilot_nm: float,
    mean_rad_s: float,
    room: MotionLimits,
    guess: RigGuess,
    largest_lag_s: float,
    wish: PlanRequest,
    string_nm_s_rad: float,
    largest_nm: float,
    most_periods: int,
) -> OffsetPlan:
    """Plan stage 5 in proportion to the pilot. The reported motion is smaller than the true one because of the lag.

    Of some random sets of phases (always the same ones) the one with the largest possible offset is used.
    """
    omega = 2.0 * np.pi * np.asarray(HARMONICS) / PERIOD_S
    speed = answer[0] / pilot_nm * np.hypot(1.0, omega * largest_lag_s)
    torque = np.where(np.abs(answer[1]) > pilot_nm, answer[1] / pilot_nm, 1.0)
    z = 1.0 / np.maximum(np.abs(speed), 1e-9)
    zeta = string_nm_s_rad or float(np.min(z))
    # the offset is largest where |r| depends most on Z: |dr/d ln Z| = 2ζ|Z|/|Z + ζ|²
    shares = (2.0 * zeta * z / (z**2 + zeta**2)) ** SHARPNESS
    steady = guess.steady_torque_nm(mean_rad_s)
    speed_room = min(mean_rad_s - room.usable_low_rad_s, room.usable_high_rad_s - mean_rad_s)
    if wish.amplitude_rad_s is not None:
        speed_room = min(speed_room, wish.amplitude_rad_s / ROOM_SHARE)
    limits = [
        (ROOM_SHARE * speed_room, shares * speed),
        (ROOM_SHARE * (room.usable_torque_nm - abs(steady)), shares * torque),
        (BETWEEN * largest_nm, shares.astype(np.complex128)),
    ]
    rng = np.random.default_rng(0)
    scale, phases_rad = 0.0, PHASES_RAD
    for draw in range(DRAWS):
        drawn = PHASES_RAD if draw == 0 else tuple(rng.uniform(0.0, 2.0 * math.pi, len(HARMONICS)).tolist())
        fits = min(have / _peak(lines, drawn) for have, lines in limits)
        if fits > scale:
            scale, phases_rad = fits, drawn
    if not scale > 0.0:
        raise LimitHit(
            f"the limits leave no room for a torque offset at {mean_rad_s:.2f} rad/s", where="plan of stage 5",
            stops=True, next_step="Widen the speed window, or raise limits.torque_nm",
            entry=MessageCode.NO_ROOM_FOR_MOTION,
        )
    periods = min(wish.periods or SETTLE + COUNTED, most_periods)
    if periods < SETTLE + LEAST_COUNTED:
        raise LimitHit(
            f"{periods} periods of {PERIOD_S:g} s are too few: {SETTLE} settle, and {LEAST_COUNTED} must follow",
            where="--periods, and limits.time_s in rig.yaml",
            stops=True, next_step=f"Use {SETTLE + LEAST_COUNTED} or more",
            entry=MessageCode.NO_ROOM_FOR_MOTION,
        )
    swing, pull, peak = (_peak(scale * lines, phases_rad) for _, lines in limits)
    reference = PeriodicReference(
        mean_rad_s, PERIOD_S, tuple(harmonic / PERIOD_S for harmonic in HARMONICS),
        tuple(float(one) for one in np.abs(scale * shares * speed)), phases_rad, guess,
    )
    segment = PlannedSegment(
        reference, periods, SETTLE, mean_rad_s - swing, mean_rad_s + swing, steady - pull, steady + pull
    )
    plan = Plan("multisine", "speed", (segment,), room, guess)
    return OffsetPlan(plan, tuple(float(one) for one in scale * shares), peak)
