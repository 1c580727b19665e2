"""A look at the scatter: how tight is the interval already, and how much longer must it be?"""

from __future__ import annotations

import math
from dataclasses import dataclass

from tdhil.estimation.frequency_domain.friction_levels import measure_levels, tie_viscous
from tdhil.estimation.frequency_domain.spectrum import period_lines, pooled_lines
from tdhil.estimation.identify import identify
from tdhil.estimation.samples import stretches, usable_samples
from tdhil.identify.options import Options
from tdhil.recording.recording import Recording
from tdhil.run.design.prediction import LEAST_NU, Evidence, Fitted, fit, half_width, longer, noise_free, whole_periods
from tdhil.run.design.stopping_rule import aimed_scatter, least_scale


@dataclass(frozen=True)
class Look:
    """What the scatter says: J's relative half-width now, and after ``scale`` times as many periods.

    ``enough``: the tolerance is met then (now, if ``scale`` is 1). None of it knows how J came out but for what the
    lines' weights owe to it, which is of second order: multiply torque by anything, and nothing here changes.
    """

    periods: float
    half_width_now: float
    scale: float
    half_width_then: float
    enough: bool


def look(
    recording: Recording, confidence: float, tolerance: float, most_scale: float, pilot_dof: float
) -> Look | None:
    """Look at what has been acquired so far; None where the estimator would refuse it."""
    evidence = evidence_of(recording)
    fitted = None if evidence is None else fit(evidence, confidence)
    return None if evidence is None or fitted is None else _look(
        evidence, fitted, confidence, tolerance, most_scale, pilot_dof
    )


def _look(
    evidence: Evidence, fitted: Fitted, confidence: float, tolerance: float, most_scale: float, pilot_dof: float
) -> Look:
    explained = noise_free(evidence, fitted)
    dof = max(pilot_dof, 2.0 * evidence.lines[0].nu)

    def width(scale: float) -> float:
        return half_width(longer(explained, scale, aimed_scatter(dof, dof * (scale - 1.0))), confidence)

    now = width(1.0)
    scale, then, enough = least_scale(lambda x: now if x == 1.0 else width(x), tolerance, most_scale)
    return Look(whole_periods(evidence.lines), now, scale, then, enough)


def interval_of(recording: Recording, confidence: float) -> float:
    """The relative half-width of the very interval that the run would end with; infinite where there is none."""
    found = identify(recording, Options(confidence=confidence)).inertia
    return math.inf if found is None else 0.5 * (found.high - found.low) / found.value


def evidence_of(recording: Recording) -> Evidence | None:
    """Lines and levels as identification will see them; None without enough whole periods."""
    excitation = recording.excitation
    if excitation is None or not excitation.segments:
        return None
    samples = usable_samples(recording)
    cut = stretches(samples, excitation.segments)
    fits = tuple(period_lines(stretch, samples) for stretch in cut)
    levels = measure_levels(cut, fits, samples, recording.levels, 0.0)
    tie = tie_viscous(levels)
    pooled = pooled_lines(fits, tie.slope if tie is not None else 0.0, levels.warming.own)
    lines = tuple(line for line in pooled if line.excited and line.nu >= LEAST_NU)
    return Evidence(lines, levels, recording.lag_prior) if lines else None
