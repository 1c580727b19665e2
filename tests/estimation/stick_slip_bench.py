"""Records of a shaft in stick-slip: Stribeck friction, and a PI speed loop that is too soft to hold the speed.

It shares no code with the tested code. Many records are stepped together. A sticking shaft is exactly at standstill.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from tdhil.recording.recording import Recording
from tests.estimation.reporting import recorded

INERTIAS_KG_M2 = (0.02, 0.1, 0.35, 1.0, 4.0, 15.0, 50.0, 104.0, 500.0)
SEEDS_EACH = 12                # 108 records in all
LENGTH = 60.0                  # of a record, in units of its pace
STEP = 0.001


@dataclass(frozen=True)
class StickSlip:
    """Shaft in SI units at the motor; ``pace_s`` is the unit of time, since a small shaft oscillates faster."""

    inertia_kg_m2: float
    seed: int
    pace_s: float
    coulomb_nm: float
    breakaway_nm: float        # Stribeck friction at standstill
    stribeck_rad_s: float
    viscous_nm_s_rad: float
    gain_nm_s_rad: float
    integral_nm_rad: float
    speed_lag_s: float
    torque_lag_s: float
    rate_hz: float


def draw(inertia_kg_m2: float, seed: int) -> StickSlip:
    """Return the shaft with this inertia and seed."""
    rng = np.random.default_rng([seed, round(1e3 * inertia_kg_m2)])
    pace = float(np.clip(0.3 + 0.25 * (np.log10(inertia_kg_m2) + 2.0), 0.2, 1.5))
    stribeck = rng.uniform(0.5, 3.0) / pace
    coulomb = inertia_kg_m2 * stribeck / pace * rng.uniform(0.5, 3.0)
    breakaway = coulomb * rng.uniform(1.3, 2.5)
    # too soft: less than the fall of friction with speed; it needs seconds to reach the breakaway torque
    gain = (breakaway - coulomb) / stribeck * rng.uniform(0.05, 0.5)
    integral = breakaway / (0.3 * stribeck * pace * rng.uniform(1.0, 5.0))
    return StickSlip(
        inertia_kg_m2, seed, pace, coulomb, breakaway, stribeck, coulomb / stribeck * rng.uniform(0.0, 0.05), gain,
        integral, rng.uniform(0.01, 0.2) * pace, rng.uniform(0.01, 0.1) * pace, float(rng.choice([50.0, 100.0])) / pace,
    )


def every_shaft() -> list[StickSlip]:
    return [draw(inertia, seed) for inertia in INERTIAS_KG_M2 for seed in range(SEEDS_EACH)]


def simulate(shafts: list[StickSlip]) -> list[Recording]:
    """Return one record per shaft. The set speed changes between a few low values, in steps or ramps."""
    many, count = len(shafts), round(LENGTH / STEP)
    rngs = [np.random.default_rng([shaft.seed, 7, round(1e3 * shaft.inertia_kg_m2)]) for shaft in shafts]

    def of(name: str) -> np.ndarray:
        return np.array([getattr(shaft, name) for shaft in shafts])

    inertia, pace, coulomb, breakaway = of("inertia_kg_m2"), of("pace_s"), of("coulomb_nm"), of("breakaway_nm")
    width, viscous = of("stribeck_rad_s"), of("viscous_nm_s_rad")
    gain, integral = of("gain_nm_s_rad"), of("integral_nm_rad")
    dt = STEP * pace
    target = np.stack([_target(shaft, rng, count) for shaft, rng in zip(shafts, rngs, strict=True)], axis=1)
    noise = np.stack([rng.standard_normal(count) for rng in rngs], axis=1) * 0.02 * coulomb
    speed, torque = np.empty((count, many)), np.empty((count, many))
    omega, wound = np.zeros(many), 0.5 * breakaway
    for n in range(count):
        error = target[n] - omega
        wound = wound + integral * error * dt
        push = gain * error + wound
        force = push + noise[n]
        way = np.where(omega != 0.0, np.sign(omega), np.sign(force))
        stuck = (omega == 0.0) & (np.abs(force) <= breakaway)
        friction = way * (coulomb + (breakaway - coulomb) * np.exp(-((omega / width) ** 2))) + viscous * omega
        after = omega + dt / inertia * (force - friction)
        stops = (after * way < 0.0) & (np.abs(force) <= breakaway)
        omega = np.where(stuck | stops, 0.0, after)
        speed[n], torque[n] = omega, push
    return [
        _reported(shaft, rng, speed[:, k], torque[:, k])
        for k, (shaft, rng) in enumerate(zip(shafts, rngs, strict=True))
    ]


def _target(shaft: StickSlip, rng: np.random.Generator, count: int) -> np.ndarray:
    time = np.arange(count) * STEP
    edges = np.cumsum(rng.uniform(6.0, 15.0, 12))
    levels = shaft.stribeck_rad_s * rng.uniform(0.05, 0.6, 13)
    if rng.random() < 0.5:
        return np.asarray(np.interp(time, np.concatenate([[0.0], edges]), levels))
    return np.asarray(levels[np.searchsorted(edges, time)])


def _reported(shaft: StickSlip, rng: np.random.Generator, speed: np.ndarray, torque: np.ndarray) -> Recording:
    dt = STEP * shaft.pace_s
    seen = []
    for signal, lag in ((speed, shaft.speed_lag_s), (torque, shaft.torque_lag_s)):
        keep = np.exp(-dt / lag)
        seen.append(lfilter([1.0 - keep], [1.0, -keep], signal))
    each = max(1, round(1.0 / (shaft.rate_hz * dt)))
    speed, torque = seen[0][::each], seen[1][::each]
    q_w, q_t = 0.002 * float(np.max(np.abs(speed))), 0.002 * float(np.max(np.abs(torque)))
    speed = speed + q_w * 0.5 * rng.standard_normal(len(speed))
    torque = torque + 2.0 * q_t * rng.standard_normal(len(torque))
    return recorded(
        np.arange(len(speed)) * each * dt, np.round(speed / q_w) * q_w, np.round(torque / q_t) * q_t,
        speed_resolution_rad_s=q_w, torque_resolution_nm=q_t,
    )
