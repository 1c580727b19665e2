"""Rehearsals of faults: fleet, trend and compare leave them out without a request, and mark them if shown."""

import json

import pytest

from tdhil.cli.main import main
from tdhil.fleet import FleetRow, read_table
from tdhil.fleet.table import write_table
from tests.fleet.simulated_logs import write_log

pytestmark = pytest.mark.one_worker("fleet")
FAULT = "torque-scale@hold=1.1"
MARKS = "SIMULATED · FAULT REHEARSAL"


@pytest.fixture(scope="module")
def logs(few, tmp_path_factory):
    """Return a run and a rehearsal."""
    import tdhil

    folder = tmp_path_factory.mktemp("rehearsed") / "logs"
    folder.mkdir()
    recording = tdhil.read(few / "R1-001.mcap").recording
    write_log(folder / "run.mcap", recording, "R1", 0)
    write_log(folder / "rehearsal.mcap", recording, "R1", 1, faults=(FAULT,))
    return folder


@pytest.mark.heavy
def test_a_fleet_leaves_rehearsals_out_and_counts_them(logs, tmp_path, capsys):
    out = tmp_path / "fleet.csv"
    command = ["fleet", str(logs), "--out", str(out), "--jobs", "1"]
    assert main(command) == 0
    text = capsys.readouterr().out
    assert "left out: 1 rehearsal of faults; --rehearsals includes them" in text and "rehearsal.mcap" not in text
    assert [row.log for row in read_table(out)] == [str(logs / "run.mcap")]
    assert main([*command, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["logs"], found["rehearsals"], found["rehearsed"], sum(found["verdicts"].values())) == (1, 1, 0, 1)
    assert main([*command, "--rehearsals"]) == 0
    text = capsys.readouterr().out
    assert "1 of them FAULT REHEARSAL" in text and f"{MARKS} {logs / 'rehearsal.mcap'}: " in text
    assert [row.rehearsed_faults for row in read_table(out)] == [FAULT, None]


@pytest.mark.heavy
def test_watch_marks_a_rehearsal(logs, tmp_path, capsys):
    command = ["watch", str(logs), "--once", "--out", str(tmp_path / "fleet.csv"), "--jobs", "1"]
    assert main(command) == 0
    assert "rehearsal.mcap" not in capsys.readouterr().out
    assert main([*command, "--rehearsals"]) == 0
    assert f"{MARKS} {logs / 'rehearsal.mcap'}: " in capsys.readouterr().out


def test_a_rehearsal_without_a_result_is_no_failed_log_of_a_fleet(logs, tmp_path, monkeypatch):
    from tdhil.errors import NothingRecorded
    from tdhil.fleet import FleetRequest, LogTask, identify_log, run_fleet

    def refuse(*_):
        raise NothingRecorded("nothing moved", where="run.mcap")

    monkeypatch.setattr("tdhil.session.conclude", refuse)
    row = identify_log(LogTask(str(logs / "rehearsal.mcap"))).row
    assert row.failed and row.rehearsed_faults == FAULT
    found = run_fleet(FleetRequest((str(logs / "rehearsal.mcap"),), tmp_path / "fleet.csv"))
    assert (found.rows, found.rehearsals, found.exit_code) == ((), 1, 0)


@pytest.mark.heavy
def test_compare_refuses_a_rehearsal_by_name_and_marks_it(logs, tmp_path, capsys):
    both = [str(logs / "run.mcap"), str(logs / "rehearsal.mcap")]
    assert main(["compare", *both]) == 2
    said = capsys.readouterr().err
    assert both[1] in said and f"this run is a rehearsal of faults: {FAULT}" in said and "--rehearsals" in said
    report = tmp_path / "compared.html"
    assert main(["compare", "--rehearsals", *both, "--report", str(report)]) == 0
    assert capsys.readouterr().out.startswith(MARKS)
    assert f"{MARKS}: at least one drive and rig is simulated; rehearsed: {FAULT}" in report.read_text("utf-8")


def test_a_trend_includes_and_marks_rehearsals_if_asked(tmp_path, capsys):
    table = tmp_path / "fleet.csv"
    write_table([FleetRow(f"{day}.mcap", "valid", rig="R", date=f"2026-05-0{day}T12:00:00+00:00", inertia_kg_m2=104.0,
                          inertia_low_kg_m2=103.0, inertia_high_kg_m2=105.0, drive_serial=7, simulated=True,
                          rehearsed_faults=FAULT if day == 3 else None) for day in range(1, 6)], table)
    assert main(["trend", str(table)]) == 0
    text = capsys.readouterr().out
    assert "rig R · SIMULATED: 4 results" in text and "--rehearsals includes the rehearsals" in text
    assert main(["trend", str(table), "--rehearsals"]) == 0
    text = capsys.readouterr().out
    assert f"rig R · {MARKS}: 5 results" in text and "left out" not in text
    assert main(["trend", str(table), "--rehearsals", "--json"]) == 0
    points = json.loads(capsys.readouterr().out)["quantities"][0]["points"]
    assert [one["rehearsed_faults"] for one in points] == [None, None, FAULT, None, None]
