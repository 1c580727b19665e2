"""All five stages on lines of 10 to 100 Hz, with and without torque mode, and data of the line in the recording."""

from dataclasses import replace
from itertools import pairwise

import pytest

from drivers.drive import Mode
from sim_bus.params import ReportingParams, RigParams
from tdhil.estimation import identify
from tdhil.estimation.result import Options, Verdict
from tdhil.recording.builder import FACTS
from tdhil.runner.settings import ControlAssumptions, ExcitationRequest
from tests.runner.line_drive import COARSE, LIMITS, Line, LineDrive, run_line

TRUE_KG_M2 = 104.0
SPEED_ONLY = frozenset({Mode.SPEED})


def identified(run):
    assert run.outcome.cause is None, run.outcome.cause
    assert run.outcome.stop.confirmed
    assert run.drive.top_rad_s < LIMITS.speed_max_rad_s
    assert all(abs(speed) < 0.05 for speed in run.drive.disabled_at)
    return identify(run.recording, Options(tolerance=0.05))


@pytest.mark.heavy
@pytest.mark.parametrize(("rate_hz", "modes"), [(10, frozenset(Mode)), (10, SPEED_ONLY), (30, SPEED_ONLY)])
def test_a_slow_line_identifies(rate_hz, modes):
    found = identified(run_line(LineDrive(Line(1.0 / rate_hz), modes=modes, seed=5)))
    assert found.verdict is Verdict.VALID
    assert found.inertia.value == pytest.approx(TRUE_KG_M2, rel=0.02)
    assert found.inertia.low <= TRUE_KG_M2 <= found.inertia.high


@pytest.mark.heavy
def test_signals_read_one_after_the_other_have_a_time_offset():
    run = run_line(LineDrive(Line(0.1, apart=True), seed=6))
    found = identified(run)
    assert found.inertia.low <= TRUE_KG_M2 <= found.inertia.high
    assert found.skew_s.low <= -0.024 <= found.skew_s.high        # torque is latched 24 ms behind speed on average
    half_s = run.recording.timing_half_width_s
    assert half_s == pytest.approx(0.038, abs=0.003)
    assert run.recording.lag_prior.skew_sd_s == pytest.approx((0.01**2 + half_s**2) ** 0.5)


@pytest.mark.heavy
def test_without_torque_mode_two_stages_state_why_they_are_skipped():
    run = run_line(LineDrive(Line(0.05), modes=SPEED_ONLY), ExcitationRequest(periods=2))
    assert run.outcome.cause is None
    torque, hold = run.outcome.stages[2:4]
    assert (torque.outcome, hold.outcome) == ("skipped", "skipped")
    assert "has no torque mode" in torque.detail
    assert "has no torque mode" in hold.detail
    assert run.drive.modes_commanded == {Mode.SPEED}
    assert run.recording.stages[2:4] == (torque, hold)


@pytest.mark.heavy
def test_the_rate_is_written_down_once_it_is_known():
    """`LineDrive.period_s` raises if it is read before preflight."""
    run = run_line(LineDrive(Line(0.1), modes=SPEED_ONLY), ExcitationRequest(periods=2))
    assert run.log.run["cycle"] == {"period_s": 0.1, "rate_hz": pytest.approx(10.0)}
    assert ("rate", "10 cycles per second") in run.log.events
    assert run.recording.stepped_setpoint.period_s == 0.1
    assert {"timing_half_width_s", "stepped_setpoint"} <= FACTS


@pytest.mark.heavy
def test_torque_read_in_step_with_a_stiff_drive_is_not_trusted():
    """The drive is read every 100 ms and follows a step within about 30 ms. Most of the response is lost."""
    stiff = COARSE.drive.model_copy(update={
        "speed_gain_nm_s_rad": 1500.0, "speed_integral_gain_nm_rad": 3000.0, "speed_filter_s": 0.0,
        "torque_limit_nm": 2000.0,
    })
    limits = replace(LIMITS, torque_nm=2000.0)
    plain = ReportingParams(speed_lag_s=0.0, torque_lag_s=0.0)
    run = run_line(LineDrive(
        Line(0.1), params=RigParams(drive=stiff, reporting=plain), modes=SPEED_ONLY, seed=2,
    ), ExcitationRequest(amplitude_rad_s=1.5), limits)
    found = identified(run)
    if found.inertia is not None:
        assert found.inertia.low <= TRUE_KG_M2 <= found.inertia.high
        assert found.verdict is not Verdict.VALID
        assert "stepped setpoint" in {line.source for line in found.budget}


@pytest.mark.heavy
def test_a_ramp_in_the_drive_is_found_and_not_exceeded():
    run = run_line(LineDrive(Line(0.05), modes=SPEED_ONLY, ramp_rad_s2=0.8, seed=3))
    found = identified(run)
    plan = run.display.plans[0]
    assert plan.limits.acceleration_rad_s2 == pytest.approx(0.8, rel=0.1)
    steepest = max(abs(b - a) for segment in plan.segments for a, b in _neighbours(segment.reference))
    assert steepest / 0.01 <= 0.8
    assert any("speed ramp limits the shaft" in text for _, text in run.log.events)
    assert found.inertia.low <= TRUE_KG_M2 <= found.inertia.high


def test_reaction_takes_three_cycles_of_a_slow_line():
    assumed = ControlAssumptions()
    assert assumed.at_period(0.004) == assumed
    assert assumed.at_period(0.1).reaction_s == pytest.approx(0.3)
    assert assumed.at_period(0.1).at_period(0.1) == assumed.at_period(0.1)


def _neighbours(reference):
    times = [0.01 * n for n in range(int(reference.period_s / 0.01) + 1)]
    speeds = [reference.reference(t)[0] for t in times]
    return pairwise(speeds)
