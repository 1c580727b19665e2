"""Influence of a torque on J through the excited lines, to first order, and the interval of J widened by it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from tdhil.estimation.case import Finding, PeriodicCase
from tdhil.estimation.frequency_domain import ModelCurve
from tdhil.estimation.result import BudgetLine, Estimate
from tdhil.estimation.spectrum import ComplexArray
from tdhil.recording import FloatArray

LEAST_PERIODS = 3         # fewest periods in one segment: their scatter is part of the interval


def inertia_changes(curve: ModelCurve, theta: FloatArray, torques: Sequence[ComplexArray]) -> FloatArray:
    """Return the change of J, kg·m², by each of P torques that are subtracted, as the parts (P, R) of the R segment
    means. ``torques``: the line of each in every segment mean, (R,).
    """
    problem = curve.fitted.problem
    free, covariance = curve.covariance()
    g, slopes = problem.model.impedance_jacobian(theta, problem.s)
    by = slopes[problem.owner][:, list(free)] * problem.speed[:, None]
    weight = 2.0 * problem.root_periods**2 / problem.variance(g)[problem.owner]
    toward = by.conj() @ (covariance @ problem.model.inertia_row[list(free)])
    found: FloatArray = -(toward * weight * np.array(torques)).real
    return found


def segment_means(case: PeriodicCase, curve: ModelCurve, by_segment: Mapping[int, ComplexArray]) -> list[ComplexArray]:
    """Return lines in the order of the model's segment means, one array for each of P signals.

    ``by_segment``: lines (P, K) by the number of the segment; 0 for a segment without. Returns [] if the model has
    other segment means.
    """
    lines = curve.fitted.problem.lines
    many = max(len(own) for own in by_segment.values())
    by_line: dict[float, list[ComplexArray]] = {}
    for number, fit in enumerate(case.fits):
        if not len(fit.speed):
            continue
        own = by_segment.get(number, np.zeros((many, len(fit.lines_hz)), dtype=np.complex128))
        for column, hertz in enumerate(fit.lines_hz):
            by_line.setdefault(round(hertz, 9), []).append(own[:, column])
    rows = [np.array(by_line[round(line.hertz, 9)]) for line in lines]
    return list(np.concatenate(rows).T) if all(
        len(row) == len(line.speed) for row, line in zip(rows, lines, strict=True)) else []


def widened(finding: Finding, half_width: float, source: str, note: str) -> Finding:
    """Return the finding with a half-width, kg·m², added in squares to J's interval, and as a line of the budget."""
    inertia, budget = finding.inertia, finding.budget
    if inertia is None:
        return finding
    low, high = (math.hypot(side, half_width) for side in (inertia.value - inertia.low, inertia.high - inertia.value))
    if budget:
        budget = (*budget[:-1], BudgetLine(source, half_width, note), budget[-1])
    return replace(finding, budget=budget, inertia=Estimate(inertia.value, inertia.value - low, inertia.value + high))
