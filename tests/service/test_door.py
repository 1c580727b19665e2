"""Limits of connections: idle ones are limited and closed, and a request is always accepted. Small limits, loopback."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import resource
import socket
import ssl
import subprocess
import sys
import threading
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest
import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route

from tdhil.service import door as door_module
from tdhil.service.door import HEADERS_S, Door, Room, Seldom, raise_limit
from tdhil.service.server import Tls, _listen
from tests.service.conftest import HANGS_S, wait_for

ROOM = Room(waiting=8, waiting_of_one=4, served=6, served_of_one=3)
HEADER = b"POST /stop HTTP/1.1\r\nHost: rig\r\nContent-Length: 0\r\n"


async def answer(request: Request) -> Response:
    await request.body()
    return PlainTextResponse("stopped")


async def upload(request: Request) -> Response:
    request.scope[door_module.ADMITTED] = True
    return await answer(request)


class Served:
    """Door before a small application, in a thread, with the clock of the test."""

    def __init__(self, room: Room = ROOM, tls: ssl.SSLContext | None = None) -> None:
        self.time_s = 0.0
        self.said: list[str] = []
        self.listening = _listen("127.0.0.1", 0)
        self.address = self.listening.getsockname()
        self.door = Door(self.listening, room, self.said.append, tls=tls, clock=lambda: self.time_s)
        self._ready, self._end = threading.Event(), threading.Event()
        self._clients = contextlib.ExitStack()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve()), daemon=True)
        self._thread.start()
        assert self._ready.wait(HANGS_S)

    async def _serve(self) -> None:
        routes = [Route("/stop", answer, methods=["POST"]), Route("/stop", answer),
                  Route("/upload", upload, methods=["POST"])]
        config = uvicorn.Config(Starlette(routes=routes), http="h11", ws="none", lifespan="off", log_level="critical")
        config.load()
        state = uvicorn.server.ServerState()
        self.door.open(lambda: config.http_protocol_class(config=config, server_state=state, app_state={}))
        self._ready.set()
        while not self._end.is_set():
            await asyncio.sleep(0.01)
        self.door.close()
        for one in tuple(state.connections):
            one.transport.abort()
        await asyncio.sleep(0.05)

    def connect(self, host: str = "127.0.0.1", sent: bytes = b"") -> socket.socket:
        """Connect a client from an address of the loopback."""
        found = self._clients.enter_context(socket.create_connection(self.address, HANGS_S, (host, 0)))
        found.sendall(sent)
        return found

    def close(self) -> None:
        self._clients.close()
        self._end.set()
        self._thread.join(HANGS_S)
        self.listening.close()


@pytest.fixture
def served() -> Iterator[Served]:
    found = Served()
    yield found
    found.close()


def stops(client: socket.socket) -> bool:
    """Return whether a whole request gets its reply."""
    client.sendall(HEADER + b"Connection: close\r\n\r\n")
    return b"stopped" in whole(client)


def answered(client: socket.socket) -> bool:
    """Return one reply of a connection that stays open."""
    found = b""
    while not found.endswith(b"stopped") and (piece := client.recv(4096)):
        found += piece
    return found.startswith(b"HTTP/1.1 200")


def whole(client: socket.socket) -> bytes:
    found = b""
    with contextlib.suppress(ConnectionError):
        while piece := client.recv(4096):
            found += piece
    return found


def is_closed(client: socket.socket) -> bool:
    client.setblocking(False)
    try:
        return client.recv(1) == b""
    except BlockingIOError:
        return False
    except ConnectionError:
        return True
    finally:
        client.settimeout(HANGS_S)


def test_requests_in_parts_or_in_sequence_get_their_replies(served):
    client = served.connect(sent=HEADER[:20])
    wait_for("the piece", lambda: served.door.waiting == 1)
    client.sendall(HEADER[20:] + b"\r\n")
    assert answered(client)
    client.sendall(HEADER + b"\r\n")                  # the same connection again
    assert answered(client)
    assert (served.door.waiting, served.door.served, served.said) == (0, 1, [])


def test_a_reply_does_not_wait_for_the_client_to_acknowledge_its_header(served):
    """Nagle's algorithm would hold back the body until then: the delayed acknowledgement of a client takes 40 ms."""
    assert answered(served.connect(sent=HEADER + b"\r\n"))
    (one,) = served.door._served
    assert one.transport.get_extra_info("socket").getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)


@pytest.mark.parametrize("sent", [b"", HEADER])
def test_idle_connections_of_one_address_close_its_oldest_and_lock_no_client_out(served, sent):
    other = served.connect("127.0.0.2")
    idle = [served.connect("127.0.0.3", sent) for _ in range(20)]
    wait_for("all of them", lambda: sum(map(is_closed, idle)) == 16)
    assert [is_closed(one) for one in idle] == [True] * 16 + [False] * 4
    assert served.door.waiting == ROOM.waiting_of_one + 1
    assert stops(served.connect("127.0.0.3"))
    assert stops(other)
    assert "connections of 127.0.0.3 wait for a header, which is the limit for one address" in served.said[0]
    assert len(served.said) == 1                      # not one for each


def test_idle_connections_of_many_addresses_close_the_oldest_of_all(served):
    idle = [served.connect(f"127.0.0.{3 + number}") for number in range(20)]
    wait_for("all of them", lambda: sum(map(is_closed, idle)) == 12)
    assert [is_closed(one) for one in idle] == [True] * 12 + [False] * 8
    assert stops(served.connect("127.0.0.99"))
    assert "connections wait for a header, which is the limit." in served.said[0]


@pytest.mark.parametrize("sent", [b"", HEADER[:30]])
def test_a_header_that_is_not_completed_in_time_ends_its_connection(served, sent):
    slow = served.connect(sent=sent)
    wait_for("it", lambda: served.door.waiting == 1)
    served.time_s = HEADERS_S - 0.1
    early = served.connect()
    wait_for("the other", lambda: served.door.waiting == 2)
    assert not is_closed(slow)
    served.time_s = HEADERS_S
    wait_for("its end", lambda: is_closed(slow))
    assert not is_closed(early)


@pytest.mark.parametrize("sent", [b"", HEADER[:30]])
def test_a_client_that_goes_before_its_header_is_complete_leaves_nothing(served, sent):
    """Its place is free at once, before its time-out: the clock does not advance."""
    client = served.connect(sent=sent)
    wait_for("it", lambda: served.door.waiting == 1)
    client.close()
    wait_for("its end", lambda: served.door.waiting == 0, 30.0)


def test_a_body_that_is_not_completed_in_time_ends_its_connection(served):
    slow = served.connect(sent=HEADER.replace(b"Length: 0", b"Length: 9") + b"\r\nhalf")
    wait_for("it", lambda: served.door.served == 1)
    served.time_s = 1.0
    assert not is_closed(slow)
    served.time_s = 1.0 + HEADERS_S
    wait_for("its end", lambda: is_closed(slow))
    wait_for("its place", lambda: served.door.served == 0)


def test_an_accepted_upload_may_take_longer_and_is_closed_only_if_connections_are_needed(served):
    slow = served.connect(sent=HEADER.replace(b"/stop", b"/upload").replace(b"Length: 0", b"Length: 9") + b"\r\nhalf")
    wait_for("it", lambda: any(one.rank == 1 for one in served.door._served))
    served.time_s = 10.0 * HEADERS_S
    assert stops(served.connect())
    assert not is_closed(slow)
    slow.sendall(b"whole")
    assert answered(slow)


def test_connections_that_were_served_make_room_the_oldest_idle_one_first(served):
    kept = [served.connect("127.0.0.3", HEADER + b"\r\n") for _ in range(ROOM.served_of_one)]
    for one in kept:
        assert answered(one)
    assert stops(served.connect("127.0.0.3"))
    assert [is_closed(one) for one in kept] == [True, False, False]
    assert "of 127.0.0.3 are open, which is the limit for one address" in served.said[0]
    served.time_s = 2.0
    more = [served.connect(f"127.0.0.{10 + number}", HEADER + b"\r\n") for number in range(ROOM.served)]
    for one in more:
        assert answered(one)
    assert [is_closed(one) for one in kept] == [True, True, True]
    assert "connections are open, which is the limit." in served.said[1]


def at_the_server(method: str, complete: bool, more_body: bool = False) -> Any:
    """Return a connection that the HTTP server has, of the address x."""
    protocol = SimpleNamespace(
        cycle=SimpleNamespace(response_complete=complete, more_body=more_body), scope={"method": method})
    found = door_module._Served(socket.socket(), "x", protocol, None)
    found.transport = SimpleNamespace(get_protocol=lambda: protocol, abort=found.peer.close)
    return found


def test_lost_connections_are_closed_before_open_ones_and_no_longer_count(served):
    door, gone, idle = served.door, at_the_server("GET", True), at_the_server("GET", True)
    gone.peer.close()
    among = door._served_of["x"] = dict.fromkeys([idle, gone])
    assert not door._close_one(dict(among))
    assert list(among) == [idle] and not idle.gone
    assert door._close_one(dict(among)) and idle.gone
    assert "x" not in door._served_of
    assert door._close_one({}) is False                # the client is gone


def test_a_door_that_was_never_opened_can_be_closed():
    with socket.socket() as listening:
        Door(listening, ROOM, print).close()


def test_idle_connections_are_closed_before_served_ones_and_changes_last(served):
    web_socket = at_the_server("GET", False)
    web_socket.transport.get_protocol = lambda: None
    change, load, idle = (at_the_server(*one) for one in (("POST", False), ("GET", False), ("GET", True)))
    half, new = at_the_server("POST", False, True), at_the_server("GET", False)
    new.protocol.cycle = None
    among = dict.fromkeys([change, web_socket, load, idle, half, new])
    closed = []
    while among:
        before = list(among)
        served.door._close_one(among)
        closed += [one for one in before if one.gone]
        for gone in closed:
            among.pop(gone, None)
    assert closed == [idle, half, new, web_socket, load, change]


def test_a_process_without_descriptors_closes_an_idle_connection_and_reports_it_once_per_second(served, monkeypatch):
    idle = served.connect("127.0.0.3")
    wait_for("it", lambda: served.door.waiting == 1)
    none_left = threading.Event()

    class Listening:
        def __init__(self, real: socket.socket) -> None:
            self._real = real

        def accept(self) -> Any:
            if none_left.is_set():
                raise OSError(errno.EMFILE, "Too many open files")
            return self._real.accept()

        def fileno(self) -> int:
            return self._real.fileno()

    none_left.set()
    monkeypatch.setattr(served.door, "_listening", Listening(served.listening))
    client = served.connect("127.0.0.4")
    wait_for("room", lambda: is_closed(idle))
    wait_for("a second try", lambda: served.door._complain._left_out > 0)
    assert len(served.said) == 1
    assert "Too many open files" in served.said[0]
    assert "Traceback" not in served.said[0]
    none_left.clear()
    assert stops(client)


def test_a_line_comes_once_a_second_with_the_number_of_those_left_out():
    said: list[str] = []
    times = iter([0.0, 0.1, 0.9, 1.0, 2.5])
    seldom = Seldom(said.append, lambda: next(times))
    for number in range(5):
        seldom(str(number))
    assert said == ["0", "3 (2 more such lines were left out)", "4"]


def test_over_tls_a_request_is_accepted_and_incomplete_connections_are_closed(tls):
    served = Served(tls=Tls(*tls).context())
    trusts = ssl.create_default_context(cafile=str(tls[0]))
    try:
        silent, half = served.connect("127.0.0.2"), served.connect("127.0.0.3", b"\x16\x03")
        plain = trusts.wrap_socket(served.connect("127.0.0.4"), server_hostname="127.0.0.1")
        wait_for("them", lambda: (served.door.waiting, served.door.served) == (1, 2))
        with trusts.wrap_socket(served.connect("127.0.0.5"), server_hostname="127.0.0.1") as client:
            assert stops(client)
        served.time_s = HEADERS_S - 0.1
        assert not any(map(is_closed, (silent, half)))
        served.time_s = HEADERS_S
        wait_for("their end", lambda: is_closed(silent) and is_closed(half))
        assert whole(plain) == b""
        wait_for("room", lambda: (served.door.waiting, served.door.served) == (0, 0))
        garbage = served.connect("127.0.0.6", b"GET / HTTP/1.1\r\n\r\n")
        whole(garbage)
        wait_for("room", lambda: served.door.served == 0)
    finally:
        served.close()


def test_half_of_the_descriptors_stay_free_of_connections():
    room = Room.of(1024)
    assert room.waiting + room.served <= 512
    assert room.waiting_of_one < room.waiting
    assert room.served_of_one < room.served
    assert Room.of(10**6) == Room.of(65536)


def test_the_limit_of_open_files_is_raised_as_far_as_the_system_grants_it():
    program = ("import resource; resource.setrlimit(resource.RLIMIT_NOFILE, (256, 512));"
               "from tdhil.service.door import raise_limit; print(raise_limit());"
               "print(resource.getrlimit(resource.RLIMIT_NOFILE)[0])")
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert found.stdout.split() == ["512", "512"]
    assert raise_limit() <= resource.getrlimit(resource.RLIMIT_NOFILE)[1]
