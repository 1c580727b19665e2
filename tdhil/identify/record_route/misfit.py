"""Does any smooth response explain the bins better than the model? Then the model is wrong, and so may be its number.

Within some neighbouring bins of one window every shaft's response is nearly a straight line over frequency,

    T = g₀ W_0 + g₁ (W_1 + (s − s₀) W_0),

two complex unknowns (the local polynomial method). What that leaves is noise, measured without a model. If the model
leaves so much more that F says it is no chance, then the data contradict it.
"""

import numpy as np

from tdhil.estimation.result import ResidualTest
from tdhil.estimation.time_domain.equation import evaluate
from tdhil.estimation.time_domain.fit import Problem
from tdhil.recording.recording import FloatArray

_GROUP = 6
_FIRST = 2       # bins of a window below it are friction's, constant and all


def local_test(problem: Problem, theta: FloatArray, factor: float) -> ResidualTest | None:
    """F test of the model against local straight lines; None if there are not enough bins in a row.

    ``factor``: by how much more than its noise model says the inertia scatters over time. Noise that comes with the
    motion is shared by many bins, so F is divided by factor², and its degrees of freedom are taken as half as many.
    """
    found = evaluate(theta, problem.bins)
    bins, variance = problem.bins, problem.variance
    by_model, by_line, dof_model, dof_line = 0.0, 0.0, 0, 0
    for number in np.unique(bins.window):
        mine = np.flatnonzero((bins.window == number) & (bins.hertz > 0.0))[_FIRST - 1 :]
        for first in range(0, len(mine) - _GROUP + 1, _GROUP):
            part = mine[first : first + _GROUP]
            weight = 1.0 / np.sqrt(variance[part])
            s = bins.s[part]
            lines = np.stack([bins.speed[part, 0],
                              bins.speed[part, 1] + (s - s.mean()) * bins.speed[part, 0]], axis=1)
            u, _ = np.linalg.qr(lines * weight[:, None])
            error = found.error[part] * weight
            left = error - u @ (u.conj().T @ error)
            by_model += 2.0 * float(np.sum(np.abs(error) ** 2))
            by_line += 2.0 * float(np.sum(np.abs(left) ** 2))
            dof_model += 2 * _GROUP
            dof_line += 2 * (_GROUP - 2)
    fitted = len(problem.free)
    extra = dof_model - fitted - dof_line
    if dof_line < 8 or extra < 2 or by_line <= 0.0:
        return None
    from scipy.stats import f

    statistic = (by_model - by_line) / extra / (by_line / dof_line) / factor**2
    return ResidualTest(float(statistic), float(extra), float(f.sf(statistic, extra, 0.5 * dof_line)))
