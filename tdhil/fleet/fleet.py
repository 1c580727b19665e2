"""Many logs, one table: the logs under some folders, identified by a pool or a cluster, and the results."""

from __future__ import annotations

import os
import stat
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Protocol

from tdhil.errors import LogError, MessageCode, TdhilError, UsageError
from tdhil.fleet.archive_mark import is_archived
from tdhil.fleet.rows import FleetRow, FleetSettings, failure_row, row_key
from tdhil.fleet.table import Journal, check_table_path, write_table
from tdhil.fleet.task import Done, LogTask, content_hash, identify_log, named_errors, remote, sidecar_of
from tdhil.process_pool import Loss, Pool, TaskLimits

_SLOWEST: Final = 5


@dataclass(frozen=True)
class FleetRequest:
    """Request for a fleet. ``roots``: folders, files, or URLs of them; ``out``: the table. ``jobs``: number of
    processes on this machine.

    ``scheduler``: address of a Dask cluster to use instead. ``cache``: keep recordings that were read beside the table;
    ``again``: identify all logs anew; ``retry_failed``: identify the failed ones anew. ``archived``: include runs that
    `tdhil serve` has archived; ``rehearsals``: include rehearsals of faults on the simulated drive.
    """

    roots: tuple[str, ...]
    out: Path
    settings: FleetSettings = field(default_factory=FleetSettings)
    jobs: int = 1
    scheduler: str | None = None
    limits: TaskLimits = field(default_factory=TaskLimits)
    cache: bool = True
    again: bool = False
    retry_failed: bool = False
    archived: bool = True
    rehearsals: bool = False

    @property
    def folder(self) -> Path:
        """Folder beside the table with the journal and the recordings."""
        return self.out.with_name(f"{self.out.name}.work")


@dataclass(frozen=True)
class FleetSummary:
    """Result of a fleet, rows by log. ``done_before``: number of rows that existed before; ``live``: of logs that are
    being written; ``bare_traces``: of CSV files without a sidecar; ``slowest``: log and CPU time in s; ``left``: number
    of logs still to do; ``archived``, ``rehearsals``: of archived runs and of rehearsals that were left out.
    """

    rows: tuple[FleetRow, ...]
    out: Path
    done_before: int = 0
    live: int = 0
    bare_traces: int = 0
    slowest: tuple[tuple[str, float], ...] = ()
    cpu_s: float = 0.0
    wall_s: float = 0.0
    left: int = 0
    archived: int = 0
    rehearsals: int = 0
    interrupted: bool = False

    def document(self) -> dict[str, Any]:
        """Return the document that ``--json`` prints."""
        changed = [row for row in self.rows if row.changed]
        return {
            "out": str(self.out),
            "logs": len(self.rows),
            "verdicts": dict(sorted(Counter(row.verdict for row in self.rows if not row.failed).items())),
            "failed": dict(sorted(Counter(row.error_kind for row in self.rows if row.failed).items(), key=str)),
            "failures": [{"log": row.log, "kind": row.error_kind, "text": row.error_text}
                         for row in self.rows if row.failed],
            "simulated": sum(row.simulated is True for row in self.rows),
            "rehearsed": sum(row.rehearsed_faults is not None for row in self.rows),
            "in_part": [
                {"log": row.log, "aborted_stage": row.aborted_stage, "aborted_by": row.aborted_by,
                 "complete": row.complete, "text": row.part_text}
                for row in self.rows if row.part_text is not None
            ],
            "changed": [
                {"log": row.log, "verdict": row.verdict, "stored_verdict": row.stored_verdict,
                 "inertia_kg_m2": row.inertia_kg_m2, "stored_inertia_kg_m2": row.stored_inertia_kg_m2}
                for row in changed
            ],
            "slowest": [{"log": log, "cpu_s": cpu_s} for log, cpu_s in self.slowest],
            "done_before": self.done_before, "live": self.live, "bare_traces": self.bare_traces, "left": self.left,
            "archived": self.archived, "rehearsals": self.rehearsals, "cpu_s": self.cpu_s, "wall_s": self.wall_s,
        }

    @property
    def exit_code(self) -> int:
        """Exit code. 0: every log has a result; 3: some have none, or are not done; 10: no log has a result.

        The log of a run that was refused before motion is complete although it has no result.
        """
        bad = sum(row.failed and not row.no_motion for row in self.rows)
        if self.rows and all(row.failed for row in self.rows):
            return 10
        return 3 if bad or self.left else 0


class Progress(Protocol):
    """Receiver of the progress."""

    def start(self, total: int, done: int) -> None:
        """Start the progress of ``total`` logs, of which ``done`` are done."""

    def done(self, row: FleetRow) -> None:
        """Count one finished log."""


def run_fleet(
    request: FleetRequest,
    progress: Progress | None = None,
    function: Callable[[LogTask], Done] = identify_log,
    stop: Callable[[], bool] | None = None,
) -> FleetSummary:
    """Identify all logs that are not done yet, and write the table.

    Ctrl-C ends it early, and so does ``stop``, which is called several times a second. Then the finished rows are in
    the table, `FleetSummary.interrupted` is True, and the same request does the rest. It may be called in any thread.

    Raises UsageError (no log found, a file that is not a table of a fleet, a cluster that doesn't fit) and LogBroken
    (disk full).
    """
    check_table_path(request.out, request.folder)
    began = time.monotonic()
    found = find_logs(request.roots, archived=request.archived)
    if not found.logs and not found.live:
        raise UsageError("no log is there", where=", ".join(request.roots),
                         next_step="Logs end in .mcap; a trace in .csv needs a .yaml of the same name beside it",
                         entry=MessageCode.NO_LOGS_FOUND)
    with Journal(request.folder) as journal, ExitStack() as stack:
        rows, todo = _known(request, journal, found.logs)
        before = len(rows)
        if progress is not None:
            progress.start(len(found.logs), before)
        taken: list[tuple[float, str]] = []
        interrupted = False
        try:
            results = _results(request, function, [task for task, _ in todo], stack, stop) if todo else iter(())
            stamps = {task.log: stamp for task, stamp in todo}
            for task, result in results:
                done = _lost(task, result) if isinstance(result, Loss) else result
                row = done.row
                key = None if row.sha256 is None else row_key(row.sha256, request.settings)
                journal.add(row, key, stamps[task.log])
                rows[task.log] = row
                taken.append((done.cpu_s, task.log))
                if progress is not None:
                    progress.done(row)
            interrupted = stop is not None and stop() and len(rows) < len(found.logs)
        except KeyboardInterrupt:
            interrupted = True
            stack.close()
        ordered = tuple(row for _, row in sorted(rows.items()) if request.rehearsals or row.rehearsed_faults is None)
        write_table(ordered, request.out)
    shown = {row.log for row in ordered}
    return FleetSummary(
        rows=ordered, out=request.out, done_before=before, live=len(found.live), bare_traces=len(found.bare_traces),
        archived=len(found.archived), rehearsals=len(rows) - len(ordered),
        slowest=tuple((log, cpu_s) for cpu_s, log in sorted(taken, reverse=True) if log in shown)[:_SLOWEST],
        cpu_s=sum(cpu_s for cpu_s, _ in taken), wall_s=time.monotonic() - began, left=len(found.logs) - len(rows),
        interrupted=interrupted,
    )


def _results(
    request: FleetRequest, function: Callable[[LogTask], Done], tasks: Sequence[LogTask], stack: ExitStack,
    stop: Callable[[], bool] | None,
) -> Iterator[tuple[LogTask, Done | Loss]]:
    if request.scheduler is not None:
        from tdhil.fleet.cluster import run_on_cluster

        cluster = run_on_cluster(function, tasks, request.scheduler, request.limits, stop)
        stack.callback(cluster.close)  # type: ignore[attr-defined]
        return cluster
    pool: Pool[LogTask, Done] = stack.enter_context(Pool(function, min(request.jobs, len(tasks)), request.limits))
    return pool.run(tasks, stop)


def _lost(task: LogTask, loss: Loss) -> Done:
    """Return the row of a log that hangs or ends its process. It has the hash of the content, so that the log isn't
    tried again.
    """
    facts: dict[str, Any] = {}
    if "://" not in task.log:
        with suppress(OSError):
            facts = {"sha256": content_hash(Path(task.log)), "size_bytes": Path(task.log).stat().st_size}
    return Done(failure_row(task.log, loss.kind, loss.text, task.settings, **facts))


Stamp = tuple[int, int] | None


def _known(
    request: FleetRequest, journal: Journal, logs: Sequence[str]
) -> tuple[dict[str, FleetRow], list[tuple[LogTask, Stamp]]]:
    """Return the existing rows by log, and the tasks left to do.

    A file that was not changed since is recognised by size and time. Another file is recognised by its content, if
    there are results to compare with.
    """
    cache = None
    if request.cache:
        folder = request.folder / "cache"
        with suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            cache = str(folder.absolute())
    rows: dict[str, FleetRow] = {}
    todo: list[tuple[LogTask, Stamp]] = []
    for log in logs:
        stamp = _stamp(log)
        row = None if request.again else _row(request, journal, log, stamp)
        if row is not None and not (row.failed and request.retry_failed):
            rows[log] = row
        else:
            todo.append((LogTask(log, request.settings, cache), stamp))
    return rows, todo


def _row(request: FleetRequest, journal: Journal, log: str, stamp: Stamp) -> FleetRow | None:
    if stamp is None or not journal.rows:
        return None
    sha256 = journal.hashes.get((log, *stamp))
    if sha256 is None:
        try:
            sha256 = content_hash(Path(log))
        except OSError:
            return None
    row = journal.rows.get(row_key(sha256, request.settings))
    return None if row is None else replace(row, log=log)


def _stamp(log: str) -> Stamp:
    """Return size in bytes and time of the last change in ns. For a trace, files in the same folder are included.

    For a URL, a number by which its file system distinguishes contents replaces the time.
    """
    if "://" in log:
        with suppress(OSError, TdhilError):
            system, inside = remote(log)
            with named_errors(log):
                return int(system.info(inside)["size"] or 0), int(system.ukey(inside), 16) >> 196
        return None
    path = Path(log)
    try:
        found = path.stat()
        size, changed_ns = found.st_size, found.st_mtime_ns
        if path.suffix.lower() == ".csv":
            for beside in sorted(path.parent.glob("*.yaml")):
                size += beside.stat().st_size
                changed_ns = max(changed_ns, beside.stat().st_mtime_ns)
    except OSError:
        return None
    return size, changed_ns


# ---------------------------------------------------------------------------------------------------------------------
# Search for logs


@dataclass(frozen=True)
class FoundLogs:
    """Logs in their order; logs that are being written; traces without a sidecar; logs of archived runs."""

    logs: tuple[str, ...]
    live: tuple[str, ...]
    bare_traces: tuple[str, ...]
    archived: tuple[str, ...] = ()


def find_logs(roots: Sequence[str], *, archived: bool = True) -> FoundLogs:
    """Return every .mcap, and every .csv with a sidecar, below the folders. A file that is named itself may have any
    ending. Without ``archived``, runs that `tdhil serve` has archived are left out.

    Raises UsageError for a root that does not exist. A folder that can't be listed is left out. A file that can't be
    read stays in the list and gets a row with its error later.
    """
    logs: set[str] = set()
    live: set[str] = set()
    bare: set[str] = set()
    for root in roots:
        if "://" in root:
            system, inside = remote(root)
            try:
                with named_errors(root):
                    names = [inside] if system.isfile(inside) else system.find(inside)
            except (OSError, LogError) as error:
                raise UsageError(f"can't be listed: {error}", where=root) from error
            logs.update(system.unstrip_protocol(name) for name in names if name.lower().endswith(".mcap"))
            continue
        path = Path(root)
        if path.is_file():
            _sort_in(path, logs, live, bare, named=True)
        elif path.is_dir():
            for folder, folders, names in os.walk(path):
                folders[:] = sorted(name for name in folders if not name.endswith(".work"))
                for name in names:
                    if name.lower().endswith((".mcap", ".csv")):
                        _sort_in(Path(folder) / name, logs, live, bare, named=False)
        else:
            raise UsageError("there is no such file or folder", where=root, next_step=_meant(path),
                             entry=MessageCode.FILE_NOT_FOUND)
    hidden = set() if archived else {one for one in logs if is_archived(one)}
    return FoundLogs(tuple(sorted(logs - hidden)), tuple(sorted(live)), tuple(sorted(bare)), tuple(sorted(hidden)))


def _meant(path: Path) -> str:
    """Return a suggestion if a similar name exists."""
    from difflib import get_close_matches

    with suppress(OSError):
        if close := get_close_matches(path.name, [one.name for one in path.parent.iterdir()], n=1):
            return f"Did you mean {path.parent / close[0]}?"
    return ""


def _sort_in(path: Path, logs: set[str], live: set[str], bare: set[str], *, named: bool) -> None:
    from tdhil.session import is_live

    with suppress(OSError):
        if not stat.S_ISREG(path.stat().st_mode):
            return                                     # reading from a pipe would wait for ever
    if path.suffix.lower() == ".csv" and not sidecar_of(path).is_file() and not named:
        bare.add(str(path))
    elif is_live(path):
        live.add(str(path))
    else:
        logs.add(str(path))
