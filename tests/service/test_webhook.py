"""Messages on ended runs and changed rigs, to a server of the test."""

from __future__ import annotations

import hashlib
import hmac
import json
import threading
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest

from tdhil.errors import UsageError
from tdhil.service.notifications import Notifier
from tdhil.service.run_filter import Summary
from tdhil.service.webhook import SECRET_FILE, SIGNATURE, Webhook
from tests.service.conftest import wait_for

DONE = Summary("20260101-000000-aaaaaa", "a", "done", "2026-01-01T00:00:00.000Z", "local", "2999-01-01T00:01:00.000Z",
               verdict="valid", inertia_kg_m2=104.0, low_kg_m2=100.0, high_kg_m2=108.0, exit_code=0)
STEP = {"after": DONE.id}


def trend(changes=(), drift=None):
    return {"quantities": [{"column": "inertia_kg_m2", "text": "changed by -5 %", "changes": list(changes),
                            "drift": drift}]}


@pytest.fixture
def listener():
    """Server on its own port. ``got``: (body, signature). ``statuses``: its next replies."""
    class Listener(BaseHTTPRequestHandler):
        def do_POST(self):
            body = self.rfile.read(int(self.headers["content-length"]))
            self.server.got.append((body, self.headers.get(SIGNATURE)))
            self.send_response(self.server.statuses.pop(0) if self.server.statuses else 204)
            self.end_headers()

        def log_message(self, *what):
            return

    server = HTTPServer(("127.0.0.1", 0), Listener)
    server.got, server.statuses = [], []
    thread = threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True)
    thread.start()
    yield server
    server.shutdown()
    server.server_close()
    thread.join()


def address(server):
    return f"http://127.0.0.1:{server.server_address[1]}/hook?site=1"


def test_an_end_a_failure_and_a_change_are_sent_once(tmp_path, listener, monkeypatch):
    monkeypatch.setattr("tdhil.service.notifications.EVERY_S", 0.01)
    monkeypatch.setattr("tdhil.service.notifications.TRIES_S", (0.0, 0.0))
    listener.statuses += [503]                                     # the first attempt fails
    secret = tmp_path / "secret"
    secret.write_text("hush\n")
    hook = Webhook.of(address(listener), {SECRET_FILE: str(secret)})
    runs = [DONE, replace(DONE, id="20260101-000001-aaaaaa", state="failed", exit_code=6, verdict=None),
            replace(DONE, id="20260101-000002-aaaaaa", state="moving", ended=None),
            replace(DONE, id="20250101-000000-aaaaaa", ended="2025-01-01T00:00:00.000Z")]
    notifier = Notifier(hook, lambda: runs, lambda rig, run: (trend(), trend([STEP])))
    notifier.start()
    wait_for("the messages", lambda: len(listener.got) >= 4)
    notifier.close()
    bodies = [json.loads(body) for body, _ in listener.got]
    assert [one["event"] for one in bodies] == ["run.ended", "run.ended", "rig.changed", "run.failed"]
    assert bodies[0] == bodies[1] and bodies[0]["inertia_kg_m2"] == 104.0 and bodies[0]["path"] == f"/runs/{DONE.id}"
    assert bodies[2]["text"] == "changed by -5 %"
    for body, signature in listener.got:
        assert signature == f"sha256={hmac.new(b'hush', body, hashlib.sha256).hexdigest()}"


def events(before, after, run=DONE):
    notifier = Notifier(Webhook("http://x"), lambda: [run], lambda rig, one: (before, after))
    return [one["event"] for one in notifier.news()] + [one["event"] for one in notifier.news()]


def test_a_change_is_sent_with_the_run_that_shows_it_and_never_for_a_rehearsal():
    assert events({}, trend()) == ["run.ended"]
    assert events(trend([STEP]), trend([STEP])) == ["run.ended"]
    assert events(trend(), trend(drift={"change": 0.1})) == ["run.ended", "rig.drifts"]
    assert events(trend(), trend([STEP]), replace(DONE, rehearsal=True)) == ["run.ended"]
    assert events(trend(), trend([STEP]), replace(DONE, state="refused")) == ["run.failed"]


def test_a_message_that_cannot_be_delivered_is_reported_and_the_next_one_is_sent(listener, monkeypatch):
    monkeypatch.setattr("tdhil.service.notifications.TRIES_S", (0.0, 0.0))
    said = []
    listener.statuses += [500, 301]
    Notifier(Webhook.of(address(listener), {}), list, lambda rig, run: ({}, {}), said.append)._deliver({"run": "x"})
    assert len(said) == 1 and "HTTP 301" in said[0] and "run x was not delivered" in said[0]
    assert listener.got[0][1] is None and "site=1" not in said[0] and "signed" not in said[0]


@pytest.mark.parametrize("secret", [None, b"hush"])
def test_the_start_states_that_messages_are_not_signed(secret):
    said = []
    notifier = Notifier(Webhook("http://x", secret), list, lambda rig, run: ({}, {}), said.append)
    notifier.start()
    notifier.close()
    assert (f"not signed: {SECRET_FILE} is not set" in said[0]) is (secret is None)


@pytest.mark.parametrize("url", ["ftp://x/y", "http://", "https://me:pw@host/", "host", "http://[x"])
def test_an_address_that_is_none_is_refused_without_its_password(url):
    with pytest.raises(UsageError, match="--webhook") as caught:
        Webhook.of(url, {})
    assert "pw" not in str(caught.value)
