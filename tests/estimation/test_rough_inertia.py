"""Rough J from one change of speed, with reporting lags: within a fifth, with its own uncertainty."""

import numpy as np
import pytest
from scipy.signal import lfilter, lsim

from tdhil.estimation import RoughFriction, rough_friction, rough_inertia, rough_inertia_before_echo
from tdhil.recording.recording import Level
from tests.estimation.loaded_bench import STEP_S, Loaded, late, turned


def ramp(inertia=104.0, viscous=8.0, coulomb=60.0, speed_lag=0.4, torque_lag=0.15, seed=0, down=False, hold=5.0):
    """Return a speed ramp from 2 to 6 rad/s in 4 s between two holds, with the torque of the balance."""
    dt = 0.004
    time = np.arange(0.0, 2.0 * hold + 4.0, dt)
    u = np.clip((time - hold) / 4.0, 0.0, 1.0)
    speed = 2.0 + 4.0 * (0.5 - 0.5 * np.cos(np.pi * u))
    if down:
        speed = 8.0 - speed
    rng = np.random.default_rng(seed)
    keep = np.exp(-dt / 0.5)
    load = lfilter([1.0], [1.0, -keep], 3.0 * np.sqrt(1 - keep**2) * rng.standard_normal(len(time)))
    torque = inertia * np.gradient(speed, dt) + viscous * speed + coulomb - load

    def lagged(x, tau):
        return x[0] + lsim(([1.0], [tau, 1.0]), x - x[0], time)[1] if tau else x

    seen = np.round((lagged(speed, speed_lag) + 0.003 * rng.standard_normal(len(time))) / 0.0105) * 0.0105
    return time, seen, np.round(lagged(torque, torque_lag) + 2.0 * rng.standard_normal(len(time)))


@pytest.mark.long(but_first=4)
@pytest.mark.heavy
@pytest.mark.parametrize("down", [False, True])
@pytest.mark.parametrize("lags", [(0.4, 0.15), (0.0, 0.0), (0.5, 0.0), (0.15, 0.5)])
def test_within_a_fifth_for_any_lags(lags, down):
    errors, claimed = [], []
    for seed in range(20):
        signals = ramp(speed_lag=lags[0], torque_lag=lags[1], seed=seed, down=down)
        found = rough_inertia(*signals, Level(1.0, 5.0), Level(11.0, 14.0))
        errors.append(found.inertia_kg_m2 / 104.0 - 1.0)
        claimed.append(found.rel_error)
    assert np.max(np.abs(errors)) < 0.2
    assert np.mean(np.abs(errors) <= claimed) >= 0.9
    assert np.median(claimed) < 0.25


def test_friction_from_two_levels():
    found = rough_friction(*ramp(), Level(0.5, 5.0), Level(11.0, 14.0))
    assert found.viscous_nm_s_rad == pytest.approx(8.0, abs=2.0)
    assert found.coulomb_nm == pytest.approx(60.0, abs=8.0)


def test_without_data_there_is_no_result():
    time, speed, torque = ramp()
    assert rough_inertia(time, np.full_like(speed, 3.0), torque, Level(1.0, 5.0), Level(11.0, 14.0)) is None
    assert rough_inertia(time, speed, torque, Level(11.0, 14.0), Level(1.0, 5.0)) is None
    assert rough_inertia(time, speed, torque, Level(30.0, 31.0), Level(32.0, 33.0)) is None
    assert rough_inertia(time, speed, -torque, Level(1.0, 5.0), Level(11.0, 14.0)) is None
    nan = np.full_like(torque, np.nan)
    assert rough_inertia(time, speed, nan, Level(1.0, 5.0), Level(11.0, 14.0)) is None


def test_oscillating_operating_points_are_known_by_their_means():
    time, speed, torque = ramp(hold=24.0)
    swing = 1.45 * np.sin(2.0 * np.pi * time / 6.0 + 0.3)
    levels = Level(0.0, 24.0), Level(28.0, 52.0)
    assert rough_inertia(time, speed + swing, torque, *levels) is None
    found = rough_inertia(time, speed + swing, torque, *levels, swinging=True)
    assert found.inertia_kg_m2 == pytest.approx(104.0, rel=0.2)


@pytest.mark.parametrize("bottom", [60.0, 374.0])
def test_above_an_oscillating_string_the_time_before_the_echo_gives_j(bottom):
    """Six ramps above a bit with a scatter of 500 N·m give the motor inertia for any string."""
    plant, runs = Loaded(bit_noise_nm=500.0, bottom=bottom, hold=400.0, speed_lags_s=(0.02,)), 8
    echo_s = 2.0 * plant.pipe().delay_s
    time, starts = STEP_S * np.arange(2400), 6.0 + np.cumsum([0.0, 8.3, 6.2, 9.1, 7.7, 6.6])
    drive = sum(8000.0 * (-1.0) ** n * ((time >= at) & (time < at + 0.75 * echo_s)) for n, at in enumerate(starts))
    white, keep = np.random.default_rng(3).standard_normal((len(time), runs)), np.exp(-STEP_S / 0.3)
    noise = 500.0 * lfilter([np.sqrt(1.0 - keep**2)], [1.0, -keep], white, axis=0)
    speeds, torques = (late(one, lag) for one, lag in zip(turned(plant, drive, noise), (0.40, 0.15), strict=True))

    def found(run, ramps):
        seen = [(time, speeds[:, run], torques[:, run], at) for at in ramps]
        return rough_inertia_before_echo(seen, echo_s, 296.5, RoughFriction(20.0, 2500.0, 50.0))

    told = [found(run, starts) for run in range(runs)]
    assert all(abs(one.inertia_kg_m2 / plant.motor - 1.0) < max(0.35, one.rel_error) for one in told)
    assert np.mean([one.inertia_kg_m2 for one in told]) == pytest.approx(plant.motor, rel=0.2)
    assert all(0.3 <= one.rel_error < 0.8 for one in told)
    assert found(0, starts[:1]) is None


@pytest.mark.parametrize(
    ("viscous", "coulomb", "at_rad_s", "opposing"),
    [
        (8.0, 60.0, 5.0, (8.0, 60.0)),
        (-100.0, 5800.0, 20.0, (0.0, 3800.0)),     # falls with speed: the torque at this point for any speed
        (30.0, -60.0, 4.0, (15.0, 0.0)),           # drives at standstill
        (-100.0, 100.0, 4.0, (0.0, 0.0)),
        (0.0, -60.0, 4.0, (0.0, 0.0)),
    ],
)
def test_friction_that_would_drive_keeps_its_measured_torque(viscous, coulomb, at_rad_s, opposing):
    found = RoughFriction(viscous, coulomb, 1.0).opposing(at_rad_s)
    assert (found.viscous_nm_s_rad, found.coulomb_nm) == pytest.approx(opposing)
    assert found.level_sd_nm == 1.0
