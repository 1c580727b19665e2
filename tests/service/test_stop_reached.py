"""Stop that reaches its run and its drive: with other slow stops, and with any change of the rig's file."""

from __future__ import annotations

import subprocess
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from drivers import LONGEST_STOP_S
from tdhil.service import client as client_module
from tdhil.service import supervisor as supervisor_module
from tdhil.service.limits import API
from tdhil.service.run_state import State
from tdhil.service.site import STOPS
from tdhil.service.store import CONNECTION_FILE, write_json
from tdhil.session import hold, kept_connection
from tests.service.conftest import HANGS_S, Checked, Service, wait_for

BROKEN = "limits: [\n"


@pytest.mark.heavy
def test_slow_stops_of_one_rig_delay_no_stop_of_another(client, call, service, monkeypatch):
    run = call.start("a", "hold")["id"]
    service.wait(run, "moving")
    begun: list[str] = []
    released = threading.Event()

    def slow(rig: Any, who: str) -> tuple[int, str]:
        begun.append(rig.id)
        released.wait(HANGS_S)
        return 0, "tdhil stop confirmed standstill"

    monkeypatch.setattr(service.supervisor, "stop_drive", slow)
    asked = [*["real"] * (STOPS + 1), *["b"] * (STOPS + 1)]
    with ThreadPoolExecutor(len(asked)) as cards:
        slow_ones = [cards.submit(client.post, f"{API}/rigs/{rig}/stop", json={}) for rig in asked]
        try:
            wait_for("the slow stops", lambda: set(begun) == {"real", "b"} and len(begun) >= 2)
            wait_for("the stops that join them", lambda: sum(
                one.what == "stop asked" and one.details.get("joined", False)
                for one in service.audit.entries()) == len(asked) - 2)
            one = threading.Thread(target=lambda: client.post(f"{API}/rigs/a/stop", json={}), daemon=True)
            one.start()
            service.wait(run, "stopped")
            assert not any(other.done() for other in slow_ones)
        finally:
            released.set()
        assert [one.result().json()["exit_code"] for one in slow_ones] == [0] * len(asked)
    assert sorted(begun) == ["b", "real"]              # one thread for each rig


@pytest.mark.heavy
def test_a_stop_of_a_run_that_begins_during_a_stop_of_its_drive_is_sent_to_the_run(client, call, service, monkeypatch):
    released, begun = threading.Event(), threading.Event()

    def slow(rig: Any, who: str) -> tuple[int, str]:
        begun.set()
        released.wait(HANGS_S)
        return 0, ""

    monkeypatch.setattr(service.supervisor, "stop_drive", slow)
    with ThreadPoolExecutor(1) as cards:
        first = cards.submit(client.post, f"{API}/rigs/a/stop", json={})
        try:
            assert begun.wait(HANGS_S)
            run = call.start("a", "hold")["id"]
            service.wait(run, "moving")
            assert call("POST", "/rigs/a/stop", 200, json={})["runs"] == [run]
            service.wait(run, "stopped")
        finally:
            released.set()
        assert first.result().json()["runs"] == []


def test_the_web_waits_longer_for_a_stop_than_the_stop_takes(monkeypatch):
    waited: list[float] = []

    def run(command: list[str], *, timeout: float, **more: object) -> object:
        waited.append(timeout)
        return SimpleNamespace(returncode=0, stdout=b"{}", stderr=b"")

    monkeypatch.setattr(subprocess, "run", run)
    assert supervisor_module._stop_seen(["tdhil", "stop"])[0]
    assert waited[0] > LONGEST_STOP_S + 10.0
    assert client_module.Client()._timeout_s > waited[0]


# -- the rig's file


def unreadable(path: Path) -> None:
    path.write_bytes(b"name: \xff\xfe\n")


CHANGES = {
    "broken": lambda path: path.write_text(BROKEN),
    "unreadable": unreadable,
    "renamed": lambda path: path.rename(path.with_name("other.yaml")),
    "removed": lambda path: path.unlink(),
}


def card(call: Checked, rig: str) -> dict[str, Any]:
    found: dict[str, Any] = next(one for one in call("GET", "/rigs", 200) if one["id"] == rig)
    assert found == call("GET", f"/rigs/{rig}", 200)
    return found


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_a_run_is_stopped_on_its_card_with_any_change_of_the_rig_s_file(client, call, service, change):
    run = call.start("a", "hold")["id"]
    service.wait(run, "moving")
    change(service.supervisor.rigs.get("a").path)
    found = card(call, "a")
    assert (found["state"], found["run"]) == ("unusable", run)
    assert client.get("/rigs/a").status_code == 200
    assert call("POST", "/rigs/a/stop", 200, json={})["runs"] == [run]
    service.wait(run, "stopped")


@pytest.mark.heavy
@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_an_unconfirmed_stop_is_repeated_and_signed_off_with_any_change_of_the_rig_s_file(
    call, service, monkeypatch, change,
):
    run = unconfirmed(service, call)
    change(service.supervisor.rigs.get("real").path)
    assert card(call, "real")["blocked_by"] == run
    stopped: list[str] = []
    monkeypatch.setattr(service.supervisor, "_stop_drive_of",
                        lambda request, status: stopped.append(request.id) or (False, "seen"))
    assert call("POST", "/rigs/real/stop", 200, json={})["exit_code"] == 8
    assert stopped == [run]
    call("POST", f"/runs/{run}/sign-off", 200, json={"note": "at standstill"})
    assert service.supervisor.blocked("real") is None


def unconfirmed(service: Service, call: Checked) -> str:
    """Return a run of the rig `real` whose stop was not confirmed."""
    import os
    import signal

    run: str = call.start("real", "ask")["id"]
    service.wait(run, "awaiting_confirmation")
    os.kill(service.store.status(run).pid or 0, signal.SIGKILL)
    service.wait(run, str(State.STOP_NOT_CONFIRMED))
    wait_for("its end", lambda: not service.supervisor.live())
    return run


@pytest.mark.parametrize("broken", [BROKEN.encode(), b"name: \xff\xfe\n", b"speed: 1\n"])
def test_a_file_that_cannot_be_used_is_repaired_as_a_new_rig_is_added(call, service, broken):
    path = service.supervisor.rigs.get("real").path
    good = path.read_text()
    path.write_bytes(broken)
    found = call("GET", "/rigs/real/file", 200)
    reverse = good + "allow_reverse: true\n"
    from tdhil.service.run_state import NotAllowed

    for refused in (reverse, good.replace("attended", "watched")):
        with pytest.raises(NotAllowed):
            service.supervisor.edit_rig("real", refused, found["sha256"], "anna")
    assert path.read_bytes() == broken
    service.supervisor.edit_rig("real", good, found["sha256"], "anna")
    assert path.read_text() == good
    assert (service.store.folder / "rigs" / "real" / f"{found['sha256']}.yaml").read_bytes() == broken


# -- another program moves the shaft while the run is identified


@pytest.mark.heavy
@pytest.mark.parametrize("path", ["/rigs/real/stop", "/runs/{run}/stop"])
def test_a_stop_reaches_the_shaft_that_another_program_moves_while_the_run_is_identified(
    call, service, monkeypatch, path,
):
    rig = service.supervisor.rigs.get("real")
    stopped: list[str] = []
    monkeypatch.setattr(service.supervisor, "_stop_drive_of",
                        lambda request, status: stopped.append(request.id) or (True, "standstill"))
    for held in (False, True):
        run = call.start("real", "identify")["id"]
        write_json(service.store.place(run) / CONNECTION_FILE, kept_connection(*rig.way()))
        service.wait(run, "identifying")
        with hold(rig.address) if held else nullcontext():
            found = call("POST", path.format(run=run), 200, json={})
            if "said" in found:
                assert (found["exit_code"], "the drive is held by" in found["said"]) == ((0, True) if held
                                                                                         else (None, False))
            service.wait(run, "failed")
            wait_for("the stop of the drive", lambda held=held, run=run: not held or stopped == [run])
        wait_for("its end", lambda: not service.supervisor.live())
        assert stopped == ([run] if held else [])
