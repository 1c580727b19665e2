"""Each friction model, compared with its equations integrated from event to event; and general properties."""

import math
from itertools import pairwise
from typing import NamedTuple, get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from sim_bus.plant import friction as models
from sim_bus.plant.friction import ShaftParams, torque
from sim_bus.plant.rigid import Params, ShaftState, friction_torque, step

MODELS = ("coulomb", "stribeck", "dahl", "lugre")
STICKING = ("coulomb", "stribeck")
PROFILE = ((0.0, 1.0, 250.0), (1.0, 3.0, -200.0), (3.0, 7.0, 40.0))
"""(from, to, torque) for start from standstill, reversal, and standstill."""


class Law(NamedTuple):
    """Parameters of the textbook, without equations of the simulator."""

    J: float
    B: float
    Fc: float
    Fs: float
    ws: float
    s0: float
    s1: float

    @classmethod
    def of(cls, params: Params) -> "Law":
        p = params
        fs = p.static_nm if p.friction in ("stribeck", "lugre") else p.coulomb_nm
        s0 = {"dahl": p.dahl_stiffness_nm_rad, "lugre": p.lugre_stiffness_nm_rad}.get(p.friction, 0.0)
        s1 = p.lugre_damping_nm_s_rad if p.friction == "lugre" else 0.0
        return cls(p.inertia_kg_m2, p.viscous_nm_s_rad, p.coulomb_nm, fs, p.stribeck_speed_rad_s, s0, s1)

    def g(self, w: float) -> float:
        return self.Fc + (self.Fs - self.Fc) * math.exp(-((w / self.ws) ** 2))

    def rates(self, w: float, z: float, u: float, side: float) -> list[float]:
        if self.s0 == 0.0:
            return [(u - self.B * w - side * self.g(w)) / self.J, 0.0]
        bend = w - self.s0 * side * w * z / self.g(w)
        return [(u - self.B * w - self.s0 * z - self.s1 * bend) / self.J, bend]


def reference(params: Params, times: np.ndarray, profile: tuple = PROFILE) -> np.ndarray:
    """Return the speed at ``times``. The sign of ω is constant within a piece that ends at ω = 0 or a torque change."""
    law = Law.of(params)
    speed, w, z = np.zeros_like(times), 0.0, 0.0
    # Without a bristle, the solver would take large steps at the kink of friction.
    longest = np.inf if law.s0 else min(1e-2, law.ws / 10.0)
    for begin, end, u in profile:
        now = begin
        while now < end - 1e-12:
            side = math.copysign(1.0, w)
            if w == 0.0:
                push = u - law.s0 * z
                if push == 0.0 or (law.s0 == 0.0 and abs(push) <= law.Fs):
                    break                                     # sticks until the torque changes
                side = math.copysign(1.0, push)

            def zero(_t: float, y: np.ndarray) -> float:
                return float(y[0])

            zero.terminal, zero.direction = True, -side  # type: ignore[attr-defined]
            piece = solve_ivp(lambda _t, y, u=u, s=side: law.rates(y[0], y[1], u, s), (now, end), [w, z],
                              method="DOP853", rtol=1e-10, atol=1e-13, events=zero, dense_output=True, max_step=longest)
            here = (times > now) & (times <= piece.t[-1] + 1e-12)
            if here.any():
                speed[here] = piece.sol(times[here])[0]
            now, z = float(piece.t[-1]), float(piece.y[1][-1])
            w = 0.0 if piece.status == 1 else float(piece.y[0][-1])
    return speed


def simulated(params: Params, dt_s: float, profile: tuple = PROFILE) -> np.ndarray:
    state, speeds = ShaftState(), [0.0]
    for begin, end, u in profile:
        for _ in range(round((end - begin) / dt_s)):
            state = step(params, state, u, dt_s)
            speeds.append(state.speed_rad_s)
    return np.array(speeds)


def deviation(params: Params, dt_s: float, profile: tuple = PROFILE) -> float:
    """Return the largest deviation of the speed, as a share of its range."""
    times = np.arange(round(profile[-1][1] / dt_s) + 1) * dt_s
    truth = reference(params, times, profile)
    assert truth.max() > 0.0 > truth.min()                    # it did start and reverse
    return float(np.max(np.abs(simulated(params, dt_s, profile) - truth)) / np.ptp(truth))


CASES = {
    "coulomb": ({"friction": "coulomb"}, 1e-9),
    "stribeck": ({"friction": "stribeck"}, 1e-6),
    "stribeck, narrow": ({"friction": "stribeck", "stribeck_speed_rad_s": 0.02}, 1e-6),
    "stribeck, wide": ({"friction": "stribeck", "stribeck_speed_rad_s": 0.5, "static_nm": 100.0}, 1e-6),
    "dahl": ({"friction": "dahl"}, 2e-6),
    "dahl, stiff": ({"friction": "dahl", "dahl_stiffness_nm_rad": 1e5}, 1e-5),
    "lugre": ({"friction": "lugre"}, 5e-6),
    "lugre, undamped": ({"friction": "lugre", "lugre_damping_nm_s_rad": 0.0}, 1e-5),
    "lugre, overdamped": ({"friction": "lugre", "lugre_damping_nm_s_rad": 9000.0}, 1e-5),
    "lugre, stiff": ({"friction": "lugre", "lugre_stiffness_nm_rad": 1e5, "lugre_damping_nm_s_rad": 300.0}, 1e-5),
}


@pytest.mark.long(but_first=8)
@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize("dt_s", [0.002, 0.0005])
@pytest.mark.parametrize("name", CASES)
def test_start_reversal_and_stick_as_integrated_between_events(name: str, dt_s: float) -> None:
    words, bound = CASES[name]
    assert bound <= 1e-4
    assert deviation(Params(**words), dt_s) < bound  # type: ignore[arg-type]


SHORT = ((0.0, 0.02, 100.0), (0.02, 0.04, -90.0), (0.04, 0.08, 40.0))


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize(("words", "bound"), [
    ({"friction": "coulomb"}, 1e-9),
    ({"friction": "stribeck"}, 1e-5),
    ({"friction": "dahl"}, 1e-3),
    ({"friction": "dahl", "dahl_stiffness_nm_rad": 1e5}, 3e-4),
    ({"friction": "lugre"}, 1e-4),
    ({"friction": "lugre", "lugre_stiffness_nm_rad": 1e5, "lugre_damping_nm_s_rad": 0.0}, 1e-4),
    ({"friction": "lugre", "lugre_stiffness_nm_rad": 1e5, "lugre_damping_nm_s_rad": 316.0}, 1e-4),
])
def test_a_shaft_ten_thousand_times_lighter_is_still_accurate(words: dict[str, object], bound: float) -> None:
    assert deviation(Params(inertia_kg_m2=0.01, **words), 0.002, SHORT) < bound  # type: ignore[arg-type]


@pytest.mark.long(but_first=9)
@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize("inertia", [0.01, 1.0, 104.0])
@pytest.mark.parametrize("words", [
    {"friction": "lugre", "lugre_stiffness_nm_rad": stiffness, "lugre_damping_nm_s_rad": damping}
    for stiffness in (1e5, 1e7) for damping in (0.0, 300.0, 1e4)
] + [{"friction": "dahl", "dahl_stiffness_nm_rad": stiffness} for stiffness in (1e5, 1e7)], ids=str)
def test_a_stiff_bristle_comes_to_standstill_and_stays(words: dict[str, object], inertia: float) -> None:
    params = Params(inertia_kg_m2=inertia, viscous_nm_s_rad=80.0, **words)  # type: ignore[arg-type]
    state, top = ShaftState(0.2), 0.2 + 300.0 / 80.0
    for _ in range(50):
        state = step(params, state, 300.0, 0.002)
        assert abs(state.speed_rad_s) <= top
    law = Law.of(params)
    settling_s = 18.0 * max(2.0 * law.J / law.B, (law.s1 + law.B) / law.s0, 0.01)
    for _ in range(round(settling_s / 0.002)):
        state = step(params, state, 20.0, 0.002)
    assert friction_torque(params, state) == pytest.approx(20.0, rel=1e-3)
    speeds = []
    for _ in range(100):
        state = step(params, state, 20.0, 0.002)
        speeds.append(abs(state.speed_rad_s))
    assert max(speeds) < 1e-5                                  # no chatter


def energy(params: Params, state: ShaftState) -> float:
    stiffness = {"dahl": params.dahl_stiffness_nm_rad, "lugre": params.lugre_stiffness_nm_rad}.get(params.friction, 0.0)
    return 0.5 * params.inertia_kg_m2 * state.speed_rad_s**2 + 0.5 * stiffness * state.bristle_rad**2


@settings(max_examples=100, deadline=None)
@given(friction=st.sampled_from(MODELS), speed=st.floats(-5, 5), drive=st.floats(-400, 400),
       viscous=st.floats(0, 20), inertia=st.sampled_from([20.0, 104.0, 1500.0]))
def test_friction_dissipates_energy(friction: str, speed: float, drive: float, viscous: float, inertia: float) -> None:
    params = Params(friction=friction, viscous_nm_s_rad=viscous, inertia_kg_m2=inertia)  # type: ignore[arg-type]
    state = ShaftState(speed)
    stored, work, scale = energy(params, state), 0.0, 0.0
    for _ in range(300):
        after = step(params, state, drive, 0.002)
        work += drive * (after.angle_rad - state.angle_rad)
        state = after
        scale = max(scale, energy(params, state), abs(work))
        assert energy(params, state) <= stored + work + 2e-4 * (1e-3 + scale)


@settings(max_examples=100, deadline=None)
@given(friction=st.sampled_from(MODELS), speed=st.floats(-1, 1), dt_s=st.sampled_from([0.0005, 0.002, 0.01]),
       inertia=st.sampled_from([0.01, 1.0, 104.0]))
def test_without_torque_it_never_accelerates(friction: str, speed: float, dt_s: float, inertia: float) -> None:
    params = Params(friction=friction, inertia_kg_m2=inertia)  # type: ignore[arg-type]
    state = ShaftState(speed)
    most = energy(params, state)
    for _ in range(50):
        state = step(params, state, 0.0, dt_s)
        assert energy(params, state) <= most * 1.001 + 1e-12


@settings(max_examples=60, deadline=None)
@given(friction=st.sampled_from(STICKING), speed=st.floats(-1, 1), share=st.floats(-1, 1))
def test_it_sticks_exactly(friction: str, speed: float, share: float) -> None:
    params = Params(friction=friction)  # type: ignore[arg-type]
    holds = params.coulomb_nm if friction == "coulomb" else params.static_nm
    state = ShaftState(speed, 1.5)
    for _ in range(20_000):
        state = step(params, state, 0.0, 0.002)
        if state.speed_rad_s == 0.0:
            break
    for dt_s in (0.002, 0.0005, 0.01):
        drive = share * holds
        assert step(params, state, drive, dt_s) == state
        assert friction_torque(params, state, drive) == drive
    beyond = holds * (1.0 + 1e-9)
    assert step(params, state, beyond, 0.002).speed_rad_s > 0.0 > step(params, state, -beyond, 0.002).speed_rad_s


@pytest.mark.parametrize("friction", ["dahl", "lugre"])
def test_a_bristle_that_carries_the_load_is_a_fixed_point(friction: str) -> None:
    params = Params(friction=friction, dahl_stiffness_nm_rad=4096.0, lugre_stiffness_nm_rad=4096.0)  # type: ignore[arg-type]
    state = ShaftState(0.0, 0.0, 32.0 / 4096.0)
    assert step(params, state, 32.0, 0.002) == state


@settings(max_examples=100, deadline=None)
@given(friction=st.sampled_from(MODELS), speed=st.floats(-2, 2), bristle=st.floats(-0.003, 0.003),
       drive=st.floats(-300, 300), dt_s=st.floats(1e-4, 1e-2), inertia=st.sampled_from([0.01, 1.0, 104.0]))
def test_both_directions_are_alike(friction: str, speed: float, bristle: float, drive: float, dt_s: float,
                                   inertia: float) -> None:
    params = Params(friction=friction, inertia_kg_m2=inertia)  # type: ignore[arg-type]
    one, other = ShaftState(speed, 0.0, bristle), ShaftState(-speed, 0.0, -bristle)
    for _ in range(5):
        one, other = step(params, one, drive, dt_s), step(params, other, -drive, dt_s)
        assert one == tuple(-value for value in other)


@settings(max_examples=60, deadline=None)
@given(friction=st.sampled_from(MODELS), speed=st.floats(0.01, 5))
def test_steady_sliding_has_the_torque_of_the_law(friction: str, speed: float) -> None:
    """With balanced torque the speed is constant. The law is stated again here."""
    params = Params(friction=friction, inertia_kg_m2=1e6)  # type: ignore[arg-type]
    law = Law.of(params)
    bristle = law.g(speed) / law.s0 if law.s0 else 0.0
    state = step(params, ShaftState(speed, 0.0, bristle), law.g(speed) + law.B * speed, 0.002)
    assert state.speed_rad_s == pytest.approx(speed, rel=1e-12)
    assert state.angle_rad == pytest.approx(speed * 0.002, rel=1e-12)
    assert torque(params, speed, bristle) == pytest.approx(law.g(speed), rel=1e-12)


def test_friction_falls_from_breakaway_to_sliding() -> None:
    params = Params(friction="stribeck")
    levels = [friction_torque(params, ShaftState(speed)) for speed in (1e-9, 0.05, 0.1, 0.2, 1.0)]
    assert levels[0] == pytest.approx(80.0) and levels[-1] == pytest.approx(60.0)
    assert levels[2] == pytest.approx(60.0 + 20.0 / math.e)
    assert all(a > b for a, b in pairwise(levels))
    assert friction_torque(params, ShaftState(), 300.0) == 80.0


def test_every_model_is_in_plant_yaml_and_in_these_tests() -> None:
    assert set(MODELS) == set(models.MODELS) == set(get_args(ShaftParams.model_fields["friction"].annotation))
    assert {words["friction"] for words, _ in CASES.values()} == set(MODELS)


def test_without_coulomb_friction_no_model_has_any() -> None:
    for friction in MODELS:
        params = Params(friction=friction, coulomb_nm=0.0)  # type: ignore[arg-type]
        assert step(params, ShaftState(1.0), 5.0, 0.002) == step(Params(coulomb_nm=0.0), ShaftState(1.0), 5.0, 0.002)
        assert friction_torque(params, ShaftState(1.0)) == 0.0


@pytest.mark.parametrize("friction", ["stribeck", "lugre"])
def test_breakaway_below_sliding_is_refused(friction: str) -> None:
    with pytest.raises(ValueError, match=r"static_nm: breakaway torque can't be below coulomb_nm \(100\)"):
        Params(friction=friction, coulomb_nm=100.0, static_nm=80.0)  # type: ignore[arg-type]
    Params(friction="dahl", coulomb_nm=100.0, static_nm=80.0)
