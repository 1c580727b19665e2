"""A reported speed that jumps above a string: a scale that changes during the run is found, a healthy run is not."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from profiles import MessageCode
from tdhil.estimation import Verdict, identify
from tdhil.estimation.cross_checks.speed_jump import MOST, jump_contradiction
from tests.estimation.compliant_bench import Pipe, run
from tests.estimation.test_two_mass import KNOWN, MILD

pytestmark = pytest.mark.one_worker      # its fixture is expensive

PLANT = Pipe()
AT_S = 60.0
LAG_S = 0.2               # of the drive's filter behind the sensor


@pytest.fixture(scope="module")
def recorded():
    recording = run(PLANT, [4], noise=MILD, lag_prior=KNOWN, settle=8)[0]
    return replace(recording, commanded_torque_nm=recording.torque_nm, has_drill_string=True)


def rescaled(recording, factor, lag_s=LAG_S):
    """The sensor's scale changes at `AT_S`; the drive's filter smooths the jump."""
    keep = np.exp(-float(np.median(np.diff(recording.time_s))) / lag_s)
    step = np.where(recording.time_s >= AT_S, factor, 1.0)
    share = lfilter([1.0 - keep], [1.0, -keep], step, zi=[keep])[0]
    return replace(recording, speed_rad_s=share * recording.speed_rad_s)


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


def test_speed_mode_a_gap_and_an_open_side_say_nothing(recorded):
    changed = rescaled(recorded, 2.0)
    assert jump_contradiction(replace(changed, commanded_torque_nm=None), PLANT.motor, PLANT.motor) is None
    none = np.full(len(changed.time_s), np.nan)
    assert jump_contradiction(replace(changed, commanded_torque_nm=none), PLANT.motor, PLANT.motor) is None
    assert MOST < 1.0


@pytest.mark.heavy
def test_a_rigid_shaft_is_not_asked(recorded):
    rigid = replace(rescaled(recorded, 2.0), has_drill_string=False)
    assert identify(rigid).entry is not MessageCode.SPEED_JUMPED
