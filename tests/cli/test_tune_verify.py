"""`tdhil tune verify` from the document of `tune speed`: refusals, the plan, and a whole run on the simulator."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from tdhil.cli.main import main
from tdhil.errors import ExitCode
from tdhil.recording.recording import MARGIN_S
from tdhil.session import read
from tdhil.session.verification import conclude_verification
from tdhil.speed_loop.verification import LEAST_PAIRS
from tests.cli.test_tune import estimate
from tests.cli.test_tune_speed import result
from tests.rigs import plant_file


@pytest.fixture
def tuned(tmp_path, capsys):
    """Return the document of `tune speed` for the embedded rig, and its file."""
    found, path = tmp_path / "result.json", tmp_path / "tune.json"
    found.write_text(json.dumps(result(
        gear_ratio=1.0, inertia_kg_m2=estimate(104.0, 100.0, 108.0), viscous_nm_s_rad=estimate(8.0, 7.6, 8.4),
        coulomb_nm=estimate(60.0, 58.0, 62.0), frequency_response=None)), encoding="utf-8")
    assert main(["tune", "speed", str(found), "--inner-lags", "20ms", "10ms", "--dead-time", "2ms", "--bandwidth",
                 "2", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    path.write_text(json.dumps(document), encoding="utf-8")
    return document, path


def test_the_plan_stays_within_the_limits_and_moves_nothing(tuned, capsys, monkeypatch):
    _, path = tuned
    assert main(["tune", "verify", str(path), "--simulate", "--dry-run", "--json"]) == 0
    plan = json.loads(capsys.readouterr().out)
    limits = plan["limits"]
    assert limits["speed_min_rad_s"] < plan["low_rad_s"] < plan["high_rad_s"] < limits["speed_max_rad_s"]
    assert plan["step_torque_nm"] < plan["limits"]["torque_nm"] and plan["duration_s"] < plan["limits"]["time_s"]
    monkeypatch.setenv("COLUMNS", "80")
    assert main(["tune", "verify", str(path), "--simulate", "--dry-run"]) == 0
    text = capsys.readouterr().out
    assert text.startswith("DRY RUN: nothing is connected, nothing moves\nSIMULATED")
    assert max(map(len, text.splitlines())) <= 80 and f"{plan['pairs']} pairs of steps" in text


def test_a_torque_limit_below_the_friction_of_the_tuning_is_refused_before_motion(tuned, capsys, tmp_path):
    """T_c + B ω = 60 + 8 · 7.15 = 117 N·m: the guard ended such a run after 42 s of motion."""
    document, path = tuned
    assert document["plant"]["coulomb_nm"]["value"] == 60.0
    rig = tmp_path / "rig.yaml"
    rig.write_text("limits: {speed_min_rad_s: 0.5, speed_max_rad_s: 10.0, torque_nm: 90, time_s: 900, "
                   "quick_stop_rad_s2: 2.0, watchdog_s: 0.5, probe_torque_nm: 80, probe_travel_rad: 3.0}\n")
    assert main(["tune", "verify", str(path), "--rig", str(rig), "--simulate", "--dry-run"]) == 4
    said = " ".join(capsys.readouterr().err.split())
    assert "rotation at 7.15 rad/s needs 117.2 N·m against friction, and the torque limit is 90 N·m" in said


@pytest.mark.parametrize(("content", "said"), [
    (b"\x89MCAP0\r\n", "is not JSON. Write one with: tdhil tune speed result.json --json > tune.json"),
    (b"{}", "is JSON, but not a tuning of tdhil tune speed. Write one with: tdhil tune speed"),
    (None, "does not exist. Write one with: tdhil tune speed"),
])
def test_a_file_of_another_kind_is_named_with_the_command_that_writes_it(tmp_path, capsys, content, said):
    path = tmp_path / "tune.json"
    if content is not None:
        path.write_bytes(content)
    assert main(["tune", "verify", str(path), "--simulate"]) == ExitCode.USAGE
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(("change", "words", "message"), [
    ({"controllers": []}, (), "it contains no tuned gains"),
    ({}, ("--use", "present"), "it contains no present gains"),
    ({"reported_speed_lag_s": None}, (), "has no lag of the reported speed"),
    ({"plant": {}}, (), "is not a tuning that tdhil tune speed wrote"),
])
def test_an_incomplete_file_is_refused_before_motion(tuned, capsys, tmp_path, change, words, message):
    document, path = tuned
    path.write_text(json.dumps(document | change), encoding="utf-8")
    code = main(["tune", "verify", str(path), "--simulate", "--log", str(tmp_path / "v.mcap"), *words])
    assert code == ExitCode.USAGE and message in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "v.mcap").exists()


@pytest.mark.heavy
def test_a_run_finds_a_wrongly_entered_gain_and_its_replay_agrees(tuned, capsys, tmp_path):
    document, path = tuned
    gains = document["controllers"][-1]
    log, page = tmp_path / "v.mcap", tmp_path / "v.html"
    plant = plant_file(tmp_path, f"drive:\n  speed_gain_nm_s_rad: {0.7 * gains['gain_nm_s_rad']}\n",
                       f"  speed_integral_gain_nm_rad: {gains['integral_nm_rad']}\n")
    code = main(["tune", "verify", str(path), "--simulate", "--plant", str(plant), "--seed", "5", "--log", str(log),
                 "--json"])
    live = json.loads(capsys.readouterr().out)
    assert code == ExitCode.NOT_PASSED and live["verdict"] == "differs"
    gain = next(row for row in live["rows"] if row["name"] == "gain_nm_s_rad")
    assert gain["measured"]["low"] < 0.7 * gains["gain_nm_s_rad"] < gain["measured"]["high"]
    pytest.importorskip("matplotlib")
    assert main(["replay", str(log), "--json", "--report", str(page)]) == code
    again = json.loads(capsys.readouterr().out)
    assert {name: again[name] for name in ("rows", "reason", "response")} == {
        name: live[name] for name in ("rows", "reason", "response")}
    text = page.read_text(encoding="utf-8")
    assert "SIMULATED" in text and text.count("<svg") == 1
    assert main(["replay", str(log)]) == code
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 80
    for pairs in (live["steps"]["counted_pairs"] - 3, 4):
        check_aborted(log, live, pairs)


def check_aborted(log, live, pairs):
    """Check an abort in the step after ``pairs``. Its samples continue, so the stop would be its response."""
    record = read(log)
    starts, half_s = record.configuration["verification"]["starts_s"], live["steps"]["half_s"]
    end_s = starts[2 * pairs + 1] + half_s + MARGIN_S + 0.5 * half_s       # the first pair does not count
    stages = tuple(replace(stage, outcome="aborted", end_s=end_s, detail="Interrupted: interrupted by Ctrl-C")
                   if stage.name == "acquire" else stage for stage in record.recording.stages)
    document = conclude_verification(replace(record.recording, stages=stages), record.configuration, "v").document
    assert document["steps"]["counted_pairs"] == pairs
    assert document["warnings"][0] == ("the run was aborted in stage acquire (interrupted by Ctrl-C). The result uses "
                                       "the data recorded before")
    if pairs < LEAST_PAIRS:
        assert document["verdict"] == "cannot_tell"
        assert document["next_step"] == "Remove the cause of the abort, and repeat the run."
    else:
        assert document["verdict"] == "differs"
