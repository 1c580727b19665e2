"""List of runs by pages: filters, order and search cover every run, with and without the index."""

from __future__ import annotations

import itertools
import random
import sqlite3
from contextlib import closing
from dataclasses import asdict, replace

import pytest

from tdhil.fleet import FleetRow
from tdhil.service import site as site_module
from tdhil.service.run_filter import SORTS, Order, RunFilter, Summary
from tdhil.service.run_state import Status, now
from tdhil.service.store import Index, Store, StoredRequest, summary_of, write_json
from tests.service.conftest import wait_for

VERDICTS = (None, "valid", "valid_wide", "not_identifiable")
ACCEPTANCES = (None, "pass", "fail", "cannot tell")
FILTERS = (
    RunFilter(), RunFilter(archived=True), RunFilter(rig="b"), RunFilter(verdict="valid"), RunFilter(tag="bearing"),
    RunFilter(tag="bear"), RunFilter(text="anna 7"), RunFilter(rig="a", verdict="valid", tag="checked", text="RUN"),
    RunFilter(state="failed", until="20260101-000020-000000"), RunFilter(rehearsal=True), RunFilter(uploaded=False),
    RunFilter(answered=True, rehearsal=False, uploaded=False), RunFilter(rehearsal=False, uploaded=True),
    RunFilter(acceptance="cannot tell"), RunFilter(text="cannot tell", archived=True),
)
ORDERS = [Order(key, down) for key in SORTS for down in (True, False)]


def rows(count: int = 40) -> list[Summary]:
    draw = random.Random(7)
    found = []
    for number in range(count):
        at = f"2026-01-01T00:00:{number % 60:02d}+00:00"
        request = StoredRequest(f"20260101-{number:06d}-000000", draw.choice("abc"), "x.yaml", "0" * 64, {}, "local",
                                at, True, "never")
        row = summary_of(request, Status.begun(request.id, request.rig, at), None)
        value = draw.choice((None, 104.0, 99.5, 1000.0))
        found.append(replace(
            row, state=draw.choice(("done", "failed")), verdict=draw.choice(VERDICTS), inertia_kg_m2=value,
            rehearsal=draw.random() < 0.3, uploaded=draw.random() < 0.3,
            operator=draw.choice((None, "anna", "Berta", "Ada")), note=f"run {number}", archived=draw.random() < 0.2,
            tags=tuple(draw.sample(("bearing", "checked", "Bear 2"), draw.randrange(3))),
            acceptance=ACCEPTANCES[number % 4]))
    return found


@pytest.fixture
def filled(tmp_path) -> tuple[Index, list[Summary]]:
    store = Store(tmp_path / "data")
    store.prepare()
    index, found = Index(store), rows()
    index.rebuild()
    for one in found:
        index.put(one)
    return index, found


@pytest.mark.heavy(but_first=3)
@pytest.mark.parametrize("wanted", FILTERS)
def test_the_index_applies_filter_and_order(filled, wanted):
    index, every = filled
    for order in ORDERS:
        expected = order.sorted(one for one in every if wanted.contains(one))
        assert index.find(wanted, order=order, limit=1000) == expected
        assert index.find(wanted, order=order, limit=3, offset=2) == expected[2:5]
    assert index.count(wanted) == len(expected)


def test_a_tag_is_found_as_a_whole_only(filled):
    index, every = filled
    assert index.count(RunFilter(tag="bear")) == 0
    assert 0 < index.count(RunFilter(tag="bearing", archived=True)) == sum("bearing" in one.tags for one in every)


def test_rows_without_a_value_come_last_in_both_orders(filled):
    index, _ = filled
    for down in (True, False):
        values = [one.inertia_kg_m2 for one in index.find(order=Order("inertia_kg_m2", down), limit=1000)]
        known = [one for one in values if one is not None]
        assert values == sorted(known, reverse=down) + [None] * (len(values) - len(known))


def test_the_choices_are_all_values_that_occur(filled):
    index, _ = filled
    assert index.choices() == {"rig": set("abc"), "verdict": {one for one in VERDICTS if one},
                               "acceptance": {one for one in ACCEPTANCES if one},
                               "tags": {"bearing", "checked", "Bear 2"}}


def test_a_row_has_the_acceptance_verdict_also_with_an_older_index(tmp_path):
    """An index without this column is rebuilt from the files."""
    store = Store(tmp_path)
    store.prepare()
    for number, result in enumerate(({"acceptance": {"verdict": "fail"}}, {"acceptance": None}, {}, None)):
        request = StoredRequest(f"20260101-00000{number}-000000", "a", "x.yaml", "0" * 64, {}, "local", now(), True,
                                "never")
        (store.runs / request.id).mkdir()
        store.begin(request)
        if result is not None:
            write_json(store.runs / request.id / "result.json", result)
    with closing(sqlite3.connect(tmp_path / "index.sqlite")) as base, base:
        base.execute("create table runs (id text primary key, rig, archived)")
        base.execute("pragma user_version = 6")
    assert [one.acceptance for one in Index(store).find()] == [None, None, None, "fail"]


# -- over HTTP


@pytest.fixture
def many(service, monkeypatch):
    """Return a list of 40 runs, ten per page. Some rows are newer than the index, like those of live runs."""
    monkeypatch.setattr(site_module, "PAGE_RUNS", 10)
    service.index.rebuild()
    found = rows()
    for one in found:
        service.index.put(one)
    ahead = {one.id: replace(one, note="live", archived=False) for one in found[::7]}
    monkeypatch.setattr(service.supervisor, "ahead_of_the_index", lambda: list(ahead))
    monkeypatch.setattr(service.store, "summary", ahead.__getitem__)
    return [ahead.get(one.id, one) for one in found]


@pytest.mark.heavy(but_first=2)
@pytest.mark.parametrize("query", [
    "", "sort=inertia_kg_m2&order=asc", "sort=note&order=desc", "sort=verdict&order=asc&archived=true",
    "rig=a", "verdict=valid&sort=rig&order=asc", "tag=bearing&text=anna", "text=live&sort=state",
    "acceptance=cannot tell", "rig=a&sort=acceptance&order=desc",
])
def test_the_pages_of_a_list_have_every_run_once_and_in_order(call, many, query):
    first = call("GET", f"/runs/page?{query}", 200)
    pages = [call("GET", f"/runs/page?{query}&page={page + 1}&until={first['until']}", 200)
             for page in range(first["pages"])]
    asked = dict(one.split("=") for one in query.split("&") if one)
    wanted = RunFilter(**{name: text for name, text in asked.items()
                          if name in ("rig", "verdict", "tag", "text", "acceptance")},
                       archived=asked.get("archived") == "true")
    order = Order(asked.get("sort", "id"), asked.get("order", "desc") == "desc")
    expected = [one.id for one in order.sorted(one for one in many if wanted.contains(one))]
    assert list(itertools.chain(*([one["id"] for one in page["runs"]] for page in pages))) == expected
    assert {page["total"] for page in pages} == {len(expected)}
    assert [page["first"] for page in pages] == [10 * k + 1 if page["runs"] else 0 for k, page in enumerate(pages)]
    assert first["rigs"] == ["a", "b", "c"] and first["tags"] == ["Bear 2", "bearing", "checked"]
    assert first["acceptances"] == ["cannot tell", "fail", "pass"]
    assert call("GET", f"/runs/page?{query}&page=99", 200)["runs"] == []


def test_a_new_run_moves_no_page_whose_address_is_kept(call, many, service):
    first = call("GET", "/runs/page", 200)
    kept = f"/runs/page?page=2&until={first['until']}"
    before = call("GET", kept, 200)
    for number in range(50, 55):
        service.index.put(replace(many[1], id=f"20260102-{number:06d}-000000", archived=False))
    assert call("GET", kept, 200)["runs"] == before["runs"]
    assert call("GET", "/runs/page", 200)["total"] == first["total"] + 5


def test_without_an_index_the_pages_come_from_the_files(call, service, monkeypatch):
    runs = []
    for _ in range(3):
        runs.append(call.start()["id"])
        service.wait(runs[-1], "done")
        wait_for("its end", lambda: not service.supervisor.live())
    monkeypatch.setattr(site_module, "PAGE_RUNS", 2)
    for name in ("find", "count", "choices"):
        monkeypatch.setattr(service.index, name, lambda *_, **__: (_ for _ in ()).throw(OSError("no disk")))
    first, second = (call("GET", f"/runs/page?page={page}", 200) for page in (1, 2))
    assert [one["id"] for one in (*first["runs"], *second["runs"])] == runs[::-1]
    assert (first["total"], first["pages"], second["first"]) == (3, 2, 3)


@pytest.mark.parametrize("query", ["page=0", "page=1.5", "page=1000000000", "sort=asked_by", "order=up", "state=asleep",
                                   "archived=perhaps", f"tag={'x' * 201}", f"acceptance={'x' * 201}"])
def test_a_wrong_request_of_a_list_is_refused(call, query):
    call("GET", f"/runs/page?{query}", 422)


def test_the_plain_list_has_the_same_conditions(call, many):
    for wanted in (RunFilter(verdict="valid"), RunFilter(tag="bearing"), RunFilter(until=many[9].id),
                   RunFilter(acceptance="pass")):
        query = "&".join(f"{name}={value}" for name, value in wanted.__dict__.items() if value)
        found = [one["id"] for one in call("GET", f"/runs?{query}", 200)]
        assert found == [one.id for one in many[::-1] if wanted.contains(one)]


def played(service, *runs: dict[str, object]) -> list[Summary]:
    """Put runs of rig a with J into index and files, each with these values of its row."""
    service.index.rebuild()
    found = [replace(one, **{"rig": "a", "state": "done", "verdict": "valid", "inertia_kg_m2": 104.0, "archived": False,
                             "rehearsal": False, "uploaded": False, **values})
             for one, values in zip(rows(len(runs)), runs, strict=True)]
    for one in found:
        (service.store.runs / one.id).mkdir()
        service.index.put(one)
    return found


def test_a_history_names_omitted_results_of_runs_that_ended_early(call, service):
    """The rule is that of `tdhil trend`. They used to be omitted without a message, although their pages show J."""
    found = played(service, {"state": "done"}, {"state": "stopped"}, {"state": "failed"},
                   {"state": "failed", "rehearsal": True}, {"state": "done", "uploaded": True},
                   {"state": "stopped", "inertia_kg_m2": None})
    notes = call("GET", "/rigs/a/trend", 200)["trend"]["notes"]
    assert notes[:1] == [f"2 results from a part of the run ({found[2].id}: aborted (failed), {found[1].id}: aborted"
                         " (stopped)): left out"]
    assert notes[-2:] == ["1 uploaded recording: left out", "1 rehearsal of faults on the simulated drive: left out"]
    assert call("GET", "/rigs/b/trend", 200)["trend"]["notes"] == ["no run has a result yet"]


def test_rehearsals_displace_no_result_of_a_history_and_are_there_if_asked_for(call, service, monkeypatch):
    """The latest thousand runs of a rig used to be its history, even if all of them were rehearsals."""
    monkeypatch.setattr(site_module, "TREND_RUNS", 2)
    first, *rehearsed = played(service, {}, *[{"rehearsal": True}] * 12)
    faults = {"drive_name": "Inverter", "rehearsed_faults": "torque-scale=1.1"}
    for one in (first, rehearsed[-1]):
        row = FleetRow(one.id, "valid", rig="a", inertia_kg_m2=104.0, **({} if one is first else faults))
        write_json(service.store.runs / one.id / "row.json", row.__dict__)
    trend = call("GET", "/rigs/a/trend", 200)["trend"]
    assert (trend["logs"], trend["results"], trend["rehearsed_faults"]) == (1, 1, [])
    assert "12 rehearsals of faults on the simulated drive: left out" in trend["notes"]
    trend = call("GET", "/rigs/a/trend?rehearsals=true", 200)["trend"]
    assert (trend["logs"], trend["rehearsed_faults"]) == (1, ["torque-scale=1.1"])
    assert not any("rehearsal" in one for one in trend["notes"])
    call("GET", "/rigs/a/trend?rehearsals=perhaps", 422)
    assert call("GET", "/rigs/a", 200)["last"]["id"] == first.id


def test_a_rehearsal_is_compared_only_if_asked_for(call, service, monkeypatch):
    one, rehearsed = played(service, {}, {"rehearsal": True})
    for run, options in ((one.id, {}), (rehearsed.id, {"fault": ["sto@hold"]})):
        request = StoredRequest(run, "a", "a.yaml", "0" * 64, options, "local", one.asked, True, "never")
        write_json(service.store.runs / run / "request.json", asdict(request))
        (service.store.runs / run / "run.mcap").write_bytes(b"log")
    monkeypatch.setattr(service.supervisor, "work", lambda *_: {"document": {"results": [], "settings": []}})
    path = f"/runs/compare?runs={one.id},{rehearsed.id}"
    told = call("GET", path, 422)["error"]
    assert "this run is a rehearsal of faults" in told["message"] and told["where"] == f"run {rehearsed.id}"
    call("GET", f"{path}&rehearsals=true", 200)
