"""Characteristic impedance of a drill string from a run, in the drive's own unit of torque.

A string of known travel time T hangs on the shaft. All other parameters are free: the inertia of the motor, the
impedance ζ of the string, the inertia at its end, all friction, and the filters of the reports. The measured value is z
= ζ T^(−e). The exponent e states how the length and the wave speed are used: −1 gives the inertia of the string.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tdhil.estimation.case import Case, PeriodicCase
from tdhil.estimation.frequency_domain import (
    ANY_IMPEDANCE,
    DELAY_SURER,
    LOAD,
    GaussianPrior,
    KnownStringShaft,
    TwoMassShaft,
    estimate,
    fit_compliant,
    known_of,
    plausible,
    string_view,
    viewed,
)
from tdhil.estimation.friction_levels import ViscousConstraint
from tdhil.estimation.periodic import clear_lines, measured, settled
from tdhil.estimation.result import Estimate, Options, Refused, ResidualTest, rejects
from tdhil.estimation.samples import usable_samples
from tdhil.estimation.spectrum import SpectralLine
from tdhil.recording import Pipe, Recording

_WIDER = 3.0
"""Factor on the stated uncertainty of the travel time. The prior selects among the oscillations of the string, and
measures nothing.
"""
_LEAST_LINES = 5
"""Least number of lines: ten equations, for as many unknowns of a string with known travel time and first-order
lags.
"""
_ADVICE = "repeat the run off bottom with the default motion, and check the string's sections and length"


@dataclass(frozen=True)
class MeasuredString:
    """Result of the measurement. ``value``: z, in the drive's unit of torque; ``impedance_nm_s_rad``, ``delay_s``:
    of the best fit.
    """

    value: Estimate
    impedance_nm_s_rad: float
    delay_s: float
    residual: ResidualTest | None


def measure_string(
    recording: Recording, pipe: Pipe, delay_rel_sd: float, exponent: float, confidence: float = 0.95
) -> MeasuredString:
    """Measure z of the string from a periodic motion. Raises Refused if the lines do not determine it."""
    excitation = recording.excitation
    if excitation is None or not excitation.segments:
        raise Refused("there is no periodic excitation in it", "identify with a multisine")
    recording = replace(recording, pipe=pipe, has_drill_string=True)
    begun: Case = Case(recording, Options(), samples=usable_samples(recording))
    case: PeriodicCase = settled(clear_lines(measured(begun, excitation)))
    priors, fixed = known_of(recording.lag_prior, len(case.usable), case.constraint)
    return measure_lines(case.usable, case.constraint, priors, fixed, pipe, delay_rel_sd, exponent, confidence)


def measure_lines(
    lines: tuple[SpectralLine, ...], constraint: ViscousConstraint | None, priors: tuple[GaussianPrior, ...],
    fixed: dict[int, float], pipe: Pipe, delay_rel_sd: float, exponent: float, confidence: float = 0.95,
) -> MeasuredString:
    """Measure z from spectral lines, as `measure_string`."""
    if len(lines) < _LEAST_LINES:
        raise Refused(f"{len(lines)} excited lines are too few for a string", "excite with more lines (a multisine)")
    known = replace(pipe, rel_sd=DELAY_SURER * _WIDER * delay_rel_sd)
    try:
        near = fit_compliant(TwoMassShaft(), lines, constraint, priors, fixed)
        fit = fit_compliant(KnownStringShaft(known, ANY_IMPEDANCE), lines, constraint, priors, fixed, near)
        if rejects(fit.residual) or not plausible(fit):
            raise Refused("the data contradict a string with the travel time of this pipe", _ADVICE)
        value = estimate(viewed(fit.fitted, string_view(exponent)), LOAD, confidence)
    except (np.linalg.LinAlgError, FloatingPointError, ValueError):
        raise Refused("the lines leave the impedance of the string open", _ADVICE) from None
    if not (value.bounded and value.low > 0.0):
        raise Refused("the lines leave the impedance of the string open", _ADVICE)
    m = fit.mechanical
    return MeasuredString(value, string_view(0.0).of(m), string_view(-1.0).of(m) / string_view(0.0).of(m), fit.residual)
