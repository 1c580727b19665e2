"""Torque over the shaft angle: it is found, measured, and removed from J."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from profiles import MessageCode
from tdhil.estimation import angle_harmonics, identify
from tdhil.estimation.angle_harmonics import HarmonicTorque
from tests.estimation.angle_bench import RATED_NM, OverAngle, run_over_angle
from tests.estimation.shaft_bench import Rig

TRUE, PHASE = 104.0, 0.7


@cache
def recorded(order: int, share: float) -> tuple:
    """Return two seeds of a run with one harmonic, as a share of the rated torque."""
    harmonics = ((order, share * RATED_NM, PHASE),) if order else ()
    return tuple(run_over_angle(OverAngle(rig=Rig(harmonics=harmonics)), [0, 1]))


def test_amplitude_and_phase_of_two_parts():
    torque = HarmonicTorque((1, 6), np.array([3.0, -4.0, 0.0, 1.0]), np.diag([0.01, 0.01, 0.04, 0.04]))
    first, second = torque.estimates(0.95)
    assert (first.order, second.order) == (1, 6)
    assert first.amplitude_nm.value == pytest.approx(5.0)
    assert first.phase_rad.value == pytest.approx(math.atan2(4.0, 3.0))
    assert first.amplitude_nm.high - 5.0 == pytest.approx(1.96 * 0.1, rel=1e-3)
    assert second.phase_rad.value == pytest.approx(-0.5 * math.pi)
    assert second.phase_rad.high - second.phase_rad.value == pytest.approx(math.atan(1.96 * 0.2), rel=1e-3)


@pytest.mark.heavy
@pytest.mark.parametrize(("order", "share"), [(1, 0.01), (1, 0.1), (6, 0.1)])
def test_an_order_is_found_with_its_amplitude_and_phase(order, share):
    for recording in recorded(order, share):
        found = identify(recording)
        assert [one.order for one in found.harmonics] == [order]
        one = found.harmonics[0]
        assert one.amplitude_nm.value == pytest.approx(share * RATED_NM, rel=0.1)
        assert one.phase_rad.value == pytest.approx(PHASE, abs=math.radians(5.0))
        assert found.inertia.low <= TRUE <= found.inertia.high


@pytest.mark.heavy
@pytest.mark.parametrize("order", [1, 6])
def test_an_order_above_the_stated_limit_is_found_and_one_far_below_is_not(order):
    limits = [{one.order: one.amplitude_nm for one in identify(recording).least_harmonics}
              for recording in recorded(0, 0.0)]
    assert limits[0][order] == pytest.approx(limits[1][order], rel=0.4)
    assert limits[0][36] > 10.0 * limits[0][6]
    for share, seen in ((1.2, [order]), (0.4, [])):
        for recording in recorded(order, share * max(one[order] for one in limits) / RATED_NM):
            found = identify(recording)
            assert [one.order for one in found.harmonics] == seen
            again = {one.order: one.amplitude_nm for one in found.least_harmonics}
            assert again[order] == pytest.approx(limits[0][order], rel=0.4)


@pytest.mark.heavy
def test_the_harmonic_is_removed_from_the_inertia():
    """With 10 % of rated torque at order 1, the harmonic determines the scatter unless it is subtracted."""
    for clean, bent in zip(recorded(0, 0.0), recorded(1, 0.1), strict=True):
        before, found = identify(replace(bent, position_rad=None)), identify(bent)
        without = identify(clean)
        assert before.harmonics is None
        assert found.inertia.high - found.inertia.low < before.inertia.high - before.inertia.low
        assert found.inertia.value == pytest.approx(without.inertia.value, rel=0.002)
        assert found.speed_lag_s.value == pytest.approx(without.speed_lag_s.value, abs=0.005)


@pytest.mark.heavy
def test_another_model_may_be_selected_without_the_harmonic():
    """The model after the subtraction has one more parameter, and its own count of degrees of freedom."""
    rig = Rig(torque_lag=0.01, load_sd=4.081396661692406, sensor_sd=0.02, speed_quantum=0.001, torque_quantum=1.0,
              speed_poles=(0.02,), torque_poles=(0.01,), harmonics=((6, 0.1 * RATED_NM, -2.351135709653887),))
    recording = run_over_angle(OverAngle(rig=rig, every=1), range(100, 110))[4]
    found = identify(recording)
    assert [one.order for one in found.harmonics] == [6]
    assert found.inertia.low <= TRUE <= found.inertia.high


@pytest.mark.heavy
def test_the_subtracted_torque_is_no_undeclared_motion():
    """The drive reports no torque of 0.68 Hz in this run. Only the torque without the harmonic has it."""
    for recording in recorded(1, 0.1):
        found = identify(recording)
        assert [one.order for one in found.harmonics] == [1]
        assert not any(one.entry is MessageCode.UNDECLARED_MOTION for one in found.warnings)


@pytest.mark.heavy
def test_nothing_changes_without_a_harmonic():
    for recording in recorded(0, 0.0):
        found, before = identify(recording), identify(replace(recording, position_rad=None))
        assert found.harmonics == found.backlash == ()
        unknown = replace(found, harmonics=None, least_harmonics=None, backlash=None, backlash_motion=None,
                          frequency_response=None)
        assert unknown == replace(before, frequency_response=None)


@pytest.mark.heavy
def test_a_long_recording_is_used_whole_if_its_first_periods_show_an_order(monkeypatch):
    recording, without = recorded(6, 0.1)[0], recorded(0, 0.0)[0]
    whole = identify(recording).harmonics
    monkeypatch.setattr(angle_harmonics, "LOOK_POINTS", 1)      # the minimum of three periods
    assert identify(recording).harmonics == whole
    assert identify(without).harmonics == ()


@pytest.mark.heavy
def test_an_angle_with_a_long_gap_is_not_used():
    recording = recorded(1, 0.1)[0]
    position = recording.position_rad.copy()
    position[np.arange(len(position)) % 1000 != 0] = np.nan      # once in 4 s
    assert identify(replace(recording, position_rad=position)).harmonics is None
