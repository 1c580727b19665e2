"""What stands beside a result: second opinions, the friction curve, and the warnings that follow from them."""

import math
from dataclasses import replace

from tdhil.identify.bent.verdict import MODEL as BENT
from tdhil.identify.beside.friction_curve import friction_curve
from tdhil.identify.beside.friction_curve_points import Inertia
from tdhil.identify.beside.second_opinion import disagreements, known_delay, reference_inertia, second_opinions
from tdhil.identify.identification import Estimate, Identification, SecondOpinion
from tdhil.identify.lines.friction import Levels
from tdhil.identify.lines.profile import student_quantile
from tdhil.identify.options import Options
from tdhil.identify.samples import Samples
from tdhil.record.recording import Recording


def with_second_look(
    found: Identification, recording: Recording, samples: Samples, levels: Levels | None, options: Options
) -> Identification:
    """The same result with what else the run says. Not for data that were refused as such: a second opinion would be
    a number out of them. ``levels``: of the excited segments; without any there is no friction curve. Never raises.
    """
    opinions = second_opinions(recording, samples, levels, found, options)
    points = found.friction_curve
    warnings = (*found.warnings, *disagreements(opinions, found))
    inertia = _inertia(found, opinions, options.confidence)
    if inertia is not None and levels is not None:
        curve = friction_curve(
            recording, samples, levels, Inertia(*inertia, delay=known_delay(recording, found)), options
        )
        # where the bend is part of the model, J knows of it
        points, warnings = curve.points, (*warnings, *(() if found.model == BENT else curve.warnings))
    return replace(found, second_opinions=opinions, friction_curve=points, warnings=warnings)


def _inertia(
    found: Identification, opinions: tuple[SecondOpinion, ...], confidence: float
) -> tuple[float, float] | None:
    """J of everything that turns with its standard deviation: the result's, else a second opinion's."""
    known: Estimate | None = reference_inertia(found)
    if known is None and opinions:
        known = opinions[0].inertia_kg_m2
    if known is None:
        return None
    sd = 0.5 * (known.high - known.low) / student_quantile(confidence, 1e6)
    return (known.value, sd) if math.isfinite(known.value) and math.isfinite(sd) else None
