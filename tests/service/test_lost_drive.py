"""Lost or frozen process of a run: the drive that is then stopped, and the messages; without a real drive."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from tdhil.service.run_channel import stands_still
from tdhil.service.run_state import Conflict, State, Status
from tdhil.service.store import CONNECTION_FILE, write_json
from tdhil.session import kept_connection
from tests.service.conftest import Service, wait_for

# -- which drive is stopped


class Stops:
    """Replacement of the stop process: it records commands and gives the readings of the next stop."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.commands: list[list[str]] = []
        self.code, self.said = 0, "{}"
        real = subprocess.run

        def run(command: list[str], **more: object) -> object:
            if "tdhil.service.drive_stop" not in command and "stop" not in command:
                return real(command, **more)
            self.commands.append([one for one in command if one not in (sys.executable, "-m")])
            return SimpleNamespace(returncode=self.code, stdout=self.said.encode(), stderr=b"")

        monkeypatch.setattr("tdhil.service.supervisor.subprocess.run", run)


@pytest.fixture
def stops(monkeypatch: pytest.MonkeyPatch) -> Stops:
    return Stops(monkeypatch)


def lost_run(service: Service, *, kept: bool = True, change: Callable[[Path], object] = lambda path: None) -> str:
    """Return a run on the rig `real` whose process is killed after a change of the rig's file."""
    service.supervisor.start()
    rig = service.supervisor.rigs.get("real")
    run = service.supervisor.start_run("real", {"note": "ask"}, "local").request.id
    service.wait(run, "awaiting_confirmation")
    if kept:
        write_json(service.store.place(run) / CONNECTION_FILE, kept_connection(*rig.way()))
    change(rig.path)
    os.kill(service.store.status(run).pid, signal.SIGKILL)
    service.wait(run, "interrupted", "stop_not_confirmed")
    wait_for("its end", lambda: not service.supervisor.live())
    return run


def other_port(path: Path) -> None:
    path.write_text(path.read_text().replace("host: 127.0.0.1", "host: 127.0.0.2"))


@pytest.mark.heavy
def test_the_stop_after_a_lost_run_goes_to_the_drive_of_the_run(service, stops):
    run = lost_run(service)
    assert stops.commands == [["tdhil.service.drive_stop", str(service.store.place(run) / CONNECTION_FILE)]]
    status = service.store.status(run)
    assert (status.state, status.stop.confirmed) == (State.INTERRUPTED, True)
    assert status.stop.at_rest is not None
    assert service.supervisor.blocked("real") is None


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize("change", [other_port, lambda path: path.write_text(path.read_text() + "# a word\n"),
                                    lambda path: path.unlink()])
def test_a_rig_s_file_that_was_changed_in_the_meantime_leaves_the_stop_unconfirmed(service, stops, change):
    """The rig may have another drive now. Standstill of the run's drive shows nothing about that one."""
    path = service.supervisor.rigs.get("real").path
    before = path.read_text()
    run = lost_run(service, change=change)
    assert stops.commands == [["tdhil.service.drive_stop", str(service.store.place(run) / CONNECTION_FILE)]]
    status = service.store.status(run)
    assert (status.state, status.stop.confirmed, status.stop.at_rest) == (State.STOP_NOT_CONFIRMED, False, None)
    for words in ("tdhil stop confirmed standstill, on the connection that the run used (modbus tcp 127.0.0.1",
                  "real.yaml was changed or removed after the run was requested"):
        assert words in status.error.what
    assert "hard-wired emergency stop" in status.error.next_step
    path.write_text(before)
    assert service.supervisor.blocked("real") == run
    with pytest.raises(Conflict, match="neither confirmed nor signed off"):
        service.supervisor.start_run("real", {"note": "ask"}, "local")
    path.with_name("again.yaml").write_text(before)                  # the same drive under another name
    assert service.supervisor.blocking_run(service.supervisor.rigs.get("again")) == run
    service.supervisor.sign_off(run, "anna", "both shafts at rest")
    assert service.supervisor.blocked("real") is None
    assert service.supervisor.blocking_run(service.supervisor.rigs.get("again")) is None
    with pytest.raises(Conflict, match="anna has signed"):
        service.supervisor.sign_off(run, "bert", "x")
    assert service.store.signed_off(run)["by"] == "anna"


@pytest.mark.heavy
def test_without_a_kept_connection_the_rig_s_file_counts_as_long_as_it_is_the_same(service, stops):
    path = service.supervisor.rigs.get("real").path
    run = lost_run(service, kept=False)
    assert stops.commands == [["tdhil", "stop", "--rig", str(path), "--json"]]
    assert service.store.status(run).state is State.INTERRUPTED


@pytest.mark.heavy
def test_without_a_kept_connection_and_with_another_file_no_drive_is_stopped(service, stops):
    run = lost_run(service, kept=False, change=other_port)
    assert stops.commands == []
    status = service.store.status(run)
    assert status.state is State.STOP_NOT_CONFIRMED
    assert "no stop was sent" in status.error.what


@pytest.mark.heavy
def test_a_drive_without_confirmed_standstill_blocks_its_rig_and_stop_goes_to_it(service, stops):
    """The Stop of its rig goes to the drive of the run, with any later file."""
    stops.code, stops.said = 8, "is not JSON"
    run = lost_run(service)
    status = service.store.status(run)
    assert status.state is State.STOP_NOT_CONFIRMED
    assert "did NOT confirm standstill" in status.error.what
    rig = service.supervisor.rigs.get("real")
    assert service.supervisor.stop_drive(rig, "anna") == (8, "tdhil stop did NOT confirm standstill")
    stops.code = 0
    assert service.supervisor.stop_drive(rig, "anna") == (0, "tdhil stop confirmed standstill")
    other_port(rig.path)
    code, said = service.supervisor.stop_drive(service.supervisor.rigs.get("real"), "anna")
    assert code == 8
    assert "on the connection that the run used" in said
    assert {tuple(one) for one in stops.commands} == {
        ("tdhil.service.drive_stop", str(service.store.place(run) / CONNECTION_FILE))}
    service.supervisor.sign_off(run, "anna", "at rest")
    service.supervisor.stop_drive(rig, "anna")
    assert stops.commands[-1] == ["tdhil", "stop", "--rig", str(rig.path), "--json"]
    stops.code = 8
    assert service.supervisor.stop_drive(rig, "anna") == (8, "tdhil stop did NOT confirm standstill")
    assert service.supervisor.stop_drive(service.supervisor.rigs.get("a"), "berta")[0] == 0
    wait_for("the audit", lambda: ("berta", "stop asked", None, "a") in {
        (one.who, one.what, one.run, one.rig) for one in service.audit.entries()})


@pytest.mark.heavy
def test_another_drive_at_the_address_of_the_run_is_not_accepted(service, stops, monkeypatch):
    stops.code, stops.said = 8, json.dumps({"at_rest": True, "same_drive": False, "identity": "1, 2, 3, 99"})
    status = service.store.status

    def known(run: str) -> Status:
        return replace(status(run), identity_numbers=(1, 2, 3, 4))

    monkeypatch.setattr(service.store, "status", known)
    run = lost_run(service)
    assert stops.commands[0][2:] == ["1,2,3,4"]
    assert service.store.status(run).state is State.STOP_NOT_CONFIRMED
    assert "another drive (1, 2, 3, 99) replied at the address of the run" in service.store.status(run).error.what


# -- a frozen process


@pytest.mark.heavy
def test_a_stop_to_a_frozen_process_kills_it_and_reports_an_unconfirmed_stop(call, service, stops):
    run = call.start("real", what="ask")["id"]
    service.wait(run, "awaiting_confirmation")
    write_json(service.store.place(run) / CONNECTION_FILE,
               kept_connection(*service.supervisor.rigs.get("real").way()))
    pid = service.store.status(run).pid
    suspend(pid)
    told = call("POST", f"/runs/{run}/stop", 504, json={})["error"]
    for words in ("does not respond", "SIGSTOP", "it now acts: quick stop", "sends tdhil stop"):
        assert words in told["what"]
    assert "hard-wired emergency stop" in told["next_step"]
    service.wait(run, "interrupted")
    wait_for("its end", lambda: not service.supervisor.live())
    assert [one[0] for one in stops.commands] == ["tdhil.service.drive_stop"]
    status = service.store.status(run)
    assert (status.stop.by, status.stop.confirmed, status.stop.seen) == ("local", True, None)
    assert status.stop.asked <= status.stop.at_rest
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGCONT)                   # it cannot continue
    wait_for("the audit", lambda: [one.details for one in service.audit.entries() if one.what == "stop asked"] == [
        {"process": "stood still", "killed": True}])


def suspend(pid: int) -> None:
    """Suspend the process and wait for the signal. A running process would reply to a Stop."""
    os.kill(pid, signal.SIGSTOP)
    wait_for("its standstill", lambda: stands_still(pid))


@pytest.mark.heavy
def test_a_rig_with_a_frozen_run_gives_the_same_reply(call, service):
    run = call.start("a", what="hold")["id"]
    service.wait(run, "moving")
    suspend(service.store.status(run).pid)
    assert "does not respond" in call("POST", "/rigs/a/stop", 504, json={})["error"]["what"]
    service.wait(run, "interrupted")


def test_a_frozen_process_that_cannot_be_killed_is_reported(call, service, monkeypatch):
    run = call.start("a", what="hold")["id"]
    service.wait(run, "moving")
    pid = service.store.status(run).pid
    suspend(pid)
    with monkeypatch.context() as patched:
        patched.setattr("tdhil.service.supervisor.send_signal", lambda *arguments: False)
        told = call("POST", f"/runs/{run}/stop", 504, json={})["error"]
    assert "could not end the process, and sends nothing" in told["what"]
    os.kill(pid, signal.SIGCONT)
    call("POST", f"/runs/{run}/stop", 200, json={})
    service.wait(run, "stopped")


def test_only_a_live_process_can_be_frozen():
    with subprocess.Popen(["sleep", "60"]) as child:
        assert not stands_still(child.pid)
        os.kill(child.pid, signal.SIGSTOP)
        wait_for("its stop", lambda: stands_still(child.pid))
        child.kill()
    assert not stands_still(child.pid)
