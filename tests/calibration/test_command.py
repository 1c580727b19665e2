"""``tdhil calibrate torque``: usage errors end with 2, refusals with 9, and nothing is written over."""

import pytest

from tdhil.calibration import plan_bodies
from tdhil.cli.main import main

TRACE = "time_s,speed_rad_s,torque_nm\n" + "".join(f"{0.01 * k:.2f},4.0,90.{k % 10}\n" for k in range(300))


@pytest.fixture
def traces(tmp_path):
    for name, text in (("a.csv", TRACE), ("b.csv", TRACE + "3.0,4.0,90.0\n")):
        (tmp_path / name).write_text(text)
    return [str(tmp_path / "a.csv"), str(tmp_path / "b.csv")]


@pytest.mark.parametrize("more", [
    [], ["--added", "0"], ["--added", "-5"], ["--added", "nan"], ["--added-sd", "0.1"], ["--body", "x"],
    ["--body", "a.csv="], ["--added", "55", "--added-sd", "-1"], ["--added", "55", "--confidence", "2"],
])
def test_what_is_no_request_ends_with_2(traces, more, capsys):
    assert main(["calibrate", "torque", *traces, *more]) == 2
    assert "Traceback" not in capsys.readouterr().err


def test_logs_without_a_result_end_with_9(traces, capsys):
    assert main(["calibrate", "torque", *traces, "--added", "55"]) == 9
    assert "can't be used" in " ".join(capsys.readouterr().out.split())


def test_a_missing_log_or_the_same_twice_ends_with_2(traces, tmp_path):
    assert main(["calibrate", "torque", traces[0], str(tmp_path / "no.mcap"), "--added", "55"]) == 2
    assert main(["calibrate", "torque", traces[0], traces[0], "--added", "55"]) == 2
    assert main(["calibrate", "torque", traces[0], "--added", "55"]) == 2
    assert main(["calibrate", "torque", "--plan"]) == 2


@pytest.mark.parametrize("option", ["--pairs", "--reference", "--known-pipe"])
def test_a_plan_is_for_a_body_and_states_it(traces, capsys, option):
    assert main(["calibrate", "torque", traces[0], "--plan", option, "file"]) == 2
    assert option in capsys.readouterr().err


def test_a_log_without_a_periodic_motion_gives_no_plan(traces, capsys):
    assert main(["calibrate", "torque", traces[0], "--plan"]) == 2
    assert "gives no plan: there is no periodic excitation in it. Identify with a multisine" in capsys.readouterr().err


def test_the_table_of_a_plan_keeps_each_value_with_its_unit_in_80_columns(traces, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr("tdhil.session.find_plan", lambda *_: (109.8, 3.7, plan_bodies(109.8, 0.002, 3.7, 0.01, 0.001)))
    assert main(["calibrate", "torque", traces[0], "--plan", "--want", "0.5%"]) == 0
    _, above, head, *rows = capsys.readouterr().out.splitlines()
    assert above.strip() == "minutes each" and head.rstrip().endswith("for ±0.5 %") and len(rows) == 8


def test_nothing_is_written_over(traces, tmp_path):
    kept = tmp_path / "calibration.json"
    kept.write_text("kept")
    assert main(["calibrate", "torque", *traces, "--added", "55", "--save", str(kept)]) == 2
    assert kept.read_text() == "kept"
    assert main(["replay", traces[0], "--torque-calibration", str(kept)]) == 2
