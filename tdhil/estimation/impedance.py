"""Impedance of the drive's own speed loop, from a recording in which a known input moved the loop.

::

    ω = E u / Z,   Z = J s + B + F H_t (P + I/s)         E = H_t e^(−ds)              a torque offset u
                                                         E = H_t (P + I/s) G e^(−ds)   the speed reference u
    W = H_w ω      T = κ H_T (J s + B) ω e^(−ks)         reported speed and torque

H_t = 1/(1 + τ_t s): torque loop. F = 1/(1 + τ_f s): speed filter in the loop. H_w and H_T: filters of the reports. G:
the known reference filter, 1 without one. d: delay of a command. k: time by which torque is read later than speed. κ:
reported torque over commanded torque.

**Why these signals suffice.** The string loads a drive with constant reference by τ: −τ/ω = Z. A torque offset acts at
the same place as the string, except for H_t. Z then follows from W alone, for any J. T also gives J s + B, and so the
parts of Z. With an input at the reference, Z follows only from the gains of the loop, and smoothing of the reference
would change them. The fit therefore searches for an undeclared filter, and refuses the result if it finds one.

**Ratio of the torque scales.** A torque offset is known in the scale of the commanded torque, and T in the scale of the
reported torque. At low frequencies only J − P (τ_t + τ_f) acts on ω. So a ratio κ of 1.03, taken as 1, changes the
inner lags by 0.03 J/P. With a torque offset, κ is therefore a parameter. The data determine it as far as they can;
besides, κ is known within the standard uncertainties of both scales. All other values are in the scale of the command.
With an input at the reference, ω does not depend on the scale of torque: Z is in the scale of the report, and κ counts
only in the P and I of the drive.

**A lag of 0.** If the best lag is at its bound of 0, the intervals of the inner lags come from the profile likelihood:
−2 ln L of the best fit for each fixed value. All other intervals include the variance of the lags at their bounds, as
if these were free.

**Lines.** Under speed control a disturbance of the shaft decays. The scatter from period to period is mostly what one
period passes to the next; it cancels in the mean, but would count as error. Therefore all P counted periods are one
stretch. The excited lines are at every P-th of its frequencies. The lines beside them, where nothing was commanded,
contain the same noise: ν of them give its covariance.

**Likelihood.** The command is known exactly: it is rounded as it was sent, and held from sample to sample, which
multiplies its lines by (1 − e^(−jωh))/(jωh). Both reports' lines are Gaussian about the model. B is tied to the levels;
stated lags, the skew and the delay d have priors. The weights are estimates: E S⁻¹ = ν/(ν − 2) Σ⁻¹, and an estimator
with these weights scatters more than the best one by ν/(ν − 1). The information is divided by both factors, and
Student's t has its degrees of freedom.

**The gain that the drive has.** A drive computes its integral from samples, every h. Two rules are common: the sum of
all samples before the present one, and the same with the present one. Their transfer functions are I h/(z − 1) and
I h z/(z − 1) with z = e^(sh). The series in s h begins with I/s − I h/2 and with I/s + I h/2. So the string sees
P − I h/2 or P + I h/2, and P is the gain in the drive's parameters. Z itself is as measured. Neither h nor the rule is
reported. P therefore has a further contribution: a rectangular distribution of half-width I h/2, with the longest usual
h. The next term, I s h²/12, is an inertia of I h²/12; it is negligible.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from profiles.quantities import printed_interval
from tdhil.estimation.case import PeriodicCase
from tdhil.estimation.frequency_domain import AT_BOUND, CERTAIN, Box, descend, student_quantile
from tdhil.estimation.result import DriveImpedance, Estimate, ImpedancePoint, ResidualTest, Verdict, rejects
from tdhil.estimation.samples import Stretch, usual_interval
from tdhil.estimation.spectrum import BLOCK, FLOOR, ComplexArray
from tdhil.recording import BoolArray, FloatArray, ImpedanceInput

OFFSET: Final = "offset"
REFERENCE: Final = "reference"

(
    INERTIA, VISCOUS, GAIN, INTEGRAL, TORQUE_LAG, SPEED_FILTER, SPEED_REPORT, TORQUE_REPORT, DELAY, SKEW,
    REFERENCE_FILTER, TORQUE_RATIO,
) = range(12)
_SIZE: Final = 12              # number of parameters: those of the line above
_LAG_BOUND_S, _INNER_BOUND_S, _DELAY_BOUND_S = 3.0, 0.5, 0.5
"""Bounds of the fit, s: lags of the reports and of the reference, lags inside the drive's loop, delay and time offset.
They keep the descent from running away: a parameter at its bound has no standard deviation."""
_LAGS: Final = (TORQUE_LAG, SPEED_FILTER, SPEED_REPORT, TORQUE_REPORT)
_RATIO_BOUNDS: Final = (0.5, 2.0)      # of the ratio of the torque scales
_PROFILE_SHARE = 0.01          # of the quadratic half-width: accuracy of an end of a profile interval
_MOST_PROFILE_FITS = 12        # fits for one end of a profile interval, at most
_SIGNALS = 2                   # speed and torque
_LEAST_PERIODS = 5             # fewest periods in a row: an excited line then has at least four lines beside it
_BESIDE = 5                    # most noise lines used on either side of an excited line
_LEAST_LINES = 4          # fewest lines for the fit
_CLEAR = 9.0                   # |mean|² over its variance, from which a line is clear
_STARTS_S = ((0.40, 0.15), (0.05, 0.02), (0.1, 0.4))   # s; start values of the lags of speed and torque
_REFERENCE_GAIN = 10.83        # gain of −2 ln L from which a reference filter is real: probability 0.001 by chance
_SMALL_FILTER_LOSS = 3.84      # rise of −2 ln L by which the data contradict a filter: probability 0.05 by chance
_SMALL_FILTERS_S = tuple(0.01 * k for k in range(1, 16))
_POINTS = 49                   # points of the curve
CONTROL_PERIOD_S = 0.002
"""Assumed control period of an inverter's speed loop, s: the longest that is usual, and the simulated drive's."""


def measure_impedance(case: PeriodicCase) -> DriveImpedance:
    """Return the impedance. A problem in the data never raises an error; it gives a refusal."""
    asked = case.recording.impedance
    assert asked is not None
    problem = _problem(case, asked)
    if isinstance(problem, DriveImpedance):
        return problem
    try:
        return _conclude(case, asked, problem)
    except (np.linalg.LinAlgError, FloatingPointError, ValueError):
        return refusal(asked, "no speed loop of P and I is determined by these frequencies", _MORE)


def refusal(asked: ImpedanceInput, reason: str, advice: str) -> DriveImpedance:
    """Return a result without values, with the reason."""
    return DriveImpedance(Verdict.NOT_IDENTIFIABLE, asked.by, reason, advice, asked.string_nm_s_rad)


_MORE: Final = "let it run for longer (--periods), or with more room in limits.torque_nm and the speed window"


# ---------------------------------------------------------------------------------------------------------------------
# Spectral lines of the command (rounded as it was sent), and of the reports.


@dataclass(frozen=True)
class ImpedanceLine:
    """One excited line: speed and torque of M segments, and the covariance of one segment's mean with ``nu`` complex
    dof.
    """

    hertz: float
    u: ComplexArray                # (M,) command
    x: ComplexArray                # (M, 2)
    covariance: ComplexArray       # (2, 2)
    nu: float

    @property
    def answers(self) -> bool:
        """True if speed and torque are both clear of their noise."""
        noise = np.diag(self.covariance).real
        return bool(np.all(np.abs(self.x) ** 2 > _CLEAR * noise[None, :]))


def lines_of(case: PeriodicCase, asked: ImpedanceInput) -> tuple[ImpedanceLine, ...]:
    """Return the lines of the longest run of whole periods of every segment; () if a segment has too few periods."""
    pieces = []
    for stretch, fit_ in zip(case.stretches, case.fits, strict=True):
        # positions in `periods` of the longest run of consecutive periods
        runs = np.split(np.arange(len(stretch.index)), np.flatnonzero(np.diff(stretch.index) != 1) + 1)
        run = tuple(max(runs, key=len).tolist())
        if len(run) < _LEAST_PERIODS:
            return ()
        pieces.append((stretch.segment.lines_hz, commanded(stretch, asked), *_spectrum(stretch, run, fit_.rounding)))
    if not pieces or len({hertz for hertz, *_ in pieces}) > 1:
        return ()
    found = []
    for k, hertz in enumerate(pieces[0][0]):
        nu = float(sum(piece[3][k].shape[0] for piece in pieces))
        noise = [np.einsum("ni,nj->ij", piece[3][k], piece[3][k].conj()) for piece in pieces]
        covariance: ComplexArray = np.sum(noise, axis=0) / nu + np.mean([np.diag(piece[4]) for piece in pieces], axis=0)
        found.append(
            ImpedanceLine(hertz, np.array([piece[1][k] for piece in pieces]),
                          np.array([piece[2][k] for piece in pieces]),
                 covariance, nu)
        )
    return tuple(found)


def _spectrum(
    stretch: Stretch, run: tuple[int, ...], rounding: tuple[float, float]
) -> tuple[ComplexArray, tuple[ComplexArray, ...], FloatArray]:
    """Return speed and torque of the excited lines (K, 2), the lines beside each (ν, 2), and the repeating rounding
    error.

    Least squares on the actual time stamps, for all lines and a ramp together.
    """
    segment = stretch.segment
    count = len(run)
    reach = min(count // 2, _BESIDE)
    time = np.concatenate([stretch.periods[k].time_s for k in run])
    signals = np.column_stack([
        np.concatenate([stretch.periods[k].speed_rad_s for k in run]),
        np.concatenate([stretch.periods[k].torque_nm for k in run]),
    ])
    turns = [round(hertz * segment.period_s) * count for hertz in segment.lines_hz]
    beside = [
        [turn + step for step in range(-reach, reach + 1) if step and turn + step > 0] for turn in turns
    ]
    every = sorted({*turns, *(turn for some in beside for turn in some)})
    omega = 2.0 * np.pi * np.asarray(every) / (count * segment.period_s)
    size = 2 + 2 * len(every)
    normal, right = np.zeros((size, size)), np.zeros((size, 2))
    middle = 0.5 * (time[0] + time[-1])
    span = time[-1] - time[0]
    for first in range(0, len(time), BLOCK):
        block = slice(first, first + BLOCK)
        angle = np.multiply.outer(time[block] - segment.start_s, omega)
        design = np.column_stack([
            np.ones(len(angle)), 2.0 * (time[block] - middle) / span, np.cos(angle), np.sin(angle)
        ])
        normal += design.T @ design
        right += design.T @ signals[block]
    solved = np.linalg.solve(normal, right)
    table: ComplexArray = solved[2 : 2 + len(every)] - 1j * solved[2 + len(every) :]
    at = {turn: number for number, turn in enumerate(every)}
    excited: ComplexArray = table[[at[turn] for turn in turns]]
    noise = tuple(table[[at[turn] for turn in some]] for some in beside)
    floor = FLOOR * np.max(np.abs(excited) ** 2, axis=0)
    return excited, noise, np.asarray(rounding) + floor


def commanded(stretch: Stretch, asked: ImpedanceInput) -> ComplexArray:
    """Return the lines (K,) of the command in the first counted period, as the held signal that was sent."""
    segment, period = stretch.segment, stretch.periods[0]
    time = period.time_s - segment.start_s
    omega = 2.0 * np.pi * np.asarray(segment.lines_hz)
    mean, sizes = segment.offset_rad_s, segment.amplitudes_rad_s
    if asked.by == OFFSET:
        mean, sizes = 0.0, segment.torque_amplitudes_nm
    angle = np.multiply.outer(time, omega)
    wave = mean + np.cos(angle + np.asarray(segment.phases_rad)) @ np.asarray(sizes)
    if asked.count > 0.0:
        wave = np.round(wave / asked.count) * asked.count
    design = np.column_stack([np.ones(len(time)), np.cos(angle), np.sin(angle)])
    found = np.linalg.solve(design.T @ design, design.T @ wave)
    count = len(omega)
    step = 1j * omega * usual_interval(period.time_s)
    lines: ComplexArray = (found[1 : 1 + count] - 1j * found[1 + count :]) * (1.0 - np.exp(-step)) / step
    return lines


# ---------------------------------------------------------------------------------------------------------------------

@dataclass(frozen=True)
class _Prior:
    row: FloatArray                # (P,)
    mean: float
    sd: float
    reported: bool = False         # in the scale of the reported torque

    def residual(self, theta: FloatArray) -> float:
        """Return the deviation in standard deviations."""
        scale = theta[TORQUE_RATIO] if self.reported else 1.0
        return float((scale * (self.row @ theta) - self.mean) / self.sd)


@dataclass(frozen=True)
class ImpedanceProblem:
    """K lines of M segments: ``x`` (K, M, 2) speed and torque, ``u`` (K, M) the command; ``white`` (K, 2, 2)."""

    by: str
    declared_s: float              # time constant of the reference filter
    ratio: float                   # expected ratio of the torque scales, reported over commanded
    s: ComplexArray
    u: ComplexArray
    x: ComplexArray
    covariance: ComplexArray       # (K, 2, 2)
    white: ComplexArray
    nu: FloatArray                 # (K,)
    priors: tuple[_Prior, ...]

    def model(self, theta: FloatArray) -> ComplexArray:
        """Return speed and torque (K, 2) for one unit of the command."""
        s = self.s
        omega = excitation_of(self.by, theta, s, self.declared_s) / impedance_of(theta, s)
        speed = omega / (1.0 + theta[SPEED_REPORT] * s)
        torque = theta[TORQUE_RATIO] * (theta[INERTIA] * s + theta[VISCOUS]) * omega * np.exp(-theta[SKEW] * s)
        torque = torque / (1.0 + theta[TORQUE_REPORT] * s)
        return np.stack([speed, torque], axis=1)

    def errors(self, theta: FloatArray) -> ComplexArray:
        """Return the residuals (K, M, 2) of speed and torque."""
        left: ComplexArray = self.x - self.model(theta)[:, None, :] * self.u[:, :, None]
        return left

    def residuals(self, theta: FloatArray) -> FloatArray:
        """Return the residuals of the lines and then of the priors, each with unit variance."""
        whitened = math.sqrt(2.0) * np.einsum("kij,kmj->kmi", self.white, self.errors(theta))
        known = [one.residual(theta) for one in self.priors]
        return np.concatenate([whitened.real.ravel(), whitened.imag.ravel(), np.asarray(known, dtype=np.float64)])

    def slopes(self, theta: FloatArray, scale: FloatArray) -> FloatArray:
        """Return ∂residuals/∂theta, by central differences."""
        return _slopes(self.residuals, theta, scale)


def _slopes(function: Callable[[FloatArray], FloatArray], theta: FloatArray, scale: FloatArray) -> FloatArray:
    columns = []
    for index, step in enumerate(1e-5 * scale):
        above, below = theta.copy(), theta.copy()
        above[index] += step
        below[index] -= step
        columns.append((function(above) - function(below)) / (2.0 * step))
    return np.stack(columns, axis=-1)


def control_law(theta: FloatArray, s: ComplexArray) -> ComplexArray:
    """Return the control law H_t (P + I/s), N·m·s/rad."""
    found: ComplexArray = (theta[GAIN] + theta[INTEGRAL] / s) / (1.0 + theta[TORQUE_LAG] * s)
    return found


def impedance_of(theta: FloatArray, s: ComplexArray) -> ComplexArray:
    """Return the impedance Z, N·m·s/rad."""
    found: ComplexArray = theta[INERTIA] * s + theta[VISCOUS] + control_law(theta, s) / (1.0 + theta[SPEED_FILTER] * s)
    return found


def excitation_of(by: str, theta: FloatArray, s: ComplexArray, declared_s: float) -> ComplexArray:
    """Return E, the torque on a blocked shaft for one unit of the command."""
    late = np.exp(-theta[DELAY] * s)
    found: ComplexArray = late / (1.0 + theta[TORQUE_LAG] * s)
    if by == REFERENCE:
        found = control_law(theta, s) * late / ((1.0 + theta[REFERENCE_FILTER] * s) * (1.0 + declared_s * s))
    return found


def _problem(case: PeriodicCase, asked: ImpedanceInput) -> ImpedanceProblem | DriveImpedance:
    lines = lines_of(case, asked)
    if len(lines) < _LEAST_LINES:
        return refusal(asked, f"{case.periods_used} usable whole periods are too few to know the noise", _MORE)
    clear = [line for line in lines if line.answers]
    if len(clear) < _LEAST_LINES:
        what = "torque offset" if asked.by == OFFSET else "speed reference"
        return refusal(
            asked, f"only {len(clear)} of {len(lines)} lines of the {what} are visible in speed and torque",
            "check that the drive accepts it in this mode. If it does, raise limits.torque_nm or widen the speed "
            "window",
        )
    covariance: ComplexArray = np.array([line.covariance for line in lines], dtype=np.complex128)
    white: ComplexArray = np.linalg.inv(np.linalg.cholesky(covariance)).astype(np.complex128)
    return ImpedanceProblem(
        by=asked.by,
        declared_s=asked.reference_filter_s,
        ratio=asked.torque_ratio if asked.by == OFFSET else 1.0,
        s=np.array([2j * np.pi * line.hertz for line in lines], dtype=np.complex128),
        u=np.array([line.u for line in lines], dtype=np.complex128),
        x=np.array([line.x for line in lines], dtype=np.complex128),
        covariance=covariance,
        white=white,
        nu=np.array([line.nu for line in lines]),
        priors=_priors(case, asked, usual_interval(case.stretches[0].periods[0].time_s)),
    )


def _priors(case: PeriodicCase, asked: ImpedanceInput, period_s: float) -> tuple[_Prior, ...]:
    """Return the prior knowledge: the delay of a command (about one cycle), the time offset, stated lags, the ratio of
    the torque scales, and B from levels.
    """
    known = case.recording.lag_prior
    found = [_prior(DELAY, 0.25 * period_s, max(period_s, 1e-3)), _prior(SKEW, 0.0, max(known.skew_sd_s, 1e-4))]
    if known.speed_lag_s is not None:
        found.append(_prior(SPEED_REPORT, known.speed_lag_s, max(known.speed_lag_sd_s, 1e-4)))
    if known.torque_lag_s is not None:
        found.append(_prior(TORQUE_REPORT, known.torque_lag_s, max(known.torque_lag_sd_s, 1e-4)))
    ratio_sd = _ratio_rel_sd(case, asked)
    if asked.by == OFFSET and ratio_sd > 0.0:
        found.append(_prior(TORQUE_RATIO, asked.torque_ratio, asked.torque_ratio * ratio_sd))
    tie = case.constraint
    if tie is not None:
        row = np.zeros(_SIZE)
        row[VISCOUS], row[INERTIA] = 1.0, tie.slope_per_inertia
        widened = math.sqrt(tie.dof / (tie.dof - 2.0)) if tie.dof > 3.0 else 2.0
        found.append(_Prior(row, tie.slope, widened * tie.sd, reported=True))
    return tuple(found)


def _ratio_rel_sd(case: PeriodicCase, asked: ImpedanceInput) -> float:
    """Return the relative standard uncertainty of the ratio of the torque scales.

    The drive converts commands and reports separately. Each of the two scales has the stated standard uncertainty, so
    their ratio has √2 times as much.
    """
    stated = asked.torque_ratio_rel_sd
    return math.sqrt(2.0) * case.recording.torque_scale_rel_sd if stated is None else stated


def _prior(index: int, mean: float, sd: float) -> _Prior:
    row = np.zeros(_SIZE)
    row[index] = 1.0
    return _Prior(row, mean, sd)


# ---------------------------------------------------------------------------------------------------------------------
# Fit: for several start values of the reporting lags, the other start values follow by linear least squares.


@dataclass(frozen=True)
class FittedImpedance:
    """Best theta, the parameters that moved and ended inside their bounds, and −2 ln L up to a constant.

    ``zero``: lags that ended at their bound of 0.
    """

    theta: FloatArray
    inside: BoolArray
    zero: BoolArray
    objective: float
    scale: FloatArray


def fit(problem: ImpedanceProblem, *, with_filter: bool = False) -> FittedImpedance:
    """Return the best fit. ``with_filter``: also fit a first-order reference filter."""
    held = _held(problem, with_filter=with_filter)
    stated = {int(np.argmax(one.row)): one.mean for one in problem.priors if np.count_nonzero(one.row) == 1}
    best: FittedImpedance | None = None
    for lags in _STARTS_S:
        speed, torque = stated.get(SPEED_REPORT, lags[0]), stated.get(TORQUE_REPORT, lags[1])
        found = _descended(problem, _start(problem, speed, torque, stated[DELAY], with_filter), held)
        best = found if best is None or found.objective < best.objective else best
    assert best is not None
    return best


def _held(problem: ImpedanceProblem, *, with_filter: bool = False) -> set[int]:
    """Return the parameters that the fit does not change."""
    held = set() if with_filter and problem.by == REFERENCE else {REFERENCE_FILTER}
    return held if any(one.row[TORQUE_RATIO] for one in problem.priors) else held | {TORQUE_RATIO}


def _descended(
    problem: ImpedanceProblem, start: FloatArray, held: set[int], like: FloatArray | None = None
) -> FittedImpedance:
    """Return the fit from ``start``. Bounds and natural scales follow from ``like``; by default, from ``start``."""
    like = start if like is None else like
    inertia, viscous, gain, integral = (float(like[k]) for k in (INERTIA, VISCOUS, GAIN, INTEGRAL))
    friction = max(abs(viscous), 0.01 * gain, 0.01 * inertia)
    scale = np.array([inertia, friction, gain, integral, 0.01, 0.01, 0.1, 0.1, 0.005, 0.005, 0.05,
                      0.01])
    high = np.array([100.0 * inertia, 100.0 * friction, 1e3 * gain, 1e4 * integral, _INNER_BOUND_S, _INNER_BOUND_S,
                     _LAG_BOUND_S, _LAG_BOUND_S, _DELAY_BOUND_S, _DELAY_BOUND_S, _LAG_BOUND_S, _RATIO_BOUNDS[1]])
    low = np.zeros(_SIZE)
    low[TORQUE_RATIO] = _RATIO_BOUNDS[0]
    positive = [INERTIA, GAIN, INTEGRAL]
    low[positive] = 1e-4 * like[positive]
    low[VISCOUS], low[SKEW], low[DELAY] = -high[VISCOUS], -_DELAY_BOUND_S, -_DELAY_BOUND_S
    free: BoolArray = np.array([index not in held for index in range(_SIZE)])
    box = Box(low, high, scale)
    found = descend(
        lambda theta: (problem.residuals(theta), lambda: problem.slopes(theta, scale)), start, free, box
    )
    near = AT_BOUND * scale
    inside = free & (found.theta > low + near) & (found.theta < high - near)
    lags = np.isin(np.arange(_SIZE), _LAGS)
    return FittedImpedance(found.theta, inside, free & lags & (found.theta <= low + near), found.objective, scale)


def _start(problem: ImpedanceProblem, speed_s: float, torque_s: float, delay_s: float, with_filter: bool) -> FloatArray:
    s, u = problem.s[:, None], problem.u
    omega = problem.x[:, :, 0] * (1.0 + speed_s * s)
    torque = problem.x[:, :, 1] * (1.0 + torque_s * s) / problem.ratio
    ones = np.ones_like(omega)
    inertia, viscous = _real_fit([s * ones, ones], torque / omega)
    inertia = inertia if inertia > 0.0 else float(np.median(np.abs(torque / omega / s)))
    law = u / omega - (inertia * s + viscous) if problem.by == OFFSET else torque / (u - omega)
    gain, integral = _real_fit([ones, ones / s], law)
    least = 1e-3 * float(np.median(np.abs(inertia * s)))
    theta = np.zeros(_SIZE)
    theta[[INERTIA, VISCOUS, GAIN, INTEGRAL]] = inertia, viscous, max(gain, least), max(integral, least)
    theta[[TORQUE_LAG, SPEED_FILTER, SPEED_REPORT, TORQUE_REPORT]] = 0.01, 0.02, speed_s, torque_s
    theta[DELAY] = delay_s
    theta[REFERENCE_FILTER] = 0.05 if with_filter else 0.0
    theta[TORQUE_RATIO] = problem.ratio
    return theta


def _real_fit(columns: Sequence[NDArray[np.complex128]], target: NDArray[np.complex128]) -> tuple[float, float]:
    """Return real a, b with a·first + b·second ≈ target, each equation relative to its size."""
    weight = 1.0 / np.maximum(np.abs(target), 1e-300).ravel()
    table = np.stack([(column.ravel() * weight) for column in columns], axis=1)
    right = target.ravel() * weight
    both = np.concatenate([table.real, table.imag])
    found = np.linalg.lstsq(both, np.concatenate([right.real, right.imag]), rcond=None)[0]
    return float(found[0]), float(found[1])


# ---------------------------------------------------------------------------------------------------------------------
# Results: values with intervals from the quadratic approximation, and the residual test.


class _ThetaSpread:
    """Covariance of theta, and the degrees of freedom of the values derived from it.

    ``other``: a second fit that the data also allow. Each interval then covers both.
    """

    def __init__(
        self, problem: ImpedanceProblem, fitted: FittedImpedance, confidence: float, other: _ThetaSpread | None = None
    ) -> None:
        self._problem, self._fitted, self._confidence, self._other = problem, fitted, confidence, other
        self._moved = np.flatnonzero(fitted.inside | fitted.zero)
        slopes = problem.slopes(fitted.theta, fitted.scale)[:, self._moved]
        lines = 2 * problem.x.size
        count, segments = len(problem.s), problem.x.shape[1]
        nu = problem.nu
        shrunk = (nu - _SIGNALS) / nu * (nu - 1.0) / nu
        of_line = slopes[:lines].reshape(2, count, segments * _SIGNALS, -1)
        parts = [shrunk[k] * sum(of_line[half, k].T @ of_line[half, k] for half in range(2)) for k in range(count)]
        self._dof = [*(2.0 * (nu - 1.0)), *([math.inf] * (len(slopes) - lines))]
        parts += [np.outer(row, row) for row in slopes[lines:]]
        self._parts = parts
        size = fitted.scale[self._moved]
        information: FloatArray = np.sum(parts, axis=0) * np.outer(size, size)
        self._inverse = np.linalg.pinv(information, rcond=1e-13, hermitian=True) * np.outer(size, size)
        plain = (slopes.T @ slopes) * np.outer(size, size)
        self._plain = np.linalg.pinv(plain, rcond=1e-13, hermitian=True) * np.outer(size, size)

    def around(self, function: Callable[[FloatArray], FloatArray], extra_sd: FloatArray | None = None
               ) -> tuple[Estimate, ...]:
        """Return each value of ``function`` of theta with its interval; ``extra_sd`` is added in quadrature."""
        value = function(self._fitted.theta)
        slopes = _slopes(function, self._fitted.theta, self._fitted.scale)[:, self._moved]
        found = []
        for index, (one, row) in enumerate(zip(value, slopes, strict=True)):
            column = self._inverse @ row
            shares = np.array([column @ part @ column for part in self._parts])
            variance = max(float(row @ column), 0.0)
            open_share = float(np.sum([share**2 / dof for share, dof in zip(shares, self._dof, strict=True)]))
            dof = max(1.0, min(float(np.sum(shares)) ** 2 / open_share if open_share > 0.0 else 1e6, 1e6))
            half = student_quantile(self._confidence, dof) * math.sqrt(variance)
            if extra_sd is not None:
                half = math.hypot(half, student_quantile(self._confidence, CERTAIN) * float(extra_sd[index]))
            found.append(Estimate(float(one), float(one - half), float(one + half)))
        if self._other is not None:
            also = self._other.around(function, extra_sd)
            found = [replace(one, low=min(one.low, two.low), high=max(one.high, two.high))
                     for one, two in zip(found, also, strict=True)]
        return tuple(found)

    def at_least_zero(
        self, rows: FloatArray, *, extra_sd: FloatArray | None = None, profiled: bool = False
    ) -> tuple[Estimate, ...]:
        """Return the sum of parameters that each row (N, P) selects, with its interval, not below 0.

        ``profiled``: the intervals are those of the profile likelihood. They are so too with an inner lag at its bound
        of 0. ``extra_sd`` (N,) is added in quadrature.
        """
        found = [_not_below_zero(one) for one in self.around(lambda theta: rows @ theta, extra_sd)]
        if profiled or self._fitted.zero[[TORQUE_LAG, SPEED_FILTER]].any():
            plain = self.around(lambda theta: rows @ theta)
            found = [self._profiled(row, one) for row, one in zip(rows, plain, strict=True)]
            if extra_sd is not None:
                more = student_quantile(self._confidence, CERTAIN) * extra_sd
                found = [Estimate(one.value, max(one.value - math.hypot(one.value - one.low, add), 0.0),
                                  one.value + math.hypot(one.high - one.value, add))
                         for one, add in zip(found, more.tolist(), strict=True)]
        if self._other is not None:
            also = self._other.at_least_zero(rows, extra_sd=extra_sd, profiled=profiled)
            found = [replace(one, low=min(one.low, two.low), high=max(one.high, two.high))
                     for one, two in zip(found, also, strict=True)]
        return tuple(found)

    def _profiled(self, row: FloatArray, quadratic: Estimate) -> Estimate:
        value, half = quadratic.value, quadratic.high - quadratic.value
        column = row[self._moved]
        variance = float(column @ self._plain @ column)
        if not (half > 0.0 and variance > 0.0 and math.isfinite(half)):
            return _not_below_zero(quadratic)
        allowed = half / math.sqrt(variance)
        toward = np.zeros(_SIZE)
        toward[self._moved] = self._plain @ column / variance

        def rise(target: float) -> float:
            """Return √ of the rise of −2 ln L with the sum held at ``target``, over the allowed one."""
            tight = _Prior(row, target, 1e-3 * half)
            bound = replace(self._problem, priors=(*self._problem.priors, tight))
            start = self._fitted.theta + (target - value) * toward
            best = _descended(bound, start, _held(self._problem), self._fitted.theta)
            return math.sqrt(max(best.objective - tight.residual(best.theta) ** 2 - self._fitted.objective, 0.0)
                             ) / allowed

        high = _crossing(rise, value, half, math.inf if row[GAIN] else _INNER_BOUND_S * float(np.sum(row)))
        low = _crossing(rise, value, -half, 0.0) if value > 0.0 else 0.0
        return Estimate(value, low, high)


def _crossing(rise: Callable[[float], float], value: float, step: float, limit: float) -> float:
    """Return the point at which ``rise`` exceeds 1, from ``value`` in the direction of ``step``, at most ``limit``.

    The point is outside of the crossing by at most `_PROFILE_SHARE` of ``step``.
    """
    def further(point: float) -> float:
        return min(point + step, limit) if step > 0.0 else max(point + step, limit)

    inner, at_inner = value, 0.0
    outer = further(inner)
    at_outer = rise(outer)
    for _ in range(_MOST_PROFILE_FITS):
        if at_outer < 1.0:
            if outer == limit:
                break
            inner, at_inner, outer = outer, at_outer, further(outer)
            at_outer = rise(outer)
            continue
        if abs(outer - inner) <= _PROFILE_SHARE * abs(step):
            break
        share = min(max((1.0 - at_inner) / (at_outer - at_inner), 0.1), 0.9)
        middle = inner + (outer - inner) * share
        at_middle = rise(middle)
        if at_middle < 1.0:
            inner, at_inner = middle, at_middle
        else:
            outer, at_outer = middle, at_middle
    return outer


def residual_test(problem: ImpedanceProblem, fitted: FittedImpedance) -> ResidualTest | None:
    """Return Bartlett's form of Wilks' Λ, (2ν + M − 2) ln det(1 + S⁻¹ Σ e eᴴ/ν) ~ χ²(4M) a line, with the priors'
    part.
    """
    from scipy.special import chdtrc

    errors = problem.errors(fitted.theta)
    segments = errors.shape[1]
    statistic = 0.0
    for k, nu in enumerate(problem.nu):
        spread = errors[k].T @ errors[k].conj()
        matrix = np.eye(_SIGNALS) + np.linalg.solve(problem.covariance[k], spread) / nu
        statistic += (2.0 * nu + segments - _SIGNALS) * math.log(abs(np.linalg.det(matrix)))
    statistic += sum(one.residual(fitted.theta) ** 2 for one in problem.priors)
    measured = 2.0 * _SIGNALS * segments * len(problem.nu) + len(problem.priors)
    left = measured - float(np.count_nonzero(fitted.inside))
    if left < 1.0:
        return None
    return ResidualTest(float(statistic), left, float(chdtrc(left, statistic)))


def _conclude(case: PeriodicCase, asked: ImpedanceInput, problem: ImpedanceProblem) -> DriveImpedance:
    fitted = fit(problem)
    test = residual_test(problem, fitted)
    bare = replace(refusal(asked, "", ""), residual=test, conditions=_conditions(case, asked))
    confidence = case.options.confidence
    shows = _undeclared(problem, fitted, confidence) if asked.by == REFERENCE else None
    p_value = 1.0 if test is None else test.p_value
    if shows is not None:
        seen, instead = shows
        other = f"one of {seen.value:.3g} s ({printed_interval(seen.low, seen.high, 3)})"
        expected = "no reference filter"
        if problem.declared_s > 0.0:
            other = f"{other} in place of it" if instead else f"a further {other} besides it"
            expected = f"the declared reference filter of {problem.declared_s:g} s"
        return replace(
            bare, verdict=Verdict.MODEL_REJECTED, reference_filter_s=seen,
            reason=f"the residuals contradict a speed loop with {expected} (p = {p_value:.2g}): {other} would explain"
            " them",
            advice="measure with --impedance offset: a reference filter does not affect it. Or disable the "
                   "filter in the drive, or state it (drive_data.reference_filter_s in rig.yaml)",
        )
    if rejects(test):
        return replace(
            bare, verdict=Verdict.MODEL_REJECTED,
            reason=f"the residuals contradict a rigid shaft under a speed loop of P and I (p = {p_value:.2g})",
            advice="Check three causes: a string or a brake on the shaft; another structure of the loop (feed-forward,"
            " ramp, notch); report filters other than first-order lags.",
        )
    spread = _ThetaSpread(problem, fitted, confidence, _small_filter(problem, fitted, confidence))
    # further standard uncertainties of P and I, from the drive's unknown rule of integration and the ratio of the
    # torque scales
    ratio_rel_sd = 0.0 if asked.by == OFFSET else _ratio_rel_sd(case, asked)
    fitted_gain, fitted_integral = float(fitted.theta[GAIN]), float(fitted.theta[INTEGRAL])
    sampled_sd = fitted_integral * 0.5 * CONTROL_PERIOD_S / math.sqrt(3.0)
    integral, inertia, viscous = spread.around(
        lambda theta: theta[[INTEGRAL, INERTIA, VISCOUS]], np.array([ratio_rel_sd * fitted_integral, 0.0, 0.0]))
    rows, extra = _rows(), np.array([math.hypot(sampled_sd, ratio_rel_sd * fitted_gain), 0.0, 0.0, 0.0])
    gain = spread.around(lambda theta: theta[[GAIN]], extra[:1])[0]
    wide = not gain.bounded
    if wide:      # allowed only if P would be bounded with the ratio of the torque scales known exactly
        exact = replace(fitted, inside=fitted.inside & (np.arange(_SIZE) != TORQUE_RATIO))
        if not (gain.finite
                and _ThetaSpread(problem, exact, confidence).around(lambda theta: theta[[GAIN]])[0].bounded):
            return replace(bare, reason="the data do not determine the gain of the loop", advice=_MORE)
    gain, inner, torque_lag, speed_filter = spread.at_least_zero(rows, extra_sd=extra, profiled=wide)
    explained = "untested" if test is None else f"p = {p_value:.2g}"
    return replace(
        bare,
        verdict=Verdict.VALID,
        reason=f"a speed loop of P and I on a rigid shaft explains speed and torque ({explained})",
        advice="; ".join(
            ([_WIDE] if wide else [])
            + ([] if asked.string_nm_s_rad > 0.0 else ["add --string-impedance to get |r|, too"])),
        gain_nm_s_rad=gain,
        integral_nm_rad=_not_below_zero(integral),
        inner_lag_s=inner,
        torque_lag_s=torque_lag,
        speed_filter_s=speed_filter,
        inertia_kg_m2=inertia,
        viscous_nm_s_rad=viscous,
        points=_points(case, asked, problem, fitted, spread),
    )


_WIDE: Final = (
    "P and the lags have wide intervals, because the scales of commanded and reported torque may differ. If you "
    "know both better, state a smaller drive_data.torque_scale_rel_sd in rig.yaml"
)


def _rows() -> FloatArray:
    """Return the rows (4, P) of P, the sum of the inner lags, the lag of the torque and the speed filter."""
    rows = np.zeros((4, _SIZE))
    for row, parameters in zip(rows, ((GAIN,), (TORQUE_LAG, SPEED_FILTER), (TORQUE_LAG,), (SPEED_FILTER,)),
                               strict=True):
        row[list(parameters)] = 1.0
    return rows


def _not_below_zero(one: Estimate) -> Estimate:
    return Estimate(one.value, max(one.low, 0.0), one.high)


def _undeclared(
    problem: ImpedanceProblem, plain: FittedImpedance, confidence: float
) -> tuple[Estimate, bool] | None:
    """Return the significant undeclared reference filter, and whether it replaces the declared one; None without one.

    False: the filter is additional. Of the two alternatives, the one that explains the data better is returned.
    """
    found = []
    for instead in (False, True) if problem.declared_s > 0.0 else (False,):
        wanted = replace(problem, declared_s=0.0) if instead else problem
        fitted = fit(wanted, with_filter=True)
        if plain.objective - fitted.objective >= _REFERENCE_GAIN and fitted.inside[REFERENCE_FILTER]:
            found.append((fitted.objective, instead, wanted, fitted))
    if not found:
        return None
    _, instead, wanted, fitted = min(found, key=lambda one: one[:2])
    spread = _ThetaSpread(wanted, fitted, confidence)
    return _not_below_zero(spread.around(lambda theta: theta[[REFERENCE_FILTER]])[0]), instead


def _small_filter(problem: ImpedanceProblem, plain: FittedImpedance, confidence: float) -> _ThetaSpread | None:
    """Return the fit with the largest undeclared reference filter that the data do not contradict; None if there is
    none.

    Such a filter changes P by more than P's own interval. With a torque offset as input, no reference filter has an
    effect.
    """
    if problem.by == OFFSET:
        return None
    largest, best = None, plain.objective
    start = plain.theta.copy()
    for filter_s in _SMALL_FILTERS_S:
        start[REFERENCE_FILTER] = filter_s
        fitted = _descended(problem, start, _held(problem))
        best = min(best, fitted.objective)
        if fitted.objective - best > _SMALL_FILTER_LOSS:
            break
        largest, start = fitted, fitted.theta.copy()
    return None if largest is None else _ThetaSpread(problem, largest, confidence)


def _points(
    case: PeriodicCase, asked: ImpedanceInput, problem: ImpedanceProblem, fitted: FittedImpedance, spread: _ThetaSpread
) -> tuple[ImpedancePoint, ...]:
    lines = problem.s.imag / (2.0 * math.pi)
    grid = np.geomspace(lines.min(), lines.max(), _POINTS)
    hertz = np.unique(np.concatenate([grid[(grid > lines.min() * 1.001) & (grid < lines.max() * 0.999)], lines]))
    s: ComplexArray = 2j * np.pi * hertz
    zeta, scale_sd = asked.string_nm_s_rad, case.recording.torque_scale_rel_sd

    def both(theta: FloatArray) -> FloatArray:
        z = impedance_of(theta, s)
        return np.concatenate([z.real, z.imag])

    def reflected(theta: FloatArray) -> FloatArray:
        return reflection(impedance_of(theta, s), zeta)

    parts = spread.around(both)
    real, imaginary = parts[: len(s)], parts[len(s) :]
    inner: list[Estimate | None] = [None] * len(s)
    total = inner
    if zeta > 0.0:
        z = impedance_of(fitted.theta, s)
        by_scale = np.abs(reflection(1.001 * z, zeta) - reflection(0.999 * z, zeta)) / 0.002 * scale_sd
        inner = [_not_below_zero(one) for one in spread.around(reflected)]
        total = [_not_below_zero(one) for one in spread.around(reflected, by_scale)]
    seen = _seen(problem, fitted)
    return tuple(
        ImpedancePoint(float(f), real[k], imaginary[k], inner[k], total[k], seen.get(round(float(f), 9)))
        for k, f in enumerate(hertz)
    )


def reflection(impedance: ComplexArray, string_nm_s_rad: float) -> FloatArray:
    """Return the reflection coefficient |r| = |Z − ζ|/|Z + ζ|."""
    found: FloatArray = np.abs((impedance - string_nm_s_rad) / (impedance + string_nm_s_rad))
    return found


def _seen(problem: ImpedanceProblem, fitted: FittedImpedance) -> dict[float, tuple[float, float]]:
    """Return Z (real, imaginary) from each line alone: E u/ω, with the lag of the reported speed removed."""
    theta, s = fitted.theta, problem.s
    driven = excitation_of(problem.by, theta, s, problem.declared_s) / (1.0 + theta[SPEED_REPORT] * s)
    speed = np.sum(problem.x[:, :, 0] * problem.u.conj(), axis=1)
    power = np.sum(np.abs(problem.u) ** 2, axis=1)
    z = driven * power / speed
    return {
        round(float(f), 9): (float(one.real), float(one.imag))
        for f, one in zip(s.imag / (2.0 * math.pi), z, strict=True)
    }


def _conditions(case: PeriodicCase, asked: ImpedanceInput) -> tuple[str, ...]:
    scale = "commanded torque" if asked.by == OFFSET else "reported torque"
    found = [f"P, I and Z in the scale of the drive's {scale}", "first-order lags in loop and reports",
             f"P for a drive that integrates every {1e3 * CONTROL_PERIOD_S:g} ms or faster"]
    if asked.by == REFERENCE:
        declared = asked.reference_filter_s
        found.append(f"a reference filter of {declared:g} s" if declared > 0.0 else "no reference filter")
    ratio_sd = _ratio_rel_sd(case, asked)
    found.append(f"reported torque over commanded torque {asked.torque_ratio:.4g} ± {100.0 * ratio_sd:.2g} % (1 sd)"
                 if ratio_sd > 0.0 else f"reported torque over commanded torque exactly {asked.torque_ratio:.4g}")
    if case.recording.lag_prior.source:
        found.append(f"reporting lags as stated by {case.recording.lag_prior.source}")
    return tuple(found)
