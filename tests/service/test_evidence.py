"""Archive of evidence of a run over HTTP: audit, download, and every error at its field."""

from __future__ import annotations

import errno
import json
import os
from functools import partial

import pytest

from tdhil.evidence import check_evidence, make_evidence
from tests.evidence.small_runs import found, write_run
from tests.service.conftest import play_uploads
from tests.service.test_records import ended, noted

STATED = {"publisher": "The Institute", "publish": "log,result,identity", "remove": ["North Yard"]}


@pytest.fixture
def run(call, service, monkeypatch):
    """Return a run with the log of a real drive; its identification is simulated."""
    play_uploads(service, monkeypatch)
    monkeypatch.setattr("tdhil.evidence.making.make_evidence", partial(make_evidence, conclude=found))
    which = ended(call, service)
    (service.store.place(which) / "run.mcap").unlink(missing_ok=True)
    write_run(service.store.place(which) / "run.mcap")
    return which


def test_an_archive_is_made_downloaded_and_audited(call, service, client, run):
    assert call("GET", f"/runs/{run}", 200)["evidence"] is None
    call("GET", f"/runs/{run}/evidence.zip", 404)
    made = call("POST", f"/runs/{run}/evidence", 201, json=STATED)
    assert (made["publisher"], made["publish"]) == ("The Institute", ["log", "result", "identity"])
    archive = client.get(f"/api/v1/runs/{run}/evidence.zip")
    assert archive.headers["content-type"] == "application/zip" and "evidence.zip" in archive.headers[
        "content-disposition"]
    assert check_evidence(archive.content, made["sha256"], conclude=found).problems == ()
    view = call("GET", f"/runs/{run}", 200)
    assert view["evidence"] == made and "evidence.zip" in view["files"]
    (asked,), (done,) = noted(service, "evidence requested"), noted(service, "evidence made")
    assert asked.details == {"publisher": "The Institute", "publish": "log,result,identity"}
    assert done.details["sha256"] == made["sha256"] and noted(service, "downloaded evidence.zip")
    assert call("POST", f"/runs/{run}/evidence", 201, json=STATED)["sha256"] == made["sha256"]
    key = service.store.folder / "evidence.key"
    assert len(key.read_bytes()) == 32 and key.stat().st_mode & 0o77 == 0


def test_every_error_of_the_statement_is_reported_at_its_field(call, service, run):
    sent = {"publish": "photo", "reference_inertia_kg_m2": "-1", "reference_method": "guessed"}
    refused = call("POST", f"/runs/{run}/evidence", 422, json=sent)
    assert {one["option"] for one in refused["fields"]} == {
        "publisher", "publish", "reference_inertia_kg_m2", "reference_sd_kg_m2", "reference_method", "reference_note"}
    labels = {one["option"]: one["label"] for one in refused["fields"]}     # the label of the form, not the option
    assert labels["publisher"] == "Publisher: who permits this" and labels["reference_note"] == "How, in words"
    call("POST", f"/runs/{run}/evidence", 422, json={**STATED, "photo": 1})
    assert not noted(service, "evidence requested")


def test_a_private_text_is_refused_and_leaves_no_archive(call, service, run):
    sent = {**STATED, "firmware": "from 10.1.2.3", "publisher": "ops@example.com, 192.168.0.7"}
    told = call("POST", f"/runs/{run}/evidence", 422, json=sent)
    assert "private text" in told["error"]["message"] and "10.1.2.3" not in json.dumps(told)
    assert {one["option"] for one in told["fields"]} == {"publisher", "firmware"}      # both, each at its field
    assert not (service.store.place(run) / "evidence.zip").exists()


@pytest.mark.parametrize(("number", "status"), [(errno.ENOSPC, 507), (errno.EACCES, 503)])
def test_without_an_audit_entry_no_archive_is_made(call, service, run, monkeypatch, number, status):
    def unwritable(*said, **more):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(service.audit, "note", unwritable)
    error = call("POST", f"/runs/{run}/evidence", status, json=STATED)["error"]
    assert error["next_step"].startswith("Nothing was changed.")
    assert not (service.store.place(run) / "evidence.zip").exists()


def test_the_run_s_page_has_the_form_for_an_engineer_only(client, run):
    text = client.get(f"/runs/{run}").text
    assert 'id="evidence-form"' in text and 'name="publisher"' in text and 'name="reference_method"' in text
