"""Runs that the service archived: fleet, trend and compare leave them out without a request."""

import json

import pytest

from tdhil.cli.main import main
from tdhil.fleet import FleetRow, find_logs, is_archived
from tdhil.fleet.table import write_table


@pytest.fixture
def runs(tmp_path):
    """Return three runs of a service: a normal one, an archived one, one with a tag and a damaged file of another."""
    marks = {"a": None, "b": '{"archived": true}', "c": '{"archived": false, "tags": ["x"]}', "d": "["}
    for name, text in marks.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "run.mcap").write_bytes(b"log")
        if text is not None:
            (tmp_path / name / "annotations.json").write_text(text)
    return tmp_path


def test_the_mark_beside_the_log_is_read(runs):
    assert [name for name in "abcd" if is_archived(runs / name / "run.mcap")] == ["b"]
    assert not is_archived("s3://bucket/run.mcap") and not is_archived("nowhere/run.mcap")


def test_a_fleet_leaves_archived_runs_out_and_counts_them(runs):
    found = find_logs([str(runs)], archived=False)
    assert [log.split("/")[-2] for log in found.logs] == ["a", "c", "d"] and len(found.archived) == 1
    assert len(find_logs([str(runs)]).logs) == 4
    assert find_logs([str(runs / "b" / "run.mcap")], archived=False).logs == ()


def test_compare_refuses_an_archived_run_by_name(runs, capsys):
    logs = [str(runs / name / "run.mcap") for name in "ab"]
    assert main(["compare", *logs]) == 2
    said = capsys.readouterr().err
    assert logs[1] in said and "archived this run" in said and "--archived" in said
    main(["compare", "--archived", *logs])
    assert "archived this run" not in capsys.readouterr().err


def test_a_trend_leaves_out_runs_archived_after_the_table(runs, capsys):
    table = runs / "fleet.csv"
    write_table([FleetRow(str(runs / name / "run.mcap"), "valid", rig="R", date=f"2026-05-0{day}T12:00:00+00:00",
                          inertia_kg_m2=104.0, inertia_low_kg_m2=103.0, inertia_high_kg_m2=105.0, drive_serial=7)
                 for day, name in enumerate("abc", 1)], table)

    def trend(*more):
        code = main(["trend", str(table), "--json", *more])
        return code, json.loads(capsys.readouterr().out)

    code, found = trend()
    assert (code, found["logs"]) == (0, 2)
    assert "1 archived run left out; --archived includes them" in found["notes"]
    assert trend("--archived")[1]["logs"] == 3
    for name in "ac":
        (runs / name / "annotations.json").write_text('{"archived": true}')
    assert main(["trend", str(table)]) == 2
    assert "every run of this table is archived" in capsys.readouterr().err
