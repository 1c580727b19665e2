"""One drive, one holder: a lock on the drive's address, which everything takes that may move its shaft.

The lock (flock) belongs to an open file, so that the system lets go of it when the process ends, whatever ends it. The
file says who holds it. It lies where every user and every service of this computer finds the same one; a folder of the
user's would leave two users two locks. A file can be removed while it is locked, and the next one would lock another:
so on Linux a name in the kernel is taken besides (abstract socket), which nobody can remove. Stopping takes no lock.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shlex
import socket
import stat
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drivers import PreflightRefused

if TYPE_CHECKING:
    from tdhil.config import RunOptions
    from tdhil.session.connection import Connection

FOLDERS = ("/run/lock", "/dev/shm", "/tmp")
"""The first of them in which anybody may make files is the one for all."""
PATIENCE_S = 0.3
"""Who only asks for the holder has the lock for a moment; so long it is tried again."""
_LONGEST = 4096


@dataclass(frozen=True)
class Holder:
    """Who holds a drive: process, command line, and since when (local time, ISO 8601)."""

    pid: int
    command: str
    since: str

    def __str__(self) -> str:
        return f"process {self.pid} ({self.command}), since {self.since}"


NOBODY_KNOWN = Holder(0, "it does not say who it is", "it does not say when")


class DriveHeld(PreflightRefused):
    """Another process holds the drive; ``holder`` says which."""

    def __init__(self, holder: Holder, address: str) -> None:
        self.holder = holder
        super().__init__(
            f"the drive is held by {holder}", where=address,
            next_step="Wait until that run has ended, or end it there; nothing has moved (tdhil stop always works)",
        )


def address_of(connection: Connection, options: RunOptions) -> str | None:
    """The drive's address as one text, the same for everybody on this computer.

    None where no other process can reach it: the embedded simulator, and what its bus says of itself.
    """
    if options.simulate or not connection.configured:
        return None
    return connection.kind.address(options, connection)


@contextmanager
def hold(address: str | None) -> Iterator[None]:
    """Hold the drive for as long as the block takes, or as the process lives.

    Raises DriveHeld, naming the holder, where another has it, and PreflightRefused where there can be no lock. On a
    system without such locks (Windows) nothing is held.
    """
    if address is None or sys.platform == "win32":
        yield
        return
    descriptor = _open(_path(address))
    try:
        _take(descriptor, address)
        with _name_in_kernel(address):
            try:
                yield
            finally:
                with suppress(OSError):
                    os.ftruncate(descriptor, 0)
    finally:
        os.close(descriptor)


def holder_of(address: str | None) -> Holder | None:
    """Who holds the drive now; None where nobody does, or where this system can't tell."""
    return None if address is None else _holder(_path(address))


def holders() -> list[Holder]:
    """Who holds any drive on this computer now."""
    found = (_holder(path) for path in sorted(_folder().glob(_name("*"))))
    return [one for one in found if one is not None]


def _holder(path: Path) -> Holder | None:
    if sys.platform == "win32":
        return None
    import fcntl

    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError:
        return None
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return _read(descriptor)
        return None
    finally:
        os.close(descriptor)


def _take(descriptor: int, address: str) -> None:
    import fcntl

    end_s = time.monotonic() + PATIENCE_S
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            break
        except BlockingIOError:
            if time.monotonic() >= end_s:
                raise DriveHeld(_read(descriptor), address) from None
        except OSError as error:
            raise _no_lock(error, _path(address)) from error
        time.sleep(0.01)
    me = Holder(os.getpid(), _command(), datetime.now().astimezone().isoformat(timespec="seconds"))
    with suppress(OSError):            # who it is matters to people; the lock holds without it
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, json.dumps(asdict(me)).encode(), 0)


@contextmanager
def _name_in_kernel(address: str) -> Iterator[None]:
    with socket.socket(socket.AF_UNIX) as taken:
        if sys.platform == "linux":
            try:
                taken.bind("\0" + _path(address).name)
            except OSError as error:
                if error.errno == errno.EADDRINUSE:
                    raise DriveHeld(NOBODY_KNOWN, address) from None
        yield


def _read(descriptor: int) -> Holder:
    """What the file says of its holder; what another user wrote there may be anything."""
    try:
        found: Any = json.loads(os.pread(descriptor, _LONGEST, 0))
        return Holder(int(found["pid"]), str(found["command"])[:300], str(found["since"])[:40])
    except (OSError, ValueError, TypeError, KeyError, ArithmeticError, RecursionError):
        return NOBODY_KNOWN


def _command() -> str:
    name, *rest = sys.argv or ["python"]
    return shlex.join((Path(name).name, *rest))[:300]


def _name(key: str) -> str:
    return f"tdhil-{key}.lock"


def _path(address: str) -> Path:
    return _folder() / _name(hashlib.sha256(address.encode()).hexdigest()[:24])


def _folder() -> Path:
    for folder in map(Path, FOLDERS):
        with suppress(OSError):
            mode = folder.stat().st_mode
            if stat.S_ISDIR(mode) and mode & stat.S_ISVTX and mode & stat.S_IWOTH:
                return folder
    import tempfile

    return Path(tempfile.gettempdir())


def _open(path: Path) -> int:
    """The lock's file, which belongs to whoever was first, and which anybody may lock."""
    flags = os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC
    try:
        for _ in range(3):
            with suppress(FileNotFoundError):      # without O_CREAT first: the kernel refuses it for another's file
                return os.open(path, flags)
            with suppress(FileExistsError):
                descriptor = os.open(path, flags | os.O_CREAT | os.O_EXCL, 0o666)
                with suppress(OSError):
                    os.fchmod(descriptor, 0o666)   # whatever the mask of whoever came first
                return descriptor
        raise FileNotFoundError(errno.ENOENT, "it comes and goes", str(path))
    except OSError as error:
        raise _no_lock(error, path) from error


def _no_lock(error: OSError, path: Path) -> PreflightRefused:
    return PreflightRefused(
        f"whether somebody else moves this drive can't be known: its lock can't be had ({error.strerror or error})",
        where=str(path), next_step="See to whom that file belongs; nothing has moved",
    )
