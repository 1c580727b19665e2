r"""Torque that is sampled in step with a stepped setpoint, and what that may do to J.

In speed mode the host's setpoint is a staircase, a step a cycle, and the drive answers each step with a surge of torque
that dies away. Torque and speed are read once a cycle, always at the same moment after the step. What is read of the
surges is then a sum where the shaft got the integral: for a steady acceleration, and so for any slow motion,

    J_read/J = Σ_n T g(ε + n T),        ∫g dt = 1,

T the cycle, ε the moment, g the answer of acceleration to a unit step of the setpoint (the impulse response of the
speed's following H) as the torque report's lag leaves it. Nothing in the record tells: the reading is exactly that of a
shaft with another inertia. It vanishes where a cycle is short beside the lags; at 10 Hz it is some percent. ε is not
known, so the worst one is taken, and the interval stretched by it. (In torque mode the shaft's answer to a step of
torque is smooth, and what sampling does to torque is a delay, which is a parameter of the fit.)
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from tdhil.estimation.case import Finding
from tdhil.estimation.result import BudgetLine
from tdhil.recording import FloatArray, Recording, SteppedSetpoint

NEGLIGIBLE = 1e-3         # of J
_FINE = 32                # steps of a cycle
_LONGEST_S = 40.0
_MOST = 0.5               # of J: beyond it there is no number


def stretched(finding: Finding, recording: Recording) -> Finding:
    """The finding with what stepping may do to J, where the recording says that the setpoint was stepped slowly."""
    stepped, inertia = recording.stepped_setpoint, finding.inertia
    if stepped is None or inertia is None:
        return finding
    lag_s = 0.0 if finding.torque_lag_s is None else max(finding.torque_lag_s.low, 0.0)
    share = worst_share(stepped, lag_s)
    if share < NEGLIGIBLE:
        return finding
    half = share * inertia.value
    note = f"torque is read once in {1e3 * stepped.period_s:.3g} ms, in step with the setpoint that moves the drive"
    budget = (*finding.budget, BudgetLine("stepped setpoint", half, note)) if finding.budget else finding.budget
    finding = replace(finding, reading_kg_m2=half, budget=budget)
    if half <= 0.5 * (inertia.high - inertia.low):
        return finding
    return replace(
        finding,
        advice="shorten the cycle (baud rate, function 23, TCP), or use a drive's torque mode",
        warnings=(*finding.warnings, f"{note}: J may be off by {share:.1%} for that alone"),
    )


def worst_share(stepped: SteppedSetpoint, torque_lag_s: float) -> float:
    """|J_read/J − 1| at the worst moment of reading, at most a half."""
    _, answer = _answer(stepped, torque_lag_s)
    sums = stepped.period_s * answer.reshape(-1, _FINE).sum(axis=0)
    # Just before a step all is as at the step itself, but for the answer's own first moment.
    every = np.append(sums, sums[0] - stepped.period_s * answer[0])
    worst = float(np.max(np.abs(every - 1.0)))
    return min(worst, _MOST) if math.isfinite(worst) else _MOST


_CROSSOVER_RAD_S = 5.0
"""Of a quick speed loop of a top drive, for a drive whose loop is not known: the quicker the loop, the sharper torque
answers a step. Simulated drives of all profiles stay below half of what follows from it."""


def usual_following(period_s: float) -> SteppedSetpoint:
    """A PI loop with a double pole at half its crossover, with a setpoint that is stepped once in ``period_s``."""
    first_s = 4.0 / _CROSSOVER_RAD_S
    return SteppedSetpoint(period_s, first_s, first_s, first_s / _CROSSOVER_RAD_S)


def _answer(stepped: SteppedSetpoint, lag_s: float) -> tuple[FloatArray, FloatArray]:
    """Times (N,), _FINE a cycle, and g there, 1/s: (1 + b s)/((1 + a₁ s + a₂ s²)(1 + τ s)) by its poles."""
    step = stepped.period_s / _FINE
    count = math.ceil(_LONGEST_S / stepped.period_s) * _FINE
    time = np.asarray(np.arange(count) * step, dtype=np.float64)
    # A lag as short as a step of the grid is none, nor may two poles meet.
    poles = np.roots([stepped.second_s2, stepped.first_s, 1.0])
    if abs(poles[0] - poles[1]) < 1e-3 * abs(poles[0]):
        poles = poles * np.array([0.999, 1.001])
    gain = 1.0 / stepped.second_s2
    if lag_s > step:
        fast = -1.0 / lag_s
        if np.min(np.abs(poles - fast)) < 1e-3 * abs(fast):
            fast *= 1.003
        gain *= -fast
        poles = np.append(poles, fast)
    parts = []
    for index, pole in enumerate(poles):
        residue = gain * (1.0 + stepped.zero_s * pole) / np.prod(pole - np.delete(poles, index))
        parts.append((residue * np.exp(pole * time)).real)
    answer: FloatArray = np.sum(np.array(parts, dtype=np.float64), axis=0)
    return time, answer
