r"""Error of J if torque is sampled in step with a stepped setpoint.

In speed mode the setpoint of the host is a staircase with a step a cycle. The drive reacts to each step with a torque
pulse that decays. Torque and speed are read once a cycle, always at the same moment after the step. The readings of the
pulses then form a sum, while the shaft received the integral. For a steady acceleration, and for any slow motion,

    J_read/J = Σ_n T g(ε + n T),        ∫g dt = 1,

with the cycle T, the moment ε, and g, the response of acceleration to a unit step of the setpoint (the impulse response
of the speed's following H), filtered by the lag of the torque report. Nothing in the recording shows this error: the
readings are exactly those of a shaft with another inertia. It vanishes if a cycle is short compared with the lags; at
10 Hz it is a few percent. For J of stage 5 in speed mode ε is unknown, so the interval is widened for the worst ε.

In torque mode the response of the shaft to a step of torque is smooth. Sampling then acts as a delay of the torque,
which is a parameter of the fit. A torque that is held for a cycle acts on average T/2 later than it was set; it is read
ε after it was set. The fit therefore finds a time offset (skew) of ε − T/2, less the drive's own torque lag, between
the reports, although both registers belong to one moment. This skew gives ε, and with it the error of the ramps of the
same run in speed mode.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from profiles import CodedText, MessageCode
from tdhil.estimation.case import Finding
from tdhil.estimation.result import BudgetLine
from tdhil.estimation.spectrum import ComplexArray
from tdhil.recording import FloatArray, Recording, SteppedSetpoint

NEGLIGIBLE = 1e-3         # share of J
_FINE = 32                # grid steps of a cycle
_MOST = 0.5               # share of J; a larger error gives no number


def stretched(finding: Finding, recording: Recording) -> Finding:
    """Return the finding with the possible error of J, if the recording states a slowly stepped setpoint."""
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
        warnings=(*finding.warnings, CodedText(
            f"{note}. This alone may change J by {100 * share:.1f} %",
            MessageCode.STEPPED_SETPOINT)),
    )


def worst_share(stepped: SteppedSetpoint, torque_lag_s: float) -> float:
    """Return |J_read/J − 1| for the worst moment of reading, at most 0.5."""
    worst = float(np.max(np.abs(_shares(stepped, torque_lag_s))))
    return min(worst, _MOST) if math.isfinite(worst) else _MOST


def _shares(stepped: SteppedSetpoint, torque_lag_s: float) -> FloatArray:
    """Return J_read/J − 1 (_FINE + 1,) at the moments 0 to T after a step; all are infinite for an unstable response.

    With g = Σ r_i e^(p_i t), the sum over the cycles is a geometric series: Σ_n g(ε + n T) = Σ r_i e^(p_i ε)/(1 −
    e^(p_i T)).
    """
    poles, residues = _response(stepped, torque_lag_s)
    period_s = stepped.period_s
    if not np.all(poles.real < 0.0):
        return np.full(_FINE + 1, math.inf)
    after_s = np.arange(_FINE + 1) / _FINE * period_s
    series = residues / -np.expm1(poles * period_s)
    every: FloatArray = period_s * (np.exp(np.multiply.outer(after_s, poles)) @ series).real - 1.0
    return every


# ---------------------------------------------------------------------------------------------------------------------
# Error of J from reading in step, if the skew shows the moment of reading.


@dataclass(frozen=True)
class ReadingShare:
    """J_read/J − 1 and its standard deviation."""

    value: float
    sd: float


EXACT_READING = ReadingShare(0.0, 0.0)

_ONE_FRAME_SD_S = 0.002
"""Standard deviation of the time between registers of one reply: one task of the drive, 1 to 4 ms in the profiles'
manuals.
"""


@dataclass(frozen=True)
class ReadMoment:
    """Skew between the reports of torque and speed in torque mode, its standard deviation, and the torque's lag; s."""

    skew_s: float
    skew_sd_s: float
    torque_lag_s: float


def reading_share(
    loops: Sequence[SteppedSetpoint], moment: ReadMoment | None, torque_lag_s: float = 0.0
) -> ReadingShare:
    """Return the share over the moments of reading that the skew allows, and over ``loops``, which are equally likely.

    Without a skew every moment of a cycle is equally likely, and the mean share is 0. An unstable loop may add any
    share. ``torque_lag_s``: lag of the torque report, used if ``moment`` is None.
    """
    lag_s = torque_lag_s if moment is None else moment.torque_lag_s
    shares, weights = [], []
    for stepped in loops:
        ends = _shares(stepped, lag_s)
        if not np.all(np.isfinite(ends)):
            return ReadingShare(0.0, _MOST)
        ends = np.clip(ends, -_MOST, _MOST)
        shares.append(0.5 * (ends[1:] + ends[:-1]))
        weights.append(np.ones(_FINE) / _FINE if moment is None else _likely(stepped.period_s, moment))
    share, weight = np.concatenate(shares), np.concatenate(weights) / len(loops)
    mean = float(weight @ share)
    sd = math.sqrt(float(weight @ (share - mean) ** 2))
    return ReadingShare(mean, sd) if max(abs(mean), sd) >= NEGLIGIBLE else EXACT_READING


def _likely(period_s: float, moment: ReadMoment) -> FloatArray:
    """Return the probability (_FINE,) of each part of a cycle as the moment of reading. Their sum is 1.

    A staircase with a lag τ, read ε after its steps, has the skew ε − T/2 − τ + T Σ e^(−(ε + nT)/τ), n ≥ 0.
    """
    at = (np.arange(_FINE) + 0.5) / _FINE * period_s
    skew = at - 0.5 * period_s
    lag_s = moment.torque_lag_s
    if lag_s > 1e-3 * period_s:
        skew = skew - lag_s + period_s * np.exp(-at / lag_s) / -math.expm1(-period_s / lag_s)
    apart = np.remainder(skew - moment.skew_s + 0.5 * period_s, period_s) - 0.5 * period_s
    sd = math.hypot(moment.skew_sd_s, _ONE_FRAME_SD_S, period_s / _FINE)
    exponent = -0.5 * (apart / sd) ** 2
    weight: FloatArray = np.exp(exponent - np.max(exponent))
    return weight / float(np.sum(weight))


_CROSSOVER_RAD_S = 5.0
"""Bandwidth of a fast speed loop of a top drive, for a drive with an unknown loop. A faster loop reacts to a step
more sharply. For simulated drives of all profiles the error is below half of the value from this bandwidth."""


_SHARES_OF_CROSSOVER = (0.2, 0.4, 0.6, 0.8, 1.0)   # crossovers of usual loops over the bandwidth, from slow to fast


def usual_loops(period_s: float) -> tuple[SteppedSetpoint, ...]:
    """Return PI loops with a double pole at half their crossover, from slow to fast, with one step per ``period_s``."""
    loops = []
    for share in _SHARES_OF_CROSSOVER:
        first_s = 4.0 / (share * _CROSSOVER_RAD_S)
        loops.append(SteppedSetpoint(period_s, first_s, first_s, first_s / (share * _CROSSOVER_RAD_S)))
    return tuple(loops)


def _response(stepped: SteppedSetpoint, lag_s: float) -> tuple[ComplexArray, ComplexArray]:
    """Return poles p (R,), 1/s, and residues r (R,), 1/s, of g: (1 + b s)/((1 + a₁ s + a₂ s²)(1 + τ s))."""
    # a lag as short as a step of the grid counts as none, and two poles must not coincide
    poles = np.roots([stepped.second_s2, stepped.first_s, 1.0])
    if abs(poles[0] - poles[1]) < 1e-3 * abs(poles[0]):
        poles = poles * np.array([0.999, 1.001])
    gain = 1.0 / stepped.second_s2
    if lag_s > stepped.period_s / _FINE:
        fast = -1.0 / lag_s
        if np.min(np.abs(poles - fast)) < 1e-3 * abs(fast):
            fast *= 1.003
        gain *= -fast
        poles = np.append(poles, fast)
    residues = [gain * (1.0 + stepped.zero_s * pole) / np.prod(pole - np.delete(poles, index))
                for index, pole in enumerate(poles)]
    return poles.astype(np.complex128), np.array(residues, dtype=np.complex128)
