"""Distributed string, compared with the impedance of the wave equation, derived independently here."""

import cmath
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_bus.inverter import Inverter
from sim_bus.params import FAITHFUL, QUIET, DriveParams, RigParams
from sim_bus.plant.drill_string import DrillString, StringParams, StringState
from sim_bus.plant.two_mass import Bottom

DT = 0.002
ENDS = ("mass", "free", "clamped")
SMOOTH = StringParams(inertia_kg_m2=20.0, coulomb_nm=0.0, viscous_nm_s_rad=100.0, drag_nm_s_rad_m=0.05,
                      bottom=Bottom(coulomb_nm=0.0, viscous_nm_s_rad=40.0))
"""String with a light motor, so that its impedance of about 300 N·m·s/rad dominates."""


def impedance(params: StringParams, hz: float) -> complex:
    """Return torque over speed at the motor, from ω'' = γ² ω with γ² = s (ρI s + d)/(G I)."""
    s = 2j * math.pi * hz
    area_moment = math.pi / 32.0 * (params.outer_diameter_m**4 - params.inner_diameter_m**4)
    inertia, compliance = params.density_kg_m3 * area_moment, 1.0 / (params.shear_modulus_pa * area_moment)
    line = cmath.sqrt((inertia * s + params.drag_nm_s_rad_m) / (s * compliance))
    turn = cmath.tanh(cmath.sqrt((inertia * s + params.drag_nm_s_rad_m) * s * compliance) * params.length_m)
    if params.bottom_end == "mass":
        load = params.bottom.inertia_kg_m2 * s + params.bottom.viscous_nm_s_rad
        string = line * (load + line * turn) / (line + load * turn)
    else:
        string = line * turn if params.bottom_end == "free" else line / turn
    return params.inertia_kg_m2 * s + params.viscous_nm_s_rad + string


def moved(string: DrillString, torques: list[float], dt_s: float = DT) -> tuple[list[StringState], np.ndarray]:
    """Return the state after each step, and the mean speed in each."""
    state, states = string.rest(), []
    for torque in torques:
        state = string.step(state, torque, dt_s)
        states.append(state)
    return states, np.diff([0.0] + [state.angle_rad for state in states]) / dt_s


@pytest.mark.heavy
@pytest.mark.parametrize("end", ENDS)
@pytest.mark.parametrize("hz", [
    0.2, 1.1, 5.0, *(pytest.param(hz, marks=pytest.mark.long) for hz in (0.05, 0.45, 0.7, 2.0)),
])
def test_a_sine_agrees_with_the_analytic_impedance(end: str, hz: float) -> None:
    params = SMOOTH.model_copy(update={"bottom_end": end})
    count = round(1.0 / hz / DT)
    hz = 1.0 / (count * DT)
    periods = math.ceil(40.0 * hz) + 1
    torques = [100.0 * math.sin(2.0 * math.pi * hz * (n + 0.5) * DT) for n in range(count)]
    _, speeds = moved(DrillString(params), torques * periods)
    turn = np.exp(-2j * np.pi * np.arange(count) / count)
    found = np.dot(torques, turn) / np.dot(speeds[-count:], turn)
    assert abs(found / impedance(params, hz) - 1.0) < 1e-3


@pytest.mark.heavy
@pytest.mark.parametrize("end", ENDS)
def test_the_response_to_an_impulse_agrees_too(end: str) -> None:
    """One step of torque contains every frequency: the transform of the response is 1/impedance."""
    params = SMOOTH.model_copy(update={"bottom_end": end})
    _, speeds = moved(DrillString(params), [1000.0] + [0.0] * 30_000)
    assert abs(speeds[-1]) < 1e-6 * max(speeds)
    times = (np.arange(len(speeds)) + 0.5) * DT
    for hz in (0.03, 0.1, 0.31, 0.62, 1.7, 4.0):
        response = np.sum(speeds * np.exp(-2j * math.pi * hz * times))
        torque = 1000.0 * np.sinc(hz * DT) * cmath.exp(-1j * math.pi * hz * DT)
        assert abs(torque / response / impedance(params, hz) - 1.0) < 1e-3, hz


def test_at_low_frequency_it_is_the_sum_of_all_inertias() -> None:
    params = SMOOTH.model_copy(update={"drag_nm_s_rad_m": 0.0, "bottom": Bottom(coulomb_nm=0.0, viscous_nm_s_rad=0.0)})
    pipe = params.density_kg_m3 * params.polar_moment_m4 * params.length_m
    assert pipe == pytest.approx(params.impedance_nm_s_rad * params.delay_s)
    _, speeds = moved(DrillString(params), [20.0] * 5_000)
    assert speeds[-1] == pytest.approx(20.0 / 100.0 * (1.0 - math.exp(-100.0 * 10.0 / (20.0 + 374.0 + pipe))), rel=0.02)


@pytest.mark.parametrize("length_m", [7.0, 100.0, 2300.0, 2301.7])
@pytest.mark.parametrize("dt_s", [0.002, 0.0013, 0.01])
def test_the_echo_comes_after_exactly_twice_the_delay(length_m: float, dt_s: float) -> None:
    params = StringParams(length_m=length_m, bottom_end="clamped", coulomb_nm=0.0, viscous_nm_s_rad=0.0,
                          drag_nm_s_rad_m=0.0)
    endless = params.model_copy(update={"length_m": 60_000.0})
    string, echo_s = DrillString(params), 2.0 * params.delay_s
    assert string.cells * string.tick_s == pytest.approx(params.delay_s, rel=1e-12)
    count = math.ceil(1.5 * echo_s / dt_s) + 1
    unechoed = DrillString(endless)
    state, other = string.rest(), unechoed.rest()
    for n in range(1, count):
        state, other = string.step(state, 500.0, dt_s), unechoed.step(other, 500.0, dt_s)
        same = abs(state.speed_rad_s - other.speed_rad_s) <= 1e-9 * abs(other.speed_rad_s)
        if n * dt_s < echo_s - 1e-9:
            assert same
        if n * dt_s > echo_s + 2.0 * dt_s + 2.0 * string.tick_s:
            assert not same


def energy(string: DrillString, state: StringState) -> float:
    """Return the energy of both ends and of the waves, exact at the end of a tick."""
    bottom = string.params.bottom.inertia_kg_m2 if string.params.bottom_end == "mass" else 0.0
    waves = float(np.sum(state.down_nm**2 + state.up_nm**2)) * string.tick_s / (4.0 * string.impedance_nm_s_rad)
    return (0.5 * string.params.inertia_kg_m2 * state.speed_rad_s**2
            + 0.5 * bottom * state.bottom_speed_rad_s**2 + waves)


@pytest.mark.heavy
@settings(max_examples=25, deadline=None)
@given(end=st.sampled_from(ENDS), friction=st.sampled_from(["coulomb", "stribeck"]), drag=st.sampled_from([0.0, 0.02]),
       torque=st.floats(-3000, 3000), viscous=st.floats(0, 50))
def test_energy_never_grows_without_work(end: str, friction: str, drag: float, torque: float, viscous: float) -> None:
    params = StringParams(bottom_end=end, friction=friction, drag_nm_s_rad_m=drag,       # type: ignore[arg-type]
                          viscous_nm_s_rad=viscous, bottom=Bottom(friction=friction))    # type: ignore[arg-type]
    string = DrillString(params)
    state, work = string.rest(), 0.0
    for _ in range(800):
        before = state.angle_rad
        state = string.step(state, torque, string.tick_s)
        work += torque * (state.angle_rad - before)
        assert energy(string, state) <= work * (1.0 + 1e-6) + 1e-9
    most = energy(string, state)
    for _ in range(800):
        state = string.step(state, 0.0, string.tick_s)
        assert energy(string, state) <= most * (1.0 + 1e-6)
        most = energy(string, state)


def test_without_friction_none_is_lost() -> None:
    params = StringParams(coulomb_nm=0.0, viscous_nm_s_rad=0.0, drag_nm_s_rad_m=0.0,
                          bottom=Bottom(coulomb_nm=0.0, viscous_nm_s_rad=0.0))
    string = DrillString(params)
    state = string.rest()
    for _ in range(500):
        state = string.step(state, 2000.0, string.tick_s)
    begin = energy(string, state)
    for _ in range(20_000):
        state = string.step(state, 0.0, string.tick_s)
    assert energy(string, state) == pytest.approx(begin, rel=1e-5)


@pytest.mark.heavy
def test_a_clamped_string_holds_the_torque_by_its_twist() -> None:
    params = StringParams(bottom_end="clamped", coulomb_nm=0.0, viscous_nm_s_rad=400.0)
    string = DrillString(params)
    states, _ = moved(string, [400.0] * 90_000)
    stiffness = params.shear_modulus_pa * params.polar_moment_m4 / params.length_m
    assert states[-1].angle_rad * stiffness == pytest.approx(400.0, rel=1e-6)
    assert string.top_torque_nm(states[-1]) == pytest.approx(400.0, rel=2e-4)       # the last waves still travel
    assert states[-1].bottom_angle_rad == 0.0


def test_steps_of_any_length_give_the_same() -> None:
    string = DrillString(SMOOTH)
    whole = moved(string, [300.0] * 1000, 0.01)[0][-1]
    for dt_s in (0.002, 0.0005, 0.00317):
        state, left = string.rest(), 10.0
        while left > 1e-9:
            state, left = string.step(state, 300.0, min(dt_s, left)), left - dt_s
        assert state.speed_rad_s == pytest.approx(whole.speed_rad_s, rel=1e-6)
        assert state.bottom_speed_rad_s == pytest.approx(whole.bottom_speed_rad_s, rel=1e-6)


def test_a_state_that_was_kept_does_not_change() -> None:
    string = DrillString(SMOOTH)
    kept = moved(string, [300.0] * 800)[0][-1]
    waves = kept.down_nm.copy(), kept.up_nm.copy()
    once = string.step(kept, 100.0, 0.01)
    assert np.array_equal(kept.down_nm, waves[0]) and np.array_equal(kept.up_nm, waves[1])
    again = string.step(kept, 100.0, 0.01)
    assert once.speed_rad_s == again.speed_rad_s and np.array_equal(once.up_nm, again.up_nm)


@pytest.mark.heavy
@pytest.mark.parametrize(("speed", "sticks"), [(4.0, True), (18.0, False)])
def test_the_bit_sticks_and_slips_at_low_speed_only(speed: float, sticks: bool) -> None:
    drive = DriveParams(rated_torque_nm=20_000.0, torque_limit_nm=30_000.0, speed_gain_nm_s_rad=6000.0,
                        speed_integral_gain_nm_rad=4000.0, speed_limit_rpm=250.0)
    bit = Bottom(friction="stribeck", coulomb_nm=2500.0, static_nm=5000.0, stribeck_speed_rad_s=2.5,
                 viscous_nm_s_rad=20.0)
    rig = RigParams(plant=StringParams(bottom=bit), drive=drive, noise=QUIET, reporting=FAITHFUL)
    inverter, speeds = Inverter(rig, np.random.default_rng(0)), []
    inverter.control.speed(speed, 0.5, 0.5)
    for n in range(75_000):
        inverter.step(DT)
        if n >= 60_000:
            speeds.append(inverter.state.bottom_speed_rad_s)  # type: ignore[attr-defined]
    if sticks:
        assert np.mean(np.array(speeds) == 0.0) > 0.2 and max(speeds) > 2.0 * speed
    else:
        assert np.mean(speeds) == pytest.approx(speed, rel=1e-3) and np.ptp(speeds) < 0.1


@pytest.mark.parametrize(("bad", "says"), [
    ({"inner_diameter_m": 0.127}, r"inner_diameter_m: must be less than outer_diameter_m \(0\.127\)"),
    ({"length_m": 1.0}, r"length_m: waves would take 0\.000315 s"),
    ({"length_m": 1e6}, r"length_m: waves would take 315 s"),
])
def test_invalid_strings_are_refused(bad: dict[str, float], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        StringParams(**bad)  # type: ignore[arg-type]
