"""Two masses, or the string? The simplest that the residuals allow stands; what can't be told apart is not assumed.

Two masses are a string that weighs nothing. A light string is, to first order in its weight, two masses with other
shares of the same total: a third of it seems to turn with the motor. Only its second swing, near one half of the
wave's frequency 1/T, tells. So where two masses explain the data, J_r and J_L are theirs, but their intervals hold
whatever string the data do not contradict (`result.py`; one whose lowest swing the lines can see, `fit.too_slow`);
J_r + J_L is the same in both. Only who says ``--model two-mass`` takes the spring's weight for nothing.

So little is lost by holding on to two masses too long, and J_r moves by what the string weighs if they are given up too
early: the string must gain what would be as unlikely by chance as residuals that reject a model (χ²(1); half of that
at the bound η = 0).
"""

import math
from dataclasses import dataclass

import numpy as np

from tdhil.estimation.frequency_domain.compliant_fit import SLOWEST_SEEN, CompliantFit, chance_gain, fit_compliant
from tdhil.estimation.frequency_domain.friction_levels import ViscousTie
from tdhil.estimation.frequency_domain.model import GaussianPrior
from tdhil.estimation.frequency_domain.rigid import RigidResult
from tdhil.estimation.frequency_domain.shafts import INERTIA
from tdhil.estimation.frequency_domain.spectrum import Line
from tdhil.estimation.result import Refusal
from tdhil.identify.compliant.string_shaft import StringShaft
from tdhil.identify.compliant.two_mass import LOAD, SWING, TwoMassShaft
from tdhil.identify.lines.fit import Held
from tdhil.identify.lines.residual import rejects
from tdhil.identify.options import Model as Asked

_DOUBT = 0.3                 # of the residual test's p, above which a rigid shaft isn't doubted
_MUCH = 9.0                  # of −2 ln L, for one parameter more than the rigid shaft's lags have
_REPORTS = 3                 # unknown besides the shaft: two lags and the skew
_SIGNIFICANT = 25.0          # |mean|² over its variance, as `Line.excited`
_LEAST_LOAD = 0.01           # of the total: less hangs on one line's error
_NEAR = (SLOWEST_SEEN, 2.0)  # where a swing can be seen, of the lowest and the highest line


@dataclass(frozen=True)
class Chosen:
    """``fit`` stands, or was the last to be tried if ``rejected``; ``beside``: the string, where two masses stand."""

    fit: CompliantFit
    beside: CompliantFit | None = None
    rejected: bool = False


def usable_lines(every: tuple[Line, ...], least_nu: float) -> tuple[Line, ...]:
    """Lines where speed or torque stands clear of its scatter: at a resonance one of them all but vanishes.

    The likelihood treats both alike, so either will do.
    """
    return tuple(line for line in every if line.nu >= least_nu and _clear(line))


def _clear(line: Line) -> bool:
    speed = np.abs(line.speed) ** 2 * line.periods > _SIGNIFICANT * line.s_ww
    torque = np.abs(line.torque) ** 2 * line.periods > _SIGNIFICANT * line.s_tt
    return bool(np.all(speed | torque))


def choose(
    asked: Asked, lines: tuple[Line, ...], tie: ViscousTie | None, priors: tuple[GaussianPrior, ...], held: Held
) -> Chosen | Refusal:
    """``priors`` and ``held`` as with a rigid shaft."""
    refusal = _refuse_count(StringShaft() if asked == "string" else TwoMassShaft(), lines, tie, priors)
    if refusal is not None:
        return refusal
    if asked != "auto":
        forced = fit_compliant(TwoMassShaft() if asked == "two-mass" else StringShaft(), lines, tie, priors, held)
        return Chosen(forced, rejected=rejects(forced.residual))
    two = fit_compliant(TwoMassShaft(), lines, tie, priors, held)
    if two.residual is None:      # a shaft taken in place of one that was contradicted must be one that could be, too
        return Refusal(
            f"{len(lines)} excited lines leave nothing to test two masses on a spring with",
            "excite more lines about two mean speeds, from well below the resonance to well above it",
        )
    if _refuse_count(StringShaft(), lines, tie, priors) is not None:
        return Chosen(two, rejected=rejects(two.residual) or not plausible(two))
    string = fit_compliant(StringShaft(), lines, tie, priors, held, two)
    if not rejects(two.residual) and not _outdoes(string, two):
        return Chosen(two, string, rejected=not plausible(two))
    return Chosen(string, rejected=rejects(string.residual) or not plausible(string))


def _outdoes(string: CompliantFit, two: CompliantFit) -> bool:
    """Does the string gain more on two masses, by its one parameter, than chance gives?"""
    return two.fitted.whole.objective - string.fitted.whole.objective > chance_gain()


def may_swing(rigid: RigidResult) -> bool:
    """Should another shaft be tried? Where the rigid one is rejected; and where a load that swings behind first-order
    lags explains the data much better than the lags of a rigid shaft do, whatever their structure.

    A resonance just above the band bends the lines as filters of two poles would, and may pass the residual test, at
    the price of an inertia far too low. Looked into only where first-order lags don't do and the test is in doubt:
    a rigid shaft with plain lags pays nothing for it.
    """
    fitted, problem = rigid.fitted, rigid.fitted.problem
    if rejects(rigid.residual):
        return True
    if rigid.first_order or rigid.residual is None or rigid.residual.p_value > _DOUBT:
        return False
    if _refuse_count(TwoMassShaft(), problem.lines, problem.tie, problem.priors) is not None:
        return False
    try:
        two = fit_compliant(TwoMassShaft(), problem.lines, problem.tie, problem.priors, fitted.held)
    except (np.linalg.LinAlgError, FloatingPointError, ValueError):
        return False
    return fitted.whole.objective - two.fitted.simple.objective > _MUCH


def plausible(fit: CompliantFit) -> bool:
    """Does something swing that the lines can see, or has one bad line been explained by a load of its own?"""
    omega = np.abs(fit.fitted.problem.s)
    m = fit.mechanical
    near = _NEAR[0] * float(np.min(omega)) <= m[SWING] <= _NEAR[1] * float(np.max(omega))
    return bool(near and m[LOAD] >= _LEAST_LOAD * (m[INERTIA] + m[LOAD]))


def _refuse_count(
    shaft: TwoMassShaft | StringShaft,
    lines: tuple[Line, ...],
    tie: ViscousTie | None,
    priors: tuple[GaussianPrior, ...],
) -> Refusal | None:
    """Equations and unknowns, as `identifiable.refuse_count` has them for a rigid shaft."""
    equations, unknowns = 2 * len(lines) + (tie is not None) + len(priors), len(shaft.names) + _REPORTS
    if equations >= unknowns:
        return None
    name = "a string" if isinstance(shaft, StringShaft) else "two masses on a spring"
    wanted = math.ceil(0.5 * (unknowns - (tie is not None) - len(priors)))
    return Refusal(
        f"{len(lines)} excited lines, mean speeds and known lags give {equations} equations, but {name} behind a "
        f"drive's reports {'has' if isinstance(shaft, StringShaft) else 'have'} {unknowns} unknowns",
        f"excite at least {wanted} lines, from well below the resonance to well above it",
    )
