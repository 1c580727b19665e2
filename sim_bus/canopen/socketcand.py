"""A small socketcand server: a CAN bus over TCP, where the kernel has none.

python-can's stock ``socketcand`` client talks to it (``tcp_tune=True`` on the client's side, otherwise Nagle and
delayed acknowledgement leave 22 cycles a second). A frame goes to all other clients and local ports, never back.

No thread of its own: whoever needs the bus calls `poll`, which moves frames for as long as it waits; a simulator
does so through a `HubPort`. Bytes that a client doesn't fetch are kept up to a limit, then the client is dropped.
"""

import contextlib
import selectors
import socket
import time
from collections.abc import Callable

from sim_bus.socketcand import HI, LONGEST_WORD, OK, WireFrame, frame_word, parse_send, split

HOLD_S = 0.020
"""The client takes the ``< ok >`` of rawmode by itself: a frame glued to it would be an error to it."""
_MOST_PENDING_BYTES = 1 << 20
_BACKLOG = 16


class _Client:
    """One connection and what is under way on it."""

    def __init__(self, connection: socket.socket) -> None:
        self.socket = connection
        self.received = bytearray()
        self.pending = bytearray()
        self.raw = False
        self.hold_until_s = 0.0


class Hub:
    """The server. ``port`` 0 takes any free one; the one taken stands in ``port``."""

    def __init__(self, host: str = "127.0.0.1", port: int = 0, channel: str = "can0") -> None:
        self.host, self.channel = host, channel
        self._selector = selectors.DefaultSelector()
        self._clients: list[_Client] = []
        self._taps: list[Callable[[WireFrame], None]] = []
        self.all_gone = False
        """The last client has just left; whoever acts on it sets it back."""
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._listener = socket.socket(family, socket.SOCK_STREAM)
        try:
            self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._listener.bind((host, port))
            self._listener.listen(_BACKLOG)
        except OSError:
            self._listener.close()
            self._selector.close()
            raise
        self._listener.setblocking(False)
        self.port: int = self._listener.getsockname()[1]
        self._selector.register(self._listener, selectors.EVENT_READ)

    def tap(self, deliver: Callable[[WireFrame], None]) -> None:
        """Adds a local port, called in `poll` with every frame of a client."""
        self._taps.append(deliver)

    def send(self, frame: WireFrame) -> None:
        """A frame of a local port goes to all clients. (A remote frame has no word in this protocol.)"""
        self._spread(frame, None)

    def poll(self, timeout_s: float) -> None:
        """Waits up to ``timeout_s`` for something to happen on the sockets and deals with it."""
        held = [client.hold_until_s for client in self._clients if client.hold_until_s]
        if held:
            timeout_s = min(timeout_s, max(min(held) - time.monotonic(), 0.0))
        for key, events in self._selector.select(timeout_s):
            client = key.data
            if client is None:
                self._accept()
                continue
            if events & selectors.EVENT_READ:
                self._read(client)
            if events & selectors.EVENT_WRITE and client in self._clients:
                self._flush(client)
        if held:
            now_s = time.monotonic()
            for client in list(self._clients):
                if client.hold_until_s and now_s >= client.hold_until_s:
                    client.hold_until_s = 0.0
                    self._flush(client)

    def close(self) -> None:
        """Closes every connection."""
        for client in self._clients:
            client.socket.close()
        self._clients.clear()
        self._listener.close()
        self._selector.close()

    def _accept(self) -> None:
        try:
            connection, _ = self._listener.accept()
        except OSError:
            return
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client = _Client(connection)
        self._clients.append(client)
        self._selector.register(connection, selectors.EVENT_READ, client)
        self._tell(client, HI)

    def _read(self, client: _Client) -> None:
        try:
            data = client.socket.recv(65536)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._drop(client)
            return
        client.received += data
        for word in split(client.received):
            self._obey(client, word)
        if len(client.received) > LONGEST_WORD:
            self._drop(client)

    def _obey(self, client: _Client, word: str) -> None:
        if word.startswith("send ") and client.raw:
            frame = parse_send(word)
            if frame is not None:
                for deliver in self._taps:
                    deliver(frame)
                self._spread(frame, client)
        elif word == f"open {self.channel}":
            self._tell(client, OK)
        elif word == "rawmode":
            client.raw = True
            self._tell(client, OK)
            client.hold_until_s = time.monotonic() + HOLD_S
        elif word.startswith("open "):
            self._tell(client, b"< error could not open bus >")
        else:
            self._tell(client, b"< error unknown command >")

    def _spread(self, frame: WireFrame, sender: _Client | None) -> None:
        if frame.remote_length is not None:
            return
        word = b""
        for client in list(self._clients):
            if client is not sender and client.raw:
                word = word or frame_word(frame, time.time())
                self._tell(client, word)

    def _tell(self, client: _Client, word: bytes) -> None:
        busy = bool(client.pending) or client.hold_until_s
        client.pending += word
        if not busy:
            self._flush(client)
        elif len(client.pending) > _MOST_PENDING_BYTES:
            self._drop(client)

    def _flush(self, client: _Client) -> None:
        """Sends what the socket takes; the rest waits until it takes more."""
        if client.pending and not client.hold_until_s:
            try:
                sent = client.socket.send(client.pending)
            except BlockingIOError:
                sent = 0
            except OSError:
                self._drop(client)
                return
            del client.pending[:sent]
        wanted = selectors.EVENT_READ
        if client.pending and not client.hold_until_s:
            wanted |= selectors.EVENT_WRITE
        if self._selector.get_key(client.socket).events != wanted:
            self._selector.modify(client.socket, wanted, client)

    def _drop(self, client: _Client) -> None:
        if client not in self._clients:
            return
        self._clients.remove(client)
        with contextlib.suppress(KeyError, ValueError):
            self._selector.unregister(client.socket)
        client.socket.close()
        if client.raw and not any(other.raw for other in self._clients):
            self.all_gone = True
