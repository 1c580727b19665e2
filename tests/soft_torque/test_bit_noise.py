"""Random torque of the bit from surface signals, compared with a chain of masses under a known noise.

The chain is linear, because the bit turns fast. It uses no wave and no line (cases.py).
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.linalg import expm

from tdhil.soft_torque import (
    EXACT_STRING,
    Interval,
    SeverityRefused,
    SurfaceRecord,
    bit_noise_in,
    with_noise,
)
from tests.soft_torque.cases import DRIVE, SOFT_035, STRING, Pipe, lumped_chain, string_with
from tests.soft_torque.chain_in_time import reported

INERTIA, EXACT_J = Interval(1500.0, 1440.0, 1560.0), Interval(1500.0, 1500.0, 1500.0)
EXACT = replace(STRING, tolerance=EXACT_STRING)
STEP_S, MEAN_RAD_S, LAGS_S = 0.02, 15.0, (0.4, 0.15)


@cache
def drilled(rms_nm: float, correlation_s: float, seeds: int, seconds: float = 600.0):
    """Return time, and torque and top speed of each seed, (N, seeds), in steady rotation under bit noise."""
    chain, _, count = lumped_chain([Pipe(3000.0, 0.127, 0.1086, lumps=24)], 374.0, 20.0, DRIVE, SOFT_035)
    size = len(chain)
    pipe_kg_m2 = 7850.0 * np.pi * (0.127**4 - 0.1086**4) / 32.0 * 3000.0 / 48.0
    whole = np.zeros((size + 1, size + 1))
    whole[:size, :size] = chain
    whole[2 * count - 1, size] = -1.0 / (374.0 + pipe_kg_m2)
    step = expm(whole * STEP_S)[:size]
    random = np.random.default_rng(4)
    keep = np.exp(-STEP_S / correlation_s)
    states, noise, kept = np.zeros((size, seeds)), rms_nm * random.standard_normal(seeds), []
    for row in random.standard_normal((round((seconds + 60.0) / STEP_S), seeds)):
        noise = keep * noise + rms_nm * np.sqrt(1.0 - keep**2) * row
        states = step[:, :size] @ states + np.outer(step[:, size], noise)
        kept.append((states[-1], states[count]))
    torque, top = (np.array(one)[round(60.0 / STEP_S) :] for one in zip(*kept, strict=True))
    return STEP_S * np.arange(len(top)), 3000.0 + torque, MEAN_RAD_S + top


def record(case, seed, **noises) -> SurfaceRecord:
    time_s, torque, top = case
    return SurfaceRecord(*reported(time_s, torque[:, seed], top[:, seed], LAGS_S, seed, **noises), *LAGS_S)


def part(whole: SurfaceRecord, end_s: float) -> SurfaceRecord:
    kept = whole.time_s < end_s
    return replace(whole, time_s=whole.time_s[kept], speed_rad_s=whole.speed_rad_s[kept],
                   torque_nm=whole.torque_nm[kept])


@pytest.mark.parametrize(("rms_nm", "correlation_s", "seeds"), [
    (200.0, 0.2, 2), pytest.param(200.0, 0.2, 30, marks=pytest.mark.heavy),
    pytest.param(600.0, 0.5, 30, marks=pytest.mark.heavy), pytest.param(1000.0, 0.1, 30, marks=pytest.mark.long),
])
def test_the_interval_contains_the_true_noise(rms_nm, correlation_s, seeds):
    case = drilled(rms_nm, correlation_s, seeds)
    found = [bit_noise_in(record(case, seed), EXACT, EXACT_J) for seed in range(seeds)]
    # If θ is held, σ is that of the stated θ with the same density at the lowest mode of 0.13 Hz.
    omega = 2.0 * np.pi * 0.13

    def as_held(theta_s):
        return rms_nm * np.sqrt(correlation_s / (1.0 + (omega * correlation_s) ** 2)
                                / (theta_s / (1.0 + (omega * theta_s) ** 2)))

    expected = [rms_nm if one.correlation_measured else as_held(one.correlation_s.value) for one in found]
    inside = [one.rms_nm.low <= rms <= one.rms_nm.high for one, rms in zip(found, expected, strict=True)]
    assert np.mean(inside) >= 0.9
    assert np.median([one.rms_nm.value / rms for one, rms in zip(found, expected, strict=True)]) == pytest.approx(
        1.0, rel=0.12)
    # the density at low frequency, 4σ²θ, excites the lowest mode
    density = [one.rms_nm.value**2 * one.correlation_s.value for one in found]
    assert np.median(density) == pytest.approx(rms_nm**2 * correlation_s, rel=0.2)


@pytest.mark.heavy
def test_string_and_inertia_widen_the_interval():
    whole = record(drilled(200.0, 0.2, 2), 0)
    narrow, wide = bit_noise_in(whole, EXACT, EXACT_J), bit_noise_in(whole, STRING, INERTIA)
    assert wide.rms_nm.value == narrow.rms_nm.value
    assert wide.rms_nm.low < narrow.rms_nm.low < narrow.rms_nm.high < wide.rms_nm.high
    assert wide.rms_nm.low < 200.0 < wide.rms_nm.high
    assert 0.0 < wide.report_share < 0.1 and wide.segments >= 20
    scaled = bit_noise_in(replace(whole, scale_ends=(0.8, 1.2)), EXACT, EXACT_J).rms_nm
    assert scaled.value == narrow.rms_nm.value
    assert scaled.low < 0.85 * scaled.value and 1.15 * scaled.value < scaled.high


def test_unsuitable_records_are_refused_with_a_reason():
    case = drilled(200.0, 0.2, 2)
    whole = record(case, 0)
    with pytest.raises(SeverityRefused, match=r"has 3 segments of steady rotation; .* needs 8, which is 208 s"):
        bit_noise_in(part(whole, 110.0), STRING, INERTIA)
    with pytest.raises(SeverityRefused, match="noise of the reports is"):
        bit_noise_in(record(case, 0, noise=(0.2, 2000.0)), STRING, INERTIA)
    with pytest.raises(SeverityRefused, match=r"not that of a noise.*length and sizes"):
        bit_noise_in(whole, replace(string_with(length_m=2400.0), tolerance=EXACT_STRING), EXACT_J)
    slow = replace(whole, **{name: getattr(whole, name)[::25] for name in ("time_s", "speed_rad_s", "torque_nm")})
    with pytest.raises(SeverityRefused, match=r"a sample every 0\.5 s.*Record at 2\.3 Hz"):
        bit_noise_in(slow, STRING, INERTIA)
    time_s, torque, top = case      # the same motion at a fifth of the speed, forty times as large: the bit stops
    sticks = (time_s, 3000.0 + 40.0 * (torque - 3000.0), 0.5 * MEAN_RAD_S + 40.0 * (top - MEAN_RAD_S))
    with pytest.raises(SeverityRefused, match=r"without stick-slip|does not turn"):
        bit_noise_in(record(sticks, 0), STRING, INERTIA)


def test_the_tuning_uses_it_with_its_interval():
    string = with_noise(STRING, Interval(300.0, 200.0, 400.0), 0.4)
    assert (string.bit.noise_nm, string.bit.noise_correlation_s) == (300.0, 0.4)
    assert string.tolerance.noise_factor == pytest.approx(1.5)
    assert string.bit.coulomb_nm == STRING.bit.coulomb_nm and string.lines == STRING.lines
