"""Friction over speed: every point covers, and nonlinear friction is found if present and rarely if absent."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom

from sim_bus.inverter import Inverter
from sim_bus.params import DriveParams, RigParams
from sim_bus.plant.rigid import Params
from sim_bus.plant.two_mass import TwoMassParams
from tdhil.estimation import Options
from tdhil.estimation.cross_checks.friction_by_speed import FrictionCurve, Inertia, friction_curve
from tdhil.estimation.cross_checks.momentum_fit import Delay
from tdhil.estimation.friction_levels import Levels, measure_levels
from tdhil.estimation.samples import stretches, usable_samples
from tdhil.estimation.spectrum import period_lines
from tests.estimation.reporting import recorded
from tests.estimation.stages_bench import usual_runs

pytestmark = pytest.mark.one_worker("friction")     # both use the same runs

KNOWN = Inertia(104.0, 0.3, Delay(0.25, 0.02, True))
STRIBECK = Params(friction="stribeck", static_nm=100.0, stribeck_speed_rad_s=3.0)
SPEEDS = (2.0, 3.0, 4.5, 6.0, 8.0)


def held(plant, seed, speeds=SPEEDS, hold_s=14.0, drive=None):
    """Return the 100 Hz reports of the simulated drive in speed mode at one speed after the other."""
    inverter = Inverter(RigParams(plant=plant, drive=drive or DriveParams()), np.random.default_rng(seed))
    rows, now = [], 0.0
    count, step = inverter.steps(0.01)
    for speed in speeds:
        inverter.control.speed(speed, 1.5, 1.5)
        for _ in range(round(hold_s / 0.01)):
            for _ in range(count):
                inverter.step(step)
            now += 0.01
            rows.append((now, inverter.reporting.speed_rad_s, inverter.reporting.torque_nm))
    return recorded(*np.array(rows).T.copy())


def curve_of(recording, density=9.0, dof=18.0, inertia=KNOWN):
    known = Levels(np.array([3.0, 7.0]), np.zeros(2), np.zeros(2), np.full(2, 100.0), density, dof)
    return friction_curve(recording, usable_samples(recording), known, inertia, Options())


def true_friction(plant, speed):
    extra = (plant.static_nm - plant.coulomb_nm) * np.exp(-((speed / plant.stribeck_speed_rad_s) ** 2))
    return plant.coulomb_nm + plant.viscous_nm_s_rad * speed + (extra if plant.friction == "stribeck" else 0.0)


@pytest.mark.heavy
@pytest.mark.parametrize(("plant", "bends"), [(Params(), False), (STRIBECK, True)])
def test_points_cover_and_nonlinear_friction_is_reported(plant, bends):
    covered = points = bent = 0
    for seed in range(12):
        curve = curve_of(held(plant, seed))
        bent += curve.bent
        speeds = [point.speed_rad_s for point in curve.points]
        assert speeds == sorted(speeds)
        assert np.allclose(speeds, SPEEDS, atol=0.1)
        points += len(speeds)
        covered += sum(p.torque_nm.low <= true_friction(plant, p.speed_rad_s) <= p.torque_nm.high
                       for p in curve.points)
        assert bool(curve.warnings) is curve.bent
    assert covered >= binom.ppf(0.005, points, 0.95)
    assert bent >= 11 if bends else bent <= 1


@pytest.mark.heavy
def test_a_load_that_still_oscillates_does_not_make_friction_nonlinear():
    """At the ends of a stretch the load of two masses has another speed than the motor, for half a minute."""
    two, drive = TwoMassParams(), DriveParams(torque_limit_nm=8000.0, speed_gain_nm_s_rad=3000.0,
                                              speed_integral_gain_nm_rad=2000.0)
    whole = replace(KNOWN, value=two.inertia_kg_m2 + two.bottom.inertia_kg_m2, sd=2.0)
    swing_s = 2.0 * np.pi * (two.bottom.inertia_kg_m2 / two.stiffness_nm_rad) ** 0.5
    for seed in range(2):
        recording = held(two, seed, (2.5, 4.0, 6.0, 8.0), 20.0, drive)
        assert curve_of(recording, 30.0, inertia=whole).bent
        curve = curve_of(recording, 30.0, inertia=replace(whole, swing_s=swing_s))
        assert not curve.bent and len(curve.points) == 4


@pytest.mark.heavy
def test_the_spread_of_the_slope_agrees_with_the_nonlinear_friction():
    """Between 3 and 7 rad/s, the secant is compared with both local slopes, from the formula of the plant."""
    step = 1e-4
    ends = (3.0, 7.0)
    slopes = [(true_friction(STRIBECK, w + step) - true_friction(STRIBECK, w - step)) / (2.0 * step) for w in ends]
    chord = (true_friction(STRIBECK, 7.0) - true_friction(STRIBECK, 3.0)) / 4.0
    worst = max(abs(slope - chord) for slope in slopes)
    found = np.mean([curve_of(held(STRIBECK, seed)).viscous_spread_nm_s_rad for seed in range(6)])
    assert 0.4 * worst < found < 2.5 * worst


@pytest.mark.long
@pytest.mark.heavy
def test_on_a_whole_run_every_point_covers_and_linear_friction_stays_linear():
    covered = points = bent = 0
    for recording in usual_runs()[:100]:
        samples = usable_samples(recording)
        cut = stretches(samples, recording.excitation.segments)
        fits = tuple(period_lines(stretch, samples) for stretch in cut)
        levels = measure_levels(cut, fits, samples, recording.levels, 104.0)
        curve = friction_curve(recording, samples, levels, KNOWN, Options())
        assert len(curve.points) >= 4
        points += len(curve.points)
        covered += sum(p.torque_nm.low <= 60.0 + 8.0 * p.speed_rad_s <= p.torque_nm.high for p in curve.points)
        bent += curve.bent
    assert covered / points >= 0.93           # points of one run share its noise density and are not independent
    assert bent <= binom.ppf(0.999, 100, 0.01)


def test_two_speeds_are_no_curve():
    curve = curve_of(held(Params(), 1, (2.0, 6.0)))
    assert curve == FrictionCurve((), None, False, 0.0)
    assert curve.warnings == ()


def test_without_scatter_there_are_no_intervals_and_no_points():
    short = held(Params(), 1, (2.0, 4.0, 6.0), 7.0)
    assert curve_of(short, density=0.0, dof=0.0).points == ()
    assert curve_of(short, density=0.0).points == ()
    assert len(curve_of(short).points) == 3
