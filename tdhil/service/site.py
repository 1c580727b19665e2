"""The service behind the web, as each route uses it. It returns plain views, and is independent of HTTP."""

from __future__ import annotations

import asyncio
import secrets
import sqlite3
import threading
from collections.abc import Callable, Coroutine, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Literal, TypeVar
from urllib.parse import quote

import anyio
from prometheus_client import CollectorRegistry, Counter, Gauge

from tdhil.config import STATED
from tdhil.errors import TdhilError
from tdhil.service.acceptance_signature import FILE as SIGNATURE_FILE
from tdhil.service.access import Access
from tdhil.service.document_cache import DocumentCache
from tdhil.service.evidence_request import ABOUT, ARCHIVE, EvidenceView
from tdhil.service.fleets import Fleets
from tdhil.service.letterhead import outdated_reports
from tdhil.service.limits import UPLOAD_LIMIT
from tdhil.service.live_feed import Feeds
from tdhil.service.records import RunRecords
from tdhil.service.run_channel import lives
from tdhil.service.run_filter import NEWEST, Order, RunFilter, Summary
from tdhil.service.run_state import NotThere, State, Status, Told
from tdhil.service.schemas import ReplayView, RigView, RunsPageView, RunView, adapter
from tdhil.service.start_request import RigFile
from tdhil.service.store import CHOSEN, LOG, RECOVERED, read_as, read_json
from tdhil.service.supervisor import Supervisor, service_ended
from tdhil.service.uploads import TRACE, Uploads
from tdhil.session import Holder

T = TypeVar("T")
Ahead = Mapping[str, Summary | None]
"""Rows of the runs that are ahead of the index, by id; None for a deleted run, whose entry the index still has."""
STOPS: Final = 16
"""Number of threads for stops that are started in advance. Each further stop starts a thread of its own."""
LEASES: Final = 8
"""Number of threads for leases of watched runs, in addition to the web's other threads."""


NO_RIG: Final = "Uploaded recording"
"""Title of a run without a rig."""
WHOLE_INDEX_S: Final = 30.0
"""Longest wait of a trend for an index that is being made, s: 10,000 runs take about 10 s. A list does not wait."""
PAGE_RUNS: Final = 100
"""Number of runs on a page of the list."""
BEGUN_BY: Final = "begun_by"
"""Key of a waiting replay's file: the start of the service that accepted it."""
TREND_RUNS: Final = 1000
"""Number of latest runs in a trend."""


def _local(asked: str) -> str:
    """Return a time in UTC as local time with its zone, the format of each text of a trend."""
    return datetime.fromisoformat(asked).astimezone().isoformat(timespec="seconds")


class Metrics:
    """Metrics for Prometheus."""

    def __init__(self) -> None:
        found = self.registry = CollectorRegistry()
        self.runs_asked = Counter("tdhil_runs_asked", "Runs that were requested, without rehearsals", registry=found)
        self.rehearsals_asked = Counter("tdhil_rehearsals_asked", "Rehearsals of faults that were requested",
                                        registry=found)
        self.stops_asked = Counter("tdhil_stops_asked", "Stops that were requested", registry=found)
        self.live = Gauge("tdhil_runs_live", "Runs that have not ended, without rehearsals", registry=found)
        self.rehearsed = Gauge("tdhil_rehearsals_live", "Rehearsals that have not ended", registry=found)
        self.viewers = Gauge("tdhil_live_viewers", "Pages that watch a run", registry=found)
        self.relayed = Gauge("tdhil_foxglove_viewers", "Viewers that are sent a log as it grows", registry=found)
        self.unsigned = Gauge("tdhil_rigs_blocked", "Rigs whose last stop is not signed off", registry=found)


class Site:
    """All parts of one service. ``access``: roles and logins.

    ``logs``: folders, by name, whose logs may be identified again. ``upload_limit``: largest uploaded file, bytes.
    """

    def __init__(
        self, supervisor: Supervisor, *, access: Access | None = None,
        logs: Mapping[str, Path] = MappingProxyType({}), upload_limit: int = UPLOAD_LIMIT,
    ) -> None:
        self.supervisor, self.store = supervisor, supervisor.store
        self.access = access or Access(self.store.folder)
        self.access.changed = lambda what, name: supervisor.note("terminal", what, None, None, name=name)
        self.fleets = Fleets(self.store, logs, supervisor.turning)
        self.uploads = Uploads(self.store, supervisor.note, upload_limit)
        self.feeds = Feeds()
        self.metrics = Metrics()
        self.relays = 0
        self.leases = anyio.CapacityLimiter(LEASES)
        self.logins = anyio.CapacityLimiter(1)         # limit of simultaneous password checks: each takes 32 MB
        self.waiting_replays: dict[tuple[str, str], ReplayView] = {}
        self.replay_names = threading.Lock()
        self.start_id = secrets.token_hex(8)
        self.records = RunRecords(supervisor, lambda run: any(one == run for one, _ in tuple(self.waiting_replays)))
        self.tasks: set[asyncio.Task[Any]] = set()
        self._stops = ThreadPoolExecutor(STOPS, "stop")
        self._stopping = 0
        self._shared_stops: dict[str, asyncio.Task[Any]] = {}
        self._documents = DocumentCache(self.store.runs)
        self._works = anyio.CapacityLimiter(1)         # computations that a page waits for, one at a time
        self._replays = anyio.CapacityLimiter(1)       # slow computations, so that no plan waits for them
        self._previews = anyio.CapacityLimiter(1)      # a large upload takes long to read

    def begin_stops(self) -> None:
        """Start the threads for stops: on a busy computer, a thread may take 200 ms to start."""
        there = threading.Barrier(STOPS + 1)
        for _ in range(STOPS):
            self._stops.submit(there.wait)
        there.wait()

    async def at_once(self, stop: Callable[[], T]) -> T:
        """Run a stop in a thread of its own: it never waits for a computation, a download, the index or another stop.

        The first `STOPS` threads run already. Above them, a thread is started, which may take 200 ms.
        """
        self._stopping += 1
        try:
            if self._stopping <= STOPS:
                return await asyncio.get_running_loop().run_in_executor(self._stops, stop)
            found: T = await anyio.to_thread.run_sync(stop, limiter=anyio.CapacityLimiter(1))
            return found
        finally:
            self._stopping -= 1

    async def shared_stop(self, what: str, stop: Callable[[], T], joined: Callable[[], None]) -> T:
        """Run a stop as `at_once`. If a stop of ``what`` is in progress, call ``joined`` and wait for that one.

        So many requests to stop one shaft occupy one thread.
        """
        task: asyncio.Task[T] | None = self._shared_stops.get(what)
        if task is None:
            task = self._shared_stops[what] = asyncio.get_running_loop().create_task(self.at_once(stop))
            task.add_done_callback(lambda _: self._shared_stops.pop(what))
        else:
            joined()
        return await asyncio.shield(task)          # a client that disconnects ends no stop

    def in_background(self, work: Coroutine[Any, Any, T]) -> asyncio.Task[T]:
        """Begin work that no request waits for. Return its task."""
        task = asyncio.get_running_loop().create_task(work)
        self.tasks.add(task)
        task.add_done_callback(self.tasks.discard)
        return task

    def stop_beside(self, run: str, holder: Holder | None, who: str) -> asyncio.Task[tuple[int, str]] | None:
        """Begin to stop the drive of a run that another program holds. Return the stop; None without a holder."""
        if holder is None:
            return None
        return self.in_background(self.shared_stop(
            f"beside {run}", partial(self.supervisor.stop_beside, run, holder, who),
            lambda: self.supervisor.note(who, "stop asked", run, None, joined=True)))

    async def work(self, what: str, run: str | None, asked: Mapping[str, Any]) -> dict[str, Any]:
        """Compute a task, one at a time. Return its document; from the cache if it can't differ. Raises Refused."""
        key = self._documents.key(what, asked)
        if (kept := self._documents.get(key)) is not None:
            return kept
        work, limiter = partial(self.supervisor.work, what, run, asked), self._works
        if what in ("replay", "calibrate", "upload", "evidence"):
            limiter = self._replays
        if what == "preview":
            limiter = self._previews
        found: dict[str, Any] = (await anyio.to_thread.run_sync(work, limiter=limiter))["document"]
        self._documents.put(key, found)
        return found

    def rig_views(self, rigs: Iterable[RigFile]) -> list[RigView]:
        """Return the views of rigs. The files of the runs ahead of the index are read once for all of them."""
        live = self._ahead_of_the_index()
        return [self.rig_view(one, live) for one in rigs]

    def rig_view(self, rig: RigFile, live: Ahead | None = None) -> RigView:
        """Return the view of a rig, with its present user and its last run. ``live``: rows ahead of the index."""
        run, blocked = self.supervisor.run_of(rig.id), self.supervisor.blocking_run(rig)
        if rig.rig is None:
            return RigView(rig.id, rig.id, "unusable", False, "never", rig.problem, run=run, blocked_by=blocked)
        try:
            options, connection = rig.way()
            simulated = options.simulate or not connection.configured
            drive, profile, problem = connection.drive, connection.profile.name, ""
        except TdhilError as error:
            return RigView(rig.id, rig.name, "unusable", False, rig.rig.service.motion, str(error), run=run,
                           blocked_by=blocked)
        holder = self.supervisor.holder(rig)
        state: Literal["free", "busy", "held", "blocked"]
        state = "busy" if run else "held" if holder else "blocked" if blocked else "free"
        wanted = RunFilter(rig.id, answered=True, rehearsal=False, uploaded=False)
        last = next(iter(self.find_runs(wanted, limit=1, live=live)), None)
        from tdhil.config import simulated_default_rig

        bench = simulated_default_rig(rig.rig) if simulated else rig.rig
        limits = None if bench.limits is None else bench.limits.model_dump()
        return RigView(
            rig.id, rig.name, state, simulated, rig.motion, problem, None if holder is None else str(holder), run,
            blocked, drive, profile, limits, last,
        )

    def find_runs(
        self, wanted: RunFilter, order: Order = NEWEST, *, limit: int = 100, offset: int = 0,
        live: Ahead | None = None,
    ) -> list[Summary]:
        """Return runs from the index; from the files if the index is missing or out of date, as for a live run.

        ``live``: the rows of the runs that are ahead of the index; None: they are read now.
        """
        live = self._ahead_of_the_index() if live is None else live
        ahead = [one for one in live.values() if one is not None and wanted.contains(one)]
        first = max(0, offset - len(ahead))        # rows of live runs move a row of the index by their number at most
        try:
            ended = self.supervisor.index.find(
                wanted, order=order, limit=limit + offset - first, offset=first, without=live)
        except (sqlite3.Error, OSError):
            first, ended = 0, [one for one in self.store.summaries() if one.id not in live and wanted.contains(one)]
        return order.sorted((*ahead, *ended))[offset - first : offset - first + limit]

    def runs_page(self, wanted: RunFilter, order: Order, page: int) -> RunsPageView:
        """Return a page of the list of runs, with the number of all that meet the conditions, and the choices."""
        live = self._ahead_of_the_index()
        total = self._count_runs(live, wanted)
        try:
            choices = self.supervisor.index.choices()
        except (sqlite3.Error, OSError):
            choices = {name: set() for name in CHOSEN}
        found = self.find_runs(wanted, order, limit=PAGE_RUNS, offset=(page - 1) * PAGE_RUNS, live=live)
        newest = wanted.until or next(
            (one.id for one in self.find_runs(RunFilter(archived=True), limit=1, live=live)), None)
        rigs = choices["rig"] | {one.rig for one in live.values() if one is not None and one.rig}
        return RunsPageView(
            found, total, page, max(1, -(-total // PAGE_RUNS)), (page - 1) * PAGE_RUNS + 1 if found else 0, newest,
            sorted(rigs), sorted(choices["verdict"]), sorted(choices["tags"], key=str.casefold),
            sorted(choices["acceptance"]))

    def _count_runs(self, live: Ahead, wanted: RunFilter) -> int:
        ahead = sum(one is not None and wanted.contains(one) for one in live.values())
        try:
            return ahead + self.supervisor.index.count(wanted, live)
        except (sqlite3.Error, OSError):
            return ahead + sum(wanted.contains(one) for one in self.store.summaries() if one.id not in live)

    def _ahead_of_the_index(self) -> Ahead:
        """Return the rows of the runs whose index entry is missing or out of date, from the files."""
        found: dict[str, Summary | None] = {}
        for run in self.supervisor.ahead_of_the_index():
            found[run] = None
            with suppress(NotThere):
                found[run] = self.store.summary(run)
        return found

    def trend_rows(self, rig: str, *, archived: bool = False, rehearsals: bool = False) -> list[dict[str, Any]]:
        """Return the rows of a rig's history, each with the time of the run's request, as on every page.

        `tdhil.fleet.trend.history_rows` states which of them count. An uploaded recording has no row, since its
        identity is only stated by a person. A run that did not end as requested is a part of a run, also without a row.
        """
        self.supervisor.index.wait_until_made(WHOLE_INDEX_S)
        found, rehearsal = [], None if rehearsals else False
        wanted = RunFilter(rig, archived=archived, answered=True, rehearsal=rehearsal, uploaded=False)
        for one in self.find_runs(wanted, limit=TREND_RUNS):
            row = read_json(self.store.runs / one.id / "row.json")
            if one.state != State.DONE:
                row = {"log": one.id, "verdict": one.verdict, "rig": rig, "aborted_by": one.state, **(row or {})}
            if row is not None:
                found.append({**row, "date": _local(one.asked)})
        return found

    def left_out(self, rig: str, *, archived: bool, rehearsals: bool) -> list[str]:
        """Return which runs with J have no row in the rig's history, in words."""
        from tdhil.fleet import counted, rehearsals_left_out

        wanted, live = RunFilter(rig, archived=archived, answered=True), self._ahead_of_the_index()
        notes = []
        if uploaded := self._count_runs(live, replace(wanted, uploaded=True)):
            notes.append(f"{counted(uploaded, 'uploaded recording')}: left out")
        rehearsed = 0 if rehearsals else self._count_runs(live, replace(wanted, rehearsal=True, uploaded=False))
        return [*notes, rehearsals_left_out(rehearsed)] if rehearsed else notes

    def trends_around(self, rig: str, run: str) -> tuple[Mapping[str, Any], Mapping[str, Any]]:
        """Return the rig's trend without this run, and the trend with it."""
        rows = self.trend_rows(rig)
        before = [one for one in rows if one.get("log") != run]
        first, second = (
            self.supervisor.work("trend", None, {"rows": one, "rig": rig})["document"] if one else {}
            for one in (before, rows))
        return first, second

    def replays(self, run: str) -> list[ReplayView]:
        """Return the finished replays and the waiting ones. One that waited when the service ended has failed."""
        waiting = {name: one for (at, name), one in tuple(self.waiting_replays.items()) if at == run}
        made = {}
        for name, plain in self.store.replays(run):
            here = plain.pop(BEGUN_BY, None) == self.start_id
            one = made[name] = adapter(ReplayView).validate_python(plain)
            if one.state != "waiting":
                waiting.pop(name, None)
            elif not here:
                made[name] = replace(one, state="failed", error=Told.of(service_ended(f"replay {name}")))
        return [one for _, one in sorted((made | waiting).items())]

    def run_view(self, run: str, status: Status | None = None) -> RunView:
        """Return the view of a run. ``status``: the status that the run itself has just reported. Raises NotThere."""
        request, folder = self.store.request(run), self.store.place(run)
        status = status or self.store.status(run)
        rig_name = request.rig or NO_RIG
        with suppress(TdhilError):
            rig_name = self.supervisor.rig(request.rig).name
        annotations = self.store.annotations(run)
        found = [name for name in (LOG, TRACE, RECOVERED, "report.html", "result.json", "report.pdf",
                              ARCHIVE)
                 if (folder / name).is_file()]
        return RunView(
            request.id, request.rig, rig_name, status.state, status.stage, status.at,
            request.asked, request.asked_by, request.simulated if status.simulated is None else status.simulated,
            dict(request.options), list(status.history), dict(status.expected_s), list(status.preflight),
            status.identity, status.safe_action, status.confirmation, request.motion, status.watch, status.stop,
            status.error, status.exit_code, status.verdict,
            self.store.result(run), found, self.replays(run), read_json(folder / "signed_off.json"),
            lives(folder), request.rehearsal, None if status.rehearsal is None else dict(status.rehearsal),
            tags=list(annotations.tags), archived=annotations.archived, edits=list(annotations.edits),
            signature=self.records.signature(run),
            uploaded=None if request.uploaded is None else dict(request.uploaded),
            evidence=read_as(EvidenceView, folder / ABOUT),
            outdated=outdated_reports(folder, SIGNATURE_FILE, annotations),
            **{name: annotations.text(name, request.options) for name in STATED},
        )

    def broker_messages(self) -> dict[str, Any]:
        """Return the messages for a broker, by topic: each rig's state and latest result."""
        found: dict[str, Any] = {}
        for view in self.rig_views(self.supervisor.all_rigs()):
            run = None
            if view.run is not None:
                with suppress(NotThere):
                    status = self.store.status(view.run)
                    run = {"id": view.run, "state": status.state.value, "stage": status.stage, "since": status.at,
                           "rehearsal": self.store.rehearsed(view.run)}
            here = f"rigs/{quote(view.id, safe='')}"
            found[f"{here}/state"] = {
                "rig": view.id, "name": view.name, "state": view.state, "simulated": view.simulated,
                "holder": view.holder, "blocked_by": view.blocked_by, "run": run,
            }
            if view.last is not None:
                found[f"{here}/result"] = asdict(view.last)
        return found
