"""Uploaded recordings that wait to be identified: a log of tdhil, or a trace of another tool in CSV.

::

    uploads/.<id>/                                 while it is received; deleted if the upload is cut off
    uploads/<id>/upload.json, run.mcap | trace.csv
    runs/<id of a run>/                            the same folder, once it is identified

Nothing here concerns a drive. An uploaded recording becomes a run that has already ended, so it never waits for a code,
never blocks a rig and never stops. The name of the uploaded file is a text. It is never used as a path.
"""

from __future__ import annotations

import hashlib
import os
import re
import secrets
import shutil
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, BinaryIO, Final, Literal

from profiles import visible
from tdhil.errors import LogError, TdhilError
from tdhil.service.limits import MEBIBYTE, UPLOAD_LIMIT
from tdhil.service.run_state import FULL, Conflict, NoRoom, NotThere, Status, Told, TooLarge, now, request_wrong
from tdhil.service.store import LOG, Store, StoredRequest, read_json, write_json

AT_ONCE: Final = 2
"""Largest number of uploads that are received at the same time."""
WAITING: Final = 8
"""Largest number of uploads that wait to be identified."""
KEPT_S: Final = 86_400.0
"""Time after which an upload that was not identified is deleted, s."""
KEPT_FREE: Final = 500_000_000
"""Disk space that an upload leaves free, bytes. A run needs 200 MB for its log, so an upload stops no run."""
LONGEST_NAME: Final = 200
"""Longest name of an uploaded file, characters. A longer one is cut."""
FINISHED: Final = 100
"""Number of identified uploads whose run is remembered."""
FOLDER: Final = "uploads"
TRACE: Final = "trace.csv"
"""File of a trace, as it was received."""
MOTION: Final = "excitation.yaml"
_ID: Final = re.compile(r"[0-9a-f]{16}")
_ABOUT: Final = "upload.json"
_RAW: Final = "received"
UploadState = Literal["waiting", "delayed", "identifying", "failed", "done"]
"""States: waits for a person; waits until no real shaft turns; is identified; could not be identified; is a run."""
BUSY: Final = frozenset({"delayed", "identifying"})
"""States in which an upload can be neither deleted nor identified again."""


@dataclass(frozen=True)
class Upload:
    """An uploaded file. ``kind``: a log of tdhil, or a trace in CSV. ``run``: made from it. ``error``: why not."""

    id: str
    name: str
    size_bytes: int
    sha256: str
    by: str
    at: str
    kind: Literal["log", "trace"]
    state: UploadState = "waiting"
    run: str | None = None
    error: Told | None = None

    @property
    def source(self) -> dict[str, str]:
        """Return what a result states of the file."""
        return {"file": self.name, "sha256": self.sha256, "by": self.by, "at": self.at}


def shown_name(name: str) -> str:
    """Return the name of a file for display: its last part, one line, without control characters."""
    last = re.split(r"[/\\]", name.strip())[-1]
    return " ".join(visible(last).split())[:LONGEST_NAME] or "without a name"


class Receiving:
    """A file while it is received, in a folder of its own. It exists for others only after `finish`."""

    def __init__(self, folder: Path, file: BinaryIO, limit: int, free: Callable[[], int]) -> None:
        self.folder, self._file, self._limit, self._free = folder, file, limit, free
        self._sum = hashlib.sha256()
        self.size = 0

    def write(self, piece: bytes) -> None:
        """Add a piece. Raises TooLarge, NoRoom and LogError."""
        self.size += len(piece)
        if self.size > self._limit:
            raise too_large(self._limit)
        if self._free() < KEPT_FREE:
            raise _no_room()
        with _disk(self.folder.name):
            self._file.write(piece)
        self._sum.update(piece)

    def finish(self) -> str:
        """Write the file to the disk. Return its SHA-256 in hex. Raises NoRoom and LogError."""
        with _disk(self.folder.name):
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()
        return self._sum.hexdigest()

    def close(self) -> None:
        """Delete the file, unless it was kept."""
        with suppress(OSError):
            self._file.close()
        shutil.rmtree(self.folder, ignore_errors=True)


class Uploads:
    """The uploads of one service, for any thread. ``limit``: largest file, bytes; ``note`` writes to the audit."""

    def __init__(self, store: Store, note: Callable[..., None], limit: int = UPLOAD_LIMIT) -> None:
        self._store, self._note, self.limit = store, note, limit
        self.folder = store.folder / FOLDER
        self._lock = threading.RLock()         # an upload becomes a run, or is found, but never in between
        self._receiving = 0
        self._states: dict[str, tuple[UploadState, Told | None]] = {}
        self._finished: dict[str, Upload] = {}         # those that are a run now

    def start(self) -> None:
        """Delete half received files of a service that ended, and uploads that were not identified in time."""
        if self.folder.is_dir():
            for one in self.folder.iterdir():
                if not _ID.fullmatch(one.name) or read_json(one / _ABOUT) is None:
                    shutil.rmtree(one, ignore_errors=True)
            self._delete_old()

    # -- receiving -----------------------------------------------------------------------------------------------

    def begin(self, length: int | None) -> Receiving:
        """Begin to receive a file of ``length`` bytes, None if the client does not state it.

        Raises TooLarge, Conflict if too many uploads are received or wait, NoRoom and LogError.
        """
        if length is not None and length > self.limit:
            raise too_large(self.limit)
        self._delete_old()
        with self._lock:
            if self._receiving >= AT_ONCE:
                raise Conflict(f"{AT_ONCE} uploads are in progress, which is the limit", where=FOLDER,
                               next_step="Wait until one has ended")
            if len(self._ids()) + self._receiving >= WAITING:
                raise Conflict(f"{WAITING} uploads wait to be identified, which is the limit", where=FOLDER,
                               next_step="Identify or delete one of them")
            self._receiving += 1
        folder = self.folder / f".{secrets.token_hex(8)}"
        try:
            if self._free() < KEPT_FREE + (length or 0):
                raise _no_room()
            with _disk(FOLDER):
                folder.mkdir(parents=True, mode=0o750)
                return Receiving(folder, (folder / _RAW).open("xb"), self.limit, self._free)
        except TdhilError:
            self.close(None)
            shutil.rmtree(folder, ignore_errors=True)
            raise

    def finish(self, received: Receiving, name: str, who: str) -> Upload:
        """Keep a file that was received as a whole. Raises UsageError if it is empty, NoRoom and LogError."""
        from tdhil.session import is_log

        sha256 = received.finish()
        if not received.size:
            raise request_wrong("the file is empty", shown_name(name), "Choose another file")
        raw = received.folder / _RAW
        log = is_log(raw)
        found = Upload(received.folder.name[1:], shown_name(name), received.size, sha256, who, now(),
                       "log" if log else "trace")
        about = {one: value for one, value in asdict(found).items() if one not in ("id", "state", "run", "error")}
        with _disk(found.name):
            raw.rename(received.folder / (LOG if log else TRACE))
            write_json(received.folder / _ABOUT, about)
            received.folder.rename(self.folder / found.id)
        self._note(who, "recording uploaded", None, None, upload=found.id, file=found.name, sha256=sha256,
                   size_bytes=found.size_bytes)
        return found

    def close(self, received: Receiving | None) -> None:
        """End an upload. What was not kept is deleted."""
        if received is not None:
            received.close()
        with self._lock:
            self._receiving -= 1

    # -- what waits ----------------------------------------------------------------------------------------------

    def all(self) -> list[Upload]:
        """Return the uploads that wait, the newest first."""
        self._delete_old()
        found = []
        for one in self._ids():
            with suppress(NotThere):
                found.append(self.get(one))
        return sorted(found, key=lambda one: one.at, reverse=True)

    def get(self, upload: str) -> Upload:
        """Return one upload, also for some time after it became a run. Raises NotThere."""
        with self._lock:
            if (finished := self._finished.get(upload)) is not None:
                return finished
            plain = read_json(self.place(upload) / _ABOUT)
            try:
                found = Upload(id=upload, **(plain or {}))
            except TypeError:
                raise _not_there(upload) from None
            state, error = self._states.get(upload, ("waiting", None))
            return replace(found, state=state, error=error)

    def place(self, upload: str) -> Path:
        """Return the folder of an upload. Raises NotThere, also for a name that is not an id."""
        path = self.folder / upload if _ID.fullmatch(upload) else None
        if path is None or not path.is_dir():
            raise _not_there(upload)
        return path

    def delete(self, upload: str, who: str) -> None:
        """Delete an upload. Raises NotThere, and Conflict while it is identified."""
        found = self.get(upload)
        with self._lock:
            if self._states.get(upload, ("waiting", None))[0] in BUSY or found.run is not None:
                raise Conflict(f"the upload is {'identified' if found.run else 'being identified'}",
                               where=f"upload {upload}", next_step="Delete the run that is made from it")
            self._remove(upload)
        self._note(who, "upload deleted", None, None, upload=upload, file=found.name, sha256=found.sha256)

    # -- from an upload to a run ---------------------------------------------------------------------------------

    def begin_identifying(self, upload: str) -> Upload:
        """Mark an upload as being identified. Raises NotThere, and Conflict if it already is."""
        with self._lock:
            found = self.get(upload)
            if found.state in BUSY or found.run is not None:
                raise Conflict("this upload is already identified" if found.run else "this upload is being identified",
                               where=f"upload {upload}", next_step="Wait for its run")
            self._states[upload] = ("identifying", None)
        return replace(found, state="identifying", error=None)

    def delay(self, upload: str, *, delayed: bool) -> None:
        """Keep whether the identification waits until no real shaft turns."""
        with self._lock:
            self._states[upload] = ("delayed" if delayed else "identifying", None)

    def failed(self, upload: str, error: Told) -> None:
        """Keep the reason why an upload could not be identified. It can be identified again with another mapping."""
        with self._lock:
            self._states[upload] = ("failed", error)

    def become_run(
        self, upload: Upload, rig: str, options: Mapping[str, Any], who: str, document: Mapping[str, Any]
    ) -> str:
        """Make the folder of an identified upload the folder of an ended run. Return the run's id.

        ``document``: facts of the identification from the worker process. The rename is the last step, so a run
        exists as a whole or not at all. Raises NoRoom and LogError.
        """
        folder = self.place(upload.id)
        with self._lock, _disk(upload.name):
            run = self._store.new_id()
            try:
                at = now()
                request = StoredRequest(
                    run, rig, "", "", {**options, **document["said"]}, who, at, document["simulated"], "never",
                    uploaded={**upload.source, "rig": rig, "kind": upload.kind, "size_bytes": upload.size_bytes},
                )
                status = Status.of_uploaded(run, rig, at, simulated=document["simulated"], verdict=document["verdict"],
                                            exit_code=document["exit_code"], identity=document["identity"],
                                            rehearsal=document["rehearsal"])
                self._store.adopt(folder, request, status)
                (self._store.runs / run / _ABOUT).unlink(missing_ok=True)
            except OSError:
                with suppress(OSError):
                    (self._store.runs / run).rmdir()
                raise
            self._states.pop(upload.id, None)
            self._finished[upload.id] = replace(upload, state="done", run=run)
            for old in list(self._finished)[:-FINISHED]:
                del self._finished[old]
        self._note(who, "upload identified", run, rig or None, upload=upload.id, file=upload.name,
                   sha256=upload.sha256, verdict=document["verdict"])
        return run

    # ------------------------------------------------------------------------------------------------------------

    def _ids(self) -> list[str]:
        with suppress(OSError):
            return [one.name for one in self.folder.iterdir() if _ID.fullmatch(one.name)]
        return []

    def _free(self) -> int:
        return shutil.disk_usage(self._store.folder).free

    def _remove(self, upload: str) -> None:
        """Delete the folder under a name that no request finds, so that an upload exists as a whole or not at all."""
        with suppress(OSError):
            gone = (self.folder / upload).rename(self.folder / f".{upload}")
            shutil.rmtree(gone, ignore_errors=True)
        self._states.pop(upload, None)

    def _delete_old(self) -> None:
        before = datetime.fromisoformat(now()) - timedelta(seconds=KEPT_S)
        for one in self._ids():
            with suppress(NotThere, ValueError):
                found = self.get(one)
                if found.state not in BUSY and datetime.fromisoformat(found.at) < before:
                    self._remove(one)
                    self._note("service", "upload expired", None, None, upload=one, file=found.name,
                               sha256=found.sha256)


@contextmanager
def _disk(name: str) -> Iterator[None]:
    """Raise NoRoom for a full disk, and LogError for any other error of it."""
    try:
        yield
    except OSError as error:
        if error.errno in FULL:
            raise _no_room() from error
        raise LogError(f"the upload can't be written ({error.strerror or error})", where=name,
                       next_step="Check the folder of the service") from error


def _no_room() -> NoRoom:
    return NoRoom(f"the disk has no room for this file; {KEPT_FREE // 10**6} MB stay free for runs", where=FOLDER,
                  next_step="Nothing was kept. Free some disk space")


def too_large(limit: int) -> TooLarge:
    """Return the refusal of a file above the limit."""
    return TooLarge(f"the file is larger than the limit of {limit // MEBIBYTE} MiB", where=FOLDER,
                    next_step="Export the part with the motion, or raise tdhil serve --upload-limit")


def _not_there(upload: str) -> NotThere:
    return NotThere("this upload does not exist", where=f"upload {upload[:40]}",
                    next_step="It was identified, deleted, or it has expired. See the list of runs")

