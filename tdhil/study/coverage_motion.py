"""What the shaft is asked to do: a plan of stage 5 per run, each from its own rough inertia, on one time grid."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tdhil.recording.recording import Segment
from tdhil.run.excitation import ExcitationWish, MachineLimits, Plan, RigGuess, make_plan
from tdhil.studies.coverage.plants import CoveragePlant, FloatArray

ROUGH_ERROR = 0.15        # the rough inertia is wrong by up to this share, uniformly, either way
_FRICTION_ERROR = 0.03    # so is the rough friction: the steady holds of stages 2 to 4 tell it well
_LEAD_S = 1.0             # steady speed before the excitation
_TAIL_S = 1.0             # the excitation goes on after its last whole period, for what is read late


@dataclass(frozen=True)
class Motion:
    """``target`` (steps, runs) rad/s and ``feed`` (steps, runs) N·m; ``segments`` per run, ``rough`` (runs,) kg·m²."""

    target: FloatArray
    feed: FloatArray
    segments: tuple[tuple[Segment, ...], ...]
    rough: FloatArray
    step_s: float


def rough_guess(plant: CoveragePlant, shares: FloatArray) -> RigGuess:
    """What stages 1 to 4 would have left behind; ``shares`` (2,) in [−1, 1]: how wrong inertia and friction are."""
    friction = 1.0 + _FRICTION_ERROR * float(shares[1])
    return RigGuess(
        plant.inertia_kg_m2 * (1.0 + ROUGH_ERROR * float(shares[0])),
        plant.viscous_nm_s_rad * friction,
        plant.coulomb_nm * friction,
    )


def plan_for(plant: CoveragePlant, guess: RigGuess, periods: int) -> Plan:
    """The default multisine about two mean speeds: so many periods that count at each, after 10 s of settling."""
    limits = MachineLimits(*plant.window_rad_s, plant.torque_limit_nm)
    settle = max(1, math.ceil(10.0 * plant.lowest_hz - 1e-9))
    return make_plan(limits, guess, ExcitationWish(frequency_hz=plant.lowest_hz, periods=settle + periods))


def motion(plant: CoveragePlant, guesses: list[RigGuess], periods: int) -> Motion:
    """Every run's reference on the same grid, which depends on the plant only, not on which runs there are."""
    plans = [plan_for(plant, guess, periods) for guess in guesses]
    join = _join_s(plant, periods)
    length = plans[0].segments[0].duration_s
    starts = (_LEAD_S, _LEAD_S + length + join)
    steps = round((starts[1] + length + _TAIL_S) / plant.step_s)
    time: FloatArray = np.arange(steps, dtype=np.float64) * plant.step_s
    target, feed = np.empty((len(time), len(plans))), np.empty((len(time), len(plans)))
    for run, plan in enumerate(plans):
        target[:, run], rate = _one(plan, time, starts, length, join)
        guess = plan.guess
        feed[:, run] = guess.inertia_kg_m2 * rate + guess.viscous_nm_s_rad * target[:, run] + guess.coulomb_nm
    segments = tuple(
        tuple(segment.recorded(start) for segment, start in zip(plan.segments, starts, strict=True)) for plan in plans
    )
    return Motion(target, feed, segments, np.array([guess.inertia_kg_m2 for guess in guesses]), plant.step_s)


def _join_s(plant: CoveragePlant, periods: int) -> float:
    """Duration of the transition, s: the longest that the most wrong rough guesses ask for, and a tenth more."""
    longest = 0.0
    for corner in ((-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)):
        plan = plan_for(plant, rough_guess(plant, np.array(corner)), periods)
        longest = max(longest, plan.transition(plan.segments[0].reference.start_speed_rad_s, 1).duration_s)
    return math.ceil(11.0 * longest) / 10.0


def _one(
    plan: Plan, time: FloatArray, starts: tuple[float, float], length: float, join: float
) -> tuple[FloatArray, FloatArray]:
    """Speed and acceleration: steady, first segment, half a cosine, second segment."""
    speed, rate = np.empty_like(time), np.zeros_like(time)
    ends = [segment.reference.start_speed_rad_s for segment in plan.segments]
    lead = time < starts[0] - 1e-9
    speed[lead] = ends[0]
    between = (time >= starts[0] + length - 1e-9) & (time < starts[1] - 1e-9)
    turn = np.pi * (time[between] - starts[0] - length) / join
    half = 0.5 * (ends[1] - ends[0])
    speed[between], rate[between] = ends[0] + half * (1.0 - np.cos(turn)), half * np.pi / join * np.sin(turn)
    insides = (~lead & (time < starts[0] + length - 1e-9), time >= starts[1] - 1e-9)
    for segment, start, inside in zip(plan.segments, starts, insides, strict=True):
        reference = segment.reference
        omega = 2.0 * np.pi * np.asarray(reference.lines_hz)
        angle = np.outer(time[inside] - start, omega) + np.asarray(reference.phases_rad)
        amplitudes = np.asarray(reference.amplitudes_rad_s)
        speed[inside] = reference.offset_rad_s + np.cos(angle) @ amplitudes
        rate[inside] = -np.sin(angle) @ (omega * amplitudes)
    return speed, rate
