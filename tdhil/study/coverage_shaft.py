"""The shaft of the benchmark, many runs at once, in fine steps.

Between two steps every input is taken as a straight line; for that, a first-order lag y' = (u − y)/τ has the exact
recursion, with h = step/τ and a = e^(−h),

    y₁ = a y₀ + g₀ u₀ + g₁ u₁,   g₀ = (1 − a)/h − a,   g₁ = 1 − (1 − a)/h.

The shaft is such a lag of u = (T + load − T_c)/B with τ = J/B (positive speed, so that T_c is constant). A bend of
friction is part of u: known at the step's beginning, and at its end from the last two speeds by a straight line. The
motor follows its command through a short lag. The command is feed-forward from the rough inertia plus a slow PI on the
mean speed, K_p = Ĵ ω_b, K_i = K_p ω_b/4, ω_b = 0.2/0.4 s, on a speed that is as late as the report's delay; it is
renewed once a host cycle and held between.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tdhil.studies.coverage.plants import CoveragePlant, FloatArray
from tdhil.study.coverage_motion import Motion

_BANDWIDTH_RAD_S = 0.2 / 0.4
_LEAST_DELAY_S = 0.005


@dataclass(frozen=True)
class Shaft:
    """What truly happened, (steps, runs): speed in rad/s, torque at the shaft in N·m; row n at n·step_s."""

    speed: FloatArray
    torque: FloatArray
    step_s: float


def lag_weights(step_s: float, lag_s: float) -> tuple[float, float, float]:
    """a, g₀, g₁ of the recursion above."""
    h = step_s / lag_s
    a, gone = float(np.exp(-h)), float(-np.expm1(-h))
    return a, gone / h - a, 1.0 - gone / h


def coloured(white: FloatArray, step_s: float, time_s: float) -> FloatArray:
    """Unit variance, correlation e^(−|t|/time_s), stationary from the first row; ``white`` (steps, runs)."""
    from scipy.signal import lfilter

    keep = float(np.exp(-step_s / time_s))
    drive = white * np.sqrt(1.0 - keep * keep)
    drive[0] = white[0]
    found: FloatArray = lfilter([1.0], [1.0, -keep], drive, axis=0)
    return found


def turn(plant: CoveragePlant, motion: Motion, load: FloatArray, ripple: FloatArray) -> Shaft:
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
    # from here on ``torque`` takes the ripple's place, and ``push`` the load's: nothing is stored twice
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
    return Shaft(speed, torque, step)
