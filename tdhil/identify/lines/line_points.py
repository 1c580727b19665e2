"""Lines as a reader sees them: the inertia that each frequency shows by itself, beside what the model makes of it.

    G = T/ω,    apparent inertia Im G/ω_k (what regressing torque on acceleration gives at that line),    damping Re G

pooled over the segments, G = Σ P T W* / Σ P |W|², of variance v / Σ P |W|² (`likelihood`), half of it in
either part.
"""

import math

import numpy as np

from tdhil.estimation.frequency_domain.filter_order import Fitted
from tdhil.estimation.frequency_domain.inference import student_quantile
from tdhil.estimation.frequency_domain.spectrum import ComplexArray, Line
from tdhil.estimation.result import Estimate, LinePoint


def fitted_points(fitted: Fitted, confidence: float) -> tuple[LinePoint, ...]:
    """The lines of a fit beside the likelier of its two answers."""
    problem, theta = fitted.problem, fitted.likelier.theta
    return line_points(problem.unloaded(theta), problem.model.impedance(theta, problem.s), confidence)


def line_points(lines: tuple[Line, ...], fitted: ComplexArray, confidence: float) -> tuple[LinePoint, ...]:
    """One for each line, in their order; ``fitted`` (K,) is the model's T/ω at them, N·m·s/rad."""
    found = []
    for line, model in zip(lines, fitted, strict=True):
        g = complex(model)
        weight = line.periods * np.abs(line.speed) ** 2
        energy = float(np.sum(weight))
        if not (energy > 0.0 and math.isfinite(energy)):
            continue
        seen = complex(np.sum(line.periods * line.torque * line.speed.conj())) / energy
        variance = line.s_tt + abs(g) ** 2 * line.s_ww - 2.0 * (g.conjugate() * line.s_tw).real
        sd = math.sqrt(max(variance, 0.0) / (2.0 * energy))
        half = student_quantile(confidence, max(2.0 * line.nu, 1.0)) * sd
        omega = 2.0 * math.pi * line.hertz
        found.append(
            LinePoint(
                hertz=line.hertz,
                apparent_inertia_kg_m2=_around(seen.imag / omega, half / omega),
                fitted_inertia_kg_m2=g.imag / omega,
                apparent_damping_nm_s_rad=_around(seen.real, half),
                fitted_damping_nm_s_rad=g.real,
                residual_sd=abs(seen - g) / (math.sqrt(2.0) * sd) if sd > 0.0 else 0.0,
            )
        )
    return tuple(found)


def _around(value: float, half: float) -> Estimate:
    return Estimate(value, value - half, value + half)
