r"""Response of the motor's speed to a step of the speed setpoint, and its figures.

The model has the state equations of controller, notch, dead time (Padé approximation of second order), lags and shaft
in series, with the speed filter in the feedback. The first lag of `LoopPlant.lags_s` filters the speed;
the others act on the torque.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi

import numpy as np

from tdhil.speed_loop.loop import LoopPlant, PiGains, Reals

_SYSTEM = tuple[Reals, Reals, Reals, float]
"""A, B, C and D of a system with one input and one output."""
SETTLED_SHARE = 0.05
"""Band about the new setpoint in which the speed counts as settled, as a share of the step."""
_STEPS = 1500


@dataclass(frozen=True)
class StepFigures:
    """Overshoot, rise and settling of one response."""

    overshoot_share: float
    rise_s: float
    """Time from 10 to 90 % of the step; infinite if 90 % is not reached."""
    settling_s: float
    """Time until the speed stays within `SETTLED_SHARE`; infinite if it does not."""


def _series(first: _SYSTEM, second: _SYSTEM) -> _SYSTEM:
    a, b, c, d = first
    e, f, g, h = second
    size, more = len(a), len(e)
    joined = np.zeros((size + more, size + more))
    joined[:size, :size], joined[size:, size:], joined[size:, :size] = a, e, np.outer(f, c)
    return joined, np.concatenate([b, f * d]), np.concatenate([h * c, g]), h * d


def _gain(value: float) -> _SYSTEM:
    return np.zeros((0, 0)), np.zeros(0), np.zeros(0), value


def _lag(tau_s: float) -> _SYSTEM:
    if tau_s <= 0.0:
        return _gain(1.0)
    return np.array([[-1.0 / tau_s]]), np.array([1.0 / tau_s]), np.array([1.0]), 0.0


def _second_order(over: tuple[float, float, float], under: tuple[float, float]) -> _SYSTEM:
    """Return the system (n₂ s² + n₁ s + n₀)/(s² + d₁ s + d₀), with states scaled by √d₀."""
    (n2, n1, n0), (d1, d0) = over, under
    omega = d0**0.5
    a = np.array([[0.0, omega], [-omega, -d1]])
    return a, np.array([0.0, omega]), np.array([(n0 - n2 * d0) / d0, (n1 - n2 * d1) / omega]), n2


def _shaft(plant: LoopPlant) -> _SYSTEM:
    inertia, viscous = plant.inertia_kg_m2, plant.viscous_nm_s_rad
    if plant.spring is None:
        return np.array([[-viscous / inertia]]), np.array([1.0 / inertia]), np.array([1.0]), 0.0
    load, k, c = plant.load_kg_m2, plant.stiffness_nm_rad, plant.spring.damping_nm_s_rad
    a = np.array([[-(c + viscous) / inertia, c / inertia, -k / inertia], [c / load, -c / load, k / load],
                  [1.0, -1.0, 0.0]])
    return a, np.array([1.0 / inertia, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]), 0.0


def _controller(gains: PiGains) -> _SYSTEM:
    pi_part: _SYSTEM = (np.zeros((1, 1)), np.array([gains.integral_nm_rad]), np.array([1.0]), gains.gain_nm_s_rad)
    notch = gains.notch
    if notch is None:
        return pi_part
    omega = 2.0 * pi * notch.hertz
    return _series(pi_part, _second_order((1.0, 2.0 * notch.numerator_damping * omega, omega**2),
                                          (2.0 * notch.denominator_damping * omega, omega**2)))


def closed_loop(plant: LoopPlant, gains: PiGains) -> tuple[Reals, Reals, Reals]:
    """Return A, B and C of the closed loop, from speed setpoint to the motor's speed."""
    forward = _controller(gains)
    if plant.dead_time_s > 0.0:
        one, two = 6.0 / plant.dead_time_s, 12.0 / plant.dead_time_s**2
        forward = _series(forward, _second_order((1.0, -one, two), (one, two)))
    for lag in plant.lags_s[1:]:
        forward = _series(forward, _lag(lag))
    forward = _series(forward, _shaft(plant))
    size = len(forward[0])
    a, b, c, _ = _series(forward, _lag(plant.lags_s[0] if plant.lags_s else 0.0))
    out = np.concatenate([forward[2], np.zeros(len(a) - size)])
    return a - np.outer(b, c), b, out


def is_stable_loop(plant: LoopPlant, gains: PiGains) -> bool:
    """Return whether all poles of the closed loop have a negative real part."""
    a, _, _ = closed_loop(plant, gains)
    return bool(np.max(np.linalg.eigvals(a).real) < 0.0)


def step_responses(plants: Sequence[LoopPlant], gains: PiGains, duration_s: float) -> tuple[Reals, Reals]:
    """Return times (N,), s, and the speed of each plant (plant, N) after a unit step of the speed setpoint."""
    speeds = loop_responses([closed_loop(plant, gains) for plant in plants], [duration_s] * len(plants))
    return np.linspace(0.0, duration_s, _STEPS + 1), speeds


def loop_responses(loops: Sequence[tuple[Reals, Reals, Reals]], durations_s: Sequence[float]) -> Reals:
    """Return the responses (loop, N) of closed loops (A, B, C) to a unit step, over their durations; inf: overflow."""
    from scipy.linalg import expm

    speeds = np.zeros((len(loops), _STEPS + 1))
    for size in {len(a) for a, _, _ in loops}:
        rows = [row for row, loop in enumerate(loops) if len(loop[0]) == size]
        whole = np.zeros((len(rows), size + 1, size + 1))
        for at, row in enumerate(rows):
            a, b, _ = loops[row]
            whole[at, :-1, :-1], whole[at, :-1, -1] = a, b
            whole[at] *= durations_s[row] / _STEPS
        state = np.eye(size + 1)[:, -1:]
        with np.errstate(over="ignore", invalid="ignore"):
            move, out = expm(whole), np.array([loops[row][2] for row in rows])
            for at in range(1, _STEPS + 1):
                state = move @ state
                speeds[rows, at] = (out * state[:, :-1, 0]).sum(axis=1)
    speeds[~np.isfinite(speeds)] = np.inf
    return speeds


def step_figures(time_s: Reals, speed: Reals) -> StepFigures:
    """Return overshoot, rise and settling of a response to a unit step."""
    low, high = (_first(time_s, speed, level) for level in (0.1, 0.9))
    outside = np.flatnonzero(np.abs(speed - 1.0) > SETTLED_SHARE)
    if not outside.size:
        settled = 0.0
    elif outside[-1] + 1 >= len(time_s):
        settled = np.inf
    else:
        settled = float(time_s[outside[-1] + 1])
    return StepFigures(max(0.0, float(speed.max()) - 1.0), high - low if high < np.inf else np.inf, settled)


def _first(time_s: Reals, speed: Reals, level: float) -> float:
    at = np.flatnonzero(speed >= level)
    if not at.size:
        return float(np.inf)
    k = int(at[0])
    if k == 0:
        return float(time_s[0])
    share = (level - speed[k - 1]) / (speed[k] - speed[k - 1])
    return float(time_s[k - 1] + share * (time_s[k] - time_s[k - 1]))
