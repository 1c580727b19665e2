"""rig.yaml in the units of the manuals: converted and shown, or refused, but never read as a bare number."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from drivers.errors import DataFileError
from profiles.yaml_loader import load_model
from tdhil.buses.canopen import CAN_BIT_RATES, bit_rate_problem
from tdhil.cli.main import main
from tdhil.config.rig import Rig, load_rig
from tdhil.errors import UsageError
from tests.rigs import NUMBERS, limits_text, rig_file


def rig(tmp_path: Path, limits: dict[str, str | None], more: str = "") -> Path:
    return rig_file(tmp_path, limits_text(**limits), more)


@pytest.mark.parametrize(("key", "written", "value"), [
    ("speed_max_rad_s", "100 rpm", 10.471975511965978), ("speed_max_rad_s", "100 1/min", 10.471975511965978),
    ("torque_nm", "2 kNm", 2000.0), ("time_s", "15min", 900.0), ("watchdog_s", "200 ms", 0.2),
    ("probe_travel_rad", "90°", 1.5707963267948966), ("quick_stop_rad_s2", "20 rpm/s", 2.0943951023931953),
])
def test_a_value_with_its_unit_is_converted_and_both_are_told(tmp_path, key, written, value):
    bench = load_rig(rig(tmp_path, {key: written}))
    assert bench.get(f"limits.{key}") == pytest.approx(value, rel=1e-15)
    ((said, text, source),) = bench.conversions
    assert said == f"limits.{key}"
    assert text.startswith(f"{written} = ")
    assert source == f"rig.yaml:{list(NUMBERS).index(key) + 2}"


@pytest.mark.parametrize(("ours", "key", "written", "value"), [
    ("speed_max_rad_s", "speed_max_rpm", "100", 10.471975511965978),
    ("speed_min_rad_s", "speed_min_rpm", "5", 0.5235987755982988),
    ("quick_stop_rad_s2", "quick_stop_rpm_s", "20", 2.0943951023931953),
    ("probe_travel_rad", "probe_travel_deg", "90", 1.5707963267948966),
    ("torque_nm", "torque_knm", "2", 2000.0), ("watchdog_s", "watchdog_ms", "200", 0.2),
    ("speed_max_rad_s", "speed_max_rpm", "100 rpm", 10.471975511965978),
])
def test_a_key_in_the_manual_s_unit(tmp_path, ours, key, written, value):
    bench = load_rig(rig(tmp_path, {ours: None, key: written}))
    assert bench.get(f"limits.{ours}") == pytest.approx(value, rel=1e-15)
    assert bench.line(f"limits.{ours}") == 9
    assert bench.conversions[0][0] == f"limits.{ours}"


@pytest.mark.parametrize(("limits", "more", "line", "words"), [
    ({"speed_max_rpm": "100"}, "", 10, "'speed_max_rpm' and 'speed_max_rad_s' (line 3) are the same quantity"),
    ({"speed_max_rad_s": None, "speed_max_rpm": "100 rad/s"}, "", 9, "the key says rpm, the value rad/s"),
    ({"speed_max_rad_s": None, "speed_max_rpm": "fast"}, "", 9, "must be a number in rpm"),
    ({"speed_max_rad_s": "100 1/s"}, "", 3, "'1/s' is not a unit of speed"),
    ({"speed_max_rad_s": "15 min"}, "", 3, "min is a unit of time, not of speed"),
    ({"torque_nm": "50 %"}, "", 4, "% is a unit of share, not of torque"),
    ({"torque_nm": "2 kNm", "probe_torque_nm": "3 kNm"}, "", 8, "must not be above torque_nm, which is 2000"),
    ({"speed_max_rad_s": "1e9 rpm"}, "", 3, "must be at most 100000, not 1.047e+08 (1e9 rpm)"),
    ({"probe_travel_rad": "3 furlong"}, "", 9, "is not a unit of angle"),
    ({"torque_nm": "1e308"}, "", 4, "must be at most 1e+07"),
    ({}, "run: {seed: 500k}", 10, "write the number alone: this key has no unit"),
    ({}, "run: {periods: 5 periods}", 10, "write the number alone: this key has no unit"),
    ({}, "bus: {bitrate: 500}", 10, "500 bit/s is not a CAN bit rate; 500k is one: 500000"),
    ({}, "bus: {bitrate: 240k}", 10, "the nearest is 250000"),
    ({}, "bus: {bitrate: 15 min}", 10, "not of bit rate"),
])
def test_what_is_refused_offers_no_wrong_number(tmp_path, limits, more, line, words):
    with pytest.raises(DataFileError) as caught:
        load_rig(rig(tmp_path, limits, more))
    problems = [(problem.line, problem.message) for problem in caught.value.problems]
    assert any(at == line and words in message for at, message in problems), problems
    assert "write 100" not in str(caught.value)
    assert len(problems) == 1


def test_text_stays_text(tmp_path):
    bench = load_rig(rig(tmp_path, {}, "bus: {channel: 500k, options: {tty: 5 min}}\nprofile: 90 rpm"))
    assert (bench.bus.channel, bench.bus.options["tty"], bench.profile, bench.conversions) == (
        "500k", "5 min", "90 rpm", ()
    )


def test_the_dry_run_shows_both(tmp_path, capsys):
    path = rig(tmp_path, {"speed_max_rad_s": "100 rpm"}, "run: {excitation: sine, frequency_hz: 0.2, tolerance: 5%}")
    assert main(["identify", "--dry-run", "--rig", str(path)]) == 0
    said = capsys.readouterr().out
    assert "limits.speed_max_rad_s: 100 rpm = 10.47 rad/s  (rig.yaml:3)" in said
    assert "0.5 to 10.47 " in said
    assert "4.775 to 100 rpm " in said
    assert main(["identify", "--dry-run", "--json", "--rig", str(path)]) == 0
    converted = json.loads(capsys.readouterr().out)["converted"]
    assert ["run.tolerance", "5% = 0.05", "rig.yaml:10"] in converted


def test_in_files_without_a_conversion_the_message_states_the_value(tmp_path):
    with pytest.raises(DataFileError, match=r"'100 rpm' is 10\.471975512 rad/s; write limits\.speed_max_rad_s as"):
        load_model(rig(tmp_path, {"speed_max_rad_s": "100 rpm"}), Rig)


@pytest.mark.parametrize("bit_s", [10_000, 20_000, 50_000, 83_333, 100_000, 125_000, 250_000, 500_000, 1_000_000])
def test_bit_rates_of_can(bit_s):
    assert bit_rate_problem(bit_s) == ""


@pytest.mark.parametrize("bit_s", [0, 1, 500, 125, 9600, 115_200, 499_999, 2_000_000])
def test_bit_rates_that_can_does_not_have(bit_s):
    assert str(next(one for one in CAN_BIT_RATES if str(one) in bit_rate_problem(bit_s)))


def test_the_command_line_and_the_environment_know_the_same_rates(monkeypatch, tmp_path, capsys):
    from tdhil.buses.canopen import can_line

    monkeypatch.setenv("HOME", str(tmp_path))
    with pytest.raises(UsageError, match="500 bit/s is not a CAN bit rate"):
        can_line({"interface": "socketcan", "bitrate": 500})
    monkeypatch.setenv("CAN_BITRATE", "500")
    with pytest.raises(UsageError, match=r"CAN_BITRATE: bitrate 500 bit/s"):
        can_line({"interface": "socketcan"})


def test_options_accept_units(capsys):
    import argparse

    from tdhil.cli.identify import add_arguments

    parser = argparse.ArgumentParser()
    add_arguments(parser)
    found = parser.parse_args(["--amplitude", "15rpm", "--offset", "40 1/min", "--max-time", "5min",
                               "--tolerance", "1%", "--frequency", "50mHz", "-b", "500k", "--confidence", "95%"])
    assert found.amplitude_rad_s == pytest.approx(1.5707963)
    assert (found.max_time_s, found.tolerance, found.frequency_hz, found.bitrate, found.confidence) == (
        300.0, 0.01, 0.05, 500_000, 0.95
    )
    with pytest.raises(SystemExit):
        parser.parse_args(["--amplitude", "15 Hz"])
    assert "Hz is a unit of frequency, not of speed" in capsys.readouterr().err
