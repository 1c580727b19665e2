"""Torque of the plant that depends on the angle."""

import math

import pytest

from profiles import DataFileError
from sim_bus.params import load_rig
from sim_bus.plant import Harmonic, Params, build
from sim_bus.plant.angle_torque import torque_over_step
from tests.rigs import plant_file

LIGHT = {"inertia_kg_m2": 2.0, "viscous_nm_s_rad": 0.0, "coulomb_nm": 0.0}


def test_the_mean_over_a_step_is_that_of_the_travel():
    one = (Harmonic(order=36, amplitude_nm=10.0, phase_rad=0.7),)
    fine = [10.0 * math.cos(36.0 * (0.3 + 0.02 * (k + 0.5) / 4000) + 0.7) for k in range(4000)]
    assert torque_over_step(one, 0.3, 0.02) == pytest.approx(sum(fine) / 4000, abs=1e-6)
    assert torque_over_step(one, 0.3, 0.0) == pytest.approx(10.0 * math.cos(36.0 * 0.3 + 0.7))


def test_the_speed_follows_the_energy_of_the_angle():
    """Without friction, J ω²/2 changes by the work of the harmonic: −a (sin(nθ + φ) − sin φ)/n."""
    plant = build(Params(**LIGHT, harmonics=(Harmonic(order=6, amplitude_nm=5.0, phase_rad=0.4),)))
    state = plant.rest()._replace(speed_rad_s=4.0)
    for _ in range(2000):
        state = plant.step(state, 0.0, 0.0005)
    work = -5.0 * (math.sin(6.0 * state.angle_rad + 0.4) - math.sin(0.4)) / 6.0
    assert 0.5 * 2.0 * state.speed_rad_s**2 == pytest.approx(0.5 * 2.0 * 16.0 + work, abs=2e-4)


def test_a_plant_without_harmonics_is_the_same_plant():
    assert type(build(Params())) is type(build(Params(harmonics=(Harmonic(order=1, amplitude_nm=0.0),))))


def test_plant_yaml_declares_harmonics(tmp_path):
    path = plant_file(tmp_path, "plant:\n  harmonics:\n    - {order: 6, amplitude_nm: 12.0, phase_rad: 0.5}\n")
    assert load_rig(path).plant.harmonics == (Harmonic(order=6, amplitude_nm=12.0, phase_rad=0.5),)
    plant_file(tmp_path, "plant:\n  harmonics:\n    - {order: 0, amplitude_nm: 12.0}\n")
    with pytest.raises(DataFileError, match="order"):
        load_rig(path)
