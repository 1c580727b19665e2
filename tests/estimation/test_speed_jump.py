"""Jump of the reported speed above a string: a change of scale during the run is found, without false alarms."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from profiles import MessageCode
from tdhil.estimation import Verdict, identify
from tdhil.estimation.cross_checks.speed_jump import MOST, jump_contradiction
from tdhil.recording import Stage
from tests.estimation.compliant_bench import Pipe, run
from tests.estimation.test_two_mass import KNOWN, MILD

pytestmark = pytest.mark.one_worker      # its fixture is expensive

PLANT = Pipe()
AT_S = 60.0
LAG_S = 0.2               # time constant of the drive's filter after the sensor


@pytest.fixture(scope="module")
def recorded():
    recording = run(PLANT, [4], noise=MILD, lag_prior=KNOWN, settle=8)[0]
    return replace(recording, commanded_torque_nm=recording.torque_nm, has_drill_string=True)


def rescaled(recording, factor, lag_s=LAG_S):
    """Change the scale of the sensor at `AT_S`; the filter of the drive smooths the jump."""
    keep = np.exp(-float(np.median(np.diff(recording.time_s))) / lag_s)
    step = np.where(recording.time_s >= AT_S, factor, 1.0)
    share = lfilter([1.0 - keep], [1.0, -keep], step, zi=[keep])[0]
    return replace(recording, speed_rad_s=share * recording.speed_rad_s)


@pytest.mark.heavy
def test_a_healthy_run_is_far_below_the_bound(recorded):
    for share in (1.0, 0.8):
        assert jump_contradiction(recorded, share * PLANT.motor, PLANT.motor) is None


@pytest.mark.parametrize("factor", [0.3, 2.0])
def test_a_scale_that_changes_is_found_behind_the_drives_filter(recorded, factor):
    found = jump_contradiction(rescaled(recorded, factor), 0.95 * PLANT.motor, PLANT.motor)
    assert found is not None
    assert found.entry is MessageCode.SPEED_JUMPED
    assert float(found.reason.split()[1]) == pytest.approx(AT_S, abs=0.3)


@pytest.mark.heavy
def test_such_a_run_has_no_inertia(recorded):
    found = identify(rescaled(recorded, 0.5))
    assert found.entry is MessageCode.SPEED_JUMPED
    assert found.inertia is None
    assert found.verdict is Verdict.MODEL_REJECTED


def test_a_single_false_report_is_no_jump(recorded):
    speed = recorded.speed_rad_s.copy()
    speed[int(np.searchsorted(recorded.time_s, AT_S))] += 3.0
    lone = replace(recorded, speed_rad_s=speed)
    assert jump_contradiction(lone, 0.95 * PLANT.motor, PLANT.motor) is None


@pytest.mark.parametrize(("factor", "command"), [(0.3, True), (0.5, None)])
def test_in_speed_mode_the_reported_torque_bounds_the_true_one(recorded, factor, command):
    in_speed_mode = replace(recorded, commanded_torque_nm=command and np.full(len(recorded.time_s), np.nan))
    assert jump_contradiction(in_speed_mode, 0.8 * PLANT.motor, PLANT.motor) is None
    inertia = PLANT.motor / factor                           # result of such a run
    assert jump_contradiction(rescaled(in_speed_mode, factor), 0.95 * inertia, inertia) is not None


def test_there_is_no_result_without_a_command_and_a_torque_limit(recorded):
    in_speed_mode = replace(rescaled(recorded, 2.0), commanded_torque_nm=None, torque_limit_nm=None)
    assert jump_contradiction(in_speed_mode, PLANT.motor, PLANT.motor) is None
    assert MOST < 1.0


def test_a_jump_after_stage_5_is_not_searched(recorded):
    ended = Stage("acquire", 0.0, AT_S - 1.0, "ok", "")
    assert jump_contradiction(replace(rescaled(recorded, 2.0), stages=(ended,)), PLANT.motor, PLANT.motor) is None


@pytest.mark.heavy
def test_a_rigid_shaft_is_not_checked(recorded):
    rigid = replace(rescaled(recorded, 2.0), has_drill_string=False)
    assert identify(rigid).entry is not MessageCode.SPEED_JUMPED
