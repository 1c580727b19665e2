"""Inertia of a motor above a drill string on bottom, from the motion before an echo returns.

The motion of the motor runs down the string as a wave. For the round-trip time 2L/v the string acts only as the
resistance ζ = √(J_s k). The later echo depends on the bit: a mass, collars, new rock, a bit that cuts. The waves at the
top are a = τ + ζω down and b = ζω − τ up (τ: torque that the string takes). For any bottom with a linear response, b(t)
= ∫ r(x) a(t − x) dx,

    Z = J s + B + ζ (1 − Γ)/(1 + Γ),       Γ(s) = Σ_n r_n e^(−s t_n).

r is not the whole echo of the string, but the response of the bottom to *one* wave: repeated echoes pass the top, whose
motion is measured, and are part of a. Therefore r is short, for any damping of the string. It is unknown: nearly 0
until 0.97 · 2L/v (`_UNEVEN`: pipes are worn, and mud drags along them), and from there up to a full reflection,
decaying within 16 s. A dense line spectrum, with spacing 1/P, covers a whole period P. The response of the bit is
fitted too, and its scatter is noise. A bit in stick-slip does not respond linearly; its torsional oscillation shows
this.

The interval is that of the profile likelihood, over all bottoms and reports. The scatter from period to period would
count an oscillation that continues from one period to the next as new in each; `unleaked` corrects it.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from profiles import CodedText, MessageCode
from tdhil.estimation.case import Finding, ModelWords, PeriodicCase
from tdhil.estimation.frequency_domain import signal_filters
from tdhil.estimation.frequency_domain.compliant_fit import chance_gain
from tdhil.estimation.frequency_domain.filter_order import FittedModel, fit_model, likeliest
from tdhil.estimation.frequency_domain.frequency_response import ModelCurve
from tdhil.estimation.frequency_domain.inference import (
    estimate,
    grown_lines,
    half_width_first_order,
    torque_scale_line,
)
from tdhil.estimation.frequency_domain.likelihood import Likelihood
from tdhil.estimation.frequency_domain.model import GaussianPrior, Model
from tdhil.estimation.frequency_domain.rigid import fitted_points, known_structure, lag_priors, lags_of, of_reports
from tdhil.estimation.frequency_domain.shafts import (
    ANY_IMPEDANCE,
    INERTIA,
    VISCOUS,
    like_the_pipe,
    unlike_the_pipe,
)
from tdhil.estimation.result import BudgetLine, Compliant, Refused, ResidualTest, rejects
from tdhil.estimation.samples import STICK_SLIP_REGULAR, STICK_SLIP_SHARE, downhole_swing_rad_s, repeats
from tdhil.estimation.spectrum import ComplexArray, PeriodLines, SpectralLine, pooled_lines
from tdhil.recording import FloatArray, LagPrior, Pipe, Recording, TorqueAnswer

# ---------------------------------------------------------------------------------------------------------------------
# Shaft of a motor above a string.


RESISTANCE, ECHO = 2, 3     # positions in m of ζ and of the first value of r
_FASTER = 0.97              # share of 2L/v: waves may be slightly faster than in a smooth pipe of nominal steel
_FINER, _LATE_FINER = 4.0, 1.4     # instants of r per half a cycle of the fastest line; the second from _LATE_S on
_FULL = 1.0                 # sd of r over half a cycle at first: about a full reflection
_DIES_S = 5.0               # s; time constant of the decay of r
_LATE_S = 3.0             # s after the echo; from then on the instants are farther apart
_LASTS_S = 16.0           # s after the echo; duration of its response
_UNEVEN = 0.01              # sd of r before the echo
_TOP_SHARE = 0.05           # sd of the friction at the top, as a share of ζ
_HELD, _FREE = (0.5, 2.0), (0.1, 10.0)     # least and greatest ζ of the fit over that of the pipe
_MOST = 5.0                 # largest |r|: five times the prior's sd or more, so that the prior holds r


class EchoShaft:
    """J (kg·m²), B, ζ (N·m·s/rad), r_1 … r_N. The priors are ζ, to the pipe's tolerance, and the size of r."""

    def __init__(self, pipe: Pipe, fastest_hz: float, impedance_rel_sd: float | None = None) -> None:
        """Set the pipe. ``impedance_rel_sd``: of ζ, instead of the pipe's."""
        rel_sd = pipe.rel_sd if impedance_rel_sd is None else impedance_rel_sd
        self._range = _HELD if impedance_rel_sd is None else _FREE
        half_s = 0.5 / fastest_hz
        self.echo_s = _FASTER * 2.0 * pipe.delay_s
        late_s, end_s = self.echo_s + _LATE_S, self.echo_s + _LASTS_S
        fine: FloatArray = np.arange(half_s / _FINER, late_s, half_s / _FINER)
        self.at_s: FloatArray = np.concatenate([fine, np.arange(late_s, end_s, half_s / _LATE_FINER)])
        self.pipe = pipe
        after = np.maximum(self.at_s - self.echo_s, 0.0)
        size = np.where(self.at_s < self.echo_s, _UNEVEN, _FULL * np.exp(-after / _DIES_S))
        size /= np.sqrt(np.where(self.at_s < late_s, _FINER, _LATE_FINER))
        self.held = len(self.at_s)
        self.names = ("inertia", "viscous", "resistance", *(f"echo_{n}" for n in range(len(self.at_s))))
        self.inertia_row, self.viscous_row = np.eye(2, len(self.names))
        zeta = pipe.impedance_nm_s_rad
        sd = np.concatenate([[_TOP_SHARE * zeta, rel_sd * zeta], size])
        self._beliefs: FloatArray = np.eye(len(self.names))[VISCOUS:] / sd[:, None]
        self._believed: FloatArray = np.eye(len(sd))[1] / rel_sd
        self._delayed: tuple[ComplexArray, ComplexArray] | None = None

    def impedance(self, m: FloatArray, s: ComplexArray) -> ComplexArray:
        gamma = self._delays(s) @ m[ECHO:]
        z: ComplexArray = m[INERTIA] * s + m[VISCOUS] + m[RESISTANCE] * (1.0 - gamma) / (1.0 + gamma)
        return z

    def jacobian(self, m: FloatArray, s: ComplexArray) -> ComplexArray:
        """Return the slopes by m; uses ∂(1 − Γ)/(1 + Γ)/∂Γ = −2/(1 + Γ)²."""
        delays = self._delays(s)
        gamma = delays @ m[ECHO:]
        by_gamma = -2.0 * m[RESISTANCE] / (1.0 + gamma) ** 2
        return np.column_stack([s, np.ones_like(s), (1.0 - gamma) / (1.0 + gamma), by_gamma[:, None] * delays])

    def bounds(self, rough_inertia: float, s: ComplexArray) -> tuple[FloatArray, FloatArray]:
        zeta, most = self.pipe.impedance_nm_s_rad, np.full(len(self.at_s), _MOST)
        lowest, highest = self._range
        return (np.concatenate([[1e-6 * rough_inertia, -np.inf, lowest * zeta], -most]),
                np.concatenate([[1e6 * rough_inertia, np.inf, highest * zeta], most]))

    def scales(self, rough_inertia: float, s: ComplexArray) -> FloatArray:
        zeta = self.pipe.impedance_nm_s_rad
        return np.concatenate([[rough_inertia, zeta, zeta], np.ones(len(self.at_s))])

    def beliefs(self, m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the prior residuals and slopes, as `shafts.Believing` does."""
        return self._beliefs @ m - self._believed, self._beliefs

    def start(self, inertia: float) -> FloatArray:
        """Return start values (M,) for a bit that is a mass of the string's own weight."""
        zeta, at = self.pipe.impedance_nm_s_rad, self.at_s
        first = int(np.argmin(np.abs(at - 2.0 * self.pipe.delay_s)))
        slow_s = self.pipe.inertia_kg_m2 / zeta
        echo = np.where(at >= at[first], 1.8 * np.gradient(at) / slow_s * np.exp((at[first] - at) / slow_s), 0.0)
        echo[first] -= 0.9
        return np.concatenate([[inertia, 0.0, zeta], echo])

    def _delays(self, s: ComplexArray) -> ComplexArray:
        """Cached values of the lines, which stay the same during a fit."""
        if self._delayed is None or self._delayed[0] is not s:
            self._delayed = s, np.exp(-np.outer(s, self.at_s))
        return self._delayed[1]


# ---------------------------------------------------------------------------------------------------------------------
# Scatter of a shaft that continues to oscillate.
#
# A string continues to oscillate from one period into the next. The error T − G W of a line in one period then contains
# the oscillation at its beginning and at its end: a smooth function of frequency, which the next period compensates.
# The mean of N periods contains nearly nothing of it, their scatter all. With the densest possible lines, spacing 1/P,
# the part of the scatter that a Hann window keeps, e_k − (e_(k−1) + e_(k+1))/2, has no part that is smooth over k, and
# is 3/2 times as large for the rest. Variances of neighbours are averaged, because noise changes slowly with frequency
# and each line has few periods.


_NEIGHBOURS = 2           # lines on either side over which a scatter is smoothed
_SURER = 3.0        # factor of this averaging on the degrees of freedom of one line's scatter


def unleaked(lines: tuple[SpectralLine, ...], fits: tuple[PeriodLines, ...]) -> tuple[SpectralLine, ...]:
    """Return the pooled lines of ``fits`` with the scatter of their means; unchanged if the lines are not dense."""
    if len(lines) < 2 * _NEIGHBOURS + 1 or any(len(fit.lines_hz) != len(lines) for fit in fits):
        return lines
    steps = np.diff([line.hertz for line in lines])
    if np.ptp(steps) > 1e-3 * steps[0] or lines[0].hertz > 1.001 * steps[0]:
        return lines
    plain, smooth = np.zeros(len(lines)), np.zeros(len(lines))
    for fit in fits:
        speed, torque = fit.speed.mean(axis=0), fit.torque.mean(axis=0)
        error = fit.torque - torque - torque / speed * (fit.speed - speed)
        hann = error[:, 1:-1] - 0.5 * (error[:, :-2] + error[:, 2:])
        plain += np.sum(np.abs(error) ** 2, axis=0)
        smooth += np.pad(np.sum(np.abs(hann) ** 2, axis=0) / 1.5, 1, mode="edge")
    padded = np.pad(np.log(np.maximum(smooth, 1e-300)), _NEIGHBOURS, mode="edge")
    count = 2 * _NEIGHBOURS + 1
    share = np.exp(np.convolve(padded, np.full(count, 1.0 / count), "valid")) / np.maximum(plain, 1e-300)
    return tuple(
        replace(line, s_ww=line.s_ww * by, s_tt=line.s_tt * by, s_tw=line.s_tw * by, nu=_SURER * line.nu)
        for line, by in zip(lines, share.tolist(), strict=True)
    )


# ---------------------------------------------------------------------------------------------------------------------

_LAGS_S = ((0.40, 0.15), (0.05, 0.05), (0.15, 0.40))       # s; start values of the lags of speed and torque
_WORDS = ModelWords(
    "a string with an unknown echo",
    "check that rig.yaml describes the pipe from the top down to its first change of section",
    "excite for longer (--periods), or lift the bit off bottom",
)


def identify_before_echo(case: PeriodicCase) -> Finding:
    """Return J of the motor alone. Raises Refused for an unknown pipe, or lines that do not resolve the time before
    the echo.
    """
    pipe, confidence = case.recording.pipe, case.options.confidence
    if pipe is None:
        raise Refused(
            "pseudo-random torque needs the sizes of the pipe, and these are not stated",
            "state load.length_m and both diameters in rig.yaml, or use --excitation multisine",
            entry=MessageCode.ECHO_NOT_SEPARATED,
        )
    lines = unleaked(pooled_lines(case.fits, 0.0), case.fits)
    answer = case.recording.torque_answer if case.recording.lag_prior.torque_lag_s is None else None
    problem = problem_of(lines, pipe, case.recording.lag_prior, answer)
    fitted = fit_before_echo(problem, case.recording.lag_prior)
    residual = residual_of(fitted)
    shaft = echo_shaft(problem)
    finding = Finding(
        model="string", words=_WORDS, residual=residual, lines=fitted_points(fitted, confidence),
        warnings=(CodedText(
            "J is J_r, the motor side of the string, from the time before an echo returns",
            MessageCode.MOTOR_SIDE_ONLY),),
        compliant=Compliant(None, None, None, None, None, None),
        curve=ModelCurve(fitted, confidence, residual),
        settled=lines,
    )
    if rejects(residual):
        return replace(finding, compliant=None)
    free = fit_before_echo(problem_of(lines, pipe, case.recording.lag_prior, answer, ANY_IMPEDANCE),
                           case.recording.lag_prior)
    ratio = float(free.likelier.theta[RESISTANCE]) / pipe.impedance_nm_s_rad
    likelier = likeliest(fitted) - likeliest(free) > chance_gain() and not rejects(residual_of(free))
    if likelier and not like_the_pipe(ratio):
        return replace(finding, compliant=None, contradiction=unlike_the_pipe(ratio))
    inertia = estimate(fitted, INERTIA, confidence)
    if not (inertia.bounded and inertia.low > 0.0):
        raise Refused("the lines before the echo leave the inertia open", _WORDS.if_wide,
                      entry=MessageCode.NOT_IDENTIFIABLE)
    speed_lag, torque_lag, skew = lags_of(fitted, confidence)
    tolerance = f"to {100.0 * pipe.rel_sd:.2g} % (1 sd), as {pipe.source or 'stated'}"
    return replace(
        finding,
        inertia=inertia,
        conditions=(
            f"almost no echo returns within {shaft.echo_s:.2f} s, and each echo decays within {_LASTS_S:g} s",
            f"the characteristic impedance of the pipe is {pipe.impedance_nm_s_rad:.4g} N·m·s/rad {tolerance}",
            *(() if answer is None else (_FOLLOWS,)),
            *of_reports(case.recording.lag_prior),
        ),
        speed_lag_s=speed_lag,
        torque_lag_s=torque_lag,
        skew_s=skew,
        budget=_budget(fitted, inertia.low, inertia.high, confidence, case.recording.torque_scale_rel_sd),
    )


def problem_of(
    lines: tuple[SpectralLine, ...], pipe: Pipe, prior: LagPrior, answer: TorqueAnswer | None = None,
    impedance_rel_sd: float | None = None,
) -> Likelihood:
    """Return the likelihood. ``answer``: the response of the torque, used if no lag of it is stated.
    ``impedance_rel_sd``: of ζ, instead of the pipe's.

    Raises Refused if the lines are too few, or too far apart to separate an echo from the time before it.
    """
    hertz = [line.hertz for line in lines]
    apart = float(np.max(np.diff(hertz))) if len(hertz) > 1 else math.inf
    shaft = EchoShaft(pipe, max(hertz, default=1.0), impedance_rel_sd)
    if not 1.0 / apart >= shaft.echo_s + _LASTS_S:
        raise Refused(
            f"the lines are {apart:.3g} Hz apart. An echo after {shaft.echo_s:.2f} s needs lines at most "
            f"{1.0 / (shaft.echo_s + _LASTS_S):.3g} Hz apart",
            "use a lower --frequency, or --excitation multisine",
            entry=MessageCode.ECHO_NOT_SEPARATED,
        )
    if not max(hertz) * shaft.echo_s >= 1.0:
        raise Refused(
            f"the string is too short: its echo returns after {shaft.echo_s:.2f} s, within the first period of "
            f"the fastest line ({max(hertz):.3g} Hz)",
            "use --excitation multisine", entry=MessageCode.ECHO_NOT_SEPARATED,
        )
    model = Model(shaft)
    lags = (model.at(signal_filters.SPEED_LAG), model.at(signal_filters.TORQUE_LAG))
    known = lag_priors(prior, *lags)
    if answer is not None:
        shape = model.at(signal_filters.TORQUE_SHAPE)
        known += (
            GaussianPrior(lags[1], max(answer.lag_s - _OWN_LAG_S, 0.0), _OWN_LAG_SD_S),
            GaussianPrior(shape, answer.shape, _SHAPE_SD),
        )
    return Likelihood(lines, model, None, known)


# ---------------------------------------------------------------------------------------------------------------------
# Filter of the torque report, from the commanded torque.
#
# Before an echo returns, J follows from lines at which the filters of the reports matter as much as J. Long lags on
# both reports look like a lighter motor; with unknown filters the interval reaches down to half of J. The filter of the
# torque report, however, can be measured without the mechanics. In torque mode the torque is commanded, and a drive's
# torque loop follows within some milliseconds. The delay and the smoothing of the reported torque relative to the
# commanded one are then those of the report's filter, with a small part of drive and bus (`_OWN_LAG_S`). The delay
# itself is not used, because it contains that of the bus.


_OWN_LAG_S, _OWN_LAG_SD_S = 0.01, 0.015      # s; lag of the torque behind its setpoint: 0 to some 40 ms
_SHAPE_SD = 0.1             # sd of the report's shape about the measured one, of 0 to 0.5: the torque loop adds its own
_ANSWER_MISFIT = 0.01       # of the lines, rms: above it the response is not a filter of two poles, and stays unknown
_LEAST_ANSWER = 0.1         # of the strongest line: weaker lines are not used
_FOLLOWS = (
    "the drive's torque follows its setpoint within some 40 ms; its filter causes any further delay of the reported"
    " torque"
)


def torque_answer(recording: Recording, commanded_nm: FloatArray) -> TorqueAnswer | None:
    """Return the response of a motion for `identify_before_echo`; ``commanded_nm`` (N,). None if not of two poles.

    A command acts from its cycle on, and a report follows about one cycle later; all of this is delay.
    """
    from scipy.optimize import least_squares

    excitation = recording.excitation
    if excitation is None or not excitation.segments or excitation.mode != "torque":
        return None
    segment = excitation.segments[-1]
    begin_s = segment.start_s + segment.settle_periods * segment.period_s
    counts = (recording.time_s >= begin_s) & (recording.time_s < segment.end_s) & recording.fresh
    if len(commanded_nm) != len(recording.time_s) or np.count_nonzero(counts) < 4 * len(segment.lines_hz):
        return None
    time, both = recording.time_s[counts] - begin_s, np.stack([commanded_nm[counts], recording.torque_nm[counts]])
    both = both - both.mean(axis=1, keepdims=True)
    asked, seen = np.array([both @ np.exp(-2j * np.pi * hertz * time) for hertz in segment.lines_hz]).T
    clear = np.abs(asked) > _LEAST_ANSWER * np.max(np.abs(asked))
    ratio, s = seen[clear] / asked[clear], 2j * np.pi * np.array(segment.lines_hz)[clear]

    def off(x: FloatArray) -> FloatArray:
        lag, shape, delay = x
        error = ratio * (1.0 + lag * s + shape * (lag * s) ** 2) * np.exp(delay * s) - 1.0
        return np.concatenate([error.real, error.imag])

    bounds = ([0.0, 0.0, -0.1], [signal_filters.LAG_BOUND_S, signal_filters.SHAPE_BOUND, signal_filters.SKEW_BOUND_S])
    best = min((least_squares(off, (lag, 0.1, 0.01), bounds=bounds) for lag in (0.02, 0.3)), key=lambda fit: fit.cost)
    if not math.sqrt(2.0 * best.cost / max(len(s), 1)) <= _ANSWER_MISFIT:
        return None
    return TorqueAnswer(float(best.x[0]), float(best.x[1]))


# ---------------------------------------------------------------------------------------------------------------------

def echo_shaft(problem: Likelihood) -> EchoShaft:
    """Return the shaft of a problem from `problem_of`."""
    assert isinstance(problem.model.shaft, EchoShaft)
    return problem.model.shaft


def fit_before_echo(problem: Likelihood, prior: LagPrior) -> FittedModel:
    """Return the fit. Raises Refused if the arithmetic fails."""
    model, shaft = problem.model, echo_shaft(problem)
    moved = model.mechanical - Model().mechanical
    fixed = {index + moved: value for index, value in known_structure(prior).items()}
    apparent, top = _apparent_inertia(problem.lines), 2j * np.pi * problem.lines[-1].hertz
    starts = []
    for speed_lag, torque_lag in _LAGS_S:
        reports = np.zeros(signal_filters.COUNT)
        reports[signal_filters.SPEED_LAG], reports[signal_filters.TORQUE_LAG] = speed_lag, torque_lag
        inertia = apparent * abs((1.0 + torque_lag * top) / (1.0 + speed_lag * top))
        starts.append(np.concatenate([shaft.start(inertia), reports]))
    try:
        return fit_model(problem, fixed, starts)
    except (np.linalg.LinAlgError, FloatingPointError, ValueError) as error:
        raise Refused("the lines before the echo leave the inertia open", _WORDS.if_wide,
                      entry=MessageCode.NOT_IDENTIFIABLE) from error


def _apparent_inertia(lines: tuple[SpectralLine, ...]) -> float:
    """Return the median |T/(ω W)| of the faster half of the lines, at which the string has little effect; kg·m²."""
    upper = lines[len(lines) // 2 :]
    return float(np.median([abs(np.mean(line.torque / line.speed)) / (2.0 * np.pi * line.hertz) for line in upper]))


def residual_of(fitted: FittedModel) -> ResidualTest | None:
    """Return the test of the lines alone, less the fitted parameters: a prior on the echo is not a measurement."""
    from scipy.special import chdtrc

    problem, theta = fitted.problem, fitted.whole.theta
    _, q = problem.weighted(theta)
    m, nu = problem.segments, problem.nu
    statistic = float(np.sum((2.0 * nu + m - 1.0) * np.log1p(q / nu)))
    whole, parts = problem.information(theta)
    free = np.ix_(fitted.free, fitted.free)
    measured = np.sum([part for part, _ in parts[: len(problem.lines)]], axis=0)
    left = 2.0 * float(np.sum(m)) - float(np.trace(np.linalg.pinv(whole[free], hermitian=True) @ measured[free]))
    return ResidualTest(statistic, left, float(chdtrc(left, statistic))) if left >= 1.0 else None


_GRID_S = 0.25            # s; step of the search for a period in the residual torque
_LOOKED_AT_S = 300.0      # s; longest part of a segment in this search


def refuse_stick_slip(case: PeriodicCase) -> None:
    """Raise Refused, with period and size, if the motor also oscillates as above a bit in stick-slip.

    The residual torque moves it, by J ω. Stick-slip makes the J of the lines too small, if it has an effect.
    """
    pipe = case.recording.pipe
    if pipe is None or not case.every:
        return
    inertia_kg_m2 = _apparent_inertia(case.every)
    for stretch, fit in zip(case.stretches, case.fits, strict=True):
        segment = stretch.segment
        if not stretch.periods:
            continue
        begin_s = segment.start_s + stretch.index[0] * segment.period_s
        part = case.samples.between(begin_s, min(segment.end_s, begin_s + _LOOKED_AT_S))
        grid: FloatArray = np.arange(part.time_s[0], part.time_s[-1], _GRID_S)
        turned = np.exp(2j * np.pi * np.outer(grid - segment.start_s, fit.lines_hz))
        rest = np.interp(grid, part.time_s, part.speed_rad_s) - (turned @ fit.speed.mean(axis=0)).real
        swing_rad_s, mean_rad_s = math.sqrt(2.0) * float(rest.std()), abs(float(rest.mean()))
        period_s, regular = repeats(rest, _GRID_S)
        if regular < STICK_SLIP_REGULAR or period_s <= 0.0:
            continue
        torque_nm = inertia_kg_m2 * 2.0 * np.pi / period_s * swing_rad_s
        downhole = downhole_swing_rad_s(torque_nm, pipe.impedance_nm_s_rad, pipe.delay_s, period_s)
        if downhole >= STICK_SLIP_SHARE * mean_rad_s:
            raise Refused(
                f"stick-slip: besides the excitation the speed oscillates by ±{swing_rad_s:.2f} rad/s every "
                f"{period_s:.1f} s about {mean_rad_s:.3g} rad/s, as above a bit that sticks and slips",
                "lift the bit off bottom, take weight off it, or turn faster",
                entry=MessageCode.STICK_SLIP_RECORDED,
            )


def _budget(fitted: FittedModel, low: float, high: float, confidence: float, scale: float) -> tuple[BudgetLine, ...]:
    at, size = fitted.problem.model.at, fitted.problem.model.mechanical
    lags = tuple(at(index) for index in (signal_filters.SPEED_LAG, signal_filters.TORQUE_LAG, signal_filters.SKEW))
    echo = tuple(range(ECHO, size))

    def half(*known: int) -> float:
        return half_width_first_order(fitted, INERTIA, confidence, known)

    grown = (
        ("noise", half(VISCOUS, RESISTANCE, *echo, *lags), "scatter from period to period, with the noise of the "
                                                           "bit"),
        ("echo", half(VISCOUS, RESISTANCE, *lags), "unknown reflection at the bottom"),
        ("string", half(*lags), "characteristic impedance of the pipe, and friction at the top"),
        ("lags", half(), "time constants of the reporting filters"),
        ("lag structure", 0.5 * (high - low), "filters of two poles, moving averages"),
    )
    return (
        *grown_lines(grown, 0.5 * (high - low)),
        torque_scale_line(float(fitted.likelier.theta[INERTIA]), scale, confidence),
    )
