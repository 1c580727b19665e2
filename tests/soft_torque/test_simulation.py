"""Simulation in time: echoes, reflection, modes and damping against theory and the chain of lumps; critical speeds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from tdhil.report import TunedFor, tuning_document
from tdhil.report.tuning import JUMPING_BIT_ERROR_SHARE, LIGHT_BIT_ERROR_SHARE, SIMULATION_ERROR_SHARE
from tdhil.soft_torque import (
    RPM,
    Advice,
    Begin,
    BitFriction,
    ClosedSystem,
    DrillString,
    Interval,
    Margins,
    Search,
    SpeedController,
    TopDrive,
    TuneCase,
    Tuned,
    Tuning,
    critical_speed,
    critical_speeds,
    grid_of,
    has_light_bit,
    linear_limit,
    lowest_turning,
    lowest_turning_with_noise,
    reflection_at,
    simulate,
)
from tdhil.soft_torque.critical_speed import coarse_tick_s
from tdhil.soft_torque.simulation import LoopSimulation, TopDisturbance, _LightBit, _Top
from tests.soft_torque.cases import (
    BIT,
    DRIVE,
    HALF,
    SOFT_025,
    SOFT_1,
    STIFF,
    STRING,
    TABLE,
    Pipe,
    lumped_chain,
    string_with,
)
from tests.soft_torque.chain_in_time import ends_turning as ends_turning_of_chain
from tests.soft_torque.chain_in_time import lowest_turning_of_chain, reference_case

J = Interval(1500.0, 1500.0, 1500.0)
SMOOTH = {"friction": "coulomb", "static_nm": None, "stribeck_speed_rad_s": None, "coulomb_nm": 0.0}
"""Bit without dry friction, so that the whole system is linear."""


def turning(string, law, *, drive=DRIVE, speed=10.0, change=0.5, seconds=40.0, keep=0.0, tick=0.006):
    """Return the simulation of a jump of the set speed by `change` from steady rotation."""
    start = np.array([[speed]])
    return simulate(string, [(drive, law)], Begin("turning", start), start + change, 1e9, seconds, keep, tick)


def test_echoes_return_after_the_round_trip_time():
    """After a jump of the set speed, the torque is that of a damper ζ until the echo. Its time is exact to 0.005 s."""
    string = string_with(**SMOOTH, viscous_nm_s_rad=0.0, drag=0.0)
    stiff = SpeedController(3e6, 3e6)
    quick = TopDrive(100.0, 0.0, 0.0, (1e-4,))
    trace = turning(string, stiff, drive=quick, seconds=6.0, tick=0.002)
    torque = trace.top_torque_nm[:, 0, 0]
    steady = 0.5 * string.impedance_nm_s_rad
    plateau = (trace.time_s > 0.2) & (trace.time_s < string.echo_s - 0.01)
    assert torque[plateau] == pytest.approx(np.full(plateau.sum(), steady), abs=0.005 * steady)
    for echo in (1, 2):      # a heavy bottom reverses the wave, and a stiff top reverses it again
        jump = np.abs(np.diff(torque))
        near = np.abs(trace.time_s[1:] - echo * string.echo_s) < 0.1
        assert trace.time_s[1:][near][np.argmax(jump[near])] == pytest.approx(echo * string.echo_s, abs=0.005)


@pytest.mark.heavy
@pytest.mark.parametrize("hertz", [0.1299, 0.567])
def test_the_reflection_of_the_top_agrees_with_theory(hertz):
    """A sine wave that arrives at the top is reflected with the amplitude of theory, to 0.005."""
    drive = TopDrive(1500.0, 8.0, 0.0, DRIVE.inner_lags_s)
    grid = grid_of(string_with(drag=0.0))
    top = _Top([(drive, law) for law in TABLE.values()], [grid] * len(TABLE), 1)
    time_s = grid.tick_s * (np.arange(round(24.0 / hertz / grid.tick_s)) + 0.5)
    sent = np.empty((time_s.size, len(TABLE)))
    still = np.zeros((len(TABLE), 1))
    for k, wave in enumerate(np.cos(2 * np.pi * hertz * time_s)):
        sent[k], _ = top.step(np.full(len(TABLE), wave), still)
    late = time_s > time_s[-1] - 8.0 / hertz
    basis = np.exp(-2j * np.pi * hertz * time_s[late])
    amplitudes = abs(2.0 * np.mean(sent[late] * basis[:, None], axis=0))
    expected = [reflection_at(drive, law, STRING, np.array([hertz]))[0] for law in TABLE.values()]
    assert amplitudes == pytest.approx(expected, abs=0.005)


def poles_of(samples, step_s, order):
    """Return the poles of a sum of decaying exponentials, by a matrix pencil."""
    half = len(samples) // 2
    data = np.lib.stride_tricks.sliding_window_view(samples, half)
    _, _, right = np.linalg.svd(data, full_matrices=False)
    right = right[:order].T
    values = np.linalg.eigvals(np.linalg.pinv(right[:-1]) @ right[1:])
    return np.log(values.astype(complex)) / step_s


@pytest.mark.long(but_first=3)
@pytest.mark.heavy
@pytest.mark.parametrize("name", TABLE)
def test_modes_in_time_are_the_poles(name):
    """Modes agree with the poles: frequency to 1 %, damping ratio to 0.005 (to 0.012 above a ratio of 0.4)."""
    string = string_with(**SMOOTH)
    drive = TopDrive(1500.0, 8.0, 0.0, DRIVE.inner_lags_s)
    trace = turning(string, TABLE[name], drive=drive, seconds=45.0, keep=0.1)
    late = trace.time_s > 5.0
    step_s = float(np.mean(np.diff(trace.time_s)))
    bit = trace.bit_rad_s[late, 0, 0] - 10.5
    found = poles_of(bit, step_s, 14)
    for mode in ClosedSystem(string, drive, TABLE[name]).modes(0.7):
        if mode.damping > 0.75:
            continue      # decayed before the window begins
        seen = found[np.argmin(abs(found - mode.pole_rad_s))]
        assert abs(seen) / (2 * np.pi) == pytest.approx(mode.frequency_hz, rel=0.01)
        assert -seen.real / abs(seen) == pytest.approx(mode.damping, abs=0.012 if mode.damping > 0.4 else 0.005)


@pytest.mark.long(but_first=2)
@pytest.mark.heavy
@pytest.mark.parametrize("law", [STIFF, SOFT_025, HALF], ids=["stiff", "soft", "half"])
def test_sections_in_time_against_the_chain(law):
    """A change of the set speed travels through pipe, heavy pipe and collars to the bit as in the chain."""
    from tdhil.soft_torque import BottomEnd, PipeSection, StringFile, string_of

    sections = tuple(PipeSection(length_m=length, outer_diameter_m=outer, inner_diameter_m=inner)
                     for length, outer, inner in ((2000.0, 0.127, 0.1086), (300.0, 0.127, 0.0762)))
    collars = PipeSection(length_m=180.0, outer_diameter_m=0.203, inner_diameter_m=0.0714)
    string = string_of(StringFile(sections=sections, bottom=BottomEnd(
        sections=(collars,), viscous_nm_s_rad=30.0, coulomb_nm=0.0)))
    drive = TopDrive(1500.0, 8.0, 0.0, DRIVE.inner_lags_s)
    start = np.zeros((1, 1))
    trace = simulate(string, [(drive, law)], Begin("rest", start), start + 1.0, 0.2, 30.0, 0.05)
    pipes = [Pipe(2000.0, 0.127, 0.1086, lumps=80), Pipe(300.0, 0.127, 0.0762, lumps=12),
             Pipe(180.0, 0.203, 0.0714, lumps=12)]
    a, b, n = lumped_chain(pipes, 0.0, 30.0, drive, law)
    step_s = 0.01
    whole = expm(np.block([[a, b[:, None]], [np.zeros((1, len(b) + 1))]]) * step_s)
    state, expected = np.zeros(len(b) + 1), []
    times = np.arange(1, 3001) * step_s
    for time_s in times:
        state[-1] = min(1.0, 0.2 * time_s)
        state = whole @ state
        expected.append(state[2 * n - 1])
    seen = np.interp(times, trace.time_s, trace.bit_rad_s[:, 0, 0])
    assert np.max(np.abs(seen - expected)) < 0.02


@pytest.mark.heavy
def test_a_bit_sticks_and_breaks_away_as_in_an_event_based_integration():
    """An inertia on a short, stiff line under a ramp breaks away at F_s and then follows the differential equation."""
    from scipy.integrate import solve_ivp

    bit = BitFriction(2500.0, 5000.0, 2.5)
    line = string_with(length_m=30.0, drag=0.0).lines[0]
    string = DrillString((line,), 374.0, 20.0, bit)
    firm = SpeedController(4e5, 4e6)
    drive = TopDrive(1500.0, 0.0, 0.0, (1e-3,))
    start = np.zeros((1, 1))
    trace = simulate(string, [(drive, firm)], Begin("rest", start), start + 3.0, 0.1, 12.0, 0.01, 0.002)
    stiffness = string.stiffness_nm_rad
    # The top follows the ramp with the angle 0.05 t². The bit sticks until k·angle = F_s.
    away_s = np.sqrt(5000.0 / stiffness / 0.05)

    def law(t, y):
        angle, speed = y
        friction = 2500.0 + 2500.0 * np.exp(-((speed / 2.5) ** 2))
        return [speed, (stiffness * (0.05 * t * t - angle) - 20.0 * speed - friction) / 374.0]

    solution = solve_ivp(law, (away_s, 12.0), [0.0, 1e-9], rtol=1e-8, max_step=0.01,
                         events=lambda t, y: y[1] if t > away_s + 0.1 else 1.0)
    moved = trace.time_s[np.argmax(trace.bit_rad_s[:, 0, 0] > 0.0)]
    assert moved == pytest.approx(away_s, abs=0.03)
    swing = solution.t < (solution.t_events[0][0] if solution.t_events[0].size else 12.0)
    highest = solution.y[1][swing].max()
    assert trace.bit_rad_s[trace.time_s < solution.t[swing][-1] + 0.1, 0, 0].max() == pytest.approx(highest, rel=0.03)


def above_collars(pipe_m, collars_m, outer_m, **bit):
    """Return 5 inch pipe above collars that end in a bit without inertia."""
    from tdhil.soft_torque import BottomEnd, PipeSection, StringFile, string_of

    pipe = PipeSection(length_m=pipe_m, outer_diameter_m=0.127, inner_diameter_m=0.1086)
    collars = PipeSection(length_m=collars_m, outer_diameter_m=outer_m, inner_diameter_m=0.0714)
    return string_of(StringFile(sections=(pipe,), bottom=BottomEnd(sections=(collars,), **{**BIT, **bit})))


@pytest.mark.heavy
def test_the_critical_speed_above_collars_is_that_of_the_chain_with_the_tick_of_tune():
    """Below 200 m of collars, the lowest speed from which on the bit turns agrees with the chain to 5 %."""
    string, law = above_collars(2800.0, 200.0, 0.2032), SpeedController(847.1, 1015.4)
    search = Search(lowest_rpm=64.0, highest_rpm=92.0, coarse_rpm=4.0, longest_tick_s=coarse_tick_s(string))
    (found,) = lowest_turning(string, [(DRIVE, law)], "stuck", search)
    chain = reference_case(
        length_m=2800.0, bottom_inertia=0.0, noise_nm=0.0, laws=[(law.gain_nm_s_rad, law.integral_nm_rad, 0.0, 0.05)],
        lumps=80, collars=(200.0, np.pi / 32.0 * (0.2032**4 - 0.0714**4), 12), period_s=search.duration_s / 12.0)
    speeds = np.arange(68.0, 93.0, 1.0)
    turns = ends_turning_of_chain(**chain, rpm=speeds[None], calm=12.0 * search.calm_s / search.duration_s)[0]
    assert found == pytest.approx(speeds[~turns].max() + 1.0, rel=0.05)


@pytest.mark.parametrize(("outer_m", "inertia_kg_m2", "light", "share"), [
    (0.2032, 0.0, True, LIGHT_BIT_ERROR_SHARE), (0.2032, 2.0, True, LIGHT_BIT_ERROR_SHARE),
    (0.2032, 40.0, False, SIMULATION_ERROR_SHARE), (0.127, 0.0, True, JUMPING_BIT_ERROR_SHARE),
])
def test_grid_and_report_have_one_rule_for_a_light_bit(outer_m, inertia_kg_m2, light, share):
    """Below 8 inch collars (ζ 4,112 N·m·s/rad), half a tick of 6 ms is 12.3 kg·m². Above 5 inch ones, the bit jumps."""
    string = above_collars(2800.0, 200.0, outer_m, inertia_kg_m2=inertia_kg_m2)
    assert has_light_bit(string, 0.006) is light
    assert (grid_of(string, 0.006).bottom_inertia_kg_m2 == 0.0) is light
    stiff = Tuned("stiff", STIFF, reflection=J, band_reflection=J, damping=J, margins=Margins(60.0, 10.0, 0.5),
                  quiet_cures=(75.0,) * 5)
    case = TuneCase(string, DRIVE, J)
    tuning = Tuning(case, (0.13,), (stiff,), Search(), Advice(None, "stiff", keep=False))
    document = tuning_document(tuning, TunedFor("x", True, None, 1.0, "drive", "stated"))
    (one,) = document["controllers"]
    jumps = [words for words in document["warnings"] if "jumps from speed to speed" in words]
    assert len(jumps) == (outer_m == 0.127) and all("18 % too low" in words for words in jumps)
    assert one["critical_rpm"]["cure"]["high"] == pytest.approx(75.0 + 0.5 + share * 75.0)


LIGHT = TopDrive(104.2, 8.0, 60.0, DRIVE.inner_lags_s)
SLOW = SpeedController(372.8, 15.63, 10.42)
"""Its integral time is 24 s, three periods of the string."""


def test_a_bit_that_sticks_again_after_a_minute_does_not_turn():
    """A slow stick-slip cycle is simulated to its end: the cure speed is the linear stability limit."""
    search = Search(lowest_rpm=0.0, highest_rpm=48.0)
    (found,) = lowest_turning(STRING, [(LIGHT, SLOW)], "stuck", search)
    assert found == pytest.approx(linear_limit(STRING, LIGHT, SLOW) / RPM, abs=1.5)


@pytest.mark.heavy
def test_slow_stick_slip_against_the_chain():
    """With and without noise, the cure speed of a loop with a long integral time agrees with the chain of masses."""
    for noise_nm in (0.0, 200.0):
        string = replace(STRING, bit=replace(STRING.bit, noise_nm=noise_nm))
        (found,) = lowest_turning_with_noise([string], [(LIGHT, SLOW)], [1], "stuck", 7.7)
        (expected,) = lowest_turning_of_chain(
            laws=[(SLOW.gain_nm_s_rad, SLOW.integral_nm_rad, SLOW.compensated_kg_m2, 0.05)],
            **{key: value for key, value in reference_case(noise_nm=noise_nm, inertia=104.2).items() if key != "laws"})
        assert found == pytest.approx(expected, rel=0.1)


def test_loops_with_different_starts_and_ends_are_simulated_together_as_each_alone(monkeypatch):
    """A stuck bit, a ramp from rest, a short and a long integral time: one simulation, each loop to its own end."""
    string = replace(STRING, bit=replace(STRING.bit, noise_nm=500.0))
    search = Search(duration_s=6.0, calm_s=1.0, start_ramp_rpm_s=20.0, longest_tick_s=0.03)
    loops, seeds = [(DRIVE, STIFF), (LIGHT, SLOW), (DRIVE, SOFT_1), (LIGHT, SLOW), (DRIVE, HALF)], [1, 2, 1, 3, 4]
    starts, speeds = ["stuck", "rest", "rest", "stuck", "rest"], np.tile([20.0, 35.0, 60.0, 90.0], (5, 1))
    begun = []

    class Counted(LoopSimulation):
        def __init__(self, *given, **named):
            super().__init__(*given, **named)
            begun.append(self)

    monkeypatch.setattr(critical_speed, "LoopSimulation", Counted)
    together = critical_speed.ends_turning([string] * 5, loops, starts, speeds, search, seeds)
    (simulation,) = begun
    alone = [critical_speed.ends_turning([string], [loops[k]], starts[k], speeds[[k]], search, [seeds[k]])[0]
             for k in range(5)]
    assert together.tolist() == np.array(alone).tolist()
    assert together.any() and not together.all()
    ticks = [one.ticks for one in begun[1:]]
    assert simulation.ticks == max(ticks) and len(set(ticks)) == 4


def rubbing(string, lines):
    """Return the string with dry friction on its first lines, as many as ``lines``."""
    dry = [replace(line, coulomb_nm_m=0.4, static_nm_m=0.6) for line in string.lines[:lines]]
    return replace(string, lines=(*dry, *string.lines[lines:]))


@pytest.mark.parametrize(("outer_m", "lines", "at_once"), [(None, 0, False), (None, 1, False), (0.203, 0, True),
                                                           (0.203, 1, True), (0.203, 2, False), (0.127, 0, False)])
def test_ticks_that_are_simulated_together_equal_single_ones(outer_m, lines, at_once, monkeypatch):
    """Heavy and light bits, wall friction, a bit that jumps: all results are equal to the last digit.

    The balance of a light bit is solved for all ticks at once, unless it depends on the tick before.

    """
    string = rubbing(STRING if outer_m is None else above_collars(1500.0, 180.0, outer_m), lines)
    loops, speeds = [(DRIVE, SOFT_025), (DRIVE, STIFF)], np.array([[20.0, 60.0, 110.0], [30.0, 90.0, 150.0]]) * RPM
    single = []
    step = _LightBit.step
    monkeypatch.setattr(_LightBit, "step", lambda self, *a: single.append(1) or step(self, *a))

    def simulation():
        return LoopSimulation(string, loops, Begin(["stuck", "rest"], speeds), speeds, 2.0, 0.012, disturbance=[1, 2])

    together, each = simulation(), simulation()
    found: list = []
    while together.ticks < 2001:
        found += list(together.advance_together(2001 - together.ticks))
    assert together.ticks == len(found) == 2001 and (not single) == (at_once or outer_m is None)
    bits = []
    for _ in range(2001):
        each.advance()
        bits.append(each.bit_rad_s)
    assert np.array_equal(found, bits) and np.array_equal(together.top.torque_nm, each.top.torque_nm)
    assert 0.02 < np.mean(np.array(bits) == 0.0) < 0.98


def test_gains_whose_stick_slip_may_be_too_slow_are_reported():
    """Beyond eight periods of the string, as with gains without integral action, the critical speeds may be too low."""
    shown = {}
    for integral in (1600.0 / 60.0, 1600.0 / 63.0, 0.0):
        present = Tuned("present", SpeedController(1600.0, integral), reflection=J, band_reflection=J, damping=J,
                        margins=Margins(60.0, 10.0, 0.5), quiet_cures=(75.0,) * 5)
        tuning = Tuning(TuneCase(STRING, DRIVE, J), (0.13,), (present,), Search(), Advice(None, "present", keep=True))
        document = tuning_document(tuning, TunedFor("x", True, None, 1.0, "drive", "stated"))
        shown[integral] = [words for words in document["warnings"] if "longer than 62 s" in words]
    assert [len(words) for words in shown.values()] == [0, 1, 1]


@pytest.mark.parametrize(("outer_m", "jumps"), [(0.2032, False), (0.127, True)])
def test_a_bit_without_inertia_is_in_balance_and_jumps_only_where_its_branch_ends(outer_m, jumps):
    """Torque rises and falls slowly: friction and damping balance it. On falling friction, the bit shows hysteresis."""
    string = above_collars(2000.0, 200.0, outer_m)
    grid = grid_of(string, 0.03)
    bit = _LightBit([string], [grid], 1)
    damping = grid.impedance_nm_s_rad[-1] + 0.5 * grid.drag_nm_s_rad[-1] + 20.0
    torques = np.linspace(0.0, 8000.0, 1601)
    speed, seen = np.zeros(1), []
    for torque in (*torques, *torques[::-1]):
        _, speed = bit.step(np.array([torque]), speed)
        seen.append(speed[0])
    up, down = np.array(seen[:1601]), np.array(seen[1601:])[::-1]
    for found in (up, down):
        moves = found > 0.0
        balance = damping * found + 2500.0 + 2500.0 * np.exp(-((found / 2.5) ** 2))
        assert balance[moves] == pytest.approx(torques[moves], abs=1.0)
        assert not moves[torques < 4800.0].any() and moves[torques > 5000.0].all()
    assert (np.max(np.abs(up - down)) > 2.0) == jumps
    assert (np.max(np.diff(up)) > 2.0) == jumps


@pytest.mark.heavy
def test_a_bit_below_collars_sticks_and_slips_alike_in_finer_steps():
    """With collars as lines, the bit has no inertia. Half of this tick gives the same motion."""
    string = above_collars(1500.0, 180.0, 0.203)
    target = np.array([[60.0 * RPM]])
    coarse, fine = (simulate(string, [(DRIVE, STIFF)], Begin("stuck", target), target, 1.0, 12.0, 0.05, tick)
                    for tick in (0.006, 0.003))
    assert coarse.last_stuck_s[0, 0] == pytest.approx(fine.last_stuck_s[0, 0], abs=0.1)
    slow = [np.convolve(trace.bit_rad_s[:, 0, 0], np.ones(10) / 10.0, "same") for trace in (coarse, fine)]
    seen = np.interp(fine.time_s, coarse.time_s, slow[0])
    assert np.max(np.abs(seen - slow[1])) < 0.08 * slow[1].max()


@pytest.mark.heavy
def test_cure_speeds_of_the_reference_case():
    """For four reference controllers, the bit sticks 3 rpm below the reference cure speed and turns 2 rpm above it."""
    cures = np.array([[183.0], [72.0], [57.0], [40.0]])
    target = (cures + np.array([[-3.0, 2.0]])) * RPM
    loops = [(DRIVE, law) for law in (STIFF, SOFT_1, SOFT_025, HALF)]
    trace = simulate(STRING, loops, Begin("stuck", target), target, 1.0, 80.0, 20.0)
    assert (trace.last_stuck_s > 60.0).tolist() == [[True, False]] * 4


@pytest.mark.heavy
def test_a_critical_speed_is_found_to_its_resolution():
    """The search for one controller, over a narrow range of speeds, finds the cure speed to its resolution."""
    search = Search(lowest_rpm=48.0, highest_rpm=64.0, coarse_rpm=8.0, resolution_rpm=2.0, duration_s=50.0, calm_s=15.0)
    (cure,) = lowest_turning(STRING, [(DRIVE, SOFT_025)], "stuck", search)
    assert cure == pytest.approx(57.0, abs=2.0)


def test_without_a_bit_there_are_no_critical_speeds():
    with pytest.raises(ValueError, match="no bit"):
        critical_speeds(DrillString(STRING.lines, 374.0), [(DRIVE, SOFT_1)])


@pytest.mark.heavy
def test_a_stuck_bit_that_is_not_freed_stays_stuck():
    """If the bit does not break away at any tested speed, the critical speed is None."""
    string = string_with(static_nm=1e6, coulomb_nm=1e6)
    search = Search(lowest_rpm=10.0, highest_rpm=20.0, duration_s=20.0, calm_s=5.0, start_ramp_rpm_s=50.0)
    assert lowest_turning(string, [(DRIVE, SOFT_025)], "rest", search) == [None]


def test_steady_rotation_stays_steady():
    """A start in equilibrium, with drag, drive friction and bit, gives no oscillation."""
    start = np.array([[120.0 * RPM]])
    trace = simulate(STRING, [(DRIVE, SOFT_025)], Begin("turning", start), start, 1.0, 20.0, 0.5)
    assert np.ptp(trace.bit_rad_s) < 1e-6 * 120.0 * RPM
    assert (trace.last_stuck_s < 0.0).all()


@pytest.mark.heavy
def test_dry_friction_along_the_string_against_the_chain():
    """Cure speeds in a deviated well with 1,500 N·m of dry wall friction agree with the chain of masses to 5 %."""
    line = replace(STRING.lines[0], coulomb_nm_m=0.5, static_nm_m=0.5)
    string = replace(STRING, lines=(line,), bit=replace(STRING.bit, noise_nm=0.0))
    laws = (SOFT_025, HALF)
    found = lowest_turning_with_noise([string] * 2, [(DRIVE, law) for law in laws], [1, 1], "stuck", 7.7)
    expected = lowest_turning_of_chain(
        length_m=3000.0, polar_m4=np.pi / 32.0 * (0.127**4 - 0.1086**4), shear_pa=79.3e9, density=7850.0, drag=0.005,
        bottom_inertia=374.0, bottom_viscous=20.0, coulomb_nm=2500.0, static_nm=5000.0, stribeck_rad_s=2.5,
        noise_nm=0.0, noise_correlation_s=0.2, inertia=1500.0, viscous=8.0, dry_nm=60.0, lags_s=DRIVE.inner_lags_s,
        laws=[(law.gain_nm_s_rad, law.integral_nm_rad, law.compensated_kg_m2, 0.05) for law in laws], seed=1,
        period_s=7.7, wall_nm=1500.0)
    assert found == pytest.approx(expected, rel=0.05)


def test_a_string_on_the_wall_keeps_its_twist():
    """The side force in the file gives dry friction per metre. Steady rotation needs its torque at the top."""
    from tdhil.soft_torque import BottomEnd, PipeSection, StringFile, string_of

    section = PipeSection(length_m=2000.0, outer_diameter_m=0.127, inner_diameter_m=0.1086, side_force_n_m=100.0)
    string = string_of(StringFile(sections=(section,), bottom=BottomEnd(**{"inertia_kg_m2": 374.0, **BIT})))
    assert string.lines[0].coulomb_nm_m == pytest.approx(0.2 * 100.0 * 0.0635)
    assert string.lines[0].static_nm_m == pytest.approx(0.3 * 100.0 * 0.0635)
    start = np.array([[120.0 * RPM]])
    trace = simulate(string, [(DRIVE, SOFT_025)], Begin("turning", start), start, 1.0, 20.0, 0.5)
    assert np.ptp(trace.bit_rad_s) < 1e-6 * 120.0 * RPM
    friction_nm = 2000.0 * string.lines[0].coulomb_nm_m
    free = simulate(STRING, [(DRIVE, SOFT_025)], Begin("turning", start), start, 1.0, 1.0, 0.5)
    drag_nm = 5.0 * 120.0 * RPM      # drag of 1,000 m: this string is shorter than the reference case by this length
    assert trace.top_torque_nm[0, 0, 0] - free.top_torque_nm[0, 0, 0] == pytest.approx(friction_nm - drag_nm, rel=0.01)


def test_a_torque_on_the_rotor_is_balanced_by_the_drive():
    """The drive's torque at the final standstill has changed by the disturbance. A record repeats after its end."""
    start = np.array([[10.0]])
    quiet, pushed = (
        simulate(string_with(**SMOOTH), [(DRIVE, SOFT_025)], Begin("turning", start), start, 1.0, 40.0,
                 disturbance=TopDisturbance(np.full((1, 1), push), 0.5)) for push in (0.0, 300.0))
    change = quiet.top_torque_nm[:, 0, 0] - pushed.top_torque_nm[:, 0, 0]
    assert change[-1] == pytest.approx(300.0, abs=3.0)
    assert pushed.top_rad_s[-1, 0, 0] == pytest.approx(10.0, abs=0.01)
    record = TopDisturbance(np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]), 0.5)
    assert [record.at(time_s).ravel().tolist() for time_s in (0.0, 0.6, 1.6)] == [[1.0, 4.0], [2.0, 5.0], [1.0, 4.0]]
