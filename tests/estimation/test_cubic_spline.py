"""Natural cubic spline, compared with that of scipy."""

import numpy as np
import pytest
from scipy import interpolate

from tdhil.estimation.cubic_spline import CubicSpline


@pytest.mark.parametrize("count", [2, 3, 4, 50])
def test_value_and_slope_are_those_of_scipy(count):
    rng = np.random.default_rng(count)
    times = np.cumsum(rng.uniform(0.5, 2.0, count))
    values = rng.standard_normal(count)
    time = np.linspace(times[0] - 0.5, times[-1] + 0.5, 301)
    ours, theirs = CubicSpline.through(times, values), interpolate.CubicSpline(times, values, bc_type="natural")
    assert np.allclose(ours.at(time), theirs(time), rtol=1e-12, atol=1e-12)
    assert np.allclose(ours.slope(time), theirs(time, 1), rtol=1e-12, atol=1e-12)
