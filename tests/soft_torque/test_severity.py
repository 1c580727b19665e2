"""Stick-slip from surface signals, compared with a chain of masses whose bit speed is known (chain_in_time.py)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tdhil.soft_torque import (
    EXACT_STRING,
    RPM,
    Interval,
    PipeSection,
    SeverityRefused,
    SpeedController,
    StringFile,
    SurfaceRecord,
    reflection_at,
    severity,
    string_of,
)
from tdhil.soft_torque.torsional_severity import _measured, downhole_speed
from tests.soft_torque.cases import BIT, DRIVE, FIVE_INCH, PAPER, SOFT_035, STRING, BottomEnd
from tests.soft_torque.chain_in_time import recorded, reference_case, reported

pytestmark = pytest.mark.one_worker      # its fixture is expensive

INERTIA = Interval(1500.0, 1440.0, 1560.0)
PERIOD_S = 1.0 / 0.1299
LAGS_S = (0.1, 0.05)
EXACT = replace(STRING, tolerance=EXACT_STRING)


def gains(law: SpeedController):
    return (law.gain_nm_s_rad, law.integral_nm_rad, law.compensated_kg_m2, law.derivative_filter_s)


@pytest.fixture(scope="module")
def drilled():
    """Return simulated records by gains and set speed, rpm: (reported record, true speed of the bit)."""
    rpm = np.array([[100.0, 180.0], [100.0, 180.0]])
    time_s, torque, top, bit = recorded(**reference_case(
        laws=[gains(PAPER), gains(SOFT_035)], rpm=rpm, periods=20.0, lumps=14, own_noise=True))
    names = [("paper", 100), ("paper", 180), ("soft", 100), ("soft", 180)]
    return {name: (SurfaceRecord(*reported(time_s, torque[:, k], top[:, k], LAGS_S, k), *LAGS_S), bit[:, k])
            for k, name in enumerate(names)}


def late(record: SurfaceRecord, begin_s: float) -> SurfaceRecord:
    kept = record.time_s > begin_s
    return replace(record, time_s=record.time_s[kept], speed_rad_s=record.speed_rad_s[kept],
                   torque_nm=record.torque_nm[kept])


@pytest.mark.heavy
def test_stick_slip_is_found_at_once_with_its_frequency_and_downhole_amplitude(drilled):
    record, bit = drilled["paper", 100]
    found = severity(record, EXACT, INERTIA)
    assert found.level == "stick-slip"
    assert found.episodes[0].start_s - record.time_s[0] < 2.0 * PERIOD_S
    settled = record.time_s > 2.0 * PERIOD_S
    starts = record.time_s[1:][settled[1:] & (bit[1:] > 0.0) & (bit[:-1] == 0.0)]
    starts = starts[np.concatenate([[True], np.diff(starts) > 0.5 * PERIOD_S])]
    assert found.period_s.value == pytest.approx(np.mean(np.diff(starts)), rel=0.03)
    assert found.period_s.low <= np.mean(np.diff(starts)) <= found.period_s.high
    swing = 0.5 * np.ptp(bit[settled & (record.time_s < 4.0 * PERIOD_S)])
    assert found.downhole_rad_s.value == pytest.approx(swing, rel=0.15)
    assert found.index.low < found.index.value < found.index.high
    assert found.stick_slip_share > 0.9
    assert severity(record, STRING, INERTIA).downhole_rad_s.high > 1.1 * found.downhole_rad_s.high


@pytest.mark.heavy
def test_a_string_that_turns_raises_no_alarm(drilled):
    for name in (("soft", 100), ("soft", 180), ("paper", 180)):
        record, bit = drilled[name]
        calm = late(record, 10.0 * PERIOD_S)
        assert (bit[record.time_s > 10.0 * PERIOD_S] > 0.0).all()
        found = severity(calm, STRING, INERTIA)
        assert found.episodes == () and found.stick_slip_share == 0.0
        assert found.mean_rad_s == pytest.approx(name[1] * RPM, rel=0.02)
    assert found.level == "smooth"


def test_the_bits_speed_is_followed_through_sections_of_different_pipe():
    """`downhole_speed` in time recovers an oscillation of the bit from the signals that `at_top` gives at the top."""
    sections = (PipeSection(length_m=1500.0, **FIVE_INCH),
                PipeSection(length_m=400.0, outer_diameter_m=0.1651, inner_diameter_m=0.0714))
    string = string_of(StringFile(sections=sections, bottom=BottomEnd(inertia_kg_m2=200.0, **BIT)))
    step, hertz = 0.01, 0.21
    time_s = step * np.arange(3000)
    s = np.array([2j * np.pi * hertz])
    top, torque = string.at_top(s)
    turn = np.exp(s * time_s)
    found = downhole_speed((top * turn).real, (torque * turn).real, step, string)
    known = np.isfinite(found)
    assert known.sum() > 2500
    assert found[known] == pytest.approx(turn.real[known], abs=0.02)


@pytest.mark.heavy
def test_the_reflection_is_that_of_the_gains_in_place(drilled):
    for name, law in (("paper", PAPER), ("soft", SOFT_035)):
        record = late(drilled[name, 100][0], 2.0 * PERIOD_S)
        check = severity(record, EXACT, INERTIA, (DRIVE, law)).reflection
        hertz = np.array([0.5 * (check.from_hz + check.to_hz)])
        assert check.expected == pytest.approx(reflection_at(DRIVE, law, EXACT, hertz)[0])
        assert check.verdict == "as expected"
        assert check.measured.value == pytest.approx(check.expected, abs=0.1)
    assert severity(late(drilled["paper", 100][0], 20.0), EXACT, INERTIA,
                    (DRIVE, SOFT_035)).reflection.verdict == "reflects more"


@pytest.mark.heavy
def test_a_record_without_information_is_refused(drilled):
    record, _ = drilled["soft", 180]
    with pytest.raises(SeverityRefused, match="does not turn"):
        severity(replace(record, speed_rad_s=0.0 * record.speed_rad_s), STRING, INERTIA)
    slow = replace(record, **{name: getattr(record, name)[::60] for name in ("time_s", "speed_rad_s", "torque_nm")})
    with pytest.raises(SeverityRefused, match=r"a sample every 1\.2 s.*needs 16 samples"):
        severity(slow, STRING, INERTIA)
    with pytest.raises(SeverityRefused, match="3 periods"):
        severity(late(record, record.time_s[-1] - 2.0 * PERIOD_S), STRING, INERTIA)
    gaps = record.time_s % 15.0 < 12.0
    with pytest.raises(SeverityRefused, match="free of gaps"):
        severity(SurfaceRecord(record.time_s[gaps], record.speed_rad_s[gaps], record.torque_nm[gaps]), STRING, INERTIA)
    quiet = severity(replace(record, speed_rad_s=np.full_like(record.time_s, 10.0),
                             torque_nm=np.full_like(record.time_s, 3000.0)), STRING, INERTIA)
    assert quiet.level == "smooth" and quiet.period_s is None and quiet.reflection is None


# Speed and torque of a stiff top drive above an oscillating string, 50 samples a second, with noise of the reports.
SECONDS = 0.02 * np.arange(9000)


def oscillating(period_s=5.5, speed_rad_s=0.03, torque_nm=2500.0):
    random, turn = np.random.default_rng(3), 2.0 * np.pi * SECONDS / period_s
    return SurfaceRecord(SECONDS, 12.0 + speed_rad_s * np.cos(turn) + 0.002 * random.standard_normal(len(turn)),
                         8000.0 + torque_nm * np.sin(turn) + 50.0 * random.standard_normal(len(turn)))


def rounded(record: SurfaceRecord, speed_rad_s: float, torque_nm: float):
    return replace(record, speed_rad_s=np.round(record.speed_rad_s / speed_rad_s) * speed_rad_s,
                   torque_nm=np.round(record.torque_nm / torque_nm) * torque_nm)


@pytest.mark.parametrize("steps", [(1e-6, 1e-3), (0.001, 10.0), (0.01, 100.0)])
@pytest.mark.parametrize("names", [("torque_nm",), ("speed_rad_s",), ("torque_nm", "speed_rad_s")])
def test_a_frozen_half_is_left_out_and_named(names, steps):
    record = rounded(oscillating(), *steps)
    whole = severity(record, EXACT, INERTIA)
    spoilt = replace(record, **{name: np.where(SECONDS < 90.0, getattr(record, name), getattr(record, name)[4500])
                                for name in names})
    found = severity(spoilt, EXACT, INERTIA)
    assert whole.left_out == () and len(found.left_out) == len(names)
    for name, said in zip(names, found.left_out, strict=True):
        assert f"The reported {name.split('_')[0]} did not change for 90" in said
    assert found.turning_s < 91.0
    assert found.index.value == pytest.approx(whole.index.value, rel=0.02)
    assert found.period_s.value == pytest.approx(5.5, rel=0.01)


def held(record: SurfaceRecord, count: int):
    at = np.arange(len(SECONDS)) // count * count
    return replace(record, speed_rad_s=record.speed_rad_s[at], torque_nm=record.torque_nm[at])


def ramps(record: SurfaceRecord):
    """Return a drive that reports whole revolutions a minute: constant, with ramps and an overshoot between."""
    rpm = np.interp(SECONDS, [0, 60, 65, 66, 67, 120, 125, 180], [100, 100, 130, 135, 130, 130, 80, 80])
    return replace(record, speed_rad_s=np.round(rpm) * RPM)


@pytest.mark.parametrize("record", [
    *(rounded(oscillating(), *steps) for steps in ((0.005, 500.0), (0.02, 2000.0), (0.1, 5000.0))),
    held(oscillating(), 10), held(oscillating(), 50), rounded(held(oscillating(), 25), 0.005, 500.0),
    ramps(oscillating()),
    rounded(oscillating(torque_nm=0.0), 0.005, 200.0),
    replace(oscillating(), speed_rad_s=np.full(len(SECONDS), 12.0)),
])
def test_a_signal_that_is_held_rounded_or_constant_is_not_frozen(record):
    kept, said = _measured(record, 7.7)
    assert said == () and len(kept.time_s) == len(SECONDS)


@pytest.mark.parametrize(("speed", "torque"), [(1.0, -1.0), (-1.0, 1.0)])
def test_a_top_drive_that_would_brake_is_refused(speed, torque):
    record = oscillating()
    with pytest.raises(SeverityRefused, match="the top drive would brake"):
        severity(replace(record, speed_rad_s=speed * record.speed_rad_s, torque_nm=torque * record.torque_nm), EXACT,
                 INERTIA)
