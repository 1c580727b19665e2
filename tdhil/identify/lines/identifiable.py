"""Can these lines tell the inertia at all? Count equations and unknowns before fitting.

Each distinct excited frequency is two equations (real and imaginary part of T/ω); two mean speeds add one (B), each
lag stated by the drive or the rig one. Unknown are five: J, B, the two lags, and the skew. (The structure of the lags
is unknown too; where the lines cannot tell it, the interval is wide or open, but is one.) At a second mean speed the
same frequency says the same again: it helps the scatter, not the count.

The parameters are those of the rigid model.
"""

from tdhil.estimation.frequency_domain.friction_levels import ViscousTie
from tdhil.estimation.frequency_domain.model import GaussianPrior, Model
from tdhil.estimation.frequency_domain.signal_filters import (
    AVERAGE,
    SKEW,
    SPEED_LAG,
    SPEED_SHAPE,
    TORQUE_LAG,
    TORQUE_SHAPE,
)
from tdhil.estimation.result import Refusal
from tdhil.recording.recording import LagPrior

UNKNOWNS = 5
_AT = Model().at
_LEAST_SD_S = 1e-4     # a lag "known exactly" is known to a tenth of a millisecond at best


def lag_priors(
    prior: LagPrior, speed_index: int = _AT(SPEED_LAG), torque_index: int = _AT(TORQUE_LAG)
) -> tuple[GaussianPrior, ...]:
    """What is known of the two lags; the indices are where they stand in theta."""
    known = []
    if prior.speed_lag_s is not None:
        known.append(GaussianPrior(speed_index, prior.speed_lag_s, max(prior.speed_lag_sd_s, _LEAST_SD_S)))
    if prior.torque_lag_s is not None:
        known.append(GaussianPrior(torque_index, prior.torque_lag_s, max(prior.torque_lag_sd_s, _LEAST_SD_S)))
    return tuple(known)


def known_structure(prior: LagPrior) -> dict[int, float]:
    """A stated lag is a first-order one. What the manual states of both reports leaves no room for an average."""
    held = {}
    if prior.speed_lag_s is not None:
        held[_AT(SPEED_SHAPE)] = 0.0
    if prior.torque_lag_s is not None:
        held[_AT(TORQUE_SHAPE)] = 0.0
    if len(held) == 2:
        held[_AT(AVERAGE)] = 0.0
    return held


def unfiltered() -> dict[int, float]:
    """The paper's assumption: what is reported is what is."""
    return {_AT(index): 0.0 for index in (SPEED_LAG, SPEED_SHAPE, TORQUE_LAG, TORQUE_SHAPE, AVERAGE, SKEW)}


def with_skew(priors: tuple[GaussianPrior, ...], lines: int, tie: ViscousTie | None, sd_s: float) -> tuple[
    GaussianPrior, ...
]:
    """If only the skew is missing from the count, and both lags are known: torque and speed come in one frame."""
    known = len(priors) + (tie is not None) + 2 * lines
    if known < UNKNOWNS and len(priors) == 2:
        return (*priors, GaussianPrior(_AT(SKEW), 0.0, max(sd_s, _LEAST_SD_S)))
    return priors


def known_of(
    prior: LagPrior, lines: int, tie: ViscousTie | None
) -> tuple[tuple[GaussianPrior, ...], dict[int, float]]:
    """What is known of a rigid shaft's reports beforehand: the priors, and what is held."""
    return with_skew(lag_priors(prior), lines, tie, prior.skew_sd_s), known_structure(prior)


def refuse_count(lines: int, tie: ViscousTie | None, priors: tuple[GaussianPrior, ...]) -> Refusal | None:
    """A refusal that names equations, unknowns and the motion that would do."""
    equations = 2 * lines + (tie is not None) + len(priors)
    if equations >= UNKNOWNS:
        return None
    sources = [f"{lines} excited {'line gives' if lines == 1 else 'lines give'} {2 * lines} equations"]
    if tie is not None:
        sources.append("two mean speeds give one")
    if priors:
        sources.append(f"what is known of the lags gives {len(priors)}")
    missing = "more lines (a multisine)" if tie is not None else "more lines about two mean speeds (a multisine)"
    return Refusal(
        f"{', '.join(sources)}, but there are five unknowns: inertia, viscous friction, the lags of the reported speed "
        "and torque, and their skew",
        f"excite with {missing}, or state the drive's speed and torque filters with their uncertainty",
    )
