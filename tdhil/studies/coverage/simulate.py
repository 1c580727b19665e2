"""From a plant and seeds to recordings. Every run has its own random stream: how runs are grouped changes nothing."""

from __future__ import annotations

import numpy as np

from tdhil.recording.recording import Excitation, Recording
from tdhil.studies.coverage.plants import CoveragePlant, FloatArray, Report
from tdhil.study.coverage_motion import Motion, motion, rough_guess
from tdhil.study.coverage_shaft import Shaft, coloured, lag_weights, turn


def simulate(plant: CoveragePlant, seeds: list[tuple[int, ...]], periods: int) -> list[Recording]:
    """One recording per seed (a tuple of whole numbers, none of them negative)."""
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
        read(plant, asked, run, Shaft(speed[:, run], torque[:, run], shaft.step_s), stream)
        for run, stream in enumerate(streams)
    ]


def quiet_shaft(plant: CoveragePlant, shares: FloatArray, periods: int) -> tuple[Motion, Shaft]:
    """What would happen without any noise, for rough inertias wrong by ``shares`` (runs,) of the largest error."""
    asked = motion(plant, [rough_guess(plant, np.array([share, 0.0])) for share in shares], periods)
    return asked, turn(plant, asked, np.zeros_like(asked.target), np.zeros_like(asked.target))


def _white(streams: list[np.random.Generator], steps: int) -> FloatArray:
    """Standard normal, (steps, runs), every run from its own stream."""
    found = np.empty((steps, len(streams)))
    for run, stream in enumerate(streams):
        found[:, run] = stream.standard_normal(steps)
    return found


def lagged(signal: FloatArray, report: Report, step_s: float) -> FloatArray:
    """The poles of a report, exact for inputs that are straight between steps; (steps, runs), settled at the start."""
    from scipy.signal import lfilter

    for lag in report.lags_s:
        keep, early, late = lag_weights(step_s, lag)
        signal, _ = lfilter([late, early], [1.0, -keep], signal, axis=0, zi=signal[:1] * (1.0 - late))
    return signal


def shown(signal: FloatArray, report: Report, step_s: float, at_s: FloatArray) -> FloatArray:
    """One signal (steps,), its poles passed already, at instants of its own: moving average and delay."""
    grid = np.arange(len(signal)) * step_s
    when = at_s - report.delay_s
    if report.average_s <= 0.0:
        return np.interp(when, grid, signal)
    area = np.concatenate(([0.0], np.cumsum(0.5 * (signal[1:] + signal[:-1]) * step_s)))
    before = when - report.average_s
    began = np.minimum(before, 0.0) * signal[0]      # before the first row the signal stood still
    mean: FloatArray = (np.interp(when, grid, area) - np.interp(before, grid, area) - began) / report.average_s
    return mean


def read(plant: CoveragePlant, asked: Motion, run: int, shaft: Shaft, stream: np.random.Generator) -> Recording:
    """Sample one run as its host would; ``shaft`` holds that run's signals (steps,) behind the poles of the reports."""
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
