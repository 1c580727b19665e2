"""Margins, stability and step responses of one loop, against python-control."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tdhil.speed_loop import (
    LoopPlant,
    NotchFilter,
    PiGains,
    SpringLoad,
    is_stable_loop,
    speed_loop_margins,
    step_figures,
    step_responses,
)
from tdhil.speed_loop.loop import margins_of
from tdhil.speed_loop.step import loop_responses

pytest.importorskip("control")
from tests.speed_loop import by_control


def random_loop(seed: int) -> tuple[LoopPlant, PiGains]:
    """Return a rigid shaft or two masses on a spring; every fourth one has a notch."""
    rng = np.random.default_rng(seed)
    inertia, lags = 10.0 ** rng.uniform(-2.0, 3.0), tuple(rng.uniform(0.003, 0.03, 2))
    spring = notch = None
    if seed % 2:
        swing = rng.uniform(0.02, 1.0) / sum(lags) / (2.0 * math.pi)
        spring = SpringLoad(swing, swing * rng.uniform(1.1, 2.5), 0.05 * inertia * 2.0 * math.pi * swing)
        notch = NotchFilter(spring.resonance_hz, 0.1, 0.6) if seed % 4 == 3 else None
    plant = LoopPlant(inertia, 0.05 * inertia * rng.random(), lags, rng.uniform(0.001, 0.01), spring)
    gain = 10.0 ** rng.uniform(-1.2, 0.6) * inertia / sum(lags)
    return plant, PiGains(gain, gain**2 / (4.0 * plant.total_inertia_kg_m2), notch)


@pytest.mark.parametrize("seed", range(16))
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_margins_are_those_of_python_control(seed):
    plant, gains = random_loop(seed)
    found, true = speed_loop_margins([plant], gains)[0], by_control.true_margins(plant, gains)
    assert found.stable is true.stable is is_stable_loop(plant, gains)
    assert found.phase_deg == pytest.approx(true.phase_deg, abs=0.3)
    assert found.gain_db == pytest.approx(true.gain_db, abs=0.1)


def test_some_of_these_loops_are_unstable():
    stable = [speed_loop_margins([plant], gains)[0].stable for plant, gains in map(random_loop, range(16))]
    assert True in stable and False in stable


@pytest.mark.parametrize("seed", [0, 1, 3])
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_the_step_response_is_that_of_python_control(seed):
    plant, gains = random_loop(seed)
    gains = PiGains(0.3 * gains.gain_nm_s_rad, 0.09 * gains.integral_nm_rad, gains.notch)
    span = 30.0 * plant.total_inertia_kg_m2 / gains.gain_nm_s_rad
    time_s, speeds = step_responses([plant], gains, span)
    assert np.max(np.abs(speeds[0] - by_control.step(plant, gains, time_s))) < 1e-5


def test_a_rigid_shaft_without_lags_has_the_margins_of_a_text_book():
    """P = 1, I = 0.25, J = 1 give a double pole at −0.5, T = (s + 0.25)/(s + 0.5)², and no phase crossover."""
    plant, gains = LoopPlant(1.0, 0.0, (1e-6,)), PiGains(1.0, 0.25)
    found = speed_loop_margins([plant], gains)[0]
    crossover = math.sqrt((1.0 + math.sqrt(1.25)) / 2.0)
    assert found.phase_deg == pytest.approx(math.degrees(math.atan(crossover / 0.25)), abs=0.1)
    assert found.gain_db == math.inf
    time_s, speeds = step_responses([plant], gains, 40.0)
    exact = 1.0 - np.exp(-0.5 * time_s) * (1.0 - 0.5 * time_s)
    assert speeds[0] == pytest.approx(exact, abs=1e-4)
    figures = step_figures(time_s, exact)
    assert figures.overshoot_share == pytest.approx(math.exp(-2.0), abs=1e-3)     # at t = 4
    assert figures.settling_s == pytest.approx(time_s[np.flatnonzero(np.abs(exact - 1.0) > 0.05)[-1] + 1])


@pytest.mark.parametrize(("factor", "stable", "conditional"), [(4.0, True, True), (0.25, False, False)])
def test_a_loop_that_a_lower_gain_destabilises_is_named(factor, stable, conditional):
    """The textbook loop K (s + 1)²/s³ is stable above K = 0.5. Its phase is −180° at 1 rad/s, with |L| = 2 K."""
    omega = np.geomspace(1e-3, 1e3, 2000)
    s = 1j * omega
    loop = factor * (s + 1.0) ** 2 / s**3
    (found,) = margins_of(loop[None, :], np.ones((1, len(omega)), dtype=complex), omega)
    assert (found.stable, found.conditional) == (stable, conditional)
    assert found.gain_db == pytest.approx(abs(20.0 * math.log10(2.0 * factor)), abs=0.01)
    assert not found.keeps(1.0, 1.0)


def test_a_speed_that_does_not_arrive_has_no_rise():
    assert step_figures(np.array([0.0, 1.0]), np.array([0.0, 0.3])).rise_s == math.inf


def test_gains_far_slower_than_the_lags_have_margins_too():
    """P/J is a millionth of 1/Στ."""
    found = speed_loop_margins([LoopPlant(1.0, 0.0, (0.01,))], PiGains(1e-4, 2.5e-9))[0]
    assert found.stable and 70.0 < found.phase_deg < 80.0
    assert 1e-5 < found.bandwidth_hz < 3e-5


@pytest.mark.parametrize(("over", "under"), [(0.04, 0.4), (0.3, 1.0), (0.1, 1.0)])
def test_width_and_depth_of_a_notch_are_those_of_its_response(over, under):
    notch = NotchFilter(3.0, over, under)
    assert -20.0 * math.log10(abs(notch.at(np.array([2j * math.pi * 3.0]))[0])) == pytest.approx(notch.depth_db)
    assert notch.width_hz is not None
    half = math.sqrt(9.0 + 0.25 * notch.width_hz**2)           # the ends lie evenly around it on a logarithmic scale
    for hertz in (half - 0.5 * notch.width_hz, half + 0.5 * notch.width_hz):
        assert abs(notch.at(np.array([2j * math.pi * hertz]))[0]) ** 2 == pytest.approx(0.5)


def test_a_shallow_notch_has_no_width_of_3_db():
    assert NotchFilter(3.0, 0.8, 1.0).width_hz is None


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("rate_1_s", [50.0, 1e5])       # the powers overflow, or the matrix exponential itself
def test_a_loop_whose_response_overflows_never_settles(rate_1_s):
    a, b, c = np.array([[rate_1_s, 1.0], [0.0, rate_1_s]]), np.array([1.0, -1.0]), np.array([1.0, 0.0])
    (speed,) = loop_responses([(a, b, c)], [30.0])
    figures = step_figures(np.linspace(0.0, 30.0, len(speed)), speed)
    assert figures.overshoot_share == figures.settling_s == math.inf
