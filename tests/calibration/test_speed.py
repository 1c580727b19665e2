"""``tdhil calibrate speed``: counted turns, position of a log, coverage, refusals, and the file."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tdhil.calibration import CountedTurns, calibrate_by_position, calibrate_by_turns
from tdhil.cli.main import main
from tdhil.errors import UsageError
from tdhil.estimation import AngleRatio, Verdict, mean_speed
from tdhil.recording import Level
from tdhil.report.calibration_page import scale_error
from tdhil.session import RunRecord, TurnsCount, add_speed_calibration, speed_by_position, speed_by_turns
from tests.calibration.bodies import IDENTITY
from tests.estimation.reporting import recorded

SCALE = 1.03
"""Reported over true speed."""
COUNTED = ["--turns", "100", "--seconds", "312.4", "--speed", "2.0"]
TORQUE = {"kind": "torque_calibration", "date": "2026-11-23T10:00:00+00:00", "drive": IDENTITY, "settings": {},
          "simulated": True, "calibration_factor": {"value": 0.95, "low": 0.94, "high": 0.96, "confidence": 0.95}}


def turning(seconds=120.0, lag=0.3, resolution=1e-3, scale=SCALE, position=True, last=None):
    """Return a shaft at about 4 rad/s, its lagged and rounded speed, and its angle in counts of 1/4096 turn."""
    time = np.arange(round(seconds * 50.0)) / 50.0
    slow = 2.0 * math.pi * 0.2
    angle = 4.0 * time + 0.5 / slow * np.sin(slow * time)
    speed = scale * (4.0 + 0.5 * np.cos(slow * (time - lag)))
    speed = resolution * np.round(speed / resolution)
    if last is not None:
        speed = np.where(time > seconds / 2.0, last / scale * speed, speed)
    count = 2.0 * math.pi / 4096.0
    return recorded(
        time, speed, np.full(len(time), 90.0) + 0.01 * np.arange(len(time)) % 7,
        levels=(Level(0.0, seconds / 2.0), Level(seconds / 2.0, seconds)), speed_resolution_rad_s=resolution,
        position_rad=count * np.round(angle / count) if position else None, simulated=True, gear_ratio=4.0)


def record(recording):
    return RunRecord(recording, {"identity": IDENTITY, "started": "2026-11-23T10:00:00+00:00"}, "run.mcap")


def test_counted_turns_give_the_factor_and_its_budget():
    found = calibrate_by_turns(CountedTurns(100.0, 0.25, 312.4, 0.3, 2.0, 0.002), 0.01)
    value = 2.0 * math.pi * 100.0 / (2.0 * 312.4)
    assert found.factor.value == pytest.approx(value)
    shares = [0.25 / 100.0, 0.3 / 312.4, 0.002 / 2.0]
    assert sorted(line.of_factor for line in found.budget) == pytest.approx(sorted(shares))
    assert found.factor.standard_uncertainty == pytest.approx(value * math.hypot(*shares))


def test_the_interval_of_a_count_covers():
    rng, many, covered = np.random.default_rng(3), 1000, 0
    for _ in range(many):
        seconds, speed = 300.0, 2.0
        counted = CountedTurns(
            speed / SCALE * seconds / (2.0 * math.pi) + 0.25 * rng.standard_normal(), 0.25,
            seconds + 0.3 * rng.standard_normal(), 0.3, speed + 0.002 * rng.standard_normal(), 0.002)
        factor = calibrate_by_turns(counted, 0.05).factor
        covered += factor.low <= 1.0 / SCALE <= factor.high
    assert 0.93 * many <= covered <= 0.97 * many


def test_too_few_turns_are_refused_with_the_required_number():
    few = CountedTurns(10.0, 0.25, 31.4, 0.3, 2.0, 0.001)
    found = calibrate_by_turns(few, 0.005)
    assert found.factor is None and f"count {found.least_turns} turns" in found.advice
    many = found.least_turns / few.turns
    enough = replace(few, turns=found.least_turns, seconds=many * few.seconds)
    assert calibrate_by_turns(enough, 0.005).factor.half_width_share == pytest.approx(0.005, rel=0.02)
    hopeless = calibrate_by_turns(replace(few, speed_sd_rad_s=0.1), 0.005)
    assert hopeless.factor is None and hopeless.least_turns is None


def test_a_wrong_unit_is_no_scale():
    found = calibrate_by_turns(CountedTurns(100.0, 0.1, 312.4, 0.1, 19.1, 0.001), 0.01)
    assert found.factor is None and "wrong unit" in found.reason


@pytest.mark.parametrize(("lag", "resolution"), [(0.0, 1e-4), (0.3, 1e-3), (0.5, 0.02)])
@pytest.mark.parametrize("seconds", [33.0, 121.3])
def test_the_position_of_a_log_gives_the_factor(lag, resolution, seconds):
    found = speed_by_position(record(turning(seconds, lag, resolution)), 0.2, 0.95)
    assert found.factor.low <= 1.0 / SCALE <= found.factor.high


def test_a_scale_that_changed_is_refused():
    found = speed_by_position(record(turning(last=1.2)), 0.2, 0.95)
    assert found.factor is None and "changed during the run" in found.reason


def test_a_log_without_a_position_is_refused():
    with pytest.raises(UsageError, match="no position"):
        speed_by_position(record(turning(position=False)), 0.01, 0.95)
    with pytest.raises(UsageError, match="no stretch"):
        speed_by_position(record(replace(turning(), levels=())), 0.01, 0.95)


def test_a_position_that_does_not_move_is_refused():
    """An encoder that is stuck on a count: a factor of 0 ended with a traceback."""
    found = calibrate_by_position([AngleRatio("stage 2", 0.0, 0.001)], 0.01)
    assert (found.verdict, found.factor) == (Verdict.MODEL_REJECTED, None)
    assert "no travel" in found.reason


def test_a_common_error_of_stretches_is_not_averaged_down():
    one, four = (calibrate_by_position([AngleRatio("stage 2", 0.97, 0.002)] * many, 0.1) for many in (1, 4))
    assert four.factor.standard_uncertainty == pytest.approx(one.factor.standard_uncertainty)


def test_turns_beside_a_log_count_its_mean_speed():
    recording = turning(lag=0.5, resolution=0.02)
    mean, bound = mean_speed(recording, 10.0, 110.0)
    true = SCALE * float(np.interp([10.0, 110.0], recording.time_s, recording.position_rad) @ [-1.0, 1.0]) / 100.0
    assert abs(mean - true) <= bound
    turns = true / SCALE * 100.0 / (2.0 * math.pi) / 4.0
    count = TurnsCount(turns, 0.05, seconds_sd=0.1, start_s=10.0, end_s=110.0)
    counted, found = speed_by_turns(count, record(recording), 4.0, 0.05, 0.95)
    assert counted.turns_sd == pytest.approx(0.2)
    assert found.factor.low <= 1.0 / SCALE <= found.factor.high
    for start, end in ((10.0, 130.0), (50.0, 50.0), (None, 110.0)):
        with pytest.raises(UsageError, match="times"):
            speed_by_turns(replace(count, start_s=start, end_s=end), record(recording), 4.0, 0.05, 0.95)


def test_a_gap_in_the_log_gives_no_mean_speed():
    recording = turning()
    fresh = recording.fresh & ~((recording.time_s > 50.0) & (recording.time_s < 51.0))
    assert mean_speed(replace(recording, fresh=fresh), 10.0, 110.0) is None


@pytest.mark.parametrize("more", [
    [], ["--turns", "100"], ["--turns", "nan", "--seconds", "300", "--speed", "2"], ["--seconds", "10"],
    [*COUNTED, "--from", "1"], [*COUNTED, "--turns-sd", "-1"], [*COUNTED, "--at", "main"], [*COUNTED, "--want", "2"],
    ["--turns", "-5", "--seconds", "300", "--speed", "2"], [*COUNTED, "--confidence", "2"],
])
def test_what_is_no_request_ends_with_2(more, capsys):
    assert main(["calibrate", "speed", *more]) == 2
    assert "Traceback" not in capsys.readouterr().err


def test_the_command_prints_a_card_a_document_and_refuses(capsys):
    assert main(["calibrate", "speed", *COUNTED]) == 0
    card = " ".join(capsys.readouterr().out.replace("│", "").split())
    assert "true speed = κ" in card and "0.56 % too little speed" in card
    assert "(0.9999 to 1.0113) ±0.57 %" in card and "The factor is known to ±0.57 %." in card     # 0.564 % both times
    assert main(["calibrate", "speed", "--turns", "25", "--seconds", "312.4", "--speed", "2.0", "--at", "main",
                 "--gear", "4", "--want", "5%", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["calibration_factor"]["value"] == pytest.approx(math.pi / 3.124)
    assert document["inputs"]["turns_sd"] == 1.0 and len(document["warnings"]) == 3
    assert main(["calibrate", "speed", "--turns", "10", "--seconds", "31.2", "--speed", "2"]) == 9


@pytest.mark.parametrize(("value", "half", "words"), [
    (1.0 / 1.0457, 0.0096, "4.6 % too much speed"), (1.0 / 1.04857, 0.0021, "4.86 % too much speed"),
    (1.0056, 0.0057, "0.56 % too little speed"), (0.9999984, 0.0019, "the true speed to ±0.20 %"),
    (1.0000016, 0.0019, "the true speed to ±0.20 %"),
])
def test_the_error_of_a_scale_has_the_digits_of_its_interval(value, half, words):
    assert scale_error({"value": value, "low": value - half, "high": value + half}, "speed") == words


def test_the_file_has_a_section_and_keeps_the_torque(tmp_path, capsys):
    kept = tmp_path / "calibration.json"
    kept.write_text(json.dumps(TORQUE))
    assert main(["calibrate", "speed", *COUNTED, "--save", str(kept)]) == 0
    assert "was not checked" in " ".join(capsys.readouterr().err.split())
    document = json.loads(kept.read_text())
    assert document.pop("speed_calibration")["calibration_factor"]["value"] == pytest.approx(1.0056, abs=1e-4)
    assert document == TORQUE and [one.name for one in tmp_path.iterdir()] == ["calibration.json"]
    before = kept.read_text()
    assert main(["calibrate", "speed", *COUNTED, "--save", str(kept)]) == 2
    assert "already" in capsys.readouterr().err
    assert kept.read_text() == before
    alone = tmp_path / "speed.json"
    assert main(["calibrate", "speed", *COUNTED, "--save", str(alone)]) == 0
    assert json.loads(alone.read_text())["kind"] == "speed_calibration"
    refused = tmp_path / "refused.json"
    assert main(["calibrate", "speed", *COUNTED, "--want", "0.01%", "--save", str(refused)]) == 9
    assert not refused.exists()


def test_a_file_that_cannot_be_written_has_its_code(tmp_path, capsys, monkeypatch):
    assert main(["calibrate", "speed", *COUNTED, "--save", str(tmp_path / "no" / "speed.json")]) == 2
    assert "can't be written" in (err := capsys.readouterr().err) and "TDH-206" in err
    kept = tmp_path / "calibration.json"
    kept.write_text(json.dumps(TORQUE))

    def refused(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "replace", refused)
    assert main(["calibrate", "speed", *COUNTED, "--save", str(kept)]) == 2
    assert "can't be written" in (err := capsys.readouterr().err) and "TDH-206" in err
    assert json.loads(kept.read_text()) == TORQUE and [one.name for one in tmp_path.iterdir()] == ["calibration.json"]


@pytest.mark.parametrize(("text", "words"), [("no JSON", "is no JSON"), ("{}", "no calibration"),
                                             (json.dumps(TORQUE), "another drive: its serial is 17, and 23")])
def test_a_file_of_another_kind_or_drive_is_not_changed(tmp_path, text, words):
    path = tmp_path / "calibration.json"
    path.write_text(text)
    with pytest.raises(UsageError, match=words):
        add_speed_calibration({"drive": {**IDENTITY, "serial": 23}, "settings": {}, "simulated": True}, path)
    assert path.read_text() == text
