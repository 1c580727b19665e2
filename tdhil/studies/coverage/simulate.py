"""Simulated recordings from a plant and seeds. Every run has its own random stream, so grouping has no effect."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from tdhil.errors import MessageCode, TdhilError
from tdhil.estimation import Options, identify
from tdhil.process_pool import Loss, Pool, TaskLimits
from tdhil.recording import Excitation, FloatArray, Recording, Segment
from tdhil.runner.excitation import MotionLimits, Plan, PlanRequest, RigGuess, make_plan
from tdhil.studies.coverage.plants import CoveragePlant, ReportFilter

# ---------------------------------------------------------------------------------------------------------------------
# Motion of the shaft: a plan of stage 5 per run, each from its own rough inertia, on one time grid.


ROUGH_ERROR = 0.15        # largest relative error of the rough inertia, uniform, either sign
_FRICTION_ERROR = 0.03    # the same for the rough friction: the steady stretches of stages 2 to 4 give it accurately
_LEAD_S = 1.0             # s; steady speed before the excitation
_TAIL_S = 1.0             # s; excitation after its last whole period, for late reports


@dataclass(frozen=True)
class SimulatedMotion:
    """Motion: ``target`` (steps, runs) rad/s and ``feed`` (steps, runs) N·m; ``segments`` per run, ``rough`` (runs,)
    kg·m².
    """

    target: FloatArray
    feed: FloatArray
    segments: tuple[tuple[Segment, ...], ...]
    rough: FloatArray
    step_s: float


def rough_guess(plant: CoveragePlant, shares: FloatArray) -> RigGuess:
    """Return the results of stages 1 to 4; ``shares`` (2,) in [−1, 1]: errors of inertia and friction."""
    friction = 1.0 + _FRICTION_ERROR * float(shares[1])
    return RigGuess(
        plant.inertia_kg_m2 * (1.0 + ROUGH_ERROR * float(shares[0])),
        plant.viscous_nm_s_rad * friction,
        plant.coulomb_nm * friction,
    )


def plan_for(plant: CoveragePlant, guess: RigGuess, periods: int) -> Plan:
    """Return the default multisine about two mean speeds: ``periods`` that count at each, after 10 s of settling."""
    limits = MotionLimits(*plant.window_rad_s, plant.torque_limit_nm)
    settle = max(1, math.ceil(10.0 * plant.lowest_hz - 1e-9))
    return make_plan(limits, guess, PlanRequest(frequency_hz=plant.lowest_hz, periods=settle + periods))


def motion(plant: CoveragePlant, guesses: list[RigGuess], periods: int) -> SimulatedMotion:
    """Return every run's reference on the same grid, which depends only on the plant, not on the other runs."""
    plans = [plan_for(plant, guess, periods) for guess in guesses]
    # duration of the transition, s: the longest for the most wrong rough guesses, plus a tenth
    longest = 0.0
    for corner in ((-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)):
        rough = plan_for(plant, rough_guess(plant, np.array(corner)), periods)
        longest = max(longest, rough.transition(rough.segments[0].reference.start_speed_rad_s, 1).duration_s)
    join = math.ceil(11.0 * longest) / 10.0
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
    return SimulatedMotion(target, feed, segments, np.array([guess.inertia_kg_m2 for guess in guesses]), plant.step_s)


def _one(
    plan: Plan, time: FloatArray, starts: tuple[float, float], length: float, join: float
) -> tuple[FloatArray, FloatArray]:
    """Return speed and acceleration: steady, first segment, half a cosine, second segment."""
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


# ---------------------------------------------------------------------------------------------------------------------
# Simulation of the shaft, many runs at once, in fine steps.
#
# Between two steps every input is a straight line. For this, a first-order lag y' = (u − y)/τ has the exact recursion,
# with h = step/τ and a = e^(−h),
#
#     y₁ = a y₀ + g₀ u₀ + g₁ u₁,   g₀ = (1 − a)/h − a,   g₁ = 1 − (1 − a)/h.
#
# The shaft is such a lag of u = (T + load − T_c)/B with τ = J/B (positive speed, so that T_c is constant). Nonlinear
# friction is part of u: it is known at the beginning of the step, and extrapolated at its end from the last two speeds.
# The motor follows its command through a short lag. The command is feed-forward from the rough inertia plus a slow PI
# on the mean speed, K_p = Ĵ ω_b, K_i = K_p ω_b/4, ω_b = 0.2/0.4 s, on a speed with the delay of the report. It is
# renewed once a host cycle and held between.


_BANDWIDTH_RAD_S = 0.2 / 0.4
_LEAST_DELAY_S = 0.005


@dataclass(frozen=True)
class SimulatedShaft:
    """True motion, (steps, runs): speed in rad/s, torque at the shaft in N·m; row n at n·step_s."""

    speed: FloatArray
    torque: FloatArray
    step_s: float


def lag_weights(step_s: float, lag_s: float) -> tuple[float, float, float]:
    """Return a, g₀, g₁ of the recursion for a first-order lag."""
    h = step_s / lag_s
    a, gone = float(np.exp(-h)), float(-np.expm1(-h))
    return a, gone / h - a, 1.0 - gone / h


def coloured(white: FloatArray, step_s: float, time_s: float) -> FloatArray:
    """Return noise of unit variance, correlation e^(−|t|/time_s), stationary from the first row; ``white`` (steps,
    runs).
    """
    from scipy.signal import lfilter

    keep = float(np.exp(-step_s / time_s))
    drive = white * np.sqrt(1.0 - keep * keep)
    drive[0] = white[0]
    found: FloatArray = lfilter([1.0], [1.0, -keep], drive, axis=0)
    return found


def turn(plant: CoveragePlant, motion: SimulatedMotion, load: FloatArray, ripple: FloatArray) -> SimulatedShaft:
    """Step the shaft; ``load`` and ``ripple`` (steps, runs), N·m. Raises ValueError if the speed reaches zero."""
    step = motion.step_s
    keep, early, late = lag_weights(step, plant.inertia_kg_m2 / plant.viscous_nm_s_rad)
    early, late = early / plant.viscous_nm_s_rad, late / plant.viscous_nm_s_rad
    stay = float(np.exp(-step / plant.motor_lag_s))
    seen_stay = float(np.exp(-step / max(plant.speed_report.total_delay_s, _LEAST_DELAY_S)))
    held = max(1, round(plant.reading.command_s / step))
    proportional = motion.rough * _BANDWIDTH_RAD_S
    integral_step = proportional * (_BANDWIDTH_RAD_S / 4.0) * held * step
    steps, runs = motion.target.shape
    speed, torque = np.empty((steps, runs)), ripple
    # to save memory, ``torque`` replaces the ripple from here on, and ``push`` the load
    push = load
    push -= plant.coulomb_nm
    omega, motor = motion.target[0].copy(), motion.feed[0].copy()
    seen, integral, command = omega.copy(), np.zeros(runs), motor.copy()
    torque[0] += motor
    push[0] += torque[0]
    if plant.bend is not None:
        push[0] -= plant.bend.torque(omega)
    speed[0] = omega
    limit = plant.torque_limit_nm
    for n in range(steps - 1):
        if n % held == 0:
            error = motion.target[n] - seen
            integral += integral_step * error
            command = np.clip(motion.feed[n] + proportional * error + integral, -limit, limit)
            pulled = (1.0 - stay) * command
        seen *= seen_stay
        seen += (1.0 - seen_stay) * omega
        motor *= stay
        motor += pulled
        torque[n + 1] += motor
        push[n + 1] += torque[n + 1]
        if plant.bend is not None:
            push[n + 1] -= plant.bend.torque(omega + (omega - speed[n - 1] if n else 0.0))
        omega = keep * omega
        omega += early * push[n]
        omega += late * push[n + 1]
        speed[n + 1] = omega
    if speed.min() <= 0.0:
        raise ValueError(f"{plant.name}: the speed reaches zero, where Coulomb friction is not constant")
    return SimulatedShaft(speed, torque, step)


# ---------------------------------------------------------------------------------------------------------------------

def simulate(plant: CoveragePlant, seeds: list[tuple[int, ...]], periods: int) -> list[Recording]:
    """Return one recording per seed (a tuple of whole numbers ≥ 0)."""
    streams = [np.random.default_rng(np.random.SeedSequence(seed)) for seed in seeds]
    guesses = [rough_guess(plant, stream.uniform(-1.0, 1.0, 2)) for stream in streams]
    asked = motion(plant, guesses, periods)
    noise, steps = plant.noise, len(asked.target)
    load = noise.load_nm * coloured(_white(streams, steps), asked.step_s, noise.load_time_s)
    shaft = turn(plant, asked, load, noise.ripple_nm * _white(streams, steps))
    sensed = _white(streams, steps)
    sensed *= noise.sensor_rad_s
    sensed += shaft.speed
    speed = lagged(sensed, plant.speed_report, shaft.step_s)
    torque = lagged(shaft.torque, plant.torque_report, shaft.step_s)
    return [
        read(plant, asked, run, SimulatedShaft(speed[:, run], torque[:, run], shaft.step_s), stream)
        for run, stream in enumerate(streams)
    ]


def quiet_shaft(plant: CoveragePlant, shares: FloatArray, periods: int) -> tuple[SimulatedMotion, SimulatedShaft]:
    """Return the motion without noise, for rough inertias wrong by ``shares`` (runs,) of the largest error."""
    asked = motion(plant, [rough_guess(plant, np.array([share, 0.0])) for share in shares], periods)
    return asked, turn(plant, asked, np.zeros_like(asked.target), np.zeros_like(asked.target))


def _white(streams: list[np.random.Generator], steps: int) -> FloatArray:
    """Return standard normal noise, (steps, runs), every run from its own stream."""
    found = np.empty((steps, len(streams)))
    for run, stream in enumerate(streams):
        found[:, run] = stream.standard_normal(steps)
    return found


def lagged(signal: FloatArray, report: ReportFilter, step_s: float) -> FloatArray:
    """Return the signal behind the poles of a report, exact for inputs that are straight between steps; (steps,
    runs).
    """
    from scipy.signal import lfilter

    for lag in report.lags_s:
        keep, early, late = lag_weights(step_s, lag)
        signal, _ = lfilter([late, early], [1.0, -keep], signal, axis=0, zi=signal[:1] * (1.0 - late))
    return signal


def shown(signal: FloatArray, report: ReportFilter, step_s: float, at_s: FloatArray) -> FloatArray:
    """Return one signal (steps,), already behind its poles, at its own instants: moving average and delay."""
    grid = np.arange(len(signal)) * step_s
    when = at_s - report.delay_s
    if report.average_s <= 0.0:
        return np.interp(when, grid, signal)
    area = np.concatenate(([0.0], np.cumsum(0.5 * (signal[1:] + signal[:-1]) * step_s)))
    before = when - report.average_s
    began = np.minimum(before, 0.0) * signal[0]      # before the first row the signal was constant
    mean: FloatArray = (np.interp(when, grid, area) - np.interp(before, grid, area) - began) / report.average_s
    return mean


def read(
    plant: CoveragePlant, asked: SimulatedMotion, run: int, shaft: SimulatedShaft, stream: np.random.Generator
) -> Recording:
    """Sample one run as its host would; ``shaft``: signals (steps,) of that run behind the poles of the reports."""
    reading, noise, step = plant.reading, plant.noise, shaft.step_s
    end = (len(shaft.speed) - 1) * step - 0.1
    instants = np.arange(0.1, end, 1.0 / reading.rate_hz)
    instants = instants + stream.uniform(-reading.jitter_s, reading.jitter_s, len(instants))
    speed = shown(shaft.speed, plant.speed_report, step, instants + reading.speed_after_s)
    torque = shown(shaft.torque, plant.torque_report, step, instants + reading.torque_after_s)
    speed = _rounded(
        speed + noise.reported_speed_rad_s * stream.standard_normal(len(speed)), noise.speed_quantum_rad_s
    )
    torque = _rounded(torque + noise.reported_torque_nm * stream.standard_normal(len(torque)), noise.torque_quantum_nm)
    fresh = stream.random(len(speed)) >= reading.dropped
    fresh[0] = True
    newest = np.maximum.accumulate(np.where(fresh, np.arange(len(fresh)), 0))   # a stale sample repeats the last
    stamps = instants + stream.uniform(-reading.stamp_error_s, reading.stamp_error_s, len(instants))
    return Recording(
        time_s=stamps,
        speed_rad_s=speed[newest],
        torque_nm=torque[newest],
        fresh=fresh,
        limited=np.zeros(len(speed), dtype=np.bool_),
        excitation=Excitation("multisine", "torque", asked.segments[run]),
        speed_resolution_rad_s=noise.speed_quantum_rad_s,
        torque_resolution_nm=noise.torque_quantum_nm,
        torque_limit_nm=plant.torque_limit_nm,
        simulated=True,
    )


def _rounded(signal: FloatArray, quantum: float) -> FloatArray:
    return np.round(signal / quantum) * quantum if quantum > 0.0 else signal


# ---------------------------------------------------------------------------------------------------------------------
# Runs of the benchmark: simulated, identified, each stored as a line; by several processes if requested.
#
# A run is identified by (base seed, plant, number) and has its own random stream. The totals therefore depend neither
# on the number of processes nor on the grouping of the runs.


GROUP = 20     # runs simulated together; they need some 200 MB


@dataclass(frozen=True)
class SimulatedRun:
    """Identification of one run; ``value``, ``low``, ``high`` in kg·m², None without a number."""

    plant: str
    number: int
    seconds: float
    verdict: str
    reason: str
    value: float | None = None
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True)
class SimulationTask:
    """Runs ``first`` … ``first + count − 1`` of one plant."""

    plant: CoveragePlant
    first: int
    count: int
    base_seed: int
    periods: int
    confidence: float


def tasks(
    plants: Iterable[CoveragePlant], seeds: int, base_seed: int, periods: int, confidence: float
) -> list[SimulationTask]:
    """Return every plant's runs in groups."""
    return [
        SimulationTask(plant, first, min(GROUP, seeds - first), base_seed, periods, confidence)
        for plant in plants
        for first in range(0, seeds, GROUP)
    ]


def run_task(task: SimulationTask) -> tuple[SimulatedRun, ...]:
    """Simulate and identify one group."""
    own = zlib.crc32(task.plant.name.encode())      # by name, so that a plant's runs do not depend on the other plants
    numbers = range(task.first, task.first + task.count)
    recordings = simulate(task.plant, [(task.base_seed, own, number) for number in numbers], task.periods)
    options = Options(confidence=task.confidence)
    found = []
    for number, recording in zip(numbers, recordings, strict=True):
        said = identify(recording, options)
        seconds = float(recording.time_s[-1] - recording.time_s[0])
        run = SimulatedRun(task.plant.name, number, seconds, said.verdict.value, said.reason)
        if said.inertia is not None:
            inertia = said.inertia
            run = SimulatedRun(*_head(run), float(inertia.value), float(inertia.low), float(inertia.high))
        found.append(run)
    return tuple(found)


def _head(run: SimulatedRun) -> tuple[str, int, float, str, str]:
    return run.plant, run.number, run.seconds, run.verdict, run.reason


def run_all(wanted: list[SimulationTask], processes: int) -> Iterator[tuple[SimulatedRun, ...]]:
    """Yield groups when they are done, in no particular order. An interruption drops unfinished groups.

    Raises TdhilError if one of several processes died with a task: the benchmark is then incomplete.
    """
    if processes <= 1:
        yield from map(run_task, wanted)
        return

    with Pool(run_task, min(processes, len(wanted)), TaskLimits(None, None)) as pool:
        for task, result in pool.run(wanted):
            if isinstance(result, Loss):
                raise TdhilError(
                    f"a process that worked for it died: {result.text}", where=f"plant {task.plant.name}",
                    next_step="If memory was short, let fewer of them work at a time, such as --set processes=1",
                    entry=MessageCode.WORKER_PROCESS_LOST,
                )
            yield result
