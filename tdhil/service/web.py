"""The web: the API, the live sockets and the pages, on one port. It opens no drive's bus and moves nothing itself.

A stop never waits for a computation, a download or the index: it has its own threads. `site` has the data for all
routes. The handler of a route is in the module of its subject. `schemas.ROUTES` declares path, role and replies.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Awaitable, Callable, Mapping
from contextlib import asynccontextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final
from urllib.parse import urlencode

import anyio
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.authentication import AuthenticationMiddleware
from starlette.requests import Request
from starlette.responses import RedirectResponse, Response
from starlette.routing import BaseRoute, Match, Route, WebSocketRoute
from starlette.types import ASGIApp
from starlette.websockets import WebSocket, WebSocketDisconnect

from tdhil.errors import LogError, TdhilError, UsageError
from tdhil.service import (
    auth_routes,
    evidence_routes,
    file_routes,
    fleet_routes,
    new_rig_routes,
    rig_routes,
    run_routes,
    service_routes,
    upload_routes,
)
from tdhil.service.access import SOCKET_LOOK_S, Access, principal, require
from tdhil.service.accounts import Role
from tdhil.service.door import NO_DESCRIPTOR, Seldom
from tdhil.service.foxglove import PROTOCOLS, Relay, Running
from tdhil.service.limits import API, UPLOAD_LIMIT
from tdhil.service.live_feed import Feed
from tdhil.service.middleware import RequestGuard, error_response, error_view, off, status_of
from tdhil.service.page_routes import Pages
from tdhil.service.run_channel import tell_viewed
from tdhil.service.run_state import NotLoggedIn, NotThere, disk_full, request_wrong
from tdhil.service.schemas import SOCKETS
from tdhil.service.site import Site
from tdhil.service.store import LOG
from tdhil.service.supervisor import Supervisor

LOOPBACK: Final = frozenset({"127.0.0.1", "localhost", "::1"})
SUBJECTS: Final = (
    new_rig_routes, rig_routes, run_routes, file_routes, evidence_routes, upload_routes,
    fleet_routes, auth_routes, service_routes)
_GONE: Final = suppress(WebSocketDisconnect, RuntimeError)
"""Context for messages to a socket, whose other end may disconnect at any time."""


class Web(Site):
    """Web application of one supervisor. ``hosts``: accepted host names.

    ``viewers``: origins (``http://localhost:8080``) whose pages may only read logs by the Foxglove protocol.
    ``access``, ``logs``, ``upload_limit``: as in `Site`.
    """

    def __init__(
        self, supervisor: Supervisor, *, hosts: frozenset[str] = LOOPBACK, viewers: frozenset[str] = frozenset(),
        access: Access | None = None, logs: Mapping[str, Path] = MappingProxyType({}),
        upload_limit: int = UPLOAD_LIMIT,
    ) -> None:
        super().__init__(supervisor, access=access, logs=logs, upload_limit=upload_limit)
        self._complain = Seldom(supervisor.say)
        self._pages = Pages(self)
        serve = {"watch": self._watch, "foxglove": self._foxglove}
        sockets: list[BaseRoute] = []          # below the API and at the root
        for path, one in ((f"{base}{one.path}", one) for base in (API, "") for one in SOCKETS):
            sockets += [WebSocketRoute(path, self._socket(one.role, serve[one.name])),
                        Route(path, self._no_socket(one.role))]
        self.app = Starlette(
            routes=[*(one for subject in SUBJECTS for one in subject.routes(self)), *sockets, *self._pages.routes()],
            lifespan=self._lifespan,
            middleware=[Middleware(AuthenticationMiddleware, backend=self.access)],
            exception_handlers=dict.fromkeys((TdhilError, HTTPException, OSError, Exception), self._failed),
        )
        self.asgi: ASGIApp = RequestGuard(self.app, hosts, viewers)

    @asynccontextmanager
    async def _lifespan(self, app: Starlette) -> Any:
        self.begin_stops()
        await off(service_routes.openapi_text)         # takes 0.4 s: done now, so that no stop waits for it
        await anyio.to_thread.run_sync(self.access.start)
        await anyio.to_thread.run_sync(self.supervisor.start)
        await anyio.to_thread.run_sync(self.uploads.start)
        try:
            yield
        finally:
            await anyio.to_thread.run_sync(self.fleets.close)
            await anyio.to_thread.run_sync(self.access.close)
            await anyio.to_thread.run_sync(self.supervisor.close)

    async def _failed(self, request: Request, error: Exception) -> Response:
        if isinstance(error, OSError) and error.errno in NO_DESCRIPTOR:
            error = LogError(f"the service has no descriptor left ({error.strerror})", where=request.url.path[:100],
                             next_step="Repeat the request. Raise the limit of open files (LimitNOFILE, ulimit -n)")
            self._complain("A request failed: {}", error)
        elif disk_full(error) is not None:
            self._complain("A request failed: {}", error)
        elif not isinstance(error, TdhilError | HTTPException):
            import traceback

            traceback.print_exception(error, file=sys.stderr)
        path, status, headers = request.url.path, None, {}
        if isinstance(error, HTTPException) and error.status_code == 405:
            routes = [one for one in self.app.routes
                      if isinstance(one, Route) and one.matches(request.scope)[0] is not Match.NONE]
            methods = ", ".join(sorted({method for one in routes for method in one.methods or ()}))
            error = request_wrong(f"supports {methods}, not {request.method[:20]}", path[:100])
            status, headers = 405, {"allow": methods}
        elif isinstance(error, HTTPException) and error.status_code == 404:
            listed = f"See {API}/openapi.json" if path.startswith(API) else ""
            error = NotThere("this address does not exist", where=path[:100], next_step=listed)
        if path.startswith(API) or request.method != "GET":
            return error_response(error, status, headers)
        if isinstance(error, NotLoggedIn) and self.access.login:       # reply to a browser, which gets a page
            there = f"{request.url.path}?{request.url.query}" if request.url.query else request.url.path
            return RedirectResponse(f"/login?{urlencode({'next': there})}", 303)
        reported = error_view(error).error
        return self._pages.render(request, "error.html", "", status_of(error), reported=reported,
                                  reported_json=json.dumps(asdict(reported)))

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
                await socket.accept()          # a page receives the reason only after this
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
        feed = self.feeds.of(run, lambda: Feed(
            folder / LOG, lambda: self.store.status(run), lambda: tell_viewed(folder)))
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
        """Ignore messages of a viewer. Wait until it disconnects."""
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
        self.relays += 1

        async def send_news(scope: anyio.CancelScope) -> None:
            with _GONE:
                await relay.run()
            scope.cancel()

        try:
            async with anyio.create_task_group() as both:
                both.start_soon(send_news, both.cancel_scope)
                with _GONE:
                    while (message := await socket.receive())["type"] != "websocket.disconnect":
                        said = message.get("text")
                        await relay.hear(message.get("bytes") or b"" if said is None else said)
                both.cancel_scope.cancel()
        finally:
            self.relays -= 1

    def _running(self, rig: str) -> Running | None:
        if (run := self.supervisor.run_of(rig)) is None:
            return None
        with suppress(NotThere):
            asked, status = self.store.request(run), self.store.status(run)
            simulated = asked.simulated if status.simulated is None else status.simulated
            return Running(run, self.store.place(run) / LOG, simulated, asked.rehearsal)
        return None
