"""Rule for the end of stage 5: cost of interim looks, and working confidence that compensates for them."""

import math

import numpy as np
import pytest
from scipy.stats import f as fisher
from scipy.stats import norm
from scipy.stats import t as student

from tdhil.runner.design.stopping_rule import aimed_scatter, least_scale, working_confidence, worst_coverage


def simulated_coverage(confidence, dof, threshold, looks, runs=200_000):
    """Simulate the coverage of a mean. The unit of length is the pilot. The rule uses the variance only."""
    rng = np.random.default_rng(5)
    variance, length = rng.chisquare(dof, runs) / dof, np.ones(runs)
    squared = student.ppf(0.5 + 0.5 * confidence, dof) ** 2 * threshold
    for _ in range(looks):
        quantile = student.ppf(0.5 + 0.5 * confidence, dof * length)
        needed = np.maximum(length * quantile**2 * variance / length / squared, 1.1)
        added = np.where(quantile**2 * variance / length > squared, length * np.maximum(needed - 1.0, 0.1), 0.0)
        own = rng.chisquare(np.maximum(dof * added, 1e-9))
        variance = (dof * length * variance + np.where(added > 0.0, own, 0.0)) / (dof * (length + added))
        length = length + added
    error = rng.standard_normal(runs) / np.sqrt(length)      # independent of the scatter
    half = student.ppf(0.5 + 0.5 * confidence, dof * length) * np.sqrt(variance / length)
    return float(np.mean(np.abs(error) <= half))


@pytest.mark.heavy
@pytest.mark.parametrize("looks", [1, 3])
@pytest.mark.parametrize("threshold", [0.7, 0.9])
def test_the_working_confidence_compensates_for_interim_looks(threshold, looks):
    chance = 3.0 * math.sqrt(0.05 * 0.95 / 200_000)
    plain = simulated_coverage(0.95, 16.0, threshold, looks)
    mended = simulated_coverage(working_confidence(0.95, 16.0), 16.0, threshold, looks)
    assert plain < 0.9475                                    # interim looks reduce the coverage
    assert plain >= worst_coverage(0.95, 16.0) - chance      # and by no more than the rule assumes
    assert mended >= 0.95 - chance


@pytest.mark.heavy
@pytest.mark.parametrize("confidence", [0.8, 0.95, 0.99])
def test_the_correction_is_small_and_vanishes_with_a_long_pilot(confidence):
    working = [working_confidence(confidence, dof) for dof in (10.0, 20.0, 80.0, 2000.0)]
    assert working == sorted(working, reverse=True)
    assert all(one > confidence for one in working)
    wider = norm.ppf(0.5 + 0.5 * working[1]) / norm.ppf(0.5 + 0.5 * confidence)
    assert wider < 1.06
    assert working[-1] - confidence < 0.02 * (1.0 - confidence)
    assert worst_coverage(working[1], 20.0) == pytest.approx(confidence, abs=1e-6)


def test_the_assumed_scatter_is_exceeded_with_the_stated_probability():
    rng = np.random.default_rng(1)
    dof, added = 20.0, 30.0
    ratio = rng.chisquare(added, 200_000) / added / (rng.chisquare(dof, 200_000) / dof)
    pooled = (dof + added * ratio) / (dof + added)
    from tdhil.runner.design.stopping_rule import AIM

    assert np.mean(pooled <= aimed_scatter(dof, added)) == pytest.approx(AIM, abs=0.005)
    assert aimed_scatter(dof, added) == pytest.approx((dof + added * fisher.ppf(AIM, added, dof)) / (dof + added))
    assert aimed_scatter(dof, 0.0) == 1.0


@pytest.mark.parametrize("floor", [0.0, 0.005, 0.009])
@pytest.mark.parametrize("tolerance", [0.01, 0.012, 0.02])
def test_the_least_scale_is_found(floor, tolerance):
    asked = []

    def half_width(scale):
        asked.append(scale)
        return math.sqrt(0.03**2 / scale + floor**2)

    scale, then, enough = least_scale(half_width, tolerance, 100.0)
    exact = 0.03**2 / (tolerance**2 - floor**2)
    assert enough is (exact <= 100.0)
    if enough:
        assert 0.999 * exact <= scale <= 1.08 * exact
        assert 0.95 * tolerance <= then <= tolerance * (1.0 + 1e-9)
    assert len(asked) <= 6


def test_no_time_is_used_for_an_unreachable_tolerance():
    scale, then, enough = least_scale(lambda x: math.sqrt(0.03**2 / x + 0.02**2), 0.01, 100.0)
    assert not enough
    assert scale < 15.0                                       # ±2.2 % there, ±2.02 % at a hundred
    assert then <= 1.1 * math.sqrt(0.03**2 / 100.0 + 0.02**2)
    assert least_scale(lambda _: math.inf, 0.01, 100.0) == (100.0, math.inf, False)
    assert least_scale(lambda _: 0.005, 0.01, 100.0) == (1.0, 0.005, True)
