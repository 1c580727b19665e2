"""Do the residuals look like the scatter between periods? If not, the model is wrong, and so would its number be.

Of M segment means with weights estimated on ν complex degrees of freedom, q/M follows F(2M, 2ν). Bartlett's form of its
logarithm,

    (2ν + M − 1) ln(1 + q/ν)  ~  χ²(2M),

holds far into the tail, where sums of F itself do not; the tie of B to the levels, t(n), adds (n − ½) ln(1 + z²/n)
~ χ²(1), and what is known of the lags χ²(1) each. Their sum at the best parameters has lost one degree of freedom to
each parameter that was free to follow the data: those at a bound were not.
"""

import math

import numpy as np

from tdhil.estimation.frequency_domain.filter_order import Fitted
from tdhil.estimation.frequency_domain.likelihood import Likelihood
from tdhil.estimation.frequency_domain.spectrum import Line
from tdhil.estimation.result import ResidualTest
from tdhil.recording.recording import FloatArray

REJECT_P = 0.001
_AT_BOUND = 1e-6      # of the natural scale


def rejects(test: ResidualTest | None) -> bool:
    """Do the data contradict the model? Also where the statistic is no number."""
    return test is not None and not test.p_value >= REJECT_P


def residual_of(fitted: Fitted, chosen: int = 0) -> ResidualTest | None:
    """Of the whole family's fit; what counts as fitted are the free parameters inside their bounds.

    ``chosen``: how many more were, by a choice among models.
    """
    theta, limits = fitted.whole.theta, fitted.limits
    near = _AT_BOUND * limits.scale
    inside = (theta > limits.low + near) & (theta < limits.high - near)
    return residual_test(fitted.problem, theta, int(np.count_nonzero(inside[fitted.free])) + chosen)


def contradicted(problem: Likelihood, theta: FloatArray, others: tuple[Line, ...]) -> bool:
    """Do lines that were not fitted contradict theta (P,)? For lines that were too weak in one signal.

    A shaft that swings stands still at its antiresonance while the torque goes on: that line has no speed to speak of,
    and says most. Each by itself, by Bartlett's form as above; theta is all but exact for lines as weak as these.
    """
    from scipy.stats import chi2

    if not others:
        return False
    beside = Likelihood(others, problem.model, None, ())
    _, q = beside.weighted(theta)
    m, nu = beside.segments, beside.nu
    p_values = chi2.sf((2.0 * nu + m - 1.0) * np.log1p(q / nu), 2.0 * m)
    return bool(np.min(p_values) < REJECT_P / len(others))


def residual_test(problem: Likelihood, theta: FloatArray, fitted: int) -> ResidualTest | None:
    """The sum against its expectation; None where as much was fitted as was measured."""
    _, q = problem.weighted(theta)
    m, nu = problem.segments, problem.nu
    measured = 2.0 * float(np.sum(m)) + len(problem.priors)
    statistic = float(np.sum((2.0 * nu + m - 1.0) * np.log1p(q / nu)))
    statistic += float(sum(((theta[p.index] - p.mean) / p.sd) ** 2 for p in problem.priors))
    if problem.tie is not None:
        n = problem.tie.dof
        measured += 1.0
        statistic += max(n - 0.5, 0.5) * math.log1p(problem.tie_error(theta) ** 2 / n)
    left = measured - fitted
    if left < 1.0:
        return None
    from scipy.stats import chi2

    return ResidualTest(statistic=statistic, degrees_of_freedom=left, p_value=float(chi2.sf(statistic, left)))
