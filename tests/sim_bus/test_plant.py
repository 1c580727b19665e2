import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from sim_bus.plant import rigid
from sim_bus.plant.rigid import Params, ShaftState, step


def torque_at(time_s: float) -> float:
    """Return the torque for start, reversal and standstill, constant over each 2 ms step for both integrations."""
    if time_s < 1.0:
        return 250.0
    if time_s < 3.0:
        return -200.0
    return 40.0


def simulate(params: Params, end_s: float = 7.0, dt_s: float = 0.002) -> tuple[np.ndarray, list[ShaftState]]:
    count = round(end_s / dt_s)
    state, states = ShaftState(), [ShaftState()]
    for k in range(count):
        state = step(params, state, torque_at(k * dt_s), dt_s)
        states.append(state)
    return np.arange(count + 1) * dt_s, states


def independent(params: Params, times: np.ndarray) -> np.ndarray:
    """Integrate own equations by RK45 (rtol 1e-10), piecewise in torque: Coulomb by events, Dahl directly."""
    J, B, F, sigma = params.inertia_kg_m2, params.viscous_nm_s_rad, params.coulomb_nm, params.dahl_stiffness_nm_rad
    speed = np.zeros_like(times)
    bristle, omega = 0.0, 0.0
    for begin, end in pairwise([0.0, 1.0, 3.0, float(times[-1])]):
        drive, now = torque_at(begin), begin
        inside = (times > begin - 1e-9) & (times <= end + 1e-9)
        while now < end - 1e-12:
            if params.friction == "dahl":
                solution = solve_ivp(
                    lambda _t, y, u=drive: [(u - B * y[0] - sigma * y[1]) / J,
                                            y[0] * (1.0 - sigma * y[1] / F * np.sign(y[0]))],
                    (now, end), [omega, bristle], rtol=1e-10, atol=1e-12, dense_output=True, max_step=0.01)
                bristle = solution.y[1][-1]
            else:
                side = np.sign(omega) or (np.sign(drive) if abs(drive) > F else 0.0)
                if side == 0.0:
                    speed[inside & (times >= now)] = 0.0
                    break

                def zero(_t: float, y: np.ndarray) -> float:
                    return float(y[0])

                zero.terminal, zero.direction = True, -side  # type: ignore[attr-defined]
                solution = solve_ivp(lambda _t, y, u=drive, s=side: [(u - B * y[0] - s * F) / J],
                                     (now, end), [omega], rtol=1e-10, atol=1e-12, events=zero, dense_output=True)
            here = inside & (times >= now - 1e-9) & (times <= solution.t[-1] + 1e-9)
            speed[here] = solution.sol(times[here])[0]
            omega = 0.0 if solution.status == 1 else float(solution.y[0][-1])
            now = float(solution.t[-1])
    return speed


@pytest.mark.parametrize(("params", "tolerance"), [
    (Params(), 1e-9),
    (Params(viscous_nm_s_rad=0.0), 1e-9),
    (Params(friction="dahl"), 3e-5),
    (Params(friction="dahl", dahl_stiffness_nm_rad=600.0), 3e-5),
])
def test_agrees_with_an_independent_integration(params: Params, tolerance: float) -> None:
    times, states = simulate(params)
    speed = np.array([state.speed_rad_s for state in states])
    truth = independent(params, times)
    assert max(truth) > 1.0 and min(truth) < -0.5                 # it did start and reverse
    assert np.max(np.abs(speed - truth)) < tolerance


def test_sticks_exactly_and_without_chatter() -> None:
    _, states = simulate(Params())
    assert [state.speed_rad_s for state in states[-100:]] == [0.0] * 100
    assert step(Params(), ShaftState(), 60.0, 0.002) == ShaftState()
    assert step(Params(), ShaftState(), 60.1, 0.002).speed_rad_s > 0.0


def test_a_step_through_zero_agrees_with_many_small_ones() -> None:
    params = Params()
    for torque in (-300.0, -50.0):
        coarse = step(params, ShaftState(0.003), torque, 0.002)
        fine = ShaftState(0.003)
        for _ in range(2000):
            fine = step(params, fine, torque, 1e-6)
        assert coarse.speed_rad_s == pytest.approx(fine.speed_rad_s, abs=1e-12)


def test_viscous_limit_is_continuous() -> None:
    tiny = step(Params(viscous_nm_s_rad=1e-9), ShaftState(0.01), -500.0, 0.002)
    none = step(Params(viscous_nm_s_rad=0.0), ShaftState(0.01), -500.0, 0.002)
    assert tiny.speed_rad_s == pytest.approx(none.speed_rad_s, abs=1e-12)


@settings(max_examples=60, deadline=None)
@given(speed=st.floats(-10, 10), torque=st.floats(-400, 400), friction=st.sampled_from(["coulomb", "dahl"]),
       viscous=st.floats(0, 20))
def test_energy_is_only_what_the_torque_brought(speed: float, torque: float, friction: str, viscous: float) -> None:
    params = Params(friction=friction, viscous_nm_s_rad=viscous)  # type: ignore[arg-type]
    state = ShaftState(speed)
    stored = 0.5 * 104.0 * speed**2
    work = 0.0
    for _ in range(200):
        after = step(params, state, torque, 0.002)
        work += torque * (after.angle_rad - state.angle_rad)
        state = after
        assert abs(state.bristle_rad) <= params.coulomb_nm / params.dahl_stiffness_nm_rad * (1 + 1e-9)
    energy = 0.5 * 104.0 * state.speed_rad_s**2 + 0.5 * params.dahl_stiffness_nm_rad * state.bristle_rad**2
    assert energy <= stored + work + 1e-3 * (1.0 + abs(work))


@given(speed=st.floats(-1, 1), torque=st.floats(-60, 60))
@settings(max_examples=60, deadline=None)
def test_torque_below_friction_always_ends_at_standstill(speed: float, torque: float) -> None:
    params, state = Params(viscous_nm_s_rad=8.0), ShaftState(speed)
    for _ in range(20000):
        state = step(params, state, 0.9 * torque, 0.002)
        if state.speed_rad_s == 0.0:
            break
    assert step(params, state, 0.9 * torque, 0.002).speed_rad_s == 0.0


def test_friction_torque_and_loads() -> None:
    assert rigid.friction_torque(Params(), ShaftState(-1.0)) == -60.0
    assert rigid.friction_torque(Params(), ShaftState(), 25.0) == 25.0
    assert rigid.friction_torque(Params(friction="dahl"), ShaftState(1.0, 0.0, 0.012)) == pytest.approx(60.0)
    with_load = step(Params(load_nm=30.0), ShaftState(1.0), 100.0, 0.002)
    without = step(Params(), ShaftState(1.0), 70.0, 0.002)
    assert with_load == without == step(Params(), ShaftState(1.0), 100.0, 0.002, 30.0)


def test_parameters_are_checked() -> None:
    for bad in ({"inertia_kg_m2": 0.0}, {"coulomb_nm": -1.0}, {"viscous_nm_s_rad": math.nan}, {"friction": "karnopp"}):
        with pytest.raises(ValueError, match=next(iter(bad))):
            Params(**bad)  # type: ignore[arg-type]
