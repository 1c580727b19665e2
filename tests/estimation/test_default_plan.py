"""Default plan on the field-like rig: bias, scatter and coverage over fixed seeds, and other true values."""

from dataclasses import replace

import numpy as np
import pytest

from tdhil.estimation import Options, Verdict, identify
from tests.estimation.shaft_bench import Rig, recordings

pytestmark = pytest.mark.one_worker("default plan")

SEEDS = list(range(24))


def inertias(found):
    estimates = [one.inertia for one in found]
    assert all(estimate is not None for estimate in estimates), [one.reason for one in found]
    return tuple(np.array([getattr(e, name) for e in estimates]) for name in ("value", "low", "high"))


@pytest.mark.parametrize("seeds", [pytest.param(10, marks=pytest.mark.heavy), pytest.param(24, marks=pytest.mark.long)])
def test_within_one_percent_and_covering(default_run, seeds):
    rig, motion, plan, shaft = default_run
    found = [identify(recording) for recording in recordings(rig, motion, shaft, SEEDS[:seeds])]
    value, low, high = inertias(found)
    assert np.max(np.abs(value - 104.0)) < 1.04
    assert abs(np.mean(value) - 104.0) < 4.0 * 0.26 / np.sqrt(seeds)
    assert np.sqrt(np.mean((value - 104.0) ** 2)) < 0.34
    assert np.mean((low <= 104.0) & (high >= 104.0)) >= 0.9
    assert np.mean(high - low) < 2.0 * 0.01 * 104.0          # with a narrow interval
    assert {one.verdict for one in found} == {Verdict.VALID}
    assert plan.duration_s <= 320.0
    for name, truth in (("viscous_nm_s_rad", 8.0), ("coulomb_nm", 60.0), ("speed_lag_s", 0.40), ("torque_lag_s", 0.15),
                        ("skew_s", 0.0)):
        estimates = [getattr(one, name) for one in found]
        assert np.mean([e.low <= truth <= e.high for e in estimates]) >= 0.85, name
        assert all(e.low <= e.value <= e.high for e in estimates), name


TRUTHS = {
    "20 ms skew": {"torque_delay": 0.020},
    "two poles": {"speed_poles": (0.3, 0.1)},
    "moving average and lag": {"speed_poles": (0.2,), "speed_average": 0.5},
    "moving average alone": {"speed_poles": (), "speed_average": 0.5},
    "matched": {"speed_poles": (0.15,), "torque_delay": 0.005},
    "two long poles": {"speed_poles": (0.5, 0.3)},
    "three poles": {"speed_poles": (0.2, 0.2, 0.2)},
    "torque through two poles": {"speed_poles": (0.1,), "torque_poles": (0.25, 0.25)},
    "the long lag on torque": {"speed_poles": (0.1,), "torque_poles": (0.4,)},
}
MARKS = dict.fromkeys(
    ("two poles", "matched", "two long poles", "three poles", "torque through two poles", "moving average and lag",
     "moving average alone"),
    pytest.mark.long)


@pytest.mark.heavy
@pytest.mark.parametrize("name", [
    pytest.param(name, marks=MARKS.get(name, ())) for name in TRUTHS
])
def test_covers_other_reporting_filters(default_run, name):
    _, motion, _, shaft = default_run
    truth = replace(Rig(), **TRUTHS[name])
    value, low, high = inertias([identify(r) for r in recordings(truth, motion, shaft, SEEDS[:5])])
    assert np.sum((low <= 104.0) & (high >= 104.0)) >= 4
    assert np.max(np.abs(value - 104.0)) < 2.1


@pytest.mark.heavy
def test_jitter_and_dropped_samples(default_run):
    rig, motion, _, shaft = default_run
    for recording in recordings(rig, motion, shaft, SEEDS[:2], rate_hz=100.0, jitter_s=0.004, drop=0.05):
        found = identify(recording)
        assert found.inertia is not None
        assert abs(found.inertia.value - 104.0) < 1.04
        assert any("stale" in warning for warning in found.warnings)


@pytest.mark.heavy
def test_the_same_recording_gives_the_same_bits(one_recording):
    assert repr(identify(one_recording)) == repr(identify(one_recording))


@pytest.mark.heavy
def test_aborted_run_uses_its_whole_periods(one_recording):
    first, second = one_recording.excitation.segments
    cut = second.start_s + 5.5 * second.period_s
    keep = one_recording.time_s < cut
    excitation = replace(one_recording.excitation, segments=(first, replace(second, end_s=cut)))
    partial = replace(
        one_recording, time_s=one_recording.time_s[keep], speed_rad_s=one_recording.speed_rad_s[keep],
        torque_nm=one_recording.torque_nm[keep], fresh=one_recording.fresh[keep], limited=one_recording.limited[keep],
        excitation=excitation, complete=False,
    )
    found = identify(partial)
    assert found.periods_used == 14
    assert found.inertia.low <= 104.0 <= found.inertia.high
    assert any("partial" in warning for warning in found.warnings)


@pytest.mark.heavy
def test_torque_scale_widens_only_the_total(one_recording):
    plain = identify(one_recording).inertia
    found = identify(replace(one_recording, torque_scale_rel_sd=0.02)).inertia
    assert (found.value, found.low, found.high) == (plain.value, plain.low, plain.high)
    above = np.hypot(plain.high - plain.value, 1.96 * 0.02 * plain.value)
    assert found.high_total - found.value == pytest.approx(above, rel=1e-3)
    assert (plain.low_total, plain.high_total) == pytest.approx((plain.low, plain.high), rel=1e-12)
    assert "torque scale exact" in found.conditional_on


@pytest.mark.heavy
def test_papers_model_is_rejected_with_lags(one_recording):
    found = identify(one_recording, Options(model="paper"))
    assert found.verdict is Verdict.MODEL_REJECTED
    assert found.inertia is None
    assert found.paper is not None


@pytest.mark.heavy
def test_tolerance_decides_between_valid_and_wide(one_recording):
    found = identify(one_recording, Options(tolerance=1e-3))
    assert found.verdict is Verdict.VALID_WIDE
    assert found.inertia is not None
