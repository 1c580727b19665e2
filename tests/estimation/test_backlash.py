"""Backlash of the coupling: found in the angle, measured, and included in the interval of J."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from profiles import MessageCode
from tdhil.estimation import Verdict, backlash, identify
from tdhil.recording import Segment
from tests.estimation.angle_bench import COUNTS, OverAngle, run_over_angle
from tests.estimation.shaft_bench import Rig
from tests.estimation.stages_bench import Play

TRUE, COUNT = 104.0, 2.0 * math.pi / COUNTS


@cache
def recorded(counts: float, inertia: float = 40.0, coulomb: float = 20.0) -> tuple:
    """Return two seeds of a run whose coupling has this play in counts."""
    play = Play(counts * COUNT, inertia, coulomb, viscous=2.0)
    return tuple(run_over_angle(OverAngle(play=play), [0, 1]))


@pytest.mark.parametrize(("counts", "inertia"), [(3.0, 40.0), pytest.param(10.0, 60.0, marks=pytest.mark.heavy)])
def test_backlash_is_found_with_its_angle(counts, inertia):
    for recording in recorded(counts, inertia):
        found = identify(recording)
        (one,) = found.backlash
        assert one.play_rad.low <= counts * COUNT <= one.play_rad.high
        # the motor shows J_L/J of the play
        assert one.at_motor_rad.low <= counts * COUNT * inertia / TRUE <= one.at_motor_rad.high
        assert one.play_rad.high < 1.8 * one.play_rad.low
        assert found.inertia.low <= TRUE <= found.inertia.high
        assert any(getattr(one, "entry", None) is MessageCode.BACKLASH_FOUND for one in found.warnings)


@pytest.mark.heavy
def test_backlash_widens_the_interval_and_is_in_the_budget():
    recording = recorded(3.0)[0]
    found, before = identify(recording), identify(replace(recording, position_rad=None))
    assert before.backlash is None
    assert found.inertia.value == pytest.approx(before.inertia.value, rel=1e-9)
    assert found.inertia.low < before.inertia.low and found.inertia.high > before.inertia.high
    (line,) = (one for one in found.budget if one.source == "backlash")
    assert 0.0 < line.half_width_kg_m2 < 0.01 * TRUE


@pytest.mark.heavy
def test_the_result_states_whether_the_motion_can_show_a_play():
    """A larger constant load keeps the torque of the drive positive. Then the load hardly crosses a play."""
    recording = recorded(0.0)[0]
    reversing, driving = identify(recording), identify(replace(recording, torque_nm=recording.torque_nm + 100.0))
    assert reversing.backlash_motion.torque_reverses and not driving.backlash_motion.torque_reverses
    assert driving.backlash_motion.least_torque_nm == pytest.approx(
        reversing.backlash_motion.least_torque_nm + 100.0, abs=0.1)


@pytest.mark.heavy
def test_an_elastic_coupling_without_play_has_none():
    for recording in recorded(0.0):
        assert identify(recording).backlash == ()


@pytest.mark.heavy
def test_a_play_that_the_load_never_crosses_is_not_found():
    """The friction of the load exceeds the largest inertia torque of the motion."""
    for recording in recorded(10.0, 20.0, 50.0):
        found = identify(recording)
        assert found.backlash == ()
        assert found.inertia.low <= TRUE <= found.inertia.high


@pytest.mark.heavy
def test_a_play_too_large_for_a_linear_shaft_is_the_reason():
    for recording in recorded(120.0, 70.0, 10.0):
        found = identify(recording)
        assert found.backlash
        assert found.inertia is None or found.inertia.low <= TRUE <= found.inertia.high
        if found.verdict is Verdict.MODEL_REJECTED:
            assert "backlash" in f"{found.reason} {found.advice}"


@pytest.mark.heavy
def test_lags_that_the_play_has_biased_do_not_hide_it():
    """The model finds lags of 0.46 and 0.30 s here. Without a filter, the torque explains more of the angle."""
    rig = Rig(speed_poles=(0.02,), torque_poles=(0.01,), speed_quantum=0.0105, torque_quantum=1.0, load_sd=1.23)
    play = Play(60.0 * COUNT, 65.7, 10.8, 2.62, natural=162.5, ratio=0.15)
    for recording in run_over_angle(OverAngle(rig=rig, play=play, every=1), [270, 275]):
        found = identify(recording)
        assert found.backlash[0].play_rad.low <= play.angle <= found.backlash[0].play_rad.high
        assert found.inertia is None or found.inertia.low <= TRUE <= found.inertia.high


@pytest.mark.heavy
def test_too_few_angles_give_no_result():
    recording = recorded(3.0)[0]
    position = recording.position_rad.copy()
    position[np.arange(len(position)) % 500 != 0] = np.nan      # once in 2 s
    assert identify(replace(recording, position_rad=position)).backlash is None


def test_a_decaying_oscillation_is_no_backlash():
    """A string oscillates for minutes after a change of its mean speed, at another frequency than the period."""
    period_s, swing_hz, excited = 12.5, 0.176, tuple(range(1, 11))
    time = np.arange(0.0, 8 * period_s, 0.05)
    turned = 3.0 * time + 0.05 * np.exp(-0.02 * time) * np.cos(2.0 * math.pi * swing_hz * time)
    periods = [(time[k : k + 250], turned[k : k + 250]) for k in range(0, len(time), 250)]
    lines = backlash._lines(periods, Segment(0.0, 100.0, period_s, 0, 3.0, (), (), ()), 40).mean(axis=0)
    segment = backlash._SegmentAngle(
        period_s, 3.0, excited, lines, np.arange(11.0, 41.0), lines[10:], np.arange(11.0, 41.0) ** -2.0)
    left = segment.settled(segment.rest[None])[0]
    assert np.linalg.norm(left) < 0.05 * np.linalg.norm(segment.rest)
    wave = np.arange(1.0, 41.0)
    play = replace(segment, theta=np.where(wave < 11, 0.05 * np.exp(1.7j * wave) / wave, 0.0))
    z = backlash._GapMotion.of(np.array([[5.0, 0.3, 0.0, 0.0]])).waves(play, 1000, np.zeros((10, 1)))[:, 10:]
    assert np.linalg.norm(segment.settled(z)) > 0.8 * np.linalg.norm(z)


def test_the_lines_of_uniform_and_of_jittered_periods():
    """Both give the lines of the signal, with one set of equations for all periods, or one for each period."""
    segment, wanted = Segment(2.0, 12.0, 2.0, 1, 3.0, (0.5,), (1.0,), (0.0,)), np.array([0.3, 0.2 - 0.1j, 0.05j])
    rng = np.random.default_rng(3)
    for jitter_s in (0.0, 3e-3):
        periods = []
        for begin in (4.0, 6.0, 8.0):
            time = begin + 0.05 * np.arange(40) + jitter_s * rng.random(40)
            turned = np.exp(1j * math.pi * np.multiply.outer(time - segment.start_s, [1.0, 2.0, 3.0])) @ wanted
            periods.append((time, 3.0 * time + 0.01 * (time - begin) ** 2 + turned.real))
        assert backlash._lines(periods, segment, 3) == pytest.approx(np.tile(wanted, (3, 1)), abs=1e-9)
