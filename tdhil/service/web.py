"""The web: the API, the live sockets and the pages, on one port. It opens no drive's bus and moves nothing itself.

A stop never waits for a computation, a download or the index: it has its own threads.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import re
import sqlite3
import sys
import threading
from collections.abc import Awaitable, Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, suppress
from dataclasses import asdict
from functools import cache, partial
from importlib.resources import files
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Literal, TypeVar
from urllib.parse import quote, urlencode

import anyio
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from prometheus_client import CollectorRegistry, Counter, Gauge, generate_latest
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.authentication import AuthenticationMiddleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, HTMLResponse, JSONResponse, RedirectResponse, Response, StreamingResponse
from starlette.routing import BaseRoute, Match, Mount, WebSocketRoute
from starlette.routing import Route as Way
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp
from starlette.websockets import WebSocket, WebSocketDisconnect

from tdhil.config import form_options
from tdhil.errors import LogError, MessageCode, TdhilError, UsageError
from tdhil.service import auth_routes, run_views
from tdhil.service.access import (
    SOCKET_LOOK_S,
    Access,
    address_of,
    principal,
    require,
    require_options,
)
from tdhil.service.accounts import Role
from tdhil.service.attendance import LEASE_S
from tdhil.service.audit import ChainHead
from tdhil.service.door import NO_DESCRIPTOR, Seldom
from tdhil.service.fleets import Fleets
from tdhil.service.foxglove import PROTOCOLS, Relay, Running
from tdhil.service.live_feed import Feed, Feeds
from tdhil.service.middleware import RequestGuard, body_of, error_response, off, status_of, told_of
from tdhil.service.run_channel import lives
from tdhil.service.run_state import (
    NotAllowed,
    NotLoggedIn,
    NotThere,
    State,
    Status,
    now,
)
from tdhil.service.schemas import (
    API,
    CSRF_HEADER,
    ROUTES,
    SOCKETS,
    AuditView,
    CompareView,
    HealthView,
    LeaseView,
    PlanView,
    ReplayView,
    RigFileView,
    RigView,
    Route,
    RunView,
    StoppedView,
    TrendView,
    adapter,
    document,
    plain,
)
from tdhil.service.start_request import EDITABLE, RigFile, options_of, require_motion, require_unwatched
from tdhil.service.store import Summary, read_json, write_json
from tdhil.service.supervisor import Supervisor
from tdhil.version import __version__

T = TypeVar("T")
HERE: Final = Path(str(files("tdhil.service")))
_ANSWERS: Final = {**run_views.ANSWERS, **auth_routes.ANSWERS}
LOOPBACK: Final = frozenset({"127.0.0.1", "localhost", "::1"})
_REPORT_POLICY: Final = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; sandbox allow-downloads"
_OF_HERE: Final = re.compile(r"/(?![/\\])[\x21-\x5b\x5d-\x7e]*")
"""Addresses to which a login may redirect."""
STOPS: Final = 16
"""Number of simultaneous stops, each in its own thread, which is started in advance."""
_GONE: Final = suppress(WebSocketDisconnect, RuntimeError)
"""Used around messages to a socket: its other end may disconnect at any time."""


class Web:
    """The application around one supervisor. ``hosts``: accepted host names; ``access``: roles and logins.

    ``viewers``: origins (``http://localhost:8080``) whose pages may read logs by the Foxglove protocol, and no more.
    ``logs``: folders, by name, whose logs may be identified again.
    """

    def __init__(
        self, supervisor: Supervisor, *, hosts: frozenset[str] = LOOPBACK, viewers: frozenset[str] = frozenset(),
        access: Access | None = None, logs: Mapping[str, Path] = MappingProxyType({}),
    ) -> None:
        self.supervisor, self.store = supervisor, supervisor.store
        self.access = access or Access(self.store.folder)
        self.access.changed = lambda what, name: supervisor.note("terminal", what, None, None, name=name)
        self.fleets = Fleets(self.store, logs, supervisor.turning)
        self.feeds = Feeds()
        self._complain = Seldom(supervisor.say)
        self._stops = ThreadPoolExecutor(STOPS, "stop")
        self._leases = anyio.CapacityLimiter(8)        # so has a watched run's lease
        self._works = anyio.CapacityLimiter(1)         # computations that a page waits for, one at a time
        self._replays = anyio.CapacityLimiter(1)       # slow ones, so that no plan waits behind them
        self.logins = anyio.CapacityLimiter(1)        # passwords too: each takes 32 MB
        self._waiting: dict[tuple[str, str], ReplayView] = {}
        self._made = threading.Lock()
        self._tasks: set[asyncio.Task[None]] = set()
        self._registry = CollectorRegistry()
        self._asked = Counter("tdhil_runs_asked", "Runs that were requested", registry=self._registry)
        self._stopped = Counter("tdhil_stops_asked", "Stops that were requested", registry=self._registry)
        self._live = Gauge("tdhil_runs_live", "Runs that have not ended", registry=self._registry)
        self._viewers = Gauge("tdhil_live_viewers", "Pages that watch a run", registry=self._registry)
        self._relays = 0
        self._relayed = Gauge("tdhil_foxglove_viewers", "Viewers that are sent a log as it grows",
                              registry=self._registry)
        self._unsigned = Gauge("tdhil_rigs_blocked", "Rigs whose last stop is not signed off",
                               registry=self._registry)
        self._pages = Environment(
            loader=FileSystemLoader(HERE / "templates"), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
            lstrip_blocks=True,
        )
        self._pages.globals["version"] = __version__
        self._pages.globals["form_options"] = form_options
        self.app = Starlette(routes=self._routes(), lifespan=self._lifespan,
                             middleware=[Middleware(AuthenticationMiddleware, backend=self.access)],
                             exception_handlers=dict.fromkeys((TdhilError, HTTPException, OSError, Exception),
                                                              self._failed))
        self.asgi: ASGIApp = RequestGuard(self.app, hosts, viewers)

    def _routes(self) -> list[BaseRoute]:
        api = [Way(f"{API}{route.path}", self._endpoint(route), methods=[route.method]) for route in ROUTES]
        at_the_root = [Way(route.path, self._endpoint(route), methods=["GET"]) for route in ROUTES
                       if route.name in ("health", "metrics")]
        pages = [
            Way("/", self._page("rigs.html", "rigs")),
            Way("/rigs/{rig}", self._page("history.html", "rigs")),
            Way("/rigs/{rig}/file", self._page("rig_file.html", "rigs")),
            Way("/start/{rig}", self._page("start.html", "rigs")),
            Way("/runs", self._page("runs.html", "runs")),
            Way("/runs/{run}", self._page("run.html", "runs")),
            Way("/runs/{run}/live", self._page("live.html", "runs")),
            Way("/calibrate/{rig}", self._page("calibrate.html", "rigs")),
            Way("/rehearse/{rig}", self._page("rehearse.html", "rigs")),
            Way("/compare", self._page("compare.html", "runs")),
            Way("/fleets", self._page("fleets.html", "fleets")),
            Way("/fleets/{fleet}", self._page("fleet.html", "fleets")),
            Way("/audit", self._page("audit.html", "audit", "admin")),
            Way("/accounts", self._page("accounts.html", "accounts", "viewer")),
            Way("/login", self._login_page),
            Way("/favicon.ico", lambda request: RedirectResponse("/static/icon.svg")),
        ]
        sockets: list[BaseRoute] = []
        for path, one in ((f"{base}{one.path}", one) for base in (API, "") for one in SOCKETS):
            sockets += [WebSocketRoute(path, self._socket(one.role, getattr(self, f"_{one.name}"))),
                        Way(path, self._no_socket(one.role))]
        return [*api, *at_the_root, *sockets, *pages, Mount("/static", StaticFiles(directory=HERE / "static"))]

    @asynccontextmanager
    async def _lifespan(self, app: Starlette) -> Any:
        self._begin_stops()
        await off(_openapi_text)               # takes 0.4 s: now, not while a stop waits
        await anyio.to_thread.run_sync(self.access.start)
        await anyio.to_thread.run_sync(self.supervisor.start)
        try:
            yield
        finally:
            await anyio.to_thread.run_sync(self.fleets.close)
            await anyio.to_thread.run_sync(self.access.close)
            await anyio.to_thread.run_sync(self.supervisor.close)

    def _begin_stops(self) -> None:
        """Start the threads for stops: on a busy computer, a thread may take 200 ms to start."""
        there = threading.Barrier(STOPS + 1)
        for _ in range(STOPS):
            self._stops.submit(there.wait)
        there.wait()

    async def _failed(self, request: Request, error: Exception) -> Response:
        if isinstance(error, OSError) and error.errno in NO_DESCRIPTOR:
            error = LogError(f"the service has no descriptor left ({error.strerror})", where=request.url.path[:100],
                             next_step="Repeat the request. Raise the limit of open files (LimitNOFILE, ulimit -n)")
            self._complain("A request failed: {}", error)
        elif not isinstance(error, TdhilError | HTTPException):
            import traceback

            traceback.print_exception(error, file=sys.stderr)
        path, status, headers = request.url.path, None, {}
        if isinstance(error, HTTPException) and error.status_code == 405:
            methods = ", ".join(sorted(self._methods(request)))
            error, status, headers = UsageError(
                f"supports {methods}, not {request.method[:20]}", where=path[:100],
                                                entry=MessageCode.REQUEST_WRONG), 405, {"allow": methods}
        elif isinstance(error, HTTPException) and error.status_code == 404:
            listed = f"See {API}/openapi.json" if path.startswith(API) else ""
            error = NotThere("this address does not exist", where=path[:100], next_step=listed)
        if path.startswith(API) or request.method != "GET":
            return error_response(error, status, headers)
        if isinstance(error, NotLoggedIn) and self.access.login:       # a page
            there = f"{request.url.path}?{request.url.query}" if request.url.query else request.url.path
            return RedirectResponse(f"/login?{urlencode({'next': there})}", 303)
        told = told_of(error).error
        return self._render(request, "error.html", "", status_of(error), told=told)

    def _methods(self, request: Request) -> set[str]:
        """Return the methods of an address, from all of its routes."""
        found = (one.methods for one in self.app.routes
                 if isinstance(one, Way) and one.matches(request.scope)[0] is not Match.NONE)
        return {method for methods in found for method in methods or ()}

    # -- the API -----------------------------------------------------------------------------------------------------

    def _endpoint(self, route: Route) -> Callable[[Request], Awaitable[Response]]:
        own = getattr(self, f"_{route.name}", None)
        answer: Callable[[Request, Any], Awaitable[Any]] = own or partial(_ANSWERS[route.name], self)
        first = next(iter(route.answers))

        async def serve(request: Request) -> Response:
            try:
                self._require(route, request)
                found = await answer(request, await body_of(request, route))
            except TdhilError as error:
                return error_response(error)
            except ClientDisconnect:           # during the request: no reply can reach the client
                return Response(status_code=400)
            if isinstance(found, Response):
                return found
            code, value = found if isinstance(found, tuple) else (first, found)
            return JSONResponse(plain(value, route.answers[code]), code)

        return serve

    def _require(self, route: Route, request: Request) -> None:
        sent = None if route.method == "GET" else request.headers.get(CSRF_HEADER, "")
        require(principal(request), route.role, route=route.name, open_here=not self.access.login, csrf=sent)

    async def _rigs(self, request: Request, body: Any) -> list[RigView]:
        return await off(lambda: [self.rig_view(rig) for rig in self.supervisor.rigs.all()])

    async def _rig(self, request: Request, body: Any) -> RigView:
        return await off(lambda: self.rig_view(self.supervisor.rigs.get(request.path_params["rig"])))

    async def _rig_file(self, request: Request, body: Any) -> RigFileView:
        return await off(lambda: _file_view(self.supervisor.rigs.get(request.path_params["rig"])))

    async def _edit_rig(self, request: Request, body: Any) -> RigFileView:
        rig, who = request.path_params["rig"], principal(request)
        if not who.known:
            raise NotAllowed("only a logged-in user may edit a rig's file", where=f"rig {rig}",
                             next_step="Edit the file on the service's computer, or add users")
        return await off(lambda: _file_view(self.supervisor.edit_rig(rig, body.text, body.sha256, who.name)))

    async def _plan(self, request: Request, body: dict[str, Any]) -> PlanView:
        rig = await off(lambda: self.supervisor.rigs.get(request.path_params["rig"]))
        options = options_of(body)
        await off(lambda: rig.way(options))
        asked = {"rig_file": str(rig.path.resolve()), "options": options}
        return PlanView(rig.id, rig.sha256, await self.work("plan", None, asked))

    async def _trend(self, request: Request, body: Any) -> TrendView:
        rig = await off(lambda: self.supervisor.rigs.get(request.path_params["rig"]))

        def rows() -> list[dict[str, Any]]:
            runs = self.list_runs(rig.id, "done", 1000)
            return [row for one in runs if (row := read_json(self.store.place(one.id) / "row.json")) is not None]

        found = await off(rows)
        if not found:
            nothing = {"rig": rig.id, "logs": 0, "results": 0, "notes": ["no run has a result yet"], "quantities": []}
            return TrendView(rig.id, nothing)
        asked = {"rows": found, "rig": rig.id}
        return TrendView(rig.id, await self.work("trend", None, asked))

    async def _compare(self, request: Request, body: Any) -> CompareView:
        runs = [one for one in request.query_params.get("runs", "").split(",") if one]
        if not 2 <= len(set(runs)) == len(runs) <= 8:
            raise UsageError("name two to eight different runs", where="runs", next_step="?runs=ID,ID",
                             entry=MessageCode.REQUEST_WRONG)
        for run in runs:
            if not (await off(partial(self.store.place, run)) / "run.mcap").is_file():
                raise NotThere("this run has no log", where=f"run {run}")
        asked = {"runs": runs, "runs_folder": str(self.store.runs)}
        return CompareView(runs, await self.work("compare", None, asked))

    async def _start(self, request: Request, body: dict[str, Any]) -> tuple[int, RunView]:
        key = request.headers.get("idempotency-key")
        if key is not None and not 1 <= len(key) <= 200:
            raise UsageError("must have 1 to 200 characters", where="Idempotency-Key", entry=MessageCode.REQUEST_WRONG)
        rig, who = request.path_params["rig"], principal(request)

        def check() -> None:
            found = self.supervisor.rigs.get(rig)
            require_motion(found)
            if not who.known:
                require_unwatched(found)
            require_options(who, options_of(body))

        await off(check)
        asked = await off(lambda: self.supervisor.start_run(rig, body, who.name, key, address_of(request)))
        if asked.new:
            self._asked.inc()
        return 201 if asked.new else 200, await off(lambda: self.run_view(asked.request.id))

    async def _stop_rig(self, request: Request, body: Any) -> StoppedView:
        rig_id, asking = request.path_params["rig"], principal(request)
        who = asking.name
        self._stopped.inc()

        def stop() -> StoppedView:
            rig = self.supervisor.rigs.get(rig_id)
            if (run := self.supervisor.run_of(rig_id)) is not None:
                self.supervisor.stop(run, who)
                return StoppedView(rig_id, [run])
            if "operator" not in asking.roles and self.supervisor.certainly_idle(rig):
                raise NotAllowed("no tdhil moves this rig: a stop would open its bus and act on a drive that another"
                                 " program may control", where=f"rig {rig_id}",
                                 next_step="Ask an operator. If the shaft turns, use the hard-wired stop")
            code, said = self.supervisor.stop_drive(rig, who)
            return StoppedView(rig_id, [], code, said)

        return await self._at_once(stop)

    async def _runs(self, request: Request, body: Any) -> Any:
        query = request.query_params
        limit = query.get("limit", "100")
        if not limit.isdecimal() or not 1 <= int(limit) <= 1000:
            raise UsageError("must be 1 to 1000", where="limit", entry=MessageCode.REQUEST_WRONG)
        if (state := query.get("state")) is not None and state not in set(State):
            raise UsageError(f"{state[:40]!r} is not a state", where="state",
                             next_step=f"States: {', '.join(State)}", entry=MessageCode.REQUEST_WRONG)
        return await off(lambda: self.list_runs(query.get("rig"), state, int(limit)))

    async def _run(self, request: Request, body: Any) -> RunView:
        return await off(lambda: self.run_view(request.path_params["run"]))

    async def _confirm(self, request: Request, body: Any) -> RunView:
        run, who = request.path_params["run"], principal(request).name
        code = body.code.replace(" ", "")
        _require_key(body.lease, "lease")
        await off(lambda: self.supervisor.confirm(run, code, body.binding, who, body.lease))
        return await off(lambda: self.run_view(run))

    async def _renew(self, request: Request, body: Any) -> LeaseView:
        run, who = request.path_params["run"], principal(request).name
        _require_key(body.key, "key")
        _require_key(body.new_key, "new_key")
        renew = partial(self.supervisor.renew, run, body.key, who, new_key=body.new_key, gone=body.gone)
        return LeaseView(run, await anyio.to_thread.run_sync(renew, limiter=self._leases), LEASE_S)

    async def _stop(self, request: Request, body: Any) -> RunView:
        run, who = request.path_params["run"], principal(request).name
        self._stopped.inc()
        return await self._at_once(lambda: self.run_view(run, self.supervisor.stop(run, who)))

    async def _at_once(self, stop: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._stops, stop)

    async def _sign_off(self, request: Request, body: Any) -> RunView:
        run, who = request.path_params["run"], principal(request).name
        if not body.note.strip() or len(body.note) > 500:
            raise UsageError("must be 1 to 500 characters: state what you saw", where="note",
                             entry=MessageCode.REQUEST_WRONG)
        await off(lambda: self.supervisor.sign_off(run, who, body.note))
        return await off(lambda: self.run_view(run))

    async def _ask_replay(self, request: Request, body: Any) -> tuple[int, ReplayView]:
        run, who = request.path_params["run"], principal(request).name
        asked = run_views.settings_of(body)
        view = await off(lambda: self._new_replay(run, asked, who))
        rig = (await off(lambda: self.store.request(run))).rig
        self.supervisor.note(who, f"replay {view.name} asked", run, rig, options=asked)
        task = asyncio.get_running_loop().create_task(self._replay_later(run, view))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return 202, view

    def _new_replay(self, run: str, asked: dict[str, Any], who: str) -> ReplayView:
        folder = self.store.place(run)
        if not self.store.status(run).ended or not (folder / "run.mcap").is_file():
            raise UsageError("the run has no finished log", where=f"run {run}", next_step="Wait until it has ended",
                             entry=MessageCode.NOT_READY)
        with self._made:
            (folder / "replays").mkdir(exist_ok=True)
            taken = [int(name) for name, _ in self.store.replays(run)] + [
                int(name) for at, name in self._waiting if at == run]
            view = ReplayView(f"{max(taken, default=0) + 1:03d}", asked, now(), who, "waiting")
            self._waiting[run, view.name] = view
        return view

    async def _replay_later(self, run: str, view: ReplayView) -> None:
        """Run a replay once no shaft of this service may turn."""
        while await off(self.supervisor.turning):
            await anyio.sleep(0.5)
        try:
            found = await self.work("replay", run, view.asked)
            done = ReplayView(view.name, view.asked, view.at, view.by, "done", found)
        except TdhilError as error:
            done = ReplayView(view.name, view.asked, view.at, view.by, "failed", error=told_of(error).error)
        path = self.store.place(run) / "replays" / f"{view.name}.json"
        try:
            await off(lambda: write_json(path, plain(done, ReplayView)))
        except OSError as error:
            lost = told_of(LogError(f"the replay can't be written ({error.strerror or error})", where=path.name)).error
            self._waiting[run, view.name] = ReplayView(view.name, view.asked, view.at, view.by, "failed", error=lost)
        else:
            self._waiting.pop((run, view.name), None)

    async def _replay(self, request: Request, body: Any) -> ReplayView:
        run, name = request.path_params["run"], request.path_params["replay"]
        found = next((one for one in await off(lambda: self.replays(run)) if one.name == name), None)
        if found is None:
            raise NotThere("this replay does not exist", where=f"run {run[:40]}")
        return found

    async def _log(self, request: Request, body: Any) -> Response:
        return await self.file(request, "run.mcap", "application/octet-stream")

    async def _report(self, request: Request, body: Any) -> Response:
        response = await self.file(request, "report.html", "text/html", shown=True)
        response.headers["content-security-policy"] = _REPORT_POLICY
        return response

    async def _report_pdf(self, request: Request, body: Any) -> Response:
        run = request.path_params["run"]
        folder = await off(lambda: self.store.place(run))
        if not (folder / "report.pdf").exists() and (folder / "result.json").exists():
            await self.work("report", run, {"name": "report.pdf"})
        return await self.file(request, "report.pdf", "application/pdf")

    async def work(self, what: str, run: str | None, asked: Mapping[str, Any]) -> dict[str, Any]:
        """Compute a task, one at a time. Return its document. Raises Refused."""
        work, limiter = partial(self.supervisor.work, what, run, asked), self._works
        if what in ("replay", "calibrate"):
            limiter = self._replays
        found: dict[str, Any] = (await anyio.to_thread.run_sync(work, limiter=limiter))["document"]
        return found

    async def _result(self, request: Request, body: Any) -> Response:
        return await self.file(request, "result.json", "application/json")

    async def file(self, request: Request, name: str, media: str, *, shown: bool = False) -> Response:
        """Return a file of the run, as a download (or ``shown``). Raises NotThere."""
        run, who = request.path_params["run"], principal(request).name
        path = (await off(lambda: self.store.place(run))) / name
        if not path.is_file():
            raise NotThere(f"this run has no {name}", where=f"run {run}", next_step="Wait until the run has ended")
        rig = (await off(lambda: self.store.request(run))).rig
        if request.method == "GET":
            self.supervisor.note(who, f"downloaded {name}", run, rig)
        called = f"{rig}-{run}-{name}"
        grows = name == "run.mcap" and not (await off(lambda: self.store.status(run))).ended
        if grows and ("range" not in request.headers or "if-range" in request.headers):
            said = {"content-disposition": f'attachment; filename="{called}"'}
            return StreamingResponse(_as_it_is(path), media_type=media, headers=said)
        return FileResponse(path, media_type=media, filename=None if shown else called)

    async def _audit(self, request: Request, body: Any) -> AuditView:
        limit = request.query_params.get("limit", "200")
        if not limit.isdecimal() or not 1 <= int(limit) <= 5000:
            raise UsageError("must be 1 to 5000", where="limit", entry=MessageCode.REQUEST_WRONG)

        given = request.query_params.get("head")
        kept = None if given is None else ChainHead.of(given)

        def look() -> AuditView:
            audit = self.supervisor.audit
            entries, broken, head = list(audit.entries()), audit.verify(kept), audit.head()
            return AuditView(entries[-int(limit):][::-1], broken, None if head is None else str(head), audit.made())

        return await off(look)

    # -- health ---------------------------------------------------------------------------------------------------

    async def _health(self, request: Request, body: Any) -> HealthView:
        rigs = await off(self.supervisor.rigs.all)
        live = self.supervisor.live() if principal(request).roles else []
        return HealthView("ok", __version__, live, len(rigs))

    async def _metrics(self, request: Request, body: Any) -> Response:
        self._live.set(len(self.supervisor.live()))
        self._viewers.set(self.feeds.viewers)
        self._relayed.set(self._relays)
        views = await off(lambda: [self.rig_view(rig) for rig in self.supervisor.rigs.all()])
        self._unsigned.set(sum(one.state == "blocked" for one in views))
        return Response(generate_latest(self._registry), media_type="text/plain; version=0.0.4; charset=utf-8")

    async def _openapi(self, request: Request, body: Any) -> Response:
        return Response(_openapi_text(), media_type="application/json")

    # -- views -----------------------------------------------------------------------------------------

    def rig_view(self, rig: RigFile) -> RigView:
        """Return a rig, with its present user and its last run."""
        if rig.rig is None:
            return RigView(rig.id, rig.id, "unusable", False, "never", rig.problem)
        try:
            options, connection = rig.way()
            simulated = options.simulate or not connection.configured
            drive, profile, problem = connection.drive, connection.profile.name, ""
        except TdhilError as error:
            return RigView(rig.id, rig.name, "unusable", False, rig.rig.service.motion, str(error))
        run = self.supervisor.run_of(rig.id)
        holder = self.supervisor.holder(rig)
        blocked = self.supervisor.blocked(rig.id)
        state: Literal["free", "busy", "held", "blocked"]
        state = "busy" if run else "held" if holder else "blocked" if blocked else "free"
        last = self.list_runs(rig.id, None, 10)
        from tdhil.config import simulated_default_rig

        bench = simulated_default_rig(rig.rig) if simulated else rig.rig
        limits = None if bench.limits is None else bench.limits.model_dump()
        return RigView(
            rig.id, rig.name, state, simulated, rig.motion, problem, None if holder is None else str(holder), run,
            blocked, drive, profile, limits, next((one for one in last if one.inertia_kg_m2 is not None), None),
        )

    def list_runs(self, rig: str | None, state: str | None, limit: int) -> list[Summary]:
        """Return runs from the index; from the files if it is not available or out of date, as for a live run."""
        live = self.supervisor.ahead_of_the_index()
        now_live = []
        for run in live:
            with suppress(NotThere):
                now_live.append(self.store.summary(run))
        try:
            ended = [one for one in self.supervisor.index.find(rig=rig, state=state, limit=limit + len(live))
                     if one.id not in live]
        except (sqlite3.Error, OSError):
            ended = [one for one in self.store.summaries() if one.id not in live]
        found = [one for one in (*now_live, *ended) if rig in (None, one.rig) and state in (None, one.state)]
        return sorted(found, key=lambda one: one.id, reverse=True)[:limit]

    def replays(self, run: str) -> list[ReplayView]:
        """Return the finished replays and the waiting ones."""
        made = {name: adapter(ReplayView).validate_python(one) for name, one in self.store.replays(run)}
        waiting = {name: one for (at, name), one in tuple(self._waiting.items()) if at == run and name not in made}
        return [one for _, one in sorted((made | waiting).items())]

    def run_view(self, run: str, status: Status | None = None) -> RunView:
        """Return a run without its samples. ``status``: if the run itself has just reported it. Raises NotThere."""
        request, folder = self.store.request(run), self.store.place(run)
        status = status or self.store.status(run)
        rig_name = request.rig
        with suppress(TdhilError):
            rig_name = self.supervisor.rigs.get(request.rig).name
        found = [name for name in ("run.mcap", "recovered.mcap", "report.html", "result.json", "report.pdf")
                 if (folder / name).is_file()]
        return RunView(
            request.id, request.rig, rig_name, status.state, status.stage, status.at,
            request.asked, request.asked_by, request.simulated if status.simulated is None else status.simulated,
            dict(request.options), list(status.history), dict(status.expected_s), list(status.preflight),
            status.identity, status.safe_action, status.confirmation, request.motion, status.watch, status.stop,
            status.error, status.exit_code, status.verdict,
            self.store.result(run), found, self.replays(run), read_json(folder / "signed_off.json"),
            lives(folder),
        )

    def told(self) -> dict[str, Any]:
        """Return the messages for a broker, by topic: each rig's state and latest result."""
        found: dict[str, Any] = {}
        for rig in self.supervisor.rigs.all():
            view, run = self.rig_view(rig), None
            if view.run is not None:
                with suppress(NotThere):
                    status = self.store.status(view.run)
                    run = {"id": view.run, "state": status.state.value, "stage": status.stage, "since": status.at}
            here = f"rigs/{quote(rig.id, safe='')}"
            found[f"{here}/state"] = {
                "rig": rig.id, "name": view.name, "state": view.state, "simulated": view.simulated,
                "holder": view.holder, "blocked_by": view.blocked_by, "run": run,
            }
            if view.last is not None:
                found[f"{here}/result"] = asdict(view.last)
        return found

    # -- live --------------------------------------------------------------------------------------------------------

    def _socket(
        self, role: Role, serve: Callable[[WebSocket], Awaitable[None]]
    ) -> Callable[[WebSocket], Awaitable[None]]:
        """Serve a socket while its client has the role. Otherwise close it: 4401 without a login, 4403 for a lower
        role.
        """
        async def allowed(socket: WebSocket) -> bool:
            who = self.access.who(socket)
            if role not in who.roles:
                await socket.close(4403 if who.roles else 4401, "log in" if not who.roles else f"for {role} only")
            return role in who.roles

        async def look(socket: WebSocket, scope: anyio.CancelScope) -> None:
            with _GONE:
                while await allowed(socket):
                    await anyio.sleep(SOCKET_LOOK_S)
            scope.cancel()

        async def guarded(socket: WebSocket) -> None:
            if role not in self.access.who(socket).roles:
                await socket.accept()          # only then does a page receive the reason
                await allowed(socket)
                return
            async with anyio.create_task_group() as both:
                both.start_soon(look, socket, both.cancel_scope)
                with _GONE:
                    await serve(socket)
                both.cancel_scope.cancel()

        return guarded

    def _no_socket(self, role: Role) -> Callable[[Request], Awaitable[Response]]:
        """Answer an ordinary request to a socket's address."""
        async def serve(request: Request) -> Response:
            path = request.url.path
            require(principal(request), role, route=path, open_here=not self.access.login)
            error = UsageError("is a WebSocket", where=path[:100], next_step="Open it as ws:// or wss://")
            return error_response(error, 426, {"upgrade": "websocket", "connection": "upgrade"})

        return serve

    async def _watch(self, socket: WebSocket) -> None:
        run = socket.path_params["run"]
        try:
            folder = await off(lambda: self.store.place(run))
        except NotThere as error:
            await socket.send_denial_response(error_response(error))
            return
        await socket.accept()
        feed = self.feeds.of(run, lambda: Feed(folder / "run.mcap", lambda: self.store.status(run)))
        queue = feed.watch()
        try:
            async with anyio.create_task_group() as both:
                both.start_soon(self._listen, socket, both.cancel_scope)
                with _GONE:
                    while (message := await queue.get()) is not None:
                        await socket.send_text(json.dumps(message, allow_nan=False))
                    await socket.close(1013, "too slow: connect again")
                both.cancel_scope.cancel()
        finally:
            feed.leave(queue)

    @staticmethod
    async def _listen(socket: WebSocket, scope: anyio.CancelScope) -> None:
        """Ignore what a viewer sends. Wait until it disconnects."""
        with _GONE:
            while True:
                message = await socket.receive()
                if message["type"] == "websocket.disconnect":
                    break
        scope.cancel()

    async def _foxglove(self, socket: WebSocket) -> None:
        rig_id = socket.path_params["rig"]
        protocol = next((one for one in PROTOCOLS if one in socket.scope["subprotocols"]), None)
        try:
            rig = await off(lambda: self.supervisor.rigs.get(rig_id))
        except NotThere as error:
            await socket.send_denial_response(error_response(error))
            return
        if protocol is None:
            wrong = UsageError("speaks the Foxglove protocol", where=socket.url.path[:100],
                               next_step=f"Offer a sub-protocol: {' or '.join(PROTOCOLS)}")
            await socket.send_denial_response(error_response(wrong, 400))
            return
        await socket.accept(protocol)
        relay = Relay(rig_id, lambda: self._running(rig_id), socket.send_text, socket.send_bytes, rig.simulated)
        self._relays += 1

        async def tell(scope: anyio.CancelScope) -> None:
            with _GONE:
                await relay.run()
            scope.cancel()

        try:
            async with anyio.create_task_group() as both:
                both.start_soon(tell, both.cancel_scope)
                with _GONE:
                    while (message := await socket.receive())["type"] != "websocket.disconnect":
                        said = message.get("text")
                        await relay.hear(message.get("bytes") or b"" if said is None else said)
                both.cancel_scope.cancel()
        finally:
            self._relays -= 1

    def _running(self, rig: str) -> Running | None:
        if (run := self.supervisor.run_of(rig)) is None:
            return None
        asked, status = self.store.request(run), self.store.status(run)
        simulated = asked.simulated if status.simulated is None else status.simulated
        return Running(run, self.store.place(run) / "run.mcap", simulated)

    # -- pages -------------------------------------------------------------------------------------------------------

    def _page(self, template: str, here: str, role: Role = "viewer") -> Callable[[Request], Awaitable[Response]]:
        async def serve(request: Request) -> Response:
            require(principal(request), role, route=request.url.path, open_here=not self.access.login)
            known: dict[str, Any] = {}
            if "rig" in request.path_params:
                known["rig"] = await off(
                    lambda: self.rig_view(self.supervisor.rigs.get(request.path_params["rig"])))
            if "run" in request.path_params:
                known["run"] = await off(lambda: self.run_view(request.path_params["run"]))
            if "fleet" in request.path_params:
                known["fleet"] = await off(lambda: self.fleets.get(request.path_params["fleet"]))
            return self._render(request, template, here, **known)

        return serve

    async def _login_page(self, request: Request) -> Response:
        there = request.query_params.get("next", "/")
        there = there if _OF_HERE.fullmatch(there) else "/"
        if principal(request).roles or not self.access.login:
            return RedirectResponse(there, 303)
        return self._render(request, "login.html", "login", next=there)

    def _render(self, request: Request, template: str, here: str, status: int = 200, **known: Any) -> Response:
        text = self._pages.get_template(template).render(
            here=here, who=principal(request), login=self.access.login, **known)
        return HTMLResponse(text, status)


def _file_view(rig: RigFile) -> RigFileView:
    """Return the view of a rig's file. Raises UsageError."""
    try:
        data = rig.path.read_bytes()
        return RigFileView(rig.id, data.decode(), hashlib.sha256(data).hexdigest(), sorted(EDITABLE))
    except (OSError, ValueError) as error:
        raise UsageError(f"can't be read as text ({error})", where=rig.path.name) from error


@cache
def _openapi_text() -> bytes:
    return json.dumps(document(), ensure_ascii=False).encode()


def _as_it_is(path: Path) -> Iterator[bytes]:
    """Yield a growing file up to its present end."""
    left = path.stat().st_size
    with path.open("rb") as file:
        while left > 0 and (piece := file.read(min(left, 2**16))):
            left -= len(piece)
            yield piece


def _require_key(key: str | None, where: str) -> None:
    if key is not None and not 16 <= len(key) <= 200:
        raise UsageError("must have 16 to 200 characters", where=where, next_step="Use a random key",
                         entry=MessageCode.REQUEST_WRONG)
