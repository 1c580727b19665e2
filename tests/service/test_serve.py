"""`tdhil serve` as a process, with real simulated runs in stepped time: requested, watched, killed, stopped."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

import tdhil
from drivers import CommunicationLost
from tdhil.cli.main import main
from tdhil.errors import ExitCode, UsageError
from tdhil.recording import read_run
from tdhil.service import AccountsFile, attend, server
from tdhil.service.client import ServiceError
from tdhil.service.run_state import State, now, way_to
from tdhil.service.server import require_way
from tdhil.service.store import Store, StoredRequest
from tests.recording.test_log_tail import write
from tests.rigs import PATIENT_LIMITS, rig_file
from tests.service.conftest import HANGS_S, folder_of_locks, wait_for

QUICK = {"seed": 7, "rate_hz": 50}         # a fifth of the usual rate of the drive, to save computing time


SERVE = """
import sys
from tdhil.session import drive_lock
drive_lock.FOLDERS = (sys.argv.pop(1),)        # a replay waits for a drive in use, but not in other tests
from tdhil.__main__ import console
console()
"""


class Server:
    def __init__(self, data: Path, *more: str, descriptors: int | None = None, **client: Any) -> None:
        """Start a server. ``descriptors``: its limit of open files."""
        limit = () if descriptors is None else ("prlimit", f"--nofile={descriptors}:{descriptors}")
        self.log = (data.parent / "serve.txt").open("a+")
        start = self.log.seek(0, os.SEEK_END)
        self.process = subprocess.Popen(
            [*limit, sys.executable, "-c", SERVE, folder_of_locks(data.parent / "locks"), "serve", "--data", str(data),
             "--port", "0", *more], stderr=self.log)
        address = wait_for("the address", lambda: re.search(r"https?://\S+", self.said(start)))
        self.url = address.group(0)
        self.client = tdhil.Client(self.url, **client)
        wait_for("an answer", self.answers)

    def said(self, start: int = 0) -> str:
        self.log.seek(start)
        return self.log.read()

    def answers(self) -> bool:
        with contextlib.suppress(CommunicationLost):
            return bool(self.client.rigs())
        return False


@contextlib.contextmanager
def served(data: Path, *more: str, descriptors: int | None = None, **client: Any) -> Iterator[Server]:
    server = Server(data, *more, descriptors=descriptors, **client)
    try:
        yield server
    finally:
        server.process.kill()
        server.process.wait()
        server.log.close()


@pytest.mark.heavy
def test_a_run_outlives_its_web_and_gives_one_result(tmp_path):
    """The web server is killed while the shaft moves. The run is complete, and the next web server finds it."""
    data = tmp_path / "data"
    with served(data) as first:
        assert [rig["id"] for rig in first.client.rigs()] == ["simulated-canopen", "simulated-modbus"]
        plan = first.client.plan("simulated-canopen", excitation="sine", frequency=0.2, amplitude="10rpm")["plan"]
        assert plan["excitation"] == "sine"
        run = first.client.start("simulated-canopen", key="once", **QUICK)["id"]
        wait_for("motion", lambda: first.client.run(run)["stage"] in ("speed", "torque"))
        with pytest.raises(ServiceError) as refused:
            first.client.start("simulated-canopen")
        assert (refused.value.status, refused.value.holder) == (409, f"run {run}")
        first.process.kill()
        first.process.wait()
    with pytest.raises(CommunicationLost, match="hard-wired emergency stop"):
        first.client.rigs()
    with served(data) as second:
        assert second.client.start("simulated-canopen", key="once", **QUICK)["id"] == run
        found = second.client.wait(run, timeout_s=HANGS_S)
        assert (found["state"], found["exit_code"], found["verdict"]) == ("done", 0, "valid")
        folder = data / "runs" / run
        logged = read_run(folder / "run.mcap")
        assert logged.complete
        assert logged.result == found["result"]
        replay = second.client.replay(run, tolerance=0.001)
        assert replay["result"]["verdict"] == "valid_wide"
        assert replay["result"]["inertia_kg_m2"]["value"] == found["result"]["inertia_kg_m2"]["value"]
        assert second.client.run(run)["result"] == found["result"]             # never overwritten
        assert second.client.download(run, "report.html", tmp_path / "report.html").read_bytes().startswith(b"<!")
        assert second.client.download(run, "log.mcap", tmp_path / "copy.mcap").read_bytes() == (
            folder / "run.mcap").read_bytes()
        assert len(second.client.runs()) == 1
        (inertia, *_) = second.client.trend("simulated-canopen")["quantities"]
        assert [(one["log"], one["value"]) for one in inertia["points"]] == [
            (run, found["result"]["inertia_kg_m2"]["value"])]
        assert second.client.audit()["broken"] is None
        assert second.client.rig("simulated-canopen")["last"]["inertia_kg_m2"] == pytest.approx(1.05 * 104.0, rel=0.02)
        second.client.annotate(run, tags=["after repair"], operator="Anna")
        assert [one["id"] for one in second.client.runs(text="repair anna")] == [run]
        with pytest.raises(ServiceError, match="no acceptance"):
            second.client.acceptance(run)
        second.client.archive(run)
        assert (second.client.runs(), len(second.client.runs(archived=True))) == ([], 1)
        with pytest.raises(ServiceError, match="id of the run"):
            second.client.delete(run, confirm="yes")
        assert second.client.run(run)["result"] == found["result"]
    one = json.loads((folder / "result.json").read_bytes())
    assert one == found["result"]


@pytest.mark.heavy
def test_the_end_of_the_service_interrupts_a_replay_and_keeps_its_request(tmp_path):
    """The process hung after SIGTERM, and the accepted replay was lost."""
    store, data = Store(tmp_path / "data"), tmp_path / "data"
    store.prepare()
    run = store.new_id()
    status = store.begin(StoredRequest(run, "simulated-canopen", "", "", {}, "local", now(), True, "never"))
    store.save(way_to(status.to(State.PREFLIGHT, now()).to(State.MOVING, now()), State.STOPPED, now(), exit_code=143))
    write(store.place(run) / "run.mcap")
    with served(data) as first:
        first.client._object("POST", f"/runs/{run}/replays", {})
        first.process.send_signal(signal.SIGTERM)
        assert first.process.wait(HANGS_S) == ExitCode.OK
    with served(data) as second:
        (found,) = second.client.run(run)["replays"]
        assert found["state"] in ("failed", "done")
        if found["result"] is None:
            assert found["error"]["next_step"]


@pytest.mark.heavy
def test_half_requests_that_are_cut_off_leave_no_traceback(tmp_path):
    """Each half request used to write two tracebacks, 5 KB of log, and delayed a later stop."""
    with served(tmp_path / "data") as server:
        at = urlsplit(server.url)
        for _ in range(20):
            with socket.create_connection((at.hostname, at.port), HANGS_S) as half:
                half.sendall(b"POST /api/v1/runs/x/stop HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 9\r\n\r\n{")
        with socket.create_connection((at.hostname, at.port), HANGS_S) as half:
            half.sendall(b"POST /api/v1/runs/x/stop HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 9\r\n\r\n{")
            half.shutdown(socket.SHUT_WR)
            while half.recv(4096):             # its end is seen by the service
                pass
        assert server.client.rigs()
        assert "Traceback" not in server.said()
        assert "ERROR" not in server.said()


@pytest.mark.heavy
@pytest.mark.real_time
def test_the_end_of_the_service_brakes_moving_shafts(tmp_path):
    """With SIGTERM, as of `systemctl stop`, the shaft is at standstill before the service ends.

    A stop from a page has the same effect.
"""
    (tmp_path / "rigs").mkdir()
    rig_file(tmp_path / "rigs", "drive: modbus\nrun: {simulate: true}\n", PATIENT_LIMITS)
    with served(tmp_path / "data", "--rigs", str(tmp_path / "rigs")) as server:
        run = server.client.start("rig", real_time=True)["id"]
        wait_for("motion", lambda: server.client.run(run)["state"] == "moving")
        server.process.send_signal(signal.SIGTERM)
        assert server.process.wait(HANGS_S) == ExitCode.OK
    status = json.loads((tmp_path / "data" / "runs" / run / "state.json").read_bytes())
    assert (status["state"], status["exit_code"]) == ("stopped", ExitCode.TERMINATED), status
    stop = status["stop"]
    assert stop["asked"] <= stop["seen"] <= stop["at_rest"]
    assert stop["confirmed"] is True


@pytest.mark.heavy
@pytest.mark.real_time
def test_a_watched_run_moves_with_the_code_of_another_terminal_and_brakes_when_its_web_is_killed(tmp_path):
    """The process of the run counts the lease time itself, without a web server."""
    rigs, data = tmp_path / "rigs", tmp_path / "data"
    rigs.mkdir()
    rig_file(rigs, "rate_hz: 20\nrun: {simulate: true}\n", PATIENT_LIMITS, "service: {motion: watched}\n")
    with served(data, "--rigs", str(rigs)) as server:
        with pytest.raises(UsageError, match="no service runs"):
            attend(tmp_path, print)
        shown: list[str] = []
        going = threading.Event()
        threading.Thread(target=attend, args=(data, shown.append, lambda: not going.is_set()), daemon=True).start()
        run = server.client.start("rig", real_time=True)["id"]
        (code,) = wait_for("the code", lambda: [one for text in shown for one in re.findall(r"(\d{3} \d{3})\n", text)])
        wait_for("the same on the other terminal", lambda: code in server.said())
        assert "an operator watches the page" in shown[-1]
        assert "Rig rig, SIMULATED. Requested by local" in shown[-1]
        assert 0.0 < Store(data).status(run).expected_half_width < 0.1
        key, post = "k" * 16, server.client._object
        binding = server.client.run(run)["confirmation"]["binding"]
        post("POST", f"/runs/{run}/confirm", {"code": code.replace(" ", ""), "binding": binding, "lease": key})
        wait_for("the run's lease", lambda: server.client.run(run)["watch"])       # begun once the run has its code
        wait_for("motion", lambda: post("POST", f"/runs/{run}/lease", {"key": key})["watch"]
                 and server.client.run(run)["stage"] == "speed")
        post("POST", f"/runs/{run}/lease", {"key": key})
        server.process.kill()
        server.process.wait()
        status = wait_for("its end", lambda: (
            found if (found := Store(data).status(run)).ended else None))
        going.set()
    assert (status.state, status.exit_code) == ("stopped", ExitCode.TERMINATED), status
    assert status.stop.confirmed is True
    assert status.stop.by == "nobody watched"
    assert (status.watch.by, status.watch.how) == ("local", "silent")
    log = read_run(data / "runs" / run / "run.mcap")
    told = [one.text for one in log.events if one.kind == "watch"]
    assert told[:2] == ["its page is open", "its page sends nothing"]
    assert status.error.what == "interrupted: the run was not watched for 5 s (its page sends nothing)"
    assert [one.text for one in log.events if one.kind == "interrupted"] == [status.error.what]
    assert abs(log.recording.speed_rad_s[-1]) < 0.1
    assert max(log.recording.speed_rad_s) > 0.5
    wait_for("what became of it", lambda: any(f"run {run}: moving" in one for one in shown))


@pytest.mark.parametrize("host", ["0.0.0.0", "192.0.2.1", "::", "rig.example", ""])
def test_another_host_without_login_and_tls_is_refused_in_words(host, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["serve", "--host", host]) == ExitCode.USAGE
    said = capsys.readouterr().err
    assert "needs a login and TLS" in said
    assert "ssh -L" in said
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(UsageError, match="there is no user yet"):
        require_way(host, tls=True, accounts=False)
    with pytest.raises(UsageError, match="needs a login"):
        require_way(host, tls=False, accounts=False)
    require_way(host, tls=True, accounts=True)


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.2", "::1", "localhost"])
def test_loopback_is_not_refused_without_users(host):
    require_way(host, tls=False, accounts=False)
    require_way(host, tls=True, accounts=False)
    require_way(host, tls=True, accounts=True)
    with pytest.raises(UsageError, match="must not be sent without TLS"):
        require_way(host, tls=False, accounts=True)


def test_a_certificate_that_does_not_serve_is_refused_in_words(tls, tmp_path, capsys, monkeypatch):
    cert, key = tls
    monkeypatch.chdir(tmp_path)
    (tmp_path / "no.pem").write_text("no certificate")
    subprocess.run(["openssl", "ec", "-aes128", "-passout", "pass:x", "-in", key, "-out", "locked.pem"], check=True,
                   capture_output=True)
    other = tmp_path / "other.pem"
    subprocess.run(["openssl", "ecparam", "-name", "prime256v1", "-genkey", "-noout", "-out", other], check=True)
    for pair in ((cert, tmp_path / "none.pem"), ("no.pem", key), (cert, "locked.pem"), (cert, other)):
        assert main(["serve", "--tls-cert", str(pair[0]), "--tls-key", str(pair[1])]) == ExitCode.USAGE
        assert "certificate and key can't be used" in capsys.readouterr().err
    assert main(["serve", "--tls-cert", str(cert)]) == ExitCode.USAGE
    assert main(["serve", "--allowed-host", "rig:80", "--tls-cert", str(cert), "--tls-key", str(key)]) == ExitCode.USAGE


@pytest.mark.heavy
def test_with_users_it_is_reached_over_tls_with_a_token_alone(tls, tmp_path):
    """A token over TLS is accepted. No token, another token, a plain connection and another host name are refused."""
    data = tmp_path / "data"
    accounts = AccountsFile(data)
    data.mkdir()
    accounts.add_user("anna", "admin", "correct horse battery")
    token = accounts.add_token("notebook", "operator")
    assert main(["serve", "--data", str(data), "--port", "0"]) == ExitCode.USAGE
    with served(data, "--tls-cert", str(tls[0]), "--tls-key", str(tls[1]), token=token, ca=tls[0]) as server:
        assert server.url.startswith("https://")
        assert server.client.me()["name"] == "notebook (token)"
        for client in (tdhil.Client(server.url, ca=tls[0]), tdhil.Client(server.url, ca=tls[0], token="tdhil_x")):
            with pytest.raises(ServiceError) as refused:
                client.rigs()
            assert (refused.value.status, refused.value.exit_code) == (401, ExitCode.REFUSED)
        with pytest.raises(ServiceError) as refused:
            server.client.audit()
        assert refused.value.status == 403
        with pytest.raises(CommunicationLost):
            tdhil.Client(server.url, token=token).rigs()           # an untrusted certificate
        with pytest.raises(CommunicationLost):
            tdhil.Client(server.url.replace("https", "http")).rigs()
        accounts.remove_token("notebook")
        wait_for("its end", lambda: not known(server.client))


def known(client: tdhil.Client) -> bool:
    return bool(client.me()["roles"])


def test_a_token_is_sent_over_tls_only():
    with pytest.raises(UsageError, match="over TLS only"):
        tdhil.Client("http://127.0.0.1:8420", token="tdhil_x")
    with pytest.raises(UsageError, match="can't be read as certificates"):
        tdhil.Client("https://127.0.0.1:8420", token="tdhil_x", ca="/none.pem")


def test_a_missing_extra_is_installed_from_the_clone(monkeypatch):
    monkeypatch.setattr(server, "find_spec", lambda name: None)
    with pytest.raises(UsageError, match=r"not installed here.*in the clone.*pip install '\.\[service\]'"):
        server.require_service()


def test_one_service_per_folder_and_an_existing_folder_of_rigs(tmp_path, capsys):
    from tdhil.service.server import _alone

    with _alone(tmp_path), pytest.raises(UsageError, match="another tdhil serve uses this folder"):
        _alone(tmp_path)
    assert main(["serve", "--rigs", str(tmp_path / "missing"), "--data", str(tmp_path)]) == ExitCode.USAGE
    assert "this folder does not exist. Create it, or name another" in capsys.readouterr().err
    assert main(["serve", "--port", "99999", "--data", str(tmp_path)]) == ExitCode.USAGE


@pytest.mark.parametrize(("arguments", "words"), [
    (["--data", "file"], "file: can't be made"), (["--data", "/proc/nothing"], "/proc/nothing: can't be made"),
    (["--data", "taken"], "taken: can't be written"), (["--data", "d", "--viewer", "foo"], "--viewer foo"),
    (["--data", "d", "--viewer", "http://a/b"], "--viewer http://a/b"),
    (["--check-idle", "--data", "d"], "--data d: this folder does not exist"),
    (["users", "list", "--data", "d"], "--data d: this folder does not exist"),
    (["users", "add", "anna", "--role", "admin", "--data", "file/d"], "--data file/d: can't be made"),
    (["--port", "0", "--mqtt", "mqtt://a", "users", "add", "anna", "--role", "admin", "--data", "d"],
     "--port --mqtt: has no effect with users"),
    (["--tls-cert", "a.pem", "tokens", "list", "--data", "d"], "--tls-cert: has no effect with tokens"),
    (["--check-idle", "audit", "--data", "d"], "--check-idle: has no effect with audit"),
])
def test_a_refused_start_is_explained(tmp_path, capsys, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tdhil.service.server._uvicorn", lambda *_: pytest.fail("it served"))
    (tmp_path / "file").touch()
    (tmp_path / "taken" / "service.lock").mkdir(parents=True)
    locks = tmp_path / "lock"              # its own folder, since another test may lock a drive of this computer
    locks.mkdir()
    locks.chmod(0o1777)
    monkeypatch.setattr("tdhil.session.drive_lock.FOLDERS", (str(locks),))
    serving = not {"users", "tokens", "audit"} & set(arguments)
    assert main(["serve", *(["--port", "0"] if serving else []), *arguments]) == ExitCode.USAGE
    assert words in capsys.readouterr().err
    assert not (tmp_path / "d").exists()


def test_an_unconfirmed_standstill_determines_the_exit_code(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("tdhil.service.server._uvicorn",
                        lambda app, listening, brake, *_: brake.__self__.not_at_rest.append("R1"))
    assert main(["serve", "--port", "0", "--data", str(tmp_path / "data")]) == ExitCode.STOP_NOT_CONFIRMED
    assert "Standstill NOT confirmed: R1. Use the hard-wired emergency stop." in capsys.readouterr().err


def test_a_file_without_a_valid_rig_id_is_reported_as_omitted(tmp_path, capsys, monkeypatch):
    for name in ("a.yaml", "rig 7.yaml", "b.yml", "notes.txt"):
        (tmp_path / name).write_text("run: {simulate: true}\n")
    monkeypatch.setattr("tdhil.service.server._uvicorn", lambda *_: None)
    assert main(["serve", "--port", "0", "--rigs", str(tmp_path), "--data", str(tmp_path / "data")]) == ExitCode.OK
    assert "Ignored, because the name is not that of a rig file: b.yml, rig 7.yaml." in capsys.readouterr().err


def test_a_client_shows_the_message_of_the_service():
    with pytest.raises(CommunicationLost, match="Is tdhil serve running"):
        tdhil.Client("http://127.0.0.1:1").rigs()


@pytest.mark.parametrize(("host", "names", "linked"), [
    ("127.0.0.1", (), "127.0.0.1"), ("0.0.0.0", ("bench.example.com",), "bench.example.com"),
    ("0.0.0.0", (), socket.gethostname()), ("::", (), socket.gethostname()), ("192.0.2.1", ("other",), "192.0.2.1"),
])
def test_a_link_names_a_host_that_can_be_reached(host, names, linked):
    assert server._reachable(host, names) == linked
