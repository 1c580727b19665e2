"""Admission of connections: accept them, limit their number, and always accept one more.

An idle connection needs one descriptor and a few hundred bytes here. It is passed to the HTTP server with its first
complete header (plain HTTP), or with its first byte (TLS). So thousands of idle connections do not block a Stop:

* Waiting connections and served connections have a limit each, for one address and for all addresses.
* If a limit is reached, the oldest idle connection is closed, and the new one is accepted.
* A header, or the rest of a request, takes at most `HEADERS_S`. The handler of an upload admits its connection, and
  limits its time itself, by the received bytes.
* Half of the process's descriptors stay free of connections: a Stop needs some for sockets and files of its own.
"""

from __future__ import annotations

import asyncio
import errno
import selectors
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    import ssl

HEADERS_S: Final = 10.0
"""Longest time for a header, a TLS handshake, and the rest of a request, s. A slow radio link takes 1 s."""
LOOK_S: Final = 0.5
"""Interval between two checks for connections that have taken too long, s."""
AT_ONCE: Final = 64
"""Connections accepted in one turn of the event loop: about 5 ms of work. Then other work continues."""
BACKLOG: Final = 4096
"""Connections that the kernel queues for acceptance. With fewer, a burst makes a Stop wait 1 s for TCP."""
HEADER_LIMIT: Final = 32 * 1024
"""Largest header, bytes; the HTTP server has the same limit."""
MOST_DESCRIPTORS: Final = 65_536
"""Largest number of descriptors to use, even if the system grants more."""
MOST: Final = 4096
"""Largest number of connections of each kind, for any number of descriptors."""
ADMITTED: Final = "tdhil.admitted"
"""Key in the ASGI scope of a request whose handler limits the time of its body itself."""
PAUSE_S: Final = 0.05
"""Pause if the system has no descriptor and no connection can be closed, s."""
NO_DESCRIPTOR: Final = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM})
Say = Callable[[str], None]


@dataclass(frozen=True)
class Room:
    """Limits of waiting and of served connections, in total and for one address."""

    waiting: int
    waiting_of_one: int
    served: int
    served_of_one: int

    @staticmethod
    def of(descriptors: int) -> Room:
        """Use half of the descriptors: half of them for each kind, and a quarter of a kind for one address."""
        each = max(4, min(MOST, descriptors // 4))
        return Room(each, max(2, each // 4), each, max(2, each // 4))


def raise_limit() -> int:
    """Raise the limit of open files as far as the system grants it. Return the limit now in force."""
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MOST_DESCRIPTORS if hard == resource.RLIM_INFINITY else min(hard, MOST_DESCRIPTORS)
    if soft != resource.RLIM_INFINITY and wanted > soft:
        with suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
            return wanted
    return MOST_DESCRIPTORS if soft == resource.RLIM_INFINITY else int(soft)


class Seldom:
    """Printer of at most one line a second. The next line states the number of omitted lines."""

    EVERY_S: Final = 1.0

    def __init__(self, say: Say, clock: Callable[[], float] = time.monotonic) -> None:
        self._say, self._clock = say, clock
        self._next_s = -1.0
        self._left_out = 0

    def __call__(self, text: str, *values: object) -> None:
        """Print the line with its values, or count it as omitted."""
        now_s = self._clock()
        if now_s < self._next_s:
            self._left_out += 1
            return
        more = f" ({self._left_out} more such lines were left out)" if self._left_out else ""
        self._next_s, self._left_out = now_s + self.EVERY_S, 0
        self._say(text.format(*values) + more)


@dataclass(eq=False)
class _Waiting:
    """A connection whose header is not complete."""

    peer: socket.socket
    address: str
    since_s: float
    header: bytes = b""

    def __post_init__(self) -> None:
        self.number = self.peer.fileno()       # a selector formats a socket as text at each call


@dataclass(eq=False)
class _Served:
    """A connection at the HTTP server. ``idle_s``: time since which it has no request; None during a request."""

    peer: socket.socket
    address: str
    protocol: Any
    idle_s: float | None
    transport: asyncio.Transport | None = None
    task: asyncio.Task[None] | None = None

    @property
    def gone(self) -> bool:
        """Return whether the connection is closed and its descriptor is free again."""
        return self.peer.fileno() == -1

    @property
    def rank(self) -> int:
        """Order in which connections are closed to make room: 0 idle, 1 a download, an upload or a WebSocket, 2 a
        change.
        """
        if self.transport is None:
            return 0
        upgraded = self.transport.get_protocol() is not self.protocol
        if upgraded:
            return 1                   # a WebSocket
        cycle = self.protocol.cycle
        if cycle is None or cycle.response_complete:
            return 0
        if cycle.more_body:
            return 1 if self.protocol.scope.get(ADMITTED) else 0
        return 1 if self.protocol.scope["method"] in ("GET", "HEAD") else 2

    def close(self) -> None:
        """Close the connection at once. Data in transit are lost."""
        if self.transport is not None:
            self.transport.abort()
        elif self.task is not None:
            self.task.cancel()


class Door:
    """Admission of connections at one listening socket, in the event loop's thread."""

    def __init__(
        self, listening: socket.socket, room: Room, say: Say, *, tls: ssl.SSLContext | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._listening, self._room, self._tls, self._clock = listening, room, tls, clock
        self._complain = Seldom(say, clock)
        self._waiting: dict[_Waiting, None] = {}                   # the oldest first
        self._headers = selectors.DefaultSelector()    # the event loop's own selector costs three times as much
        self._waiting_of: dict[str, dict[_Waiting, None]] = {}
        self._served: dict[_Served, None] = {}
        self._served_of: dict[str, dict[_Served, None]] = {}
        self._look_again: asyncio.TimerHandle | None = None
        self._open = False

    @property
    def waiting(self) -> int:
        """Number of connections whose header is not complete."""
        return len(self._waiting)

    @property
    def served(self) -> int:
        """Number of connections at the HTTP server."""
        return sum(not one.gone for one in self._served)

    def open(self, protocol: Callable[[], Any]) -> None:
        """Start to accept. ``protocol`` makes the HTTP server's end of a connection. Call it in the event loop."""
        self._protocol, self._loop = protocol, asyncio.get_running_loop()
        self._listening.setblocking(False)
        self._listening.listen(BACKLOG)
        self._open = True
        self._loop.add_reader(self._listening, self._accept)
        self._loop.add_reader(self._headers.fileno(), self._hear_all)
        self._look_again = self._loop.call_later(LOOK_S, self._look)

    def close(self) -> None:
        """Accept no more connections, and close the waiting ones. The HTTP server keeps the served ones."""
        if not self._open:
            return
        self._open = False
        self._loop.remove_reader(self._listening)
        self._loop.remove_reader(self._headers.fileno())
        if self._look_again is not None:
            self._look_again.cancel()
        for one in tuple(self._waiting):
            self._drop(one)
        self._headers.close()

    # -- accepting -----------------------------------------------------------------------------------------------------

    def _accept(self) -> None:
        for _ in range(AT_ONCE):
            try:
                peer, where = self._listening.accept()
            except (BlockingIOError, InterruptedError, ConnectionAbortedError):
                return
            except OSError as error:
                self._no_descriptor(error)
                return
            peer.setblocking(False)
            self._admit(_Waiting(peer, str(where[0]), self._clock()))

    def _no_descriptor(self, error: OSError) -> None:
        if error.errno not in NO_DESCRIPTOR:
            self._complain("A connection can't be accepted: {}.", error.strerror or error)
            return
        self._complain("A connection can't be accepted: {}. The oldest idle one is closed. Raise the limit of open"
                       " files (LimitNOFILE, ulimit -n).", error.strerror or error)
        if self._waiting:
            self._drop(next(iter(self._waiting)))
        elif not self._close_one(self._served):
            self._loop.remove_reader(self._listening)
            self._loop.call_later(PAUSE_S, self._accept_again)

    def _accept_again(self) -> None:
        if self._open:
            self._loop.add_reader(self._listening, self._accept)

    def _admit(self, new: _Waiting) -> None:
        of_it = self._waiting_of.setdefault(new.address, {})
        if len(of_it) >= self._room.waiting_of_one:
            self._drop(next(iter(of_it)))
            self._complain("{} connections of {} wait for a header, which is the limit for one address. The oldest one"
                           " was closed.", self._room.waiting_of_one, new.address)
        elif len(self._waiting) >= self._room.waiting:
            self._drop(next(iter(self._waiting)))
            self._complain("{} connections wait for a header, which is the limit. The oldest one was closed.",
                           self._room.waiting)
        self._waiting[new] = None
        self._waiting_of.setdefault(new.address, {})[new] = None
        self._headers.register(new.number, selectors.EVENT_READ, new)

    def _forget(self, one: _Waiting) -> None:
        self._headers.unregister(one.number)
        self._waiting.pop(one, None)
        of_it = self._waiting_of.get(one.address, {})
        of_it.pop(one, None)
        if not of_it:
            self._waiting_of.pop(one.address, None)

    def _drop(self, one: _Waiting) -> None:
        self._forget(one)
        one.peer.close()

    def _hear_all(self) -> None:
        for key, _ in self._headers.select(0):
            self._hear(key.data)

    def _hear(self, one: _Waiting) -> None:
        """Read a part of the header. With TLS the first byte is enough; it is left in the socket."""
        if self._tls is None:
            try:
                piece = one.peer.recv(HEADER_LIMIT)
            except (BlockingIOError, InterruptedError):
                return
            except OSError:
                piece = b""
            if not piece:
                self._drop(one)
                return
            one.header += piece
            if b"\r\n\r\n" not in one.header and len(one.header) < HEADER_LIMIT:
                return
        self._forget(one)
        self._serve(one)

    # -- serving -------------------------------------------------------------------------------------------------------

    def _serve(self, one: _Waiting) -> None:
        of_it = self._served_of.setdefault(one.address, {})
        if len(of_it) >= self._room.served_of_one and self._close_one(of_it):
            self._complain("{} connections of {} are open, which is the limit for one address. The oldest idle one was"
                           " closed.", self._room.served_of_one, one.address)
        if len(self._served) >= self._room.served and self._close_one(self._served):
            self._complain("{} connections are open, which is the limit. The oldest idle one was closed.",
                           self._room.served)
        found = _Served(one.peer, one.address, self._protocol(), self._clock())
        self._served[found] = None
        self._served_of.setdefault(one.address, {})[found] = None
        found.task = self._loop.create_task(self._connect(found, one.header))

    async def _connect(self, one: _Served, header: bytes) -> None:
        secure: dict[str, Any] = {} if self._tls is None else {"ssl_handshake_timeout": HEADERS_S}
        try:
            one.transport, _ = await self._loop.connect_accepted_socket(
                lambda: one.protocol, one.peer, ssl=self._tls, **secure)
        except (OSError, asyncio.CancelledError):      # a handshake that failed, took too long or was cut
            with suppress(OSError):
                one.peer.close()
            self._remove(one)
            return
        if header:
            one.protocol.data_received(header)

    def _remove(self, one: _Served) -> None:
        self._served.pop(one, None)
        of_it = self._served_of.get(one.address, {})
        of_it.pop(one, None)
        if not of_it:
            self._served_of.pop(one.address, None)

    def _close_one(self, among: dict[_Served, None]) -> bool:
        """Close the oldest connection of the lowest rank, unless one is gone. Return whether an open one was closed."""
        if gone := [one for one in among if one.gone]:
            for one in gone:
                self._remove(one)
            return False
        if not among:
            return False
        first = min(among, key=lambda one: one.rank)   # the oldest: a dict keeps its order, min returns the first
        first.close()
        self._remove(first)
        return True

    def _look(self) -> None:
        """Close connections that have taken too long."""
        now_s = self._clock()
        for waits in tuple(self._waiting):
            if now_s - waits.since_s < HEADERS_S:
                break
            self._drop(waits)
        for one in tuple(self._served):
            if one.gone:
                self._remove(one)
            elif one.rank > 0:
                one.idle_s = None
            elif one.idle_s is None:
                one.idle_s = now_s
            elif now_s - one.idle_s >= HEADERS_S:
                one.close()
                self._remove(one)
        self._look_again = self._loop.call_later(LOOK_S, self._look)
