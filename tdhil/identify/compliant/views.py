"""The same shaft with one of its parameters replaced by another that is asked for: the total inertia, the stiffness, a
resonance. Its interval is then a profile like any other (`interval.estimate`), bounds and curved valleys included.

The parameter m_i gives way to u with m_i = h(u, the others); the rest keep their places. By the chain rule
∂Z/∂u = ∂Z/∂m_i ∂h/∂u, and every other slope gains ∂Z/∂m_i ∂h/∂m_j.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from tdhil.estimation.frequency_domain.filter_order import Fitted
from tdhil.estimation.frequency_domain.likelihood import Likelihood
from tdhil.estimation.frequency_domain.model import Model
from tdhil.estimation.frequency_domain.optimiser import Fit
from tdhil.estimation.frequency_domain.shafts import INERTIA, Shaft
from tdhil.estimation.frequency_domain.spectrum import ComplexArray
from tdhil.identify.compliant.string_shaft import STRING_SHARE
from tdhil.identify.compliant.two_mass import LOAD, SWING
from tdhil.identify.lines.fit import box, rough_inertia_of
from tdhil.recording.recording import FloatArray


@dataclass(frozen=True)
class View:
    """``of`` m: what takes the place of m[index]; ``back`` from m with it there: (m[index], its gradient (M,))."""

    index: int
    of: Callable[[FloatArray], float]
    back: Callable[[FloatArray], tuple[float, FloatArray]]


def _light(m: FloatArray) -> float:
    """1 − 2η/3, the share of the load that swings (`string_shaft.py`); 1 of two lumps."""
    return 1.0 - 2.0 / 3.0 * float(m[STRING_SHARE]) if len(m) > STRING_SHARE else 1.0


def _total_back(m: FloatArray) -> tuple[float, FloatArray]:
    slope = np.zeros(len(m))
    slope[INERTIA], slope[LOAD] = 1.0, -1.0
    return float(m[INERTIA] - m[LOAD]), slope


def _stiffness_back(m: FloatArray) -> tuple[float, FloatArray]:
    """ω_a = √(k/(J_L (1 − 2η/3)))."""
    swing = math.sqrt(max(float(m[SWING]), 1e-300) / (float(m[LOAD]) * _light(m)))
    slope = np.zeros(len(m))
    slope[SWING], slope[LOAD] = 0.5 * swing / max(float(m[SWING]), 1e-300), -0.5 * swing / float(m[LOAD])
    if len(m) > STRING_SHARE:
        slope[STRING_SHARE] = swing / (3.0 * _light(m))
    return swing, slope


def _resonance_back(m: FloatArray) -> tuple[float, FloatArray]:
    """ω_a = Ω/√(1 + J_L/J_r)."""
    motor, load = float(m[INERTIA]), float(m[LOAD])
    swing = float(m[SWING]) / math.sqrt(1.0 + load / motor)
    slope = np.zeros(len(m))
    slope[SWING] = swing / float(m[SWING])
    slope[LOAD] = -0.5 * swing / (motor + load)
    slope[INERTIA] = 0.5 * swing * load / (motor * (motor + load))
    return swing, slope


TOTAL = View(INERTIA, lambda m: float(m[INERTIA] + m[LOAD]), _total_back)
STIFFNESS = View(SWING, lambda m: float(m[SWING] ** 2 * m[LOAD] * _light(m)), _stiffness_back)
RESONANCE = View(SWING, lambda m: float(m[SWING] * math.sqrt(1.0 + m[LOAD] / m[INERTIA])), _resonance_back)


class ViewedShaft:
    """A compliant shaft through a view."""

    def __init__(self, inner: Shaft, view: View) -> None:
        self.inner, self.view = inner, view
        self.names = inner.names
        slope = _total_back(np.ones(len(inner.names)))[1] if view is TOTAL else None
        self.inertia_row = inner.inertia_row if slope is None else _through(inner.inertia_row, view.index, slope)
        self.viscous_row = inner.viscous_row

    def impedance(self, m: FloatArray, s: ComplexArray) -> ComplexArray:
        return self.inner.impedance(self._inside(m)[0], s)

    def jacobian(self, m: FloatArray, s: ComplexArray) -> ComplexArray:
        inside, slope = self._inside(m)
        found = self.inner.jacobian(inside, s)
        replaced = found[:, self.view.index].copy()
        found[:, self.view.index] = 0.0
        viewed: ComplexArray = found + replaced[:, None] * slope
        return viewed

    def bounds(self, rough_inertia: float, s: ComplexArray) -> tuple[FloatArray, FloatArray]:
        low, high = self.inner.bounds(rough_inertia, s)
        if self.view is STIFFNESS:
            at = self.view.index
            low[at], high[at] = 1e-3 * rough_inertia * low[at] ** 2, 1e3 * rough_inertia * high[at] ** 2
        return low, high

    def scales(self, rough_inertia: float, s: ComplexArray) -> FloatArray:
        scales = self.inner.scales(rough_inertia, s)
        if self.view is STIFFNESS:
            scales[self.view.index] = rough_inertia * float(np.median(np.abs(s))) ** 2
        return scales

    def _inside(self, m: FloatArray) -> tuple[FloatArray, FloatArray]:
        inside = m.copy()
        inside[self.view.index], slope = self.view.back(m)
        return inside, slope


def viewed(fitted: Fitted, view: View) -> Fitted:
    """The same fits in the view's parameters; `view.index` is where the interval is asked for."""
    old = fitted.problem
    problem = Likelihood(old.lines, Model(ViewedShaft(old.model.shaft, view)), old.tie, old.priors)
    size = old.model.mechanical

    def seen(fit: Fit) -> Fit:
        theta = fit.theta.copy()
        theta[view.index] = view.of(fit.theta[:size])
        return Fit(theta, fit.objective)

    simple = seen(fitted.simple)
    whole = simple if fitted.whole is fitted.simple else seen(fitted.whole)
    limits = box(problem, rough_inertia_of(problem))
    return replace(fitted, problem=problem, limits=limits, simple=simple, whole=whole)


def _through(row: FloatArray, index: int, slope: FloatArray) -> FloatArray:
    """A linear combination of m, in the view's parameters."""
    kept = row.copy()
    kept[index] = 0.0
    kept += row[index] * slope
    return kept
