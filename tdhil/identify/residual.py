"""Do the residuals look like the scatter between periods? If not, the model is wrong, and so would its number be.

Of M segment means with weights estimated on ν degrees of freedom, q is M·F(2M, 2ν): mean Mν/(ν − 1), variance
M² · 2ν'²(2M + ν' − 2)/(2M (ν' − 2)²(ν' − 4)) with ν' = 2ν. The sum over the lines, less a share for the fitted
parameters, is compared with the scaled χ² of the same mean and variance.
"""

import numpy as np

from tdhil.identify.identification import ResidualTest
from tdhil.identify.likelihood import Likelihood
from tdhil.record.recording import FloatArray

REJECT_P = 0.001


def rejects(test: ResidualTest | None) -> bool:
    """Do the data contradict the model? Also where the statistic is no number."""
    return test is not None and not test.p_value >= REJECT_P


def residual_test(problem: Likelihood, theta: FloatArray, fitted: int) -> ResidualTest | None:
    """Weighted residual sum against its expectation; None where as much was fitted as was measured."""
    _, q = problem.weighted(theta)
    m, nu = problem.segments, 2.0 * problem.nu
    measured = 2.0 * float(np.sum(m))
    statistic = 2.0 * float(np.sum(q))
    if problem.tie is not None:
        measured += 1.0
        statistic += problem.tie_error(theta) ** 2
    measured += len(problem.priors)
    statistic += float(sum(((theta[p.index] - p.mean) / p.sd) ** 2 for p in problem.priors))
    left = measured - fitted
    if left < 1.0:
        return None
    safe = np.maximum(nu, 4.5)
    mean = 2.0 * float(np.sum(m * safe / (safe - 2.0)))
    variance = 4.0 * float(np.sum(m * safe**2 * (2.0 * m + safe - 2.0) / ((safe - 2.0) ** 2 * (safe - 4.0))))
    extra = measured - 2.0 * float(np.sum(m))
    mean, variance = (mean + extra) * left / measured, (variance + 2.0 * extra) * left / measured
    scale, dof = variance / (2.0 * mean), 2.0 * mean**2 / variance
    from scipy.stats import chi2

    return ResidualTest(statistic=statistic, degrees_of_freedom=left, p_value=float(chi2.sf(statistic / scale, dof)))
