"""Values from bins: J and the other parameters with intervals, the uncertainty budget, and the test of the model."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from tdhil.estimation.candidates import NARROW_BAND, SQUARE, STRAIGHT, WIDE_BAND, FitRoute, ModelTrial, walk
from tdhil.estimation.frequency_domain import (
    LAG_BOUND_S,
    Fit,
    GaussianPrior,
    fisher_tail,
    profile_edge,
    simple_weight,
    student_quantile,
)
from tdhil.estimation.result import BudgetLine, Estimate, ResidualTest, doubtful
from tdhil.estimation.time_domain.equation import (
    BACK,
    BEND,
    FORWARD,
    INERTIA,
    SKEW,
    SPEED_LAG,
    SPEED_SHAPE,
    TORQUE_LAG,
    TORQUE_SHAPE,
    VISCOUS,
    evaluate,
    scale_slopes,
)
from tdhil.estimation.time_domain.fit import FitProblem, FoundFit, covariance, minimise, search
from tdhil.estimation.time_domain.taylor import ComplexArray
from tdhil.estimation.time_domain.windows import Bins, TaperWindow, joined, measure
from tdhil.recording import FloatArray

# ---------------------------------------------------------------------------------------------------------------------
# Local test: if any smooth response explains the bins better than the model, the model is wrong, and J may be too.
#
# Within neighbouring bins of one window the response of every shaft is nearly a straight line over frequency,
#
#     T = g₀ W_0 + g₁ (W_1 + (s − s₀) W_0),
#
# with two complex unknowns (the local polynomial method). The rest is noise, measured without a model. If the residual
# of the model is larger beyond chance (F test), the data contradict the model.


_GROUPS = (6, 4, 3)      # bins a group, largest first; a machine that stops often has few bins in a row
_FIRST = 2       # first bin of a window that is used: lower ones contain friction, constant and all


def local_test(problem: FitProblem, theta: FloatArray, factor: float) -> ResidualTest | None:
    """Return the F test of the model against local straight lines; None without enough bins in a row.

    ``factor``: scatter of the inertia over time, relative to the noise model. Noise that comes with the motion is
    common to many bins, so F is divided by factor², and its degrees of freedom are halved.
    """
    found = evaluate(theta, problem.bins)
    bins, variance = problem.bins, problem.variance
    for group in _GROUPS:
        by_model, by_line, dof_model, dof_line = 0.0, 0.0, 0, 0
        for number in np.unique(bins.window):
            mine = np.flatnonzero((bins.window == number) & (bins.hertz > 0.0))[_FIRST - 1 :]
            for first in range(0, len(mine) - group + 1, group):
                part = mine[first : first + group]
                weight = 1.0 / np.sqrt(variance[part])
                s = bins.s[part]
                lines = np.stack([bins.speed[part, 0],
                                  bins.speed[part, 1] + (s - s.mean()) * bins.speed[part, 0]], axis=1)
                u, _ = np.linalg.qr(lines * weight[:, None])
                error = found.error[part] * weight
                left = error - u @ (u.conj().T @ error)
                by_model += 2.0 * float(np.sum(np.abs(error) ** 2))
                by_line += 2.0 * float(np.sum(np.abs(left) ** 2))
                dof_model += 2 * group
                dof_line += 2 * (group - 2)
        extra = dof_model - len(problem.free) - dof_line
        if not (dof_line < 8 or extra < 2 or by_line <= 0.0):
            statistic = float((by_model - by_line) / extra / (by_line / dof_line) / factor**2)
            return ResidualTest(statistic, float(extra), fisher_tail(statistic, extra, 0.5 * dof_line))
    return None


# ---------------------------------------------------------------------------------------------------------------------
# Scatter over time: errors of time stamps, rounding and friction come with the motion.
#
# The score of the fit is a sum over bins, and by Parseval also one over time. With ε and δ, the signals whose lines are
# the residuals e_m/√v_m and their slopes ∂e_m/√v_m,
#
#     Σ_m 2 Re(∂e_m* e_m)/v_m = 1/T ∫ δ ε dt = Σ_b g_b,      Σ_b g_b = 0 at the best fit,
#
# with the part g_b of a block of time. Σ g_b g_bᵀ with its neighbours (weight ½) estimates the covariance of the score
# for any noise over time: H⁻¹ (Σ …) H⁻¹ is a covariance of theta without the assumption of stationary noise
# ("sandwich"). Divided by √v, both signals are nearly white. If e itself were cut into blocks, the residual of a slow
# load at the lowest frequencies would spread over the others, where less is expected, and the sandwich would be several
# times too large.


_BLOCK_S = 4.0            # s; least length of a block, unless it gives too few blocks
_BLOCKS = 40              # blocks, at most
_LEAST_BLOCKS = 10        # blocks, at least


@dataclass(frozen=True)
class BlockVariance:
    """Variance of one direction in parameter space by the sandwich, and the number of blocks for it."""

    variance: float
    count: float


def block_scores(problem: FitProblem, placed: tuple[TaperWindow, ...], theta: FloatArray) -> FloatArray:
    """Return g_b (blocks, 10), in order of time."""
    whole = evaluate(theta, problem.bins)
    return _in_blocks(problem, placed, whole.error, whole.slopes)


def _in_blocks(
    problem: FitProblem, placed: tuple[TaperWindow, ...], error: ComplexArray, slopes: ComplexArray
) -> FloatArray:
    """Return the parts (blocks, P) of the score of ``error`` (M,) with the ``slopes`` (M, P), in order of time."""
    total = sum(window.hop_s for window in placed)
    length = max(total / _BLOCKS, min(_BLOCK_S, total / _LEAST_BLOCKS))
    bins = problem.bins
    # the mean of a product of two real signals is half that of their lines, except at frequency zero
    white = np.where(bins.hertz > 0.0, 2.0, 1.0) / np.sqrt(problem.variance)
    both = np.column_stack([error, slopes]) * white[:, None]
    scores = []
    for window in placed:
        mine = bins.window == float(window.number)
        if not np.any(mine):
            continue
        turns = bins.hertz[mine] * window.hop_s
        blocks = max(1, round(window.hop_s / length))
        points = blocks * math.ceil((2.0 * float(turns.max()) + 1.0) / blocks)
        signals = (np.exp(2j * math.pi / points * np.outer(np.arange(points), turns)) @ both[mine]).real
        each = signals[:, 1:] * signals[:, :1] / points
        scores.append(each.reshape(blocks, -1, slopes.shape[1]).sum(axis=1))
    return np.concatenate(scores) if scores else np.zeros((0, slopes.shape[1]))


def sandwich(scores: FloatArray, direction: FloatArray) -> BlockVariance:
    """Return the variance of directionᵀ·theta, where ``direction`` = H⁻¹ e (10,)."""
    each = scores @ direction
    if len(each) < 3:
        return BlockVariance(0.0, 1.0)
    square = float(each @ each)
    neighbours = float(each[1:] @ each[:-1])
    count = square**2 / max(float(np.sum(each**4)), 1e-300)
    # the fit removes about one part in the effective number of blocks from each block
    return BlockVariance(max(square + neighbours, 0.5 * square) * count / max(count - 1.0, 1.0), count)


# ---------------------------------------------------------------------------------------------------------------------
# A torque scale that changes with the motion. The local test fits any smooth response over frequency, and is blind to
# it.
#
# If the scale changes with speed, as that of a current above base speed, J becomes J + J₁|ω|. If braking torque has
# another scale, as a current without the losses, a torque r T is added wherever T brakes. With the derivative of the
# residuals by such a parameter, less the part that all other parameters and friction ∝ speed² explain, one step of
# least squares gives the parameter. Its variance is the larger one of the noise model and of the sandwich, both with
# the residuals that the parameter leaves: otherwise the change would count as noise. Friction f(ω) hardly looks like
# J₁: over a record, ∫ f(ω) ω dω/dt dt depends on the first and the last speed only (docs/decisions/0091).


_CLEAR_CHANGE = 4.5       # sd; least clear change: few blocks of time make the tails of its distribution long
_LEAST_BY_SPEED = 0.03    # of J, from low to high speed; a smaller change does no harm beside the torque scale
_LEAST_BY_BRAKING = 0.08  # of the torque; noise of the torque itself looks like a few percent
_LOW_TO_HIGH = (0.05, 0.95)   # quantiles of the speed


@dataclass(frozen=True)
class ScaleChange:
    """Change of the torque's scale: as a ``share`` of J from the speed ``low_rad_s`` to ``high_rad_s``, or, if
    ``braking``, of braking torque against driving torque. ``clear``: the change in its own standard deviations.
    """

    braking: bool
    share: float
    low_rad_s: float
    high_rad_s: float
    clear: float

    @property
    def found(self) -> bool:
        least = _LEAST_BY_BRAKING if self.braking else _LEAST_BY_SPEED
        return abs(self.clear) > _CLEAR_CHANGE and abs(self.share) > least


def scale_changes(
    problem: FitProblem, placed: tuple[TaperWindow, ...], theta: FloatArray, braking: ComplexArray
) -> tuple[ScaleChange, ScaleChange]:
    """Return the change with the speed, and that between driving and braking; ``braking`` as in `scale_slopes`."""
    free = list(dict.fromkeys((*problem.free, BEND)))
    bins, nuisance = problem.bins, problem.box.scale[free]
    at, raw = evaluate(theta, bins), scale_slopes(theta, bins, braking)
    left, slopes = problem.stacked(theta)
    weight = (np.where(bins.hertz > 0.0, np.sqrt(2.0), 1.0) / np.sqrt(problem.variance))[:, None]
    columns = np.zeros((len(left), 3))
    columns[:, 0] = left
    columns[: 2 * len(bins), 1:] = np.concatenate([(raw * weight).real, (raw * weight).imag])
    by_others = np.linalg.lstsq(slopes[:, free] * nuisance, columns, rcond=None)[0]
    columns -= slopes[:, free] * nuisance @ by_others
    own: ComplexArray = np.column_stack([at.error, raw]) - at.slopes[:, free] * nuisance @ by_others
    speeds = np.abs(np.concatenate([window.part(0.0, window.length_s).speed_rad_s for window in placed]))
    low, high = (float(speed) for speed in np.quantile(speeds, _LOW_TO_HIGH))
    found = []
    for number, unit in ((1, (high - low) / max(abs(float(theta[INERTIA])), 1e-300)), (2, 1.0)):
        information = max(float(columns[:, number] @ columns[:, number]), 1e-300)
        change = -float(columns[:, number] @ columns[:, 0]) / information
        scores = _in_blocks(problem, placed, own[:, 0] + change * own[:, number], own[:, number : number + 1])
        left_over = 1.0 - change**2 * information / max(float(columns[:, 0] @ columns[:, 0]), 1e-300)
        variance = max(sandwich(scores, np.array([1.0 / information])).variance, left_over / information)
        found.append(ScaleChange(number == 2, change * unit, low, high, change / math.sqrt(variance)))
    return found[0], found[1]


def _braking(window: TaperWindow) -> TaperWindow:
    """Return the window with the torque only where it opposes the rotation."""
    samples, way = window.run.samples, window.run.direction
    opposed = replace(samples, torque_nm=way * np.minimum(way * samples.torque_nm, 0.0))
    return replace(window, run=replace(window.run, samples=opposed))


# ---------------------------------------------------------------------------------------------------------------------
# Intervals: every value that the data do not contradict, for any structure of the reporting filters.
#
# The profile P(x) = min over all other parameters of −2 ln L, including the filters' shapes κ, follows the valley in
# which inertia and lags compensate each other. The interval is {x: P(x) ≤ P_min + (i t)²}, with t, Student's quantile
# for the degrees of freedom of the scatter, and i ≥ 1, the scatter of the parameter over time relative to the noise
# model (`sandwich`).


LEAST_DOF = 3.0           # least degrees of freedom for the quantile
_SHAPE_STARTS = ((0.02, 0.02), (0.3, 0.1), (0.1, 0.3))   # start values of the shapes of both filters
_EQUAL_POLES, _NEAR_EQUAL = 0.25, 0.1      # κ of two equal poles, and the distance that counts as equal to it


@dataclass(frozen=True)
class Spread:
    """Uncertainty of one parameter: sd of the quadratic approximation, the sandwich's factor on it, the quantile.

    ``lean``: change of the value with the other direction of regression (see `direction_gap`).
    """

    sd: float
    factor: float
    quantile: float
    lean: float


def spread(problem: FitProblem, fit: Fit, scores: FloatArray, index: int, confidence: float) -> Spread:
    """Return the uncertainty of a parameter; ``scores`` of the blocks of time at this fit (`block_scores`)."""
    found, _ = covariance(problem, fit.theta, problem.free)
    at = problem.free.index(index)
    sd = math.sqrt(max(float(found[at, at]), 0.0))
    direction = np.zeros(len(fit.theta))
    direction[list(problem.free)] = found[at]
    blocks = sandwich(scores, direction)
    share = _shares(problem, fit.theta, direction)
    dof = 2.0 * share - len(problem.free)
    factor = math.sqrt(blocks.variance) / sd if sd > 0.0 else 1.0
    if factor > 1.0:
        dof = min(dof, blocks.count)
    lean = float(direction_gap(problem, fit.theta) @ direction)
    return Spread(sd, max(factor, 1.0), student_quantile(confidence, max(dof, LEAST_DOF)), lean)


def direction_gap(problem: FitProblem, theta: FloatArray) -> FloatArray:
    """Return the shift of the score, (10,), if all noise were in the speed instead of the torque.

    Least squares makes the residual e orthogonal to ∂G W, with the reported speed W. If the noise is in the speed, T/G
    is the clean signal, W + e/G, and the normal equations gain Σ 2 Re(∂ln G* |e|²/v). The truth lies between.
    """
    bins = problem.bins
    found = evaluate(theta, bins)
    weight = np.where(bins.hertz > 0.0, 2.0, 1.0) * np.abs(found.error) ** 2 / problem.variance
    tone, nothing = np.zeros_like(bins.speed), np.zeros_like(bins.bend)
    tone[:, 0] = 1.0
    steady = replace(bins, speed=tone, torque=tone * found.gain[:, None], level=0.0 * bins.level, bend=nothing)
    logs = -evaluate(theta, steady).slopes / found.gain[:, None]
    return np.asarray((logs.real * weight[:, None]).sum(axis=0), dtype=np.float64)


def with_shapes(problem: FitProblem, stated: tuple[int, ...]) -> FitProblem:
    """Return the problem with free structures of the filters. A stated lag is that of a one-pole filter."""
    shapes = [shape for lag, shape in ((SPEED_LAG, SPEED_SHAPE), (TORQUE_LAG, TORQUE_SHAPE)) if lag not in stated]
    return replace(problem, free=(*problem.free, *shapes))


def best_shapes(problem: FitProblem, near: Fit) -> Fit:
    """Return the best of several descents from the one-pole fit."""
    fits = [near]
    for shapes in _SHAPE_STARTS:
        start = near.theta.copy()
        for index, value in zip((SPEED_SHAPE, TORQUE_SHAPE), shapes, strict=True):
            if index in problem.free:
                start[index] = value
        fits.append(minimise(problem, start))
    return min(fits, key=lambda fit: fit.objective)


def profile(problem: FitProblem, best: Fit, index: int, reach: float, step: float) -> Estimate:
    """Return the interval up to a rise of the profile by reach² on either side of ``best``; a bound, or ±inf,
    without it.
    """

    def refit(start: FloatArray, value: float) -> Fit:
        return minimise(problem, start, {index: value})

    shapes = [at for at in (SPEED_SHAPE, TORQUE_SHAPE) if at in problem.free and at != index]

    def others(fit: Fit, value: float) -> Iterator[Fit]:
        """Yield starts with two equal poles, for each report that has one pole or two different ones."""
        for at in shapes:
            if abs(float(fit.theta[at]) - _EQUAL_POLES) > _NEAR_EQUAL:
                start = fit.theta.copy()
                start[at] = _EQUAL_POLES
                yield refit(start, value)

    low, high = (profile_edge(refit, problem.box, best, index, side * step, reach**2, others) for side in (-1.0, 1.0))
    return Estimate(float(best.theta[index]), low, high)


def _shares(problem: FitProblem, theta: FloatArray, direction: FloatArray) -> float:
    """Return the effective number of bins behind the parameter: (Σ c)²/Σ c² of their shares in its variance."""
    _, slopes = problem.stacked(theta)
    count = len(problem.bins)
    pulled = (slopes @ direction) ** 2
    each = pulled[:count] + pulled[count : 2 * count]
    return float(np.sum(each) ** 2 / max(float(np.sum(each**2)), 1e-300))


# ---------------------------------------------------------------------------------------------------------------------

_SURELY = 3.0       # times the reach², from which friction is nonlinear; between 1 and this both are possible
_AT_BOUND = 1e-3    # share of the bound; a lag so near counts as at the bound
_FARTHER = 4.0      # times the bound, up to which a longer lag is tried
_CLEARLY_LONGER = 10.0   # of −2 ln L; least improvement by a longer lag, about three standard deviations
_OF_REPORTS = (SPEED_LAG, TORQUE_LAG, SKEW, SPEED_SHAPE, TORQUE_SHAPE)


@dataclass(frozen=True)
class Solved:
    """Solution of the bins. ``bent``: friction has a part ∝ speed²; ``shaped``: a filter differs from one pole.

    ``beyond``: the report, "speed" or "torque", whose lag is longer than the bound; "" for none. ``scale``: the
    clearest change of the torque's scale; None without.
    """

    inertia: Estimate
    viscous: Estimate
    coulomb: Estimate | None
    speed_lag_s: Estimate
    torque_lag_s: Estimate
    skew_s: Estimate
    residual: ResidualTest | None
    budget: tuple[BudgetLine, ...]
    bent: bool
    shaped: bool
    bins: int
    beyond: str = ""
    scale: ScaleChange | None = None


@dataclass(frozen=True)
class ShaftEquation:
    """Fit with one model of friction (structure of the filters free if ``shaped``), and J with its interval.

    ``scores`` (blocks, 10) are those of the fit with one-pole filters.
    """

    problem: FitProblem
    fit: Fit
    scores: FloatArray
    spread: Spread
    inertia: Estimate
    shaped: bool

    @property
    def reach(self) -> float:
        return self.spread.factor * self.spread.quantile


@dataclass(frozen=True)
class _BandWalk:
    """State of the walk over the bands. ``bands``: the wide one, if it exists, and the narrow one.

    ``stated``: indices of the lags that were stated. ``braking`` (M, 4): X_n of the braking torque, of all bins.
    """

    bands: tuple[FoundFit, ...]
    placed: tuple[TaperWindow, ...]
    braking: ComplexArray
    stated: tuple[int, ...]
    confidence: float
    solved: Solved | None = None
    ended: bool = False


def solve(
    bins: Bins, placed: tuple[TaperWindow, ...], priors: tuple[GaussianPrior, ...], torque_span_nm: float,
    confidence: float
) -> Solved | None:
    """Walk the rows of a recording (`tdhil.estimation.candidates`). None if too few bins are clear of the noise."""
    bands = search(bins, priors, torque_span_nm)
    stated = tuple(prior.index for prior in priors)
    braking = joined([measure(_braking(window)) for window in placed] if bands else []).torque
    return walk(FitRoute.RECORD, _BAND_TRIALS, _BandWalk(bands, placed, braking, stated, confidence)).solved


def _holds(solved: Solved | None) -> bool:
    """Return whether J is bounded, and the model was tested and is not in doubt."""
    if solved is None or not (solved.inertia.bounded and solved.inertia.low > 0.0):
        return False
    return solved.residual is not None and not doubtful(solved.residual)


def _try_wide(now: _BandWalk) -> _BandWalk:
    return replace(now, solved=_solve(now, now.bands[0], now.bands[1:]))


def _try_narrow(now: _BandWalk) -> _BandWalk:
    return replace(now, solved=_solve(now, now.bands[-1], ()))


_BAND_TRIALS: Mapping[str, ModelTrial[_BandWalk]] = {
    WIDE_BAND: ModelTrial(lambda now: len(now.bands) > 1, _try_wide),
    NARROW_BAND: ModelTrial(lambda now: bool(now.bands) and not _holds(now.solved), _try_narrow),
}


@dataclass(frozen=True)
class _FrictionWalk:
    """State of the walk over the friction in a band: the equation ``chosen``, and J with its interval.

    ``square``: the problem with friction of the speed squared, and its fit.
    """

    band: FoundFit
    square: tuple[FitProblem, Fit]
    placed: tuple[TaperWindow, ...]
    stated: tuple[int, ...]
    confidence: float
    straight: ShaftEquation | None = None
    chosen: ShaftEquation | None = None
    inertia: Estimate | None = None
    bent: bool = False
    ended: bool = False

    def explains(self, times: float) -> bool:
        """Return whether friction ∝ ω² lowers −2 ln L by more than ``times`` the square of J's reach."""
        if self.straight is None:
            return False
        return self.band.fit.objective - self.square[1].objective > times * self.straight.reach**2


def _try_straight(now: _FrictionWalk) -> _FrictionWalk:
    straight = _shaft(now.band.problem, now.band.fit, now.placed, now.stated, now.confidence)
    return replace(now, straight=straight, chosen=straight, inertia=straight.inertia)


def _try_square(now: _FrictionWalk) -> _FrictionWalk:
    curved = _shaft(*now.square, now.placed, now.stated, now.confidence)
    if now.explains(_SURELY):
        return replace(now, chosen=curved, inertia=curved.inertia, bent=True)
    assert now.inertia is not None
    return replace(now, inertia=_joined(now.inertia, curved.inertia.low, curved.inertia.high))


_FRICTION_TRIALS: Mapping[str, ModelTrial[_FrictionWalk]] = {
    STRAIGHT: ModelTrial(lambda now: True, _try_straight),
    SQUARE: ModelTrial(lambda now: now.explains(1.0), _try_square),
}


def _joined(one: Estimate, low: float, high: float) -> Estimate:
    return Estimate(one.value, min(one.low, low), max(one.high, high))


def _solve(now: _BandWalk, found: FoundFit, narrower: tuple[FoundFit, ...]) -> Solved:
    """Solve in one band. The interval of J also contains that of one-pole filters in each narrower band.

    In a narrower band a filter of any structure is correct, but J is less certain; if the bands agree, nothing changes.
    A narrower band adds at most the half-width on either side, because it may contain little information.
    """
    stated, confidence = now.stated, now.confidence
    bent_problem = replace(found.problem, free=(*found.problem.free, BEND))
    square = bent_problem, minimise(bent_problem, found.fit.theta)
    frictions = walk(FitRoute.BAND, _FRICTION_TRIALS, _FrictionWalk(found, square, now.placed, stated, confidence))
    assert frictions.chosen is not None and frictions.inertia is not None
    chosen, value, bent = frictions.chosen, frictions.inertia, frictions.bent
    for band in narrower:
        middle = float(band.fit.theta[INERTIA])
        near = min(one_pole_reach(band, now.placed, confidence), 0.5 * (value.high - value.low))
        value = _joined(value, middle - near, middle + near)
    problem = chosen.problem
    residual = local_test(problem, chosen.fit.theta, chosen.spread.factor)
    shift = float(square[1].theta[INERTIA]) - float(found.fit.theta[INERTIA])
    budget = _budget(chosen, value, shift, bent, stated)
    changes = [change for change in scale_changes(problem, now.placed, chosen.fit.theta, now.braking[found.keep])
               if change.found]

    def estimate(index: int) -> Estimate:
        return _estimate(chosen, index, confidence)

    return Solved(
        inertia=value,
        viscous=estimate(VISCOUS),
        coulomb=_coulomb(problem, chosen.fit, chosen.spread),
        speed_lag_s=estimate(SPEED_LAG),
        torque_lag_s=estimate(TORQUE_LAG),
        skew_s=estimate(SKEW),
        residual=residual,
        budget=budget,
        bent=bent,
        shaped=chosen.shaped,
        bins=len(problem.bins),
        beyond=_lag_beyond(chosen, stated),
        scale=max(changes, key=lambda change: abs(change.clear), default=None),
    )


def _lag_beyond(shaft: ShaftEquation, stated: tuple[int, ...]) -> str:
    """Return the report whose lag is at its bound, if a longer lag explains the bins clearly better; "" for none.

    J and the lags compensate each other, so a lag held at the bound makes J wrong. A true lag at the bound itself needs
    no longer one. The model with the longer lag must pass its own test: other faults move a lag to its bound, too.
    """
    problem, fit = shaft.problem, shaft.fit
    at = [index for index in (SPEED_LAG, TORQUE_LAG)
          if index not in stated and fit.theta[index] >= (1.0 - _AT_BOUND) * LAG_BOUND_S]
    if not at:
        return ""
    high = problem.box.high.copy()
    high[at] = _FARTHER * LAG_BOUND_S
    longer = minimise(replace(problem, box=replace(problem.box, high=high)), fit.theta)
    tested = local_test(problem, longer.theta, shaft.spread.factor)
    if fit.objective - longer.objective <= _CLEARLY_LONGER or tested is None or doubtful(tested):
        return ""
    return "torque" if longer.theta[TORQUE_LAG] > longer.theta[SPEED_LAG] else "speed"


def _shaft(
    problem: FitProblem, fit: Fit, placed: tuple[TaperWindow, ...], stated: tuple[int, ...], confidence: float
) -> ShaftEquation:
    """Return the interval of J over every structure of the filters, joined with that of one pole each; the value by
    weight.

    If the structures lower −2 ln L by chance, their profile alone excludes the truth (docs/decisions/0045). One-pole
    filters add at most the half-width on either side, because their quadratic interval ignores the bounds of the lags.
    """
    scores = block_scores(problem, placed, fit.theta)
    own = spread(problem, fit, scores, INERTIA, confidence)
    reach, scale = own.factor * own.quantile, float(problem.box.scale[INERTIA])
    open_problem = with_shapes(problem, stated)
    best = best_shapes(open_problem, fit)
    gain, more = (fit.objective - best.objective) / own.factor**2, len(open_problem.free) - len(problem.free)
    weight = simple_weight(gain, more, problem.equations())
    shaped = weight < 0.5
    wide = profile(open_problem, best, INERTIA, reach, min(max(reach * own.sd, 1e-7 * scale), 0.5 * scale))
    value = float(weight * fit.theta[INERTIA] + (1.0 - weight) * best.theta[INERTIA])
    near, middle = min(reach * own.sd, 0.5 * (wide.high - wide.low)), float(fit.theta[INERTIA])
    seen = (value, wide.low, wide.high, middle - near, middle + near)
    inertia = Estimate(value, min(seen) + min(own.lean, 0.0), max(seen) + max(own.lean, 0.0))
    return ShaftEquation(open_problem if shaped else problem, best if shaped else fit, scores, own, inertia, shaped)


def one_pole_reach(found: FoundFit, placed: tuple[TaperWindow, ...], confidence: float) -> float:
    """Return the half-width of J in one band, by the quadratic approximation, with one pole each."""
    own = spread(found.problem, found.fit, block_scores(found.problem, placed, found.fit.theta), INERTIA, confidence)
    return own.factor * own.quantile * own.sd


def _estimate(shaft: ShaftEquation, index: int, confidence: float) -> Estimate:
    problem, fit = shaft.problem, shaft.fit
    own = spread(problem, fit, shaft.scores, index, confidence)
    reach, scale = own.factor * own.quantile, float(problem.box.scale[index])
    found = profile(problem, fit, index, reach, min(max(reach * own.sd, 1e-7 * scale), 10.0 * scale))
    return Estimate(found.value, min(found.low, found.value), max(found.high, found.value))


def _coulomb(problem: FitProblem, fit: Fit, own: Spread) -> Estimate | None:
    """Return T_c along the rotation; it includes the load if the shaft turned in one direction only."""
    both = [index for index in (FORWARD, BACK) if index in problem.free]
    if not both:
        return None
    direction = np.zeros(len(fit.theta))
    direction[FORWARD], direction[BACK] = (0.5, -0.5) if len(both) == 2 else (1.0, -1.0)
    direction[[index for index in (FORWARD, BACK) if index not in both]] = 0.0
    spread_of, _ = covariance(problem, fit.theta, problem.free)
    part = direction[list(problem.free)]
    half = own.factor * own.quantile * math.sqrt(max(float(part @ spread_of @ part), 0.0))
    value = float(direction @ fit.theta)
    return Estimate(value, value - half, value + half) if math.isfinite(half) else None


def _budget(
    shaft: ShaftEquation, inertia: Estimate, shift: float, bent: bool, stated: tuple[int, ...]
) -> tuple[BudgetLine, ...]:
    """Return the budget: noise with the lags fixed, the parts of unknown lags and unknown structures, and the rest."""
    problem, fit, own = shaft.problem, shaft.fit, shaft.spread
    held = tuple(index for index in problem.free if index not in _OF_REPORTS)
    alone, _ = covariance(problem, fit.theta, held)
    reach = shaft.reach
    noise = reach * math.sqrt(max(float(alone[held.index(INERTIA), held.index(INERTIA)]), 0.0))
    one_pole = reach * own.sd
    whole = 0.5 * (inertia.high - inertia.low)
    lags = math.sqrt(max(one_pole**2 - noise**2, 0.0))
    structure = math.sqrt(max(whole**2 - one_pole**2, 0.0)) if math.isfinite(whole) else math.inf
    known = "as stated" if stated else "none is stated"
    return (
        BudgetLine("noise", noise, "disturbance of the load and noise of both signals, for known lags"),
        BudgetLine("lags", lags, f"lags and time offset of the reported signals; {known}"),
        BudgetLine("lag structure", structure, "one pole, two, an average or a delay"),
        BudgetLine("friction model", abs(shift), "friction with and without a term in speed²"
                   + ("; it has one" if bent else "")),
    )
