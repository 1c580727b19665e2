"""A rigid shaft with bent friction, fitted: every shape in turn, the filters of its wave found on the way.

The bend's lines depend on the filters, and these on the fit: a few rounds settle that. The shape that explains the data
best stands; in the interval counts every shape that the data do not contradict, from where its own −2 ln L lies.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tdhil.estimation.frequency_domain.filter_order import Fitted, fit_model
from tdhil.estimation.frequency_domain.friction_levels import Levels, ViscousTie, slope_over_speed
from tdhil.estimation.frequency_domain.likelihood import Likelihood, Load
from tdhil.estimation.frequency_domain.model import GaussianPrior, Model
from tdhil.estimation.frequency_domain.optimiser import Fit
from tdhil.estimation.frequency_domain.rigid import RigidResult
from tdhil.estimation.frequency_domain.shafts import INERTIA, RigidShaft
from tdhil.estimation.frequency_domain.spectrum import Line
from tdhil.estimation.result import Estimate, ResidualTest
from tdhil.identify.bent.bends import Bend, bends
from tdhil.identify.bent.shaft import BEND, BentShaft
from tdhil.identify.bent.wave import Wave
from tdhil.identify.lines.fit import Held, box, minimise, rough_inertia_of
from tdhil.identify.lines.interval import estimate, quantile_of
from tdhil.identify.lines.residual import residual_of
from tdhil.recording.recording import FloatArray

_ROUNDS = 3
_RIGID = len(RigidShaft.names)
_HOPELESS = 40.0    # of −2 ln L behind the best with first-order lags: looked at no further
_FINE = 0.003       # of a bell's width
_SLOWEST = 0.1      # of the mean speed: what comes nearer to rest than that is another kind of friction


@dataclass(frozen=True)
class Motion:
    """What the shaft did: a wave for each segment, the levels (the segments' first, in their order), the lines."""

    waves: tuple[Wave, ...]
    levels: Levels
    lines: tuple[Line, ...]
    tie: ViscousTie | None


@dataclass(frozen=True)
class BentFit:
    """One shape, fitted."""

    bend: Bend
    fitted: Fitted
    residual: ResidualTest | None

    @property
    def objective(self) -> float:
        return self.fitted.whole.objective


def fit_bends(motion: Motion, priors: tuple[GaussianPrior, ...], held: Held, rigid: RigidResult) -> list[BentFit]:
    """Every shape, the best first; none where the shaft comes too near to rest. ``priors``, ``held``: as rigid."""
    # with first-order lags: a whole family of filters, made to explain a bend, ends in corners
    start = rigid.fitted.simple.theta
    speeds = [wave.over_period(start[_RIGID:]) for wave in motion.waves]
    ways = {float(np.sign(wave.mean)) for wave in motion.waves}
    slowest = min(float(np.min(speed * np.sign(wave.mean))) for speed, wave in zip(speeds, motion.waves, strict=True))
    if len(ways) != 1 or slowest <= _SLOWEST * min(abs(wave.mean) for wave in motion.waves):
        return []
    priors = tuple(replace(prior, index=prior.index + 1) for prior in priors)
    held = {index + 1: value for index, value in held.items()}
    fastest = max(float(np.max(np.abs(speed))) for speed in speeds)

    def near(bend: Bend) -> _Near:
        return _near(bend, motion, priors, held, np.insert(start, BEND, 0.0))

    tried = [near(bend) for bend in bends(slowest, fastest)]
    tried += _between(tried, near)
    least = min(fit.objective for _, _, fit in tried)
    found = [
        BentFit(bend, whole := fit_model(problem, held, [fit.theta]), residual_of(whole, 1))
        for bend, problem, fit in tried
        if fit.objective <= least + _HOPELESS
    ]
    return sorted(found, key=lambda one: one.objective)


def inertia_of(found: Sequence[BentFit], best: Estimate, confidence: float) -> Estimate:
    """``best``, the best shape's, with an interval that holds whatever the others leave open. ``found``: it first."""
    rise = quantile_of(found[0].fitted, INERTIA, confidence) ** 2
    low, high = [best.low], [best.high]
    for one in found[1:]:
        behind = one.objective - found[0].objective
        if behind < rise:
            other = estimate(one.fitted, INERTIA, confidence, behind)
            low.append(other.low)
            high.append(other.high)
    return Estimate(best.value, min(low), max(high))


_Near = tuple[Bend, Likelihood, Fit]


def _between(tried: list[_Near], near: Callable[[Bend], _Near]) -> list[_Near]:
    """The best bell between the neighbours of the grid's best."""
    bells = [(bend.width_rad_s, fit.objective) for bend, _, fit in tried if bend.width_rad_s is not None]
    best = min(range(len(bells)), key=lambda number: bells[number][1])
    around = (math.log(bells[max(best - 1, 0)][0]), math.log(bells[min(best + 1, len(bells) - 1)][0]))
    seen: list[_Near] = []

    def objective(log_width: float) -> float:
        seen.append(near(Bend(math.exp(log_width))))
        return seen[-1][2].objective

    from scipy.optimize import minimize_scalar

    minimize_scalar(objective, bounds=around, method="bounded", options={"xatol": _FINE, "maxiter": 20})
    return [min(seen, key=lambda one: one[2].objective)]


def _near(
    bend: Bend, motion: Motion, priors: tuple[GaussianPrior, ...], held: Held, start: FloatArray
) -> _Near:
    """With first-order lags, one descent in each round, from where the last one ended."""
    theta = start
    for _ in range(_ROUNDS):
        problem = _problem(bend, motion, priors, theta[BEND + 1 :])
        first_order = {**dict.fromkeys(problem.model.structure, 0.0), **held}
        fit = minimise(problem, box(problem, rough_inertia_of(problem)), theta, first_order)
        theta = fit.theta
    return bend, problem, fit


def _problem(bend: Bend, motion: Motion, priors: tuple[GaussianPrior, ...], phi: FloatArray) -> Likelihood:
    """With the bend's lines as the filters ``phi`` (6,) have them."""
    seen = [wave.through(bend, phi) for wave in motion.waves]
    by_hertz = [
        {round(hertz, 9): line for hertz, line in zip(wave.lines_hz, lines, strict=True)}
        for wave, (lines, _) in zip(motion.waves, seen, strict=True)
    ]
    entries = np.array([own[line.hertz] for line in motion.lines for own in by_hertz if line.hertz in own])
    levels = motion.levels
    friction = np.concatenate([[mean for _, mean in seen], bend.over(levels.speed[len(seen) :])])
    typical = float(np.mean(np.abs(levels.speed)) / np.max(np.abs(friction)))
    shaft = BentShaft(slope_over_speed(levels, friction), typical)
    return Likelihood(motion.lines, Model(shaft), motion.tie, priors, Load(BEND, entries))
