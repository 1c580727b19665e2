"""One drive, one holder: a lock on the drive's address. Every program that may move the shaft takes it.

The lock (flock) belongs to an open file, so the system releases it when the process ends, for any reason. The file
names the holder. It lies in one folder for all users and services of this computer; a folder per user would give two
users two locks. A locked file can be removed, and the next process would then lock another one. So on Linux an abstract
socket name in the kernel is taken too, which can't be removed. Stopping takes no lock.
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
from profiles import MessageCode

if TYPE_CHECKING:
    from tdhil.buses import Connection
    from tdhil.config import RunOptions

FOLDERS = ("/run/lock", "/dev/shm", "/tmp")
"""Candidate folders. The first one in which every user may create files is used."""
PATIENCE_S = 0.3
"""Time for which taking the lock is retried, s. A process that only reads the holder has the lock for a moment."""
_LONGEST = 4096


@dataclass(frozen=True)
class Holder:
    """The holder of a drive: process, command line, and start (local time, ISO 8601)."""

    pid: int
    command: str
    since: str

    def __str__(self) -> str:
        return f"process {self.pid} ({self.command}), since {self.since}"


NOBODY_KNOWN = Holder(0, "command line unknown", "unknown time")


class DriveHeld(PreflightRefused):
    """Another process holds the drive; ``holder`` names it."""

    entry = MessageCode.DRIVE_HELD

    def __init__(self, holder: Holder, address: str) -> None:
        self.holder = holder
        super().__init__(
            f"the drive is held by {holder}", where=address,
            next_step="This command moved nothing; the other run may turn the shaft. Wait until it ends, or end it"
            " there. tdhil stop is not blocked",
        )


def address_of(connection: Connection, options: RunOptions) -> str | None:
    """Return the drive's address as one text, the same for every user of this computer.

    None if no other process can reach it: the embedded simulator, or a bus that exists only in this process.
    """
    if options.simulate or not connection.configured:
        return None
    return connection.bus.address(options, connection)


@contextmanager
def hold(address: str | None) -> Iterator[None]:
    """Hold the drive until the block or the process ends.

    Raises DriveHeld, with the holder, if another process holds it, and PreflightRefused if no lock is possible. On a
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
    """Return the present holder of the drive; None if there is none, or if this system has no such locks."""
    return None if address is None else _holder(_path(address))


def holders() -> list[Holder]:
    """Return the present holders of all drives on this computer."""
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
    with suppress(OSError):            # the name is for the operator; the lock holds without it
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
    """Return the holder from the file. Its content is untrusted: another user may have written it."""
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
    """Open the lock's file. The first user owns it, and every user may lock it."""
    flags = os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC
    try:
        for _ in range(3):
            with suppress(FileNotFoundError):      # first without O_CREAT: refused for another user's file
                return os.open(path, flags)
            with suppress(FileExistsError):
                descriptor = os.open(path, flags | os.O_CREAT | os.O_EXCL, 0o666)
                with suppress(OSError):
                    os.fchmod(descriptor, 0o666)   # regardless of the first user's umask
                return descriptor
        raise FileNotFoundError(errno.ENOENT, "another process creates and removes the file repeatedly", str(path))
    except OSError as error:
        raise _no_lock(error, path) from error


def _no_lock(error: OSError, path: Path) -> PreflightRefused:
    return PreflightRefused(
        f"the drive can't be locked against other programs: no access to its lock file ({error.strerror or error})",
        where=str(path), next_step="Check the owner of that file. Nothing has moved",
        entry=MessageCode.DRIVE_HELD,
    )
