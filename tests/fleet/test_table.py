"""Rows, journal, and table in each format."""

import csv
import json
import random
import re
import struct
from dataclasses import asdict, fields, replace
from pathlib import Path

import pytest

from tdhil.errors import UsageError
from tdhil.fleet.rows import COLUMNS, FleetRow, FleetSettings, failure_row, row_from_json, row_key, row_of
from tdhil.fleet.table import Journal, check_table_path, read_table, write_table
from tdhil.report import result_document
from tests.report.findings import full, recording

VALUES = {
    str: ["R7", "N·m, \"quoted\"\nsecond line; 'x'", "0012", "nan", "=1+1"],
    int: [0, 2**32 - 1, 2**53 + 1], bool: [True, False],
    float: [0.1, 1 / 3, 5e-324, 1.7976931348623157e308, -1.5, 104.28293000519912],
}


def rows():
    rng = random.Random(4)
    found = [FleetRow("a.mcap", "valid"), failure_row("b.mcap", "DriveFault", "two\nlines", FleetSettings())]
    for number in range(30):
        content = {name: rng.choice([*VALUES[kind], None]) for name, kind in COLUMNS.items()}
        content |= {"log": f"{number}.mcap", "verdict": "valid", "tdhil": "0.1.0", "settings": "{}"}
        content["inertia_kg_m2"] = struct.unpack("<d", rng.randbytes(6) + b"\x59\x40")[0]
        found.append(FleetRow(**content))
    return found


@pytest.mark.parametrize("ending", [".csv", ".sqlite", ".parquet"])
def test_a_table_is_read_back_to_the_last_bit(tmp_path, ending):
    if ending == ".parquet":
        pytest.importorskip("duckdb", reason="duckdb is not installed (pip install '.[fleet]')")
    path = tmp_path / f"it's a fleet{ending}"
    write_table([], path)
    assert read_table(path) == []
    write_table(rows(), path)
    assert [repr(row) for row in read_table(path)] == [repr(row) for row in rows()]
    assert sorted(one.name for one in tmp_path.iterdir()) == [path.name]


def test_a_name_that_is_not_utf_8_has_a_row(tmp_path):
    write_table([FleetRow("R7-\udcff.mcap", "valid")], tmp_path / "fleet.csv")
    assert read_table(tmp_path / "fleet.csv")[0].log == "R7-?.mcap"


def leads_somewhere(document, place):
    """Return whether every key of the path exists. A part that this run does not have (drive, rig) ends the path."""
    for key in place.split("."):
        if document is None:
            return True
        if isinstance(document, list):
            document = document[int(key)]
        elif key in document:
            document = document[key]
        else:
            return False
    return True


def test_every_column_has_its_place_in_the_document():
    """A misspelt path would give an empty column for every log."""
    document = result_document(full(), recording(), {}, "run.mcap")
    places = [place for one in fields(FleetRow) for place in one.metadata.get("places", ())]
    assert len(places) > 40
    assert [place for place in places if not leads_somewhere(document, place)] == []
    assert not leads_somewhere(document, "inertia_kg_m2.lowest")


def test_every_quantity_has_its_unit():
    units = ("_kg_m2", "_nm_s_rad", "_nm_rad", "_nm", "_s", "_hz", "_rel_sd", "_ratio", "_factor", "_value",
             "confidence")
    assert [name for name, kind in COLUMNS.items() if kind is float and not name.endswith(units)] == []
    assert {one.name for one in fields(FleetRow)} == set(COLUMNS)


def test_parquet_without_duckdb_names_the_package(tmp_path, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "duckdb", None)
    with pytest.raises(UsageError, match="pip install 'duckdb"):
        check_table_path(tmp_path / "fleet.parquet", tmp_path / "work")
    check_table_path(tmp_path / "fleet.csv", tmp_path / "work")


def test_a_foreign_file_is_not_changed(tmp_path):
    (tmp_path / "fleet.csv").write_text("mine")
    with pytest.raises(UsageError, match="no fleet wrote"):
        check_table_path(tmp_path / "fleet.csv", tmp_path / "fleet.csv.work")
    with pytest.raises(UsageError, match="ends neither"):
        check_table_path(tmp_path / "fleet.xlsx", tmp_path)
    with pytest.raises(UsageError, match=r"this table does not exist\. Make one: tdhil fleet LOG LOG --out fleet.csv"):
        read_table(tmp_path / "none.csv")
    (tmp_path / "result.json").write_text("{}")
    with pytest.raises(UsageError, match=r"is not a table \(.parquet, .csv or .sqlite\). Make one: tdhil fleet "):
        read_table(tmp_path / "result.json")
    for ending in (".csv", ".sqlite"):
        (tmp_path / f"fleet{ending}").write_text("mine\n1\n")
        with pytest.raises(UsageError, match="is no table of a fleet"):
            read_table(tmp_path / f"fleet{ending}")


def test_the_journal_loses_only_a_truncated_line(tmp_path):
    first, second = rows()[:2]
    with Journal(tmp_path) as journal:
        journal.add(replace(first, sha256="aa"), "k1", (5, 6))
        journal.add(second, "k2", None)
    path = tmp_path / "journal.jsonl"
    whole = path.read_bytes()
    path.write_bytes(b"not JSON\n" + whole[:-30])
    with Journal(tmp_path) as journal:
        assert journal.rows == {"k1": replace(first, sha256="aa")}
        assert journal.hashes == {("a.mcap", 5, 6): "aa"}
        journal.add(second, "k2", None)
    with Journal(tmp_path) as journal:
        assert set(journal.rows) == {"k1", "k2"}


def test_one_host_at_a_time(tmp_path):
    pytest.importorskip("fcntl")
    with Journal(tmp_path), pytest.raises(UsageError, match="another fleet is at work"):
        Journal(tmp_path)


def test_the_page_has_every_column():
    """On the page, `…` replaces the rest of a name."""
    page = (Path(__file__).parents[2] / "docs/how-to/identify-many-logs.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (`.*?`) \|", page, re.MULTILINE)
    whole, begun = set(), []
    for name in (name for row in rows for name in re.findall(r"`([\w…]+)`", row)):
        if name.endswith("…"):
            begun.append(name.removesuffix("…"))
        else:
            whole.add(name)
    assert [column for column in COLUMNS if column not in whole and not column.startswith(tuple(begun))] == []


def test_rows_of_a_table_with_other_columns_are_rejected(monkeypatch):
    before = row_key("aa", FleetSettings())
    monkeypatch.setitem(COLUMNS, "another_s", float)
    assert row_key("aa", FleetSettings()) != before


def test_dependencies_of_a_result():
    keys = {row_key("aa", FleetSettings()), row_key("ab", FleetSettings()), row_key("aa", FleetSettings(model="rigid")),
            row_key("aa", FleetSettings(confidence=0.9)), row_key("aa", FleetSettings(tolerance=0.9))}
    assert len(keys) == 5


@pytest.mark.parametrize("change", [
    {"other": 1}, {"inertia_kg_m2": "104"}, {"samples": 1.5}, {"complete": 1}, {"verdict": None},
])
def test_invalid_rows(change):
    content = asdict(FleetRow("a", "valid")) | change
    if change == {"verdict": None}:
        del content["verdict"]
    with pytest.raises(ValueError, match=r"row|is no"):
        row_from_json(content)


@pytest.mark.parametrize(("stored", "changed"), [
    (None, None), ({"verdict": "valid", "inertia_kg_m2": {"value": 104.0 * (1 + 1e-10)}}, False),
    ({"verdict": "valid", "inertia_kg_m2": {"value": 105.0}}, True),
    ({"verdict": "model_rejected", "inertia_kg_m2": None}, True), ({"verdict": 7}, None), ("what", None),
    ({"verdict": "valid", "inertia_kg_m2": {"value": "x"}}, True),
])
def test_changes_from_the_result_in_the_log(stored, changed):
    document = {"verdict": "valid", "reason": "as", "inertia_kg_m2": {"value": 104.0, "low": 103.0}}
    row = row_of("a.mcap", json.loads(json.dumps(document)), settings=FleetSettings(), stored=stored)
    assert row.changed is changed
    assert row.inertia_low_kg_m2 == 103.0


FORMULAS = ("=cmd|' /C calc'!A0", "+1+1", "-2+3", "@SUM(A1)", "\t=1", "\r=1", "\n=1", "'=1", "''=1", "\uff1d1")


@pytest.mark.parametrize("name", [*FORMULAS, "'quoted", "R7", "a=b", "5-6"])
def test_no_text_of_a_table_is_a_formula_and_it_is_read_back_as_it_was(tmp_path, name):
    """The name of a rig comes from a log, which anyone may have written."""
    row = FleetRow(log=name, verdict="valid", rig=name, note=name, operator=name, skew_s=-0.5)
    write_table([row], tmp_path / "fleet.csv")
    with (tmp_path / "fleet.csv").open(newline="", encoding="utf-8") as file:
        (cells,) = csv.DictReader(file)
    texts = {cells[column] for column in ("log", "rig", "note", "operator")}
    assert texts == {f"'{name}" if name in FORMULAS else name}
    assert cells["skew_s"] == "-0.5"                       # a number stays a number
    assert read_table(tmp_path / "fleet.csv") == [row]
