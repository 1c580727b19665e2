"""Choice of the excitation: within limits, as requested, at least as good as the usual one, as good as predicted."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tdhil.estimation.frequency_domain.likelihood import Likelihood
from tdhil.estimation.frequency_domain.model import Model
from tdhil.estimation.frequency_domain.shafts import StringShaft
from tdhil.estimation.friction_levels import ViscousConstraint
from tdhil.estimation.samples import Samples
from tdhil.estimation.spectrum import SpectralLine
from tdhil.recording.recording import LagPrior
from tdhil.runner.design import (
    DesignKnowledge,
    NoiseDensity,
    assumed_noise,
    choose,
    expected_half_width,
    half_width,
    longer,
    measured_noise,
    predicted,
)
from tdhil.runner.design.prediction import assumed_theta
from tdhil.runner.excitation import MotionLimits, PlanRefused, PlanRequest, RigGuess, make_plan
from tdhil.runner.guard import Guard
from tdhil.runner.planning import plan_acquisition
from tdhil.runner.settings import ControlAssumptions, ExcitationRequest
from tdhil.runner.stages.speed import STRING_ERROR
from tdhil.studies.coverage.bound import density
from tdhil.studies.coverage.plants import FLEET

FORESIGHT_S = Guard.foresight_s(ControlAssumptions())
PLANTS = {plant.name: plant for plant in FLEET}
LIMITS = MotionLimits(0.5, 10.0, 400.0, FORESIGHT_S)
GUESS = RigGuess(104.0, 8.0, 60.0)
KNOWN = DesignKnowledge(assumed_noise(400.0, 10.0), LagPrior())


def machine(plant):
    limits = MotionLimits(*plant.window_rad_s, plant.torque_limit_nm, FORESIGHT_S)
    return limits, RigGuess(plant.inertia_kg_m2, plant.viscous_nm_s_rad, plant.coulomb_nm)


def true_noise(plant):
    noise = plant.noise
    return NoiseDensity(2.0 * noise.load_nm**2 * noise.load_time_s, noise.sensor_rad_s**2 * plant.step_s,
                        noise.load_time_s)


# -- noise ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["field", "paper", "heavy"])
def test_the_error_s_density_is_the_one_that_follows_from_the_plant(name):
    plant = PLANTS[name]
    stated = LagPrior(plant.speed_report.total_delay_s, 0.0, plant.torque_report.total_delay_s, 0.0)
    theta = assumed_theta(plant.inertia_kg_m2, plant.viscous_nm_s_rad, stated)
    hertz = np.array([0.05, 0.1, 0.2, 0.4])
    assert true_noise(plant).error_density(hertz, theta) == pytest.approx(density(plant, hertz), rel=0.2)


def steady_stretch(seed, speed, load_sd, seconds=6.0, step_s=0.004):
    """Return a record of a shaft under PI speed control with a slowly varying load, and reports without lag."""
    rng = np.random.default_rng(seed)
    inertia, viscous, coulomb = 104.0, 8.0, 60.0
    keep, load, integral, omega = np.exp(-step_s / 0.5), load_sd * rng.standard_normal(), 0.0, speed
    rows = []
    for step in range(round((seconds + 10.0) / step_s)):
        error = speed - omega
        integral += 300.0 * error * step_s
        torque = coulomb + viscous * speed + 300.0 * error + integral
        load = keep * load + load_sd * np.sqrt(1.0 - keep**2) * rng.standard_normal()
        omega += step_s / inertia * (torque + load - coulomb - viscous * omega)
        rows.append((step * step_s, omega, torque))
    return Samples(*np.array(rows[-round(seconds / step_s) :]).T)


@pytest.mark.heavy
def test_the_noise_is_measured_at_steady_speed():
    fallback = assumed_noise(400.0, 10.0)
    theta = assumed_theta(104.0, 8.0, LagPrior(0.0, 0.0, 0.0, 0.0))
    found = [
        measured_noise((steady_stretch(seed, 3.0, 5.0), steady_stretch(seed + 100, 7.0, 5.0)), theta, fallback)
        for seed in range(16)
    ]
    assert {one.source for one in found} == {"measured"}
    assert np.mean([one.load_nm2_s for one in found]) == pytest.approx(2.0 * 25.0 * 0.5, rel=0.3)
    assert measured_noise((), theta, fallback) is fallback
    silent = Samples(np.arange(1500) * 0.004, np.full(1500, 3.0), np.full(1500, 84.0))
    assert measured_noise((silent,), theta, fallback).load_nm2_s > 0.0       # the estimate of the noise is never zero


# -- the choice ----------------------------------------------------------------------------------------------


@pytest.mark.heavy
@pytest.mark.parametrize("name", ["servo", "heavy"])
def test_the_chosen_motion_is_within_limits_and_has_a_smaller_predicted_uncertainty(name):
    plant = PLANTS[name]
    limits, guess = machine(plant)
    known = DesignKnowledge(true_noise(plant), LagPrior())
    usual, chosen = make_plan(limits, guess), choose(limits, guess, PlanRequest(), known, 0.95)
    plan = chosen.plan
    assert plan.duration_s <= 1.02 * usual.duration_s
    assert chosen.half_width < 0.96 * chosen.usual_half_width
    assert max(plan.segments[0].reference.lines_hz) <= 0.6 + 1e-9     # 0.24/τ: higher, and unknown filters matter
    times = np.linspace(0.0, plan.segments[0].reference.period_s, 800)
    for segment in plan.segments:
        speed, torque = np.array([segment.reference.reference(t) for t in times]).T
        swing = (speed - segment.reference.offset_rad_s) / (1.0 - guess.inertia_rel_error)
        assert segment.reference.offset_rad_s + swing.min() > limits.speed_low_rad_s
        assert segment.reference.offset_rad_s + swing.max() < limits.speed_high_rad_s
        assert np.abs(torque).max() <= 0.85 * limits.torque_limit_nm * (1.0 + 1e-6)


@pytest.mark.heavy
def test_the_choice_is_reproducible_and_predicts_the_uncertainty_of_the_estimator():
    first, again = (choose(LIMITS, GUESS, PlanRequest(), KNOWN, 0.95) for _ in range(2))
    assert first == again
    assert first.half_width < first.usual_half_width
    theta = KNOWN.theta(GUESS)
    assert first.half_width == expected_half_width(first.plan, theta, KNOWN.noise, KNOWN.prior, 0.95)
    quieter = replace(KNOWN.noise, load_nm2_s=KNOWN.noise.load_nm2_s / 4.0, speed_rad2_s=KNOWN.noise.speed_rad2_s / 4.0)
    assert expected_half_width(first.plan, theta, quieter, KNOWN.prior, 0.95) < 0.6 * first.half_width


@pytest.mark.heavy
def test_stated_lags_tighten_what_is_expected_and_move_the_lines():
    stated = DesignKnowledge(KNOWN.noise, LagPrior(0.02, 0.002, 0.01, 0.001, "rig.yaml"))
    chosen = choose(LIMITS, GUESS, PlanRequest(), stated, 0.95)
    assert chosen.half_width < 0.7 * choose(LIMITS, GUESS, PlanRequest(), KNOWN, 0.95).half_width


@pytest.mark.heavy(but_first=2)
@pytest.mark.parametrize(
    "wish",
    [
        PlanRequest(frequency_hz=0.2),
        PlanRequest(periods=9),
        PlanRequest(kind="step"),
        PlanRequest(kind="sine", frequency_hz=0.3),
    ],
)
def test_values_that_the_user_states_are_kept(wish):
    assert choose(LIMITS, GUESS, wish, KNOWN, 0.95).plan == make_plan(LIMITS, GUESS, wish)


@pytest.mark.heavy
def test_amplitude_and_offset_are_kept_while_the_lines_are_chosen():
    wish = PlanRequest(amplitude_rad_s=0.8, offsets_rad_s=(3.0, 6.5))
    plan = choose(LIMITS, GUESS, wish, KNOWN, 0.95).plan
    assert [segment.reference.offset_rad_s for segment in plan.segments] == [3.0, 6.5]
    for segment in plan.segments:
        speeds = [segment.reference.reference(t)[0] for t in np.linspace(0.0, segment.reference.period_s, 2000)]
        assert np.abs(np.array(speeds) - segment.reference.offset_rad_s).max() == pytest.approx(0.8, rel=2e-3)


@pytest.mark.heavy
def test_the_time_allowed_is_kept():
    for time_s in (120.0,):
        plan = choose(LIMITS, GUESS, PlanRequest(), KNOWN, 0.95, time_s).plan
        assert 0.8 * time_s < plan.duration_s <= time_s
        assert all(segment.periods - segment.settle_periods >= 6 for segment in plan.segments)
    with pytest.raises(PlanRefused, match="time"):
        choose(LIMITS, GUESS, PlanRequest(), KNOWN, 0.95, 40.0)


@pytest.mark.heavy
def test_with_a_tolerance_the_plan_that_meets_it_soonest_is_taken():
    asked, left_s = ExcitationRequest(tolerance=0.01), 900.0
    planned = plan_acquisition(asked, "torque", LIMITS, GUESS, KNOWN, left_s)
    assert planned.stopping.reachable
    assert planned.plan.duration_s < 0.7 * make_plan(LIMITS, GUESS).duration_s
    assert {one.periods - one.settle_periods for one in planned.plan.segments} == {planned.stopping.pilot_periods}
    assert all(one.settle_periods * one.reference.period_s >= 8.0 for one in planned.plan.segments)
    fixed = plan_acquisition(replace(asked, frequency_hz=0.2), "torque", LIMITS, GUESS, KNOWN, left_s).plan
    assert fixed.segments[0].reference.lines_hz[0] == pytest.approx(0.2)


# -- with a drill string --------------------------------------------------------------------------------------


STRING_LIMITS = MotionLimits(0.5, 10.0, 4000.0, FORESIGHT_S)
STRING_GUESS = RigGuess(1950.0, 23.0, 100.0, STRING_ERROR)


def hung(**options):
    return replace(KNOWN, has_drill_string=True), PlanRequest(**options)


def test_with_a_string_lines_of_equal_torque_span_its_first_two_resonances():
    known, wish = hung()
    chosen, usual = choose(STRING_LIMITS, STRING_GUESS, wish, known, 0.95), make_plan(STRING_LIMITS, STRING_GUESS)
    assert math.isnan(chosen.half_width)
    assert chosen.plan.duration_s < 1.05 * usual.duration_s
    reference = chosen.plan.segments[0].reference
    torques = np.array(reference.lines_hz) * np.array(reference.amplitudes_rad_s)
    assert torques == pytest.approx(torques[0])
    assert reference.lines_hz[0] < 0.1 and reference.lines_hz[-1] > 0.75
    assert motor_sd(chosen.plan) < 0.2 * motor_sd(usual)


def test_with_a_string_a_number_of_periods_does_not_change_the_lines():
    known, wish = hung(periods=5)
    plan = choose(STRING_LIMITS, STRING_GUESS, wish, known, 0.95).plan
    planned = choose(STRING_LIMITS, STRING_GUESS, replace(wish, periods=None), known, 0.95).plan
    assert plan.segments[0].reference.lines_hz == planned.segments[0].reference.lines_hz
    assert {one.periods for one in plan.segments} == {5}


def motor_sd(plan):
    """Return the lower bound of the deviation of J_r for the shipped string, per unit of noise.

    The reports pass through filters with two poles and averages.
    """
    shaft, m = StringShaft(), np.array([1500.0, 23.5, 588.5, 0.959, 1e-3, 15.5, 0.3645, 0.74])
    reference = plan.segments[0].reference
    hertz = np.array(reference.lines_hz)
    s, phi = 2j * np.pi * hertz, np.array([0.4, 0.0, 0.15, 0.0, 0.0, 0.0])
    g = Model(shaft).impedance(np.concatenate([m, phi]), s)
    pushed = 2.0 * np.pi * hertz * 1950.0 * np.array(reference.amplitudes_rad_s)
    speed = pushed / shaft.impedance(m, s) / (1.0 + 0.4 * s)
    counts = np.array([float(one.periods - one.settle_periods) for one in plan.segments])
    variance = 4.0 * 20.0 * plan.segments[0].reference.period_s**-1.0
    lines = tuple(
        SpectralLine(hz, np.full(2, w), np.full(2, gain * w), counts, variance / abs(gain) ** 2, 0.0, 0j,
                     counts.sum() - 2.0)
        for hz, w, gain in zip(hertz, speed, g, strict=True)
    )
    problem = Likelihood(lines, Model(shaft), ViscousConstraint(23.5, 0.0, 1.0, 20.0), ())
    whole, _ = problem.information(np.concatenate([m, phi]))
    sure = np.array([0.0] * 6 + [0.5, 0.5, 0.0, 0.5, 0.0, 0.5, 0.0, 0.0])      # at the bounds of shares and shapes
    whole += np.diag(np.where(sure > 0.0, 1.0 / np.maximum(sure, 1e-9) ** 2, 0.0))
    scale = 1.0 / np.sqrt(np.diag(whole))
    return float(np.sqrt(np.linalg.inv(whole * np.outer(scale, scale))[0, 0]) * scale[0])


@pytest.mark.heavy
def test_with_a_string_stated_values_are_kept_and_too_little_time_gives_the_usual_choice():
    known, wish = hung(frequency_hz=0.2)
    assert choose(STRING_LIMITS, STRING_GUESS, wish, known, 0.95).plan == make_plan(STRING_LIMITS, STRING_GUESS, wish)
    known, wish = hung()
    plan = choose(STRING_LIMITS, STRING_GUESS, wish, known, 0.95, 120.0).plan
    assert plan.duration_s <= 120.0


def test_a_string_s_tolerance_keeps_its_lines_and_promises_nothing():
    known, _ = hung()
    planned = plan_acquisition(ExcitationRequest(tolerance=0.01), "torque", STRING_LIMITS, STRING_GUESS, known, 900.0)
    assert planned.plan.segments[0].reference.lines_hz[0] == pytest.approx(0.08)
    assert math.isnan(planned.half_width)
    assert planned.stopping.by_interval
    assert planned.plan == choose(STRING_LIMITS, STRING_GUESS, PlanRequest(), known, 0.95).plan
    assert "not predicted" in planned.said()


def test_without_braking_torque_the_motion_needs_none():
    bitten = RigGuess(1950.0, 50.0, 1000.0, STRING_ERROR)
    free, held = (make_plan(limits, bitten, PlanRequest(offsets_rad_s=(4.0, 6.0)))
                  for limits in (STRING_LIMITS, replace(STRING_LIMITS, least_torque_nm=1000.0)))
    assert free.torque_min_nm < 1000.0
    assert held.torque_min_nm == pytest.approx(1000.0)


@pytest.mark.heavy
def test_longer_at_the_last_mean_speed_alone():
    plan = make_plan(LIMITS, GUESS)
    evidence = predicted(plan, KNOWN.theta(GUESS), KNOWN.noise, KNOWN.prior)
    alone, both = longer(evidence, 1.5, at_last=True), longer(evidence, 1.5)
    for line, one, other in zip(evidence.lines, alone.lines, both.lines, strict=True):
        assert (one.periods[0], one.nu) == (line.periods[0], other.nu)
        assert np.sum(one.periods) == pytest.approx(np.sum(other.periods))
    assert alone.levels.duration[0] == evidence.levels.duration[0]
    assert half_width(both, 0.95) <= half_width(alone, 0.95) < half_width(evidence, 0.95)
