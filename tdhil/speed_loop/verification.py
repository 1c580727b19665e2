r"""Comparison of small steps of the speed setpoint with the prediction of `tdhil tune speed`. It finds the real gains.

The lag of the reported speed is often longer than the rise time. Therefore a model of loop and report is fitted to the
mean of all steps, and the figures are those of the fitted loop, without the lag of the report.

**Fit.** P and I are free. All other quantities have the result's intervals as prior knowledge (standard deviation =
half-width/1.96): J, friction, the lags of the loop together, the resonance, the lag of the reported speed, and the
delay of the setpoint. An up step and the down step after it make one pair; half their difference is free of offset and
slow drift. The scatter between pairs gives spectrum and covariance of the noise. The rounding of the report is part of
the model.

**Rows.** Overshoot, rise and settling are compared with their predicted intervals; P and I with the typed values. The
joint coverage of all intervals is 99 %: each has 1 − 0.01/5.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from math import ceil, exp, inf, log, pi, sqrt
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from tdhil.speed_loop.design import LEAST_SPLIT, Range, UncertainPlant
from tdhil.speed_loop.loop import LoopPlant, NotchFilter, PiGains, Reals, SpringLoad
from tdhil.speed_loop.step import closed_loop, loop_responses, step_figures

CONFIDENCE = 0.99
"""Joint coverage of all rows: in at most 1 % of the runs, right gains get the verdict *differs*."""
LIKE_SHARE = 0.3
"""Relative change of P or I that a comparison must be able to detect; otherwise the verdict is cannot_tell."""
UNLIKE_RMS = 0.03
"""Root mean square of the misfit, share of the step, above which the response does not fit the loop's model."""
UNLIKE_P = 0.01
"""Probability below which noise does not explain the misfit."""
DELAY_CYCLES, DELAY_SD_CYCLES = 1.0, 1.0
"""Delay until the drive applies a setpoint, and its standard deviation, cycles. It acts at once or within two cycles,
always alike on one machine; so the ends of the range are one standard deviation away."""
NORMAL_95 = 1.96
"""Half-width of a 95 % interval, in standard deviations of a normal distribution."""
REPORT_WIDER = 3.0
"""Factor on the half-width of the reported lag. The steps determine this lag well. A result of tones may contain only
its difference from the lag of the torque."""
COUPLING_TIMES, COUPLING_MOST = 11.0, 4.0
"""Antiresonance of a coupling that a rigid shaft may have above the excited lines, as a multiple of the crossover
P/(2πJ) at one standard deviation of the prior knowledge; and largest value of that parameter, a multiple of 5.5."""
COUPLED_SHARE, COUPLED_SHARE_SD, COUPLING_DAMPING = 0.35, 0.1, 0.05
"""Share of J behind such a coupling, its standard deviation, and damping ratio of the resonance (within a factor e)."""
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
SETTLED_LAGS, SETTLED_TIMES = 3.0, 2.0
"""Length of a step: number of lags of the reported speed, plus number of predicted settling times."""

_GOLDEN = 0.5 * (sqrt(5.0) - 1.0)
"""Golden ratio − 1. Its multiples, modulo 1, fill an interval evenly."""
_DRAWS = 400
"""Number of random draws of the fitted loop, for the intervals of its figures."""
_EXCLUDED = 31.3
"""Rise of the fit's cost from which the response excludes a draw: 99.9 % quantile of χ² with 11 degrees of freedom."""
_SHUFFLES = 300
"""Number of random sign changes of the pairs, for the probability of the misfit."""
_UNSTABLE = 1e6
"""Response, as a share of the step, from which a loop counts as unstable."""
_LEAST_SD, _WHITE_SHARE = 1e-9, 1e-3
"""Least noise of the mean response, as a share of the step, and least white part of its power."""
_MOST_SAMPLES = 1500
"""Largest number of samples whose correlation is computed; its time grows with the third power."""
_ROUNDING_HARMONICS = 12
"""Number of harmonics of the rounding error in the model."""
_ROUNDING_SD, _ROUNDING_MOST = 0.7, 0.98
"""Prior standard deviation, and limit, of the amplitude of the first harmonic, as a share of that without noise."""
_ROUNDS = 12
"""Number of iterations of the fit."""
_LEAST_COUPLING, _MOST_LOG = 1e-4, 50.0
"""Least coupling parameter (the shaft is then rigid), and largest ln of P and I as a multiple of the typed value."""
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
class StepCase:
    """Prediction with which steps are compared, at the motor shaft."""

    kind: str
    """``tuned`` or ``present``: the gains that are in the drive."""
    plant: UncertainPlant
    gains: PiGains
    overshoot_share: Range
    rise_s: Range
    settling_s: Range
    reported_lag_s: Range
    """Time constant of the reported speed."""
    source: str = ""
    """File of the tuning."""

    @property
    def mode(self) -> Literal["speed", "torque"]:
        """Return the drive's mode in stage 5."""
        return "speed"

    @property
    def torque_offset(self) -> bool:
        """Return whether stage 5 writes the drive's torque offset."""
        return False

    def plain(self) -> dict[str, Any]:
        """Return the case as plain data for the log; `step_case_of` reads it."""
        return asdict(self)


def step_case_of(plain: Mapping[str, Any]) -> StepCase:
    """Return the case that `StepCase.plain` wrote. Raises KeyError or TypeError."""
    said = plain["plant"]

    def range_of(part: Mapping[str, Any] | None) -> Range | None:
        return None if part is None else Range(*(float(part[name]) for name in ("value", "low", "high")))

    def ranged(part: Mapping[str, Any]) -> Range:
        found = range_of(part)
        if found is None:
            raise TypeError("a value is missing")
        return found

    gains = plain["gains"]
    notch = gains.get("notch")
    plant = UncertainPlant(
        ranged(said["inertia_kg_m2"]), ranged(said["viscous_nm_s_rad"]), tuple(map(ranged, said["lags_s"])),
        ranged(said["dead_time_s"]), *(range_of(said.get(name)) for name in
                                       ("antiresonance_hz", "resonance_hz", "damping_nm_s_rad")))
    law = PiGains(float(gains["gain_nm_s_rad"]), float(gains["integral_nm_rad"]),
                  None if notch is None else NotchFilter(*(float(notch[name]) for name in (
                      "hertz", "numerator_damping", "denominator_damping"))))
    overshoot, rise, settling, lag = (
        ranged(plain[name]) for name in ("overshoot_share", "rise_s", "settling_s", "reported_lag_s"))
    return StepCase(str(plain["kind"]), plant, law, overshoot, rise, settling, lag, str(plain.get("source", "")))


@dataclass(frozen=True)
class StepProgram:
    """Speed setpoints of a verification: repeated steps up and down between two speeds."""

    low_rad_s: float
    high_rad_s: float
    half_s: float
    """Duration of each step."""
    pairs: int
    """Number of evaluated pairs of an up step and a down step. One more pair before them is not evaluated."""
    dither_rad_s: float = 0.0
    """Resolution of the reported speed. Pairs are offset by fractions of it, so that the rounding averages out."""

    def speeds_rad_s(self, pair: int) -> tuple[float, float]:
        """Return the upper and the lower speed setpoint of a pair."""
        offset = self.dither_rad_s * ((pair * _GOLDEN) % 1.0 - 0.5)
        return self.high_rad_s + offset, self.low_rad_s + offset

    @property
    def step_rad_s(self) -> float:
        """Size of each step."""
        return self.high_rad_s - self.low_rad_s

    @property
    def duration_s(self) -> float:
        """Duration of all steps, including the pair that is not evaluated."""
        return 2.0 * self.half_s * (self.pairs + 1)


def step_length_s(case: StepCase) -> float:
    """Return the time after which the reported speed of a step has settled, s."""
    return SETTLED_TIMES * case.settling_s.high + SETTLED_LAGS * case.reported_lag_s.high


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


# ---------------------------------------------------------------------------------------------------------------------
# Model of the loop and of its reported speed over time.


class _LoopModel:
    """Model of the reported response. All parameters but ln P and ln I have prior mean 0 and standard deviation 1."""

    def __init__(self, case: StepCase, program: StepProgram, period_s: float, count: int, timing_sd_s: float,
                 reference_filter_s: float) -> None:
        self.case, self.period_s, self.count = case, period_s, count
        self._apart = round(program.half_s / period_s)
        self.counts = program.step_rad_s / program.dither_rad_s if program.dither_rad_s > 0.0 else 0.0
        self._reference_filter_s = reference_filter_s
        self._delay_s = DELAY_CYCLES * period_s, DELAY_SD_CYCLES * period_s + timing_sd_s
        plant = case.plant
        lags = (*plant.lags_s, plant.dead_time_s)
        total = sum(lag.value for lag in lags)
        self._lags_sd = sum(lag.high - lag.low for lag in lags) / (2.0 * NORMAL_95 * total) if total > 0.0 else 0.0
        self.size = 11
        """Parameters: ln P, ln I, J, B, lags of the loop, reporting lag, delay, antiresonance, resonance, damping, and
        rounding of the report. For a rigid shaft the three of the spring are those of `_coupled`."""
        self.prior = np.r_[0.0, 0.0, np.ones(self.size - 2)]
        """Prior knowledge of each parameter, 1/variance."""

    def loop(self, theta: Reals) -> tuple[LoopPlant, PiGains]:
        """Return plant and gains for these parameters."""
        case, plant = self.case, self.case.plant
        believed = plant.believed
        inertia = _moved(plant.inertia_kg_m2, theta[2])
        scale = exp(self._lags_sd * float(np.clip(theta[4], -6.0, 6.0)))
        spring = believed.spring
        if spring is None:
            inertia, spring = self._coupled(inertia, theta)
        elif plant.antiresonance_hz is not None and plant.resonance_hz is not None:
            low = _moved(plant.antiresonance_hz, theta[7])
            spring = replace(
                spring, antiresonance_hz=low, resonance_hz=max(_moved(plant.resonance_hz, theta[8]), LEAST_SPLIT * low),
                damping_nm_s_rad=0.0 if plant.damping_nm_s_rad is None else max(
                    0.0, _shifted(plant.damping_nm_s_rad, theta[9])))
        found = LoopPlant(inertia, max(0.0, _shifted(plant.viscous_nm_s_rad, theta[3])),
                          tuple(scale * lag for lag in believed.lags_s), scale * believed.dead_time_s, spring)
        by_p, by_i = (exp(float(one)) for one in np.clip(theta[:2], -_MOST_LOG, _MOST_LOG))
        gains = replace(case.gains, gain_nm_s_rad=case.gains.gain_nm_s_rad * by_p,
                        integral_nm_rad=case.gains.integral_nm_rad * by_i)
        return found, gains

    def _coupled(self, inertia_kg_m2: float, theta: Reals) -> tuple[float, SpringLoad]:
        """Return the motor's part of J, and the spring to the rest of it.

        A shaft is known to be rigid as far as the excited lines reach. A coupling above them lets the motor answer
        sooner than the whole J. Without it in the model P was found 1.19 times too high at an antiresonance of 2.6 Hz,
        and typed gains got *differs* in one of ten runs below 6 Hz.
        """
        coupling = float(np.clip(theta[7], _LEAST_COUPLING, COUPLING_MOST))
        share = float(np.clip(COUPLED_SHARE + COUPLED_SHARE_SD * theta[8], 0.05, 0.8))
        crossover_hz = self.case.gains.gain_nm_s_rad / (2.0 * pi * inertia_kg_m2)
        low_hz = COUPLING_TIMES * crossover_hz / sqrt(coupling)
        high_hz = low_hz / sqrt(1.0 - share)
        stiffness_nm_rad = share * inertia_kg_m2 * (2.0 * pi * low_hz) ** 2
        damping = COUPLING_DAMPING * exp(float(np.clip(theta[9], -3.0, 3.0)))
        spring = SpringLoad(low_hz, high_hz, damping * stiffness_nm_rad / (pi * high_hz))
        return (1.0 - share) * inertia_kg_m2, spring

    def reported(self, theta: Reals) -> Reals:
        """Return the reported response (N,) to alternating steps, as a share of the step."""
        from scipy.linalg import expm

        plant, gains = self.loop(theta)
        a, b, c = closed_loop(plant, gains)
        lag_s = max(0.0, _shifted(self.case.reported_lag_s, REPORT_WIDER * float(theta[5])))
        for tau in (lag_s, self._reference_filter_s):
            if tau > 0.0:      # a first-order lag at the output
                size = len(a)
                joined = np.zeros((size + 1, size + 1))
                joined[:size, :size], joined[size, :size], joined[size, size] = a, c / tau, -1.0 / tau
                a, b, c = joined, np.append(b, 0.0), np.append(np.zeros(size), 1.0)
        delay_s = self._delay_s[0] + self._delay_s[1] * float(theta[6])       # below 0 if the sample times are late
        size, length = len(a), self.count + self._apart
        whole = np.zeros((size + 1, size + 1))
        whole[:-1, :-1], whole[:-1, -1] = a, b
        first = max(0, ceil(delay_s / self.period_s - 1e-9))
        state = np.zeros(size + 1)
        state[-1] = 1.0
        state = expm(whole * (first * self.period_s - delay_s)) @ state
        out = np.r_[np.zeros(first), _outputs(expm(whole * self.period_s), np.append(c, 0.0), state, length - first)]
        response = out[:self.count] + 1.0 - out[self._apart:]
        return np.asarray(response + self._rounding(response, self.rounding_amplitude(theta)), dtype=np.float64)

    def rounding_amplitude(self, theta: Reals) -> float:
        """Return the amplitude of the first harmonic of the rounding error, as a share of that without noise."""
        most = _ROUNDING_MOST if self.counts else 0.0
        return float(np.clip(_ROUNDING_SD * theta[10], -most, most))

    def _rounding(self, response: Reals, amplitude: float) -> Reals:
        """Return the mean rounding error (N,) of the reported response, as a share of the step.

        A drive rounds speed x, in counts, to Q(x), and Q(x) − x = Σ (−1)^k sin(2πk x)/(πk), with k from 1. Noise of
        standard deviation s makes the mean of harmonic k e^(−2π²k²s²) = a^(k²) times as large. Truncation in place of
        rounding gives a negative a, a set speed between two counts a small one. As set speeds are whole counts, the
        last half count of each response is lost: without this error in the model, the loop seems to settle sooner than
        it does, and I seems too large.
        """
        if not amplitude:
            return np.zeros_like(response)
        error = sum((-1.0) ** k * amplitude ** (k * k) * np.sin(2.0 * np.pi * k * self.counts * response) / (np.pi * k)
                    for k in range(1, _ROUNDING_HARMONICS + 1))
        return np.asarray(error / self.counts, dtype=np.float64)


def _outputs(move: Reals, c: Reals, state: Reals, length: int) -> Reals:
    """Return c Aᵏ x (length,), k from 0, for the matrix A and the state x; `_UNSTABLE` from where it is exceeded.

    The outputs of a block, and the states at the start of all blocks, take the root of ``length`` products each.
    """
    block = max(1, round(sqrt(length)))
    rows, states = [c], [state]
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(1, block):
            rows.append(rows[-1] @ move)
        far = np.linalg.matrix_power(move, block)
        for _ in range(1, ceil(length / block)):
            states.append(far @ states[-1])
        out: Reals = np.asarray((np.array(states) @ np.array(rows).T).ravel()[:length], dtype=np.float64)
        beyond = np.flatnonzero(~(np.abs(out) < _UNSTABLE))
    if beyond.size:
        out[beyond[0]:] = _UNSTABLE
    return out


def _moved(part: Range, by: float) -> float:
    """Return the value changed by ``by`` relative standard deviations."""
    if part.value <= 0.0:
        return part.value
    return part.value * exp((part.high - part.low) / (2.0 * NORMAL_95 * part.value) * float(np.clip(by, -6.0, 6.0)))


def _shifted(part: Range, by: float) -> float:
    return part.value + (part.high - part.low) / (2.0 * NORMAL_95) * by


# ---------------------------------------------------------------------------------------------------------------------
# Evaluation of the samples.


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
    number, count = pairs.shape
    model = _LoopModel(case, program, period_s, count, timing_sd_s, reference_filter_s)
    mean: Reals = np.asarray(pairs.mean(axis=0), dtype=np.float64) if number else np.zeros(count)
    time_s: Reals = np.asarray(period_s * np.arange(count), dtype=np.float64)
    start = np.zeros(model.size)
    expected = model.reported(start)
    if number < LEAST_PAIRS:
        return StepVerification(StepOutcome.CANNOT_TELL, f"the log has {number} pairs of steps, and {LEAST_PAIRS} are "
                                "needed", (), number, inf, 0.0, time_s, mean, expected, expected)
    scatter = pairs - mean
    whiten = _whitening(scatter)
    # The whole response leads near the minimum; its coloured noise decides there.
    weight = sqrt(number) / max(float(scatter.std()), _LEAST_SD)
    near, _ = _fitted(model, mean, lambda x: weight * x, start)
    theta, slopes = _fitted(model, mean, whiten, near)
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
    rows = _rows(model, _possible(model, mean, whiten, theta, covariance, birge), covariance, number)
    amplitude = abs(model.rounding_amplitude(theta)) if model.counts < FEW_COUNTS else 0.0
    alike = amplitude > (ROUNDED_AMPLITUDE if chance < UNLIKE_P else QUIET_AMPLITUDE)
    outcome, reason = _judged(rows, rms, chance, limited=limited, rounded_alike=alike)
    needed = None
    if outcome is StepOutcome.CANNOT_TELL and not (limited or alike):
        widest = max(0.5 * log(row.measured.high / row.measured.low) for row in rows[3:])
        needed = ceil(number * max(LEAST_LONGER, (widest / WELL_KNOWN) ** 2))
    return StepVerification(outcome, reason, rows, number, rms, chance, time_s, mean, fitted, expected, needed)


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
    model: _LoopModel, mean: Reals, whiten: Callable[[Reals], Reals], theta: Reals
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


def _cost(model: _LoopModel, whitened: Reals, theta: Reals) -> float:
    """Return the cost of the fit, −2 ln of the posterior density, from the whitened misfit (N,)."""
    return float((whitened**2).sum()) + float((model.prior * theta**2).sum())


def _possible(
    model: _LoopModel, mean: Reals, whiten: Callable[[Reals], Reals], theta: Reals, covariance: Reals, birge: float
) -> list[Reals]:
    """Return the fitted parameters, and random draws around them without those that the response excludes.

    The covariance is that of small changes. A coupling of low frequency changes the response more than its slope at
    the fit says.
    """
    variances, axes = np.linalg.eigh(covariance)
    root = axes * np.sqrt(np.maximum(variances, 0.0))
    draws = theta + np.random.default_rng(1).standard_normal((_DRAWS, len(theta))) @ root.T
    most = _cost(model, whiten(mean - model.reported(theta)), theta) + _EXCLUDED * birge
    return [theta, *(one for one in draws if _cost(model, whiten(mean - model.reported(one)), one) <= most)]


def _slopes(model: _LoopModel, theta: Reals, now: Reals) -> Reals:
    columns = []
    for k in range(model.size):
        step = _SLOPE if k < 2 else 100.0 * _SLOPE
        moved = theta.copy()
        moved[k] += step
        columns.append((model.reported(moved) - now) / step)
    return np.array(columns).T


def _rows(model: _LoopModel, draws: Sequence[Reals], covariance: Reals, number: int) -> tuple[StepRow, ...]:
    """Return the compared quantities. ``draws``: parameters that the response permits, the fitted ones first."""
    from scipy.stats import t

    case, theta = model.case, draws[0]
    names = ("overshoot_share", "rise_s", "settling_s", "gain_nm_s_rad", "integral_nm_rad")
    factor = float(t.ppf(0.5 + 0.5 * (1.0 - (1.0 - CONFIDENCE) / len(names)), number - 1))
    typed = (case.gains.gain_nm_s_rad, case.gains.integral_nm_rad)
    gains, fitted = [], model.loop(theta)[1]
    for k, (value, found) in enumerate(zip(typed, (fitted.gain_nm_s_rad, fitted.integral_nm_rad), strict=True)):
        half = factor * sqrt(float(covariance[k, k]))
        gains.append(StepRow(names[3 + k], Range(found, found * exp(-min(half, 50.0)), found * exp(min(half, 50.0))),
                             Range(value, value, value)))
    figures = _figures(model, draws)
    rows = []
    for k, name in enumerate(names[:3]):
        values = figures[:, k]
        predicted: Range = getattr(case, name)
        if not np.all(np.isfinite(values)):
            rows.append(StepRow(name, Range(float(values[0]), float(np.min(values)), inf), predicted))
            continue
        share = 0.5 * (1.0 - CONFIDENCE) / len(names)
        low, high = np.quantile(values, (share, 1.0 - share))
        rows.append(StepRow(name, Range(float(values[0]), min(float(low), float(values[0])),
                                        max(float(high), float(values[0]))), predicted))
    return (*rows, *gains)


def _figures(model: _LoopModel, draws: Sequence[Reals]) -> Reals:
    """Return overshoot, rise time, s, and settling time, s, of each draw (draw, 3)."""
    loops = [model.loop(theta) for theta in draws]
    spans = [_SPAN * plant.total_inertia_kg_m2 / gains.gain_nm_s_rad for plant, gains in loops]
    speeds = loop_responses([closed_loop(plant, gains) for plant, gains in loops], spans)
    found = [step_figures(np.linspace(0.0, span, len(speed)), speed) for span, speed in zip(spans, speeds, strict=True)]
    return np.array([(one.overshoot_share, one.rise_s, one.settling_s) for one in found])


_WORDS = {"overshoot_share": "overshoot", "rise_s": "rise time", "settling_s": "settling time", "gain_nm_s_rad": "P",
          "integral_nm_rad": "I"}


def _judged(
    rows: tuple[StepRow, ...], rms: float, chance: float, *, limited: bool, rounded_alike: bool
) -> tuple[StepOutcome, str]:
    """Return the verdict from the intervals, and its reason."""
    if limited:
        return StepOutcome.CANNOT_TELL, "an internal limit of the drive acted during the steps"
    if rounded_alike:
        return StepOutcome.CANNOT_TELL, (
            "a step is a few counts of the reported speed, and all steps are rounded alike: no noise averages this out")
    if rms > UNLIKE_RMS and chance < UNLIKE_P:
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
