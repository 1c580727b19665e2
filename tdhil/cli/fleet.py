"""`tdhil fleet` and `tdhil watch`: many logs identified into one table, once or as they arrive."""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from profiles.quantities import TIME
from tdhil.cli.arguments import add_left_out, add_option, add_settings, amount, settings_in
from tdhil.cli.results import print_json
from tdhil.config import OPTION
from tdhil.errors import ExitCode, MessageCode, UsageError

if TYPE_CHECKING:
    from rich.table import Table

    from tdhil.fleet import FleetRequest, FleetRow, FleetSummary

_SHOWN = 10         # failures and changes printed; the table has all of them


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of fleet."""
    parser.add_argument("logs", nargs="+", metavar="FOLDER|LOG",
                        help="folders with run.mcap files and traces (.csv with a .yaml of the same name), or files")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE",
                        help="the table: fleet.parquet (extra `fleet`), fleet.csv or fleet.sqlite")
    _add_settings(parser, "print the summary as one JSON document on stdout")
    where = parser.add_mutually_exclusive_group()
    _add_jobs(where)
    where.add_argument("--scheduler", metavar="tcp://HOST:8786", help="use a Dask cluster instead (extra `cluster`)")
    parser.add_argument("--again", action="store_true", help="identify all logs again, finished ones too")
    parser.add_argument("--retry-failed", action="store_true", help="retry logs that failed")
    parser.set_defaults(run=run)


LEAST_EVERY_S = 0.1
"""Least polling interval of `watch`, s."""


def add_watch_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of watch."""
    parser.add_argument("folder", type=Path, metavar="DIR", help="folder that receives logs, with its subfolders")
    parser.add_argument("--out", type=Path, metavar="FILE", help="the table (default: DIR/fleet.csv)")
    _add_settings(parser, "print one JSON document a line on stdout, for each log")
    _add_jobs(parser)
    parser.add_argument("--every", type=amount(TIME), default=2.0, metavar="S",
                        help=f"polling interval, at least {LEAST_EVERY_S:g} s (default 2 s)")
    parser.add_argument("--once", action="store_true", help="check once, then end")
    parser.set_defaults(run=run_watch)


def _add_settings(parser: argparse.ArgumentParser, json_help: str) -> None:
    add_settings(parser, "each run's")
    parser.add_argument("--time-limit", type=amount(TIME), default=120.0, metavar="S",
                        help="time limit for one log; a log that exceeds it twice is set aside (default 120 s)")
    parser.add_argument("--memory-limit", type=int, default=1500, metavar="MB",
                        help="memory limit for one log (default 1500 MB)")
    parser.add_argument("--no-cache", action="store_true", help="keep no recordings beside the table")
    add_left_out(parser, "left out")
    add_option(parser, OPTION["json"], help=json_help)


def _add_jobs(group: Any) -> None:
    group.add_argument("--jobs", type=int, metavar="N", help="parallel processes (default: one per processor core)")


def run(namespace: argparse.Namespace) -> int:
    """Identify, write the table, print the summary."""
    from tdhil.fleet import run_fleet

    request = _request(namespace, tuple(namespace.logs), namespace.out)
    with _Bar() as bar:
        summary = run_fleet(request, bar)
    _print(summary, namespace.json)
    return int(ExitCode.INTERRUPTED) if summary.interrupted else summary.exit_code


def run_watch(namespace: argparse.Namespace) -> int:
    """Identify new logs repeatedly until Ctrl-C."""
    from tdhil.report import PlainConsole

    folder: Path = namespace.folder
    if not folder.is_dir():
        raise UsageError("this folder does not exist", where=str(folder), entry=MessageCode.FILE_NOT_FOUND)
    if not namespace.every >= LEAST_EVERY_S:
        raise UsageError(f"{namespace.every:g} s is too short an interval", where="--every",
                         next_step=f"Give {LEAST_EVERY_S:g} s or more", entry=MessageCode.VALUE_NOT_ALLOWED)
    request = _request(namespace, (str(folder),), namespace.out or folder / "fleet.csv")
    watch = FolderWatch(request)
    if not namespace.once and sys.stderr.isatty():
        print(f"watching {folder}, table {request.out}; Ctrl-C ends it", file=sys.stderr)  # noqa: T201
    while True:
        for row in watch.look(at_once=namespace.once):
            if namespace.json:
                sys.stdout.write(json.dumps(asdict(row), ensure_ascii=False, allow_nan=False) + "\n")
            else:
                PlainConsole().print(f"{_log_text(row)}: {_result_text(row)}", soft_wrap=True)
            sys.stdout.flush()
        if namespace.once:
            return int(ExitCode.OK)
        time.sleep(namespace.every)


class FolderWatch:
    """Known logs, and finished ones. A file that grows without a lock (a copy in progress) is left until two checks
    find it unchanged.
    """

    def __init__(self, request: FleetRequest) -> None:
        self._request = request
        self._before: dict[str, tuple[int, int]] = {}
        self._done: dict[str, tuple[int, int]] = {}

    def look(self, *, at_once: bool = False) -> list[FleetRow]:
        """Return the rows of logs that are new since the last check, and add them to the table."""
        from tdhil.fleet import find_logs, run_fleet

        now = {log: _stamp(log) for log in find_logs(self._request.roots, archived=self._request.archived).logs}
        resting = {log: stamp for log, stamp in now.items() if at_once or self._before.get(log) == stamp}
        self._before = now
        if all(self._done.get(log) == stamp for log, stamp in resting.items()):
            return []
        summary = run_fleet(replace(self._request, roots=tuple(resting)))
        if summary.interrupted:
            raise KeyboardInterrupt
        fresh = [row for row in summary.rows if self._done.get(row.log) != resting.get(row.log)]
        self._done = resting
        return fresh


def _stamp(log: str) -> tuple[int, int]:
    try:
        found = Path(log).stat()
    except OSError:
        return 0, 0
    return found.st_size, found.st_mtime_ns


def _request(namespace: argparse.Namespace, roots: tuple[str, ...], out: Path) -> FleetRequest:
    from tdhil.fleet import FleetRequest, FleetSettings
    from tdhil.process_pool import TaskLimits, usable_cores

    if namespace.jobs is not None and not 1 <= namespace.jobs <= 1024:
        raise UsageError(f"{namespace.jobs}: must be from 1 to 1024", where="--jobs",
                         entry=MessageCode.VALUE_NOT_ALLOWED)
    if not namespace.time_limit > 0.0:
        raise UsageError(f"{namespace.time_limit:g}: must be a positive time", where="--time-limit",
                         entry=MessageCode.VALUE_NOT_ALLOWED)
    if not namespace.memory_limit >= 100:
        raise UsageError(f"{namespace.memory_limit}: must be at least 100 MB", where="--memory-limit",
                         entry=MessageCode.VALUE_NOT_ALLOWED)
    return FleetRequest(
        roots, out, FleetSettings(**settings_in(namespace)),
        jobs=namespace.jobs or usable_cores(),
        scheduler=getattr(namespace, "scheduler", None),
        limits=TaskLimits(namespace.time_limit, namespace.memory_limit * 1_000_000),
        cache=not namespace.no_cache, again=getattr(namespace, "again", False),
        retry_failed=getattr(namespace, "retry_failed", False), archived=namespace.archived,
        rehearsals=namespace.rehearsals,
    )


# ---------------------------------------------------------------------------------------------------------------------
# Progress, on stderr; results, on stdout


class _Bar:
    """A progress bar with the remaining time, on a terminal only."""

    def __init__(self) -> None:
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            TextColumn,
            TimeElapsedColumn,
            TimeRemainingColumn,
        )
        from rich.progress import Progress as RichProgress

        from tdhil.report import PlainConsole

        self._progress = RichProgress(
            TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
            TextColumn("left"), TimeRemainingColumn(), console=PlainConsole(sys.stderr), transient=True,
            disable=not sys.stderr.isatty(),
        )
        self._task = self._progress.add_task("logs", total=None)

    def start(self, total: int, done: int) -> None:
        self._progress.reset(self._task, total=total, completed=done)

    def done(self, row: FleetRow) -> None:
        self._progress.advance(self._task)

    def __enter__(self) -> _Bar:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()


def _print(summary: FleetSummary, as_json: bool) -> None:
    if as_json:
        print_json(summary.document())
        return
    from tdhil.fleet import counted
    from tdhil.recording import REHEARSAL
    from tdhil.report import SIMULATED, PlainConsole

    console = PlainConsole()
    found = summary.document()
    before = f" ({summary.done_before} of them finished before)" if summary.done_before else ""
    part = f"{found['logs']} of " if summary.left else ""
    logs = part + counted(found["logs"] + summary.left, "log")
    console.print(f"{logs}{before} in {summary.wall_s:.1f} s: {summary.out}", soft_wrap=True)
    if summary.left:
        why = "interrupted: " if summary.interrupted else ""
        console.print(f"{why}{summary.left} remaining; run the same command again")
    console.print(_counts(found))
    for count, mark in ((found["simulated"], SIMULATED), (found["rehearsed"], REHEARSAL)):
        if count:
            console.print(f"{count} of them {mark}", style="magenta")
    _list(console, "results", [
        f"{_log_text(row)}: {_result_text(row)}"
        for row in summary.rows if row.inertia_kg_m2 is not None])
    _list(console, "failed", [f"{one['log']}: {one['text']}" for one in found["failures"]])
    _list(console, "from a part of the run", [f"{one['log']}: {one['text']}" for one in found["in_part"]])
    _list(console, "different from the result in the log", [
        f"{one['log']}: {_was(one['stored_verdict'], one['stored_inertia_kg_m2'])} → "
        f"{_was(one['verdict'], one['inertia_kg_m2'])}" for one in found["changed"]])
    _list(console, "slowest", [f"{one['log']}: {one['cpu_s']:.2f} s of CPU" for one in found["slowest"]])
    if summary.live:
        console.print(f"skipped: {summary.live} being written")
    if summary.archived:
        console.print(f"left out: {counted(summary.archived, 'archived run')}; --archived includes them")
    if summary.rehearsals:
        console.print(f"left out: {counted(summary.rehearsals, 'rehearsal')} of faults; --rehearsals includes them")
    if summary.bare_traces:
        console.print(f"skipped: {counted(summary.bare_traces, 'CSV file')} without a .yaml of the same name")


def _counts(found: dict[str, Any]) -> Table:
    from rich.table import Table

    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(justify="right")
    table.add_column()
    for name, count in (*found["verdicts"].items(), *found["failed"].items()):
        table.add_row(str(count), name if name in found["verdicts"] else f"failed: {name}")
    return table


def _list(console: Any, title: str, lines: list[str]) -> None:
    if not lines:
        return
    console.print(f"{title}:")
    for line in lines[:_SHOWN]:
        console.print(f"  {line}", soft_wrap=True)
    if len(lines) > _SHOWN:
        console.print(f"  and {len(lines) - _SHOWN} more, in the table")


def _was(verdict: str, inertia_kg_m2: float | None) -> str:
    return verdict if inertia_kg_m2 is None else f"{verdict} {inertia_kg_m2:.5g} kg·m²"


def _log_text(row: FleetRow) -> str:
    """Return the name of the log after its marks."""
    from tdhil.report import marks

    return f"{marks(vars(row))} {row.log}".lstrip()


def _result_text(row: FleetRow) -> str:
    if row.failed:
        return f"failed: {row.error_text}"
    if row.inertia_kg_m2 is None:
        return f"{row.verdict}: {row.reason}"
    from tdhil.report import inertia_text

    low, high = row.inertia_low_total_kg_m2, row.inertia_high_total_kg_m2
    inertia = inertia_text({"value": row.inertia_kg_m2, "low": low, "high": high})
    part = "" if row.part_text is None else f", {row.part_text}"
    coverage = "" if row.confidence is None else f", {100.0 * row.confidence:g} % interval:"
    return f"{row.verdict}, J{coverage} {inertia}{part}"
