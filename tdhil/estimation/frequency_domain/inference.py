"""Intervals from the profile likelihood: all values that the data, with everything else refitted, don't contradict.

The quadratic approximation fails where lags are matched, or at a bound: there the likelihood is flat along a curved
valley. The profile P(x) = min over the other parameters of −2 ln L follows the valley, and needs no derivative at a
bound. The interval is {x: P(x) ≤ P_min + t²}, t Student's quantile: chi-square would take the weights for known.
"""

import math
from collections.abc import Callable

import numpy as np

from tdhil.estimation.frequency_domain.likelihood import Likelihood
from tdhil.estimation.frequency_domain.optimiser import Box, Fit
from tdhil.recording.recording import FloatArray

_TRIES = 14
_CLOSE = 5e-3     # of t: how well the edge is found


def student_quantile(confidence: float, dof: float) -> float:
    """Two-sided quantile of Student's t."""
    from scipy.stats import t

    return float(t.ppf(0.5 + 0.5 * confidence, dof))


def standard_deviation(problem: Likelihood, theta: FloatArray, index: int, free: list[int]) -> tuple[float, float]:
    """Of theta[index] in the quadratic approximation, and the degrees of freedom of that (Satterthwaite).

    var = cᵀ F c with c = F⁻¹ e_i = Σ over the parts of F, each as uncertain as the weight it was built on.
    """
    whole, parts = problem.information(theta)
    chosen = np.ix_(free, free)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(whole)[free], 1e-300))
    inverse = np.linalg.pinv(whole[chosen] * np.outer(scale, scale), rcond=1e-13, hermitian=True)
    column = inverse[:, free.index(index)] * scale * scale[free.index(index)]
    shares = np.array([column @ part[chosen] @ column for part, _ in parts])
    variance = float(np.sum(shares))
    uncertain = float(np.sum([share**2 / dof for share, (_, dof) in zip(shares, parts, strict=True)]))
    dof = variance**2 / uncertain if uncertain > 0.0 else math.inf
    return math.sqrt(max(variance, 0.0)), max(1.0, min(dof, 1e6))


Refit = Callable[[FloatArray, float], Fit]
"""The best fit with the parameter held at a value, from a start (P,) nearby."""


def profile_edge(refit: Refit, limits: Box, best: Fit, index: int, step: float, rise: float) -> float:
    """Where the profile has risen by ``rise`` on the side of ``step``'s sign; a bound, or ±inf, if it never does.

    The root of √(P − P_best) is sought, which is a straight line for a quadratic likelihood.
    """
    target = math.sqrt(max(rise, 0.0))
    if target == 0.0:
        return float(best.theta[index])
    centre = float(best.theta[index])
    bound = float(limits.high[index] if step > 0.0 else limits.low[index])
    inside, inside_root, inside_theta = centre, 0.0, best.theta
    outside: tuple[float, float] | None = None
    x = centre + step
    for _ in range(_TRIES):
        x = min(x, bound) if step > 0.0 else max(x, bound)
        fit = refit(inside_theta, x)
        root = math.sqrt(max(fit.objective - best.objective, 0.0))
        if abs(root - target) <= _CLOSE * target:
            return x
        if root < target:
            if x == bound:
                return bound
            inside, inside_root, inside_theta = x, root, fit.theta
        else:
            outside = (x, root)
        if outside is None:
            stretch = min(max(target / root if root > 0.0 else 4.0, 1.2), 4.0)
            x = centre + (x - centre) * stretch
        else:
            share = (target - inside_root) / (outside[1] - inside_root)
            x = inside + min(max(share, 0.05), 0.95) * (outside[0] - inside)
    return x if outside is not None else math.copysign(math.inf, step)
