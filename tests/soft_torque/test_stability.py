"""Margins, reserves and the linear limit, compared with poles from other methods."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tdhil.soft_torque import (
    RPM,
    ClosedSystem,
    DrillString,
    RootsLost,
    SpeedController,
    TopDrive,
    is_stable,
    linear_limit,
    loop_margins,
)
from tdhil.soft_torque.roots import count_right_of
from tdhil.soft_torque.stability import highest_crossover, response_of
from tests.soft_torque.cases import DRIVE, HALF, STIFF, STRING, TABLE, Pipe, lumped_chain, string_with


def unstable_with(string, drive, law, dead_time_s, *, stuck=False):
    """Return whether the loop with this dead time has a pole in the right half-plane, by a count along a path."""
    def characteristic(s):
        s = np.asarray(s, dtype=complex)
        speed, torque = string.at_top(s, stuck=stuck)
        lags = np.ones_like(s)
        for lag in drive.inner_lags_s:
            lags = lags * (1.0 + lag * s)
        filtered = 1.0 + law.derivative_filter_s * s
        control = (law.gain_nm_s_rad * s + law.integral_nm_rad) * filtered - law.compensated_kg_m2 * s * s
        rotor = (drive.inertia_kg_m2 * s + drive.viscous_nm_s_rad) * speed + torque
        whole = lags * filtered * s * rotor + control * np.exp(-s * dead_time_s) * speed
        return whole / s if stuck else whole      # a stuck bit gives the speed at the top a factor s

    reach = ClosedSystem(string, drive, law).reach_rad_s()
    pace = min(2.0 * np.pi / (50.0 * string.echo_s), 0.3 / max(dead_time_s, 1e-3))
    try:
        return count_right_of(characteristic, reach, pace, 40.0) > 0
    except RootsLost:
        return True


def random_cases(count, seed):
    """Generate (string, drive, law, margins) of stable loops: strings of 700 to 5,500 m, many kinds of gains."""
    random = np.random.default_rng(seed)
    while count:
        string = string_with(length_m=float(random.uniform(700, 5500)), drag=float(random.uniform(0.002, 0.01)),
                             inertia_kg_m2=float(random.uniform(100, 600)))
        inertia = float(random.uniform(300, 4000))
        lags = tuple(random.uniform(0.002, 0.04, 3).tolist())
        drive = TopDrive(inertia, 8.0, 60.0, lags)
        share = float(random.choice([0.0, 0.0, random.uniform(0.05, 0.45)]))
        omega = 2.0 * np.pi * 0.39 / string.echo_s * random.uniform(0.4, 1.3)
        gain = string.impedance_nm_s_rad / np.exp(random.uniform(np.log(0.05), np.log(1.2)))
        law = SpeedController(gain, omega**2 * inertia * (1.0 - share), share * inertia)
        found = loop_margins(drive, law, string, exact=True)
        if found.stable and found.dead_time_s < 3.0 and ClosedSystem(string, drive, law).is_stable():
            count -= 1
            yield string, drive, law, found


def scanned_reserve_s(string, drive, law, near_s, fine_s, coarse_s=0.005):
    """Return the smallest dead time on a scan from zero that is unstable with a turning or a stuck bit; None: none.

    Steps of 1 ms from ``fine_s`` below ``near_s`` to 2 ms above it, and of ``coarse_s`` below that. No step is at
    ``near_s`` itself, where a pole on the axis cannot be counted.
    """
    first = max(0.0, near_s - fine_s - 0.0005)
    for dead_time_s in (*np.arange(0.0, first, coarse_s), *np.arange(first, near_s + 0.0021, 0.001)):
        if any(unstable_with(string, drive, law, float(dead_time_s), stuck=stuck) for stuck in (False, True)):
            return float(dead_time_s)
    return None


def check_reserves(cases, fine_s, coarse_s=0.005):
    for string, drive, law, found in cases:
        scanned_s = scanned_reserve_s(string, drive, law, found.dead_time_s, fine_s, coarse_s)
        assert scanned_s == pytest.approx(found.dead_time_s, abs=0.001), law


@pytest.mark.heavy
def test_the_dead_time_reserve_is_the_smallest_that_destabilises():
    """The reserve of random loops, with a turning and with a stuck bit, is that of a scan of the dead time to 1 ms."""
    check_reserves(random_cases(50, 1), 0.010, 0.02)


@pytest.mark.long
def test_the_dead_time_reserve_on_many_controllers():
    """The same on 500 random loops, with 1 ms from 0.1 s below the reserve and 5 ms elsewhere."""
    check_reserves(random_cases(500, 2), 0.1)


@pytest.mark.parametrize(("law", "reserve_s"), [(HALF, 0.084), (STIFF, 0.0755)])
def test_the_reserve_of_the_reference_card(law, reserve_s):
    """The dead-time reserves are those of an independent bisection: 84 ms (half of J compensated), 75.5 ms (stiff)."""
    found = loop_margins(DRIVE, law, STRING)
    assert found.dead_time_s == pytest.approx(reserve_s, abs=0.005)
    # One more lag may be stable again if it is larger, so a bisection may miss the first limit.
    lags = (*DRIVE.inner_lags_s, found.lag_s)
    for factor, stable in ((0.98, True), (1.02, False)):
        drive = replace(DRIVE, inner_lags_s=(*lags[:-1], factor * found.lag_s))
        states, _, _ = lumped_chain([Pipe(3000.0, 0.127, 0.1086)], 374.0, 20.0, drive, law, stuck=False)
        free = bool(np.linalg.eigvals(states).real.max() < 1e-9)
        states, _, _ = lumped_chain([Pipe(3000.0, 0.127, 0.1086)], 374.0, 20.0, drive, law, stuck=True)
        assert (free and bool(np.linalg.eigvals(states).real.max() < 1e-9)) is stable


def test_the_gain_margin_of_half_the_inertia_compensated():
    """The gain margin is 2.3 dB, a factor of 1.305. The chain is stable at 1.27 and unstable at 1.34."""
    found = loop_margins(DRIVE, HALF, STRING)
    assert found.gain_db == pytest.approx(20.0 * np.log10(1.305), abs=0.1)

    def unstable(factor):
        law = SpeedController(*(factor * one for one in (847.1, 352.6, 750.0)))
        states, _, _ = lumped_chain([Pipe(3000.0, 0.127, 0.1086, lumps=100)], 374.0, 20.0, DRIVE, law)
        return bool(np.linalg.eigvals(states).real.max() > 1e-6)

    assert [unstable(1.27), unstable(1.34)] == [False, True]


@pytest.mark.parametrize("name", TABLE)
def test_the_linear_limit_is_where_the_chain_becomes_unstable(name):
    """With the slope of the bit's friction, the chain is unstable 2 % below the linear limit and stable 2 % above."""
    law = TABLE[name]
    limit = linear_limit(STRING, DRIVE, law)
    assert 38.0 * RPM < limit < 55.0 * RPM

    def unstable(speed):
        slope = 2.0 * 2500.0 * speed / 2.5**2 * np.exp(-((speed / 2.5) ** 2))
        states, _, _ = lumped_chain([Pipe(3000.0, 0.127, 0.1086)], 374.0, 20.0 - slope, DRIVE, law)
        return bool(np.linalg.eigvals(states).real.max() > 1e-7)

    assert [unstable(0.98 * limit), unstable(1.02 * limit)] == [True, False]


def test_unstable_loops_have_no_margin():
    law = SpeedController(847.1, 352.6, 1350.0)
    assert not ClosedSystem(STRING, DRIVE, law).is_stable()
    found = loop_margins(DRIVE, law, STRING)
    assert not found.stable
    assert (found.phase_deg, found.gain_db, found.dead_time_s) == (0.0, 0.0, 0.0)


def test_whether_a_loop_is_stable_needs_no_response_with_a_stuck_bit(monkeypatch):
    """The response of a stuck bit is computed once, and only if its margins are asked for."""
    asked = []
    original = DrillString.impedance_at

    def counted(self, s, *, stuck=False):
        asked.append(stuck)
        return original(self, s, stuck=stuck)

    monkeypatch.setattr(DrillString, "impedance_at", counted)
    assert is_stable(STRING, DRIVE, HALF) and asked == [False]
    response = response_of(STRING, highest_crossover(DRIVE, HALF))
    assert loop_margins(DRIVE, HALF, STRING, response) == loop_margins(DRIVE, HALF, STRING, response)
    assert asked == [False, False, True]
