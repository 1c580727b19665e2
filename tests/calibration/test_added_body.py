"""Torque calibration by bodies of known inertia: the factor, the budget, and every possible error."""

import re
from dataclasses import replace
from math import hypot, sqrt
from types import SimpleNamespace

import numpy as np
import pytest

from profiles import MessageCode
from tdhil.calibration import BodyRun, CalibrationCase, calibrate_torque, plan_bodies
from tdhil.errors import UsageError
from tdhil.estimation import Verdict, worst_share
from tdhil.recording import Stage, SteppedSetpoint
from tdhil.session import find_calibration, find_plan
from tests.calibration.bodies import IDENTITY, INERTIA, SCALE, recording, run, two

FACTOR = 1.0 / SCALE


def case(values, bodies, noise=0.002, sds=None, **more):
    values = np.asarray(values, dtype=float)
    covariance = np.diag((noise * values) ** 2)
    runs = tuple(BodyRun(f"run {k}", body, 0.0 if sds is None else sds[k]) for k, body in enumerate(bodies))
    return CalibrationCase(runs, values, covariance, covariance, 50.0, None, **more)


@pytest.mark.heavy
def test_the_factor_and_the_inertia_of_two_runs(tmp_path):
    found = find_calibration(two(tmp_path), "motor").calibration
    assert found.verdict is Verdict.VALID
    assert found.factor.low <= FACTOR <= found.factor.high and found.factor.half_width_share < 0.02
    assert found.inertia_kg_m2.low <= INERTIA <= found.inertia_kg_m2.high
    assert found.inertia_kg_m2.value == pytest.approx(INERTIA, rel=0.01)
    for quantity, name in ((found.factor, "of_factor"), (found.inertia_kg_m2, "of_inertia")):
        squares = sqrt(sum(getattr(line, name) ** 2 for line in found.budget))
        assert squares * quantity.value == pytest.approx(quantity.standard_uncertainty, rel=1e-6)


def test_the_difference_of_two_runs_follows_the_closed_formulas():
    found = calibrate_torque(case([100.0, 150.0], [0.0, 52.0], sds=[0.0, 0.1]))
    assert found.factor.value == pytest.approx(52.0 / 50.0)
    assert found.inertia_kg_m2.value == pytest.approx(52.0 * 100.0 / 50.0)
    share = hypot((1.0 + 104.0 / 52.0) * sqrt(2.0) * 0.002, 0.1 / 52.0)
    assert found.inertia_kg_m2.standard_uncertainty == pytest.approx(104.0 * share, rel=1e-9)


@pytest.mark.parametrize(("stated", "scale_rel_sd", "warned"), [(62.7, 0.02, True), (62.7, 0.08, False),
                                                                (56.0, 0.02, False), (50.0, 0.02, True)])
def test_a_body_that_contradicts_the_stated_torque_scale_gives_a_warning(stated, scale_rel_sd, warned):
    """The body has 55 kg·m². A factor of 1.14 with a scale of ±4 % was valid without a warning."""
    found = calibrate_torque(case([104.0, 159.0], [0.0, stated], noise=5e-4, scale_rel_sd=scale_rel_sd))
    assert found.verdict is Verdict.VALID
    assert [one.entry for one in found.warnings] == [MessageCode.FACTOR_UNLIKE_SCALE] * warned
    if stated == 62.7 and warned:
        assert found.warnings == ("the factor differs from 1 by 14 %, and the stated torque scale allows ±4.0 %."
                                  " Check the inertia of the body, or the stated scale",)


@pytest.mark.heavy
def test_three_bodies_are_tested_for_a_straight_line(tmp_path):
    runs = [*two(tmp_path), run(tmp_path, "more.mcap", 110.0, recording(110.0, 3))]
    straight = find_calibration(runs, "motor").calibration
    assert straight.verdict is Verdict.VALID and straight.linearity.p_value > 0.01
    runs[2] = replace(runs[2], added_kg_m2=120.0)
    bent = find_calibration(runs, "motor").calibration
    assert bent.verdict is Verdict.MODEL_REJECTED and "straight line" in bent.reason


@pytest.mark.heavy
def test_bodies_that_were_exchanged(tmp_path):
    without, loaded = two(tmp_path)
    exchanged = [replace(loaded, added_kg_m2=0.0), replace(without, added_kg_m2=55.0)]
    found = find_calibration(exchanged, "motor").calibration
    assert found.factor is None and "exchanged" in found.reason


@pytest.mark.long(but_first=1)
@pytest.mark.heavy
@pytest.mark.parametrize(("said", "at", "advice"), [(55.0 * 16.0, "motor", "--at main"), (55.0, "main", "--at motor")])
def test_an_inertia_given_at_the_wrong_shaft(tmp_path, said, at, advice):
    geared = [replace(one, record=replace(one.record, recording=replace(one.record.recording, gear_ratio=4.0)))
              for one in two(tmp_path, said=said)]
    found = find_calibration(geared, at).calibration
    assert found.verdict is not Verdict.VALID and found.factor is None
    assert advice in found.advice or "too small" in found.reason


@pytest.mark.heavy
def test_an_inertia_given_at_the_main_shaft(tmp_path):
    geared = [replace(one, record=replace(one.record, recording=replace(one.record.recording, gear_ratio=4.0)))
              for one in two(tmp_path, said=55.0 * 16.0)]
    assert find_calibration(geared, "main").calibration.factor.value == pytest.approx(FACTOR, rel=0.02)


@pytest.mark.long(but_first=1)
@pytest.mark.heavy
@pytest.mark.parametrize("changed", [{"speed_lag": 0.30}, {"torque_lag": 0.25}, {"skew": 0.05}])
def test_a_filter_that_changed_between_the_runs(tmp_path, changed):
    found = find_calibration(two(tmp_path, with_body=recording(55.0, 2, **changed)), "motor").calibration
    assert found.verdict is Verdict.MODEL_REJECTED and found.factor is None
    assert "do not share the filters" in found.reason and ("lag of" in found.reason or "offset" in found.reason)


def test_a_log_of_another_drive(tmp_path):
    without, loaded = two(tmp_path)
    other = run(tmp_path, "other.mcap", 55.0, loaded.record.recording, identity={**IDENTITY, "serial": 23})
    with pytest.raises(UsageError, match="serial is 23"):
        find_calibration([without, other], "motor")


def test_a_setting_that_changed_between_the_runs(tmp_path):
    without, loaded = two(tmp_path)
    bench = {"drive_data": {"rated_torque_nm": 900.0}}
    first = run(tmp_path, "a.mcap", 0.0, without.record.recording, bench={"drive_data": {"rated_torque_nm": 1000.0}})
    with pytest.raises(UsageError, match="rated_torque_nm"):
        find_calibration([first, run(tmp_path, "b.mcap", 55.0, loaded.record.recording, bench=bench)], "motor")


@pytest.mark.heavy
def test_friction_may_grow_with_the_body(tmp_path):
    grown = recording(55.0, 2, viscous=10.4, coulomb=78.0)
    found = find_calibration(two(tmp_path, with_body=grown), "motor").calibration
    assert found.verdict is Verdict.VALID and found.factor.low <= FACTOR <= found.factor.high


@pytest.mark.heavy
def test_a_run_that_was_aborted(tmp_path):
    without, loaded = two(tmp_path)
    ended = replace(loaded.record.recording, stages=(Stage("acquire", 0.0, 100.0, "aborted", "limit hit"),))
    aborted = replace(loaded, record=replace(loaded.record, recording=ended))
    found = find_calibration([without, aborted], "motor").calibration
    assert found.verdict is Verdict.NOT_IDENTIFIABLE and "aborted in stage acquire" in found.reason
    cut = replace(loaded, record=replace(loaded.record, recording=replace(loaded.record.recording, complete=False)))
    assert "ends before the run" in find_calibration([without, cut], "motor").calibration.reason


@pytest.mark.long(but_first=1)
@pytest.mark.heavy
@pytest.mark.parametrize("slip_nm_s_rad", [60.0, 300.0])
def test_a_body_that_slips_on_the_shaft(tmp_path, slip_nm_s_rad):
    """The coupling is viscous friction only. At low frequencies the body follows the shaft, at high ones not."""
    s = 2j * np.pi * np.array([0.1, 0.2, 0.3, 0.4])
    body = 55.0 * s * slip_nm_s_rad / (55.0 * s + slip_nm_s_rad)
    plain = recording(0.0, 2)
    torque = plain.torque_nm.copy()
    for segment in plain.excitation.segments:
        inside = (plain.time_s >= segment.start_s) & (plain.time_s < segment.end_s)
        t = plain.time_s[inside] - segment.start_s
        for k, (amplitude, phase) in enumerate(zip(segment.amplitudes_rad_s, segment.phases_rad, strict=True)):
            through = body[k] * (1 + 0.4 * s[k]) / (1 + 0.15 * s[k])
            torque[inside] += SCALE * (through * amplitude * np.exp(1j * phase + s[k] * t)).real
    found = find_calibration(two(tmp_path, with_body=replace(plain, torque_nm=torque)), "motor").calibration
    assert found.verdict is not Verdict.VALID and found.factor is None


@pytest.mark.heavy
def test_a_body_that_is_too_small_is_refused_with_the_required_inertia(tmp_path):
    small = two(tmp_path, 3.0, with_body=recording(3.0, 2, noise=20.0))
    small[0] = run(tmp_path, "noisy.mcap", 0.0, recording(0.0, 1, noise=20.0))
    found = find_calibration(small, "motor").calibration
    assert found.verdict is Verdict.NOT_IDENTIFIABLE and "too small" in found.reason
    least = found.least_added_kg_m2
    (advised,) = re.findall(r"a body of ([\d.]+) kg·m² or more", found.advice)
    assert 3.0 < least < 200.0 and least <= float(advised) < 1.01 * least        # never rounded down


def test_the_same_log_twice(tmp_path):
    without, _ = two(tmp_path)
    with pytest.raises(UsageError, match="same recording"):
        find_calibration([without, replace(without, added_kg_m2=55.0)], "motor")


@pytest.mark.heavy
def test_an_uncertainty_that_is_not_stated_is_assumed_and_reported(tmp_path):
    runs = two(tmp_path)
    runs[1] = replace(runs[1], added_sd_kg_m2=None)
    found = find_calibration(runs, "motor")
    assert any("standard uncertainty of the body" in warning for warning in found.warnings)
    assert any(line.source.startswith("body") for line in found.calibration.budget)


def test_the_plan_states_body_and_duration(tmp_path):
    without, _ = two(tmp_path)
    inertia, minutes, plans = find_plan(without.record, 0.01)
    assert inertia == pytest.approx(SCALE * INERTIA, rel=0.02) and minutes == pytest.approx(140.0 / 60.0)
    widths = [plan.half_width_share for plan in plans]
    assert widths == sorted(widths, reverse=True)
    twice = plan_bodies(100.0, 0.002, 4.0, 0.02, 0.0, sizes=(50.0,))[0]
    assert twice.half_width_share == pytest.approx(1.95996 * 3.0 * sqrt(2.0) * 0.002, rel=1e-5)
    assert twice.minutes == pytest.approx(4.0 * (twice.half_width_share / 0.02) ** 2)


@pytest.mark.heavy
def test_intervals_cover_as_often_as_stated():
    rng, covered, many = np.random.default_rng(4), np.zeros(2, dtype=int), 2000
    for _ in range(many):
        true = np.array([104.0, 156.0]) / 0.96
        made = case(true * (1.0 + 0.003 * rng.standard_normal(2)), [0.0, 52.0], 0.003)
        body = BodyRun("run 1", 52.0 + 0.2 * rng.standard_normal(), 0.2)
        found = calibrate_torque(replace(made, runs=(made.runs[0], body), degrees_of_freedom=1e6))
        covered += [found.factor.low <= 0.96 <= found.factor.high,
                    found.inertia_kg_m2.low <= 104.0 <= found.inertia_kg_m2.high]
    assert np.all(covered > 0.935 * many) and np.all(covered < 0.965 * many)


@pytest.mark.parametrize("runs", [1, 3, 9])
def test_repeated_mounting_does_not_reduce_the_uncertainty_of_a_body(runs):
    """All runs with the body share its error: 1 % of the body gives 1 % of κ."""
    bodies = [0.0] * runs + [55.0] * runs
    values = [104.0 + body for body in bodies]
    found = calibrate_torque(case(values, bodies, noise=1e-4, sds=[0.0] * runs + [0.55] * runs))
    assert found.factor.standard_uncertainty >= 0.01 * found.factor.value
    of_body = [line for line in found.budget if line.source.startswith("body of")]
    assert len(of_body) == 1 and of_body[0].of_factor == pytest.approx(0.01, rel=1e-3)
    squares = sqrt(sum(line.of_factor**2 for line in found.budget))
    assert squares * found.factor.value == pytest.approx(found.factor.standard_uncertainty, rel=1e-6)


@pytest.mark.parametrize("bodies", [2, 5])
def test_more_bodies_do_not_reduce_the_error_that_they_share(bodies):
    """One balance and one gauge measure all bodies: 1 % of each is 1 % of κ. It was 0.45 % with five bodies."""
    added = [0.0, *(55.0 * (k + 1) for k in range(bodies))]
    found = calibrate_torque(case([104.0 + body for body in added], added, noise=1e-4, sds=[0.01 * b for b in added]))
    assert found.factor.standard_uncertainty >= 0.01 * found.factor.value
    (line,) = (line for line in found.budget if line.source.startswith("bodies of run 1, run 2"))
    assert line.of_factor == pytest.approx(0.01, rel=1e-3)
    squares = sqrt(sum(line.of_factor**2 for line in found.budget))
    assert squares * found.factor.value == pytest.approx(found.factor.standard_uncertainty, rel=1e-6)


def test_a_body_has_an_own_error_beyond_the_shared_one():
    found = calibrate_torque(case([104.0, 159.0, 214.0], [0.0, 55.0, 110.0], noise=1e-4, sds=[0.0, 0.11, 1.1]))
    lines = {line.source: line.standard_uncertainty_kg_m2 for line in found.budget if line.source.startswith("bod")}
    assert lines == {"bodies of run 1, run 2": pytest.approx(0.22), "body of run 2, own error": pytest.approx(
        sqrt(1.1**2 - 0.22**2))}
    squares = sqrt(sum(line.of_inertia**2 for line in found.budget))
    assert squares * found.inertia_kg_m2.value == pytest.approx(found.inertia_kg_m2.standard_uncertainty, rel=1e-6)


def test_a_common_relative_error_is_in_the_factor_and_cancels_in_j():
    """With torque read in step with a speed setpoint, J of each run has the same relative error."""
    plain = calibrate_torque(case([104.0, 159.0], [0.0, 55.0]))
    found = calibrate_torque(case([104.0, 159.0], [0.0, 55.0], reading_rel_sd=0.02))
    assert found.inertia_kg_m2 == plain.inertia_kg_m2
    assert found.factor.standard_uncertainty == pytest.approx(
        sqrt(plain.factor.standard_uncertainty**2 + (0.02 * found.factor.value) ** 2), rel=1e-9)
    squares = sqrt(sum(line.of_factor**2 for line in found.budget))
    assert squares * found.factor.value == pytest.approx(found.factor.standard_uncertainty, rel=1e-6)


@pytest.mark.heavy
def test_runs_in_step_with_a_setpoint_have_this_error_in_the_factor(tmp_path):
    stepped = SteppedSetpoint(1.0 / 15.0, 0.9, 1.0, 0.35)
    runs = [replace(one, record=replace(one.record, recording=replace(one.record.recording, stepped_setpoint=stepped)))
            for one in two(tmp_path)]
    found = find_calibration(runs, "motor")
    (line,) = (line for line in found.calibration.budget if line.source == "moment of reading")
    worst = max(worst_share(stepped, one.torque_lag_s.low) for one in found.identified)
    assert line.of_factor == pytest.approx(worst / sqrt(3.0)) and line.of_factor > 0.001 and line.of_inertia == 0.0


@pytest.mark.parametrize("other", [
    {"model": "rigid+lags, bent friction"}, {"harmonics": ("one",)}, {"backlash": ("one",)},
])
def test_runs_of_compliant_shafts_or_nonlinear_friction_are_not_fitted_together(other, monkeypatch):
    from tdhil.session import torque_calibration

    plain = SimpleNamespace(model="rigid+lags", harmonics=(), backlash=(),
                            inertia=SimpleNamespace(value=104.0, low=103.0, high=105.0, confidence=0.95))
    fitted = SimpleNamespace(inertia_kg_m2=1, covariance=1, covariance_known_filters=1, degrees_of_freedom=1, sharing=1)
    monkeypatch.setattr("tdhil.estimation.identify_together", lambda recordings: fitted)
    assert torque_calibration._joint((None, None), (plain, plain))[-1] is True
    assert torque_calibration._joint((None, None), (plain, SimpleNamespace(**{**vars(plain), **other})))[-1] is False
