"""Records of an ended run: edits of tags, operator and note, archive and deletion, with audit entries."""

from __future__ import annotations

import base64
import errno
import hashlib
import json
import os
from dataclasses import asdict, replace

import pytest

from tdhil.report import Letterhead, clean_logo
from tdhil.report.acceptance import signature_rows
from tdhil.service.acceptance_signature import AcceptanceSignature, hash_of
from tdhil.service.annotations import Annotations, tags_of
from tdhil.service.audit import Audit
from tdhil.service.letterhead import stored_letterhead
from tdhil.service.run_channel import lives
from tdhil.service.run_state import State, now, way_to
from tdhil.service.schemas import ReplayView
from tdhil.service.store import Index, Store, StoredRequest, write_json
from tests.report.test_letterhead import png
from tests.service.conftest import wait_for


def ended(call, service, rig="a", what="done"):
    run = call.start(rig, what)["id"]
    service.wait(run, "done", "stopped", "stop_not_confirmed")
    wait_for("its end", lambda: run not in service.supervisor.live())
    return run


def noted(service, what):
    assert service.supervisor._notes.finish(10.0)
    return [one for one in service.audit.entries() if one.what == what]


# -- tags, operator, note


def test_tags_operator_and_note_are_edited_later_with_user_and_values_in_the_audit(call, service):
    run = ended(call, service)
    folder = service.store.place(run)
    recorded = {name: (folder / name).read_bytes() for name in ("run.mcap", "request.json", "result.json")}
    sent = {"tags": ["After repair", "bearing  7"], "operator": "Anna", "note": "new\nbearing"}
    found = call("POST", f"/runs/{run}/annotations", 200, json=sent)
    assert (found["tags"], found["operator"], found["note"]) == (["After repair", "bearing 7"], "Anna", "new bearing")
    assert [(one["field"], one["old"], one["new"], one["who"]) for one in found["edits"]] == [
        ("tags", "", "After repair, bearing 7", "local"), ("operator", "", "Anna", "local"),
        ("note", "done", "new bearing", "local")]
    assert found["options"]["note"] == "done"
    assert {name: (folder / name).read_bytes() for name in recorded} == recorded
    edits = noted(service, "annotation edited")
    assert [one.details for one in edits] == [
        {name: one[name] for name in ("field", "old", "new")} for one in found["edits"]]
    assert {(one.who, one.run, one.rig) for one in edits} == {("local", run, "a")}
    assert service.audit.verify() is None
    again = call("POST", f"/runs/{run}/annotations", 200, json={**sent, "note": None})
    assert len(again["edits"]) == 3                                     # the same values are no edit
    for text in ("repair ANNA", "bearing", "new"):
        assert [one["id"] for one in call("GET", f"/runs?text={text}", 200)] == [run], text
    assert call("GET", "/runs?text=done%20anna%20local", 200)[0]["tags"] == ["After repair", "bearing 7"]
    assert call("POST", f"/runs/{run}/annotations", 200, json={"note": "", "tags": []})["note"] == ""


def test_every_wrong_annotation_is_reported_at_its_field(call, service):
    run = ended(call, service)
    sent = {"tags": ["a,b"], "operator": "x" * 501, "note": "y" * 501}
    found = call("POST", f"/runs/{run}/annotations", 422, json=sent)
    assert [one["option"] for one in found["fields"]] == ["operator", "note", "tags"]
    assert service.store.annotations(run) == Annotations() and not noted(service, "annotation edited")
    call("POST", "/runs/20260101-000000-abcdef/annotations", 404, json={})


@pytest.mark.parametrize(("given", "kept"), [
    ((" a ", "A", "b\tc", ""), ("a", "b c")), (("Öl", "ÖL", "O\u0308l"), ("Öl",)), ((), ()),
])
def test_spellings_of_a_tag_are_one_tag(given, kept):
    assert tags_of(given) == kept


@pytest.mark.parametrize("given", [["a,b"], ["x" * 41], [str(number) for number in range(21)]])
def test_an_invalid_tag_is_refused(given):
    with pytest.raises(ValueError, match="tag"):
        tags_of(given)


@pytest.mark.heavy(but_first=2)
@pytest.mark.parametrize(("number", "status"), [(errno.ENOSPC, 507), (errno.EDQUOT, 507), (errno.EACCES, 503)])
def test_without_an_audit_entry_nothing_is_changed(call, service, monkeypatch, number, status):
    run = ended(call, service)

    def unwritable(*said, **more):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(service.audit, "note", unwritable)
    for path, sent in (("annotations", {"note": "x"}), ("archive", {"archived": True}), ("delete", {"confirm": run})):
        error = call("POST", f"/runs/{run}/{path}", status, json=sent)["error"]
        assert f"the audit can't be written ({os.strerror(number)})" in error["message"]
        assert error["next_step"].startswith("Nothing was changed. Free some disk space")
    assert service.store.annotations(run) == Annotations()
    assert service.store.place(run).is_dir()


def test_the_index_is_rebuilt_with_annotations_and_a_damaged_file_is_ignored(tmp_path):
    store = Store(tmp_path)
    store.prepare()
    runs = [store.new_id() for _ in range(3)]
    for run in runs:
        store.begin(StoredRequest(run, "a", "a.yaml", "0" * 64, {"note": "as recorded"}, "local", now(), True, "never"))
    store.annotate(runs[0], Annotations(("one", "two"), note="edited"))
    store.annotate(runs[1], Annotations(archived=True))
    (store.place(runs[2]) / "annotations.json").write_text('{"tags": 7, "else": 1}')
    index = Index(store)
    assert index.rebuild() == 3
    assert {one.id: (one.tags, one.note) for one in index.find()} == {
        runs[0]: (("one", "two"), "edited"), runs[2]: ((), "as recorded")}
    assert index.find(archived=True) == list(store.summaries())
    index.remove(runs[0])
    assert [one.id for one in index.find()] == [runs[2]]


# -- archive


@pytest.mark.heavy
def test_an_archived_run_is_hidden_from_list_trend_compare_and_last_result_unless_asked_for(
        call, service, monkeypatch):
    first, second = ended(call, service), ended(call, service)
    for number, run in enumerate((first, second)):
        write_json(service.store.place(run) / "row.json", {"log": run, "verdict": "valid", "number": number})
    found = call("POST", f"/runs/{second}/archive", 200, json={"archived": True})
    assert found["archived"] and found["edits"][0]["field"] == "archived"
    assert [one["id"] for one in call("GET", "/runs", 200)] == [first]
    assert [one["id"] for one in call("GET", "/runs?archived=true", 200)] == [second, first]
    assert call("GET", "/rigs/a", 200)["last"]["id"] == first
    assert call("GET", f"/runs/{second}", 200)["archived"]              # its page remains
    asked = []
    monkeypatch.setattr(service.supervisor, "work", lambda what, run, sent: asked.append(sent) or {
        "document": {"results": [], "settings": []}})
    call("GET", "/rigs/a/trend", 200)
    call("GET", "/rigs/a/trend?archived=true", 200)
    assert [[row["log"] for row in one["rows"]] for one in asked] == [[first], [second, first]]
    told = call("GET", f"/runs/compare?runs={first},{second}", 422)["error"]
    assert "archived" in told["message"] and told["where"] == f"run {second}"
    call("GET", f"/runs/compare?runs={first},{second}&archived=true", 200)
    call("GET", "/runs?archived=perhaps", 422)
    assert not call("POST", f"/runs/{second}/archive", 200, json={"archived": False})["archived"]
    assert len(call("GET", "/runs", 200)) == 2


def test_a_fleet_of_the_service_s_runs_leaves_archived_ones_out(tmp_path, monkeypatch):
    from tdhil.service.fleets import _own_logs

    store = Store(tmp_path)
    store.prepare()
    runs = sorted(store.new_id() for _ in range(3))
    for run in runs[:2]:
        (store.place(run) / "run.mcap").touch()
    store.annotate(runs[0], Annotations(archived=True))
    monkeypatch.chdir(tmp_path)
    assert _own_logs(Store(tmp_path.relative_to(tmp_path)), archived=False) == (f"runs/{runs[1]}/run.mcap",)
    assert len(_own_logs(Store(tmp_path), archived=True)) == 2


# -- the signature of an acceptance

ACCEPTANCE = {"verdict": "pass", "code": "", "off": [], "quantities": [
    {"name": "inertia", "label": "moment of inertia J", "unit": "kg·m²", "expected": 104.0, "tolerance": 5.0,
     "value": 104.0, "low": 100.0, "high": 108.0, "verdict": "pass", "text": "pass: expected 104, identified 104"}]}


def accepted(call, service, verdict="pass"):
    run = ended(call, service)
    path = service.store.place(run) / "result.json"
    write_json(path, {**json.loads(path.read_bytes()), "acceptance": {**ACCEPTANCE, "verdict": verdict}})
    return run, {**SIGNED, "verdict": verdict, "log_sha256": call("GET", f"/runs/{run}/acceptance", 200)["log_sha256"]}


SIGNED = {"name": "Anna Berg", "remark": ""}


def test_a_person_signs_the_verdict_and_the_log_once_and_the_audit_has_it(call, service):
    run, sent = accepted(call, service)
    log = service.store.place(run) / "run.mcap"
    assert sent["log_sha256"] == hashlib.sha256(log.read_bytes()).hexdigest()
    found = call("POST", f"/runs/{run}/acceptance", 200, json=sent)
    signature = found["signature"]
    assert (signature["name"], signature["by"], signature["role"], signature["verdict"], found["problem"]) == (
        "Anna Berg", "local", "admin", "pass", "")
    assert call("GET", f"/runs/{run}", 200)["signature"] == signature
    (entry,) = noted(service, "acceptance signed")
    assert (entry.run, dict(entry.details)) == (run, signature)
    refused = call("POST", f"/runs/{run}/acceptance", 409, json=sent)["error"]["message"]
    assert "signed already: by Anna Berg" in refused
    refused = call("POST", f"/runs/{run}/delete", 409, json={"confirm": run})["error"]["message"]
    assert "acceptance of this run is signed" in refused
    call("POST", f"/runs/{run}/annotations", 200, json={"note": "later"})      # beside the signed log, not in it
    assert call("GET", f"/runs/{run}/acceptance", 200)["problem"] == ""
    result = service.store.place(run) / "result.json"
    before = result.read_bytes()
    write_json(result, {"acceptance": {**ACCEPTANCE, "quantities": []}})
    assert "the acceptance is not the signed one" in call("GET", f"/runs/{run}/acceptance", 200)["problem"]
    result.write_bytes(before)
    log.write_bytes(log.read_bytes() + b"x")
    assert "the log is not the signed one" in call("GET", f"/runs/{run}/acceptance", 200)["problem"]


@pytest.mark.heavy
@pytest.mark.parametrize(("change", "words"), [
    ({"verdict": "pass"}, "its verdict is pass, and the verdict of the acceptance is fail"),
    ({"name": "B. Manager"}, "differs from its entry in the audit: name"),
    ({"by": "root", "at": "2026-01-01T00:00:00.000Z", "remark": "agreed"}, "the audit: account, time, remark"),
    ({"role": "viewer"}, "the audit: role"), (None, ""),
])
def test_a_signature_that_was_changed_on_the_disk_is_not_valid(call, service, change, words):
    """Only the hashes of log and acceptance were compared: verdict and name of a signature could be edited."""
    run, sent = accepted(call, service, "fail")
    signature = call("POST", f"/runs/{run}/acceptance", 200, json={**sent, "remark": "bearing"})["signature"]
    write_json(service.store.place(run) / "acceptance_signed.json", {**signature, **(change or {})})
    found = call("GET", f"/runs/{run}/acceptance", 200)["problem"]
    assert words in found and bool(found) is bool(words)


def test_a_signature_without_an_intact_entry_in_the_audit_is_not_valid(call, service):
    run, sent = accepted(call, service)
    call("POST", f"/runs/{run}/acceptance", 200, json=sent)
    service.audit.note("anna", "acceptance signed", run="another", name="Berta")
    assert call("GET", f"/runs/{run}/acceptance", 200)["problem"] == ""
    (lines,) = service.audit._folder.glob("*.jsonl")
    before = lines.read_bytes()
    signature = json.loads((service.store.place(run) / "acceptance_signed.json").read_bytes())
    write_json(service.store.place(run) / "acceptance_signed.json", {**signature, "name": "B. Manager"})
    lines.write_bytes(before.replace(b"Anna Berg", b"B. Manager"))       # both are edited, without the key
    assert "the audit has no intact entry" in call("GET", f"/runs/{run}/acceptance", 200)["problem"]
    lines.write_bytes(b"".join(line for line in before.splitlines(keepends=True) if b"acceptance signed" not in line))
    assert "the audit has no intact entry" in call("GET", f"/runs/{run}/acceptance", 200)["problem"]


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize("verdict", ["fail", "cannot tell"])
def test_a_verdict_other_than_pass_is_signed_with_a_remark_only(call, service, verdict):
    run, sent = accepted(call, service, verdict)
    found = call("POST", f"/runs/{run}/acceptance", 422, json={**sent, "name": " ", "remark": " "})
    assert [(one["option"], verdict in one["message"]) for one in found["fields"]] == [
        ("name", False), ("remark", True)]
    found = call("POST", f"/runs/{run}/acceptance", 200, json={**sent, "remark": "bearing is replaced next week"})
    assert found["signature"]["remark"] == "bearing is replaced next week"


@pytest.mark.heavy
def test_a_signature_for_another_verdict_or_log_than_shown_is_refused(call, service):
    run, sent = accepted(call, service, "fail")
    for other, words in (({"verdict": "pass"}, "the verdict is fail, not pass"),
                         ({"log_sha256": "0" * 64}, "not the one that the page showed")):
        found = call("POST", f"/runs/{run}/acceptance", 409, json={**sent, "remark": "x", **other})["error"]
        assert words in found["message"] and "Load the page again" in found["message"]
    assert service.web.records.signature(run) is None and not noted(service, "acceptance signed")
    assert "no values were expected" in call(
        "GET", f"/runs/{ended(call, service)}/acceptance", 409)["error"]["message"]
    moving = call.start("b", "hold")["id"]
    service.wait(moving, "moving")
    assert "has not ended" in call("POST", f"/runs/{moving}/acceptance", 409, json=sent)["error"]["message"]


@pytest.mark.heavy
def test_a_report_older_than_the_signature_is_made_again(call, service, monkeypatch):
    run, sent = accepted(call, service)
    folder, made = service.store.place(run), []
    for name in ("report.html", "report.pdf"):
        (folder / name).write_text("before")

    def work(what, run, asked):
        made.append((what, asked["name"]))
        (folder / asked["name"]).write_text("signed")
        return {"document": {}}

    monkeypatch.setattr(service.supervisor, "work", work)
    assert call("GET", f"/runs/{run}/report.html", 200).text == "before" and not made
    call("POST", f"/runs/{run}/acceptance", 200, json=sent)
    for name in ("report.html", "report.pdf", "report.html"):
        assert call("GET", f"/runs/{run}/{name}", 200).text == "signed"
    assert made == [("report", "report.html"), ("report", "report.pdf")]


def test_the_key_of_a_deleted_run_starts_no_second_run(call, service):
    key = {"headers": {"Idempotency-Key": "k" * 20}}
    run = call("POST", "/rigs/a/runs", 201, json={"note": "done"}, **key)["id"]
    service.wait(run, "done")
    wait_for("its end", lambda: run not in service.supervisor.live())
    assert call("POST", "/rigs/a/runs", 200, json={"note": "done"}, **key)["id"] == run
    wait_for("its process", lambda: not lives(service.store.place(run)))
    call("POST", f"/runs/{run}/delete", 200, json={"confirm": run})
    for asked in ({"note": "done"}, {"note": "another"}):
        refused = call("POST", "/rigs/a/runs", 409, json=asked, **key)["error"]["message"]
        assert f"the run of this key, {run}, was deleted" in refused and "Nothing was started" in refused
    assert service.store.ids() == []
    again = call("POST", "/rigs/b/runs", 201, json={"note": "done"}, **key)["id"]   # another rig: another request
    service.wait(again, "done")


def test_customer_order_and_place_are_edited_later_and_make_the_report_outdated(call, service):
    run = ended(call, service)
    folder = service.store.place(run)
    (folder / "report.html").write_text("old")
    assert call("GET", f"/runs/{run}", 200)["outdated"] == []
    call("POST", f"/runs/{run}/annotations", 200, json={"tags": ["x"]})
    assert call("GET", f"/runs/{run}", 200)["outdated"] == []                  # no report shows a tag
    sent = {"customer": "Østfold", "order_number": "4711", "place": "Hall 3"}
    found = call("POST", f"/runs/{run}/annotations", 200, json=sent)
    assert {name: found[name] for name in sent} == sent and found["outdated"] == ["report.html"]
    assert [one["id"] for one in call("GET", "/runs?text=4711%20hall", 200)] == [run]
    long = call("POST", f"/runs/{run}/annotations", 422, json={"order_number": "x" * 101})
    assert [one["option"] for one in long["fields"]] == ["order_number"]


def test_an_edited_text_is_in_the_report_with_the_recorded_one():
    noted = Annotations().edited({"operator": "Anna"}, "local", "2026-05-01T12:30:00.000Z", operator="Bert", tags=["x"])
    shown = noted.shown_on({"operator": "Anna", "note": None})
    assert (shown["operator"], shown["note"]) == ("Bert", None)
    assert [(one["field"], one["old"]) for one in shown["edits"]] == [("operator", "Anna")]


def test_an_admin_changes_the_letterhead_with_an_audit_line_and_old_reports_are_outdated(call, service):
    run = ended(call, service)
    (service.store.place(run) / "report.pdf").write_text("old")
    assert call("GET", "/letterhead", 200) == {"company": "", "address": [], "logo": ""}
    logo = base64.b64encode(png()).decode()
    found = call("POST", "/letterhead", 200, json={"company": " Nord\nwerk ", "address": ["Hafen 1", ""], "logo": logo})
    assert (found["company"], found["address"]) == ("Nord werk", ["Hafen 1"])
    kept = clean_logo(png())
    assert base64.b64decode(found["logo"]) == kept and call("GET", "/letterhead", 200) == found
    assert stored_letterhead(service.store.folder) == Letterhead("Nord werk", ("Hafen 1",), kept)
    (entry,) = noted(service, "letterhead changed")
    assert dict(entry.details) == {"company": "Nord werk", "address": ["Hafen 1"],
                                   "logo_sha256": hashlib.sha256(kept).hexdigest()}
    assert call("GET", f"/runs/{run}", 200)["outdated"] == ["report.pdf"]
    assert call("POST", "/letterhead", 200, json={"company": "N", "address": []})["logo"] == found["logo"]
    assert call("POST", "/letterhead", 200, json={"company": "N", "address": [], "logo": ""})["logo"] == ""
    assert service.audit.verify() is None


def test_a_letterhead_that_is_not_accepted_names_each_field_and_changes_nothing(call, service):
    svg = base64.b64encode(b"<svg xmlns='http://www.w3.org/2000/svg' onload='alert(1)'/>").decode()
    sent = {"company": "x" * 121, "address": ["y"] * 7, "logo": svg}
    found = call("POST", "/letterhead", 422, json=sent)
    assert [one["option"] for one in found["fields"]] == ["company", "address", "logo"]
    assert "It may contain scripts" in found["fields"][2]["message"]
    call("POST", "/letterhead", 422, json={"company": "", "address": [], "logo": "no base64!"})
    call("POST", "/letterhead", 422, json={"company": "", "address": [], "logo": "A" * 600_000})
    assert not noted(service, "letterhead changed") and not (service.store.folder / "letterhead.json").exists()
    (service.store.folder / "letterhead.json").write_text('{"logo": "PHN2Zy8+"}')          # edited on the disk: an SVG
    assert stored_letterhead(service.store.folder) == Letterhead()


def test_the_worker_puts_the_signature_into_the_document_of_the_report(tmp_path, monkeypatch):
    from tdhil.service.worker import _signed

    audit, tmp_path = Audit(tmp_path / "audit"), tmp_path / "runs" / "one"
    audit._folder.mkdir()
    tmp_path.mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    document = {"acceptance": ACCEPTANCE}
    (tmp_path / "run.mcap").write_bytes(b"log")
    assert _signed(document) == document
    digest = hashlib.sha256(b"log").hexdigest()
    signature = AcceptanceSignature("Anna", "engineer", "anna", "2026-05-01T12:30:00.123Z", "", "pass", digest,
                                    hash_of(ACCEPTANCE))
    write_json(tmp_path / "acceptance_signed.json", asdict(signature))
    assert "no intact entry" in dict(signature_rows(_signed(document)["acceptance"]))["signature not valid"]
    audit.note("anna", "acceptance signed", run="one", **asdict(signature))
    rows = dict(signature_rows(_signed(document)["acceptance"]))
    assert rows["signed by"] == "Anna (engineer, account anna)" and rows["SHA-256 of the log"] == digest
    assert rows["date"] == "2026-05-01 12:30:00 UTC"
    assert "signature not valid" not in rows and set(rows["signature"]) == {"_"}
    (tmp_path / "run.mcap").write_bytes(b"other")
    assert "not the signed one" in dict(signature_rows(_signed(document)["acceptance"]))["signature not valid"]
    assert [name for name, _ in signature_rows(ACCEPTANCE)] == ["accepted by"]


# -- deletion


def test_a_run_is_deleted_by_its_typed_id_with_its_own_files_and_an_audit_entry(call, service):
    run, other = ended(call, service), ended(call, service)
    folder = service.store.place(run)
    (folder / "replays").mkdir()
    write_json(folder / "replays" / "001.json", {})
    digest = hashlib.sha256((folder / "run.mcap").read_bytes()).hexdigest()
    for typed in ("", other, run[:-1]):
        found = call("POST", f"/runs/{run}/delete", 422, json={"confirm": typed})
        assert [one["option"] for one in found["fields"]] == ["confirm"]
    assert folder.is_dir()
    found = call("POST", f"/runs/{run}/delete", 200, json={"confirm": f" {run} "})
    assert {"replays/001.json", "run.mcap", "request.json", "state.json"} <= set(found["files"])
    assert found["log_sha256"] == digest
    assert [one.name for one in service.store.runs.iterdir()] == [other]
    assert [one["id"] for one in call("GET", "/runs", 200)] == [other]
    wait_for("the index", lambda: [one.id for one in service.index.find()] == [other])
    call("GET", f"/runs/{run}", 404)
    call("POST", f"/runs/{run}/delete", 404, json={"confirm": run})
    (entry,) = noted(service, "run deleted")
    assert (entry.run, entry.rig, entry.details["log_sha256"]) == (run, "a", digest)
    assert entry.details["files"] == found["files"] and service.audit.verify() is None
    assert not [one for one in service.said if run in one]              # no index entry is retried without end


def test_a_deleted_run_is_in_no_list_also_before_the_index_is_written(call, service, monkeypatch):
    run, other = ended(call, service), ended(call, service)
    wait_for("the index", lambda: {one.id for one in service.index.find()} == {run, other})
    monkeypatch.setattr(service.supervisor, "_index_later", lambda run: None)
    call("POST", f"/runs/{run}/delete", 200, json={"confirm": run})
    assert [one["id"] for one in call("GET", "/runs", 200)] == [other]
    page = call("GET", "/runs/page", 200)
    assert ([one["id"] for one in page["runs"]], page["total"]) == ([other], 1)


@pytest.mark.heavy
def test_a_moving_or_referenced_run_is_not_deleted(call, service, rigs):
    moving = call.start("a", "hold")["id"]
    service.wait(moving, "moving")
    for path, sent in (("delete", {"confirm": moving}), ("archive", {"archived": True})):
        assert "has not ended" in call("POST", f"/runs/{moving}/{path}", 409, json=sent)["error"]["message"]
    call("POST", f"/runs/{moving}/stop", 200, json={})
    unseen = ended(call, service, "b", "unseen")
    refused = call("POST", f"/runs/{unseen}/delete", 409, json={"confirm": unseen})["error"]["message"]
    assert "neither confirmed nor signed off" in refused
    call("POST", f"/runs/{unseen}/sign-off", 200, json={"note": "at standstill"})
    refused = call("POST", f"/runs/{unseen}/delete", 409, json={"confirm": unseen})["error"]["message"]
    assert "a sign-off refers to this run" in refused
    service.wait(moving, "stopped")
    wait_for("its end", lambda: moving not in service.supervisor.live())
    used = ended(call, service, "a")
    digest = hashlib.sha256((service.store.place(used) / "run.mcap").read_bytes()).hexdigest()
    (rigs / "calibration.json").write_text(json.dumps({"runs": [{"sha256": digest}]}))
    refused = call("POST", f"/runs/{used}/delete", 409, json={"confirm": used})["error"]["message"]
    assert "calibration.json refers to this run" in refused
    (rigs / "calibration.json").unlink()
    call("POST", f"/runs/{used}/delete", 200, json={"confirm": used})


def test_a_deletion_that_was_cut_short_is_finished_at_the_next_start(tmp_path, service):
    store = service.store
    run = store.new_id()
    store.begin(StoredRequest(run, "a", "a.yaml", "0" * 64, {}, "local", now(), True, "never"))
    store.place(run).rename(store.runs / f".deleted-{run}")
    assert store.ids() == []
    service.supervisor.start()
    assert list(store.runs.iterdir()) == []


def test_a_run_is_kept_until_its_process_has_ended_and_can_be_signed_and_archived_before(call, service, monkeypatch):
    run, sent = accepted(call, service)
    monkeypatch.setattr("tdhil.service.records.lives", lambda folder: True)
    refused = call("POST", f"/runs/{run}/delete", 409, json={"confirm": run})["error"]["message"]
    assert "about to end" in refused and "Try again" in refused
    call("POST", f"/runs/{run}/acceptance", 200, json=sent)
    call("POST", f"/runs/{run}/archive", 200, json={"archived": True})


@pytest.mark.heavy
def test_a_run_that_is_replayed_is_kept_until_that_has_ended(call, service):
    run = ended(call, service)
    service.web.waiting_replays[run, "001"] = ReplayView("001", {}, now(), "local", "waiting")
    refused = call("POST", f"/runs/{run}/delete", 409, json={"confirm": run})["error"]["message"]
    assert "identified again" in refused


def test_a_search_reads_the_index_and_no_file_of_a_run(tmp_path, monkeypatch):
    """`benchmarks/many_runs.py` measures the time of a search in ten thousand runs: less than 0.2 s."""
    store = Store(tmp_path)
    store.prepare()
    run = store.new_id()
    status = store.begin(StoredRequest(run, "a", "a.yaml", "0" * 64, {}, "local", now(), True, "never"))
    store.save(way_to(status, State.REFUSED, now()))
    index = Index(store)
    index.put(replace(store.summary(run), tags=("repair",), note="Ölmühle"))

    def opened(*said):
        raise AssertionError("a file of a run was read")

    monkeypatch.setattr(Store, "summary", opened)
    assert [one.id for one in index.find(text="repair ölmühle")] == [run]
