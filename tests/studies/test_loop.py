"""Closed loop, compared with linear theory and with a finer step; and its reference signals."""

import numpy as np
import pytest
from scipy import integrate, signal

from tdhil.studies.paper.loop import (
    ChirpReference,
    LoopSettings,
    MultisineReference,
    SineReference,
    StepReference,
    changed,
    reference_of,
    simulate,
)
from tdhil.studies.paper.processing import torque_line

QUIET = LoopSettings(noise_power_nm2_s=0.0, coulomb_nm=0.0, duration_s=4.0)


@pytest.mark.heavy
def test_without_dry_friction_it_is_a_linear_system():
    record = simulate([QUIET])
    _, asked, speed, torque = record.of(0)
    kp, ki, inertia, viscous = QUIET.kp_nm_s_rad, QUIET.ki_nm_rad, QUIET.inertia_kg_m2, QUIET.viscous_nm_s_rad
    loop = signal.TransferFunction([kp, ki], [inertia, kp + viscous, ki])
    fine = np.linspace(0.0, 4.0, 40_001)
    _, expected, _ = signal.lsim(loop, reference_of(QUIET).at(fine), fine)
    assert np.allclose(speed, expected[::10], atol=2e-3)
    assert np.allclose(speed[1000:], expected[::10][1000:], atol=1e-5)
    assert speed[0] == 0.0
    assert torque[0] == pytest.approx(kp * asked[0])


def test_with_dahl_friction_it_is_the_papers_equations():
    """An independent program integrates e, ∫e, ω and z of equations 4, 6, 9 and 10."""
    run = changed(QUIET, coulomb_nm=82.4, duration_s=3.0)
    reference = SineReference(run.offset_rad_s, run.amplitude_rad_s, run.frequency_hz)
    limit = run.coulomb_nm / run.dahl_stiffness_nm_rad

    def slope(t, x):
        speed, bristle, integral = x
        error = float(reference.at(np.array(t))) - speed
        torque = run.kp_nm_s_rad * error + run.ki_nm_rad * integral
        dry = run.dahl_stiffness_nm_rad * bristle
        return (
            (torque - dry - run.viscous_nm_s_rad * speed) / run.inertia_kg_m2,
            speed * (1.0 - bristle / limit * np.sign(speed)), error,
        )

    time, _, speed, _ = simulate([run]).of(0)
    expected = integrate.solve_ivp(
        slope, (0.0, 3.0), (0.0, 0.0, 0.0), rtol=1e-9, atol=1e-10, t_eval=time, method="LSODA"
    )
    assert np.allclose(speed, expected.y[0], atol=2e-3)
    assert np.allclose(speed[500:], expected.y[0][500:], atol=2e-5)


@pytest.mark.heavy
def test_half_the_step_hardly_changes_the_inertia():
    """The sampling is the same; only the integration differs."""
    coarse = changed(QUIET, coulomb_nm=82.4, duration_s=10.0, kp_nm_s_rad=10000.0)
    fine = changed(coarse, sample_period_s=0.0005)
    one = torque_line(*(column for index, column in enumerate(simulate([coarse]).of(0)) if index != 1))
    other = torque_line(*(column[::2] for index, column in enumerate(simulate([fine]).of(0)) if index != 1))
    assert one.inertia_kg_m2 == pytest.approx(other.inertia_kg_m2, abs=0.02)


def test_noise_is_a_disturbance_of_the_shaft_seeded():
    noisy = changed(QUIET, noise_power_nm2_s=10.0, duration_s=1.0)
    silent = simulate([changed(noisy, noise_power_nm2_s=0.0)]).speed_rad_s
    one, same, other = (simulate([changed(noisy, seed=seed)]).speed_rad_s for seed in (1, 1, 2))
    assert np.array_equal(one, same)
    assert not np.array_equal(one, other)
    assert 0.0 < np.abs(one - silent).max() < 0.05


@pytest.mark.heavy
def test_runs_of_a_batch_need_the_same_number_of_samples():
    with pytest.raises(ValueError, match="same number"):
        simulate([QUIET, changed(QUIET, duration_s=2.0)])
    both = simulate([QUIET, changed(QUIET, duration_s=8.0, sample_period_s=0.002, frequency_hz=0.5)])
    assert both.simulated_s == pytest.approx(12.0)


@pytest.mark.heavy
def test_progress_runs_from_zero_towards_one():
    shares = []
    simulate([QUIET], shares.append)
    assert shares[0] == 0.0
    assert shares == sorted(shares)
    assert shares[-1] < 1.0


def test_references():
    time = np.linspace(0.0, 10.0, 10_001)
    assert np.allclose(SineReference(2.0, 0.5, 0.25).at(time), 2.0 + 0.5 * np.sin(0.5 * np.pi * time))
    step = StepReference(1.0, 3.0, 2.5).at(time)
    assert (step[2499], step[2500]) == (1.0, 3.0)
    chirp = ChirpReference(0.0, 2.0, 0.5, 2.0, 10.0)
    assert np.allclose(chirp.at(time), 2.0 * signal.chirp(time, 0.5, 10.0, 2.0, phi=-90.0), atol=1e-9)
    many = MultisineReference(3.0, 0.5, 0.1)
    assert np.abs(many.at(time) - 3.0).max() == pytest.approx(0.5, rel=1e-4)
    lines = np.abs(np.fft.rfft(many.at(time[:-1]) - 3.0))
    assert set(np.flatnonzero(lines > 1e-6 * lines.max())) == {1, 2, 3, 4}


@pytest.mark.heavy
def test_each_signal_by_name():
    kinds = {name: reference_of(changed(QUIET, signal=name)) for name in ("sine", "step", "chirp", "multisine")}
    assert [type(kind).__name__.lower() for kind in kinds.values()] == [f"{name}reference" for name in kinds]
    assert kinds["step"] == StepReference(QUIET.offset_rad_s, QUIET.offset_rad_s + 1.0, 0.25)
    assert kinds["chirp"].period_s is None
    for name in kinds:
        record = simulate([changed(QUIET, signal=name, duration_s=2.0)])
        assert np.all(np.isfinite(record.speed_rad_s))
