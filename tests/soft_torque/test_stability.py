"""Margins, reserves and the linear limit, compared with poles from other methods."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tdhil.soft_torque import (
    RPM,
    BottomEnd,
    ClosedSystem,
    DrillString,
    LoopMargins,
    PipeSection,
    RequiredMargins,
    RootsLost,
    SpeedController,
    StringFile,
    TopDrive,
    is_stable,
    linear_limit,
    loop_margins,
    string_of,
)
from tdhil.soft_torque.candidates import gains
from tdhil.soft_torque.controller import control_law, inner_lags
from tdhil.soft_torque.crossover import LEAST_GAIN, highest_crossover
from tdhil.soft_torque.roots import count_right_of
from tdhil.soft_torque.stability import NEAR, REFINEMENT, _crossings, _fraction, response_of
from tests.soft_torque.cases import (
    BIT,
    DRIVE,
    HALF,
    SOFT_035,
    STIFF,
    STRING,
    TABLE,
    Pipe,
    lumped_chain,
    string_with,
)


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


LIGHT = {
    # (drive, law, pipe, drag, inertia and viscous friction at the bottom): growth above the bare drive's crossover
    "little drag": (TopDrive(234.169, 11.708, 0.0, (0.0771141, 0.0833317, 0.002)), SpeedController(626.727, 303.189),
                    Pipe(668.194, 0.1492, 0.1297, drag=0.001), 542.474, 13.2202),
    "usual drag": (TopDrive(93.8233, 4.69117, 0.0, (0.0590696, 0.173421, 0.002)), SpeedController(591.872, 257.429),
                   Pipe(608.838, 0.1397, 0.1214, drag=0.005), 244.29, 16.9531),
}


@pytest.mark.parametrize("name", LIGHT)
def test_a_resonance_far_above_the_crossover_of_a_light_drive_is_not_missed(name):
    """The string cancels all of Jω near an antiresonance, so |L| exceeds 1 there. The chain is unstable."""
    drive, law, pipe, inertia, viscous = LIGHT[name]
    string = string_of(StringFile(
        sections=(PipeSection(length_m=pipe.length_m, outer_diameter_m=pipe.outer_m, inner_diameter_m=pipe.inner_m,
                              drag_nm_s_rad_m=pipe.drag),),
        bottom=BottomEnd(inertia_kg_m2=inertia, viscous_nm_s_rad=viscous)))
    growth = []
    for stuck in (False, True):
        states, _, _ = lumped_chain([replace(pipe, lumps=120)], inertia, viscous, drive, law, stuck=stuck)
        growth.append(float(np.linalg.eigvals(states).real.max()))
    assert max(growth) > 1e-4
    found = loop_margins(drive, law, string, exact=True)
    assert not found.stable and found.dead_time_s == 0.0
    assert is_stable(string, drive, law) is (growth[0] < 0.0)


@pytest.mark.parametrize("seed", [5, pytest.param(6, marks=pytest.mark.heavy)])
def test_above_the_highest_crossover_the_loop_is_small(seed):
    """On random strings and drives, |L| stays below the least gain at all frequencies above the bound."""
    random = np.random.default_rng(seed)
    for drive, law, string in (any_loop(random) for _ in range(20 if seed == 5 else 200)):
        top = highest_crossover(drive, law, string)      # 3,000 rad/s: the end of the search
        omega = np.geomspace(top, max(top, 3e3), 20_000)
        s = 1j * omega
        for stuck in (False, True):
            rotor = drive.inertia_kg_m2 * s + drive.viscous_nm_s_rad
            loop = inner_lags(drive, s) * control_law(law, s) / (rotor + string.impedance_at(s, stuck=stuck))
            assert np.abs(loop[1:]).max(initial=0.0) <= LEAST_GAIN or top > 2990.0, (drive, law, string)


def test_whether_a_loop_is_stable_needs_no_response_with_a_stuck_bit(monkeypatch):
    """The response of a stuck bit is computed once, and only if its margins are requested."""
    asked = []
    original = DrillString.at_top

    def counted(self, s, *, stuck=False):
        asked.append(stuck)
        return original(self, s, stuck=stuck)

    monkeypatch.setattr(DrillString, "at_top", counted)
    assert is_stable(STRING, DRIVE, HALF) and asked == [False]
    response = response_of(STRING, highest_crossover(DRIVE, HALF, STRING))
    assert loop_margins(DRIVE, HALF, STRING, response) == loop_margins(DRIVE, HALF, STRING, response)
    assert asked == [False, False, True]


# ---------------------------------------------------------------------------------------------------------------------
# The grid is refined only where a margin may be decided. The result is that of the whole grid, to the last digit.

COLLARS = string_of(StringFile(
    sections=(PipeSection(length_m=1800.0, outer_diameter_m=0.127, inner_diameter_m=0.1086, side_force_n_m=60.0),),
    bottom=BottomEnd(sections=(PipeSection(length_m=180.0, outer_diameter_m=0.203, inner_diameter_m=0.0714),), **BIT)))


def on_the_whole_grid(drive, law, string, *, exact=False):
    """Return the margins from every point of the grid, and with ``exact`` from every step near |L| = 1 divided."""
    omega = response_of(string, highest_crossover(drive, law, string)).omega_rad_s

    def fraction(omega, stuck):
        return _fraction(drive, law, omega, *string.at_top(1j * omega, stuck=stuck))

    found, stable = [], True
    for stuck in (False, True):
        over, under = fraction(omega, stuck)
        at, seen = omega, over / under
        above, below = (np.unwrap(np.angle(one)) for one in (over + under, under))
        turn = above[-1] - above[0] - (below[-1] - below[0])
        stable &= abs(np.angle(1.0 + seen[0]) + turn) < 0.5 * np.pi
        if exact:
            size = np.abs(np.log(np.abs(seen)))
            near = np.flatnonzero(np.minimum(size[:-1], size[1:]) < NEAR)
            parts = np.arange(1, REFINEMENT) / REFINEMENT
            between = omega[near, None] + (omega[near + 1] - omega[near])[:, None] * parts
            at = np.sort(np.concatenate([omega, between.ravel()]))
            over, under = fraction(at, stuck)
            seen = over / under
        found.append(_crossings(at, seen))
    least = [min(pair) for pair in zip(*found, strict=True)]
    return LoopMargins(True, *least) if stable else LoopMargins(False, 0.0, 0.0, 0.0, 0.0, least[4])


def any_string(random):
    """Return one to three sections of pipe, each of 30 to 4,000 m, with any drag, above collars or one inertia."""
    def section(length_m, outer_m, inner_m, drag):
        return PipeSection(length_m=length_m, outer_diameter_m=outer_m, inner_diameter_m=inner_m, drag_nm_s_rad_m=drag)

    sections = []
    for _ in range(random.integers(1, 4)):
        outer_m = random.uniform(0.09, 0.25)
        sections.append(section(np.exp(random.uniform(np.log(30.0), np.log(4000.0))), outer_m,
                                outer_m * random.uniform(0.2, 0.9), np.exp(random.uniform(np.log(1e-5), np.log(0.03)))))
    viscous = random.uniform(0.0, 50.0)
    if random.random() < 0.5:
        bottom = {"inertia_kg_m2": np.exp(random.uniform(0.0, np.log(1000.0)))}
    else:
        drag = np.exp(random.uniform(np.log(1e-4), np.log(0.01)))
        bottom = {"sections": (section(random.uniform(20.0, 300.0), 0.203, 0.0714, drag),)}
    return string_of(StringFile(sections=tuple(sections), bottom=BottomEnd(viscous_nm_s_rad=viscous, **bottom)))


def any_loop(random):
    """Return (drive, law, string), stable or not, with P from a third to a hundred times the string's impedance."""
    string, inertia = any_string(random), float(np.exp(random.uniform(np.log(50.0), np.log(5000.0))))
    lags = tuple(np.exp(random.uniform(np.log(0.001), np.log(0.1), random.integers(0, 4))).tolist())
    share = float(random.choice([0.0, 0.0, random.uniform(0.05, 0.8)]))
    omega = float(random.choice([0.0, 1.0, 1.0, 1.0])) * 2.0 * np.pi * 0.39 / string.echo_s * random.uniform(0.2, 2.0)
    gain = string.impedance_nm_s_rad / np.exp(random.uniform(np.log(0.01), np.log(3.0)))
    law = SpeedController(gain, omega**2 * inertia * (1.0 - share), share * inertia)
    return TopDrive(inertia, float(random.uniform(0.0, 20.0)), 0.0, lags), law, string


def check_grid(count, seed, *, exact=False):
    random = np.random.default_rng(seed)
    coarse = 0
    for loop in (any_loop(random) for _ in range(count)):
        assert loop_margins(*loop, exact=exact) == on_the_whole_grid(*loop, exact=exact), loop
        coarse += response_of(loop[2], highest_crossover(*loop)).coarsest > 1
    assert coarse >= count / 3


@pytest.mark.parametrize(("count", "exact"), [(16, False), pytest.param(60, False, marks=pytest.mark.heavy),
                                              pytest.param(3, True, marks=pytest.mark.heavy)])
def test_no_crossing_is_missed_between_the_points_of_the_coarse_grid(count, exact):
    """Lightly damped strings, sharp resonances, soft and stiff, stable and unstable: all margins are the same."""
    check_grid(count, 3, exact=exact)


@pytest.mark.long
@pytest.mark.parametrize(("count", "exact"), [(3000, False), (100, True)])
def test_no_crossing_is_missed_on_many_loops(count, exact):
    """The same on many loops."""
    check_grid(count, 4, exact=exact)


@pytest.mark.parametrize("law", [STIFF, SOFT_035])
def test_few_points_of_a_fine_grid_are_computed(law, monkeypatch):
    """Pipe above collars has a grid of 8,840 to 30,000 frequencies. The margins need less than a fifth of them."""
    computed = []
    original = DrillString.at_top

    def counted(self, s, *, stuck=False):
        computed.append(np.size(s))
        return original(self, s, stuck=stuck)

    monkeypatch.setattr(DrillString, "at_top", counted)
    response = response_of(COLLARS, highest_crossover(DRIVE, law, COLLARS))
    assert response.omega_rad_s.size > 8_000
    first = loop_margins(DRIVE, law, COLLARS, response)
    assert sum(computed) < 0.2 * 2 * response.omega_rad_s.size
    before = len(computed)
    assert loop_margins(DRIVE, law, COLLARS, response) == first and len(computed) == before


@pytest.mark.parametrize(("margins", "words"), [
    ((29.7, 9.0, 0.03), "phase margin 29.7° (limit 30°)"),
    ((29.996, 9.0, 0.03), "phase margin 29.996° (limit 30°)"),
    ((40.0, 5.97, 0.03), "gain margin 5.97 dB (limit 6 dB)"),
    ((40.0, 9.0, 0.0198), "dead-time reserve 19.8 ms (limit 20 ms)"),
    ((21.4, 9.0, 0.03), "phase margin 21° (limit 30°)"),
])
def test_a_failed_margin_is_not_printed_as_its_limit(margins, words):
    assert RequiredMargins().failed(LoopMargins(True, *margins, 1.0, 0.5)) == (words,)


def test_the_order_of_entry_keeps_the_smaller_phase_margin_with_inertia_compensation():
    """A J_c that becomes larger comes last. With J_c first, up to 29° are lost between the entries."""
    random, lost = np.random.default_rng(1), []
    while len(lost) < 20:
        inertia = float(np.exp(random.uniform(np.log(300), np.log(4000))))
        drive = TopDrive(inertia, 8.0, 60.0, DRIVE.inner_lags_s)

        def margin(law, drive=drive):
            found = loop_margins(drive, law, STRING)
            return found.phase_deg if found.stable else 0.0

        new = gains(STRING, inertia, 0.1299, float(np.exp(random.uniform(np.log(0.08), 0.0))),
                    float(random.uniform(0.5, 1.15)), float(random.uniform(0.1, 0.6)))
        old = gains(STRING, inertia, 0.1299, float(np.exp(random.uniform(np.log(0.02), 0.0))),
                    float(random.uniform(0.5, 1.15)))
        both = min(margin(new), margin(old))
        if both < 20.0:
            continue
        between = replace(old, integral_nm_rad=new.integral_nm_rad)
        if new.integral_nm_rad > old.integral_nm_rad:
            between = replace(old, gain_nm_s_rad=new.gain_nm_s_rad)
        last = min(margin(between), margin(replace(new, compensated_kg_m2=0.0)))
        first = min(margin(replace(one, compensated_kg_m2=new.compensated_kg_m2)) for one in (old, between))
        assert last >= both - 0.1
        lost.append(both - first)
    assert max(lost) > 8.0, "the order matters"
