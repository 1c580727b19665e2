"""Impedance, reflection and poles, compared with the reference table, the chain of lumps and each other."""

from __future__ import annotations

import numpy as np
import pytest

from tdhil.soft_torque import (
    ClosedSystem,
    RootsLost,
    SpeedController,
    TopDrive,
    count_in,
    impedance,
    margins,
    reflection_at,
    roots_in,
    softest_allowed,
    stiff_controller,
    tuned_controller,
)
from tests.soft_torque.cases import DRIVE, HALF, STRING, TABLE, Pipe, chain_modes, lumped_chain


@pytest.mark.parametrize("name", TABLE)
def test_poles_of_the_whole_loop_are_those_of_the_chain(name):
    a, _, _ = lumped_chain([Pipe(3000.0, 0.127, 0.1086, lumps=100)], 374.0, 20.0, DRIVE, TABLE[name])
    chain = [one for one in chain_modes(a, 1.2) if one[1] < 0.97]
    exact = ClosedSystem(STRING, DRIVE, TABLE[name]).modes(1.2)
    assert len(chain) == len(exact)
    for (hertz, damping), mode in zip(chain, exact, strict=True):
        assert hertz == pytest.approx(mode.frequency_hz, rel=1e-3)
        assert damping == pytest.approx(mode.damping, abs=1e-3)


@pytest.mark.parametrize(("name", "reflected", "dampings"), [
    ("stiff", 0.992, (0.036,)),
    ("paper", 0.932, (0.062,)),
    ("a=1", 0.046, (0.059, 0.083)),
    ("a=0.25", 0.593, (0.23, 0.27)),
    ("a=0.35", 0.537, (0.14, 0.28)),
    ("half", 0.477, (0.26, 0.53)),
])
def test_the_reference_table(name, reflected, dampings):
    (first,) = ClosedSystem(STRING).modes(0.3)
    at_mode = np.array([first.frequency_hz])
    assert reflection_at(DRIVE, TABLE[name], STRING, at_mode)[0] == pytest.approx(reflected, abs=1e-3)
    modes = ClosedSystem(STRING, DRIVE, TABLE[name]).modes(0.25)
    assert sorted(mode.damping for mode in modes) == pytest.approx(dampings, abs=0.005)


def test_the_stiff_controller_has_the_margin_that_it_states():
    found = stiff_controller(DRIVE, 60.0)
    assert found.gain_nm_s_rad == pytest.approx(20286.0, rel=0.005)
    assert found.integral_nm_rad == pytest.approx(26454.0, rel=0.005)
    seen = margins(DRIVE, found, None)
    assert seen.phase_deg == pytest.approx(60.0, abs=1e-3)
    assert seen.crossover_rad_s == pytest.approx(10.0 * found.integral_nm_rad / found.gain_nm_s_rad, rel=1e-3)
    with pytest.raises(ValueError, match="no lag"):
        stiff_controller(TopDrive(1500.0), 60.0)
    with pytest.raises(ValueError, match="phase margin"):
        stiff_controller(DRIVE, 178.0)


def test_tuned_gains_match_at_the_stated_frequency():
    """Without inner lags and with B = 0, r = (1 − a)/(1 + a) at the mode."""
    bare = TopDrive(1500.0)
    for softness in (0.2, 1.0, 1.7):
        law = tuned_controller(STRING, 1500.0, softness, 0.1299)
        found = reflection_at(bare, law, STRING, np.array([0.1299]))[0]
        assert found == pytest.approx(abs(1.0 - softness) / (1.0 + softness), abs=1e-9)


def test_softer_than_allowed_drives_slow_oscillations():
    """Re Z(jω → 0) changes its sign at the returned a."""
    drive = TopDrive(1500.0, 0.0, 0.0, (0.2, 0.15))
    most = softest_allowed(STRING, drive, 0.1299)
    slow = np.array([1e-3j])
    for share, sign in ((0.9, 1.0), (1.1, -1.0)):
        law = tuned_controller(STRING, 1500.0, share * most, 0.1299)
        assert np.sign(impedance(drive, law, slow).real) == sign


@pytest.mark.parametrize(("lags", "shares"), [
    ((0.020, 0.010, 0.003), (0.65, 0.60, 0.55, 0.35)),
    ((0.005, 0.002, 0.001), (0.70, 0.65, 0.60, 0.35)),
])
def test_how_much_inertia_can_be_compensated(lags, shares):
    """The largest stable share is the reference's: a = 0.25, steps of 0.05, J too large by 0, 4, 12.6 and 76 %."""
    drive = TopDrive(1500.0, 8.0, 60.0, lags)
    for error, most in zip((0.0, 0.04, 0.126, 0.76), shares, strict=True):
        laws = [tuned_controller(STRING, 1500.0 * (1.0 + error), 0.25, 0.1299, share) for share in (most, most + 0.05)]
        stable = [ClosedSystem(STRING, drive, law).is_stable() for law in laws]
        assert stable == [True, False], error


def test_stability_is_that_of_the_chain():
    """The count of poles in the right half-plane agrees with the eigenvalues of the chain."""
    for share in (0.3, 0.6, 0.75, 0.9):
        law = tuned_controller(STRING, 1500.0, 0.25, 0.1299, share)
        a, _, _ = lumped_chain([Pipe(3000.0, 0.127, 0.1086, lumps=100)], 374.0, 20.0, DRIVE, law)
        assert ClosedSystem(STRING, DRIVE, law).is_stable() == bool(np.linalg.eigvals(a).real.max() < 1e-7)


def test_gains_at_the_motor():
    law = HALF.at_shaft(10.0)
    assert (law.gain_nm_s_rad, law.integral_nm_rad, law.compensated_kg_m2) == pytest.approx((8.471, 3.526, 7.5))
    assert law.derivative_filter_s == HALF.derivative_filter_s
    assert isinstance(law, SpeedController)


def test_every_root_of_a_polynomial_is_found():
    """All roots are found, also two that are close together, and no others."""
    rng = np.random.default_rng(3)
    for _ in range(10):
        roots = list(rng.uniform(-1.0, 1.0, 6) + 1j * rng.uniform(-1.0, 1.0, 6))
        roots += [roots[0] + 0.01]
        inside = [root for root in roots if -0.7 < root.real < 0.8 and -0.6 < root.imag < 0.9]

        def f(s, roots=tuple(roots)):
            return np.prod([s - root for root in roots], axis=0)

        found = roots_in(f, -0.7 - 0.6j, 0.8 + 0.9j, 0.01)
        assert sorted(found, key=abs) == pytest.approx(sorted(inside, key=abs), abs=1e-9)


def test_two_roots_at_one_place_count_twice():
    found = roots_in(lambda s: (s - 0.3 - 0.2j) ** 2, -1.0 - 1.0j, 1.0 + 1.0j, 0.05)
    assert found == pytest.approx([0.3 + 0.2j] * 2, abs=1e-3)


def test_a_path_through_a_root_is_reported():
    with pytest.raises(RootsLost):
        count_in(lambda s: s, 0.0, 1.0 + 1.0j, 0.1)
