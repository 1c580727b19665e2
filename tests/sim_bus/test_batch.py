"""Batch of shafts: it must equal each shaft alone, with the scalar plant as the oracle."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_bus.plant.batch import ANGLE, BRISTLE, SPEED, FixedStep, Shafts, white_torque
from sim_bus.plant.rigid import Params, ShaftState, step

TOLERANCE = 1e-9      # relative to the larger of 1 and the value


def alone(params: Params, torques, dt_s: float) -> ShaftState:
    state = ShaftState()
    for torque in torques:
        state = step(params, state, float(torque), dt_s)
    return state


def shafts_of(rigs: list[Params]) -> Shafts:
    return Shafts.of(
        [rig.inertia_kg_m2 for rig in rigs], [rig.viscous_nm_s_rad for rig in rigs], [rig.coulomb_nm for rig in rigs],
        [rig.dahl_stiffness_nm_rad for rig in rigs], [rig.friction == "dahl" for rig in rigs],
    )


def together(rigs: list[Params], torques, dt_s) -> np.ndarray:
    plant, state = FixedStep(shafts_of(rigs), dt_s), shafts_of(rigs).at_rest()
    for row in torques:
        state = plant.advance(state, row)
    return state


def assert_same(rigs, torques, dt_s) -> None:
    found = together(rigs, torques, dt_s)
    steps_s = np.broadcast_to(dt_s, (len(rigs),))
    for run, rig in enumerate(rigs):
        expected = alone(rig, torques[:, run], float(steps_s[run]))
        for row, value in ((SPEED, expected.speed_rad_s), (ANGLE, expected.angle_rad), (BRISTLE, expected.bristle_rad)):
            assert abs(found[row, run] - value) <= TOLERANCE * max(1.0, abs(value)), (run, row)


RIGS = [
    Params(inertia_kg_m2=900.0, viscous_nm_s_rad=74.3, coulomb_nm=82.4, friction="dahl"),
    Params(inertia_kg_m2=450.0, viscous_nm_s_rad=0.0, coulomb_nm=20.0, friction="dahl", dahl_stiffness_nm_rad=100.0),
    Params(inertia_kg_m2=104.0, viscous_nm_s_rad=8.0, coulomb_nm=60.0),
    Params(inertia_kg_m2=104.0, viscous_nm_s_rad=0.0, coulomb_nm=60.0),
    Params(inertia_kg_m2=10.0, viscous_nm_s_rad=1.0, coulomb_nm=0.0),
    Params(inertia_kg_m2=10.0, viscous_nm_s_rad=1.0, coulomb_nm=0.0, friction="dahl"),
]


def swinging(rows: int, columns: int) -> np.ndarray:
    """Return torques around breakaway with both signs, for starts, reversals and standstills."""
    time = np.arange(rows)[:, np.newaxis]
    return 150.0 * np.sin(2.0 * np.pi * time / 900.0 + np.arange(columns)) + 20.0


@pytest.mark.heavy
def test_agrees_with_the_scalar_plant_through_starts_reversals_and_sticks():
    torques = swinging(4000, len(RIGS))
    torques[1500:2200] = 5.0      # sticks
    assert_same(RIGS, torques, 0.002)


def test_every_run_may_have_its_own_step():
    assert_same(RIGS, swinging(1500, len(RIGS)), np.array([0.0005, 0.001, 0.002, 0.004, 0.001, 0.003]))


@pytest.mark.parametrize("kind", [slice(0, 2), slice(2, 4)])
def test_one_kind_of_friction_alone(kind):
    assert_same(RIGS[kind], swinging(2000, 2), 0.001)


@settings(max_examples=60)
@given(
    inertia=st.floats(1.0, 5000.0), viscous=st.floats(0.0, 300.0), coulomb=st.floats(0.0, 300.0),
    dahl=st.booleans(), torques=st.lists(st.floats(-500.0, 500.0), min_size=1, max_size=60), dt_s=st.floats(1e-4, 2e-3),
)
def test_agrees_for_any_shaft(inertia, viscous, coulomb, dahl, torques, dt_s):
    rig = Params(
        inertia_kg_m2=inertia, viscous_nm_s_rad=viscous, coulomb_nm=coulomb, friction="dahl" if dahl else "coulomb",
        dahl_stiffness_nm_rad=500.0,
    )
    assert_same([rig], np.array(torques)[:, np.newaxis], dt_s)


def test_a_run_does_not_depend_on_its_neighbours():
    torques = swinging(800, len(RIGS))
    whole = together(RIGS, torques, 0.001)
    for run in range(len(RIGS)):
        assert np.array_equal(whole[:, [run]], together([RIGS[run]], torques[:, [run]], 0.001))


def test_a_stuck_shaft_stays_exactly_still():
    state = together([RIGS[2]], np.full((500, 1), 59.9), 0.002)
    assert state[SPEED, 0] == 0.0
    assert state[ANGLE, 0] == 0.0


def test_invalid_steps_are_refused():
    stiff = Shafts.of(10.0, 0.0, 50.0, 1e6, True)
    with pytest.raises(ValueError, match="bristle"):
        FixedStep(stiff, 0.01)
    with pytest.raises(ValueError, match="positive"):
        Shafts.of(0.0, 0.0, 1.0, 1.0, False)
    with pytest.raises(ValueError, match="positive"):
        FixedStep(Shafts.of(1.0, 0.0, 1.0, 1.0, False), 0.0)


def test_white_torque_has_its_density_for_any_step():
    """The variance is P/h without correlation, so the spectral density is P up to the Nyquist frequency."""
    power, step_s = np.array([1e-3, 1e-3, 4e-3]), np.array([0.001, 0.0005, 0.001])
    noise = white_torque(power, step_s, 200_000, np.random.default_rng(5))
    assert np.allclose(noise.var(axis=0), power / step_s, rtol=0.02)
    assert np.all(np.abs((noise[1:] * noise[:-1]).mean(axis=0)) < 0.02 * noise.var(axis=0))
    again = white_torque(power, step_s, 200_000, np.random.default_rng(5))
    assert np.array_equal(noise, again)
