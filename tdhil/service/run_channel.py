"""Channel between web and run: a Unix socket in the run's folder, and the lock of a run that is alive.

Request and reply are a line of JSON each. The socket belongs to one user (mode 0600). The run's process holds the lock
while it is alive. The web takes the lock before the process starts, and passes it on. So a run never appears dead.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from drivers import CommunicationLost
from profiles import message_of
from tdhil.errors import MessageCode, TdhilError
from tdhil.service.run_state import Told, page_text

SOCKET: Final = "control.sock"
LOCK: Final = "alive.lock"
STOP_FILE: Final = "stop.json"
"""Name of the file with a stop request that was made before the run's process listens."""
LONGEST: Final = 64 * 1024
_PATH_LIMIT: Final = 100               # longest path of a socket, bytes; the system's limit is 108
Answer = Callable[[Mapping[str, Any]], Mapping[str, Any]]


class RunRefused(TdhilError):
    """Refusal by the run. ``reported``: the error that the run reported."""

    def __init__(self, reported: Told) -> None:
        super().__init__(reported.what, where=reported.where, next_step=reported.next_step)
        self.reported = reported
        self.exit_code = reported.exit_code
        self.entry = message_of(reported.code) or self.entry


class ChannelListener:
    """The run's end of the channel. Each request has its own thread: no slow client delays another.

    Some threads wait for requests in advance, because starting one takes 200 ms on a busy computer.
    """

    SPARE: Final = 2

    def __init__(self, folder: Path, answer: Answer) -> None:
        self._folder, self._answer = folder, answer
        self._idle = 0
        self._lock = threading.Lock()
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)

    def __enter__(self) -> Self:
        (self._folder / SOCKET).unlink(missing_ok=True)
        mask = os.umask(0o177)
        try:
            with _short(self._folder / SOCKET) as name:
                self._socket.bind(name)
        finally:
            os.umask(mask)
        self._socket.listen(16)
        for _ in range(self.SPARE):
            self._begin()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with suppress(OSError):
            self._socket.close()
        (self._folder / SOCKET).unlink(missing_ok=True)

    def _begin(self) -> None:
        with self._lock:
            self._idle += 1
        threading.Thread(target=self._accept, name="control", daemon=True).start()

    def _accept(self) -> None:
        while True:
            try:
                peer, _ = self._socket.accept()
            except OSError:
                return
            with self._lock:
                self._idle -= 1
                last = self._idle == 0
            if last:
                self._begin()
            self._serve(peer)
            with self._lock:
                if self._idle >= self.SPARE:
                    return
                self._idle += 1

    def _serve(self, peer: socket.socket) -> None:
        with peer, suppress(OSError):
            peer.settimeout(5.0)
            try:
                asked = json.loads(_line(peer))
                answer: Mapping[str, Any] = self._answer(asked if isinstance(asked, dict) else {})
            except Exception as error:         # any error of a request: the run continues
                answer = {"error": Told.of(error).__dict__}
            peer.sendall(json.dumps(answer).encode() + b"\n")


def ask(folder: Path, request: Mapping[str, Any], *, timeout_s: float = 2.0) -> dict[str, Any]:
    """Send a request and return the run's reply. Raises RunRefused with its error, and CommunicationLost."""
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as peer:
            peer.settimeout(timeout_s)
            with _short(folder / SOCKET) as name:
                peer.connect(name)
            peer.sendall(json.dumps(request).encode() + b"\n")
            found: dict[str, Any] = json.loads(_line(peer))
    except (OSError, ValueError) as error:
        raise CommunicationLost(
            page_text(f"the run's process does not answer ({error})"), where=f"run {folder.name}",
            next_step=page_text("If the shaft turns, use the hard-wired emergency stop"),
            entry=MessageCode.SERVER_UNREACHABLE,
        ) from error
    if found.get("error"):
        raise RunRefused(Told(**found["error"]))
    return found


def tell_viewed(folder: Path) -> None:
    """Report to the run that a page shows it. Raises RunRefused and CommunicationLost."""
    ask(folder, {"do": "viewed"})


def _line(peer: socket.socket) -> bytes:
    found = b""
    while not found.endswith(b"\n") and len(found) < LONGEST and (more := peer.recv(4096)):
        found += more
    return found


@contextmanager
def _short(path: Path) -> Iterator[str]:
    """Yield the path of a socket. A path that is too long is replaced by one through the open folder."""
    if len(os.fsencode(path)) < _PATH_LIMIT:
        yield str(path)
        return
    descriptor = os.open(path.parent, os.O_RDONLY)
    try:
        yield f"/proc/self/fd/{descriptor}/{path.name}"
    finally:
        os.close(descriptor)


def take_life(folder: Path) -> int:
    """Take the run's lock. Return its descriptor for the run's process to inherit; the caller closes its own copy."""
    import fcntl

    descriptor = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


def lives(folder: Path) -> bool:
    """Return whether the run's process is alive; True if this is unknown (such as without a free descriptor)."""
    import fcntl

    try:
        descriptor = os.open(folder / LOCK, os.O_RDONLY | os.O_CLOEXEC)
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError:
        return True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)
    return False


def stands_still(pid: int) -> bool:
    """Return whether the process is suspended, by SIGSTOP or a debugger; False if this is unknown."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2][:1] in ("T", "t")
    except OSError:
        return False


def send_signal(pid: int, folder: Path, number: int) -> bool:
    """Send a signal to the run's process by a descriptor, so that no other process with the same number receives it."""
    if sys.platform != "linux":
        return False
    try:
        descriptor = os.pidfd_open(pid)
    except OSError:
        return False
    try:
        if not lives(folder):              # checked after the descriptor was made: it is this run's process or none
            return False
        signal.pidfd_send_signal(descriptor, number)
        return True
    except OSError:
        return False
    finally:
        os.close(descriptor)
