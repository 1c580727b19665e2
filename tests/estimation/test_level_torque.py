"""Mean torque of stage 5 compared with the operating points of stage 2: a change of the torque scale is found."""

from dataclasses import replace

import numpy as np
import pytest

from profiles import MessageCode
from tdhil.estimation import Options, Verdict, identify
from tdhil.estimation.case import Case, Finding
from tdhil.estimation.cross_checks import cross_checked
from tdhil.estimation.cross_checks.level_torque import LEAST, MOST, level_contradiction, level_torques
from tdhil.estimation.result import Compliant, Estimate
from tdhil.estimation.samples import usable_samples
from tests.estimation.stages_bench import Stages, run_stages

pytestmark = pytest.mark.one_worker      # its fixture is expensive

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


@pytest.mark.heavy
@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_torque_scale_that_halves_or_doubles_is_found(recorded, factor):
    recording = scaled_in_stage_5(recorded[0], factor)
    found = level_contradiction(recording, usable_samples(recording))
    assert found is not None
    assert "operating points of stage 2" in found.reason
    assert found.entry is MessageCode.TORQUE_AT_SPEED_CHANGED


@pytest.mark.parametrize("factor", [1.05 * LEAST, 0.95 * MOST])
def test_a_load_that_changes_by_less_is_no_contradiction(recorded, factor):
    recording = scaled_in_stage_5(recorded[0], factor)
    assert level_contradiction(recording, usable_samples(recording)) is None


@pytest.mark.heavy
def test_such_a_run_has_no_inertia(recorded):
    found = identify(scaled_in_stage_5(recorded[1], 0.5))
    assert found.inertia is None
    assert found.verdict is Verdict.MODEL_REJECTED


def test_above_a_string_of_unknown_inertia_the_result_states_which_error_stays_hidden(recorded):
    recording = replace(recorded[0], has_drill_string=True)
    case = Case(recording, Options(), samples=usable_samples(recording))
    shaft = Compliant(None, None, None, None, None, None)
    part = Finding(model="string", inertia=Estimate(104.0, 102.0, 106.0), compliant=shaft)
    checked = cross_checked(part, case)
    ratios = [one.ratio for one in level_torques(recording, case.samples)]
    seen = min(max(ratio / LEAST, MOST / ratio) for ratio in ratios) - 1.0
    assert [one.entry for one in checked.warnings] == [MessageCode.SCALE_CHANGE_HIDDEN]
    assert f"of less than {100 * seen:.0f} %" in checked.warnings[0]
    assert checked.second_opinions[0].least_scale_change == pytest.approx(seen)
    rigid = cross_checked(part, replace(case, recording=recorded[0]))
    assert rigid.warnings == () and rigid.second_opinions[0].least_scale_change is None


def test_fewer_than_two_levels_give_no_result(recorded):
    recording = recorded[0]
    for levels in ((), recording.levels[:1], (recording.levels[0], recording.levels[0])):
        other = replace(recording, levels=levels)
        assert level_torques(other, usable_samples(other)) == ()
