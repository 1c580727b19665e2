"""E-mails on ended runs and changed rigs, to a mail server of the test (RFC 5321)."""

from __future__ import annotations

import email
import socket
import threading
from dataclasses import replace
from email import policy

import pytest

from tdhil.errors import UsageError
from tdhil.service.mail import PASSWORD_FILE, SENDER, Mail
from tdhil.service.notifications import Notifier, message_of
from tests.service.conftest import wait_for
from tests.service.test_webhook import DONE, STEP, trend

FROM = {SENDER: "tdhil@bench.example"}


class Server(threading.Thread):
    """Mail server. ``got``: (recipients, message as received). ``replies``: unusual replies to commands."""

    def __init__(self, **replies: str) -> None:
        super().__init__(daemon=True)
        self.got: list[tuple[list[str], bytes]] = []
        self.commands: list[str] = []
        self.replies = replies
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.port = self._listening.getsockname()[1]

    def run(self) -> None:
        while True:
            try:
                peer, _ = self._listening.accept()
            except OSError:
                return
            with peer, peer.makefile("rb") as lines:
                self._talk(peer, lines)

    def _talk(self, peer, lines) -> None:
        recipients: list[str] = []
        peer.sendall(b"220 test\r\n")
        while line := lines.readline():
            words = line.decode().strip()
            self.commands.append(words)
            verb = words.partition(" ")[0].upper()
            usual = {"EHLO": "250 test", "DATA": "354 go on", "QUIT": "221 bye"}.get(verb, "250 ok")
            reply = self.replies.get(verb, usual)
            peer.sendall(reply.encode() + b"\r\n")
            if verb == "RCPT" and reply[0] == "2":
                recipients.append(words.partition("<")[2].partition(">")[0])
            if verb == "DATA" and reply[0] == "3":
                text = b"".join(iter(lines.readline, b".\r\n"))
                self.got.append((recipients, text))
                peer.sendall(b"250 taken\r\n")
            if verb == "QUIT":
                return

    def close(self) -> None:
        self._listening.shutdown(socket.SHUT_RDWR)         # ends the waiting `accept`, too
        self._listening.close()
        self.join()


@pytest.fixture
def server():
    found = Server()
    found.start()
    yield found
    if found.is_alive():
        found.close()


def mail(server, recipients="chief@example.com,driller@example.com", **environment):
    return Mail.of(f"smtp://127.0.0.1:{server.port}/{recipients}", FROM | environment).at("http://127.0.0.1:8420")


def read(text):
    return email.message_from_bytes(text, policy=policy.default)


def test_the_subject_marks_a_rehearsal(server):
    run = replace(DONE, simulated=True, rehearsal=True)
    assert mail(server)._written(message_of(run))["subject"].startswith("tdhil: a SIMULATED REHEARSAL: run ended")


def test_an_end_and_a_change_reach_each_recipient(server, monkeypatch):
    monkeypatch.setattr("tdhil.service.notifications.EVERY_S", 0.01)
    runs = [replace(DONE, simulated=True),
            replace(DONE, id="20260101-000001-aaaaaa", state="failed", exit_code=6, verdict=None, inertia_kg_m2=None,
                    simulated=False)]
    notifier = Notifier(mail(server), lambda: runs, lambda rig, run: (trend(), trend([STEP])))
    notifier.start()
    wait_for("the e-mails", lambda: len(server.got) >= 3)
    notifier.close()
    assert all(recipients == ["chief@example.com", "driller@example.com"] for recipients, _ in server.got)
    ended, changed, failed = (read(text) for _, text in server.got)
    assert ended["subject"] == "tdhil: a SIMULATED: run ended, J = 104 (100 to 108) kg·m²"
    assert changed["subject"] == "tdhil: a: results changed" and "changed by -5 %" in changed.get_content()
    assert failed["subject"] == "tdhil: a: run FAILED" and "exit code: 6" in failed.get_content()
    assert f"http://127.0.0.1:8420/runs/{DONE.id}" in ended.get_content()
    assert ended["from"] == "tdhil@bench.example" and ended["auto-submitted"] == "auto-generated"


def test_a_text_with_line_breaks_adds_no_header(server):
    mail(server).send(message_of(DONE) | {"rig": "a\r\nBcc: other@example.com", "verdict": "x\r\n.\r\nQUIT"})
    recipients, text = server.got[0]
    found = read(text)
    assert recipients == ["chief@example.com", "driller@example.com"] and found["bcc"] is None
    assert "\n.\r\n" not in text.decode().replace("..", "")


@pytest.mark.parametrize(("verb", "reply"), [("MAIL", "550 no"), ("RCPT", "550 unknown"), ("DATA", "452 full")])
def test_an_e_mail_that_is_refused_is_reported(server, monkeypatch, verb, reply):
    monkeypatch.setattr("tdhil.service.notifications.TRIES_S", (0.0, 0.0))
    server.replies[verb] = reply
    said = []
    Notifier(mail(server), list, lambda rig, run: ({}, {}), said.append)._deliver(message_of(DONE))
    assert len(said) == 1 and said[0].startswith("Mail: chief@example.com") and "was not delivered" in said[0]


def test_a_missing_server_is_an_error(server):
    found = mail(server)
    server.close()
    with pytest.raises(OSError):
        found.send(message_of(DONE))


def test_a_password_is_not_sent_without_encryption(server, tmp_path):
    (tmp_path / "secret").write_text("hush\n")
    found = Mail.of(f"smtp://me@127.0.0.1:{server.port}/a@b.example", FROM | {PASSWORD_FILE: str(tmp_path / "secret")})
    assert found.password == "hush" and "hush" not in repr(found) + str(found)
    with pytest.raises(OSError, match="offers no encryption"):
        found.send(message_of(DONE))
    assert server.got == [] and not any(one.startswith("AUTH") for one in server.commands)


@pytest.mark.parametrize("url", [
    "http://host/a@b.example", "smtp://host", "smtp://host/", "smtp://host/nobody", "smtp:///a@b.example",
    "smtp://host/a@b.example,", "smtp://me:pw@host/a@b.example", "smtp://host/a@b.example?x=1", "smtp://[x/a@b.example",
    "smtp://host:0/a@b.example", "smtp://host/a@b.example%0ABcc:c@d.example",
])
def test_an_address_that_is_none_is_refused_without_its_password(url):
    with pytest.raises(UsageError, match="--mail") as caught:
        Mail.of(url, FROM)
    assert "pw" not in str(caught.value)


@pytest.mark.parametrize(("url", "port", "encrypted"), [
    ("smtp://host/a@b.example", 25, False), ("smtps://host/a@b.example", 465, True),
    ("smtp://host:587/a@b.example", 587, False),
])
def test_the_port_is_the_usual_one(url, port, encrypted):
    found = Mail.of(url, FROM)
    assert (found.port, found.encrypted, found.recipients) == (port, encrypted, ("a@b.example",))
