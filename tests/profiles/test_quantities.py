"""Numbers with units, in the notations of manuals, users and messages."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from profiles import quantities as q

# Derived by hand, not from the tested table.
KNOWN = [
    ("100 rpm", q.SPEED, 100 * 2 * math.pi / 60), ("100rpm", q.SPEED, 10.471975511965978),
    ("100 1/min", q.SPEED, 10.471975511965978), ("100 min⁻¹", q.SPEED, 10.471975511965978),
    ("100 min-1", q.SPEED, 10.471975511965978), ("100 U/min", q.SPEED, 10.471975511965978),
    ("100 r/min", q.SPEED, 10.471975511965978), ("3 rad/s", q.SPEED, 3.0), ("360 °/s", q.SPEED, 2 * math.pi),
    ("2 rev/s", q.SPEED, 4 * math.pi), ("60 rpm/s", q.ACCELERATION, 2 * math.pi), ("2 rad/s²", q.ACCELERATION, 2.0),
    ("2 rad/s^2", q.ACCELERATION, 2.0), ("180 deg/s²", q.ACCELERATION, math.pi), ("90°", q.ANGLE, math.pi / 2),
    ("90 deg", q.ANGLE, math.pi / 2), ("0.5 turns", q.ANGLE, math.pi), ("1 rad", q.ANGLE, 1.0),
    ("2 kN·m", q.TORQUE, 2000.0), ("2 kNm", q.TORQUE, 2000.0), ("2kN m", q.TORQUE, 2000.0), ("2 Nm", q.TORQUE, 2.0),
    ("2 N.m", q.TORQUE, 2.0), ("100 lbf·ft", q.TORQUE, 135.58179483314004), ("5 kN·m/s", q.TORQUE_RATE, 5000.0),
    ("5 N·m/s", q.TORQUE_RATE, 5.0), ("8 N·m·s/rad", q.FRICTION, 8.0), ("1 N·m/rpm", q.FRICTION, 30 / math.pi),
    ("104 kg·m²", q.INERTIA, 104.0), ("104 kg m^2", q.INERTIA, 104.0), ("50 kg·cm²", q.INERTIA, 0.005),
    ("15 min", q.TIME, 900.0), ("15min", q.TIME, 900.0), ("1.5 h", q.TIME, 5400.0), ("500 ms", q.TIME, 0.5),
    ("90 s", q.TIME, 90.0), ("50 mHz", q.FREQUENCY, 0.05), ("0.1 Hz", q.FREQUENCY, 0.1), ("80 °C", q.TEMPERATURE, 80.0),
    ("1 kHz", q.FREQUENCY, 1e3),
    ("1 %", q.SHARE, 0.01), ("0.35%", q.SHARE, 0.0035), ("20 ‰", q.SHARE, 0.02), ("500k", q.BIT_RATE, 500e3),
    ("500 kbit/s", q.BIT_RATE, 500e3), ("1M", q.BIT_RATE, 1e6), ("-5 rpm", q.SPEED, -0.5235987755982988),
    ("+1e2 rpm", q.SPEED, 10.471975511965978), (".5 s", q.TIME, 0.5), ("7", q.SPEED, 7.0),
]


@pytest.mark.parametrize(("text", "unit", "value"), KNOWN, ids=[text for text, _, _ in KNOWN])
def test_read(text, unit, value):
    assert q.read(text, unit) == pytest.approx(value, rel=1e-15)


def test_a_share_is_exact():
    assert (q.read("0.35 %", q.SHARE), q.read("1%", q.SHARE), q.read("5 ms", q.TIME)) == (0.0035, 0.01, 0.005)


@pytest.mark.parametrize(("text", "unit"), [
    ("100 1/s", q.SPEED),          # revolutions or radians
    ("50 Hz", q.SPEED),            # of the shaft or of the motor's supply
    ("15 m", q.TIME), ("5 mnm", q.TORQUE), ("5 MNm", q.TORQUE), ("5 MHz", q.FREQUENCY), ("1 m", q.BIT_RATE),
    ("50 %", q.TORQUE), ("15 min", q.SPEED), ("100 rpm", q.TORQUE), ("1 000 rpm", q.SPEED), ("1,5 rpm", q.SPEED),
    ("1_000 rpm", q.SPEED), ("100-200 rpm", q.SPEED), ("1.5.2 s", q.TIME), ("rpm", q.SPEED), ("", q.SPEED),
    ("nan", q.SPEED), ("inf rpm", q.SPEED), ("1e999 rpm", q.SPEED), ("0x10 rpm", q.SPEED), ("9" * 400, q.SPEED),
])
def test_an_ambiguous_text_is_not_read(text, unit):
    with pytest.raises(ValueError) as caught:
        q.read(text, unit)
    assert "write" not in str(caught.value)      # no number is offered, since the stated unit was intended


@pytest.mark.parametrize("text", ["0,5", "0,5 Hz", "1,000 Hz"])
def test_a_comma_is_reported_as_the_error(text):
    with pytest.raises(ValueError, match="a decimal point and no comma"):
        q.read(text, q.FREQUENCY)


@pytest.mark.heavy
@given(st.text(max_size=30), st.sampled_from([q.SPEED, q.TORQUE, q.TIME, q.SHARE, q.BIT_RATE]))
def test_anything_typed_is_a_finite_number_or_refused(text, unit):
    try:
        value = q.read(text, unit)
    except ValueError as error:
        assert str(error)
    else:
        assert math.isfinite(value)


@pytest.mark.parametrize(("key", "unit"), [
    ("speed_max_rad_s", "rad/s"), ("quick_stop_rad_s2", "rad/s²"), ("torque_nm", "N·m"), ("torque_ramp_nm_s", "N·m/s"),
    ("viscous_nm_s_rad", "N·m·s/rad"), ("probe_travel_rad", "rad"), ("inertia_kg_m2", "kg·m²"), ("time_s", "s"),
    ("rate_hz", "Hz"), ("tolerance", "1"), ("torque_scale_rel_sd", "1"), ("speed_lag_sd_s", "s"),
    ("speed_max_rpm", "rpm"), ("watchdog_ms", "ms"), ("dahl_stiffness_nm_rad", "N·m/rad"), ("bitrate", "bit/s"),
    ("periods", None), ("seed", None), ("node", None), ("time_min", None), ("ratio", None),
])
def test_unit_of_a_key(key, unit):
    found = q.unit_of_key(key)
    assert (found and found.symbol) == unit


def test_keys_of_one_quantity():
    assert q.same_quantity("speed_max_rpm", "speed_max_rad_s")
    assert q.same_quantity("tolerance_percent", "tolerance")
    assert not q.same_quantity("speed_max_rpm", "speed_min_rad_s")
    assert not q.same_quantity("torque_rpm", "torque_nm")
    assert not q.same_quantity("torque_nm", "torque_nm")


@pytest.mark.parametrize(("value", "text"), [
    (8.829e-12, "0"), (-3e-13, "0"), (20000.0, "20000"), (123456.0, "123500"), (0.00012345, "0.0001234"), (2.5, "2.5"),
])
def test_a_number_without_an_interval_has_no_exponent_and_no_rounding_errors(value, text):
    assert q.plain_number(value) == text


@pytest.mark.parametrize(("torque_nm", "text"), [
    (1143.04, "1143 N·m"), (12346.0, "12350 N·m"), (-0.2133, "-0.2133 N·m"), (0.8, "0.8 N·m"), (-1e-12, "0 N·m"),
])
def test_a_torque_in_a_message_fits_a_top_drive_and_a_servo(torque_nm, text):
    assert q.in_nm(torque_nm) == text
