"""Differences and histories, compared with simulation and with the densities themselves."""

import math

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from tdhil.fleet import change_detection
from tdhil.fleet.change_detection import Measured, difference, history
from tests.fleet.drawn_histories import KINDS, draw


def one(value, rel_sd=0.004, drive="a", scale=0.03, time=0.0):
    wide = math.exp(1.959963985 * rel_sd)
    return Measured(value, value / wide, value * wide, 0.95, scale, drive, time)


def test_on_one_drive_the_torque_scale_cancels():
    told = difference(one(104.0), one(106.08))
    assert told.shared_scale
    assert told.change == pytest.approx(0.02)
    half = 1.96 * 0.004 * math.sqrt(2)
    assert (told.low, told.high) == pytest.approx((1.02 * math.exp(-half) - 1, 1.02 * math.exp(half) - 1), rel=1e-3)
    assert told.differs
    for drive in ("b", None):
        other = difference(one(104.0, drive=drive), one(106.08))
        assert not other.shared_scale
        assert not other.differs
        assert other.high - other.low > 4.0 * (told.high - told.low)


def test_the_interval_of_a_difference_covers():
    rng = np.random.default_rng(1)
    hits = {True: 0, False: 0}
    for _ in range(2000):
        for same in hits:
            scales = np.exp(0.03 * rng.standard_normal(2))
            values = 104.0 * np.array([1.0, 1.02]) * (scales[0] if same else scales)
            told = difference(*(one(float(value * np.exp(0.004 * rng.standard_normal())), drive=drive)
                                for value, drive in zip(values, ("a", "a" if same else "b"), strict=True)))
            hits[same] += told.low <= 0.02 <= told.high
    assert all(0.935 < hit / 2000 < 0.965 for hit in hits.values())


def test_quantities_that_may_be_zero_are_compared_without_a_logarithm():
    told = difference(Measured(-0.001, -0.003, 0.001), Measured(0.005, 0.003, 0.007))
    assert not told.relative
    assert told.change == pytest.approx(0.006)
    assert told.high - told.low == pytest.approx(0.004 * math.sqrt(2))


def test_the_evidence_is_that_of_the_densities(monkeypatch):
    """With one κ and one τ, the oracle is multivariate normal densities with a nearly flat prior of the mean."""
    monkeypatch.setattr(change_detection, "_SPREAD", ((1.4, 1.0),))
    monkeypatch.setattr(change_detection, "_SIZES", (8.0,))
    rng = np.random.default_rng(3)
    n = 7
    sd, time = rng.uniform(0.003, 0.008, n), np.sort(rng.uniform(0, 100, n))
    of_drive = 0.03 * (np.arange(n)[:, None] // 4 == np.arange(2))
    own = np.where(np.arange(n) == 5, 0.02, 0.0)                 # a result of an unknown drive
    of_drive[5] = 0.0
    shared = of_drive @ of_drive.T + np.diag(own**2)
    x = 4.6 + sd * rng.standard_normal(n) + 0.01 * (np.arange(n) >= 3)
    flat = 10.0**2 * np.ones((n, n))
    covariance = 1.96 * np.diag(sd**2) + shared + flat
    shapes = [np.arange(n) >= c for c in range(1, n)] + [(time - time[0]) / (time[-1] - time[0])]
    pairs = [(np.arange(n) >= c) & (np.arange(n) < d) for c in range(1, n) for d in range(c + 1, n)]
    size = 8.0 * np.median(sd)
    none = multivariate_normal.logpdf(x, np.full(n, 4.6), covariance)
    each, of_pairs = ([math.exp(multivariate_normal.logpdf(
        x, np.full(n, 4.6), covariance + size**2 * np.outer(h, h)) - none) for h in some] for some in (shapes, pairs))
    weights = [0.5, 0.2 * np.mean(each[:-1]) + 0.1 * np.mean(of_pairs), 0.2 * each[-1]]
    known = change_detection._Series(x, sd, of_drive, own, time)
    found = change_detection._evidence(known)
    assert [found.none, found.step, found.drift] == pytest.approx(np.array(weights) / sum(weights), rel=1e-3)
    assert found.places == pytest.approx(np.array(each[:-1]) / sum(each[:-1]), rel=1e-3)
    # The size by regression with its own prior: mean and covariance of level and size for each place
    inverse, posterior = np.linalg.inv(covariance), []
    for share, shape in zip(found.places, shapes[:-1], strict=True):
        design = np.column_stack((np.ones(n), shape))
        of_fit = np.linalg.inv(design.T @ inverse @ design + np.diag([0.0, 1.0 / size**2]))
        posterior.append((share, norm((of_fit @ design.T @ inverse @ x)[1], math.sqrt(of_fit[1, 1]))))
    zero = 0.5 / (0.5 + 0.2 * np.mean(each[:-1]))
    for change in (-0.01, 0.001, 0.005, 0.01):
        below = zero * (change > 0.0) + (1.0 - zero) * sum(share * one.cdf(change) for share, one in posterior)
        assert found.step_size.below(change) == pytest.approx(below, rel=2e-3)
        assert found.step_size.quantile(found.step_size.below(change)) == pytest.approx(change, rel=1e-3)
    assert found.step_size.quantile(found.step_size.below(0.0) + 0.5 * zero) == 0.0


def test_a_long_history_needs_no_matrix_of_its_length(monkeypatch):
    """1000 results used to take seconds: each factor inverted a 1000 by 1000 matrix, which delayed the page."""
    sizes = []
    for name in ("inv", "slogdet", "solve"):
        made = getattr(np.linalg, name)
        monkeypatch.setattr(np.linalg, name,
                            lambda matrix, *more, made=made: (sizes.append(len(matrix)), made(matrix, *more))[1])
    rng = np.random.default_rng(5)
    rows = [one(104.0 * (1.0 + 0.02 * (k >= 120)) * math.exp(0.004 * rng.standard_normal()), drive="ab"[k % 2], time=k)
            for k in range(200)]
    found = history(rows)
    assert [change.at for change in found.changes] == [120]
    assert max(sizes) == 2                           # the drives


@pytest.mark.parametrize(("kind", "least", "most"), [
    ("none", 0, 2), ("step 2 %", 38, 40), ("step 5 %", 40, 40), ("drift 5 %", 40, 40),
])
def test_a_scale_of_3_percent_neither_hides_a_step_nor_makes_one(kind, least, most):
    rng = np.random.default_rng(11)
    found = [history(draw(rng, kind, 24)[0]) for _ in range(40)]
    assert least <= sum(one.changed for one in found) <= most
    for one_history in found:
        assert one_history.none + one_history.step + one_history.drift == pytest.approx(1.0)


def test_place_and_size_of_a_step():
    rng = np.random.default_rng(2)
    results, at = draw(rng, "step 5 %", 24)
    found = history(results)
    (change,) = found.changes
    assert change.at == at
    assert change.change.low < 0.05 < change.change.high
    assert change.probability > 0.999
    assert found.drift_change is None


@pytest.mark.parametrize(("kind", "results"), [
    ("step 1 %", 12), *(pytest.param(*one, marks=pytest.mark.heavy) for one in (("step 1 %", 20), ("step 2 %", 12)))])
def test_the_size_of_a_rarely_found_step_covers(kind, results):
    """Chance determines whether such a step is found. At its most probable place alone, 82 to 94 % covered."""
    rng = np.random.default_rng([3, results, round(1000 * KINDS[kind])])
    found = [history(draw(rng, kind, results)[0]).changes for _ in range(300)]
    sizes = [steps[0].change for steps in found if len(steps) == 1]
    assert len(sizes) > 40
    assert sum(one.low <= KINDS[kind] <= one.high for one in sizes) >= 0.94 * len(sizes)


def test_the_size_of_a_doubtful_step_includes_none():
    """The interval contains 0 if "no change" has more than half of the probability outside of the interval."""
    rng = np.random.default_rng(21)
    doubtful = [(told, step) for told in (history(draw(rng, "step 1 %", 12)[0]) for _ in range(200))
                for step in told.changes if len(told.changes) == 1]
    assert any(told.none > 0.05 for told, _ in doubtful)
    for told, step in doubtful:
        zero = told.none / (told.none + told.step)
        assert 0.0 in (step.change.low, step.change.high) or zero < 0.025
        assert step.change.probability <= 1.0 - zero


@pytest.mark.parametrize(("results", "begin", "end", "size"), [
    (12, 4, 8, 0.02), (24, 8, 16, 0.02), (24, 10, 14, 0.03), (12, 6, 8, 0.05), (300, 100, 130, 0.02),
])
def test_a_change_that_ends_again_is_two_steps(results, begin, end, size):
    """A body left on the shaft, or another gear: no step was named, and "no change" was up to 70 % probable."""
    rng = np.random.default_rng(results)
    named = 0
    for _ in range(12):
        level = [104.0 * (1.0 + size * (begin <= k < end)) for k in range(results)]
        found = history([one(level[k] * math.exp(0.004 * rng.standard_normal()), time=k) for k in range(results)])
        places = [change.at for change in found.changes]
        named += len(places) == 2 and abs(places[0] - begin) <= 1 and abs(places[1] - end) <= 1
    assert named >= 10


def test_two_steps_are_two():
    rng = np.random.default_rng(4)
    levels = [104.0] * 10 + [100.0] * 10 + [102.0] * 10
    found = history([one(level * float(np.exp(0.004 * rng.standard_normal())), time=k)
                     for k, level in enumerate(levels)])
    assert [change.at for change in found.changes] == [10, 20]


STEPS = {10: 0.04, 20: -0.03}
"""Two steps in 30 results: number of the first result after each, and its size."""


@pytest.mark.parametrize("scatter", [1.0, pytest.param(0.6, marks=pytest.mark.heavy)])
def test_the_sizes_of_two_steps_cover(scatter):
    """Every reported step of 200 histories counts, also where only one of the two steps was found."""
    rng = np.random.default_rng(3)
    hits = reported = 0
    for _ in range(200):
        scale = 1.0 + 0.03 * rng.standard_normal()
        results = []
        for k in range(30):
            level = 104.0 * scale * math.prod(1.0 + size for at, size in STEPS.items() if k >= at)
            sd = rng.uniform(0.003, 0.008)
            value, wide = level * float(np.exp(scatter * sd * rng.standard_normal())), math.exp(1.96 * sd)
            results.append(Measured(value, value / wide, value * wide, 0.95, 0.03, "drive", 7.0 * k))
        for found in history(results).changes:
            true = STEPS[min(STEPS, key=lambda at: abs(at - found.at))]
            reported += 1
            hits += found.change.low <= true <= found.change.high
    assert reported > 300
    assert hits / reported >= 0.93


def test_a_drive_that_was_replaced_explains_a_step_of_its_scale():
    rng = np.random.default_rng(4)

    def told(second):
        return history([one((104.0 if k < 12 else 106.5) * float(np.exp(0.004 * rng.standard_normal())), time=k,
                            drive="a" if k < 12 else second) for k in range(24)])

    assert told("a").changed
    assert not told("b").changed


def test_units_and_order_have_no_effect_and_too_few_are_refused():
    rng = np.random.default_rng(6)
    results, _ = draw(rng, "step 1 %", 12)
    scaled = [Measured(3 * r.value, 3 * r.low, 3 * r.high, r.confidence, r.scale_rel_sd, r.drive, r.time)
              for r in results]
    assert history(scaled).none == pytest.approx(history(results).none, rel=1e-9)
    for wrong in (results[:3], results[::-1]):
        with pytest.raises(ValueError, match="results"):
            history(wrong)
    with pytest.raises(ValueError, match="no interval"):
        difference(results[0], Measured(1.0, 2.0, 1.0))
