r"""Comparison of small steps of the speed setpoint with the prediction of `tdhil tune speed`. It finds the real gains.

The lag of the reported speed is often longer than the rise time. Therefore a model of loop and report is fitted to the
mean of all steps, and the figures are those of the fitted loop, without the lag of the report.

**Fit.** P and I are free; all other quantities of `step_model.StepModel` have prior knowledge. An up step and the down
step after it make one pair; half their difference is free of offset and slow drift. The scatter between pairs gives
spectrum and covariance of the noise.

**Rows.** Overshoot, rise and settling are compared with their predicted intervals; P and I with the typed values. The
joint coverage of all intervals is 99 %: each has 1 − 0.01/5.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from math import ceil, exp, inf, log, sqrt

import numpy as np
from numpy.typing import NDArray

from tdhil.speed_loop.design import Range
from tdhil.speed_loop.loop import Reals
from tdhil.speed_loop.step import closed_loop, loop_responses, step_figures
from tdhil.speed_loop.step_model import StepCase, StepModel, StepProgram

CONFIDENCE = 0.99
"""Joint coverage of all rows: in at most 1 % of the runs, right gains get the verdict *differs*."""
LIKE_SHARE = 0.3
"""Relative change of P or I that a comparison must be able to detect; otherwise the verdict is cannot_tell."""
UNLIKE_RMS = 0.03
"""Root mean square of the misfit, share of the step, above which the response does not fit the loop's model."""
UNLIKE_P = 0.01
"""Probability below which noise does not explain the misfit."""
ROUNDED_AMPLITUDE, QUIET_AMPLITUDE, FEW_COUNTS = 0.5, 0.87, 50.0
"""Limits of the first harmonic of the rounding error, for steps of fewer counts than `FEW_COUNTS`. Above the first one
(noise of 0.19 counts), the misfit must be that of noise. Above the second one (0.08 counts) the steps tell nothing: all
are rounded alike. Study of rounded and truncated responses of 2 to 100 counts with noise of 0.01 to 0.3 counts: each
wrong verdict is beyond these limits."""
WELL_KNOWN, LEAST_LONGER = 0.16, 1.25
"""Half-width of ln P and ln I at which the interval excludes an error of `LIKE_SHARE`, ln 1.3 = 0.26, although noise
moves it by two standard deviations (a third of the half-width each). The second value is the least factor by which a
longer record must be longer."""
LEAST_PAIRS = 8
"""Smallest number of pairs of steps. With fewer, their scatter is too uncertain."""
_QUANTITIES = ("overshoot_share", "rise_s", "settling_s", "gain_nm_s_rad", "integral_nm_rad")
_TAIL = 0.5 * (1.0 - CONFIDENCE) / len(_QUANTITIES)    # probability beyond one end of an interval
_REACH = 2.85              # sd of a normal distribution that the ends of `_DRAWS` draws reach on average, at `_TAIL`
_DRAWS, _LEAST_KEPT = 400, 40
"""Number of random draws of the fitted loop, for the intervals of its figures, and the likeliest that always count."""
_EXCLUDED = 31.3
"""Rise of the fit's cost from which the response excludes a draw: 99.9 % quantile of χ² with 11 degrees of freedom."""
_SHUFFLES = 300            # random sign changes of the pairs, for the probability of the misfit
_LEAST_SD, _WHITE_SHARE = 1e-9, 1e-3
"""Least noise of the mean response, as a share of the step, and least white part of its power."""
_MOST_SAMPLES = 1500       # whose correlation is computed; its time grows with the third power
_ROUNDS = 12               # iterations of the fit
_LARGEST_MOVE = 0.4
"""Largest change of ln P and ln I in one iteration."""
_SPAN = 30.0
"""Length of the fitted step response, in units of J/P."""
_SLOPE = 1e-4
"""Relative step of the derivatives."""


class StepOutcome(StrEnum):
    """Verdict of a verification."""

    AGREES = "agrees"
    DIFFERS = "differs"
    CANNOT_TELL = "cannot_tell"


@dataclass(frozen=True)
class StepRow:
    """One compared quantity. ``within``: the intervals overlap."""

    name: str
    measured: Range
    predicted: Range

    @property
    def within(self) -> bool:
        """Return whether measured and predicted interval overlap."""
        return self.measured.low <= self.predicted.high and self.predicted.low <= self.measured.high


@dataclass(frozen=True)
class StepVerification:
    """Result of a verification. ``response``: mean of all steps as reported, as fitted and as predicted, (N,)."""

    outcome: StepOutcome
    reason: str
    rows: tuple[StepRow, ...]
    pairs: int
    misfit_rms: float
    """Root mean square of the misfit, as a share of the step."""
    misfit_p: float
    time_s: Reals
    reported: Reals
    fitted: Reals
    predicted: Reals
    needed_pairs: int | None = None
    """Number of pairs after which P and I would be known well enough, if the number of pairs alone was too small."""
    confidence: float = CONFIDENCE
    """Joint coverage of the measured intervals."""
    explained: bool = True
    """False: no P and I on this shaft explain the response, and the rows compare nothing."""


@dataclass(frozen=True)
class StepRecord:
    """Record of a run of steps: samples (N,), and the start of each step that counts, up first."""

    time_s: Reals
    speed_rad_s: Reals
    fresh: NDArray[np.bool_]
    limited: NDArray[np.bool_]
    """Samples at which an internal limit of the drive acted."""
    starts_s: Sequence[float]
    period_s: float
    timing_sd_s: float = 0.0
    """Standard uncertainty of the sample times."""
    reference_filter_s: float = 0.0
    """Known filter of the set speed in the drive."""


def step_pairs(
    time_s: Reals, speed_rad_s: Reals, starts_s: Sequence[float], program: StepProgram, period_s: float
) -> Reals:
    """Return the response of each pair (pair, N), as a share of the step. ``starts_s``: of all steps, up first."""
    count = max(1, round(program.half_s / period_s) - 1)
    grid = period_s * np.arange(count)
    halves = [np.interp(start + grid, time_s, speed_rad_s) for start in starts_s]
    whole = len(halves) // 2
    pairs = [0.5 * ((halves[2 * k] - halves[2 * k + 1]) / program.step_rad_s + 1.0) for k in range(1, whole)]
    return np.array(pairs).reshape(-1, count)


def verify_record(case: StepCase, program: StepProgram, record: StepRecord) -> StepVerification:
    """Compare a record with the prediction. A step that the end of the record cuts short does not count."""
    time_s, length_s = record.time_s, program.half_s
    # the last sample of a step is one period before its end
    whole = [one for one in record.starts_s if time_s.size and one + length_s <= time_s[-1] + 1.5 * record.period_s]
    begin, end = (whole[0], whole[-1] + length_s) if whole else (inf, inf)
    fresh = record.fresh
    pairs = step_pairs(time_s[fresh], record.speed_rad_s[fresh], whole, program, record.period_s)
    limited = bool(np.any(record.limited[(time_s >= begin) & (time_s <= end)]))
    return verify_steps(
        case, pairs, program, record.period_s, limited=limited, timing_sd_s=record.timing_sd_s,
        reference_filter_s=record.reference_filter_s)


def verify_steps(
    case: StepCase, pairs: Reals, program: StepProgram, period_s: float, *, limited: bool = False,
    timing_sd_s: float = 0.0, reference_filter_s: float = 0.0,
) -> StepVerification:
    """Compare the response of the pairs (pair, N) with the prediction. ``limited``: the torque limit acted.

    ``timing_sd_s``: standard uncertainty of the sample times; ``reference_filter_s``: known filter of the set speed.
    """
    from scipy.special import stdtrit

    number, count = pairs.shape
    model = StepModel(case, program, period_s, count, timing_sd_s, reference_filter_s)
    mean: Reals = np.asarray(pairs.mean(axis=0), dtype=np.float64) if number else np.zeros(count)
    time_s: Reals = np.asarray(period_s * np.arange(count), dtype=np.float64)
    start = model.starts[0]
    expected = model.reported(start)
    if number < LEAST_PAIRS:
        return StepVerification(StepOutcome.CANNOT_TELL, f"the log has {number} pairs of steps, and {LEAST_PAIRS} are "
                                "needed", (), number, inf, 0.0, time_s, mean, expected, expected)
    scatter = pairs - mean
    whiten = _whitening(scatter)
    # The whole response leads near the minimum; its coloured noise decides there. If it led to another minimum, the fit
    # from the prediction is the better one.
    weight = sqrt(number) / max(float(scatter.std()), _LEAST_SD)
    near = [_fitted(model, mean, lambda x: weight * x, at)[0] for at in model.starts]

    def cost(at: Reals) -> float:
        return _cost(model, whiten(mean - model.reported(at)), at)

    theta, slopes = min((_fitted(model, mean, whiten, at) for at in (*near, start)), key=lambda fit: cost(fit[0]))
    prior = np.diag(model.prior)
    inverse = np.linalg.inv(slopes.T @ slopes + prior)
    fitted = model.reported(theta)
    misfit = mean - fitted
    rms = float(np.sqrt(np.mean(misfit**2)))
    # what noise alone leaves as misfit, from random signs of the pairs' scatter
    scatter = whiten(scatter.T).T
    signs = np.random.default_rng(0).choice((-1.0, 1.0), (_SHUFFLES, number))
    noise = signs @ scatter / sqrt(number * (number - 1))
    left = ((noise - noise @ slopes @ inverse @ slopes.T) ** 2).sum(axis=1)
    squares = float((whiten(misfit) ** 2).sum())
    chance = float(np.mean(left >= squares))
    # A misfit above that of noise is an error of the model, alike in all pairs: Birge's ratio.
    birge = max(1.0, squares / max(float(np.mean(left)), 1e-18))
    moves = scatter @ slopes @ inverse
    covariance = birge * moves.T @ moves / (number * (number - 1)) + inverse @ prior @ inverse
    factor = float(stdtrit(number - 1, 1.0 - _TAIL))
    wider = (factor / _REACH) ** 2
    rows = _rows(model, _possible(theta, wider * covariance, cost, wider * birge), covariance, factor)
    amplitude = abs(model.rounding_amplitude(theta)) if model.counts < FEW_COUNTS else 0.0
    alike = amplitude > (ROUNDED_AMPLITUDE if chance < UNLIKE_P else QUIET_AMPLITUDE)
    explained = rms <= UNLIKE_RMS or chance >= UNLIKE_P
    outcome, reason = _judged(rows, rms, explained=explained, limited=limited, rounded_alike=alike)
    needed = None
    if outcome is StepOutcome.CANNOT_TELL and not (limited or alike):
        widest = max(0.5 * log(row.measured.high / row.measured.low) for row in rows[3:])
        needed = ceil(number * max(LEAST_LONGER, (widest / WELL_KNOWN) ** 2))
    return StepVerification(outcome, reason, rows, number, rms, chance, time_s, mean, fitted, expected, needed,
                            explained=explained)


def _whitening(scatter: Reals) -> Callable[[Reals], Reals]:
    """Return a function of (N,) or (N, columns) that makes the noise of the mean response white, with variance 1.

    The noise of a closed loop is coloured: at low frequency, where I acts, it has 10 to 30 times the mean power. Its
    autocorrelation is that of the scatter (pair, N), with Parzen's window over half of the response.
    Neighbouring samples of a long response are averaged.
    """
    from scipy.linalg import solve_triangular, toeplitz

    width = ceil(scatter.shape[1] / _MOST_SAMPLES)

    def averaged(x: Reals) -> Reals:
        whole = len(x) // width
        return np.asarray(x[:whole * width].reshape(whole, width, *x.shape[1:]).mean(axis=1), dtype=np.float64)

    seen = averaged(scatter.T)
    count, number = seen.shape
    power = (np.abs(np.fft.rfft(seen, 2 * count, axis=0)) ** 2).sum(axis=1)
    correlation = np.fft.irfft(power)[:count] / (count * number * (number - 1))
    lag = np.arange(count) / (0.5 * count)
    correlation *= np.where(lag < 0.5, 1.0 - 6.0 * lag**2 * (1.0 - lag), 2.0 * np.maximum(0.0, 1.0 - lag) ** 3)
    correlation[0] += _LEAST_SD**2 + _WHITE_SHARE * correlation[0]
    root = np.linalg.cholesky(toeplitz(correlation))
    return lambda x: np.asarray(solve_triangular(root, averaged(x), lower=True), dtype=np.float64)


def _fitted(
    model: StepModel, mean: Reals, whiten: Callable[[Reals], Reals], theta: Reals
) -> tuple[Reals, Reals]:
    """Fit the parameters from ``theta`` on. Return them and the derivatives of the whitened response (N, parameter)."""
    now = model.reported(theta)

    def cost(response: Reals, at: Reals) -> float:
        return _cost(model, whiten(mean - response), at)

    slopes = whiten(_slopes(model, theta, now))
    for _ in range(_ROUNDS):
        hessian = slopes.T @ slopes + np.diag(model.prior)
        move = np.linalg.solve(hessian, slopes.T @ whiten(mean - now) - model.prior * theta)
        move *= min(1.0, _LARGEST_MOVE / max(1e-12, float(np.max(np.abs(move[:2])))))
        before = cost(now, theta)
        for share in (1.0, 0.5, 0.25, 0.1, 0.03):
            tried = theta + share * move
            there = model.reported(tried)
            if cost(there, tried) < before:
                break
        else:
            break
        theta, now = tried, there
        slopes = whiten(_slopes(model, theta, now))
        if before - cost(now, theta) < 1e-3:
            break
    return theta, slopes


def _cost(model: StepModel, whitened: Reals, theta: Reals) -> float:
    """Return the cost of the fit, −2 ln of the posterior density, from the whitened misfit (N,)."""
    return float((whitened**2).sum()) + float((model.prior * theta**2).sum())


def _possible(theta: Reals, covariance: Reals, cost: Callable[[Reals], float], birge: float) -> list[Reals]:
    """Return the fitted parameters, and random draws around them without those that the response excludes.

    The covariance is that of small changes. A coupling of low frequency changes the response more than its slope at
    the fit says.
    """
    variances, axes = np.linalg.eigh(covariance)
    root = axes * np.sqrt(np.maximum(variances, 0.0))
    draws = theta + np.random.default_rng(1).standard_normal((_DRAWS, len(theta))) @ root.T
    costs = np.array([cost(one) for one in draws])
    kept = max(_LEAST_KEPT, int(np.sum(costs <= cost(theta) + _EXCLUDED * birge)))
    return [theta, *draws[np.argsort(costs)[:kept]]]


def _slopes(model: StepModel, theta: Reals, now: Reals) -> Reals:
    columns = []
    for k in range(model.size):
        step = _SLOPE if k < 2 else 100.0 * _SLOPE
        moved = theta.copy()
        moved[k] += step
        columns.append((model.reported(moved) - now) / step)
    return np.array(columns).T


def _rows(model: StepModel, draws: Sequence[Reals], covariance: Reals, factor: float) -> tuple[StepRow, ...]:
    """Return the compared quantities. ``draws``: possible parameters, fitted ones first; ``factor``: Student's."""
    case, theta = model.case, draws[0]
    typed = (case.gains.gain_nm_s_rad, case.gains.integral_nm_rad)
    gains, fitted = [], model.loop(theta)[1]
    for k, (value, found) in enumerate(zip(typed, (fitted.gain_nm_s_rad, fitted.integral_nm_rad), strict=True)):
        by = exp(min(factor * sqrt(float(covariance[k, k])), 50.0))
        gains.append(StepRow(_QUANTITIES[3 + k], Range(found, found / by, found * by), Range(value, value, value)))
    figures = _figures(model, draws)
    rows = []
    for k, name in enumerate(_QUANTITIES[:3]):
        values = figures[:, k]
        finite = bool(np.all(np.isfinite(values)))
        low, high = np.quantile(values, (_TAIL, 1.0 - _TAIL)) if finite else (np.min(values), inf)
        value = float(values[0])
        rows.append(StepRow(name, Range(value, min(float(low), value), max(float(high), value)), getattr(case, name)))
    return (*rows, *gains)


def _figures(model: StepModel, draws: Sequence[Reals]) -> Reals:
    """Return overshoot, rise time, s, and settling time, s, of each draw (draw, 3)."""
    loops = [model.loop(theta) for theta in draws]
    spans = [_SPAN * plant.total_inertia_kg_m2 / gains.gain_nm_s_rad for plant, gains in loops]
    speeds = loop_responses([closed_loop(plant, gains) for plant, gains in loops], spans)
    found = [step_figures(np.linspace(0.0, span, len(speed)), speed) for span, speed in zip(spans, speeds, strict=True)]
    return np.array([(one.overshoot_share, one.rise_s, one.settling_s) for one in found])


_WORDS = {"overshoot_share": "overshoot", "rise_s": "rise time", "settling_s": "settling time", "gain_nm_s_rad": "P",
          "integral_nm_rad": "I"}


def _judged(
    rows: tuple[StepRow, ...], rms: float, *, explained: bool, limited: bool, rounded_alike: bool
) -> tuple[StepOutcome, str]:
    """Return the verdict from the intervals, and its reason."""
    if limited:
        return StepOutcome.CANNOT_TELL, "an internal limit of the drive acted during the steps"
    if rounded_alike:
        return StepOutcome.CANNOT_TELL, (
            "a step is a few counts of the reported speed, and all steps are rounded alike: no noise averages this out")
    if not explained:
        return StepOutcome.DIFFERS, (
            f"the response differs from that of any P and I on this shaft by {100 * rms:.1f} % of the step (rms): a "
            "ramp, a filter or another resonance acts")
    gains = rows[3:]
    off = [row for row in rows if not row.within]
    if off:
        said = [_WORDS[row.name] + (f" is {row.measured.value / row.predicted.value:.2f} times the typed value"
                                    if row in gains else " is outside its predicted interval") for row in off]
        return StepOutcome.DIFFERS, "; ".join(said)
    # gains whose interval does not exclude an error of `LIKE_SHARE`
    open_by = [row for row in gains if not (row.measured.low / row.predicted.value > 1.0 - LIKE_SHARE
                                            and row.measured.high / row.predicted.value < 1.0 + LIKE_SHARE)]
    if open_by:
        wide = open_by[0]
        return StepOutcome.CANNOT_TELL, (
            f"{_WORDS[wide.name]} is known from {wide.measured.low / wide.predicted.value:.2f} to "
            f"{wide.measured.high / wide.predicted.value:.2f} times the typed value: an error of "
            f"{100 * LIKE_SHARE:.0f} % would not be seen")
    return StepOutcome.AGREES, "all measured intervals meet the predicted ones"
