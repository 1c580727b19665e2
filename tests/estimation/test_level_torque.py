"""Torques at equal speed: stage 5 against the levels of stage 2, and a speed that the run returns to."""

import re
from dataclasses import replace

import numpy as np
import pytest

from tdhil.estimation import Verdict, identify
from tdhil.estimation.cross_checks.level_torque import LEAST, MOST, level_contradiction, level_torques
from tdhil.estimation.samples import usable_samples
from tdhil.recording import Recording
from tests.estimation.stages_bench import Stages, run_stages

BEGINS_S = 46.0           # stage 5 of the bench


@pytest.fixture(scope="module")
def recorded():
    return run_stages(Stages(periods=3), [1, 2], rate_hz=50.0)


def scaled_in_stage_5(recording, factor):
    share = np.where(recording.time_s >= BEGINS_S - 1.0, factor, 1.0)
    return replace(recording, torque_nm=share * recording.torque_nm)


def test_the_levels_account_for_the_mean_torque_of_a_healthy_run(recorded):
    for recording in recorded:
        seen = level_torques(recording, usable_samples(recording))
        assert len(seen) == 2
        assert all(0.95 < one.ratio < 1.05 for one in seen)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_torque_scale_that_halves_or_doubles_is_found(recorded, factor):
    recording = scaled_in_stage_5(recorded[0], factor)
    found = level_contradiction(recording, usable_samples(recording))
    assert found is not None
    assert "levels of stage 2" in found.reason


@pytest.mark.parametrize("factor", [1.05 * LEAST, 0.95 * MOST])
def test_a_load_that_changes_by_less_is_no_contradiction(recorded, factor):
    recording = scaled_in_stage_5(recorded[0], factor)
    assert level_contradiction(recording, usable_samples(recording)) is None


def test_such_a_run_has_no_inertia(recorded):
    found = identify(scaled_in_stage_5(recorded[1], 0.5))
    assert found.inertia is None
    assert found.verdict is Verdict.MODEL_REJECTED


def test_one_level_or_none_says_nothing(recorded):
    recording = recorded[0]
    for levels in ((), recording.levels[:1], (recording.levels[0], recording.levels[0])):
        other = replace(recording, levels=levels)
        assert level_torques(other, usable_samples(other)) == ()


def turning_twice(factor=1.0, share_of_friction=0.0, rate_hz=50.0, sd_nm=10.0):
    """A low speed, a high one and the low one again; torque is reported with ``factor`` from the middle on."""
    time = np.arange(0.0, 60.0, 1.0 / rate_hz)
    speed = np.interp(time, [0.0, 18.0, 22.0, 38.0, 42.0, 60.0], [2.85, 2.85, 7.1, 7.1, 2.85, 2.85])
    warm = 1.0 - share_of_friction * time / time[-1]
    torque = 104.0 * np.gradient(speed, time) + warm * (60.0 + 8.0 * speed)
    torque += np.random.default_rng(5).normal(0.0, sd_nm, len(time))
    torque *= np.where(time >= 30.0, factor, 1.0)
    every = np.ones(len(time), dtype=np.bool_)
    return Recording(time_s=time, speed_rad_s=speed, torque_nm=torque, fresh=every, limited=~every)


@pytest.mark.parametrize("factor", [0.4, 0.5, 2.0, 2.5])
def test_a_torque_scale_that_changes_before_the_speed_returns_is_found(factor):
    recording = turning_twice(factor)
    found = level_contradiction(recording, usable_samples(recording))
    assert found is not None
    assert found.reason.startswith("at 2.85 rad/s the mean torque is ")
    assert float(re.search(r"\(([\d.]+) times", found.reason)[1]) == pytest.approx(factor, rel=0.03)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.42])
def test_friction_that_falls_while_a_gear_warms_up_is_no_contradiction(share):
    recording = turning_twice(share_of_friction=share)
    assert level_contradiction(recording, usable_samples(recording)) is None


def test_a_torque_that_scatters_more_than_it_changed_is_no_contradiction():
    recording = turning_twice(0.5, sd_nm=1200.0)
    assert level_contradiction(recording, usable_samples(recording)) is None


def test_the_torque_of_a_swinging_string_is_no_contradiction():
    recording = replace(turning_twice(0.5), winds_up=True)
    assert level_contradiction(recording, usable_samples(recording)) is None
