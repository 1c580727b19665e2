"""Places for a run's files. An older log, a log that another run writes, and a foreign file are never overwritten."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import IO

from tdhil.config import OPTION
from tdhil.errors import LogBroken, MessageCode, UsageError

_LARGEST_STUB = 1_000_000      # bytes; a larger log holds motion and is not read


class LogPlace:
    """The file of one run. ``open`` takes it; ``settle`` gives it its final name once it is closed.

    A log that another run is writing is left alone, and this run uses another name. The log of a run that ended before
    motion goes beside the last good log, which keeps its name.
    """

    def __init__(self, wanted: Path) -> None:
        self.wanted = wanted
        self.path = wanted
        self.older: Path | None = None         # new path of an older log that was moved
        self.live = False                      # another run is writing ``wanted``
        self.motion = False                    # set when motion is confirmed
        self.moved = ""                        # message if the file was moved or removed; else empty
        self._descriptor: int | None = None    # descriptor of the file, while the file may have to be found again

    def open(self, wanted: Path) -> IO[bytes]:
        """Open the file, locked against other runs. Raises OSError, and UsageError for a foreign file."""
        with _held(wanted.parent):
            if wanted.exists() and not wanted.is_file():
                return wanted.open("wb", buffering=0)      # a device
            check_log_path(wanted)
            self.live = wanted.is_file() and is_live(wanted)
            if self.live:
                self.path = _dated(wanted, time.time())
            else:
                self.older = make_room(wanted)
            file = self.path.open("xb", buffering=0)
            _lock(file.fileno())
            self._descriptor = os.open(self.path, os.O_RDONLY)     # of its own, so that the lock ends with the file
            return file

    def follow(self) -> None:
        """Find the file again if its folder was renamed or removed during the run; ``path`` and ``moved`` then state
        it.

        Linux reports the path of an open file. A removed file is written once more, to its own place or else to the
        working or the temporary folder. Raises LogBroken if it can't be found or saved.
        """
        if self._descriptor is None or self._is_there(self.path):
            return
        missing, found = self.path, None
        with suppress(OSError):
            found = Path(f"/proc/self/fd/{self._descriptor}").readlink()
        if found is not None and self._is_there(found):
            self.path, self.moved = found, f"{missing} was moved during the run: the log is now {found}"
            return
        for folder in (partial(Path, missing.parent), Path.cwd, tempfile.gettempdir):
            with suppress(OSError):        # the working folder may be gone, and there may be no temporary one
                target = _dated(Path(folder()) / missing.name, time.time())
                with Path(f"/proc/self/fd/{self._descriptor}").open("rb") as source, target.open("xb") as copy:
                    shutil.copyfileobj(source, copy)
                self._forget()
                self.path, self.moved = target, f"{missing} was removed during the run: its content is now in {target}"
                return
        self._forget()
        raise LogBroken(
            "the log file was moved or removed during the run, and its new place is unknown", where=str(missing),
            next_step="Look for it in the new place of its folder",
        )

    def _is_there(self, path: Path) -> bool:
        try:
            return self._descriptor is None or os.path.samestat(path.stat(), os.fstat(self._descriptor))
        except OSError:
            return False

    def _forget(self) -> None:
        if self._descriptor is not None:
            os.close(self._descriptor)
        self._descriptor = None

    def name(self, *, stub: bool) -> Path:
        """Return the file's final path. ``stub``: nothing moved in this run."""
        if not stub or self.older is None:
            return self.path
        from tdhil.errors import LogError
        from tdhil.recording import read_run

        with suppress(OSError, LogError):      # an older log that holds no motion either, or is unreadable, gives way
            if self.older.stat().st_size >= _LARGEST_STUB or any(
                    stage.name != "setup" for stage in read_run(self.older).stages):
                return self.wanted.with_name(f"{self.wanted.stem}.refused{self.wanted.suffix}")
        return self.path

    def settle(self, *, stub: bool) -> None:
        """Give the file its final name, once it is closed. A stub returns the name to the older log."""
        self._forget()
        final = self.name(stub=stub)
        if final != self.path and self.older is not None:
            with suppress(OSError), _held(self.wanted.parent):      # a failure loses nothing: the names stay
                self.path.replace(final)
                self.older.rename(self.path)
                self.path = final


def check_log_path(path: Path, where: str = OPTION["log"].flag) -> None:
    """Raise UsageError for a file that is not a log: it would be moved aside by mistake."""
    from tdhil.file_kind import MAGIC

    if not path.is_file() or path.suffix == ".mcap":
        return
    with suppress(OSError), path.open("rb") as file:
        if file.read(5) in (b"", MAGIC[:5]):
            return
    raise UsageError("is not a log; it was left unchanged", where=f"{where} {path}",
                     next_step="Name another file, such as run.mcap", entry=MessageCode.FILE_EXISTS)


def check_different_files(paths: Mapping[str, Path | None]) -> None:
    """Raise UsageError if two options name the same file."""
    seen: dict[Path, str] = {}
    for option, path in paths.items():
        if path is None:
            continue
        real = path.resolve()
        if real in seen:
            raise UsageError(f"is also the file of {seen[real]}", where=f"{option} {path}",
                             next_step="Name another file", entry=MessageCode.SAME_FILE_TWICE)
        seen[real] = option


def make_room(path: Path) -> Path | None:
    """Move an older log at ``path`` aside, named by the time of its last write. Return its new path, or None."""
    if not path.is_file():
        return None
    older = _dated(path, path.stat().st_mtime)
    path.rename(older)
    return older


def is_live(path: Path) -> bool:
    """Return whether a process writes this log now. False if the system can't report it."""
    try:
        import fcntl
    except ImportError:
        try:
            path.rename(path)      # Windows does not rename an open file
        except OSError:
            return True
        return False
    with suppress(OSError), path.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def _dated(path: Path, time_s: float) -> Path:
    stamp = time.strftime("%Y%m%d-%H%M%S", time.localtime(time_s))
    dated = path.with_name(f"{path.stem}-{stamp}{path.suffix}")
    number = 1
    while dated.exists():
        number += 1
        dated = path.with_name(f"{path.stem}-{stamp}-{number}{path.suffix}")
    return dated


@contextmanager
def _held(folder: Path) -> Iterator[None]:
    """Keep other runs from choosing a name in this folder. Without such locks in the system nothing is held."""
    descriptor = None
    try:
        import fcntl

        with suppress(OSError):
            descriptor = os.open(folder, os.O_RDONLY)
            fcntl.flock(descriptor, fcntl.LOCK_EX)
    except ImportError:
        pass
    try:
        yield
    finally:
        if descriptor is not None:
            os.close(descriptor)


def _lock(descriptor: int) -> None:
    with suppress(ImportError, OSError):
        import fcntl

        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
