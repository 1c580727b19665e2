"""Record of a reference sensor beside a log: offset, frequency band, coverage, and each refusal by name."""

import json
from dataclasses import replace

import numpy as np
import pytest

from profiles import MessageCode, TdhilError
from tdhil.calibration import TorqueRecord, calibrate_reference
from tdhil.cli.main import main
from tdhil.errors import CsvUnusable
from tdhil.recording import REFERENCE_FLAG, TIME_AND_TORQUE, parse_columns, read_reference
from tests.calibration.reference_records import FINE_S, SensorBench, lagging, random_bench, records


def found_of(bench, seed=1, **more):
    return calibrate_reference(*records(bench, np.random.default_rng(seed)), **{"reference_rel_sd": 0.0, **more})


@pytest.fixture(scope="module")
def plain():
    return found_of(SensorBench())


def test_the_factor_the_offset_and_the_time_are_found(plain):
    bench = SensorBench()
    assert plain.refusal == ""
    assert plain.factor.low <= bench.factor <= plain.factor.high and plain.factor.half_width_share < 0.01
    assert plain.offset_nm.low <= bench.offset_nm <= plain.offset_nm.high
    # A difference between the filters of sensor and report is also a delay.
    assert plain.time_offset_s == pytest.approx(
        bench.time_offset_s + bench.sensor_lag_s - bench.report_lag_s, abs=0.01)


def test_the_budget_adds_up_and_contains_the_scale_of_the_sensor(plain):
    squares = np.sqrt(sum(line.of_factor**2 for line in plain.budget))
    assert squares * plain.factor.value == pytest.approx(plain.factor.standard_uncertainty, rel=1e-9)
    stated = found_of(SensorBench(), reference_rel_sd=0.01)
    assert stated.factor.standard_uncertainty == pytest.approx(
        np.hypot(plain.factor.standard_uncertainty, 0.01 * plain.factor.value), rel=1e-9)


@pytest.mark.heavy
def test_a_slow_sensor_with_another_rate_does_not_change_the_factor():
    """A filter of 0.5 s reduces a line at 0.08 Hz by 3 %. Without its variance in the fit, κ would have this error."""
    slow = found_of(SensorBench(sensor_lag_s=0.5, report_lag_s=0.0, sensor_rate_hz=17.0, report_noise_nm=0.3,
                                sensor_noise_nm=0.3))
    assert slow.factor.value == pytest.approx(0.95, rel=0.004)
    assert slow.filter_s == pytest.approx(0.5, rel=0.3)


@pytest.mark.heavy
def test_correlated_residuals_widen_the_interval(plain):
    noisy = found_of(SensorBench(slow_noise_nm=1.0))
    assert noisy.effective_samples < 0.5 * plain.effective_samples
    assert noisy.factor.standard_uncertainty > 1.5 * plain.factor.standard_uncertainty


@pytest.mark.parametrize("runs", [pytest.param(30, marks=pytest.mark.heavy), pytest.param(200, marks=pytest.mark.long)])
def test_the_interval_covers(runs):
    """Offset, noise, delay, rate and low-pass filter are random in each case."""
    covered = []
    for seed in range(runs):
        rng = np.random.default_rng([28, seed])
        bench = random_bench(rng)
        found = calibrate_reference(*records(bench, rng), reference_rel_sd=0.0)
        if found.refusal:
            assert "too little" in found.refusal, seed
            continue
        covered.append(found.factor.low <= bench.factor <= found.factor.high)
    assert len(covered) >= 0.95 * runs and np.mean(covered) >= 0.93


@pytest.mark.parametrize(("factor", "codes"), [(0.88, [MessageCode.FACTOR_UNLIKE_SCALE]), (0.98, [])])
def test_a_factor_that_contradicts_the_stated_scale_gives_a_warning(factor, codes):
    assert [one.entry for one in found_of(SensorBench(factor=factor)).warnings] == codes


def shortened(record, keep):
    return TorqueRecord(record.time_s[keep], record.torque_nm[keep], record.count_nm)


def test_what_cannot_be_calibrated_is_refused_by_name():
    drive, sensor = records(SensorBench(), np.random.default_rng(3))
    rng = np.random.default_rng(4)
    other = replace(sensor, torque_nm=rng.standard_normal(len(sensor.time_s)).cumsum())
    for told, one in (
        ("opposite sign", replace(sensor, torque_nm=-sensor.torque_nm)),
        ("correlation of both torques is too low", other),
        ("no overlap", shortened(sensor, sensor.time_s < sensor.time_s[0] + 5.0)),
        ("varies too little", replace(sensor, torque_nm=np.full(len(sensor.time_s), 80.0))),
        ("varies too little", replace(sensor, torque_nm=np.round(sensor.torque_nm / 50.0) * 50.0, count_nm=50.0)),
        ("no error of a torque scale", replace(sensor, torque_nm=2.0 * sensor.torque_nm)),
    ):
        found = calibrate_reference(drive, one)
        assert told in found.refusal and found.advice, found.refusal
    little = found_of(SensorBench(swing_nm=8.0, report_noise_nm=4.0, sensor_noise_nm=4.0, slow_noise_nm=1.0))
    assert "too little" in little.refusal or "too low" in little.refusal


@pytest.mark.parametrize("lag_s", [0.0, 0.5])
def test_a_single_tone_gives_no_scale(lag_s):
    """A sensor with a filter of 0.5 s shows 95 % of a tone of 0.1 Hz, like one with a wrong scale."""
    rng, time = np.random.default_rng(1), np.arange(0.0, 200.0, FINE_S)
    torque = 100.0 + 60.0 * np.sin(0.2 * np.pi * time)
    some = slice(10_000, None, 5)
    drive, sensor = (TorqueRecord(time[some], one[some] + rng.standard_normal(len(time[some])))
                     for one in (torque, lagging(torque, lag_s)))
    assert "too few frequencies" in calibrate_reference(drive, sensor).refusal


def test_a_value_that_is_no_number_or_a_time_that_decreases_is_an_error():
    drive, sensor = records(SensorBench(), np.random.default_rng(3))
    with pytest.raises(ValueError, match="no number"):
        calibrate_reference(drive, replace(sensor, torque_nm=np.full(len(sensor.time_s), np.nan)))
    with pytest.raises(ValueError, match="does not rise"):
        calibrate_reference(drive, replace(sensor, time_s=sensor.time_s[::-1]))


ROWS = [f"{0.1 * k:.1f},{k % 7}" for k in range(40)]


@pytest.mark.parametrize(("text", "words"), [
    ("time_s\n1\n2\n", "there is no table"),
    ("time_s,torque_nm\n" + "\n".join([*ROWS[:9], "0.9,nan", *ROWS[10:]]), ":11: a reference must be whole"),
    ("time_s,torque_nm\n" + "\n".join([*ROWS[:9], "0.25,3", *ROWS[10:]]), "time goes back"),
    ("time_s,torque_pct\n" + "\n".join(ROWS), "not as a share"),
    ("time_s,torque_kg\n" + "\n".join(ROWS), "no column is called torque"),
    ("time_s,speed_rpm\n" + "\n".join(ROWS), "no column is called torque"),
    ("time_s,torque [kg]\n" + "\n".join(ROWS), "is not a unit of torque"),
    ("", "empty"),
])
def test_an_invalid_reference_file(tmp_path, text, words):
    path = tmp_path / "sensor.csv"
    path.write_text(text)
    assert main(["calibrate", "torque", str(path), "--reference", str(path)]) in (2, 10)
    with pytest.raises(TdhilError, match=words):
        read_reference(path, parse_columns((), TIME_AND_TORQUE, REFERENCE_FLAG))


def test_a_repeated_row_has_no_effect(tmp_path):
    path = tmp_path / "sensor.csv"
    path.write_text("time_s,torque_nm\n" + "\n".join([*ROWS[:9], ROWS[8], *ROWS[9:]]))
    assert len(read_reference(path, parse_columns((), TIME_AND_TORQUE, REFERENCE_FLAG)).time_s) == len(ROWS)
    path.write_text("time_s,torque_nm\n" + "\n".join([*ROWS[:9], "0.8,99", *ROWS[9:]]))
    with pytest.raises(CsvUnusable, match="repeats itself"):
        read_reference(path, parse_columns((), TIME_AND_TORQUE, REFERENCE_FLAG))


@pytest.fixture
def files(tmp_path):
    """Write a trace of the drive and a record of the sensor in kN·m, with other names."""
    drive, sensor = records(SensorBench(swing_nm=2000.0, duration_s=120.0), np.random.default_rng(5))
    (tmp_path / "drive.csv").write_text("time_s,speed_rad_s,torque_nm\n" + "".join(
        f"{t:.6f},3.0,{y:.3f}\n" for t, y in zip(drive.time_s, drive.torque_nm, strict=True)))
    (tmp_path / "sensor.csv").write_text("t;M\n" + "".join(
        f"{t:.6f};{y / 1000.0:.6f}\n" for t, y in zip(sensor.time_s, sensor.torque_nm, strict=True)))
    return [str(tmp_path / "drive.csv"), "--reference", str(tmp_path / "sensor.csv"), "--column", "time=t:s",
            "torque=M:kNm"]


@pytest.mark.parametrize(("at", "gear", "warned"), [("main", "2", True), ("main", "1", False), ("motor", "2", False)])
def test_a_sensor_behind_a_gear_gives_a_warning(files, capsys, at, gear, warned):
    """A gear with an efficiency of 0.96 gave κ = 0.960 ± 0.006 without a warning."""
    main(["calibrate", "torque", *files, "--at", at, "--gear", gear, "--json"])
    document = json.loads(capsys.readouterr().out)
    assert ("TDH-065" in document["warning_codes"]) is warned
    assert any("the loss of the gear is in the factor" in one for one in document["warnings"]) is warned


@pytest.mark.heavy
def test_the_command_prints_saves_and_reports(files, tmp_path, capsys):
    saved, page = tmp_path / "calibration.json", tmp_path / "page.html"
    torque = ["calibrate", "torque"]
    assert main([*torque, *files, "--save", str(saved), "--report", str(page)]) == 0
    card = capsys.readouterr().out
    assert "calibration factor" in card and "time offset" in card and "--reference-sd" in " ".join(card.split())
    assert all(len(line) <= 80 for line in card.splitlines())
    document = json.loads(saved.read_text())
    factor = document["calibration_factor"]
    assert factor["low"] <= 0.95 <= factor["high"] and document["method"] == "reference"
    assert "Uncertainty budget" in page.read_text() and "<svg" in page.read_text()
    assert main([*torque, *files, "--save", str(saved)]) == 2
    assert main([*torque, *files, "--added", "5"]) == 2
    assert main([*torque, *files, "--pairs", "pairs.csv"]) == 2
    assert main([*torque, *files, "--reference-sd", "200%"]) == 2
    assert main([*torque, files[0], "--added", "5", "--reference-sd", "0.1%"]) == 2
    assert main([*torque, *files[1:]]) == 2
    assert main(["replay", files[0], "--torque-calibration", str(saved)]) in (0, 9)
