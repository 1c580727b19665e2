"""`tdhil frf` on traces: table, exported files, several logs, and data without a response."""

from __future__ import annotations

import csv
import json
import struct
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml

from tdhil.cli.main import main
from tdhil.file_kind import MAGIC
from tdhil.recording import Stage
from tdhil.session import RunRecord, read
from tests.estimation.analytic import closed_form

pytestmark = pytest.mark.one_worker      # its fixture is expensive


def write_trace(folder: Path, name: str, **how) -> list[str]:
    """Write a trace with its motion; return the words of the command line that name both."""
    recording = closed_form(rate_hz=25.0, noise=3.0, **how)
    trace, motion = folder / f"{name}.csv", folder / f"{name}.yaml"
    rows = zip(recording.time_s, recording.speed_rad_s, recording.torque_nm, strict=True)
    trace.write_text("time_s,speed_rad_s,torque_nm\n" + "".join(f"{t:.4f},{w:.9f},{m:.6f}\n" for t, w, m in rows))
    motion.write_text(yaml.safe_dump({"kind": "multisine", "mode": "torque", "segments": [
        {"start_s": one.start_s, "periods": round((one.end_s - one.start_s) / one.period_s), "period_s": one.period_s,
         "settle_periods": 1, "offset_rad_s": one.offset_rad_s, "lines_hz": list(one.lines_hz)}
        for one in recording.excitation.segments]}))
    return [str(trace), "--excitation", str(motion), "--gear", "1", "--torque-scale-sd", "0.03"]


@pytest.fixture(scope="module")
def trace(tmp_path_factory):
    return write_trace(tmp_path_factory.mktemp("trace"), "run")


def test_the_table_fits_eighty_columns_and_has_a_heading(trace, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    assert main(["frf", *trace]) == 0
    said = capsys.readouterr().out
    assert max(map(len, said.splitlines())) <= 80
    rows = [line.split() for line in said.splitlines() if line.startswith("     0.")]
    assert [row[0] for row in rows] == ["0.1", "0.2", "0.3", "0.4"]
    header = next(line for line in said.splitlines() if "coh." in line and "Hz" in line)
    coherence = header.rindex("coh.") + 4
    shown = [float(line[:coherence].split()[-1]) for line in said.splitlines() if line.startswith("     0.")]
    assert all(0.9 < one <= 1.0 for one in shown) and len(shown) == 4
    assert "No nonlinear distortion was detected" in " ".join(said.split())


@pytest.mark.heavy
def test_json_csv_parquet_and_picture_have_the_same_lines(trace, tmp_path, capsys):
    duckdb = pytest.importorskip("duckdb", reason="duckdb is not installed (pip install '.[parquet]')")
    table, parquet, picture = (tmp_path / f"frf.{ending}" for ending in ("csv", "parquet", "png"))
    assert main(["frf", *trace, "--json", "--out", str(table), "--plot", str(picture)]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["kind"] == "frequency_response"
    (one,) = document["responses"]
    lines = one["frequency_response"]["lines"]
    with table.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["magnitude_high"]) for row in rows] == [line["magnitude"]["high"] for line in lines]
    assert {row["log"] for row in rows} == {trace[0]}
    assert {float(row["distortion_detected"]) for row in rows} == {0.0}
    for row, line in zip(rows, lines, strict=True):
        assert float(row["impedance_magnitude"]) == pytest.approx(1.0 / line["magnitude"]["value"], rel=1e-12)
        assert float(row["impedance_magnitude_low"]) == line["impedance_magnitude"]["low"]
        assert line["impedance_magnitude"]["low"] < line["impedance_magnitude"]["value"]
        assert float(row["impedance_phase_rad_high"]) == -line["phase_rad"]["low"]
        assert line["impedance_phase_rad"]["high"] == -line["phase_rad"]["low"]
    assert main(["frf", *trace, "--out", str(parquet)]) == 0
    with duckdb.connect() as base:
        found = base.execute(f"SELECT hertz, phase_rad, log FROM read_parquet('{parquet}') ORDER BY hertz").fetchall()
    assert found == [(line["hertz"], line["phase_rad"]["value"], trace[0]) for line in lines]
    head = picture.read_bytes()
    assert head.startswith(b"\x89PNG") and struct.unpack(">II", head[16:24])[0] > 900
    assert main(["frf", *trace, "--plot", str(tmp_path / "frf.svg")]) == 0
    assert ElementTree.parse(tmp_path / "frf.svg").getroot().tag.endswith("}svg")


@pytest.mark.heavy
def test_the_name_of_a_log_is_no_formula_in_the_table(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    name, *motion = write_trace(tmp_path, "=cmd")
    assert main(["frf", Path(name).name, *motion, "--out", "frf.csv"]) == 0
    with Path("frf.csv").open(newline="", encoding="utf-8") as file:
        assert {row["log"] for row in csv.DictReader(file)} == {"'=cmd.csv"}


@pytest.mark.heavy
def test_python_has_the_same_response(trace, capsys):
    import tdhil

    main(["frf", *trace, "--json"])
    lines = json.loads(capsys.readouterr().out)["responses"][0]["frequency_response"]["lines"]
    result = tdhil.identify(tdhil.read(trace[0], excitation=trace[2], gear_ratio=1.0, torque_scale_rel_sd=0.03))
    sizes = [line["magnitude"]["value"] for line in lines]
    assert np.abs(result.frf.response).tolist() == pytest.approx(sizes, rel=1e-14)


@pytest.fixture
def log(tmp_path, monkeypatch):
    """Return ``log(**recording)``: the path of a log with a closed-form recording."""
    def log(name="run.mcap", **more):
        recording = replace(closed_form(rate_hz=25.0, noise=3.0), **more)
        path = tmp_path / name
        path.write_bytes(MAGIC)
        records[str(path)] = RunRecord(recording, {}, str(path))
        return str(path)

    records = {}
    monkeypatch.setattr("tdhil.cli.replay.read", lambda path, **how: records.get(str(path)) or read(path, **how))
    return log


@pytest.mark.parametrize("lines", [(0.1, 0.2, 0.3, 0.4), (0.1,)])
def test_the_abort_of_a_run_is_stated(log, lines, capsys):
    """With one line there is no J: the abort is then in the reason of the result, and frf states it too."""
    recording = closed_form(rate_hz=25.0, noise=3.0, lines=lines, amplitudes=(1.5, 0.8, 0.25, 0.25)[:len(lines)])
    end_s = float(recording.time_s[-1])
    path = log(**{name: getattr(recording, name) for name in ("time_s", "speed_rad_s", "torque_nm", "excitation")},
               stages=(Stage("acquire", 0.0, end_s, "aborted", "host: the loop stood still"),))
    assert main(["frf", path]) == 3
    said = " ".join(capsys.readouterr().out.split())
    assert said.count("! the run was aborted in stage acquire (host: the loop stood still)") == 1
    assert "TDH-030" in said


@pytest.mark.heavy
def test_a_trace_and_a_log_are_read_together(trace, log, capsys):
    assert main(["frf", *trace, "--json"]) == 0
    (alone,) = json.loads(capsys.readouterr().out)["responses"]
    for files in ((trace[0], log()), (log(), trace[0])):
        assert main(["frf", *files, *trace[1:], "--json"]) == 0
        both = json.loads(capsys.readouterr().out)["responses"]
        assert [one["log"] for one in both] == list(files)
        assert alone in both


def test_the_legend_is_printed_once(trace, log, capsys):
    assert main(["frf", log("one.mcap"), log("two.mcap")]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert (said.count("95 % intervals; model: rigid+lags"), said.count("torque scale taken as exact")) == (2, 1)


def test_a_narrow_terminal_has_two_tables_below_each_other(trace, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")
    assert main(["frf", *trace]) == 0
    said = capsys.readouterr().out.splitlines()
    assert max(map(len, said)) <= 60
    tables = [line.split() for line in said if line.startswith("     0.")]
    assert [row[0] for row in tables] == ["0.1", "0.2", "0.3", "0.4"] * 2
    assert [len(row) for row in tables] == [5] * 4 + [6] * 4


def test_distortion_that_was_not_detected_has_no_number_in_the_table(trace, capsys):
    assert main(["frf", *trace]) == 0
    said = capsys.readouterr().out.splitlines()
    at = next(line for line in said if "dist.%" in line).index("dist.%") + 5
    assert {line[at] for line in said if line.startswith("     0.")} == {"–"}


def test_data_without_a_response_give_the_reason_and_end_with_9(tmp_path, capsys):
    one = write_trace(tmp_path, "one", periods=2)
    assert main(["frf", *one]) == 9
    assert "TDH-911" in capsys.readouterr().out
    assert main(["frf", one[0], "--json"]) == 9
    (found,) = json.loads(capsys.readouterr().out)["responses"]
    assert found["frequency_response"] is None and "TDH-903" in found["reason"]


@pytest.mark.parametrize("words, code, said", [
    ([], "TDH-219", "no log is named"),
    (["missing.mcap"], "TDH-204", "does not exist"),
    (["TRACE", "--plot", "frf.gif"], "TDH-203", ".png"),
    (["TRACE", "--out", "frf.xlsx"], "TDH-203", ".parquet"),
    (["TRACE", "--out", "TRACE"], "TDH-209", "the log itself"),
    (["TRACE", "--out", "nowhere/frf.csv"], "TDH-206", "folder"),
    (["RESULT"], "TDH-208", "is a result of tdhil, not a log. Give the log: tdhil frf run.mcap"),
    (["LOG", "--gear", "2"], "TDH-220", "run.mcap is a log of a run and contains its own"),
])
def test_usage_errors_are_one_line(trace, words, code, said, tmp_path, capsys):
    files = {"TRACE": trace[0], "RESULT": str(tmp_path / "run1.json"), "LOG": str(tmp_path / "run.mcap")}
    (tmp_path / "run1.json").write_text('{"verdict": "valid", "tdhil": "1.0"}')
    (tmp_path / "run.mcap").write_bytes(MAGIC)
    assert main(["frf", *(files.get(word, word) for word in words)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and code in error and said in error
