"""A compliant shaft fitted to lines, and the intervals of what is asked of it."""

import math
from dataclasses import dataclass, replace

import numpy as np

from tdhil.estimation.frequency_domain.filter_order import Fitted, fit_model
from tdhil.estimation.frequency_domain.friction_levels import ViscousTie
from tdhil.estimation.frequency_domain.likelihood import Likelihood
from tdhil.estimation.frequency_domain.model import GaussianPrior, Model
from tdhil.estimation.frequency_domain.shafts import INERTIA, VISCOUS, RigidShaft
from tdhil.estimation.frequency_domain.spectrum import Line
from tdhil.estimation.result import Estimate, ResidualTest
from tdhil.identify.compliant.starts import compliant_starts
from tdhil.identify.compliant.string_shaft import STRING_SHARE, StringShaft
from tdhil.identify.compliant.string_shaft import resonances as string_resonances
from tdhil.identify.compliant.two_mass import DAMPING, LOAD, SWING, TwoMassShaft
from tdhil.identify.compliant.views import RESONANCE, STIFFNESS, TOTAL, viewed
from tdhil.identify.lines.fit import Apart, Held
from tdhil.identify.lines.interval import estimate
from tdhil.identify.lines.residual import REJECT_P, residual_of
from tdhil.recording.recording import FloatArray

SLOWEST_SEEN = 0.5        # of the lowest line: a slower swing is not seen
_RIGID = len(RigidShaft.names)
_LIGHT = 0.02      # share of the load that a string weighs which is all but a spring


@dataclass(frozen=True)
class CompliantFit:
    """Two lumps or the string, fitted; with the test of its residuals."""

    fitted: Fitted
    residual: ResidualTest | None

    @property
    def is_string(self) -> bool:
        return self.fitted.problem.model.mechanical > STRING_SHARE

    @property
    def mechanical(self) -> FloatArray:
        """The shaft's m of the likelier structure of lags, (M,)."""
        return self.fitted.likelier.theta[: self.fitted.problem.model.mechanical]


@dataclass(frozen=True)
class CompliantIntervals:
    """Of one fit; infinite on a side that the data leave open. SI units, resonances in Hz."""

    inertia: Estimate
    viscous: Estimate
    total: Estimate
    load: Estimate
    stiffness: Estimate
    damping: Estimate
    antiresonance: Estimate
    resonance: Estimate


def fit_compliant(
    shaft: TwoMassShaft | StringShaft,
    lines: tuple[Line, ...],
    tie: ViscousTie | None,
    priors: tuple[GaussianPrior, ...],
    held: Held,
    near: CompliantFit | None = None,
) -> CompliantFit:
    """Fit and test. ``priors`` and ``held`` count as with a rigid shaft, and are moved to where this one has them.

    ``near``: two lumps already fitted, from which a string's descents begin too.
    """
    model = Model(shaft)
    moved = model.mechanical - _RIGID
    priors = tuple(replace(prior, index=prior.index + moved) for prior in priors)
    held = {index + moved: value for index, value in held.items()}
    problem = Likelihood(lines, model, tie, priors)
    starts = compliant_starts(problem, held)
    if near is not None:
        starts = [np.insert(near.fitted.simple.theta, STRING_SHARE, _LIGHT), *starts]
    fitted = fit_model(problem, held, starts, apart=too_slow(problem))
    return CompliantFit(fitted, residual_of(fitted))


def too_slow(problem: Likelihood) -> Apart:
    """A shaft whose lowest swing the lines can't see stands where it explains more than chance does, not by a hair.

    A string always has such a double: at multiples of a frequency f, tan ωT is the same with T + 1/(2f), a wave that
    takes longer by half a period (10 s at 0.05 Hz: 32 km of pipe). What it gains on its double is scatter, and whether
    a descent finds it hangs on rounding.
    """
    slowest = SLOWEST_SEEN * float(np.min(np.abs(problem.s)))
    size = problem.model.mechanical

    def stands(theta: FloatArray) -> bool:
        return (string_resonances(theta[:size])[0] if size > STRING_SHARE else float(theta[SWING])) < slowest

    return Apart(stands, chance_gain())


def chance_gain() -> float:
    """By how much one parameter more lowers −2 ln L as seldom by chance as residuals reject a true model, χ²(1)."""
    from scipy.stats import chi2

    return float(chi2.isf(REJECT_P, 1))


def inertias(fit: CompliantFit, confidence: float) -> dict[str, Estimate]:
    """What a string's weight bears on most, as `CompliantIntervals` names it."""
    fitted = fit.fitted
    return {
        "inertia": estimate(fitted, INERTIA, confidence),
        "total": estimate(viewed(fitted, TOTAL), INERTIA, confidence),
        "load": estimate(fitted, LOAD, confidence),
        "stiffness": estimate(viewed(fitted, STIFFNESS), SWING, confidence),
    }


def intervals(fit: CompliantFit, confidence: float) -> CompliantIntervals:
    """Each by its own profile, whatever the others may be."""
    fitted = fit.fitted
    swing = estimate(fitted, SWING, confidence)
    free = estimate(viewed(fitted, RESONANCE), SWING, confidence)
    held_hz, free_hz = _hertz(fit)
    return CompliantIntervals(
        **inertias(fit, confidence),
        viscous=estimate(fitted, VISCOUS, confidence),
        damping=estimate(fitted, DAMPING, confidence),
        antiresonance=_scaled(swing, held_hz),
        resonance=_scaled(free, free_hz),
    )


def _hertz(fit: CompliantFit) -> tuple[float, float]:
    """What the two frequencies of the parametrisation are to be multiplied by: exact for two lumps.

    The string's own lie a few per cent away, by a factor that hardly depends on what is uncertain.
    """
    turn = 0.5 / math.pi
    if not fit.is_string:
        return turn, turn
    held, loose = string_resonances(fit.mechanical)
    m = fit.mechanical
    plain = float(m[SWING]), float(m[SWING] * np.sqrt(1.0 + m[LOAD] / m[INERTIA]))
    return turn * held / plain[0], turn * loose / plain[1]


def _scaled(one: Estimate, by: float) -> Estimate:
    return Estimate(one.value * by, one.low * by, one.high * by)
