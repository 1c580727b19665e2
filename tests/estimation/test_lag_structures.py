"""J over every structure of the reports' filters: what each weighs, and the interval that their mixture gives."""

import math

import numpy as np
import pytest
from scipy.stats import t as student

from tdhil.estimation.frequency_domain.filter_order import Fitted, structures
from tdhil.estimation.frequency_domain.inference import _mixed, _Part, estimate, weighed
from tdhil.estimation.frequency_domain.rigid import fit_inertia
from tdhil.estimation.frequency_domain.shafts import INERTIA
from tdhil.estimation.friction_levels import ViscousConstraint
from tdhil.estimation.spectrum import Line

TRUTH, VISCOUS = 104.0, 8.0
HERTZ = (0.1, 0.2, 0.3, 0.5, 0.7, 1.0)


def lines(speed_poles, torque_poles, scatter_nm, seed):
    """Two mean speeds, ten periods each: exact lines, and torque that scatters by so much from period to period."""
    rng = np.random.default_rng(seed)
    found = []
    for hertz in HERTZ:
        s = 2j * math.pi * hertz
        g = (TRUTH * s + VISCOUS) * np.prod([1.0 + lag * s for lag in speed_poles])
        g /= np.prod([1.0 + lag * s for lag in torque_poles])
        speed = np.full(2, 0.4 / math.hypot(1.0, 2.0 * hertz) + 0.0j)
        periods = scatter_nm / math.sqrt(2.0) * (rng.standard_normal((2, 10)) + 1j * rng.standard_normal((2, 10)))
        scatter = float(np.sum(np.abs(periods - periods.mean(axis=1, keepdims=True)) ** 2) / 18.0)
        torque = g * speed + periods.mean(axis=1)
        found.append(Line(hertz, speed, torque, np.full(2, 10.0), 1e-12, scatter, 0.0j, 18.0))
    return tuple(found)


def fitted(speed_poles=(0.40,), torque_poles=(0.15,), scatter_nm=1.5, seed=0) -> Fitted:
    tie = ViscousConstraint(VISCOUS, 0.0, 0.1, 18.0)
    return fit_inertia(lines(speed_poles, torque_poles, scatter_nm, seed), tie, (), {}, 0.95)[2]


def part(value, sd, weight):
    return _Part(value, sd, sd, weight)


def test_one_estimate_alone_has_students_interval():
    edges = [_mixed([_Part(100.0, 1.0, 2.0, 1.0)], 12.0, share) for share in (0.025, 0.975)]
    quantile = student.ppf(0.975, 12.0)
    assert edges == pytest.approx([100.0 - quantile, 100.0 + 2.0 * quantile])


def test_two_that_weigh_alike_are_both_held():
    """Far apart, each with its outer 5 %."""
    edges = [_mixed([part(90.0, 1.0, 0.5), part(110.0, 1.0, 0.5)], 30.0, share) for share in (0.025, 0.975)]
    quantile = student.ppf(0.95, 30.0)
    assert edges == pytest.approx([90.0 - quantile, 110.0 + quantile])


def test_one_that_is_open_leaves_it_open_where_it_weighs():
    def edges(weight):
        parts = [part(100.0, 1.0, 1.0 - weight), _Part(100.0, 1.0, math.inf, weight)]
        return [_mixed(parts, 30.0, share) for share in (0.025, 0.975)]

    assert edges(0.2)[1] == math.inf
    assert math.isfinite(edges(0.2)[0])
    assert edges(0.01)[1] == pytest.approx(100.0 + student.ppf(0.975, 30.0), rel=0.01)


def test_more_parameters_never_fit_worse_and_the_weights_are_shares():
    found = structures(fitted(torque_poles=(0.25, 0.25)))
    assert len(found) == 8
    assert sum(share for *_, share in found) == pytest.approx(1.0)
    for less, held_less, _ in found:
        for more, held_more, _ in found:
            if held_more.keys() < held_less.keys():
                assert more.objective <= less.objective + 1e-3


def test_a_second_pole_that_is_clear_to_see_weighs_all():
    first, *_ = structures(fitted(torque_poles=(0.25, 0.25), scatter_nm=0.5))
    assert first[2] < 1e-6


def test_where_lags_are_first_order_the_interval_is_narrower_than_that_of_the_whole_family():
    fits = [fitted(scatter_nm=4.0, seed=seed) for seed in range(2)]
    mixed = [weighed(one, 0.95) for one in fits]
    whole = [estimate(one, INERTIA, 0.95) for one in fits]
    widths = [np.mean([one.high - one.low for one in found]) for found in (mixed, whole)]
    assert widths[0] < 0.9 * widths[1]
    assert all(one.low <= TRUTH <= one.high for one in mixed)


@pytest.mark.parametrize("torque_poles", [(0.25, 0.25), (0.37, 0.13)])
def test_what_the_whole_family_says_stays_part_of_it(torque_poles):
    """Also where the second pole is just not to be seen; the value is inside."""
    one = fitted(torque_poles=torque_poles)
    found = weighed(one, 0.95)
    assert found.low < one.whole.theta[INERTIA] < found.high
    assert found.low <= found.value <= found.high
    assert found.low <= TRUTH <= found.high
    alone = estimate(one, INERTIA, 0.95)
    assert alone.low <= found.low < found.high <= alone.high
    assert found.value == alone.value
