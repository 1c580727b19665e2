"""Service on its own folder, with runs of `fake_run`."""

from __future__ import annotations

import json
import os
import re
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from starlette.testclient import TestClient

from tdhil.errors import TdhilError
from tdhil.service.access import Access
from tdhil.service.audit import Audit
from tdhil.service.limits import API
from tdhil.service.run_channel import RunRefused
from tdhil.service.run_state import FolderMissing, NotThere, Told, disk_full
from tdhil.service.start_request import Rigs
from tdhil.service.store import Index, Store
from tdhil.service.supervisor import Supervisor
from tdhil.service.web import Web
from tdhil.service.worker import WORK
from tests.rigs import limits_text

FAKE = Path(__file__).with_name("fake_run.py")
URL = "http://127.0.0.1:8420"
HANGS_S = 600.0


def wait_for(what: str, happens: Callable[[], Any], within_s: float = HANGS_S) -> Any:
    """Wait for a condition with a time-out, which only prevents an endless wait."""
    end_s = time.monotonic() + within_s
    while not (found := happens()):
        assert time.monotonic() < end_s, f"never came: {what}"
        time.sleep(0.02)
    return found


class Service:
    """One service without its web server: its parts, and its output on the terminal."""

    def __init__(self, folder: Path, rigs: Path | None, fake: bool = True, login: bool = False) -> None:
        self.said: list[str] = []
        self.store = Store(folder)
        self.store.prepare()
        self.audit, self.index = Audit(folder / "audit"), Index(self.store)
        command = (lambda run: [sys.executable, str(FAKE), str(run)]) if fake else None
        self.supervisor = Supervisor(self.store, Rigs(rigs), self.audit, self.index, say=self.said.append,
                                     command=command)
        self.access = Access(folder, login=login, say=self.said.append)
        self.web = Web(self.supervisor, access=self.access)

    def wait(self, run: str, *states: str) -> str:
        def there() -> str | None:
            state = self.store.status(run).state
            return state if state in states else None

        return str(wait_for(f"{run} {states}", there))


FACTS = {"verdict": "valid", "exit_code": 0, "simulated": False, "rehearsal": None, "identity": "",
         "said": {"operator": "Anna"}}
RESULT = {"verdict": "valid", "inertia_kg_m2": {"value": 104.0, "low_total": 100.0, "high_total": 108.0}}
_CWD = threading.Lock()


def play_uploads(service: Service, monkeypatch: pytest.MonkeyPatch, *, played: bool = True) -> list[str]:
    """Run the worker in this process. With `played` the identification of an upload is simulated.

    The note `fails` makes it fail.
"""
    done: list[str] = []

    def found(what: str, run: str | None, asked: dict[str, Any]) -> dict[str, Any]:
        done.append(what)
        if what == "upload" and played:
            place = Path(asked["place"])
            if asked["options"].get("note") == "fails":
                raise RunRefused(Told("CsvUnusable", "no row", "no row", "", "", 10, "TDH-1001"))
            (place / "run.mcap").write_bytes(b"log")
            (place / "result.json").write_text(json.dumps(RESULT))
            return {"document": FACTS}
        before = Path.cwd()
        with _CWD:
            try:
                return WORK[what](asked if run is None else {"folder": str(service.store.place(run)), **asked})
            except (TdhilError, OSError) as error:
                raise RunRefused(Told.of(disk_full(error) or error)) from error
            finally:
                os.chdir(before)

    monkeypatch.setattr(service.supervisor, "work", found)
    return done


@pytest.fixture
def nobody_s_port() -> Iterator[int]:
    """Return a reserved port without a server, since the lock of a drive is global on this computer."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        yield taken.getsockname()[1]


def folder_of_locks(at: Path) -> str:
    """Return a folder for locks that other users may write to, and which no other test uses."""
    at.mkdir(exist_ok=True)
    at.chmod(0o1777)
    return str(at)


@pytest.fixture
def own_locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Use own locks, so that drives in use by other tests on this computer have no effect."""
    monkeypatch.setattr("tdhil.session.drive_lock.FOLDERS", (folder_of_locks(tmp_path / "locks"),))


@pytest.fixture
def rigs(tmp_path: Path, nobody_s_port: int, own_locks: None) -> Path:
    """Return two simulated rigs, a real one that may move, one that may not, and one with an unreadable file."""
    folder = tmp_path / "rigs"
    folder.mkdir()
    for name in ("a", "b"):
        (folder / f"{name}.yaml").write_text(f"name: Rig {name}\nrun: {{simulate: true}}\n")
    real = f"modbus: {{host: 127.0.0.1, port: {nobody_s_port}}}\n" + limits_text(watchdog_s=None)
    (folder / "real.yaml").write_text(real + "service: {motion: attended}\n")
    (folder / "never.yaml").write_text(real)
    (folder / "watched.yaml").write_text(real + "service: {motion: watched}\n")
    (folder / "rehearsed.yaml").write_text("run: {simulate: true}\nservice: {motion: watched}\n")
    (folder / "broken.yaml").write_text("speed: <script>alert(1)</script>\n")
    return folder


@pytest.fixture
def service(tmp_path: Path, rigs: Path) -> Iterator[Service]:
    found = Service(tmp_path / "data", rigs)
    yield found
    for run in found.supervisor.live():
        with suppress(NotThere):                            # a run may have lost its folder
            (found.store.place(run) / "rest").touch()       # a braking run (`fake_run`) would not end
        with suppress(NotThere, FolderMissing):
            found.supervisor.stop(run, "end of the test")
    found.supervisor.close()


@pytest.fixture(scope="session")
def tls(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return a certificate for 127.0.0.1 and its key."""
    if shutil.which("openssl") is None:
        pytest.skip("no openssl to make a certificate")
    folder = tmp_path_factory.mktemp("tls")
    cert, key = folder / "cert.pem", folder / "key.pem"
    subprocess.run(["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes",
                    "-subj", "/CN=tdhil", "-addext", "subjectAltName=IP:127.0.0.1,DNS:localhost", "-days", "2",
                    "-keyout", key, "-out", cert], check=True, capture_output=True)
    return cert, key


class Checked:
    """Client that checks every reply of the API against the document."""

    def __init__(self, client: TestClient) -> None:
        self._client = client
        self.document = client.get(f"{API}/openapi.json").json()

    def __call__(self, method: str, path: str, expect: int, **sent: Any) -> Any:
        answer = self._client.request(method, f"{API}{path}", **sent)
        assert answer.status_code == expect, answer.text
        self.check(method, f"{API}{path.split('?', maxsplit=1)[0]}", answer)
        return answer.json() if "json" in answer.headers["content-type"] else answer

    def check(self, method: str, path: str, answer: Any) -> None:
        template = next(
            one for one in self.document["paths"]
            if re.fullmatch(re.sub(r"\{\w+\}", "[^/]+", one), path) and method.lower() in self.document["paths"][one]
        )
        described = self.document["paths"][template][method.lower()]["responses"][str(answer.status_code)]["content"]
        media = answer.headers["content-type"].split(";")[0]
        assert media in described, (path, media)
        if "schema" in described[media]:
            schema = {**described[media]["schema"], "components": self.document["components"]}
            jsonschema.validate(answer.json(), schema, cls=jsonschema.Draft202012Validator)

    def start(self, rig: str = "a", what: str = "done", expect: int = 201, **more: Any) -> dict[str, Any]:
        found = self("POST", f"/rigs/{rig}/runs", expect, json={"note": what, "seed": 7}, **more)
        assert isinstance(found, dict)
        return found


@pytest.fixture
def client(service: Service) -> Iterator[TestClient]:
    with TestClient(service.web.asgi, base_url=URL) as found:
        yield found


@pytest.fixture
def call(client: TestClient) -> Checked:
    return Checked(client)
