"""Data after an abort are a stop, not an excitation: they have no effect, and the result names the abort."""

from dataclasses import replace

import numpy as np
import pytest

from tdhil.estimation import Verdict, identify
from tdhil.recording.recording import MARGIN_S, Stage, before_abort
from tests.estimation.analytic import closed_form

pytestmark = pytest.mark.one_worker("default plan")      # 24 recordings are simulated at once

DETAIL = "the drive left the state 'enabled' and shows 'off'"


def aborted(recording, time_s, tail):
    """Return the recording aborted at this time: braking for two seconds, then ``tail`` seconds at standstill."""
    cut = recording.time_s < time_s
    interval = float(np.median(np.diff(recording.time_s)))
    after = time_s + interval * np.arange(round((tail + 2.0) / interval))
    braking = np.maximum(0.0, 1.0 - (after - time_s) / 2.0)
    last = float(recording.speed_rad_s[cut][-1])
    ones = np.ones(len(after), dtype=bool)
    return replace(
        recording,
        time_s=np.concatenate((recording.time_s[cut], after)),
        speed_rad_s=np.concatenate((recording.speed_rad_s[cut], last * braking)),
        torque_nm=np.concatenate((recording.torque_nm[cut], -50.0 * (braking > 0.0))),
        fresh=np.concatenate((recording.fresh[cut], ones)),
        limited=np.concatenate((recording.limited[cut], ~ones)),
        stages=(Stage("hold", 0.0, 0.0, "ok"), Stage("acquire", 0.0, time_s, "aborted", f"DriveFault: {DETAIL}")),
    )


@pytest.mark.heavy
def test_the_stop_is_not_used_as_excitation(one_recording):
    end_s = float(one_recording.time_s[-1])
    found = identify(aborted(one_recording, end_s - 13.0, 20.0))
    assert found.verdict in (Verdict.VALID, Verdict.VALID_WIDE)
    assert found.inertia.low < 104.0 < found.inertia.high
    assert DETAIL in found.warnings[0]
    assert not any("of 10 periods" in warning for warning in found.warnings)


@pytest.mark.long(but_first=2)
@pytest.mark.heavy
@pytest.mark.parametrize("before_end_s", [3.0, 33.0, 71.0, 140.0])
def test_whatever_follows_the_abort_the_result_is_the_same(one_recording, before_end_s):
    at_s = float(one_recording.time_s[-1]) - before_end_s
    if at_s <= 0.0:
        pytest.skip("the plan is shorter")
    short, long = (identify(aborted(one_recording, at_s, tail)) for tail in (1.0, 60.0))
    killed = identify(before_abort(aborted(one_recording, at_s, 0.0)))      # the same as a log that ends there
    assert repr(short) == repr(long)
    assert short.inertia == killed.inertia


@pytest.mark.heavy
def test_before_the_excitation_there_is_no_number_and_the_abort_is_the_reason(one_recording):
    begin_s = one_recording.excitation.segments[0].start_s
    found = identify(aborted(one_recording, begin_s + 3.0, 20.0))
    assert found.inertia is None
    assert found.reason.startswith(f"the run was aborted in stage acquire ({DETAIL})")
    assert "still" not in found.reason


def test_the_last_second_does_not_count():
    recording = closed_form()
    at_s = float(recording.time_s[-1]) - 20.0
    kept = before_abort(aborted(recording, at_s, 5.0))
    assert kept.time_s[-1] < at_s - MARGIN_S
    for segment in kept.excitation.segments:
        assert segment.end_s <= at_s - MARGIN_S
        periods = (segment.end_s - segment.start_s) / segment.period_s
        assert periods == pytest.approx(round(periods), abs=1e-6)


def test_a_complete_run_is_used_unchanged():
    recording = closed_form()
    assert before_abort(recording) is recording
