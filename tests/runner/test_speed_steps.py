"""Steps of the set speed on the fake drive: refused before motion, within the limits, ended at standstill."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivers.drive import Mode
from drivers.errors import DriveFault, LimitHit, PreflightRefused
from tdhil.errors import Interrupted
from tdhil.runner.five_stages import Runner
from tdhil.runner.settings import ExcitationRequest
from tdhil.runner.stages import further_pairs, plan_steps
from tdhil.runner.task import Task
from tdhil.speed_loop import PiGains, Range, StepCase, StepOutcome, StepProgram, StepVerification, UncertainPlant
from tests.runner.fake_drive import LIMITS, PERIOD_S, SPEED_RESOLUTION, FakeDrive
from tests.runner.line_drive import BuilderLog
from tests.runner.run_outcomes import assert_at_rest, outcomes, up_to

PLANT = UncertainPlant(Range(100.0, 96.0, 104.0), Range(8.0, 7.0, 9.0), (Range(0.02, 0.018, 0.022),),
                       Range(0.003, 0.002, 0.004))
CASE = StepCase("tuned", PLANT, PiGains(500.0, 600.0), Range(0.2, 0.15, 0.25), Range(0.2, 0.19, 0.21),
                Range(0.4, 0.35, 0.45), Range(0.0, 0.0, 0.02), "tune.json")


def runner(here, case=CASE, limits=LIMITS, log=None):
    task = Task(limits, ExcitationRequest(mode="speed"), {}, case=case)
    return Runner(here.drive, lambda _: task, log or BuilderLog(), here.stop_request, here.display, lambda *_: None)


def in_acquire(here, cycle, what):
    here.display.on_cycle = lambda stage, seen: what() if (stage, seen) == ("acquire", cycle) else None


def test_the_steps_stay_within_the_limits_and_end_at_standstill(world):
    here = world(FakeDrive(), LIMITS)
    result = runner(here).run()
    assert result.cause is None
    assert [stage.outcome for stage in result.stages] == ["ok", "ok", "skipped", "ok", "ok"]
    assert_at_rest(here, result)
    program = plan_steps(CASE, LIMITS, PERIOD_S, SPEED_RESOLUTION, 800.0, 100.0)
    assert CASE.gains.gain_nm_s_rad * program.step_rad_s < 0.5 * LIMITS.torque_nm
    assert program.step_rad_s / SPEED_RESOLUTION == pytest.approx(round(program.step_rad_s / SPEED_RESOLUTION))
    assert all(one.mode is Mode.SPEED and one.torque_nm == 0.0 for one in here.drive.commands)
    assert max(one.speed_rad_s for one in here.drive.commands) < LIMITS.speed_max_rad_s


@pytest.mark.parametrize(("settling_s", "pairs"), [(0.1, 60), (0.7, 50), (6.0, 24)])
def test_steps_that_settle_fast_are_repeated_more_often(settling_s, pairs):
    case = replace(CASE, settling_s=Range(settling_s, settling_s, settling_s), reported_lag_s=Range(0.07, 0.07, 0.07))
    assert plan_steps(case, LIMITS, PERIOD_S, SPEED_RESOLUTION, 800.0).pairs == pairs


def outcome(needed_pairs):
    nothing = np.zeros(0)
    return StepVerification(StepOutcome.CANNOT_TELL, "I is known from 0.8 to 1.4 times the typed value", (), 24, 0.0,
                            1.0, nothing, nothing, nothing, nothing, needed_pairs)


@pytest.mark.parametrize(("needed_pairs", "left_s", "more"), [
    (None, 800.0, 0), (30, 800.0, 6), (60, 800.0, 36), (100, 800.0, 36), (113, 800.0, 0), (30, 70.0, 6),
    (30, 69.0, 0),
])
def test_more_pairs_follow_where_they_are_enough_and_the_time_is_left(needed_pairs, left_s, more):
    assert further_pairs(outcome(needed_pairs), StepProgram(4.0, 4.5, 5.0, 24), left_s) == more


def test_further_pairs_are_run_and_logged_after_one_that_does_not_count(world, monkeypatch):
    monkeypatch.setattr("tdhil.runner.speed_steps_program.verify_record", lambda *_: outcome(64))
    here, log = world(FakeDrive(), LIMITS), BuilderLog()
    result = runner(here, log=log).run()
    assert result.cause is None
    said = log.run["verification"]
    program = said["program"]
    assert program["pairs"] == 64 and len(said["starts_s"]) == 2 * (64 + 1)
    gaps = np.diff(said["starts_s"]) / program["half_s"]
    assert np.count_nonzero(gaps > 1.5) == 1 and np.max(gaps) == pytest.approx(3.0, abs=0.1)
    assert any("more pairs follow" in text for _, text in log.events)


def test_an_error_of_the_comparison_does_not_end_the_run(world, monkeypatch):
    def fails(*_):
        raise ValueError("math domain error")

    monkeypatch.setattr("tdhil.runner.speed_steps_program.verify_record", fails)
    here, log = world(FakeDrive(), LIMITS), BuilderLog()
    result = runner(here, log=log).run()
    assert result.cause is None
    assert_at_rest(here, result)
    said = log.run["verification"]
    assert len(said["starts_s"]) == 2 * (said["program"]["pairs"] + 1)
    assert any("could not be compared, no more follow: ValueError: math domain error" in text
               for _, text in log.events)


NO_FRICTION = replace(CASE, plant=replace(PLANT, viscous_nm_s_rad=Range(0.0, 0.0, 0.0)))


@pytest.mark.parametrize(("limits", "case", "said"), [
    (replace(LIMITS, load="string", torque_ramp_nm_s=50.0), CASE, "load is string"),
    (replace(LIMITS, time_s=130.0), CASE, "the time limit leaves 10 s"),
    (replace(LIMITS, torque_nm=15.0, probe_torque_nm=15.0), NO_FRICTION, "one count of the reported speed is 0.01"),
    (replace(LIMITS, torque_nm=90.0), replace(CASE, coulomb_nm=Range(60.0, 58.0, 62.0)),
     "needs 117.2 N·m against friction, and the torque limit is 90 N·m"),
], ids=["string", "time", "counts", "friction"])
def test_what_can_not_be_is_refused_before_anything_moves(world, limits, case, said):
    here = world(FakeDrive(), limits)
    result = runner(here, case, limits).run()
    assert isinstance(result.cause, PreflightRefused) and said in str(result.cause)
    assert result.stop is None and here.drive.speed == 0.0 and here.drive.closed


def test_a_tuning_of_another_shaft_is_refused_and_the_shaft_stopped(world):
    here = world(FakeDrive(), LIMITS)
    other = replace(CASE, plant=replace(PLANT, inertia_kg_m2=Range(45.0, 44.0, 46.0)))
    result = runner(here, other).run()
    assert isinstance(result.cause, PreflightRefused) and "this shaft has about" in str(result.cause)
    assert_at_rest(here, result)


def test_a_speed_that_overshoots_far_more_than_predicted_is_stopped(world):
    here = world(FakeDrive(), LIMITS)
    in_acquire(here, 60, lambda: here.drive.__setattr__("follow_s", -0.05))
    result = runner(here).run()
    assert isinstance(result.cause, LimitHit) and "the overshoot is above the limit" in str(result.cause)
    assert outcomes(result)[-1] == ("acquire", "aborted")
    assert_at_rest(here, result)


@pytest.mark.parametrize(("what", "cause"), [
    (lambda here: here.stop_request.ask(), Interrupted), (lambda here: here.drive.fault(), DriveFault),
], ids=["stop", "fault"])
def test_the_steps_always_end_at_standstill(world, what, cause):
    here = world(FakeDrive(), LIMITS)
    in_acquire(here, 50, lambda: what(here))
    result = runner(here).run()
    assert isinstance(result.cause, cause)
    assert [name for name, _ in outcomes(result)] == [name for name, _ in up_to("acquire")]
    assert result.stop.confirmed and here.drive.speed == 0.0 and here.drive.closed
