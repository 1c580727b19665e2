"""Folder of a live run that disappears: its process is still stopped, and the service still ends."""

from __future__ import annotations

import signal
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest

from tdhil.service import server, supervisor
from tdhil.service.run_state import Conflict, FolderMissing, NotThere
from tests.service.conftest import Service, wait_for
from tests.service.test_supervisor import begun


def without_folder(service: Service, tmp_path: Path, what: str = "hold", rig: str = "a") -> str:
    """Return a live run whose folder has disappeared, as with an unmounted disk."""
    run = begun(service, what, rig)
    service.store.place(run).rename(tmp_path / f"gone-{rig}")
    return run


def test_the_process_is_stopped_and_the_rig_is_busy_until_it_has_ended(service, tmp_path):
    service.supervisor.start()
    run = without_folder(service, tmp_path)
    wait_for("the failed check", lambda: any("its folder is missing" in one for one in service.said))
    assert service.supervisor.run_of("a") == run
    with pytest.raises(Conflict, match="uses this rig"):
        begun(service)
    with pytest.raises(FolderMissing, match="SIGTERM was sent"):
        service.supervisor.stop(run, "anna")
    wait_for("its end", lambda: not service.supervisor.live())
    assert service.supervisor.run_of("a") is None
    assert [one for one in service.said if "may still run" in one] == [
        f"run {run}: LogError: its folder is missing, and its process may still run."
        " Stop its rig: SIGTERM is sent to the process"]               # once, not with each check
    assert f"run {run}: its folder is missing; its process ended with exit code 0" in service.said
    with pytest.raises(NotThere):
        service.supervisor.stop(run, "anna")
    wait_for("the audit", lambda: {"stop asked", "ended: its folder is missing"} <= {
        one.what for one in service.audit.entries() if one.run == run})


def test_a_stop_over_http_reaches_such_a_run(client, call, service, tmp_path):
    for path, expect in (("/rigs/a/stop", 200), ("/runs/{run}/stop", 504)):
        run = without_folder(service, tmp_path / str(expect)) if (tmp_path / str(expect)).mkdir() is None else ""
        assert call("GET", "/rigs/a", 200)["state"] == "busy"
        found = call("POST", path.format(run=run), expect, json={})
        if expect == 200:
            assert (found["runs"], found["exit_code"], "SIGTERM was sent" in found["said"]) == ([run], 8, True)
        else:
            assert "SIGTERM was sent" in found["error"]["what"]
        wait_for("its end", lambda: not service.supervisor.live())
        assert call("GET", "/rigs/a", 200)["state"] == "free"
    call("POST", f"/runs/{run}/stop", 404, json={})


def test_the_end_of_the_service_stops_such_a_run_and_reports_it(service, tmp_path):
    service.supervisor.start()
    run = without_folder(service, tmp_path)
    assert service.supervisor.brake("the end")
    assert service.supervisor.not_at_rest == [run]             # its standstill is in no file


def test_a_run_that_no_stop_reaches_receives_sigterm_at_the_end_of_the_service(service, monkeypatch):
    service.supervisor.start()
    run = begun(service)

    def fails(*_: object) -> None:
        raise OSError("broken")

    with monkeypatch.context() as patched:
        patched.setattr(service.supervisor, "stop", fails)
        assert service.supervisor.brake("the end")
    assert service.store.status(run).state == "stopped"
    assert f"run {run}: the stop failed (broken)" in service.said


def test_the_drive_is_stopped_if_such_a_process_confirms_no_standstill(service, tmp_path, monkeypatch):
    stopped: list[str] = []
    monkeypatch.setattr(supervisor.Supervisor, "stop_drive",
                        lambda self, rig, who: stopped.append(rig.id) or (8, "tdhil stop did NOT confirm standstill"))
    service.supervisor.start()
    run = without_folder(service, tmp_path)
    service.supervisor._children[run].kill()
    wait_for("its end", lambda: not service.supervisor.live())
    assert stopped == ["a"]
    assert any(one.endswith("exit code -9; tdhil stop did NOT confirm standstill") for one in service.said)


def test_the_service_ends_also_if_its_stop_fails(monkeypatch):
    def fails(who: str) -> bool:
        raise NotThere("this run does not exist")

    monkeypatch.setattr(threading, "excepthook", lambda _: None)
    web = SimpleNamespace(should_exit=False)
    server._ender(web, fails, print)(signal.SIGTERM, None)
    wait_for("its end", lambda: web.should_exit, 60.0)
