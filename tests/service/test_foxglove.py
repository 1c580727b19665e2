"""Foxglove protocol: the bytes of the log for viewers of any speed, read only."""

from __future__ import annotations

import asyncio
import json
import socket
import struct
import threading
import time
from base64 import b64decode
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import uvicorn
from mcap.reader import make_reader
from starlette.testclient import TestClient, WebSocketDenialResponse
from starlette.websockets import WebSocketDisconnect
from websockets.sync.client import connect

from tdhil.recording import RunWriter, Stage
from tdhil.recording.log_format import Event
from tdhil.service import foxglove
from tdhil.service import web as web_module
from tdhil.service.foxglove import PROTOCOLS, Relay, Running
from tdhil.service.limits import API
from tdhil.service.server import _listen
from tdhil.service.web import Web
from tests.recording.test_log_tail import COMMAND, sample, write
from tests.service.conftest import HANGS_S, URL, Service, wait_for

SOCKETS = URL.replace("http", "ws")
Message = tuple[str, int, bytes]           # topic, log time in ns, payload


def logged(path: Path) -> list[Message]:
    """Return the messages by mcap's own reader, in the order of the file."""
    with path.open("rb") as file:
        return [(channel.topic, message.log_time, message.data)
                for _, channel, message in make_reader(file).iter_messages(log_time_order=False)]


def declared(path: Path) -> dict[str, tuple[str, bytes]]:
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    return {one.topic: (summary.schemas[one.schema_id].name, summary.schemas[one.schema_id].data)
            for one in summary.channels.values()}


def by_topic(messages: list[Message]) -> dict[str, list[tuple[int, bytes]]]:
    found: dict[str, list[tuple[int, bytes]]] = {}
    for topic, time_ns, payload in messages:
        found.setdefault(topic, []).append((time_ns, payload))
    return found


class Viewer:
    """Small client of the protocol: it decodes by the specification and shares no code with the relay."""

    def __init__(self, send: Callable[[str], Any]) -> None:
        self._send = send
        self.told: list[dict[str, Any]] = []
        self.channels: dict[int, dict[str, Any]] = {}
        self.topics: dict[int, str] = {}
        self.messages: list[Message] = []

    def subscribe(self, *topics: str) -> None:
        wanted = {one["id"]: one["topic"] for one in self.channels.values() if not topics or one["topic"] in topics}
        self.topics |= {1000 + channel: topic for channel, topic in wanted.items()}
        self._send(json.dumps({"op": "subscribe", "subscriptions": [
            {"id": 1000 + channel, "channelId": channel} for channel in wanted]}))

    def take(self, message: str | bytes) -> None:
        if isinstance(message, bytes):
            opcode, subscription, time_ns = struct.unpack_from("<BIQ", message)
            assert opcode == 1
            self.messages.append((self.topics[subscription], time_ns, message[13:]))
            return
        said = json.loads(message)
        self.told.append(said)
        if said["op"] == "advertise":
            self.channels = {one["id"]: one for one in said["channels"]}

    def statuses(self) -> list[str]:
        return [one["message"] for one in self.told if one["op"] == "status"]


@contextmanager
def listening(web: Web) -> Iterator[int]:
    """Yield the port of the web server on a socket, opened as by `tdhil serve`."""
    config = uvicorn.Config(web.asgi, log_level="error", ws="websockets-sansio", ws_max_size=4096)
    server, opened = uvicorn.Server(config), _listen("127.0.0.1", 0)
    thread = threading.Thread(target=server.run, args=([opened],), daemon=True)
    thread.start()
    try:
        wait_for("the server", lambda: server.started)
        yield opened.getsockname()[1]
    finally:
        server.should_exit = True
        thread.join(10.0)


def moving(service: Service, samples: int = 200) -> tuple[str, Path]:
    """Return a run with an existing log, and the log."""
    run = service.supervisor.start_run("a", {"note": "hold"}, "test").request.id
    service.wait(run, "moving")
    path = service.store.place(run) / "run.mcap"
    write(path.with_name("whole.mcap"), samples)
    path.with_name("whole.mcap").replace(path)
    return run, path


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_an_independent_client_receives_the_content_of_the_log(service, protocol):
    """`websockets` reads every message of a growing log over a real socket, byte for byte, with the log's schemas."""
    with listening(service.web) as port, connect(
            f"ws://127.0.0.1:{port}/foxglove/a", subprotocols=[protocol], open_timeout=HANGS_S) as peer:
        assert peer.subprotocol == protocol
        viewer = Viewer(peer.send)
        while not viewer.statuses():
            viewer.take(peer.recv(HANGS_S))
        assert viewer.told[0]["name"] == "tdhil, rig a SIMULATED"
        assert viewer.told[0]["capabilities"] == []
        viewer.subscribe()
        run, path = moving(service)
        wanted = logged(path)
        while len(viewer.messages) < len(wanted):
            viewer.take(peer.recv(HANGS_S))
        said = [one for one in viewer.told if one["op"] == "serverInfo"]
        assert said[-1]["sessionId"] == run
        assert said[-1]["name"] == "tdhil, rig a SIMULATED"
        assert said[-1]["metadata"]["simulated"] == "true"
    assert by_topic(viewer.messages) == by_topic(wanted)
    assert len(wanted) > 400
    assert {one["topic"]: (one["schemaName"], b64decode(one["schema"])) for one in viewer.channels.values()} == (
        declared(path))
    assert {(one["encoding"], one["schemaEncoding"]) for one in viewer.channels.values()} == {("protobuf", "protobuf")}


@pytest.mark.heavy
def test_a_slow_viewer_has_few_bytes_in_transit(service, monkeypatch):
    """A ping must not wait behind unread data, so that the connection of a slow viewer is not closed."""
    sent: list[int] = []

    def counted(*words: Any) -> Relay:
        relay = Relay(*words)
        send = relay.send_bytes

        async def count(data: bytes) -> None:
            await send(data)
            sent.append(len(data))

        relay.send_bytes = count
        return relay

    monkeypatch.setattr(web_module, "Relay", counted)
    _, path = moving(service, 5_000)
    total = sum(len(payload) for *_, payload in logged(path))
    with listening(service.web) as port, socket.create_connection(("127.0.0.1", port)) as raw:
        raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        raw.sendall(f"GET /foxglove/a HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
                    f"Sec-WebSocket-Key: {'A' * 22}==\r\nSec-WebSocket-Version: 13\r\n"
                    f"Sec-WebSocket-Protocol: {PROTOCOLS[0]}\r\n\r\n".encode())
        raw.recv(1)                                        # it has accepted
        wanted = json.dumps({"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 1},
                                                                  {"id": 2, "channelId": 2}]}).encode()
        raw.sendall(b"\x81" + bytes([0x80 | len(wanted)]) + bytes(4) + wanted)          # masked by zeros
        wait_for("something", lambda: sum(sent) > 1000)
        before = -1
        while len(sent) > before:
            before = len(sent)
            time.sleep(0.3)
        assert sum(sent) < 350_000 < total


# -- one relay, without a socket -------------------------------------------------------------------------------------


class Bench:
    """Relay with the test as the viewer. Messages are accepted at once, or each takes ``costs_s``."""

    def __init__(self, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(foxglove, "EVERY_S", 0.001)
        monkeypatch.setattr(foxglove, "LOOK_S", 0.0)
        self.now_s, self.costs_s = 0.0, 0.0
        self.running: Running | None = Running("one", path, False)
        self.relay = Relay("a", lambda: self.running, self._text, self._bytes, clock=lambda: self.now_s)
        self.said: list[str] = []
        self.viewer = Viewer(self.said.append)

    async def _text(self, text: str) -> None:
        self.viewer.take(text)

    async def _bytes(self, data: bytes) -> None:
        self.now_s += self.costs_s
        self.viewer.take(data)

    async def subscribe(self, *topics: str) -> None:
        self.viewer.subscribe(*topics)
        await self.relay.hear(self.said.pop())

    def play(self, what: Callable[[], Any]) -> None:
        async def played() -> None:
            telling = asyncio.create_task(self.relay.run())
            await self.until(lambda: self.viewer.channels)
            await asyncio.wait_for(what(), HANGS_S)
            telling.cancel()

        asyncio.run(played())

    @staticmethod
    async def until(happens: Callable[[], Any]) -> None:
        while not happens():
            await asyncio.sleep(0.001)


@pytest.fixture
def bench(tmp_path, monkeypatch):
    return Bench(tmp_path / "run.mcap", monkeypatch)


def test_a_late_subscriber_gets_it_from_its_start_and_once(bench, tmp_path):
    writer = RunWriter(tmp_path / "run.mcap", epoch_ns=10**18, block=True)

    def grow(first: int, last: int) -> None:
        for number in range(first, last):
            writer.command(0.01 * number, COMMAND)
            writer.sample(sample(number))
        writer.event(Event(0.01 * last, "plan", f"up to {last}"))
        writer.stage(Stage(f"up to {last}", 0.0, 0.01 * last, "ok"))

    async def played() -> None:
        grow(0, 100)
        await bench.subscribe("/sample")
        await bench.until(lambda: len(bench.viewer.messages) == 100)
        await bench.subscribe("/event", "/stage")
        await bench.until(lambda: len(bench.viewer.messages) == 102)
        await bench.until(lambda: len(bench.relay._readers) == 1)
        await bench.relay.hear(json.dumps({"op": "unsubscribe", "subscriptionIds": [1004]}))
        grow(100, 200)
        await bench.until(lambda: len(bench.viewer.messages) == 203)
        writer.close()
        await bench.until(lambda: "ended" in str(bench.viewer.statuses()))

    bench.play(played)
    found, wanted = by_topic(bench.viewer.messages), by_topic(logged(tmp_path / "run.mcap"))
    assert found["/sample"] == wanted["/sample"]
    assert found["/event"] == wanted["/event"]
    assert found["/stage"] == wanted["/stage"][:1]         # unsubscribed before the second
    assert sorted(found) == ["/event", "/sample", "/stage"]


def test_the_next_run_is_a_new_session(bench, tmp_path):
    write(tmp_path / "run.mcap")
    write(tmp_path / "two.mcap", 50)

    async def played() -> None:
        await bench.subscribe("/result", "/event")
        await bench.until(lambda: "ended" in str(bench.viewer.statuses()))
        bench.running = None
        first = len(bench.viewer.messages)
        bench.running = Running("two", tmp_path / "two.mcap", True)
        await bench.until(lambda: len(bench.viewer.messages) == 2 * first)

    bench.play(played)
    sessions = [one["sessionId"] for one in bench.viewer.told if one["op"] == "serverInfo"]
    assert sessions == ["one", "two"]
    assert [topic for topic, *_ in bench.viewer.messages] == ["/event", "/result"] * 2


def test_a_rehearsal_is_marked_in_the_name_and_in_the_metadata(bench, tmp_path):
    write(tmp_path / "run.mcap")
    bench.running = Running("one", tmp_path / "run.mcap", True, True)

    async def played() -> None:
        bench.running = Running("two", tmp_path / "run.mcap", True)
        await bench.until(lambda: len([one for one in bench.viewer.told if one["op"] == "serverInfo"]) == 2)

    bench.play(played)
    first, second = [one for one in bench.viewer.told if one["op"] == "serverInfo"]
    assert (first["name"], first["metadata"]["rehearsal"]) == ("tdhil, rig a SIMULATED FAULT REHEARSAL", "true")
    assert (second["name"], second["metadata"]["rehearsal"]) == ("tdhil, rig a SIMULATED", "false")


def test_a_dead_run_is_closed(bench, tmp_path):
    write(tmp_path / "whole.mcap")
    data = (tmp_path / "whole.mcap").read_bytes()
    (tmp_path / "run.mcap").write_bytes(data[:-1000])

    async def played() -> None:
        await bench.subscribe()
        await bench.until(lambda: bench.viewer.messages)
        bench.running = None
        await bench.until(lambda: "ended" in str(bench.viewer.statuses()))

    bench.play(played)


def test_a_viewer_that_is_too_slow_loses_messages_of_every_cycle_and_a_status_reports_it(bench, tmp_path):
    """Each message takes 1 s: first a minute of earlier data, then stages, events and results only."""
    write(tmp_path / "run.mcap")

    async def played() -> None:
        bench.costs_s = 1.0
        await bench.subscribe()
        await bench.until(lambda: "too slow" in str(bench.viewer.statuses()))

    bench.play(played)
    found, wanted = by_topic(bench.viewer.messages), by_topic(logged(tmp_path / "run.mcap"))
    for topic in ("/stage", "/event", "/configuration", "/result", "/log"):
        assert found[topic] == wanted[topic]
    missing = sum(len(wanted[topic]) - len(found[topic]) for topic in ("/sample", "/command"))
    assert missing > 100
    (told,) = [one for one in bench.viewer.statuses() if "too slow" in one]
    assert told == f"viewer too slow: {missing} messages of every cycle left out"


@pytest.mark.parametrize(("said", "answer"), [
    ('{"op": "advertise", "channels": []}', "advertise: this connection is read only"),
    ('{"op": "setParameters", "parameters": []}', "this connection is read only"),
    (b"\x01\0\0\0\0nonsense", "this connection is read only"),
    ('{"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 99}]}', "channel 99 does not exist"),
    ('{"op": "subscribe", "subscriptions": [{"id": 5000000000, "channelId": 1}]}', "does not exist"),
    ('{"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 1}, {"id": 2, "channelId": 1}]}', "already"),
    ('{"op": "subscribe"}', "not a message of the protocol"),
    ("[]", "not a message of the protocol"),
    ("7", "not a message of the protocol"),
    ("[" * 4000, "not a message of the protocol"),
    ("<script>", "not a message of the protocol"),
])
def test_a_viewer_can_only_read(bench, said, answer):
    bench.running = None

    async def played() -> None:
        await bench.relay.hear(said)

    bench.play(played)
    assert answer in bench.viewer.statuses()[-1]


# -- access -----------------------------------------------------------------------------------------------------


def test_an_unknown_rig_and_an_unknown_protocol_are_refused(service):
    with TestClient(service.web.asgi, base_url=URL) as client:
        for path, protocols, code in (("/foxglove/none", PROTOCOLS[:1], 404), ("/foxglove/a", ["foxglove.v9"], 400),
                                      (f"{API}/foxglove/a", [], 400)):
            with pytest.raises(WebSocketDenialResponse) as refused, client.websocket_connect(
                    f"{SOCKETS}{path}", subprotocols=protocols):
                pass
            assert refused.value.status_code == code
            assert code == 404 or PROTOCOLS[0] in refused.value.json()["error"]["next_step"]
        for rig, simulated in (("real", ""), ("a", " SIMULATED")):
            address = f"{SOCKETS}{API}/foxglove/{rig}"
            with client.websocket_connect(address, subprotocols=list(PROTOCOLS)[::-1]) as socket:
                assert socket.receive_json()["name"] == f"tdhil, rig {rig}{simulated}"
        with client.websocket_connect(f"{SOCKETS}{API}/foxglove/a", subprotocols=list(PROTOCOLS)[::-1]) as socket:
            assert socket.receive_json()["op"] == "serverInfo"
            assert "tdhil_foxglove_viewers 1.0" in client.get("/metrics").text


def test_a_viewer_in_a_browser_reads_where_its_origin_is_named_and_does_nothing_else(service):
    origin = {"origin": "http://localhost:8080", "sec-fetch-site": "cross-site"}
    web = Web(service.supervisor, viewers=frozenset({origin["origin"]}))
    for asgi, path, may in ((web.asgi, "/foxglove/a", True), (service.web.asgi, "/foxglove/a", False),
                            (web.asgi, "/live/20260101-000000-aaaaaa", False)):
        client = TestClient(asgi, base_url=URL, headers=origin)
        if may:
            with client.websocket_connect(f"{SOCKETS}{path}", subprotocols=list(PROTOCOLS)) as socket:
                assert socket.receive_json()["op"] == "serverInfo"
        else:
            with pytest.raises(WebSocketDisconnect) as refused, client.websocket_connect(
                    f"{SOCKETS}{path}", subprotocols=list(PROTOCOLS)):
                pass
            assert refused.value.code == 4403
    assert TestClient(web.asgi, base_url=URL, headers=origin).post(f"{API}/rigs/a/runs", json={}).status_code == 403
