"""The service's data in files. The index only repeats them: if it is deleted, it is made again.

::

    runs/<id>/request.json, state.json, connection.json, confirm.json, signed_off.json, annotations.json,
              result.json, run.mcap, report.html, replays/, trace.csv and excitation.yaml of an uploaded trace
    uploads/<id>/     `uploads.Uploads`
    index.sqlite
"""

from __future__ import annotations

import json
import os
import re
import secrets
import shutil
import sqlite3
import threading
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, TypeVar

from tdhil.config import STATED
from tdhil.errors import LogUnopened, MessageCode, UsageError
from tdhil.fleet import ANNOTATIONS_FILE
from tdhil.service.annotations import Annotations
from tdhil.service.run_filter import NEWEST, SEARCHED_COLUMN, Order, RunFilter, Summary
from tdhil.service.run_state import NotThere, State, Status, now

T = TypeVar("T")
ID: Final = re.compile(r"[0-9]{8}-[0-9]{6}-[0-9a-f]{6}")
"""Id of a run: date, time (UTC), and a random part."""
_FILE_LIMIT: Final = 16 * 2**20
RESERVE: Final = 2**16
"""Disk space reserved for the final status of a run, bytes. It is used when the disk is full."""
LOG: Final = "run.mcap"
RECOVERED: Final = "recovered.mcap"
CONNECTION_FILE: Final = "connection.json"
"""File in a run's folder with the address of its drive, for a later stop (`tdhil.session.kept`)."""
_RESERVE, _USED = ".reserve", ".state.json"
_DELETED_KEYS: Final = "deleted_keys.json"
"""File with the requests of deleted runs that had an Idempotency-Key."""
KEYS: Final = 500
"""Number of newest runs, and of deleted runs, that are searched for an Idempotency-Key."""
_DELETED: Final = ".deleted-"
"""Start of the name of a run's folder during its deletion."""


def write_whole(path: Path, data: bytes, mode: int | None = None) -> None:
    """Write a file atomically, safe against loss of power. ``mode``: permissions of the file. Raises OSError."""
    beside = path.with_name(f".{path.name}.{os.getpid()}.{threading.get_ident()}")
    try:
        with beside.open("wb") as file:
            if mode is not None:
                os.fchmod(file.fileno(), mode)     # set while the file is empty
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        beside.replace(path)
    except OSError:
        beside.unlink(missing_ok=True)
        raise
    _sync_folder(path.parent)


def write_new(path: Path, data: bytes) -> None:
    """Write a new file as a whole or not at all. Raises FileExistsError, and OSError."""
    whole = path.with_name(f".{path.name}.new.{os.getpid()}.{threading.get_ident()}")
    try:
        write_whole(whole, data)
        os.link(whole, path)                   # unlike a rename, it never replaces a file
    finally:
        whole.unlink(missing_ok=True)
    _sync_folder(path.parent)


def write_json(path: Path, plain: Mapping[str, Any], mode: int | None = None) -> None:
    """Write a JSON object atomically. ``mode``: permissions of the file. Raises OSError."""
    write_whole(path, json.dumps(plain, ensure_ascii=False, indent=1, allow_nan=False).encode() + b"\n", mode)


def read_json(path: Path) -> dict[str, Any] | None:
    """Return the object in the file; None if it can't be read."""
    with suppress(OSError, ValueError, RecursionError):
        if path.stat().st_size <= _FILE_LIMIT:
            found = json.loads(path.read_bytes())
            return found if isinstance(found, dict) else None
    return None


def read_as(kind: type[T], path: Path) -> T | None:
    """Return the dataclass in the file; None if it can't be read."""
    with suppress(TypeError):
        return None if (plain := read_json(path)) is None else kind(**plain)
    return None


def _sync_folder(folder: Path) -> None:
    with suppress(OSError):                # not every file system supports fsync of a folder
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


# ---------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class StoredRequest:
    """Request of a run, file request.json. ``options`` as received, ``motion`` as in the rig's file.

    ``uploaded``: source of an uploaded recording, as in `Upload.source`, with its rig as stated, kind and size. The rig
    is '' if none was stated.
    """

    id: str
    rig: str
    rig_file: str
    rig_sha256: str
    options: Mapping[str, Any]
    asked_by: str
    asked: str
    simulated: bool
    motion: str
    idempotency_key: str | None = None
    uploaded: Mapping[str, Any] | None = None

    @property
    def rehearsal(self) -> bool:
        """Return whether faults of the simulated drive are rehearsed. Such a result is no part of the rig's history."""
        return bool(self.options.get("fault"))

    @staticmethod
    def of_plain(plain: Mapping[str, Any]) -> StoredRequest:
        return StoredRequest(**plain)


def summary_of(request: StoredRequest, status: Status, result: Mapping[str, Any] | None,
               annotations: Annotations | None = None) -> Summary:
    """Return a run's row of the list from the contents of its files."""
    inertia = (result or {}).get("inertia_kg_m2") or {}
    annotations = annotations or Annotations()
    return Summary(
        request.id, request.rig, status.state.value, request.asked, request.asked_by,
        status.at if status.ended else None,
        request.simulated if status.simulated is None else status.simulated,
        (result or {}).get("verdict"), inertia.get("value"), inertia.get("low_total"), inertia.get("high_total"),
        inertia.get("repeatability_rel"), status.exit_code, request.rehearsal,
        request.uploaded is not None,
        tags=annotations.tags, archived=annotations.archived,
        acceptance=((result or {}).get("acceptance") or {}).get("verdict"),
        **{name: annotations.text(name, request.options) or None for name in STATED},
    )


class Store:
    """The folder of one service. Any thread may call its methods."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.runs = folder / "runs"
        self._lock = threading.Lock()

    def prepare(self) -> None:
        """Make the folders. Raises LogUnopened if they can't be written."""
        try:
            for path in (self.runs, self.folder / "audit"):
                path.mkdir(parents=True, exist_ok=True, mode=0o750)
        except OSError as error:
            raise LogUnopened(f"can't be made ({error.strerror or error})", where=str(self.folder),
                              next_step="Name another folder for the runs: tdhil serve --data DIR") from error

    def new_id(self) -> str:
        """Return a new id, and make its folder. Ids sort by the time they were made at, also within a second.

        The last six hexadecimal digits are the microsecond times 16 (at most 15,999,984 of 16,777,216), plus a random
        number below 16.
        """
        while True:
            now = datetime.now(UTC)
            found = f"{now:%Y%m%d-%H%M%S}-{16 * now.microsecond + secrets.randbelow(16):06x}"
            with suppress(FileExistsError):
                (self.runs / found).mkdir(mode=0o750)
                return found

    def place(self, run: str) -> Path:
        """Return the run's folder. Raises NotThere, also for a name that is not an id."""
        path = self.runs / run if ID.fullmatch(run) else None
        if path is None or not path.is_dir():
            raise NotThere("this run does not exist", where=f"run {run[:40]}", next_step="See the list of runs")
        return path

    def require_finished_log(self, run: str) -> None:
        """Raise UsageError if the run has not ended, or has no log. Raises NotThere."""
        if not (ended := self.status(run).ended) or not (self.place(run) / LOG).is_file():
            raise UsageError("the run has no finished log", where=f"run {run}",
                             next_step="The run ended without a log" if ended else "Wait until it has ended",
                             entry=MessageCode.NOT_READY)

    def ids(self) -> list[str]:
        """Return all runs, the newest first."""
        with suppress(OSError):
            return sorted((one.name for one in self.runs.iterdir() if ID.fullmatch(one.name)), reverse=True)
        return []

    def request(self, run: str) -> StoredRequest:
        """Return the run's request. Raises NotThere if the run has none."""
        plain = read_json(self.place(run) / "request.json")
        try:
            return StoredRequest.of_plain(plain or {})
        except TypeError:
            raise NotThere("the run has no request", where=f"run {run}") from None

    def status(self, run: str) -> Status:
        """Return the status from the run's file; ``interrupted`` if the file can't be read."""
        folder = self.place(run)
        plain = read_json(folder / _USED) or read_json(folder / "state.json")
        try:
            return Status.of_plain(plain or {})
        except (TypeError, ValueError, KeyError):
            request = self.request(run)
            return Status.begun(run, request.rig, request.asked).to(State.INTERRUPTED, request.asked)

    def rehearsed(self, run: str) -> bool:
        """Return whether the run is a rehearsal; False without a request."""
        with suppress(NotThere):
            return self.request(run).rehearsal
        return False

    def result(self, run: str) -> dict[str, Any] | None:
        return read_json(self.place(run) / "result.json")

    def summary(self, run: str) -> Summary:
        return summary_of(self.request(run), self.status(run), self.result(run), self.annotations(run))

    def annotations(self, run: str) -> Annotations:
        """Return the present annotations of the run; none if the file can't be read."""
        plain = read_json(self.place(run) / ANNOTATIONS_FILE)
        with suppress(TypeError):
            return Annotations.of_plain(plain or {})
        return Annotations()

    def annotate(self, run: str, annotations: Annotations) -> None:
        """Write the annotations of the run. Raises NotThere and OSError."""
        write_json(self.place(run) / ANNOTATIONS_FILE, annotations.plain())

    def delete(self, run: str) -> None:
        """Delete the folder of the run with all its files. Raises NotThere and OSError.

        The folder first gets another name. So the run exists as a whole or not at all, also after a loss of power.
        """
        folder = self.place(run)
        gone = folder.rename(folder.with_name(f"{_DELETED}{run}"))
        _sync_folder(self.runs)
        shutil.rmtree(gone, ignore_errors=True)

    def keep_key(self, request: StoredRequest) -> None:
        """Remember the Idempotency-Key of a run that is about to be deleted. Raises OSError."""
        if request.idempotency_key is not None:
            kept = [*self._deleted_keys(), [request.id, request.rig, request.idempotency_key, request.asked_by]]
            write_json(self.folder / _DELETED_KEYS, {"runs": kept[-KEYS:]})

    def request_with_key(self, rig: str, key: str, who: str) -> StoredRequest | None:
        """Return this user's request of this rig with this key, among the newest runs; None if there is none."""
        for run in self.ids()[:KEYS]:
            with suppress(Exception):
                request = self.request(run)
                if (request.rig, request.idempotency_key, request.asked_by) == (rig, key, who):
                    return request
        return None

    def deleted_with_key(self, rig: str, key: str, who: str) -> str | None:
        """Return the deleted run that this user requested of this rig with this key; None if there is none."""
        return next((str(run) for run, *of in reversed(self._deleted_keys()) if of == [rig, key, who]), None)

    def _deleted_keys(self) -> list[list[str]]:
        found = (read_json(self.folder / _DELETED_KEYS) or {}).get("runs")
        return [one for one in found if isinstance(one, list) and one] if isinstance(found, list) else []

    def finish_deletions(self) -> None:
        """Delete the folders whose deletion was interrupted."""
        for folder in self.runs.glob(f"{_DELETED}*"):
            shutil.rmtree(folder, ignore_errors=True)

    def summaries(self) -> Iterator[Summary]:
        """Yield the row of every run that has a request, from the files."""
        for run in self.ids():
            with suppress(NotThere):
                yield self.summary(run)

    def begin(self, request: StoredRequest) -> Status:
        """Write the request and the first status of a run. Return the status. Raises OSError."""
        status = Status.begun(request.id, request.rig, request.asked)
        write_json(self.runs / request.id / "request.json", asdict(request))
        self.save(status)
        return status

    def adopt(self, folder: Path, request: StoredRequest, status: Status) -> None:
        """Make this folder the folder of an ended run. Its place, which `new_id` made, is still empty. Raises OSError.

        The last step is a rename, so the run exists as a whole or not at all.
        """
        write_json(folder / "request.json", asdict(request))
        write_json(folder / "state.json", status.plain())
        folder.replace(self.runs / request.id)
        _sync_folder(self.runs)

    def save(self, status: Status) -> None:
        """Write the status; on a full disk, into the reserved space. Raises OSError without reserved space."""
        folder, plain = self.runs / status.id, status.plain()
        try:
            write_json(folder / "state.json", plain)
        except OSError:
            kept = next((one for one in (folder / _USED, folder / _RESERVE) if one.exists()), None)
            text = json.dumps(plain, ensure_ascii=False).encode().ljust(RESERVE)
            if kept is None or len(text) > RESERVE:
                raise
            with kept.open("r+b") as file:         # written in place: this needs no new disk space
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            kept.replace(folder / _USED)
        else:
            (folder / _USED).unlink(missing_ok=True)

    def reserve(self, run: str) -> None:
        """Reserve disk space for the run's status until `release`; none if the disk is full."""
        with suppress(OSError):
            (self.runs / run / _RESERVE).write_bytes(b" " * RESERVE)

    def release(self, run: str) -> None:
        """Free the reserved disk space."""
        with suppress(OSError):
            (self.runs / run / _RESERVE).unlink(missing_ok=True)

    def signed_off(self, run: str) -> dict[str, Any] | None:
        """Return who signed off a stop that was not confirmed, when, and the note; None if no user did."""
        return read_json(self.place(run) / "signed_off.json")

    def sign_off(self, run: str, who: str, note: str) -> None:
        write_json(self.place(run) / "signed_off.json", {"by": who, "at": now(), "note": note})

    def replays(self, run: str) -> list[tuple[str, dict[str, Any]]]:
        """Return (name, document) of each replay, in the order of creation."""
        folder = self.place(run) / "replays"
        found = [(path.stem, read_json(path)) for path in sorted(folder.glob("[0-9]*.json"))]
        return [(name, plain) for name, plain in found if plain is not None]


# ---------------------------------------------------------------------------------------------------------------------
# The index: for lists and filters over thousands of runs. Nothing that concerns a shaft waits for it.


_COLUMNS: Final = tuple(Summary.__dataclass_fields__)
_VERSION: Final = 7
CHOSEN: Final = ("rig", "verdict", "acceptance", "tags")
"""Columns whose values a page offers as a choice."""
BATCH: Final = 100
"""Runs that are written to the index under its lock at a time: 5 to 20 ms, after their files were read without it."""


class Index:
    """Index of runs, for any thread. index.sqlite has a rollback journal, since a copy may lose files beside it."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._path = store.folder / "index.sqlite"
        self._lock = threading.Lock()
        self._making = threading.Lock()
        self._changed: set[str] = set()        # runs with a newer row than a rebuild in progress may have read
        self._made_anew = False                # whether the last `_open` made empty tables
        self._checked: tuple[int, int] | None = None           # device and inode of the file that has this version

    def put(self, summary: Summary) -> None:
        """Add or replace a row. Raises sqlite3.Error if it is locked or the disk is full; the files stay correct."""
        self._ensure()
        with self._lock, closing(self._open()) as base, base:
            self._note_change(summary.id)
            self._put(base, summary)

    def remove(self, run: str) -> None:
        """Remove a row, if it exists. Raises sqlite3.Error."""
        self._ensure()
        with self._lock, closing(self._open()) as base, base:
            self._note_change(run)
            base.execute("delete from runs where id = ?", (run,))

    def find(
        self, wanted: RunFilter | None = None, *, order: Order = NEWEST, limit: int = 100, offset: int = 0,
        without: Collection[str] = (), **conditions: Any,
    ) -> list[Summary]:
        """Return matching rows, the newest first. Raises sqlite3.Error.

        ``conditions``: those of `RunFilter`, in place of ``wanted``. ``without``: ids of runs that are left out. During
        `rebuild`, the rows are those of the former index, or without one the newest so far.
        """
        clause, values = (wanted or RunFilter(**conditions)).sql(without)
        rows = self._rows(f"select {', '.join(_COLUMNS)} from runs {clause} {order.sql} limit ? offset ?",
                          (*values, limit, offset))
        found = []
        for row in rows:
            plain = dict(zip(_COLUMNS, row, strict=True))
            flags = {name: bool(plain[name]) for name in ("simulated", "rehearsal", "uploaded", "archived")}
            tags = tuple(filter(None, plain["tags"].split(", ")))
            found.append(Summary(**{**plain, **flags, "tags": tags}))
        return found

    def count(self, wanted: RunFilter, without: Collection[str] = ()) -> int:
        """Return the number of matching rows. Raises sqlite3.Error."""
        clause, values = wanted.sql(without)
        return int(self._rows(f"select count(*) from runs {clause}", values)[0][0])

    def choices(self) -> dict[str, set[str]]:
        """Return the values of the columns of `CHOSEN` in the rows of all runs. Raises sqlite3.Error."""
        rows = self._rows(f"select distinct {', '.join(CHOSEN)} from runs")
        found = {name: {str(row[place]) for row in rows if row[place]} for place, name in enumerate(CHOSEN)}
        return {**found, "tags": {tag for text in found["tags"] for tag in text.split(", ")}}

    def _rows(self, sql: str, values: Sequence[Any] = ()) -> list[Any]:
        self._ensure()
        with self._lock, closing(self._open()) as base:
            return base.execute(sql, values).fetchall()

    def wait_until_made(self, within_s: float) -> bool:
        """Wait for a rebuild in progress. Return whether the index has every run."""
        made = self._making.acquire(timeout=within_s)
        if made:
            self._making.release()
        return made

    def rebuild(self) -> int:
        """Make the index again from the files. Return the number of runs.

        The files are read without the lock. It is held for `BATCH` rows at a time, so that a list waits for one batch.
        """
        with self._making:
            return self._rebuild()

    def _rebuild(self) -> int:
        with self._lock:
            self._changed.clear()
            try:
                with closing(self._open()) as base:
                    sound = base.execute("pragma quick_check(1)").fetchone() == ("ok",)
            except sqlite3.OperationalError:           # locked, or the disk is full: no reason to delete it
                raise
            except sqlite3.DatabaseError:
                sound = False
            if not sound:
                self._path.unlink(missing_ok=True)
        ids = self._store.ids()
        count = 0
        for start in range(0, len(ids), BATCH):
            found = []
            for run in ids[start : start + BATCH]:
                with suppress(NotThere):
                    found.append(self._store.summary(run))
            count += len(found)
            with self._lock, closing(self._open()) as base, base:
                for summary in found:
                    if summary.id not in self._changed:
                        self._put(base, summary)
        with self._lock, closing(self._open()) as base, base:
            gone = {run for (run,) in base.execute("select id from runs")} - set(ids) - self._changed
            base.executemany("delete from runs where id = ?", ((run,) for run in gone))
        return count

    def _note_change(self, run: str) -> None:
        if self._making.locked():
            self._changed.add(run)

    def _ensure(self) -> None:
        """Make an index that is missing or of another version, unless another thread does so now."""
        with suppress(OSError):
            found = self._path.stat()
            if found.st_size and (found.st_dev, found.st_ino) == self._checked:
                return
        if not self._making.acquire(blocking=False):
            return
        try:
            with self._lock, closing(self._open()) as base:
                made = self._made_anew
                base.execute("select 1 from runs limit 1")
            if made:
                self._rebuild()
        finally:
            self._making.release()

    def _open(self) -> sqlite3.Connection:
        """Return the open index; empty tables if it is missing or of another version. The lock is held."""
        base = sqlite3.connect(self._path, timeout=0.5)
        try:
            base.execute("pragma journal_mode = delete")
            base.execute("pragma synchronous = full")
            (version,) = base.execute("pragma user_version").fetchone()
            self._made_anew = version != _VERSION
            if self._made_anew:
                with base:
                    base.execute("drop table if exists runs")
                    columns = ", ".join((*_COLUMNS[1:], SEARCHED_COLUMN))
                    base.execute(f"create table runs (id text primary key, {columns})")
                    base.execute("create index by_rig on runs (rig, id)")
                    base.execute(f"pragma user_version = {_VERSION}")
            found = self._path.stat()
            self._checked = found.st_dev, found.st_ino
        except BaseException:
            base.close()
            raise
        return base

    @staticmethod
    def _put(base: sqlite3.Connection, summary: Summary) -> None:
        # The tags are one text in the index, and so is all that a search looks in.
        plain = {**summary.__dict__, "tags": ", ".join(summary.tags), SEARCHED_COLUMN: summary.searched}
        base.execute(f"insert or replace into runs ({', '.join(plain)}) values ({', '.join('?' * len(plain))})",
                     tuple(plain.values()))
