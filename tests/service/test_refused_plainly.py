"""Former internal errors: invalid texts, numbers that are too long, a full disk, incomplete files."""

from __future__ import annotations

import errno
import json
import os
import threading
from pathlib import Path
from typing import Any

import pytest

from tdhil.errors import ExitCode, LogError
from tdhil.service import run_state, server, store, supervisor
from tdhil.service.audit import Audit
from tdhil.service.limits import API
from tdhil.service.store import CONNECTION_FILE
from tests.service.conftest import wait_for

HALF = "\\ud800"
"""Half of a surrogate pair, as JSON writes it."""


@pytest.mark.parametrize(("path", "body", "field"), [
    ("/rigs/a/runs", f'{{"note": "{HALF}"}}', "note"),
    ("/rigs/a/runs", f'{{"fault": ["x", "{HALF}"]}}', "fault.1"),
    ("/rigs/a/runs", f'{{"{HALF}": 1}}', "body"),
    ("/rigs/a/plan", f'{{"operator": "{HALF}"}}', "operator"),
    ("/runs/x/sign-off", f'{{"note": "{HALF}"}}', "note"),
    ("/runs/x/annotations", f'{{"tags": ["{HALF}"]}}', "tags.0"),
    ("/rigs/real/file", f'{{"text": "{HALF}", "sha256": ""}}', "text"),
])
def test_an_invalid_text_is_refused_with_its_field(call, service, path, body, field):
    found = call("POST", path, 422, content=body, headers={"content-type": "application/json"})["error"]
    assert found["where"] == field
    assert "surrogate" in found["what"]
    assert service.store.ids() == []


def test_a_whole_pair_is_a_text(call, service):
    run = call("POST", "/rigs/a/runs", 201, content='{"note": "\\ud83d\\ude00"}',
               headers={"content-type": "application/json"})["id"]
    service.wait(run, "done")


def test_the_idle_state_of_the_service_is_reported_despite_a_damaged_run(call, service):
    said: list[str] = []
    run = call.start("a", "done")["id"]
    service.wait(run, "done")
    wait_for("its end", lambda: not service.supervisor.live())
    for name in ("20260101-000000-aaaaaa", "20260101-000000-bbbbbb"):
        (service.store.runs / name).mkdir()
    assert server.check_idle(service.store.folder, said.append) == ExitCode.OK
    (service.store.runs / name / CONNECTION_FILE).write_text("{}")
    assert server.check_idle(service.store.folder, said.append) == ExitCode.REFUSED
    assert f"run {name} used a drive" in said[-1]


@pytest.mark.parametrize("path", ["/runs?limit={}", "/audit?limit={}", "/runs/page?page={}", "/runs?limit=0",
                                  "/audit?limit=5001"])
def test_a_number_of_5000_digits_is_refused(client, path):
    assert client.get(API + path.format("9" * 5000)).status_code == 422


@pytest.mark.parametrize("name", ["tolerance", "max_time_s", "periods"])
@pytest.mark.parametrize("digits", [400, 5000])
def test_an_option_of_too_many_digits_is_refused(call, name, digits):
    call("POST", "/rigs/a/runs", 422, content=f'{{"{name}": {"9" * digits}}}')


def full(*_: Any, **__: Any) -> Any:
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize("what", ["sign-off", "annotations", "rig file", "replay"])
def test_a_full_disk_is_reported_in_words(call, service, monkeypatch, what):
    run = call.start("a", "unseen" if what == "sign-off" else "done")["id"]
    service.wait(run, "stop_not_confirmed", "done")
    wait_for("its end", lambda: not service.supervisor.live())
    monkeypatch.setattr(store, "write_whole", full)
    monkeypatch.setattr(supervisor, "write_whole", full)
    if what == "replay":
        monkeypatch.setattr(Path, "mkdir", full)
        found = call("POST", f"/runs/{run}/replays", 507, json={})
    elif what == "rig file":
        rig = service.supervisor.rigs.get("a")
        with pytest.raises(Exception, match="No space left") as refused:
            service.supervisor.edit_rig("a", "name: other\nrun: {simulate: true}\n", rig.sha256, "anna")
        assert isinstance(run_state.disk_full(refused.value), run_state.NoRoom)
        return
    else:
        body = {"note": "at standstill"} if what == "sign-off" else {"tags": ["x"]}
        found = call("POST", f"/runs/{run}/{what}", 507, json=body)
    assert found["error"]["code"] == run_state.NoRoom.entry.code
    assert "Free some disk space" in found["error"]["next_step"]


def test_a_rig_s_file_that_cannot_be_read_is_not_replaced(service, monkeypatch):
    rig = service.supervisor.rigs.get("a")
    monkeypatch.setattr(service.supervisor.rigs, "get", lambda _: rig)
    rig.path.unlink()
    with pytest.raises(LogError, match="the rig's file can't be read"):
        service.supervisor.edit_rig("a", "name: other\nrun: {simulate: true}\n", rig.sha256, "anna")


def test_a_new_rig_s_file_is_written_as_a_whole_or_not_at_all(service, monkeypatch):
    folder = service.supervisor.rigs.folder
    before = sorted(one.name for one in folder.iterdir())
    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        with pytest.raises(Exception, match="No space left"):
            service.supervisor.add_rig("new", "run: {simulate: true}\n", "anna")
    assert sorted(one.name for one in folder.iterdir()) == before
    assert service.supervisor.add_rig("new", "run: {simulate: true}\n", "anna").id == "new"
    with pytest.raises(run_state.Conflict):
        service.supervisor.add_rig("new", "name: other\nrun: {simulate: true}\n", "anna")
    assert sorted(one.name for one in folder.iterdir()) == sorted([*before, "new.yaml"])


def test_a_replay_whose_process_cannot_be_started_has_failed(call, service, monkeypatch):
    run = call.start("a", "done")["id"]
    service.wait(run, "done")
    wait_for("its end", lambda: not service.supervisor.live())

    def none_left(*_: Any) -> Any:
        raise OSError(errno.EAGAIN, "Resource temporarily unavailable")

    monkeypatch.setattr(service.supervisor, "work", none_left)
    name = call("POST", f"/runs/{run}/replays", 202, json={})["name"]
    found = wait_for("the replay", lambda: next(
        (one for one in call("GET", f"/runs/{run}", 200)["replays"] if one["state"] != "waiting"), None))
    assert (found["name"], found["state"]) == (name, "failed")
    assert "Resource temporarily unavailable" in found["error"]["what"]


def test_another_process_reads_whole_entries_while_lines_are_written(tmp_path, monkeypatch):
    """A second `Audit`, as in `tdhil serve audit`, reads between the writes of line and head of the first."""
    (tmp_path / "audit").mkdir()
    writer, reader = Audit(tmp_path / "audit"), Audit(tmp_path / "audit")
    writer.note("anna", "one")
    found: list[Any] = []
    between, written = threading.Event(), threading.Event()
    real = os.fsync

    def slow(descriptor: int) -> None:
        real(descriptor)
        if not between.is_set():
            between.set()
            written.wait(1.0)              # limits the time of the reader

    monkeypatch.setattr("tdhil.service.audit.os.fsync", slow)
    writing = threading.Thread(target=lambda: [writer.note("anna", str(number)) for number in range(2)])
    writing.start()
    assert between.wait(60.0)
    # A half line, as a reader may see it between two writes of the system.
    path = next((tmp_path / "audit").glob("*.jsonl"))
    whole = path.read_bytes()
    path.write_bytes(whole[:-10])
    reading = threading.Thread(target=lambda: found.append(reader.verify()))
    reading.start()
    reading.join(0.3)
    path.write_bytes(whole)
    written.set()
    reading.join(60.0)
    writing.join(60.0)
    assert found == [None]
    assert json.loads((tmp_path / "audit" / "head.json").read_text())["number"] == 3
