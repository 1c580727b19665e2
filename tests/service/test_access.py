"""Access rights: every route of the served document for every role, logins, tokens, and a stop that never waits."""

from __future__ import annotations

import contextlib
import fcntl
import io
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from starlette.requests import HTTPConnection
from starlette.testclient import TestClient
from starlette.websockets import WebSocketDisconnect

from tdhil.cli.main import main
from tdhil.errors import ExitCode, UsageError
from tdhil.service import access as access_module
from tdhil.service import accounts as accounts_module
from tdhil.service import supervisor as supervisor_module
from tdhil.service import web as web_module
from tdhil.service.access import SESSION_S, STOPS_S, Access, RequestPace, Tries, address_of
from tdhil.service.accounts import ROLES, AccountsFile, matches, scrypt
from tdhil.service.limits import API
from tdhil.service.run_state import NotAllowed, TooManyRuns, TooManyTries
from tdhil.service.start_request import edited
from tdhil.session import hold
from tests.service.conftest import Service, wait_for

URL = "https://127.0.0.1:8420"
PASSWORD = "correct horse battery"
WRONG = {"note": 7, "model": 7, "name": 7, "code": 7, "old": 7, "password": 7}      # not the body of any route
STOPS = ("stop", "stop_rig")
COOKIE = "__Host-tdhil-8420"


@pytest.fixture(autouse=True)
def cheap(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the hash of passwords cheap."""
    monkeypatch.setattr(accounts_module, "_N", 16)
    monkeypatch.setattr(accounts_module, "_P", 1)


class Guarded:
    """Service with a user and a token of each role, and one client that uses any of them."""

    def __init__(self, service: Service, client: TestClient) -> None:
        self.service, self.client, self.access = service, client, service.access
        self.time_s = 1_000_000.0
        self.access._clock = lambda: self.time_s
        self.document = client.get(f"{API}/openapi.json").json()
        self.tokens = {role: self.access.accounts.add_token(f"{role}-machine", role) for role in ROLES}
        self.sessions = {role: self.log_in(role) for role in ROLES}

    def log_in(self, name: str) -> dict[str, str]:
        """Return the headers of a page of this user."""
        cookie, who = self.access.log_in(name, PASSWORD, "192.0.2.1")
        return {"Cookie": f"{COOKIE}={cookie}", "X-CSRF-Token": who.csrf}

    def ended(self, name: str) -> dict[str, str]:
        """Return the headers of a user whose login has ended."""
        page, (last, session) = self.log_in(name), list(self.access._sessions.items())[-1]
        self.access._sessions[last] = replace(session, ends_s=self.time_s - 1.0)
        return page

    def of_token(self, role: str) -> dict[str, str]:
        return {"Authorization": f"Bearer {self.tokens[role]}"}

    def __call__(self, method: str, path: str, headers: dict[str, Any] | None = None, **sent: Any) -> Any:
        answer = self.client.request(method, f"{API}{path}", headers=headers or {}, **sent)
        self.client.cookies.clear()
        return answer

    def run(self, what: str = "done", rig: str = "a", by: str = "operator") -> str:
        answer = self("POST", f"/rigs/{rig}/runs", self.sessions[by], json={"note": what})
        assert answer.status_code == 201, answer.text
        run: str = answer.json()["id"]
        self.service.wait(run, {"ask": "awaiting_confirmation", "hold": "moving"}.get(what, "done"))
        return run

    def audit(self) -> list[tuple[str, str, str | None]]:
        return [(one.who, one.what, one.run) for one in self.service.audit.entries()]


@pytest.fixture
def people(tmp_path: Path) -> None:
    for role in ROLES:
        AccountsFile(tmp_path / "data").path.parent.mkdir(exist_ok=True)
        AccountsFile(tmp_path / "data").add_user(role, role, PASSWORD)


@pytest.fixture
def guarded(tmp_path: Path, rigs: Path, people: None) -> Iterator[Guarded]:
    service = Service(tmp_path / "data", rigs, login=True)
    with TestClient(service.web.asgi, base_url=URL) as client:
        yield Guarded(service, client)
        for run in service.supervisor.live():
            service.supervisor.stop(run, "end of the test")


# -- every route


@pytest.mark.heavy(each_share=True)
def test_every_route_for_everybody(guarded, monkeypatch):
    """The cases are from the served document. Requests without the right get 401 or 403 and have no effect.

    The body of the requests is invalid for every route, so that permitted requests change nothing either.
    """
    run = guarded.run()
    wait_for("its end", lambda: not guarded.service.supervisor.live())
    monkeypatch.setattr(guarded.service.supervisor, "work", lambda what, run, asked: {"document": {"checks": []}})
    everybody: dict[str, tuple[dict[str, str], int]] = {
        "nobody": ({}, -1), "a login that has ended": (guarded.ended("admin"), -1),
        "a machine": (guarded.of_token("operator"), 1),
        **{f"session {role}": (guarded.sessions[role], rank) for rank, role in enumerate(ROLES)},
    }
    filled = {"rig": "a", "run": run, "replay": "001", "number": "0", "fleet": "none", "upload": "none",
              "user": "no-one", "token": "none"}
    wrong: list[Any] = []
    for template, methods in guarded.document["paths"].items():
        path = template.removeprefix(API).format(**filled)
        for method, described in methods.items():
            name, role = described["operationId"], described["x-role"]
            needed = -1 if role == "anybody" else ROLES.index(role)
            assert bool(described["security"]) == (needed >= 0)
            sent = {} if method == "get" else {"json": WRONG}
            for who, (headers, rank) in everybody.items():
                if "x-websocket" in described:
                    code = closes(guarded, f"{API}{path}", headers, described["x-websocket"])
                    if code != (None if rank >= needed else 4401 if rank < 0 else 4403):
                        wrong.append((who, method, template, code))
                    code = guarded("GET", path, headers).status_code           # as if it were a page
                    if code != (426 if rank >= needed else 401):
                        wrong.append((who, "page of", template, code))
                    continue
                if name == "logout" and who.startswith("session"):
                    continue               # it works and would end the session for the next requests
                code = guarded(method.upper(), path, headers, **sent).status_code
                stops = name in STOPS and who == "a login that has ended"
                past = code not in (401, 403)
                if str(code) not in described["responses"] or past is not (rank >= needed or stops) or (
                        not past and code != (401 if rank < 0 else 403)):
                    wrong.append((who, method, template, code))
    assert wrong == []
    assert guarded.service.store.ids() == [run]
    assert guarded.document["components"]["securitySchemes"].keys() == {"token", "session"}


def test_who_may_what_is_as_it_was_agreed(guarded):
    """The rights are stated here again, since the document is derived from the tested table.

    Every user may read and stop. All other rights are listed here.
    """
    least = {
        "operator": {"start", "confirm", "renew", "ask_replay", "calibration", "ask_fleet", "stop_fleet", "pace",
                     "check_rig", "annotate", "uploads", "upload", "one_upload", "preview", "identify_upload",
                     "delete_upload"},
        "engineer": {"edit_rig", "sign_off", "archive", "sign_acceptance", "make_evidence", "add_rig", "draft_rig",
                     "scan_bus"},
        "admin": {"audit", "delete_run", "change_letterhead", "accounts", "add_user", "set_password", "remove_user",
                  "add_token", "remove_token"},
        "anybody": {"login", "logout", "me", "health", "openapi"},
    }
    changes_nothing = {"plan", "password", *STOPS}         # of other users
    found: dict[str, str] = {}
    for methods in guarded.document["paths"].values():
        for method, described in methods.items():
            found[described["operationId"]] = described["x-role"]
            if method != "get" and described["operationId"] not in set().union(*least.values()):
                assert described["operationId"] in changes_nothing
    assert found == {name: next((role for role, names in least.items() if name in names), "viewer") for name in found}
    assert set().union(*least.values(), changes_nothing) <= found.keys()


def test_only_a_token_gives_a_machine_its_role(guarded):
    for rank, role in enumerate(ROLES):
        assert guarded("GET", "/me", guarded.of_token(role)).json()["roles"] == list(ROLES[: rank + 1])
    for headers in ({"Authorization": "Bearer tdhil_x"}, {"Authorization": "Basic YTpi"}, {"Cookie": f"{COOKIE}=x"},
                    {**guarded.sessions["admin"], "Authorization": "Bearer"}):
        assert guarded("GET", "/me", headers).json()["roles"] == []
        assert guarded("GET", "/rigs", headers).status_code == 401


@pytest.mark.parametrize("path", ["/", "/rigs/a", "/start/a", "/runs", "/accounts", "/audit"])
def test_a_page_leads_to_the_login_and_back(guarded, path):
    answer = guarded.client.get(path, follow_redirects=False)
    assert (answer.status_code, answer.headers["location"]) == (303, f"/login?next={path.replace('/', '%2F')}")
    for role in ROLES:
        code = guarded.client.get(path, headers=guarded.sessions[role]).status_code
        assert code == (403 if path == "/audit" and role != "admin" else 200), role
    assert guarded.client.get("/login").status_code == 200
    assert guarded.client.get("/static/app.js").status_code == 200


@pytest.mark.parametrize(("path", "form"), [
    ("/rehearse/a", 'id="rehearse"'), ("/fleets", 'id="ask"'), ("/runs/{run}", 'id="replay"'),
    ("/upload", 'id="file"')])
def test_a_page_has_no_form_that_its_reader_may_not_send(guarded, path, form):
    page = path.format(run=guarded.run())
    for role in ROLES:
        assert (form in guarded.client.get(page, headers=guarded.sessions[role]).text) == (role != "viewer"), role


@pytest.mark.parametrize("there", [
    "//evil.example/", "https://evil.example", "/\\evil.example", "javascript:alert(1)", "", "/%0d%0aSet-Cookie",
    "/a b"])
def test_a_login_redirects_to_this_service_only(guarded, there):
    page = guarded.client.get("/login", params={"next": there}).text
    assert 'data-next="/"' in page or 'data-next="/%0d%0aSet-Cookie"' in page
    assert "evil" not in page


# -- login


def test_a_login_and_its_end(guarded):
    sent = {"json": {"name": " Operator ", "password": PASSWORD}}
    answer = guarded("POST", "/login", **sent)
    assert (answer.json()["name"], answer.json()["roles"]) == ("operator", ["viewer", "operator"])
    cookies = answer.headers.get_list("set-cookie")
    assert all("Secure" in one and "SameSite=strict" in one and "Path=/" in one and "Domain" not in one
               for one in cookies)
    assert ["HttpOnly" in one for one in cookies] == [True, False]
    given = dict(one.split(";")[0].split("=", 1) for one in cookies)
    page = {"Cookie": f"{COOKIE}={given[COOKIE]}", "X-CSRF-Token": given["__Host-tdhil-csrf-8420"]}
    assert guarded("GET", "/me", page).json()["name"] == "operator"
    on_disk = (guarded.service.store.folder / "sessions.json")
    assert given[COOKIE] not in on_disk.read_text()
    assert on_disk.stat().st_mode & 0o777 == 0o600
    # The port belongs to another service on this host.
    other = {"Host": "127.0.0.1:9000", "Cookie": page["Cookie"]}
    assert guarded("GET", "/me", other).json()["roles"] == []
    assert guarded("POST", "/logout", page, json={}).status_code == 200
    assert guarded("GET", "/rigs", page).status_code == 401
    assert Access(guarded.service.store.folder, login=True)._sessions.keys() == guarded.access._sessions.keys()
    wait_for("the audit", lambda: {("operator", "logged in", None), ("operator", "logged out", None)}
             <= set(guarded.audit()))


def test_a_login_lasts_a_shift_and_a_restart_and_stop_works_after_its_end(guarded, tmp_path):
    run = guarded.run("hold")
    page = guarded.sessions["operator"]
    again = Access(tmp_path / "data", login=True, clock=lambda: guarded.time_s)
    again.accounts.read()
    assert len(again._sessions) == len(ROLES)
    guarded.time_s += SESSION_S + 1.0
    assert "has ended" in guarded("GET", f"/runs/{run}", page).json()["error"]["what"]
    assert guarded("POST", f"/runs/{run}/stop", page, json={}).status_code == 200
    guarded.service.wait(run, "stopped")
    guarded.time_s += STOPS_S
    assert guarded("POST", f"/runs/{run}/stop", page, json={}).status_code == 401


@pytest.mark.parametrize("headers", [{"X-CSRF-Token": ""}, {"X-CSRF-Token": "x" * 32}, {"X-CSRF-Token": b"\xe9"}])
def test_a_request_without_the_token_of_the_login_changes_nothing(guarded, headers):
    page = {**guarded.sessions["operator"], **headers}
    for path in ("/rigs/a/runs", "/password", "/rigs/a/plan"):
        refused = guarded("POST", path, page, json={"note": "done"})
        assert (refused.status_code, refused.json()["error"]["where"]) == (403, "X-CSRF-Token")
    other = {**guarded.sessions["operator"], "X-CSRF-Token": guarded.sessions["admin"]["X-CSRF-Token"]}
    assert guarded("POST", "/rigs/a/runs", other, json={}).status_code == 403
    assert guarded.service.store.ids() == []


def test_a_change_or_removal_of_an_account_ends_its_sessions(guarded):
    accounts = AccountsFile(guarded.service.store.folder)      # as the terminal does
    accounts.set_password("operator", "another horse battery")
    accounts.remove_user("viewer")
    accounts.remove_token("admin-machine")
    guarded.access.refresh()
    for headers in (guarded.sessions["operator"], guarded.sessions["viewer"], guarded.of_token("admin")):
        assert guarded("GET", "/rigs", headers).status_code == 401
        assert guarded("POST", "/rigs/a/stop", headers, json={}).status_code == 401
    assert guarded("GET", "/rigs", guarded.sessions["admin"]).status_code == 200
    wanted = {"user changed", "user removed", "token removed"}
    wait_for("the audit", lambda: wanted <= {what for who, what, _ in guarded.audit() if who == "terminal"})


def test_an_open_socket_ends_with_the_login(guarded, monkeypatch):
    monkeypatch.setattr(web_module, "SOCKET_LOOK_S", 0.01)
    address = f"{URL.replace('http', 'ws')}{API}/live/{guarded.run('hold')}"
    for headers in ({}, {"Cookie": f"{COOKIE}=x"}, {"Authorization": "Bearer x"}):
        assert closes(guarded, address, headers) == 4401
    assert closes(guarded, f"{address}?token=x", guarded.sessions["viewer"]) == 4401        # no cookie with a token
    from_elsewhere = {"Origin": "https://lichtblick.example"}
    assert closes(guarded, f"{address}?token=x", from_elsewhere) == 4401
    with pytest.raises(WebSocketDisconnect) as refused:
        closes(guarded, address, {**guarded.sessions["viewer"], **from_elsewhere})
    assert refused.value.code == 4403
    with guarded.client.websocket_connect(f"{address}?token={guarded.tokens['viewer']}", headers=from_elsewhere) as one:
        assert one.receive_json()["type"] == "hello"
    with guarded.client.websocket_connect(address, headers=guarded.sessions["viewer"]) as socket:
        assert socket.receive_json()["type"] == "hello"
        guarded.access.accounts.remove_user("viewer")
        with pytest.raises(WebSocketDisconnect) as closed:
            while True:
                socket.receive_json()
    assert closed.value.code == 4401


def closes(guarded: Guarded, path: str, headers: dict[str, str], protocols: list[str] | None = None) -> int | None:
    """Return the code with which an accepted socket is closed at once, or None if it sends data first."""
    address = path if path.startswith("ws") else f"{URL.replace('http', 'ws')}{path}"
    with guarded.client.websocket_connect(address, headers=headers, subprotocols=protocols or None) as socket:
        message = socket.receive()
        return int(message["code"]) if message["type"] == "websocket.close" else None


# -- how often a password may be tried


def test_a_login_waits_for_a_minute_at_most_and_other_addresses_are_not_locked_out():
    time_s = 0.0
    tries = Tries(lambda: time_s)
    tries.begin("anna", "home")
    tries.good("anna", "home")
    for number in range(1, Tries.OF_NAME):
        tries.begin("anna", f"elsewhere {number % 7}")
    for address in ("elsewhere 0", "a new one"):
        with pytest.raises(TooManyTries) as told:
            tries.begin("anna", address)
        assert 0.0 < told.value.wait_s <= Tries.WINDOW_S
    tries.begin("anna", "home")
    tries.begin("bert", "elsewhere 0")
    for number in range(Tries.OF_ADDRESS - 1):
        tries.begin(f"name {number}", "one")
    tries.begin("anna", "home")
    tries.begin("name 0", "one")
    with pytest.raises(TooManyTries):
        tries.begin("name 99", "one")
    time_s = Tries.WINDOW_S
    tries.begin("name 99", "one")
    tries.begin("anna", "elsewhere 0")


def test_too_many_attempts_are_refused_but_a_stop_is_not(guarded):
    run = guarded.run("hold")
    for _ in range(Tries.OF_PAIR):
        answer = guarded("POST", "/login", json={"name": "operator", "password": "wrong"})
        assert (answer.status_code, answer.headers["www-authenticate"]) == (401, "Bearer")
    answer = guarded("POST", "/login", json={"name": "operator", "password": PASSWORD})
    assert answer.status_code == 429
    assert 1 <= int(answer.headers["retry-after"]) <= 60
    assert guarded("POST", f"/runs/{run}/stop", guarded.sessions["operator"], json={}).status_code == 200
    guarded.service.wait(run, "stopped")
    wait_for("the audit", lambda: guarded.audit().count(("nobody", "login refused", None)) == Tries.OF_PAIR)


@pytest.mark.parametrize("host", ["192.0.2.1", "2001:db8:0:1::5", "fe80::1%eth0", "::ffff:192.0.2.1"])
def test_addresses_are_grouped_by_network(host):
    connection = HTTPConnection({"type": "http", "client": (host, 1), "headers": []})
    assert address_of(connection) in ("192.0.2.1", "2001:db8:0:1::/64", "fe80::/64")


# -- a stop waits for nothing


def test_a_stop_waits_for_no_password_no_lock_no_file_and_no_disk(guarded, monkeypatch):
    run = guarded.run("hold")
    page, going, end = guarded.sessions["viewer"], threading.Event(), threading.Event()

    def slow(password: str, kept: str | None) -> bool:
        going.set()
        return end.wait(60.0) and False

    monkeypatch.setattr(access_module, "matches", slow)
    logging_in = [threading.Thread(target=guarded.client.post, args=(f"{API}/login",), kwargs={
        "json": {"name": f"name{number}", "password": "x"}}) for number in range(3)]
    for one in logging_in:
        one.start()
    assert going.wait(60.0)

    def full(*_: Any, **__: Any) -> None:
        raise OSError(28, "No space left on device")

    for name in ("write_json", "read_json"):
        monkeypatch.setattr(access_module, name, full)
    monkeypatch.setattr(guarded.service.audit, "note", full)
    path = guarded.access.accounts.path
    with path.with_suffix(".lock").open() as locked:
        fcntl.flock(locked, fcntl.LOCK_EX)
        path.write_text("{ broken")
        guarded.access.refresh()
        assert "the former ones stay in force" in guarded.service.said[-1]
        path.unlink()
        guarded.access.refresh()
        answer = guarded("POST", f"/runs/{run}/stop", page, json={})
    end.set()
    for one in logging_in:
        one.join()
    assert answer.status_code == 200
    guarded.service.wait(run, "stopped")
    assert guarded.service.store.status(run).stop.by == "viewer"


def test_a_login_on_a_full_disk_holds_as_long_as_the_process(guarded, monkeypatch):
    def full(*_: Any, **__: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(access_module, "write_json", full)
    page = guarded.log_in("viewer")
    assert guarded("GET", "/rigs", page).status_code == 200
    assert "end with this process" in guarded.service.said[-1]


# -- two users


@pytest.mark.heavy
def test_two_simultaneous_requests_give_one_run(guarded):
    answers: list[Any] = []
    asking = [threading.Thread(target=lambda who=who: answers.append(guarded(
        "POST", "/rigs/a/runs", {**guarded.sessions[who], "Idempotency-Key": "one"}, json={"note": "hold"})))
        for who in ("operator", "engineer") * 4]
    for one in asking:
        one.start()
    for one in asking:
        one.join()
    (run,) = guarded.service.store.ids()
    by = guarded.service.store.request(run).asked_by
    assert by in ("operator", "engineer")
    assert sorted(one.status_code for one in answers) == [200] * 3 + [201] + [409] * 4
    assert {one.json()["asked_by"] for one in answers if one.status_code < 400} == {by}
    assert {one.json()["holder"] for one in answers if one.status_code == 409} == {f"run {run}"}
    # Another user stops it, and the stop is attributed to that user.
    assert guarded("POST", "/rigs/a/stop", guarded.sessions["viewer"], json={}).status_code == 200
    guarded.service.wait(run, "stopped")
    assert guarded.service.store.status(run).stop.by == "viewer"
    wait_for("the audit", lambda: {(by, "asked", run), ("viewer", "stop asked", run)} <= set(guarded.audit()))


def test_the_confirming_user_is_distinguished_from_the_requesting_one(guarded):
    run = guarded.run("ask", "real", "operator")
    said = f"Rig real. Requested by operator, run {run}."
    wait_for("the code", lambda: any(said in one for one in guarded.service.said))
    code = {"json": {"code": "123456"}}
    assert guarded("POST", f"/runs/{run}/confirm", guarded.sessions["viewer"], **code).status_code == 403
    assert guarded("POST", f"/runs/{run}/confirm", guarded.of_token("engineer"), **code).status_code == 200
    guarded.service.wait(run, "done")
    wanted = {("operator", "asked", run), ("engineer-machine (token)", "confirmed", run)}
    wait_for("the audit", lambda: wanted <= set(guarded.audit()))


def test_two_simultaneous_confirmations_are_attributed_to_one_user(guarded):
    run, answers = guarded.run("ask", "real"), []
    confirming = [threading.Thread(target=lambda who=who: answers.append((who, guarded(
        "POST", f"/runs/{run}/confirm", guarded.sessions[who], json={"code": "123456"}).status_code)))
        for who in ("operator", "engineer", "admin")]
    for one in confirming:
        one.start()
    for one in confirming:
        one.join()
    assert sorted(code for _, code in answers) == [200, 409, 409]
    (by,) = [who for who, code in answers if code == 200]
    guarded.service.wait(run, "done")
    wait_for("the audit", lambda: len([one for one in guarded.audit() if "confirm" in one[1]]) == 3)
    assert [who for who, what, _ in guarded.audit() if what == "confirmed"] == [by]
    assert guarded("POST", f"/runs/{run}/confirm", guarded.sessions["admin"], json={"code": "1"}).status_code == 409
    wait_for("the one who came too late", lambda: guarded.audit()[-1][1] == "confirmation refused")


@pytest.mark.parametrize("option", [
    {"accept_unverified": "likely"}, {"accept_wider_limit": ["torque"]}, {"--accept-speed-unit": True}])
def test_only_an_engineer_overrides_unverified_entries(guarded, option):
    refused = guarded("POST", "/rigs/a/runs", guarded.sessions["operator"], json=option)
    assert (refused.status_code, guarded.service.store.ids()) == (403, [])
    assert "not an engineer" in refused.json()["error"]["what"]
    assert guarded("POST", "/rigs/a/runs", guarded.sessions["engineer"], json=option).status_code == 201


def test_no_request_over_http_accepts_a_missing_watchdog(guarded):
    for option in ("accept_no_watchdog", "accept_shared_watchdog"):
        refused = guarded("POST", "/rigs/a/runs", guarded.sessions["admin"], json={option: True})
        assert "never accepted over HTTP" in refused.json()["error"]["what"]
    assert guarded.service.store.ids() == []


# -- a rig's file


def test_expected_values_of_an_acceptance_are_edited_over_http():
    before = "name: bench 3\nrun: {simulate: true}\n"
    assert edited(before.encode(), before + "acceptance: {inertia: 104 kg·m² ± 5 %}\n", "a.yaml") == ("acceptance",)


def test_a_file_that_was_named_on_the_service_s_computer_stays_and_no_other_is_named_over_http():
    before = "name: bench 3\nrun: {simulate: true, plant: ../plant.yaml}\ndrive_data: {torque_calibration: ../c.json}\n"
    assert edited(before.encode(), before.replace("bench 3", "bench 4"), "a.yaml") == ("name",)
    with pytest.raises(NotAllowed, match="beside the rig's file"):
        edited(before.encode(), before.replace("../c.json", "/etc/c.json"), "a.yaml")


@pytest.mark.heavy
def test_an_engineer_edits_limits_of_a_rig_but_not_its_connection(guarded, rigs, nobody_s_port):
    engineer, path = guarded.sessions["engineer"], rigs / "real.yaml"
    before = path.read_text()
    path.chmod(0o640)
    found = guarded("GET", "/rigs/real/file", guarded.sessions["viewer"]).json()
    assert found["text"] == before

    def save(text: str, code: int, who: dict[str, str] = engineer, **more: Any) -> Any:
        answer = guarded("POST", "/rigs/real/file", who, json={"text": text, "sha256": found["sha256"], **more})
        assert answer.status_code == code, answer.text
        return answer.json()

    save(before.replace("torque_nm: 400.0", "torque_nm: 300.0"), 403, guarded.sessions["operator"])
    for wrong in ("port: 2", "host: 192.0.2.9"):
        key, value = wrong.split(": ")
        text = before.replace({"port": f"port: {nobody_s_port}", "host": "host: 127.0.0.1"}[key], wrong)
        assert "can't be changed over HTTP" in save(text, 403)["error"]["what"], value
    for more in ("allow_reverse: true\n", "run: {simulate: true}\n", "profile: ../../etc/passwd\n", "node: 3\n"):
        save(before + more, 403)
    save(before.replace("attended", "watched"), 403)
    assert "real.yaml:5" in save(before.replace("torque_nm: 400.0", "torque_nm: <b>"), 422)["error"]["message"]
    save(before.replace("torque_nm: 400.0", "torque_nm: -1"), 422)
    save("&a [*a, *a]", 422)
    save("", 422)
    save(before, 409, sha256="0" * 64)
    assert path.read_text() == before
    run = guarded.run("ask", "real")
    assert save(before, 409)["holder"] == f"run {run}"
    guarded("POST", f"/runs/{run}/stop", engineer, json={})
    wait_for("its end", lambda: not guarded.service.supervisor.live())
    done = save(before.replace("torque_nm: 400.0", "torque_nm: 300.0"), 200)
    assert guarded("GET", "/rigs/real", engineer).json()["limits"]["torque_nm"] == 300.0
    assert (path.read_text(), path.stat().st_mode & 0o777) == (done["text"], 0o640)
    kept = guarded.service.store.folder / "rigs" / "real" / f"{found['sha256']}.yaml"
    assert kept.read_text() == before
    wait_for("the audit", lambda: ("engineer", "rig file edited", None) in guarded.audit())
    for one in guarded.service.audit.entries():
        if one.what == "rig file edited":
            assert (one.rig, one.details["keys"], one.details["before"]) == ("real", ["limits"], found["sha256"])


@pytest.mark.heavy
def test_a_rig_s_file_is_not_edited_without_a_login_nor_in_a_folder_that_is_read_only(guarded, service, monkeypatch):
    with TestClient(service.web.asgi, base_url="http://127.0.0.1:8420") as client:
        assert client.post(f"{API}/rigs/a/file", json={"text": "", "sha256": ""}).status_code == 403

    def read_only(*_: Any) -> None:
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(supervisor_module, "write_whole", read_only)
    found = guarded("GET", "/rigs/a/file", guarded.sessions["engineer"]).json()
    answer = guarded("POST", "/rigs/a/file", guarded.sessions["engineer"],
                     json={"text": found["text"] + "rate_hz: 50\n", "sha256": found["sha256"]})
    assert (answer.status_code, guarded.service.supervisor.rigs.get("a").sha256) == (503, found["sha256"])
    assert "can't be written" in answer.json()["error"]["what"]


# -- without accounts, on loopback


def test_on_this_computer_all_is_allowed_until_there_are_users(service):
    with TestClient(service.web.asgi, base_url="http://127.0.0.1:8420") as client:
        def code(method: str, path: str, **more: Any) -> int:
            return int(client.request(method, f"{API}{path}", **more).status_code)

        assert len(client.get(f"{API}/me").json()["roles"]) == len(ROLES)
        assert code("GET", "/audit") == 200
        # Through a proxy it is another client. An unknown token is not the same as no token.
        for headers in ({"X-Forwarded-For": "192.0.2.1"}, {"Forwarded": "for=x"}, {"Authorization": "Bearer x"}):
            assert code("GET", "/rigs", headers=headers) == 401
        assert code("POST", "/login", json={"name": "a", "password": "b"}) == 422
        assert code("POST", "/users", json={"name": "anna", "role": "admin", "password": PASSWORD}) == 422
        assert client.get("/login", follow_redirects=False).status_code == 303
        AccountsFile(service.store.folder).add_user("anna", "admin", PASSWORD)
        service.access.refresh()
        assert code("GET", "/rigs") == 200
        assert code("POST", "/rigs/a/stop", json={}) == 200
        refused = client.post(f"{API}/rigs/a/runs", json={})
        assert refused.status_code == 403
        assert "tdhil serve --tls-cert" in refused.json()["error"]["next_step"]


@pytest.mark.heavy
def test_a_watched_rig_moves_only_for_a_logged_in_user(guarded):
    """The refusal without a login is in tests/service/test_api.py."""
    for headers in (guarded.of_token("operator"), guarded.sessions["operator"]):
        answer = guarded("POST", "/rigs/watched/runs", headers, json={"note": "ask"})
        run = answer.json()["id"]
        guarded.service.wait(run, "awaiting_confirmation")
        guarded("POST", f"/runs/{run}/stop", guarded.sessions["viewer"], json={})
        guarded.service.wait(run, "stopped")
        wait_for("its end", lambda: not guarded.service.supervisor.live())


# -- accounts


def test_an_admin_adds_and_removes_over_http(guarded):
    admin = guarded.sessions["admin"]
    assert guarded("POST", "/users", admin, json={
        "name": "anna", "role": "viewer", "password": PASSWORD}).json()["role"] == "viewer"
    assert guarded("POST", "/users", admin, json={
        "name": "bert", "role": "king", "password": PASSWORD}).status_code == 422
    page = guarded.log_in("anna")
    changed = guarded("POST", "/password", page, json={"old": "wrong", "new": "yet another horse"})
    assert (changed.status_code, changed.json()["error"]["what"]) == (422, "the old password is wrong")
    assert guarded("POST", "/password", page, json={"old": PASSWORD, "new": "yet another horse"}).status_code == 200
    assert guarded("GET", "/rigs", page).status_code == 401
    assert guarded("POST", "/users/anna/password", admin, json={"password": PASSWORD}).status_code == 200
    page = guarded.log_in("anna")
    assert "anna" not in str(guarded("POST", "/users/anna/remove", admin, json={}).json())
    assert guarded("GET", "/rigs", page).status_code == 401
    made = guarded("POST", "/tokens", admin, json={"name": "meter", "role": "viewer"}).json()
    assert guarded("GET", "/me", {"Authorization": f"Bearer {made['token']}"}).json()["name"] == "meter (token)"
    everything = guarded("GET", "/accounts", admin).text
    assert made["token"] not in everything
    assert "scrypt" not in everything
    guarded("POST", "/tokens/meter/remove", admin, json={})
    assert guarded("GET", "/metrics", {"Authorization": f"Bearer {made['token']}"}).status_code == 401
    last = guarded("POST", "/users/admin/remove", admin, json={})
    assert (last.status_code, last.json()["error"]["what"]) == (422, "is the last admin")
    wait_for("the audit", lambda: {"user added", "password set", "user removed", "token added", "token removed"}
             <= {what for who, what, _ in guarded.audit() if who in ("admin", "anna")})
    assert guarded.service.audit.verify() is None


@pytest.mark.heavy
def test_a_change_by_the_service_is_attributed_correctly(guarded, monkeypatch):
    """The thread of the service checks during the change. The user of the change is recorded once and correctly."""
    written = accounts_module.write_json

    def looked_at(*given: Any, **more: Any) -> None:
        written(*given, **more)
        looking = threading.Thread(target=guarded.access.refresh)
        looking.start()
        looking.join(0.05)

    monkeypatch.setattr(accounts_module, "write_json", looked_at)
    guarded("POST", "/tokens", guarded.sessions["admin"], json={"name": "meter", "role": "viewer"})
    monkeypatch.undo()
    guarded.access.refresh()
    wait_for("the audit", lambda: ("admin", "token added", None) in guarded.audit())
    assert [who for who, what, _ in guarded.audit() if what == "token added"] == ["admin"]


def test_stored_data_contain_no_secrets(tmp_path):
    accounts = AccountsFile(tmp_path)
    accounts.add_user("anna", "operator", PASSWORD)
    accounts.add_user("bert", "operator", PASSWORD)
    token = accounts.add_token("meter", "viewer")
    text = accounts.path.read_text()
    assert PASSWORD not in text
    assert token not in text
    assert accounts.known.users["anna"].password != accounts.known.users["bert"].password
    assert accounts.path.stat().st_mode & 0o777 == 0o600
    assert AccountsFile(tmp_path).read() == accounts.known
    assert matches(PASSWORD, accounts.known.users["anna"].password)
    assert not matches(PASSWORD + "x", accounts.known.users["anna"].password)
    assert not matches(PASSWORD, None)
    accounts.set_password("bert", "x y" * 66 + "ab")
    assert not matches("x y" * 66 + "abc", accounts.known.users["bert"].password)
    assert accounts.known.of_token(token).name == "meter"
    assert accounts.known.of_token("") is None


@pytest.mark.heavy
def test_the_hash_of_a_password_has_the_required_cost(monkeypatch):
    """The product uses 32 MB and three passes. The result agrees with RFC 7914 for its salt and cost."""
    monkeypatch.undo()
    assert scrypt("x").startswith(f"scrypt${2**15}$8$3$")
    vector = "7023bdcb3afd7348461c06cd81fd38ebfda8fbba904f8e3ea9b543f6545da1f2"
    assert accounts_module._derive("pleaseletmein", b"SodiumChloride", 2**14, 8, 1).hex() == vector


@pytest.mark.parametrize("name", [
    "", "A", "../x", "a/b", "<script>", "\x1b[31m", "a b", "local", "service", "terminal", "x" * 33, ".x", "a\n"])
def test_names_have_plain_characters(tmp_path, name):
    accounts = AccountsFile(tmp_path)
    with pytest.raises(UsageError, match="must be 1 to 32"):
        accounts.add_user(name, "viewer", PASSWORD)
    with pytest.raises(UsageError, match="must be 1 to 32"):
        accounts.add_token(name, "viewer")
    assert not accounts.path.exists()


@pytest.mark.parametrize("password", ["", "short", "password123", "anna1234567", "aaaaaaaaaaaa", "x" * 201])
def test_a_common_password_is_refused(tmp_path, password):
    with pytest.raises(UsageError, match="password"):
        AccountsFile(tmp_path).add_user("anna", "viewer", password)


@pytest.mark.parametrize("text", [
    "", "[]", "{}", '{"users": {"a": {}}, "tokens": {}}', '{"users": [], "tokens": {}}',
    '{"users": {"a": {"role": "king", "password": "scrypt$16$8$1$00$00", "since": "x"}}, "tokens": {}}',
    '{"users": {"a": {"role": "admin", "password": "x", "since": "x"}}, "tokens": {}}',
    '{"users": {}, "tokens": {"a": {"role": "admin", "sha256": "", "since": "x"}}}',
])
def test_invalid_accounts_permit_no_login_and_no_start(tmp_path, text, capsys):
    (tmp_path / "accounts.json").write_text(text)
    with pytest.raises(UsageError, match="can't be read"):
        AccountsFile(tmp_path).read()
    assert main(["serve", "--data", str(tmp_path)]) == ExitCode.USAGE
    assert "accounts can't be read" in capsys.readouterr().err


def test_a_name_that_is_tried_is_text_in_the_audit(guarded):
    for name in ("<script>alert(1)</script>", "\x1b[2J\x07", "../../etc/passwd", "\u202egnp"):
        assert guarded("POST", "/login", json={"name": name, "password": "x"}).status_code == 401
    wait_for("the audit", lambda: len([one for one in guarded.audit() if one[1] == "login refused"]) == 4)
    for path in (guarded.service.store.folder / "audit").glob("*.jsonl"):
        assert b"\x1b" not in path.read_bytes()
    assert guarded.service.audit.verify() is None


# -- on the terminal


def test_no_control_characters_reach_the_terminal_of_serve(monkeypatch, capsys):
    """The text may be the name of a rig or a drive, or an error message."""
    monkeypatch.setattr("tdhil.service.serve", lambda rigs, data, host, port, say, **_: say("a\x1b[2Jb\x07\nc") or 0)
    assert main(["serve"]) == 0
    assert capsys.readouterr().err == "a␛[2Jb␇\nc\n"


def test_users_and_tokens_on_the_terminal(tmp_path, capsys, monkeypatch):
    data = ["--data", str(tmp_path / "data")]

    def typed(text: str, *arguments: str) -> int:
        monkeypatch.setattr("sys.stdin", io.StringIO(text))
        return main(["serve", *arguments, *data])

    assert typed(f"{PASSWORD}\n", "users", "add", "anna", "--role", "admin") == 0
    assert "requires a login" in capsys.readouterr().err
    assert typed("short\n", "users", "add", "bert", "--role", "viewer") == ExitCode.USAGE
    assert typed(f"{PASSWORD}\n", "users", "add", "anna", "--role", "viewer") == ExitCode.USAGE
    assert typed("another horse\n", "users", "passwd", "anna") == 0
    assert typed("", "tokens", "add", "meter", "--role", "viewer") == 0
    token = capsys.readouterr().out.strip()
    known = AccountsFile(tmp_path / "data").read()
    assert matches("another horse", known.users["anna"].password)
    assert known.of_token(token).role == "viewer"
    assert typed("", "users", "list") == 0
    assert capsys.readouterr().out.split()[:2] == ["anna", "admin"]
    assert typed("", "tokens", "remove", "meter") == 0
    assert typed("", "users", "remove", "nobody") == ExitCode.USAGE
    assert typed("", "users", "remove", "anna") == 0
    assert not AccountsFile(tmp_path / "data").read()


# -- a drive without a run, what is public, and how many runs may show a code


@pytest.mark.heavy
def test_every_user_stops_runs_and_drives_that_tdhil_moves_and_an_operator_any_drive(guarded, monkeypatch):
    """A stop of a drive that no tdhil process moves opens its bus (decision 0022)."""
    stopped: list[str] = []
    monkeypatch.setattr(guarded.service.supervisor, "stop_drive",
                        lambda rig, who: stopped.append(who) or (0, "tdhil stop confirmed standstill"))
    viewers = (guarded.sessions["viewer"], guarded.of_token("viewer"), guarded.ended("admin"))

    def stop(headers, rig="real"):
        return guarded("POST", f"/rigs/{rig}/stop", headers, json={})

    for headers in viewers:
        answer = stop(headers)
        assert answer.status_code == 403
        assert "no tdhil moves this rig" in answer.json()["error"]["what"]
        assert "hard-wired emergency stop" in answer.json()["error"]["next_step"]
    assert stopped == []
    assert stop(guarded.sessions["operator"]).json()["said"] == "tdhil stop confirmed standstill"
    with hold(guarded.service.supervisor.rigs.get("real").address):
        assert {stop(headers).status_code for headers in viewers} == {200}
    monkeypatch.setattr(guarded.service.supervisor, "blocked", lambda rig: "a run")
    assert {stop(headers).status_code for headers in viewers} == {200}
    monkeypatch.undo()
    for rig in ("a", "broken"):                        # a simulated one, and one with an unreadable file
        assert stop(viewers[0], rig).status_code == 200
    run = guarded.run("ask", rig="real")
    assert stop(viewers[0]).json()["runs"] == [run]
    guarded.service.wait(run, "stopped")


def test_runs_are_named_to_logged_in_users_only(guarded):
    run = guarded.run("hold")
    assert guarded("GET", "/healthz").json()["live"] == []
    assert guarded("GET", "/healthz", guarded.ended("admin")).json()["live"] == []
    assert guarded("GET", "/healthz", guarded.sessions["viewer"]).json()["live"] == [run]
    assert run not in guarded.client.get("/healthz").text


def test_codes_are_shown_ten_times_in_ten_minutes_and_forty_times_a_day():
    time_s = 0.0
    pace = RequestPace(lambda: time_s)
    begun = 0
    for _ in range(20):
        with contextlib.suppress(TooManyRuns):
            pace.begin("anna", "192.0.2.1", "r")
            begun += 1
    assert begun == 10
    with pytest.raises(TooManyRuns) as refused:
        pace.begin("anna", "192.0.2.2", "r")               # from another address: the limit is per user
    assert refused.value.wait_s == 600.0
    pace.begin("berta", "192.0.2.1", "r")
    for minute in range(23 * 60):
        time_s = 600.0 + 60.0 * minute
        with contextlib.suppress(TooManyRuns):
            pace.begin("anna", "192.0.2.1", "r")
            begun += 1
    assert begun == 40
    time_s += 86_400.0
    pace.begin("anna", "192.0.2.1", "r")


def test_an_address_has_its_own_limit_and_refused_requests_do_not_count():
    pace, begun = RequestPace(lambda: 0.0), 0
    for user in range(100):
        with contextlib.suppress(TooManyRuns):
            pace.begin(f"user-{user}", "192.0.2.1", "r")
            begun += 1
    assert begun == 30
    for _ in range(10):
        pace.begin("user-99", "192.0.2.2", "r")


@pytest.mark.heavy
def test_runs_that_show_a_code_are_limited_and_simulated_ones_are_not(guarded, monkeypatch):
    monkeypatch.setattr(RequestPace, "LIMITS", ((600.0, 2, 9), (86_400.0, 40, 120)))
    for _ in range(2):
        run = guarded.run("ask", rig="real")
        guarded("POST", f"/runs/{run}/stop", guarded.sessions["operator"], json={})
        guarded.service.wait(run, "stopped")
        wait_for("its end", lambda: not guarded.service.supervisor.live())
    for rig in ("real", "rehearsed"):
        refused = guarded("POST", f"/rigs/{rig}/runs", guarded.sessions["operator"], json={"note": "ask"})
        assert refused.status_code == 429
        assert "too many runs that show a code" in refused.json()["error"]["what"]
        assert 1 <= int(refused.headers["retry-after"]) <= 600
    assert len(guarded.service.store.ids()) == 2
    guarded.run("done")                                    # a simulated one


# -- the accounts as they change


def test_accounts_are_known_from_the_start_and_read_again_until_the_end(tmp_path):
    accounts, told = AccountsFile(tmp_path), []
    accounts.add_user("anna", "operator", PASSWORD)
    access = Access(tmp_path, login=True, changed=lambda what, name: told.append((what, name)))
    access.close()                             # a thread that was never started
    access = Access(tmp_path, login=True, changed=lambda what, name: told.append((what, name)))
    access.start()
    assert list(access.accounts.known.users) == ["anna"]
    assert told == []
    accounts.add_user("bert", "viewer", PASSWORD)
    wait_for("the second", lambda: told == [("user added", "bert (viewer)")])
    accounts.remove_user("anna")
    wait_for("one less", lambda: told[1:] == [("user removed", "anna")])
    access.close()
    assert not access._thread.is_alive()


def test_unreadable_accounts_are_reported_once_and_the_former_ones_are_used(tmp_path):
    accounts, said = AccountsFile(tmp_path), []
    accounts.path.write_text("{")
    access = Access(tmp_path, login=True, say=said.append)
    access.refresh()
    access.refresh()
    assert len(said) == 1
    accounts.path.unlink()
    accounts.add_user("anna", "operator", PASSWORD)
    access.refresh()
    accounts.path.write_text("{")
    access.refresh()
    assert list(access.accounts.known.users) == ["anna"]
    assert len(said) == 2                      # again, since it was readable in between


def test_a_host_with_a_port_that_is_none_has_the_cookies_of_443():
    scope = {"type": "http", "headers": [(b"host", b"rig:99999999")]}
    assert access_module._named("x", HTTPConnection(scope)) == "x-443"


# -- stored attempts and requests are limited


def test_the_right_password_clears_the_wrong_attempts_of_that_pair():
    tries = Tries(lambda: 0.0)
    for _ in range(3):
        for _ in range(Tries.OF_PAIR - 1):
            tries.begin("anna", "192.0.2.1")
        tries.good("anna", "192.0.2.1")
    for _ in range(Tries.OF_PAIR):
        tries.begin("anna", "192.0.2.1")
    with pytest.raises(TooManyTries):
        tries.begin("anna", "192.0.2.1")


def test_addresses_that_a_name_came_from_are_kept_up_to_a_number(monkeypatch):
    tries = Tries(lambda: 0.0)
    monkeypatch.setattr(Tries, "_MOST", 3)
    for number in range(5):
        tries.good("anna", f"192.0.2.{number}")
    assert tries._good == {("anna", "192.0.2.4")}


def test_runs_of_more_than_a_day_ago_do_not_count(monkeypatch):
    time_s = 0.0
    pace = RequestPace(lambda: time_s)
    for _ in range(3):
        pace.begin("anna", "192.0.2.1", "a")
        time_s += RequestPace.LIMITS[-1][0]
    assert [len(times) for times in pace._begun.values()] == [1, 1]


def test_a_login_is_a_good_attempt_and_expires(tmp_path):
    AccountsFile(tmp_path).add_user("anna", "operator", PASSWORD)
    access = Access(tmp_path, login=True, clock=lambda: 1000.0)
    access.refresh(first=True)
    _, who = access.log_in("anna", PASSWORD, "192.0.2.1")
    assert access.tries._good == {("anna", "192.0.2.1")}
    assert access.ends_s(who) == 1000.0 + SESSION_S
    assert access.ends_s(access_module.LOCAL) is None


def test_old_attempts_are_removed(monkeypatch):
    time_s = 0.0
    tries = Tries(lambda: time_s)
    monkeypatch.setattr(Tries, "_MOST", 3)
    for number in range(6):
        tries.begin(f"user {number}", f"192.0.2.{number}")
    assert len(tries._tried) == 18
    time_s = Tries.WINDOW_S
    tries.begin("anna", "192.0.2.77")
    assert {key[1] for key in tries._tried} == {"anna", "192.0.2.77"}


def test_old_requests_of_runs_are_removed(monkeypatch):
    time_s = 0.0
    pace = RequestPace(lambda: time_s)
    monkeypatch.setattr(RequestPace, "_MOST", 3)
    for number in range(6):
        pace.begin(f"user {number}", f"192.0.2.{number}", "a")
    assert len(pace._begun) == 12              # all of them still count
    time_s = RequestPace.LIMITS[-1][0]
    pace.begin("anna", "192.0.2.77", "a")
    assert set(pace._begun) == {("user", "anna"), ("address", "192.0.2.77")}


def test_the_oldest_login_is_replaced_by_a_new_one(tmp_path, monkeypatch):
    AccountsFile(tmp_path).add_user("anna", "operator", PASSWORD)
    access = Access(tmp_path, login=True)
    access.refresh(first=True)
    monkeypatch.setattr(access_module, "_MOST_SESSIONS", 3)
    logins = [access.log_in("anna", PASSWORD, f"192.0.2.{number}")[1].session for number in range(5)]
    assert [one[:16] for one in access._sessions] == logins[2:]


def test_the_form_of_a_sign_off_is_shown_to_those_who_may_sign(guarded):
    request = guarded("POST", "/rigs/a/runs", guarded.sessions["operator"], json={"note": "unseen"})
    run = request.json()["id"]
    guarded.service.wait(run, "stop_not_confirmed")
    for role in ROLES:
        page = guarded.client.get(f"/runs/{run}", headers=guarded.sessions[role])
        assert page.status_code == 200
        assert ('<form id="sign">' in page.text) is (ROLES.index(role) >= ROLES.index("engineer"))
