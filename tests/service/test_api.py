"""API over HTTP with runs of `fake_run`: replies, refusals and actions. Each reply agrees with the document."""

from __future__ import annotations

import dataclasses
import errno
import hashlib
import json
import os
import re
import signal
import sqlite3
import threading
from datetime import datetime
from typing import Any

import jsonschema
import pytest
from starlette.testclient import TestClient, WebSocketDenialResponse

from tdhil import report
from tdhil.config import form_options, load_rig
from tdhil.config.options import OPTION, OPTIONS, Form
from tdhil.config.registry import EXCITATIONS, MODELS
from tdhil.errors import UsageError
from tdhil.runner.stages.speed import mean_speeds
from tdhil.service import start_request
from tdhil.service.limits import API
from tdhil.service.run_channel import lives
from tdhil.service.run_filter import RunFilter
from tdhil.service.run_state import State
from tdhil.service.schemas import ROUTES, SOCKETS, document
from tdhil.session.task import machine_limits
from tests.service.conftest import HANGS_S, URL, Service, wait_for

# -- documents and addresses


@pytest.mark.heavy
def test_the_document_agrees_with_the_routes(call):
    jsonschema.Draft202012Validator.check_schema({"$defs": call.document["components"]["schemas"]})
    assert call.document == document()
    names = [one["operationId"] for path in call.document["paths"].values() for one in path.values()]
    assert sorted(names) == sorted(route.name for route in (*ROUTES, *SOCKETS))
    assert all(one["x-role"] for path in call.document["paths"].values() for one in path.values())


THERE = (
    "GET /rigs", "GET /rigs/{rig}", "GET /rigs/{rig}/trend", "POST /rigs/{rig}/runs", "GET /runs", "GET /runs/{run}",
    "GET /runs/compare", "POST /runs/{run}/confirm", "POST /runs/{run}/stop", "POST /rigs/{rig}/stop",
    "GET /runs/{run}/log.mcap", "GET /runs/{run}/report.html", "GET /runs/{run}/report.pdf",
    "GET /runs/{run}/result.json", "POST /runs/{run}/replays", "GET /live/{run}", "GET /foxglove/{rig}", "GET /metrics",
    "GET /healthz", "GET /audit",
)


@pytest.mark.heavy(but_first=4)
@pytest.mark.parametrize("route", THERE)
def test_the_public_routes_exist_and_are_described(call, client, route):
    method, _, path = route.partition(" ")
    described = call.document["paths"][f"{API}{path}"][method.lower()]
    assert described["x-role"]
    answer = client.request(method, f"{API}{path.format(rig='no-rig', run='no-run')}")
    assert answer.status_code in {int(code) for code in described["responses"]}, answer.text
    if answer.status_code != 200:
        assert answer.json()["error"]["what"] != "this address does not exist"
    assert (answer.status_code == 426) is ("101" in described["responses"])


@pytest.mark.parametrize(("method", "path", "allowed"), [
    ("DELETE", f"{API}/rigs", {"GET", "HEAD", "POST"}), ("GET", f"{API}/rigs/a/runs", {"POST"}),
    ("POST", "/", {"GET", "HEAD"}), ("PUT", f"{API}/rigs/a/file", {"GET", "HEAD", "POST"}),
])
def test_an_unsupported_method_is_refused_with_the_supported_ones(client, method, path, allowed):
    answer = client.request(method, path)
    assert (answer.status_code, set(answer.headers["allow"].split(", "))) == (405, allowed)
    told = answer.json()["error"]
    assert told["where"] == path
    assert all(one in told["what"] for one in allowed)


def test_an_unknown_address_is_reported(client):
    told = client.get(f"{API}/nosuch").json()["error"]
    assert (told["where"], told["next_step"]) == (f"{API}/nosuch", f"See {API}/openapi.json")
    assert "/nosuch: this address does not exist" in client.get("/nosuch").text


def test_rigs_are_described(call):
    found = {one["id"]: one for one in call("GET", "/rigs", 200)}
    assert {name: one["state"] for name, one in found.items()} == {
        "a": "free", "b": "free", "real": "free", "never": "free", "watched": "free", "rehearsed": "free",
        "broken": "unusable"}
    assert [found[name]["simulated"] for name in ("a", "real")] == [True, False]
    assert found["a"]["limits"]["torque_nm"] == 400.0
    assert "broken.yaml:1" in found["broken"]["problem"]
    assert call("GET", "/rigs/a", 200) == found["a"]


def test_a_rig_with_an_unusable_file_counts_as_real_and_gives_the_reason(service):
    broken = service.supervisor.rigs.get("broken")
    with pytest.raises(UsageError, match=r"broken\.yaml:1"):
        broken.way()
    assert not broken.simulated


def test_a_run_from_its_request_to_its_result(call, service):
    run = call.start()
    assert (run["rig"], run["rig_name"], run["options"]) == ("a", "Rig a", {"note": "done", "seed": 7})
    service.wait(run["id"], "done")
    wait_for("the index", lambda: call("GET", "/runs?state=done", 200))
    run = call("GET", f"/runs/{run['id']}", 200)
    assert [one["state"] for one in run["history"]] == [
        "requested", "preflight", "moving", "stopping", "identifying", "done"]
    assert run["result"]["inertia_kg_m2"]["value"] == 104.0
    (summary,) = call("GET", "/runs?rig=a", 200)
    assert (summary["id"], summary["inertia_kg_m2"]) == (run["id"], 104.0)
    assert call("GET", "/runs?rig=b", 200) == []
    assert call("GET", "/rigs/a", 200)["last"]["id"] == run["id"]
    assert call("GET", f"/runs/{run['id']}/result.json", 200)["verdict"] == "valid"
    assert call("GET", f"/runs/{run['id']}/log.mcap", 200).content == b"0123456789" * 10


def test_downloads_come_in_pieces(client, call, service):
    run = call.start()["id"]
    service.wait(run, "done")
    answer = client.get(f"{API}/runs/{run}/log.mcap", headers={"Range": "bytes=5-8"})
    assert (answer.status_code, answer.content) == (206, b"5678")
    assert answer.headers["content-range"] == "bytes 5-8/100"
    call.check("GET", f"{API}/runs/{run}/log.mcap", answer)
    for asked, status in (("bytes=0-1,5-6", 206), ("bytes=100-", 416), ("bytes=x", 400)):
        answer = client.get(f"{API}/runs/{run}/log.mcap", headers={"Range": asked})
        assert answer.status_code == status
        call.check("GET", f"{API}/runs/{run}/log.mcap", answer)
    call("GET", f"/runs/{run}/report.html", 404)
    call("GET", f"/runs/{run}/recovered.mcap", 404)
    (service.store.place(run) / "recovered.mcap").write_bytes(b"copy")     # of a log that broke off
    assert "recovered.mcap" in call("GET", f"/runs/{run}", 200)["files"]
    assert call("GET", f"/runs/{run}/recovered.mcap", 200).content == b"copy"
    assert client.head(f"{API}/runs/{run}/result.json").status_code == 200             # displayed, not downloaded
    call("GET", f"/runs/{run}/log.mcap", 200)
    wait_for("the audit", lambda: sum(one.what == "downloaded run.mcap" for one in service.audit.entries()) == 5)
    assert not [one for one in service.audit.entries() if one.what == "downloaded result.json"]


@pytest.mark.heavy
def test_a_log_that_grows_comes_in_pieces_too(client, call, service):
    run = call.start(what="hold")["id"]
    service.wait(run, "moving")
    path = service.store.place(run) / "run.mcap"
    wait_for("the log", lambda: path.exists() and path.stat().st_size == 100)
    answer = client.get(f"{API}/runs/{run}/log.mcap", headers={"Range": "bytes=95-"})
    assert (answer.status_code, answer.content, answer.headers["content-range"]) == (206, b"56789", "bytes 95-99/100")
    for headers in ({}, {"Range": "bytes=95-", "If-Range": '"of another size"'}):
        answer = client.get(f"{API}/runs/{run}/log.mcap", headers=headers)
        assert (answer.status_code, answer.content) == (200, b"0123456789" * 10)
        assert "content-length" not in answer.headers          # it may have grown in the meantime


PLAN = {"excitation": "sine", "expected_half_width": None}


def worked(service: Service, monkeypatch: pytest.MonkeyPatch, answer: Any) -> list[tuple[str, dict[str, Any]]]:
    """Replace the computation; return its requests."""
    asked: list[tuple[str, dict[str, Any]]] = []

    def work(what: str, run: str | None, given: dict[str, Any]) -> dict[str, Any]:
        asked.append((what, given))
        if isinstance(answer, Exception):
            raise answer
        return {"document": answer}

    monkeypatch.setattr(service.supervisor, "work", work)
    return asked


def test_a_plan_is_computed_without_motion(call, service, monkeypatch):
    asked = worked(service, monkeypatch, PLAN)
    assert call("POST", "/rigs/a/plan", 200, json={"tolerance": "1%"})["plan"] == PLAN
    assert [(what, given["options"]) for what, given in asked] == [("plan", {"tolerance": 0.01})]
    call("POST", "/rigs/nobody/plan", 404, json={})
    call("POST", "/rigs/a/plan", 422, json={"excitation": "x"})
    assert service.store.ids() == []


def test_a_replay_is_kept_beside_the_first_result(call, service, monkeypatch):
    run = call.start()["id"]
    service.wait(run, "done")
    first = call("GET", f"/runs/{run}", 200)["result"]
    asked = worked(service, monkeypatch, {"verdict": "valid_wide"})
    for number in ("001", "002"):
        waiting = call("POST", f"/runs/{run}/replays", 202, json={"model": "rigid"})
        assert (waiting["name"], waiting["state"]) == (number, "waiting")
        done = wait_for("the replay", lambda name=number: (
            found if (found := call("GET", f"/runs/{run}/replays/{name}", 200))["state"] == "done" else None))
        assert done["result"] == {"verdict": "valid_wide"}
    assert asked == [("replay", {"model": "rigid"})] * 2
    found = call("GET", f"/runs/{run}", 200)
    assert found["result"] == first
    assert [one["name"] for one in found["replays"]] == ["001", "002"]
    call("GET", f"/runs/{run}/replays/003", 404)
    for wrong in ({"model": 7}, {"model": "nosuch"}, {"tolerance": -1}, {"tolerance": "a lot"}, {"confidence": 2},
                  {"tolerence": 0.01}):
        told = call("POST", f"/runs/{run}/replays", 422, json=wrong)["error"]
        assert next(iter(wrong)) in told["message"]
    assert [one["name"] for one in call("GET", f"/runs/{run}", 200)["replays"]] == ["001", "002"]
    assert call("POST", f"/runs/{run}/replays", 202, json={"tolerance": "1%"})["asked"] == {"tolerance": 0.01}


def test_no_plan_waits_for_a_replay(call, service, monkeypatch):
    run = call.start()["id"]
    service.wait(run, "done")
    asked, goes_on = [], threading.Event()

    def work(what: str, run: str | None, asked_for: Any) -> dict[str, Any]:
        asked.append(what)
        assert what == "plan" or goes_on.wait(HANGS_S)
        return {"document": {}}

    monkeypatch.setattr(service.supervisor, "work", work)
    call("POST", f"/runs/{run}/replays", 202, json={})
    wait_for("the replay to begin", lambda: asked)
    call("POST", "/rigs/a/plan", 200, json={})
    goes_on.set()
    assert asked == ["replay", "plan"]


def test_an_impossible_replay_gives_the_reason_and_one_of_a_live_run_waits_for_its_end(call, service, monkeypatch):
    live = call.start("b", what="hold")["id"]
    service.wait(live, "moving")
    call("POST", f"/runs/{live}/replays", 422, json={})
    run = call.start()["id"]
    service.wait(run, "done")
    worked(service, monkeypatch, UsageError("no such model", where="model"))
    name = call("POST", f"/runs/{run}/replays", 202, json={"model": "string"})["name"]
    failed = wait_for("the replay", lambda: (
        found if (found := call("GET", f"/runs/{run}/replays/{name}", 200))["state"] == "failed" else None))
    assert failed["error"]["what"] == "no such model"


@pytest.mark.heavy
def test_a_rig_s_results_over_time_and_runs_side_by_side(call, service, monkeypatch):
    assert call("GET", "/rigs/a/trend", 200)["trend"]["results"] == 0
    call("GET", "/rigs/nobody/trend", 404)
    runs = []
    for _ in range(2):
        runs.append(call.start()["id"])
        service.wait(runs[-1], "done")
        wait_for("its end", lambda: not service.supervisor.live())
        (service.store.place(runs[-1]) / "row.json").write_text('{"log": "x"}')
    wait_for("the index", lambda: len(call("GET", "/runs?state=done", 200)) == 2)
    played = {"quantities": [], "results": [{"date": "2026-01-01"}, {"date": None}],
              "settings": [{"name": "date", "values": ["a", "a"], "differs": False}, {"name": "rig", "values": []}]}
    asked = worked(service, monkeypatch, played)
    times = [call("GET", f"/runs/{one}", 200)["asked"] for one in runs]
    assert call("GET", "/rigs/a/trend", 200)["trend"] == played
    compared = call("GET", f"/runs/compare?runs={','.join(runs)}", 200)
    assert compared["runs"] == runs
    assert [one["date"] for one in compared["comparison"]["results"]] == times          # the same time on all pages
    assert compared["comparison"]["settings"][0]["values"] == times
    rows = asked[0][1]["rows"]
    seconds = [[int(datetime.fromisoformat(at).timestamp()) for at in found]
               for found in ([one["date"] for one in rows], times[::-1])]
    assert seconds[0] == seconds[1]                 # and local time with its zone in the sentences of the trend
    assert asked == [("trend", {"rows": rows, "rig": "a"}),
                     ("compare", {"runs": runs, "runs_folder": str(service.store.runs)})]
    for wrong in ("", runs[0], f"{runs[0]},{runs[0]}", ",".join("abcdefghi")):
        call("GET", f"/runs/compare?runs={wrong}", 422)
    call("GET", f"/runs/compare?runs={runs[0]},../../x", 404)


def test_the_pdf_is_made_on_the_first_request(call, service, monkeypatch):
    run = call.start()["id"]
    service.wait(run, "done")
    asked = worked(service, monkeypatch, {"file": "report.pdf"})
    call("GET", f"/runs/{run}/report.pdf", 404)        # no file is made in the test
    (service.store.place(run) / "report.pdf").write_bytes(b"%PDF")
    (service.store.place(run) / "report.html").write_bytes(b"<p>ours")
    assert call("GET", f"/runs/{run}/report.pdf", 200).content == b"%PDF"
    assert len(asked) == 1
    page = call("GET", f"/runs/{run}/report.html", 200)
    assert "sandbox" in page.headers["content-security-policy"]
    assert "script-src" not in page.headers["content-security-policy"]


def test_health_and_metrics(client, call, service):
    assert call("GET", "/healthz", 200)["status"] == "ok"
    assert client.get("/healthz").json()["rigs"] == 7
    run = call.start(what="hold")
    service.wait(run["id"], "moving")
    assert "tdhil_runs_live 1.0" in client.get("/metrics").text
    assert "tdhil_runs_asked_total 1.0" in call("GET", "/metrics", 200).text


def test_rehearsals_are_counted_separately_and_marked(client, call, service):
    (wrong,) = call("POST", "/rigs/a/runs", 422, json={"fault": ["torque-scale=abc"]})["fields"]
    assert wrong["option"] == "fault" and wrong["message"].startswith("'abc' is no value of torque-scale. It takes ")
    asked = {"note": "hold", "fault": ["sto@hold+2s"]}
    run = call("POST", "/rigs/a/runs", 201, json=asked)["id"]
    service.wait(run, "moving")
    text = client.get("/metrics").text
    assert "tdhil_runs_live 0.0" in text and "tdhil_runs_asked_total 0.0" in text
    assert "tdhil_rehearsals_live 1.0" in text and "tdhil_rehearsals_asked_total 1.0" in text
    assert call("GET", f"/runs/{run}", 200)["rehearsal"] and call("GET", "/runs", 200)[0]["rehearsal"]
    assert service.web.broker_messages()["rigs/a/state"]["run"]["rehearsal"] is True


def test_a_wrong_fault_is_reported_with_all_other_errors(call, service):
    """It used to be reported only after correction of the others, and not at all for a plan."""
    asked = {"seed": "x", "fault": ["sto@nowhere", "sto@hold", "no-such-fault"], "max_time_s": -5.0,
             "expect": ["nonsense", "weight=1±1"]}
    for way in ("runs", "plan"):
        fields = call("POST", f"/rigs/a/{way}", 422, json=asked)["fields"]
        assert [one["option"] for one in fields] == ["seed", "expect", "expect", "fault", "fault", "max_time_s"]
        assert [one["message"].split(".")[0] for one in fields[3:5]] == [
            "'nowhere' is no moment", "no fault is called 'no-such-fault'"]
        assert fields[4]["message"].endswith("The page Rehearse lists them")
    assert service.store.ids() == []


# -- files and computations of one page


def counted(monkeypatch, owner, name):
    """Count the calls of a function, without a change of its behaviour."""
    calls, real = [], getattr(owner, name)
    monkeypatch.setattr(owner, name, lambda *given, **named: (calls.append(given), real(*given, **named))[1])
    return calls


def test_a_page_computes_the_connection_to_a_rig_once(client, call, monkeypatch):
    calls = counted(monkeypatch, start_request, "connection_of")
    for _ in range(2):
        calls.clear()
        assert client.get("/start/real").status_code == 200
        assert len(calls) == 1
    calls.clear()
    usable = [one for one in call("GET", "/rigs", 200) if one["state"] != "unusable"]
    assert len(calls) == len(usable) == 6


def test_the_list_of_rigs_reads_the_files_of_a_live_run_once(call, service, monkeypatch):
    run = call.start(what="hold")["id"]
    service.wait(run, "moving")
    service.index.wait_until_made(HANGS_S)
    wait_for("the index", lambda: [one.id for one in service.index.find()] == [run])
    summaries, requests = (counted(monkeypatch, service.store, name) for name in ("summary", "request"))
    assert {one["id"]: one["run"] for one in call("GET", "/rigs", 200)}["a"] == run
    assert len(summaries) == len(requests) == 1


def test_the_pictures_of_a_page_are_read_once_and_again_once_the_report_is_made_again(call, service, monkeypatch):
    run = call.start()["id"]
    service.wait(run, "done")
    path = service.store.place(run) / "report.html"
    figure = "<figure><svg></svg><figcaption>{}</figcaption></figure>"
    reads = counted(monkeypatch, report, "pictures_in")
    for caption in ("one", "two"):
        reads.clear()
        path.write_text(f"<h2>Fit</h2>{figure.format(caption)}<h2>Rest</h2>{figure.format('rest')}", "utf-8")
        found = call("GET", f"/runs/{run}/pictures", 200)
        assert [one["caption"] for one in found] == [caption, "rest"]
        for number in range(2):
            call("GET", f"/runs/{run}/pictures/{number}", 200)
        assert len(reads) == 1


def test_the_page_of_the_audit_reads_the_chain_once(call, service, monkeypatch):
    service.audit.note("anna", "asked")
    reads = counted(monkeypatch, service.audit, "_lines")
    found = call("GET", "/audit", 200)
    assert found["head"] == str(service.audit.head()) and found["broken"] is None and found["entries"]
    assert len(reads) == 2             # the second one is this test's own head


# -- one run


def test_a_run_is_stopped_and_reports_the_times(call, service):
    run = call.start(what="hold")["id"]
    service.wait(run, "moving")
    call("POST", f"/runs/{run}/stop", 200)
    service.wait(run, "stopped")
    found = call("GET", f"/runs/{run}", 200)
    assert found["stop"]["by"] == "local"
    assert found["stop"]["asked"] <= found["stop"]["seen"]
    call("POST", f"/runs/{run}/stop", 200)         # a second stop has no effect


def test_a_rig_is_stopped_without_the_id_of_its_run(call, service):
    run = call.start(what="hold")["id"]
    assert call("POST", "/rigs/a/stop", 200)["runs"] == [run]
    service.wait(run, "stopped")
    assert call("POST", "/rigs/b/stop", 200)["exit_code"] == 0


def test_a_run_without_a_reply_on_its_socket_is_stopped_by_signal(call, service):
    run = call.start(what="deaf")["id"]
    service.wait(run, "moving")
    call("POST", f"/runs/{run}/stop", 200)
    service.wait(run, "stopped")


def test_a_second_run_of_a_rig_is_refused_with_the_owner(call, service):
    run = call.start(what="hold")["id"]
    refused = call.start(expect=409)
    assert refused["holder"] == f"run {run}"
    assert refused["error"]["exit_code"] == 4
    other = call.start("b", what="hold")["id"]      # another rig is another rig
    assert sorted(service.supervisor.live()) == sorted([run, other])


def test_a_drive_in_use_by_a_terminal_is_refused_and_named(call, service):
    from tdhil.session import hold

    address = service.supervisor.rigs.get("real").address
    with hold(address):
        refused = call.start("real", what="ask", expect=409)
        assert call("GET", "/rigs/real", 200)["state"] == "held"
    assert f"process {os.getpid()} (" in refused["holder"]


@pytest.mark.heavy
def test_twenty_posts_at_once_are_one_run(client, call, service):
    answers: list[int] = []
    send = [threading.Thread(target=lambda: answers.append(
        client.post(f"{API}/rigs/a/runs", json={"note": "hold"}).status_code)) for _ in range(12)]
    for one in send:
        one.start()
    for one in send:
        one.join()
    assert sorted(answers) == [201] + [409] * 11
    assert len(service.store.ids()) == 1


def test_the_same_key_gives_the_same_run(call, service):
    key = {"Idempotency-Key": "abc"}
    run = call.start(what="hold", headers=key)["id"]
    assert call.start(what="hold", expect=200, headers=key)["id"] == run
    call.start(what="done", expect=409, headers=key)
    call("POST", f"/runs/{run}/stop", 200)
    service.wait(run, "stopped")
    assert call.start(what="hold", expect=200, headers=key)["id"] == run       # even after its end
    assert len(service.store.ids()) == 1


# -- the code


def test_a_real_rig_moves_only_with_the_code_from_the_terminal(call, service):
    run = call.start("real", what="ask")["id"]
    service.wait(run, "awaiting_confirmation")
    shown = wait_for("the code", lambda: next((one for one in service.said if "123 456" in one), None))
    assert "this moves" in shown
    binding = call("GET", f"/runs/{run}", 200)["confirmation"]["binding"]
    assert "123456" not in json.dumps(call("GET", f"/runs/{run}", 200))
    assert "the code is wrong" in call("POST", f"/runs/{run}/confirm", 409, json={"code": "000000"})["error"]["what"]
    call("POST", f"/runs/{run}/confirm", 200, json={"code": "123 456", "binding": binding})
    service.wait(run, "done")
    call("POST", f"/runs/{run}/confirm", 409, json={"code": "123456"})          # once

    def written() -> bool:        # the audit is written by another thread: no motion waits for a disk
        who = [(one["what"], one["run"]) for one in call("GET", "/audit", 200)["entries"]]
        return {("confirmed", run), ("confirmation refused", run)} <= set(who)

    wait_for("both in the audit", written)


@pytest.mark.parametrize("sent", [{"code": "123456", "binding": "c" * 64}, {"code": "999999"}])
def test_another_plan_or_three_wrong_codes_void_it(call, service, sent):
    run = call.start("real", what="ask")["id"]
    service.wait(run, "awaiting_confirmation")
    for _ in range(1 if "binding" in sent else 3):
        call("POST", f"/runs/{run}/confirm", 409, json=sent)
    service.wait(run, "refused")
    call("POST", f"/runs/{run}/confirm", 409, json={"code": "123456", "binding": "b" * 64})


def test_a_watched_run_moves_only_while_a_page_renews_its_lease(call, service):
    assert "logged-in" in call.start("watched", expect=403)["error"]["what"]       # a real rig without a lease
    run = call.start("rehearsed", what="patient")["id"]
    service.wait(run, "awaiting_confirmation")
    key, later = "k" * 16, "n" * 16
    code = {"code": "123456", "binding": "b" * 64}
    call("POST", f"/runs/{run}/lease", 409, json={"key": key})
    assert "only while the operator watches" in call("POST", f"/runs/{run}/confirm", 409, json=code)["error"]["what"]
    call("POST", f"/runs/{run}/confirm", 422, json={**code, "lease": "short"})
    call("POST", f"/runs/{run}/confirm", 200, json={**code, "lease": key})
    service.wait(run, "moving")
    assert call("GET", f"/runs/{run}", 200)["motion"] == "watched"
    found = call("POST", f"/runs/{run}/lease", 200, json={"key": key, "new_key": later})
    assert (found["watch"]["by"], found["lease_s"]) == ("local", 5.0)
    assert "another page" in call("POST", f"/runs/{run}/lease", 409, json={"key": key})["error"]["what"]
    call("POST", f"/runs/{run}/lease", 422, json={"key": later, "gone": "bored"})
    assert call("POST", f"/runs/{run}/lease", 200, json={"key": later, "gone": "hidden"})["watch"]["how"] == "hidden"
    service.wait(run, "stopped")                       # the lease was not renewed
    watch = call("GET", f"/runs/{run}", 200)["watch"]
    assert watch["how"] == "hidden"
    assert watch["lost"] is not None
    wait_for("its end", lambda: not lives(service.store.place(run)))      # until then it refuses with 409
    call("POST", f"/runs/{run}/lease", 503, json={"key": later})


def test_a_code_of_one_run_is_no_code_of_another(call, service):
    run = call.start(what="hold")["id"]
    service.wait(run, "moving")
    assert "nothing to confirm" in call("POST", f"/runs/{run}/confirm", 409, json={"code": "123456"})["error"]["what"]


# -- refusals


def test_a_rig_that_may_not_move_from_here(call):
    refused = call.start("never", expect=403)["error"]
    assert "can't be moved over HTTP" in refused["what"]
    assert "never.yaml" in refused["where"]


@pytest.mark.heavy(but_first=2)
@pytest.mark.parametrize(("options", "status", "words"), [
    ({"accept_no_watchdog": True}, 403, "never accepted over HTTP"),
    ({"accept-no-watchdog": True}, 403, "never accepted over HTTP"),
    ({"accept_shared_watchdog": True}, 403, "never accepted over HTTP"),
    ({"yes": True}, 403, "no option replaces it"),
    ({"log": "/etc/passwd"}, 422, "is not an option"),
    ({"profile": "../../x.yaml"}, 422, "is not an option"),
    ({"interface": "socketcan"}, 422, "is not an option"),
    ({"host": "192.0.2.1"}, 422, "is not an option"),
    ({"plant": "x"}, 422, "is not an option"),
    ({"tolerance": "a lot"}, 422, "tolerance"),
    ({"tolerance": True}, 422, "must be a number"),
    ({"tolerance": 7}, 422, "tolerance: must be above 0"),
    ({"excitation": "<script>"}, 422, "excitation: "),
    ({"accept_wider_limit": "all"}, 422, "must be torque"),
    ({"note": 7}, 422, "must be a text"),
    ({"fault": {"a": 1}}, 422, "must be a text"),
    ({"seed": -1}, 422, "seed: must be at least 0"),
])
def test_refused_options_start_no_run(call, service, options, status, words):
    refused = call("POST", "/rigs/a/runs", status, json=options)["error"]
    assert words in refused["message"]
    assert service.store.ids() == []


@pytest.mark.parametrize(("sent", "words"), [
    (b"{", "is not JSON"), (b"[]", "must be an object"), (b'{"seed": NaN}', "not a number"), (b"\xff", "is not JSON"),
    (b"[" * 60000, "is not JSON"), (b"1" * 70000, "longer than the limit"),
])
def test_an_invalid_request_is_refused(call, sent, words):
    refused = call("POST", "/rigs/a/runs", 422, content=sent, headers={"content-type": "application/json"})
    assert words in refused["error"]["message"]


def test_a_form_of_another_site_is_no_request(call):
    call("POST", "/rigs/a/runs", 422, content=b"{}", headers={"content-type": "text/plain"})


def test_units_are_accepted_as_on_the_command_line(call, service):
    run = call("POST", "/rigs/a/runs", 201, json={"tolerance": "1%", "max-time": "5min", "--frequency": 0.2})
    assert run["options"] == {"tolerance": 0.01, "max_time_s": 300.0, "frequency_hz": 0.2}


@pytest.mark.parametrize("path", [
    "/rigs/nobody", "/rigs/..", "/rigs/%2e%2e%2frigs%2fa", "/rigs/a.yaml", "/rigs/<script>", "/runs/1", "/runs/..%2f..",
    "/runs/20260101-000000-000000", "/runs/..%2f..%2fetc/log.mcap", "/runs/20260101-000000-000000/log.mcap",
    "/runs/20260101-000000-000000/replays/1",
])
def test_missing_objects_give_404(client, path):
    answer = client.get(f"{API}{path}")
    assert answer.status_code == 404
    assert answer.json()["error"]["exit_code"] == 2


def test_only_its_own_files_are_served(client, service):
    (service.store.folder / "secret").write_text("s3cret")
    for path in ("/static/../web.py", "/static/..%2fweb.py", "/static/%2e%2e/web.py", "/static//etc/passwd",
                 "/static/..%5cweb.py", "/runs/..%2fsecret", "/..%2fsecret"):
        answer = client.get(path)
        assert answer.status_code in (404, 400), path
        assert "s3cret" not in answer.text
        assert "import" not in answer.text


def test_a_browser_keeps_a_file_whose_address_has_the_hash_of_its_content(client):
    addresses = re.findall(r'(?:href|src)="(/(?:static|texts)/[^"]+)"', client.get("/").text)
    assert {"/static/app.js", "/static/app.css", "/static/icon.svg", "/texts/en.js"} < {
        one.partition("?")[0] for one in addresses}
    for address in addresses:
        path, _, digest = address.partition("?")
        answer = client.get(address)
        assert answer.headers["cache-control"] == "max-age=31536000, immutable", address
        assert hashlib.sha256(answer.content).hexdigest()[:16] == digest
        for other in (path, f"{path}?{digest[::-1]}"):             # a page of another version: never cached
            assert client.get(other).headers["cache-control"] == "no-store"
    for path in ("/", "/runs", f"{API}/rigs"):
        assert client.get(path).headers["cache-control"] == "no-store"


# -- origin of requests


@pytest.mark.parametrize("headers", [{"Origin": URL}, {}])
def test_a_socket_from_its_own_page_is_accepted(client, headers):
    address = f"{URL.replace('http', 'ws')}{API}/live/20260101-000000-000000"
    with pytest.raises(WebSocketDenialResponse) as denied, client.websocket_connect(address, headers=headers):
        pass
    assert (denied.value.status_code, denied.value.json()["error"]["kind"]) == (404, "NotThere")


@pytest.mark.parametrize("host", [
    "evil.example", "evil.example:8420", "127.0.0.1.evil.example", "[::2]", "192.0.2.7", ""])
def test_it_is_not_reached_by_another_host_name(client, host):
    for path in ("/", f"{API}/rigs", "/static/app.js"):
        assert client.get(path, headers={"Host": host}).status_code == 403
    with pytest.raises(Exception), client.websocket_connect(f"{API}/live/x", headers={"Host": host}):  # noqa: B017
        pass


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost:8420", "LOCALHOST", "[::1]:8420"])
def test_it_is_reached_by_its_own_host_names(client, host):
    assert client.get(f"{API}/rigs", headers={"Host": host}).status_code == 200


@pytest.mark.parametrize("headers", [
    {"Origin": "http://evil.example"}, {"Origin": "http://["}, {"Origin": "null"}, {"Origin": "http://127.0.0.1:9999"},
    {"Origin": "file://127.0.0.1:8420"}, {"Sec-Fetch-Site": "cross-site"}, {"Sec-Fetch-Site": "same-site"},
])
def test_a_page_of_another_site_moves_and_stops_nothing(client, service, headers):
    answer = client.post(f"{API}/rigs/a/runs", json={}, headers=headers)
    assert answer.status_code == 403
    assert service.store.ids() == []
    with pytest.raises(Exception), client.websocket_connect(f"{API}/live/x", headers=headers):  # noqa: B017
        pass


def test_every_reply_has_a_content_security_policy(client):
    for path in ("/", f"{API}/rigs", "/static/app.js", "/nothing", f"{API}/nothing"):
        headers = client.get(path).headers
        assert "default-src 'none'" in headers["content-security-policy"], path
        assert headers["x-content-type-options"] == "nosniff"
        assert "access-control-allow-origin" not in headers


# -- lost processes


@pytest.mark.heavy
def test_a_killed_run_is_reported_and_its_drive_stopped(call, service):
    run = call.start(what="die")["id"]
    service.wait(run, "interrupted")
    found = call("GET", f"/runs/{run}", 200)
    assert "lost while it was moving" in found["error"]["what"]
    assert found["stop"]["confirmed"] is True          # simulated: it ended with its process
    assert call("GET", "/rigs/a", 200)["state"] == "free"


@pytest.mark.heavy
def test_a_killed_run_is_reported_on_a_full_disk_once_there_is_room(call, service, monkeypatch):
    save, room = service.store.save, threading.Event()

    def full(status):
        if not room.is_set():
            raise OSError(28, "No space left on device")
        save(status)

    run = call.start(what="hold")["id"]
    service.wait(run, "moving")
    monkeypatch.setattr(service.store, "save", full)
    os.kill(service.store.status(run).pid, signal.SIGKILL)
    wait_for("that it is told", lambda: any("can't be written yet" in one for one in service.said))
    assert call("GET", "/rigs/a", 200)["state"] == "busy"          # reserved in the meantime
    room.set()
    service.wait(run, "interrupted")
    wait_for("its end", lambda: not service.supervisor.live())


@pytest.mark.heavy
def test_an_unreachable_real_drive_blocks_its_rig_until_the_sign_off(call, service):
    run = call.start("real", what="ask")["id"]
    service.wait(run, "awaiting_confirmation")
    os.kill(service.store.status(run).pid, signal.SIGKILL)
    service.wait(run, "stop_not_confirmed")
    assert "hard-wired emergency stop" in call("GET", f"/runs/{run}", 200)["error"]["next_step"]
    wait_for("nobody live", lambda: not service.supervisor.live())
    refused = call.start("real", expect=409)
    assert "neither confirmed nor signed off" in refused["error"]["what"]
    assert call("GET", "/rigs/real", 200)["state"] == "blocked"
    call("POST", f"/runs/{run}/sign-off", 422, json={"note": " "})
    call("POST", f"/runs/{run}/sign-off", 200, json={"note": "seen at rest, key out"})
    again = call.start("real", what="ask")["id"]
    call("POST", f"/runs/{again}/stop", 200)
    service.wait(again, "stopped")
    call("POST", f"/runs/{again}/sign-off", 409, json={"note": "x"})


@pytest.mark.heavy
def test_a_new_web_finds_the_run_of_the_old_one(call, service, tmp_path, rigs):
    run = call.start(what="hold")["id"]
    service.wait(run, "moving")
    service.supervisor.close()                         # as if dead: it checks no more
    after = Service(tmp_path / "data", rigs)
    with TestClient(after.web.asgi, base_url=URL) as client:
        assert client.get(f"{API}/runs/{run}").json()["state"] == "moving"
        assert after.supervisor.live() == [run]
        assert client.post(f"{API}/rigs/a/runs", json={}).status_code == 409
        assert client.post(f"{API}/runs/{run}/stop", json={}).status_code == 200
        after.wait(run, "stopped")
    assert len(after.store.ids()) == 1


@pytest.mark.heavy
def test_a_service_that_ends_starts_no_run_and_waits_for_standstill(call, service):
    run, loose = call.start(what="hold")["id"], call.start("b", what="loose")["id"]
    for one in (run, loose):
        service.wait(one, "moving")
    assert service.supervisor.brake("service ending")
    assert service.store.status(run).state is State.STOPPED
    assert service.supervisor.not_at_rest == [loose]
    assert service.said[-3].startswith(f"Stopping run {run}, {loose}. tdhil waits")
    assert service.said[-2:] == [f"run {run}: stopped", f"run {loose}: stop_not_confirmed"]
    assert "is ending" in call.start("b", expect=409)["error"]["what"]


def test_a_stop_of_an_ended_run_does_not_change_it(call, service):
    run = call.start()["id"]
    service.wait(run, "done")
    wait_for("its end", lambda: not service.supervisor.live())
    before = sorted(one.name for one in service.store.place(run).iterdir())
    assert call("POST", f"/runs/{run}/stop", 200)["state"] == "done"
    assert sorted(one.name for one in service.store.place(run).iterdir()) == before


@pytest.mark.heavy
def test_nothing_moves_by_a_restart(call, service, tmp_path, rigs):
    run = call.start("real", what="ask")["id"]
    service.wait(run, "awaiting_confirmation")
    service.supervisor.close()
    os.kill(service.store.status(run).pid, signal.SIGKILL)
    after = Service(tmp_path / "data", rigs)
    after.supervisor.start()
    after.wait(run, "stop_not_confirmed")
    after.supervisor.close()
    assert State.MOVING not in [one.state for one in after.store.status(run).history]


@pytest.mark.heavy
def test_a_locked_index_and_a_full_audit_delay_no_stop(call, service, monkeypatch):
    run = call.start(what="hold")["id"]
    service.wait(run, "moving")
    wait_for("the index", lambda: call("GET", "/runs", 200))

    def full(*_: Any, **__: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(service.audit, "note", full)
    with sqlite3.connect(service.store.folder / "index.sqlite", isolation_level=None) as base:
        base.execute("begin exclusive")
        call("POST", f"/runs/{run}/stop", 200)
        service.wait(run, "stopped")
        assert service.web.find_runs(RunFilter())[0].id == run      # from the files
    base.close()
    wait_for("the index", lambda: service.index.find(state="stopped"))     # another attempt follows


def test_the_list_shows_the_present_state_of_a_run(call, service):
    run = call.start(what="hold")["id"]
    service.wait(run, "moving")
    assert [(one["id"], one["state"]) for one in call("GET", "/runs", 200)] == [(run, "moving")]
    assert call("GET", "/runs?state=requested", 200) == []
    assert len(call("GET", "/runs?state=moving&rig=a", 200)) == 1
    assert call("GET", "/runs?state=moving&rig=b", 200) == []


@pytest.mark.heavy
def test_runs_missing_in_the_index_of_a_killed_web_are_added(call, service, tmp_path, rigs):
    run = call.start()["id"]
    service.wait(run, "done")
    wait_for("the index", lambda: service.index.find(state="done"))
    before = service.index.find()
    with service.index._lock, sqlite3.connect(service.store.folder / "index.sqlite") as base:
        base.execute("update runs set state = 'moving'")
    base.close()
    after = Service(tmp_path / "data", rigs)
    after.supervisor.start()
    wait_for("the index", lambda: after.index.find() == before)
    after.supervisor.close()


def test_the_audit_shows_users_and_actions_and_is_intact(call, service):
    run = call.start(what="hold")["id"]
    service.wait(run, "moving")
    call("POST", f"/runs/{run}/stop", 200)
    service.wait(run, "stopped")
    call("GET", f"/runs/{run}/log.mcap", 200)
    wanted = {"asked", "stop asked", "ended: stopped", "downloaded run.mcap"}
    wait_for("the audit", lambda: wanted <= {one["what"] for one in call("GET", "/audit", 200)["entries"]})
    assert call("GET", "/audit", 200)["broken"] is None
    path = next((service.store.folder / "audit").glob("*.jsonl"))
    path.write_bytes(path.read_bytes().replace(b'"asked"', b'"Asked"', 1))
    assert call("GET", "/audit", 200)["broken"]["line"] >= 1


def test_a_web_without_descriptors_replies_with_a_message_and_limits_its_lines(client, service, monkeypatch, capsys):
    def none_left(*_: Any) -> Any:
        raise OSError(errno.EMFILE, "Too many open files")

    service.said.clear()
    monkeypatch.setattr(service.web, "rig_view", none_left)
    answers = [client.get(f"{API}/rigs") for _ in range(20)]       # without an exception, which the server would log
    assert {one.status_code for one in answers} == {503}
    assert "no descriptor left" in answers[0].json()["error"]["what"]
    assert len([one for one in service.said if "no descriptor left" in one]) <= 2
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.parametrize(("number", "status", "words"), [
    (errno.ENOSPC, 507, "Free some disk space"), (errno.EDQUOT, 507, "Free some disk space"),
    (errno.EROFS, 503, "Check that folder"),
])
@pytest.mark.parametrize("at", ["new_id", "begin", "save"])
def test_a_run_that_cannot_be_recorded_is_refused_with_a_message(call, service, monkeypatch, number, status, words, at):
    def full(*_: Any) -> Any:
        raise OSError(number, os.strerror(number))

    with monkeypatch.context() as patched:
        patched.setattr(service.store, at, full)
        refused = call.start(expect=status)["error"]
    assert os.strerror(number) in refused["what"]
    assert refused["next_step"] == f"Nothing was started. {words}"
    assert service.store.ids() == []
    assert call("GET", "/rigs/a", 200)["state"] == "free"


def test_a_process_that_cannot_be_started_on_a_full_disk_is_refused_with_a_message(call, service, monkeypatch):
    def full(*_: Any) -> Any:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr("tdhil.service.supervisor.take_life", full)
        assert "can't be started" in call.start(expect=507)["error"]["what"]
    (run,) = service.store.ids()
    assert service.store.status(run).state is State.FAILED
    assert service.supervisor.live() == []


def _of_form(*parts: str) -> set[str]:
    return {one.name for part in parts for one in form_options(part)}


@pytest.mark.parametrize(("path", "fields"), [
    ("/start/a", _of_form("run", "acquire", "simulated")),
    ("/start/real", _of_form("run", "acquire", "real")),
    ("/rehearse/a", {"stage", "after", "duration", *_of_form("rehearsal")}),
    ("/fleets", {"folder", "below", "archived", "rehearsals", "tolerance", "model"}),
])
def test_a_form_has_the_fields_of_the_table(client, path, fields):
    page = client.get(path)
    assert page.status_code == 200
    assert set(re.findall(r'<(?:input|select)[^>]* name="(\w+)"', page.text)) == fields
    for name, choices in (("excitation", EXCITATIONS), ("model", MODELS)):
        if name in fields:
            select = re.search(rf'<select name="{name}"[^>]*>(.*?)</select>', page.text, re.DOTALL)
            assert re.findall(r"<option>([^<]+)</option>", select[1]) == list(choices)


def test_the_form_asks_for_minutes_and_per_cent(client):
    page = client.get("/start/a").text
    assert re.search(r'name="tolerance" placeholder="default: 5"[^>]*data-unit="%"', page)
    assert re.search(r'name="max_time_s" placeholder="by plan or limits"[^>]*data-unit="min"', page)


def test_an_empty_field_of_the_start_form_shows_the_value_of_the_rig_s_file(client, rigs):
    (rigs / "a.yaml").write_text("run: {simulate: true, tolerance: 2%, amplitude_rad_s: 15rpm, excitation: sine,"
                                 " max_time_s: 90}\n")
    page = client.get("/start/a").text
    for name, text in (("tolerance", "2 %"), ("amplitude_rad_s", "1.5708 rad/s"), ("max_time_s", "1.5 min")):
        assert re.search(rf'name="{name}" placeholder="{text} \(rig&#39;s file\)"', page), name
    assert re.search(r'<select name="excitation"[^>]*><option value="">sine \(rig&#39;s file\)<', page)
    german = client.get("/start/a", headers={"accept-language": "de"}).text
    assert 'name="max_time_s" placeholder="1,5 min (Datei der Anlage)"' in german


def test_a_default_in_a_help_has_the_unit_of_its_field(client):
    assert "Coverage of the interval (default 95 %); at least 50 % and below 100 %." in client.get("/start/a").text


def test_the_start_form_shows_the_expected_values_of_the_rig_s_file(client, rigs):
    assert "The rig&#39;s file expects" not in client.get("/start/a").text
    (rigs / "a.yaml").write_text("run: {simulate: true}\n"
                                 "acceptance: {inertia: 104 kg·m² ± 5 %, coulomb: 60 N·m ± 9 N·m}\n")
    page = client.get("/start/a").text
    assert "The rig&#39;s file expects inertia=104 kg·m² ± 5 %, coulomb=60 N·m ± 9 N·m." in page


def test_the_start_page_names_the_speeds_of_stage_2_with_the_limits_and_of_a_first_motion(client, rigs):
    limits = machine_limits(load_rig(rigs / "real.yaml"))
    page = client.get("/start/real").text
    highest_rad_s = float(re.search(r'id="first" data-highest="([^"]+)"', page)[1])
    width = limits.speed_max_rad_s - limits.speed_min_rad_s
    assert highest_rad_s == pytest.approx(limits.speed_min_rad_s + 0.4 * width)
    careful = dataclasses.replace(limits, speed_max_rad_s=highest_rad_s)
    for where, of in (('id="first"', careful), ("speeds of stage 2", limits)):
        shown = re.findall(r'data-speed="([^"]+)"', page[page.index(where):])[:2]
        assert [float(one) for one in shown] == pytest.approx(mean_speeds(of))


def test_an_empty_field_shows_an_example_as_an_example(client):
    page = client.get("/start/a").text
    assert 'name="fault" placeholder="none, or such as sto@hold+2s"' in page
    assert 'name="expect" placeholder="such as inertia=104 kg·m² ± 5 %' in page


def test_every_option_that_http_accepts_has_a_field_of_the_start_form():
    without = {"accept_wider_limit": "of one drive, by name", "real_time_priority": "the service decides"}
    shown = {one.name for part in ("run", "acquire", "simulated", "real") for one in form_options(part)}
    assert {one.name for one in OPTIONS if one.api is True} - shown == set(without)


def test_a_new_row_of_the_table_is_a_field_with_its_name_unit_default_help_and_limits(client, monkeypatch):
    (like,) = (one for one in OPTIONS if one.name == "frequency_hz")
    made = dataclasses.replace(like, name="dwell_hz", flag="--dwell", default=2.5, help="pause, or {default}",
                               form=Form("Dwell, Hz", ("acquire",)), limits={"ge": 0.5, "lt": 7.0})
    monkeypatch.setattr("tdhil.config.options.OPTIONS", (*OPTIONS, made))
    page = client.get("/start/a").text
    (field,) = re.findall(r'<div class="field"><label data-flag="--dwell".*?</div>', page, re.DOTALL)
    assert re.search(r'<input name="dwell_hz" placeholder="default: 2.5"[^>]*data-unit="Hz"', field)
    assert '<label data-flag="--dwell" data-label="Dwell, Hz"><span>Dwell, Hz</span>\n<input' in field
    assert 'aria-describedby="about-dwell_hz"' in field
    assert '<small id="about-dwell_hz" class="dim">Pause, or 2.5; at least 0.5 Hz and below 7 Hz.</small>' in field


def test_all_wrong_motions_of_a_request_are_refused_at_once(call):
    asked = {"amplitude_rad_s": "fast", "offset_rad_s": 1e6, "periods": "many", "frequency_hz": 0.0, "confidence": 0.2}
    refused = call("POST", "/rigs/a/plan", 422, json=asked)
    assert {one["option"] for one in refused["fields"]} == set(asked)
    assert {one["label"] for one in refused["fields"]} == {OPTION[name].label for name in asked}
    said = {one["option"]: one["message"] for one in refused["fields"]}
    assert said["confidence"] == "must be at least 50 % and below 100 %, not 20 %"


RIG_PAGES = ["/start/a", "/calibrate/a", "/rehearse/a", "/rigs/a", "/rigs/a/file"]


@pytest.mark.parametrize("path", RIG_PAGES)
def test_each_page_of_a_rig_leads_to_the_others(client, path):
    links = re.search(r'<nav class="rig".*?</nav>', client.get(path).text, re.DOTALL)[0]
    assert re.findall(r'href="([^"]+)"', links) == RIG_PAGES
    assert re.findall(r'href="([^"]+)" aria-current="page"', links) == [path]


def test_the_document_describes_every_option(call):
    body = call("GET", "/openapi.json", 200)["paths"]["/api/v1/rigs/{rig}/runs"]["post"]["requestBody"]
    described = body["content"]["application/json"]["schema"]["properties"]
    assert set(described) == {option.name for option in OPTIONS if option.api is True}
    assert described["excitation"]["enum"] == list(EXCITATIONS)
    assert described["accept_wider_limit"]["items"]["enum"] == ["torque", "speed", "quick-stop"]
    assert (described["tolerance"]["x-unit"], described["max_time_s"]["x-unit"]) == ("1", "s")
