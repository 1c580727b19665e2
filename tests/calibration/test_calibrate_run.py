"""``tdhil identify --calibrate``: two runs with a prompt between them, then the calibration."""

import argparse
import io
import json
import sys
from pathlib import Path

import pytest
from rich.console import Console

from drivers import PreflightRefused
from tdhil.cli import calibrate, calibrate_run, identify
from tdhil.cli import main as entry
from tdhil.cli.main import build_parser, main
from tdhil.session import confirm_mounted, stop_signals

REAL = ["identify", "--interface", "virtual", "--channel", "none"]
CALIBRATE = ["--calibrate", "--added", "55"]


def test_an_expectation_does_not_go_with_a_calibration(capsys):
    """The body changes J: the first run ended with "cannot tell", and the calibration with it."""
    assert main(["identify", "--simulate", *CALIBRATE, "--expect", "inertia=105±5%"]) == 2
    assert "--expect" in capsys.readouterr().err


class Terminal(io.StringIO):
    def isatty(self):
        return True


def parsed(arguments):
    return build_parser(arguments[0]).parse_args(arguments)


@pytest.fixture
def calibrated(monkeypatch):
    """Return the calibrated logs; no log is read."""
    calls = []
    monkeypatch.setattr(calibrate, "calibrate_two", lambda *asked: calls.append(asked) or 0)
    return calls


def runs(folder: Path, codes=(0, 0)):
    """Return a run that writes nothing, and its requests."""
    asked: list[argparse.Namespace] = []

    def run(namespace, logs):
        asked.append(namespace)
        logs.append(Path(namespace.log))
        return codes[len(asked) - 1]

    return run, asked


@pytest.mark.parametrize("more", [
    ["--calibrate"], ["--added", "55"], ["--calibrate", "--added", "0"], ["--calibrate", "--added", "nan"],
    [*CALIBRATE, "--added-sd", "-1"], [*CALIBRATE, "--dry-run"], [*CALIBRATE, "--json"],
    [*CALIBRATE, "--report", "r.html"], [*CALIBRATE, "--trace", "shaft.csv"],
])
def test_an_invalid_request_ends_with_2_before_motion(tmp_path, monkeypatch, more):
    monkeypatch.chdir(tmp_path)
    assert main(["identify", "--simulate", *more]) == 2
    assert not list(tmp_path.iterdir())


def test_the_simulated_shaft_has_the_body_in_the_second_run(tmp_path, calibrated):
    run, asked = runs(tmp_path)
    log = tmp_path / "bench.mcap"
    namespace = parsed(["identify", "--simulate", "--seed", "4", "--simulated-added-inertia", "5", "--log", str(log),
                        *CALIBRATE, "--added-sd", "0.1"])
    assert calibrate_run.run_calibration(namespace, run) == 0
    assert [(one.log, one.seed, one.simulated_added_inertia_kg_m2) for one in asked] == [
        (str(log), 4, 5.0), (str(tmp_path / "bench-with-body.mcap"), 5, 60.0)]
    assert calibrated == [
        (log, tmp_path / "bench-with-body.mcap", 55.0, 0.1, tmp_path / "bench-calibration.json")]


@pytest.mark.parametrize(("codes", "many"), [((7, 0), 1), ((0, 7), 2)])
def test_a_run_that_failed_ends_it(tmp_path, calibrated, codes, many):
    run, asked = runs(tmp_path, codes)
    namespace = parsed(["identify", "--simulate", "--log", str(tmp_path / "a.mcap"), *CALIBRATE])
    assert calibrate_run.run_calibration(namespace, run) == 7
    assert len(asked) == many and calibrated == []


def test_a_calibration_is_never_written_over(tmp_path):
    (tmp_path / "a-calibration.json").write_text("kept")
    assert main(["identify", "--simulate", "--log", str(tmp_path / "a.mcap"), *CALIBRATE]) == 2
    assert [one.name for one in tmp_path.iterdir()] == ["a-calibration.json"]


@pytest.mark.parametrize(("typed", "many"), [("MOUNTED\n", 2), ("yes\n", 1), ("", 1)])
def test_a_real_shaft_waits_for_the_operator(tmp_path, monkeypatch, calibrated, typed, many):
    run, asked = runs(tmp_path)
    monkeypatch.setattr(sys, "stdin", Terminal(typed))
    namespace = parsed([*REAL, "--yes", "--log", str(tmp_path / "a.mcap"), *CALIBRATE])
    if many == 2:
        assert calibrate_run.run_calibration(namespace, run) == 0
        assert asked[1].simulated_added_inertia_kg_m2 is None
    else:
        with pytest.raises(PreflightRefused, match="not confirmed as mounted"):
            calibrate_run.run_calibration(namespace, run)
    assert len(asked) == many and len(calibrated) == many - 1


def test_without_a_terminal_nothing_moves(tmp_path, monkeypatch, calibrated):
    run, asked = runs(tmp_path)
    monkeypatch.setattr(sys, "stdin", io.StringIO("MOUNTED\n"))
    with pytest.raises(PreflightRefused, match="no operator can confirm that the body is mounted"):
        calibrate_run.run_calibration(
            parsed([*REAL, "--yes", "--log", str(tmp_path / "a.mcap"), *CALIBRATE]), run)
    assert asked == []


def test_the_prompt_names_the_command_for_later(monkeypatch):
    monkeypatch.setattr(sys, "stdin", Terminal("no\n"))
    said, before_question = io.StringIO(), []
    monkeypatch.setattr("tdhil.session.confirm._forget_what_was_typed", lambda: before_question.append(said.getvalue()))
    with pytest.raises(PreflightRefused) as refused:
        confirm_mounted(Console(file=said), "tdhil calibrate torque a.mcap with.mcap --added 55")
    assert "lock it out" in said.getvalue() and "a.mcap with.mcap" in str(refused.value)
    assert before_question == [""]                    # input before the prompt is no answer


@pytest.mark.parametrize("more", [[], CALIBRATE])
def test_signals_work_after_a_run_of_a_calibration(tmp_path, monkeypatch, more):
    """After the only run of a process, signals are ignored. Before the prompt and the second run they must work."""
    ends = []

    class Seen(Exception):
        pass

    def ending(*, own_process):
        ends.append(own_process)
        raise Seen

    monkeypatch.setattr(stop_signals, "Ending", ending)
    monkeypatch.setattr(entry.process, "own", True)
    with pytest.raises(Seen):
        identify.run(parsed(["identify", "--simulate", "--log", str(tmp_path / "a.mcap"), *more]))
    assert ends == [not more]


@pytest.mark.heavy
def test_both_runs_of_the_simulated_rig_give_the_calibration(tmp_path, capsys):
    log = tmp_path / "run.mcap"
    assert main(["identify", "--simulate", "--simulated-torque-scale", "1.05", "--seed", "1", "--rate", "50",
                 "--log", str(log), *CALIBRATE, "--added-sd", "0.1"]) == 0
    factor = json.loads((tmp_path / "run-calibration.json").read_text())["calibration_factor"]
    assert factor["low"] <= 1.0 / 1.05 <= factor["high"]
    said = capsys.readouterr()
    assert "calibration factor" in said.out
    assert f"drive_data: {{torque_calibration: {tmp_path / 'run-calibration.json'}}}" in said.err
