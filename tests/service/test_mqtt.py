"""Messages to a broker: retained, at least once, and without subscriptions, so no commands are possible."""

from __future__ import annotations

import contextlib
import json
import shutil
import socket
import ssl
import subprocess
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

from tdhil.cli.main import main
from tdhil.errors import ExitCode, UsageError
from tdhil.service import mqtt
from tdhil.service.mqtt import Broker, Publisher
from tests.service.conftest import HANGS_S, wait_for

Client: Any = pytest.importorskip("paho.mqtt.client", reason="paho-mqtt is not installed (extra mqtt)").Client

CONNECT, CONNACK, PUBLISH, PUBACK, DISCONNECT = 1, 2, 3, 4, 14        # MQTT 3.1.1, 2.2.1


class Heard:
    """Broker by the specification: it acknowledges and records every packet."""

    def __init__(self, port: int = 0, tls: ssl.SSLContext | None = None, at: socket.socket | None = None) -> None:
        self._tls = tls
        self.listening = at or socket.create_server(("127.0.0.1", port))
        self.listening.listen()
        self.port = self.listening.getsockname()[1]
        self.packets: list[tuple[int, int, bytes]] = []                # type, flags, body
        self._peers: list[socket.socket] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                peer, _ = self.listening.accept()
                self._peers.append(peer)
                threading.Thread(target=self._serve, args=(peer,), daemon=True).start()

    def _serve(self, peer: socket.socket) -> None:
        with contextlib.suppress(OSError, IndexError), contextlib.ExitStack() as both:
            if self._tls is not None:
                peer = both.enter_context(self._tls.wrap_socket(peer, server_side=True))
            file = both.enter_context(peer.makefile("rb"))
            while True:
                first, length, shift = file.read(1)[0], 0, 0
                while True:
                    byte = file.read(1)[0]
                    length |= (byte & 0x7F) << shift
                    shift += 7
                    if byte < 0x80:
                        break
                kind, flags, body = first >> 4, first & 0xF, file.read(length)
                self.packets.append((kind, flags, body))
                if kind == CONNECT:
                    peer.sendall(b"\x20\x02\x00\x00")
                elif kind == PUBLISH:
                    name = 2 + int.from_bytes(body[:2], "big")
                    peer.sendall(b"\x40\x02" + body[name:name + 2])

    def published(self) -> list[tuple[str, str]]:
        found = []
        for kind, flags, body in tuple(self.packets):
            if kind == PUBLISH:
                assert flags & 0b0111 == 0b0011, "QoS 1, retained"
                end = 2 + int.from_bytes(body[:2], "big")
                found.append((body[2:end].decode(), body[end + 2:].decode()))
        return found

    def last(self) -> dict[str, str]:
        return dict(self.published())

    def close(self) -> None:
        for one in (self.listening, *self._peers):
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(mqtt, "EVERY_S", 0.01)
    monkeypatch.setattr(mqtt, "RETRY_S", (0.05, 0.1))
    for name in (mqtt.USER, mqtt.PASSWORD, mqtt.PASSWORD_FILE, mqtt.CA_FILE):
        monkeypatch.delenv(name, raising=False)


@contextlib.contextmanager
def publishing(port: int, look: Any, said: list[str], **more: Any) -> Iterator[Publisher]:
    publisher = Publisher(Broker("127.0.0.1", port, tls=False, prefix="site/1", **more), look, said.append)
    publisher.start()
    try:
        yield publisher
    finally:
        publisher.close()


@pytest.mark.heavy
def test_states_and_results_are_published_as_they_change(service):
    heard, said = Heard(), []
    with publishing(heard.port, service.web.broker_messages, said):
        wait_for("the state", lambda: "site/1/rigs/a/state" in heard.last())
        assert heard.last()["site/1/status"] == "online"
        assert json.loads(heard.last()["site/1/rigs/a/state"]) == {
            "rig": "a", "name": "Rig a", "state": "free", "simulated": True, "holder": None, "blocked_by": None,
            "run": None}
        assert json.loads(heard.last()["site/1/rigs/broken/state"])["state"] == "unusable"
        run = service.supervisor.start_run("a", {"note": "hold"}, "test").request.id
        wait_for("motion", lambda: '"moving"' in heard.last()["site/1/rigs/a/state"])
        moving = json.loads(heard.last()["site/1/rigs/a/state"])
        assert (moving["state"], moving["run"]["id"], moving["run"]["stage"]) == ("busy", run, "setup")
        service.supervisor.stop(run, "test")
        done = service.supervisor.start_run("b", {}, "test").request.id
        wait_for("the result", lambda: "site/1/rigs/b/result" in heard.last())
        wait_for("rest", lambda: '"free"' in heard.last()["site/1/rigs/a/state"])
        told = json.loads(heard.last()["site/1/rigs/b/result"])
        assert (told["id"], told["inertia_kg_m2"], told["low_kg_m2"], told["simulated"]) == (done, 104.0, 100.0, True)
        assert "site/1/rigs/a/result" not in heard.last()
    wait_for("goodbye", lambda: heard.last()["site/1/status"] == "offline")
    wait_for("the end", lambda: heard.packets[-1][0] == DISCONNECT)
    assert {kind for kind, *_ in heard.packets} == {CONNECT, PUBLISH, DISCONNECT}          # nothing is subscribed to
    (connect,) = [body for kind, _, body in heard.packets if kind == CONNECT]
    assert connect[7] & 0b0011_1100 == 0b0010_1100         # a last will: QoS 1, retained
    assert b"site/1/status\x00\x07offline" in connect
    same = [one for one in heard.published() if one[0].endswith("never/state")]
    assert len(same) == 1                                  # sent once, while it does not change
    heard.close()


def test_a_missing_broker_delays_nothing_and_receives_everything_later():
    taken = socket.socket()
    taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    taken.bind(("127.0.0.1", 0))           # a reserved port without a server
    port = taken.getsockname()[1]
    said: list[str] = []
    state = {"rigs/a/state": {"is": 1}, "rigs/b/state": {"is": 1}}
    with publishing(port, lambda: dict(state), said) as publisher:
        wait_for("the complaint", lambda: "can't be reached" in str(said))
        heard = Heard(at=taken)
        wait_for("all", lambda: len(heard.last()) == 3)
        state["rigs/a/state"] = {"is": 2}
        wait_for("the change", lambda: heard.last()["site/1/rigs/a/state"] == '{"is": 2}')
        del state["rigs/b/state"]
        wait_for("what is gone", lambda: heard.last()["site/1/rigs/b/state"] == "")
        heard.close()
        wait_for("that it is away", lambda: not publisher._connected.is_set())
        state["rigs/a/state"] = {"is": 3}
        again = Heard(port)
        wait_for("all again", lambda: again.last().get("site/1/rigs/a/state") == '{"is": 3}')
        again.close()
    assert [one for one in said if "tries again" in one] == [one for one in said if "are sent to" not in one]


def test_a_failed_read_is_reported_once_and_published_later():
    heard, said, looks = Heard(), [], []

    def look() -> dict[str, Any]:
        looks.append(1)
        if len(looks) < 5:
            raise ValueError("no such disk")
        return {"rigs/a/state": {}}

    with publishing(heard.port, look, said):
        wait_for("the state", lambda: "site/1/rigs/a/state" in heard.last())
    assert [one for one in said if "disk" in one] == ["MQTT: ValueError: no such disk"]
    heard.close()


def test_the_end_without_a_broker_does_not_wait():
    silent = socket.create_server(("127.0.0.1", 0))        # accepts connections without a reply
    for port in (silent.getsockname()[1], 1):
        with publishing(port, dict, []) as publisher:
            begun_s = time.monotonic()
        assert not publisher._connected.is_set()
        assert time.monotonic() - begun_s < HANGS_S / 2
    silent.close()


def test_a_password_comes_from_a_file_and_is_shown_nowhere(tmp_path):
    (tmp_path / "secret").write_text("h4rd to guess\n")
    heard, said = Heard(), []
    broker = Broker.of(f"mqtt://rig%20room@127.0.0.1:{heard.port}/site/1",
                       {"TDHIL_MQTT_PASSWORD_FILE": str(tmp_path / "secret")})
    assert (broker.user, broker.password) == ("rig room", "h4rd to guess")
    publisher = Publisher(broker, dict, said.append)
    publisher.start()
    wait_for("the status", lambda: "site/1/status" in heard.last())
    publisher.close()
    assert heard.packets[0][2].endswith(b"\x00\x08rig room\x00\x0dh4rd to guess")
    assert "h4rd" not in repr(broker) + str(broker) + str(said)
    assert "unencrypted" in said[0]
    heard.close()


def test_the_certificate_of_a_broker_is_checked_before_any_message(tls, tmp_path):
    """A broker with an untrusted certificate receives nothing, in particular no password."""
    cert, key = tls
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(cert, key)
    heard, said = Heard(tls=context), []
    given = {"TDHIL_MQTT_USER": "u", "TDHIL_MQTT_PASSWORD": "p"}
    doubted = Publisher(Broker.of(f"mqtts://127.0.0.1:{heard.port}", given), dict, said.append)
    doubted.start()
    wait_for("the complaint", lambda: said)
    doubted.close()
    assert "its certificate isn't trusted; tdhil tries again" in said[0]
    assert heard.packets == []
    trusted = Publisher(Broker.of(f"mqtts://127.0.0.1:{heard.port}", given | {"TDHIL_MQTT_CA_FILE": str(cert)}), dict,
                        said.append)
    trusted.start()
    wait_for("the status", lambda: heard.last().get("tdhil/status") == "online")
    trusted.close()
    assert "unencrypted" not in str(said)
    heard.close()


@pytest.mark.parametrize(("url", "words"), [
    ("mqtt://user:s3cret@host", "must not be on the command line"),
    ("http://host", "must be mqtt"),
    ("mqtt://", "must be mqtt"),
    ("mqtt://host/a?b", "must be mqtt"),
    ("mqtt://host:99999", "is not a valid address"),
    ("mqtt://[::1", "is not a valid address"),
    ("mqtt://host/a/+", "a prefix must not contain"),
    ("mqtt://host/$SYS", "a prefix must not contain"),
    ("mqtt://host/a//b", "a prefix must not contain"),
])
def test_an_address_that_is_none_is_refused_before_anything_begins(url, words, capsys, tmp_path):
    assert main(["serve", "--mqtt", url, "--data", str(tmp_path / "data")]) == ExitCode.USAGE
    said = capsys.readouterr().err
    assert words in said
    assert "s3cret" not in said
    assert not (tmp_path / "data").exists()


def test_addresses_and_their_options():
    assert str(Broker.of("mqtts://broker.example", {})) == "mqtts://broker.example:8883/tdhil"
    assert Broker.of("mqtt://[::1]/a/b/", {"TDHIL_MQTT_USER": "u", "TDHIL_MQTT_PASSWORD": "p"}) == Broker(
        "::1", 1883, False, "a/b", "u", "p")
    with pytest.raises(UsageError, match="TDHIL_MQTT_PASSWORD_FILE"):
        Broker.of("mqtt://host", {"TDHIL_MQTT_PASSWORD_FILE": "/no/such/file"})
    with pytest.raises(UsageError, match="TDHIL_MQTT_CA_FILE"):
        Publisher(Broker.of("mqtts://host", {"TDHIL_MQTT_CA_FILE": "/no/such/file"}), dict)


def viewing(port: int) -> tuple[dict[str, tuple[str, bool, int]], Client]:
    """Return the last text, retain flag and QoS of each topic, as a new client receives them, and the client."""
    from paho.mqtt.enums import CallbackAPIVersion

    kept: dict[str, tuple[str, bool, int]] = {}
    viewer = Client(CallbackAPIVersion.VERSION2)
    viewer.on_message = lambda client, data, message: kept.__setitem__(
        message.topic, (message.payload.decode(), message.retain, message.qos))
    viewer.on_connect = lambda client, data, flags, reason, properties: client.subscribe("site/#", 1)
    viewer.connect("127.0.0.1", port)
    viewer.loop_start()
    return kept, viewer


@pytest.mark.heavy
@pytest.mark.skipif(shutil.which("mosquitto") is None, reason="mosquitto is not installed (apt-get install mosquitto)")
def test_a_real_broker_keeps_it_for_later_subscribers(service, tmp_path):
    """With mosquitto, a later subscriber gets the latest message, and after a kill the last will."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    (tmp_path / "m.conf").write_text(f"listener {port} 127.0.0.1\nallow_anonymous true\npersistence false\n")
    broker = subprocess.Popen(["mosquitto", "-c", str(tmp_path / "m.conf")], stderr=subprocess.DEVNULL)
    try:
        said: list[str] = []
        with publishing(port, service.web.broker_messages, said) as publisher:
            run = service.supervisor.start_run("a", {}, "test").request.id
            service.wait(run, "done")
            wait_for("the result", lambda: "rigs/a/result" in publisher._published)
            early, first = viewing(port)          # the broker may receive the result later than recorded
            wait_for("the broker's copy", lambda: "site/1/rigs/a/result" in early)
            first.loop_stop()
            kept, viewer = viewing(port)
            wait_for("what is kept", lambda: "site/1/rigs/a/result" in kept and "site/1/status" in kept)
            assert kept["site/1/status"] == ("online", True, 1)
            text, retained, qos = kept["site/1/rigs/a/result"]
            assert (json.loads(text)["id"], retained, qos) == (run, True, 1)
            publisher._client._sock_close()                # as if the service had been killed
            wait_for("the last will", lambda: kept["site/1/status"][0] == "offline")
            wait_for("that it is back", lambda: kept["site/1/status"][0] == "online")
        wait_for("goodbye", lambda: kept["site/1/status"][0] == "offline")
        viewer.loop_stop()
    finally:
        broker.kill()
        broker.wait()
