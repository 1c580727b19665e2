"""Unusable data: no number and no exception, but a reason and advice."""

from dataclasses import replace

import numpy as np
import pytest

from tdhil.estimation import Verdict, identify
from tests.estimation.analytic import closed_form


def with_signals(recording, **signals):
    return replace(recording, **signals)


def flat(r):
    return replace(r, speed_rad_s=np.full_like(r.speed_rad_s, 5.0), torque_nm=np.full_like(r.torque_nm, 100.0))


def constant_speed(r):
    rng = np.random.default_rng(0)
    return replace(
        r,
        speed_rad_s=5.0 + 0.003 * rng.standard_normal(len(r.time_s)),
        torque_nm=100.0 + 3.0 * rng.standard_normal(len(r.time_s)),
    )


def nan_speed(r):
    return replace(r, speed_rad_s=np.where(np.arange(len(r.time_s)) % 3 == 0, np.nan, r.speed_rad_s))


def all_nan(r):
    return replace(r, torque_nm=np.full_like(r.torque_nm, np.nan))


def infinite(r):
    return replace(r, torque_nm=np.full_like(r.torque_nm, np.inf))


def first(r, count):
    return replace(r, time_s=r.time_s[:count], speed_rad_s=r.speed_rad_s[:count], torque_nm=r.torque_nm[:count],
                   fresh=r.fresh[:count], limited=r.limited[:count])


def twelve(r):
    return first(r, 12)


def empty(r):
    return first(r, 0)


def clipped(r):
    return replace(r, torque_nm=np.clip(r.torque_nm, -150.0, 150.0), torque_limit_nm=150.0)


def clipped_unknown_limit(r):
    return replace(r, torque_nm=np.clip(r.torque_nm, 40.0, 150.0), torque_limit_nm=None)


def clipped_speed(r):
    return replace(r, speed_rad_s=np.clip(r.speed_rad_s, 3.5, 7.5))


def flagged(r):
    return replace(r, limited=np.arange(len(r.time_s)) % 20 == 0)


def unsorted_time(r):
    time = r.time_s.copy()
    time[[500, 501]] = time[[501, 500]]
    return replace(r, time_s=time)


def nan_time(r):
    time = r.time_s.copy()
    time[7] = np.nan
    return replace(r, time_s=time)


def stale(r):
    return replace(r, fresh=np.zeros(len(r.time_s), dtype=bool))


def no_excitation(r):
    return replace(r, excitation=None)


def two_periods(r):
    return first(r, int(np.searchsorted(r.time_s, 21.0)))


def settling_only(r):
    return first(r, int(np.searchsorted(r.time_s, 9.0)))


def uneven(r):
    return replace(r, torque_nm=r.torque_nm[:-1])


def one_tone(_):
    return closed_form(lines=(0.2,), amplitudes=(1.0,), offsets=(4.0, 7.0))


def unrelated_torque(r):
    rng = np.random.default_rng(1)
    return replace(r, torque_nm=100.0 + 50.0 * rng.standard_normal(len(r.time_s)))


def reversed_torque(r):
    return replace(r, torque_nm=-r.torque_nm)


CASES = [flat, constant_speed, nan_speed, all_nan, infinite, twelve, empty, clipped, clipped_unknown_limit,
         clipped_speed, flagged, unsorted_time, nan_time, stale, no_excitation, two_periods, settling_only, uneven,
         one_tone, unrelated_torque, reversed_torque]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("spoil", CASES, ids=lambda case: case.__name__)
def test_never_a_number(spoil):
    found = identify(spoil(closed_form()))
    assert found.verdict in (Verdict.NOT_IDENTIFIABLE, Verdict.MODEL_REJECTED)
    assert found.inertia is None
    assert found.reason
    assert found.advice


@pytest.mark.heavy
def test_nonlinear_friction_is_rejected():
    recording = closed_form(noise=0.3)
    torque = recording.torque_nm + 4.0 * (recording.speed_rad_s - 5.0) ** 2
    found = identify(replace(recording, torque_nm=torque))
    assert found.verdict is Verdict.MODEL_REJECTED
    assert found.inertia is None


@pytest.mark.heavy
def test_a_few_bad_samples_do_no_harm():
    recording = closed_form()
    speed = recording.speed_rad_s.copy()
    speed[::400] = np.nan
    found = identify(replace(recording, speed_rad_s=speed))
    assert found.inertia.low <= 104.0 <= found.inertia.high
