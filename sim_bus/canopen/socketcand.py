"""A small socketcand server: a CAN bus over TCP, for computers whose kernel has none.

python-can's ``socketcand`` client connects to it (with ``tcp_tune=True``; otherwise Nagle and delayed acknowledgement
limit the bus to 22 cycles a second). A frame goes to all other clients and local ports, never back.

It has no thread: the user of the bus calls `poll`, which moves frames while it waits. A simulator uses a `HubPort`.
Bytes that a client does not read are kept up to a limit; then the client is disconnected.
"""

import contextlib
import selectors
import socket
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import can

# ---------------------------------------------------------------------------------------------------------------------
# Words of socketcand's raw mode, as python-can's client uses them. Pure.
#
# ::
#
#     server → client   < hi >                               on connection
#     client → server   < open can0 >                        → < ok >
#     client → server   < rawmode >                          → < ok >
#     client → server   < send 123 2 a 1f >                  identifier (3 or 8 digits), length, bytes; hex
#     server → client   < frame 123 1700000000.123456 0A1F > bytes without blanks; none at all: two blanks before >
#
# python-can's client sends a length without bytes for a remote frame.


HI = b"< hi >"
OK = b"< ok >"
LONGEST_WORD = 512
"""Longest text without a ``>``, bytes. A client that sends more is not a socketcand client."""


@dataclass(frozen=True, slots=True)
class WireFrame:
    """A frame in the hub."""

    can_id: int
    extended: bool
    data: bytes
    remote_length: int | None = None


def split(buffer: bytearray) -> list[str]:
    """Take the complete words ``< … >`` off the front of ``buffer``. Return their contents."""
    end = buffer.rfind(b">")
    if end < 0:
        return []
    text = buffer[: end + 1].decode("ascii", "replace")
    del buffer[: end + 1]
    return [word.split("<", 1)[-1].strip() for word in text.split(">")[:-1]]


def parse_send(word: str) -> WireFrame | None:
    """Return the frame in ``send …``; None if the word contains no frame."""
    parts = word.split()
    try:
        can_id, length = int(parts[1], 16), int(parts[2], 16)
        data = bytes(int(part, 16) for part in parts[3:])
    except (IndexError, ValueError):
        return None
    extended = len(parts[1]) > 3
    if not 0 <= length <= 8 or not 0 <= can_id <= (0x1FFFFFFF if extended else 0x7FF):
        return None
    if not data and length:
        return WireFrame(can_id, extended, b"", length)
    return WireFrame(can_id, extended, data) if len(data) == length else None


def frame_word(frame: WireFrame, time_s: float) -> bytes:
    """Return the text of a frame for a client."""
    digits = f"{frame.can_id:08X}" if frame.extended else f"{frame.can_id:03X}"
    return f"< frame {digits} {time_s:.6f} {frame.data.hex().upper()} >".encode("ascii")


# ---------------------------------------------------------------------------------------------------------------------

HOLD_S = 0.020
"""Delay of frames after the ``< ok >`` of rawmode, s. The client expects the ``< ok >`` alone: an immediate frame would
cause an error."""
_MOST_PENDING_BYTES = 1 << 20
_BACKLOG = 16


class _SocketcandClient:
    """One connection with its buffers."""

    def __init__(self, connection: socket.socket) -> None:
        self.socket = connection
        self.received = bytearray()
        self.pending = bytearray()
        self.raw = False
        self.hold_until_s = 0.0


class Hub:
    """The server. ``port`` 0 selects any free port; the attribute ``port`` is the one in use."""

    def __init__(self, host: str = "127.0.0.1", port: int = 0, channel: str = "can0") -> None:
        self.host, self.channel = host, channel
        self._selector = selectors.DefaultSelector()
        self._clients: list[_SocketcandClient] = []
        self._taps: list[Callable[[WireFrame], None]] = []
        self.all_gone = False
        """True after the last client has left; the code that reacts to it resets it."""
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
        """Add a local port: ``deliver`` is called in `poll` with every frame of a client."""
        self._taps.append(deliver)

    def send(self, frame: WireFrame) -> None:
        """Send a frame of a local port to all clients. This protocol has no word for a remote frame."""
        self._spread(frame, None)

    def poll(self, timeout_s: float) -> None:
        """Wait up to ``timeout_s`` for an event on the sockets and handle it."""
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
        """Close every connection."""
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
        client = _SocketcandClient(connection)
        self._clients.append(client)
        self._selector.register(connection, selectors.EVENT_READ, client)
        self._tell(client, HI)

    def _read(self, client: _SocketcandClient) -> None:
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

    def _obey(self, client: _SocketcandClient, word: str) -> None:
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

    def _spread(self, frame: WireFrame, sender: _SocketcandClient | None) -> None:
        if frame.remote_length is not None:
            return
        word = b""
        for client in list(self._clients):
            if client is not sender and client.raw:
                word = word or frame_word(frame, time.time())
                self._tell(client, word)

    def _tell(self, client: _SocketcandClient, word: bytes) -> None:
        busy = bool(client.pending) or client.hold_until_s
        client.pending += word
        if not busy:
            self._flush(client)
        elif len(client.pending) > _MOST_PENDING_BYTES:
            self._drop(client)

    def _flush(self, client: _SocketcandClient) -> None:
        """Send as much as the socket accepts. The rest waits."""
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

    def _drop(self, client: _SocketcandClient) -> None:
        if client not in self._clients:
            return
        self._clients.remove(client)
        with contextlib.suppress(KeyError, ValueError):
            self._selector.unregister(client.socket)
        client.socket.close()
        if client.raw and not any(other.raw for other in self._clients):
            self.all_gone = True


# ---------------------------------------------------------------------------------------------------------------------
# A python-can bus that is a port of our own hub. Receiving runs the hub, so that no second thread is needed.


class HubPort(can.BusABC):
    """Local end of the bus. When the last client leaves, `recv` raises `can.CanOperationError` once: the
    bus has ended.
    """

    def __init__(self, hub: Hub) -> None:
        self._hub = hub
        self._queue: deque[can.Message] = deque()
        hub.tap(self._deliver)
        self.channel_info = f"hub {hub.host}:{hub.port}"
        super().__init__(channel=hub.channel)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame to all clients. Data that a client does not accept at once waits in the hub."""
        if not (msg.is_remote_frame or msg.is_error_frame):
            self._hub.send(WireFrame(msg.arbitration_id, msg.is_extended_id, bytes(msg.data)))

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        queue = self._queue
        if not queue:
            self._hub.poll(1.0 if timeout is None else timeout)
            if not queue and self._hub.all_gone:
                self._hub.all_gone = False
                raise can.CanOperationError("the last client has left")
        return (queue.popleft(), True) if queue else (None, True)

    def _deliver(self, frame: WireFrame) -> None:
        self._queue.append(can.Message(
            timestamp=time.time(), arbitration_id=frame.can_id, is_extended_id=frame.extended, data=frame.data,
            is_remote_frame=frame.remote_length is not None, dlc=frame.remote_length,
        ))

    def shutdown(self) -> None:
        """End the hub too."""
        super().shutdown()
        self._hub.close()
