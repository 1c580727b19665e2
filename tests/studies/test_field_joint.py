"""Several records as one: kept samples, and the expected slope of the paper's method."""

from itertools import pairwise

import numpy as np
import pytest

from tdhil.estimation import identify
from tdhil.estimation.result import Verdict
from tdhil.recording.recording import Excitation, Segment
from tdhil.studies.field.slopes import expected_slope, joined, slope_of
from tests.estimation.reporting import recorded

INERTIA, VISCOUS, COULOMB, SPEED_LAG, TORQUE_LAG = 104.0, 8.0, 60.0, 0.40, 0.15


def record(hertz, offset_rad_s, *, seed=0, torque_offset_nm=0.0, start_s=7.0, amplitude=1.0):
    """Return an exact periodic motion of a rigid shaft with two first-order lags and noise, at 50 Hz."""
    rng = np.random.default_rng(seed)
    time = start_s - 2.0 + 0.02 * np.arange(round((24.0 + 60.0) / 0.02))
    s = 2j * np.pi * hertz
    turn = np.exp(s * (time - start_s))
    speed = offset_rad_s + (amplitude * turn / (1.0 + SPEED_LAG * s)).real
    torque = VISCOUS * offset_rad_s + COULOMB + (
        (INERTIA * s + VISCOUS) * amplitude * turn / (1.0 + TORQUE_LAG * s)).real
    count = len(time)
    return recorded(
        time, speed + 0.003 * rng.standard_normal(count),
        torque + torque_offset_nm + 2.0 * rng.standard_normal(count),
        excitation=Excitation("sine", "speed", (
            Segment(
                start_s, start_s + 80.0, 1.0 / hertz, round(10 * hertz), offset_rad_s, (hertz,), (amplitude,), (0.0,)
            ),
        )),
        torque_offset_nm=torque_offset_nm,
        simulated=True,
    )


TONES = ((0.1, 5.0), (0.3, 5.0), (0.5, 4.0), (1.0, 2.0))


@pytest.fixture(scope="module")
def records():
    return [record(hertz, offset, seed=n, torque_offset_nm=3.0 * n) for n, (hertz, offset) in enumerate(TONES)]


def test_a_published_fit_of_the_four_slopes_is_reproduced():
    """J 103.75 and lags of 0.403 and 0.151 s give the published slopes within 0.10 kg·m² RMS (B = 0)."""
    slopes = expected_slope(np.array([0.1, 0.3, 0.5, 1.0]), 103.75, 0.0, 0.403, 0.151, 0.0)
    assert np.sqrt(np.mean((slopes - [105.379, 116.557, 135.622, 185.757]) ** 2)) == pytest.approx(0.10, abs=0.005)


def test_the_expected_slope_is_that_of_the_formula():
    omega = 2.0 * np.pi * np.array([0.05, 0.2, 0.9])
    formula = (
        INERTIA * (1.0 + omega**2 * SPEED_LAG * TORQUE_LAG) + VISCOUS * (SPEED_LAG - TORQUE_LAG)
    ) / (1.0 + omega**2 * TORQUE_LAG**2)
    found = expected_slope(omega / (2.0 * np.pi), INERTIA, VISCOUS, SPEED_LAG, TORQUE_LAG, 0.0)
    assert found == pytest.approx(formula, rel=1e-12)


@pytest.mark.heavy
def test_one_record_alone_is_not_identifiable_and_all_together_are(records):
    for alone in records:
        assert identify(alone).verdict is Verdict.NOT_IDENTIFIABLE
    together = identify(joined(records))
    assert together.verdict in (Verdict.VALID, Verdict.VALID_WIDE)
    assert together.inertia.low <= INERTIA <= together.inertia.high
    assert together.inertia.high - together.inertia.low < 0.02 * INERTIA
    assert together.speed_lag_s.value == pytest.approx(SPEED_LAG, abs=0.02)
    assert together.torque_lag_s.value == pytest.approx(TORQUE_LAG, abs=0.02)
    expected = expected_slope(np.array([0.3]), INERTIA, VISCOUS, SPEED_LAG, TORQUE_LAG, 0.0)
    assert slope_of(together, np.array([0.3])) == pytest.approx(expected, rel=0.01)


def test_time_rises_and_no_two_records_overlap(records):
    whole = joined(records)
    assert np.all(np.diff(whole.time_s) > 0.0)
    segments = whole.excitation.segments
    assert [segment.lines_hz[0] for segment in segments] == [hertz for hertz, _ in TONES]
    assert all(before.end_s < behind.start_s for before, behind in pairwise(segments))
    assert whole.torque_offset_nm == 0.0


def test_a_segment_keeps_its_samples(records):
    whole = joined(records)
    for own, segment in zip(records, whole.excitation.segments, strict=True):
        alone = own.excitation.segments[0]
        inside = (own.time_s >= alone.start_s) & (own.time_s < alone.end_s)
        moved = (whole.time_s >= segment.start_s - 1e-9) & (whole.time_s < segment.end_s - 1e-9)
        assert np.array_equal(own.speed_rad_s[inside], whole.speed_rad_s[moved])
        assert np.array_equal(own.torque_nm[inside] - own.torque_offset_nm, whole.torque_nm[moved])


def test_a_record_without_excitation_is_refused(records):
    from dataclasses import replace

    with pytest.raises(ValueError, match="without excitation"):
        joined([records[0], replace(records[1], excitation=None)])


def test_no_curve_without_a_number(records):
    assert slope_of(identify(records[0]), np.array([0.1])) is None
