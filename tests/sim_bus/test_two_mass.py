"""Two masses of the paper's figure 7, compared with closed forms, and a bit in stick-slip."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.optimize import minimize_scalar

from sim_bus.inverter import Inverter
from sim_bus.params import FAITHFUL, QUIET, DriveParams, RigParams
from sim_bus.plant.two_mass import Bottom, TwoMassParams, TwoMassState, spring_torque, step

JR, JL, K, C = 1500.0, 374.0, 473.0, 23.2
DT = 0.002
SMOOTH = TwoMassParams(inertia_kg_m2=JR, stiffness_nm_rad=K, damping_nm_s_rad=C, coulomb_nm=0.0, viscous_nm_s_rad=200.0,
                       bottom=Bottom(inertia_kg_m2=JL, coulomb_nm=0.0, viscous_nm_s_rad=30.0))


def impedance(hz: float, c: float = C, br: float = 200.0, bl: float = 30.0) -> complex:
    """Return torque over speed at the motor."""
    s = 2j * math.pi * hz
    spring, low = K / s + c, JL * s + bl
    return JR * s + br + spring * low / (spring + low)


def measured(params: TwoMassParams, hz: float, settle_s: float = 150.0) -> tuple[float, complex]:
    """Return (frequency, torque over speed) in steady state, from whole periods of sampled means."""
    count = round(1.0 / hz / DT)
    hz = 1.0 / (count * DT)
    state, torques, speeds = TwoMassState(), [], []
    skipped = math.ceil(settle_s * hz) * count
    for n in range(skipped + count):
        torque = 100.0 * math.sin(2.0 * math.pi * hz * (n + 0.5) * DT)
        before = state.angle_rad
        state = step(params, state, torque, DT)
        if n >= skipped:
            torques.append(torque)
            speeds.append((state.angle_rad - before) / DT)
    turn = np.exp(-2j * np.pi * np.arange(count) / count)
    return hz, complex(np.dot(torques, turn) / np.dot(speeds, turn))


@pytest.mark.heavy
@pytest.mark.parametrize("hz", [
    0.1, 0.179, 1.0, *(pytest.param(hz, marks=pytest.mark.long) for hz in (0.02, 0.2, 0.5, 3.0)),
])
def test_impedance(hz: float) -> None:
    hz, found = measured(SMOOTH, hz)
    assert found == pytest.approx(impedance(hz), rel=3e-4)


@pytest.mark.heavy
def test_resonance_and_antiresonance_are_those_of_the_closed_form() -> None:
    """Resonance of the free system: √(k(1/J_r + 1/J_L)). Antiresonance, with the motor held: √(k/J_L)."""
    free = SMOOTH.model_copy(update={
        "damping_nm_s_rad": 0.0, "viscous_nm_s_rad": 0.0,
        "bottom": SMOOTH.bottom.model_copy(update={"viscous_nm_s_rad": 0.0})})
    held = free.model_copy(update={"inertia_kg_m2": 1e12})
    for params, truth in ((free, math.sqrt(K * (1 / JR + 1 / JL))), (held, math.sqrt(K / JL))):
        state, twists = TwoMassState(bottom_angle_rad=0.1), []
        for _ in range(50_000):
            state = step(params, state, 0.0, DT)
            twists.append(state.angle_rad - state.bottom_angle_rad)
        twist = np.array(twists)
        after = np.flatnonzero((twist[:-1] < 0.0) & (twist[1:] >= 0.0))
        zeros = (after + twist[after] / (twist[after] - twist[after + 1])) * DT
        period = (zeros[-1] - zeros[0]) / (len(zeros) - 1)
        assert 2.0 * math.pi / period == pytest.approx(truth, rel=1e-6)
        assert np.ptp(twist[-5000:]) == pytest.approx(0.2, rel=1e-5)          # nothing lost in 100 s
    peak = minimize_scalar(lambda hz: abs(impedance(hz, 1.0, 1.0, 1.0)), bounds=(0.19, 0.21), method="bounded").x
    dip = minimize_scalar(lambda hz: -abs(impedance(hz, 1.0, 1.0, 1.0)), bounds=(0.17, 0.19), method="bounded").x
    assert (2 * math.pi * peak, 2 * math.pi * dip) == pytest.approx(
        (math.sqrt(K * (1 / JR + 1 / JL)), math.sqrt(K / JL)), rel=1e-3)


@pytest.mark.heavy
def test_at_low_frequency_it_is_the_sum_of_both() -> None:
    no_drag = SMOOTH.model_copy(update={"bottom": SMOOTH.bottom.model_copy(update={"viscous_nm_s_rad": 0.0})})
    hz, found = measured(no_drag, 0.01, settle_s=700.0)
    assert found.imag / (2.0 * math.pi * hz) == pytest.approx(JR + JL, rel=2e-3)


@pytest.mark.heavy
def test_a_stuck_bottom_sticks_exactly_and_the_spring_holds_the_torque() -> None:
    params = SMOOTH.model_copy(update={"bottom": Bottom(friction="stribeck", coulomb_nm=500.0, static_nm=800.0)})
    state = TwoMassState()
    for _ in range(100_000):
        state = step(params, state, 350.0, DT)
        assert state.bottom_speed_rad_s == state.bottom_angle_rad == 0.0
    assert spring_torque(params, state) == pytest.approx(350.0, rel=1e-3)
    for _ in range(2000):
        state = step(params, state, 1000.0, DT)
    assert state.bottom_angle_rad > 0.0


@settings(max_examples=40, deadline=None)
@given(speed=st.floats(-5, 5), low=st.floats(-5, 5), drive=st.floats(-2000, 2000), k=st.floats(10, 1e5),
       c=st.floats(0, 100), friction=st.sampled_from(["coulomb", "stribeck", "dahl", "lugre"]))
def test_energy_is_only_what_the_torque_brought(speed: float, low: float, drive: float, k: float, c: float,
                                                friction: str) -> None:
    params = TwoMassParams(stiffness_nm_rad=k, damping_nm_s_rad=c, friction=friction,  # type: ignore[arg-type]
                           bottom=Bottom(friction=friction))                           # type: ignore[arg-type]

    def energy(at: TwoMassState) -> float:
        bristle = {"dahl": params.dahl_stiffness_nm_rad, "lugre": params.lugre_stiffness_nm_rad}.get(friction, 0.0)
        twist = at.angle_rad - at.bottom_angle_rad
        return 0.5 * (JR * at.speed_rad_s**2 + JL * at.bottom_speed_rad_s**2 + k * twist**2
                      + bristle * (at.bristle_rad**2 + at.bottom_bristle_rad**2))

    state = TwoMassState(speed, bottom_speed_rad_s=low)
    stored, work, scale = energy(state), 0.0, 0.0
    for _ in range(400):
        after = step(params, state, drive, DT)
        work += drive * (after.angle_rad - state.angle_rad)
        state = after
        scale = max(scale, energy(state), abs(work))
        assert energy(state) <= stored + work + 2e-3 * (1e-3 + scale)


def test_stick_slip_agrees_with_an_integration_between_its_events() -> None:
    """A bit with Coulomb friction breaks away, sticks, and breaks away again, by independent equations."""
    dry, spans = 600.0, ((0.0, 10.0, 620.0), (10.0, 20.0, 0.0), (20.0, 30.0, 900.0))
    params = TwoMassParams(coulomb_nm=0.0, viscous_nm_s_rad=0.0, bottom=Bottom(coulomb_nm=dry, viscous_nm_s_rad=10.0))
    times = np.arange(15_001) * DT
    state, found = TwoMassState(), [0.0]
    y, stuck, truth, events = np.zeros(4), True, np.zeros_like(times), 0
    for begin, end, u in spans:
        for _ in range(round((end - begin) / DT)):
            state = step(params, state, u, DT)
            found.append(state.bottom_speed_rad_s)
        now = begin
        while now < end - 1e-9:
            def rates(_t: float, y: np.ndarray, stuck: bool = stuck, u: float = u) -> list[float]:
                tau = K * (y[0] - y[1]) + C * (y[2] - y[3])
                return [y[2], y[3], (u - tau) / JR, 0.0 if stuck else (tau - dry - 10.0 * y[3]) / JL]

            def leaves(_t: float, y: np.ndarray, stuck: bool = stuck) -> float:
                return float(K * (y[0] - y[1]) + C * y[2] - dry if stuck else y[3])

            leaves.terminal, leaves.direction = True, 1.0 if stuck else -1.0  # type: ignore[attr-defined]
            piece = solve_ivp(rates, (now, end), y, events=leaves, rtol=1e-10, atol=1e-12, dense_output=True)
            here = (times > now) & (times <= piece.t[-1] + 1e-12)
            if here.any():
                truth[here] = piece.sol(times[here])[3]
            now, y = float(piece.t[-1]), piece.y[:, -1]
            if piece.status == 1:
                stuck, events, y[3] = not stuck, events + 1, 0.0
    assert events >= 3 and min(truth) > -1e-9
    assert np.max(np.abs(truth - found)) < 1e-4 * np.ptp(truth)


STIFF_DRIVE = DriveParams(rated_torque_nm=20_000.0, torque_limit_nm=30_000.0, speed_gain_nm_s_rad=6000.0,
                          speed_integral_gain_nm_rad=4000.0, speed_limit_rpm=250.0)
BIT = Bottom(friction="stribeck", coulomb_nm=2500.0, static_nm=5000.0, stribeck_speed_rad_s=2.5, viscous_nm_s_rad=20.0)


@pytest.mark.heavy
@pytest.mark.parametrize(("speed", "sticks"), [(4.0, True), (16.0, False)])
def test_the_bit_sticks_and_slips_at_low_speed_only(speed: float, sticks: bool) -> None:
    rig = RigParams(plant=TwoMassParams(bottom=BIT), drive=STIFF_DRIVE, noise=QUIET, reporting=FAITHFUL)
    drive, bit, motor = Inverter(rig, np.random.default_rng(0)), [], []
    drive.control.speed(speed, 0.5, 0.5)
    for n in range(75_000):
        drive.step(DT)
        if n >= 60_000:
            bit.append(drive.state.bottom_speed_rad_s)  # type: ignore[attr-defined]
            motor.append(drive.speed_rad_s)
    assert np.mean(motor) == pytest.approx(speed, rel=0.02)
    if sticks:
        assert np.mean(np.array(bit) == 0.0) > 0.2 and max(bit) > 2.0 * speed
    else:
        assert np.ptp(bit) < 0.01


def test_ends_with_a_too_stiff_spring_are_refused_with_a_remedy() -> None:
    with pytest.raises(ValueError, match=r"swing at 5\.78e\+04 rad/s.*kind: rigid"):
        TwoMassParams(stiffness_nm_rad=1e12)
    with pytest.raises(ValueError, match=r"damping_nm_s_rad: it would damp"):
        TwoMassParams(damping_nm_s_rad=1e7)


LOOSE = TwoMassParams(inertia_kg_m2=60.0, stiffness_nm_rad=1e5, damping_nm_s_rad=300.0, viscous_nm_s_rad=6.0,
                      coulomb_nm=40.0, play_rad=0.01,
                      bottom=Bottom(inertia_kg_m2=44.0, coulomb_nm=20.0, static_nm=20.0, viscous_nm_s_rad=2.0))


def test_play_against_an_integrator() -> None:
    """The motor is driven so that the load changes its flank in each period; speeds stay positive."""
    def torque(time: float) -> float:
        return 100.0 + 200.0 * math.sin(2.0 * math.pi * 0.3 * time)

    def slopes(time: float, y: list[float]) -> list[float]:
        speed, angle, low_speed, low_angle = y
        twist = angle - low_angle - min(max(angle - low_angle, -0.005), 0.005)
        push = 1e5 * twist + 300.0 * (speed - low_speed)
        push = max(push, 0.0) if twist > 0.0 else min(push, 0.0) if twist < 0.0 else 0.0
        return [(torque(time) - 40.0 - 6.0 * speed - push) / 60.0, speed,
                (push - 20.0 - 2.0 * low_speed) / 44.0, low_speed]

    state, twists = TwoMassState(speed_rad_s=5.0, angle_rad=0.005, bottom_speed_rad_s=5.0), []
    for n in range(3000):
        state = step(LOOSE, state, torque((n + 0.5) * DT), DT)
        twists.append(state.angle_rad - state.bottom_angle_rad)
    exact = solve_ivp(slopes, (0.0, 3000 * DT), [5.0, 0.005, 5.0, 0.0], rtol=1e-8, atol=1e-9, max_step=DT).y[:, -1]
    assert (state.speed_rad_s, state.angle_rad) == pytest.approx(exact[:2], rel=1e-4)
    assert (state.bottom_speed_rad_s, state.bottom_angle_rad) == pytest.approx(exact[2:], rel=1e-4)
    assert min(twists) < -0.005 and max(twists) > 0.005
    assert spring_torque(LOOSE, TwoMassState(angle_rad=0.004)) == 0.0
    assert spring_torque(LOOSE, TwoMassState(angle_rad=0.006)) == pytest.approx(100.0)
    # a flank only pushes: a motor that moves away has no contact
    assert spring_torque(LOOSE, TwoMassState(speed_rad_s=-5.0, angle_rad=0.006)) == 0.0
