"""Layer between HTTP and the service: permitted hosts and origins, checked bodies, and errors as HTTP replies."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields
from functools import partial
from types import MappingProxyType
from typing import Any, Final, TypeVar
from urllib.parse import urlsplit

import anyio
from pydantic import ValidationError
from starlette.exceptions import HTTPException
from starlette.requests import HTTPConnection, Request
from starlette.responses import JSONResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from drivers import CommunicationLost, DataFileError, PreflightRefused
from tdhil.errors import CsvMisnamed, CsvUnusable, ExitCode, LogError, MessageCode, TdhilError, UsageError
from tdhil.service.access import token_in
from tdhil.service.run_channel import RunRefused
from tdhil.service.run_state import (
    Conflict,
    FolderMissing,
    NoRoom,
    NotAllowed,
    NotLoggedIn,
    NotReacting,
    NotThere,
    Told,
    TooLarge,
    TooManyTries,
    TooSlow,
    disk_full,
    request_wrong,
)
from tdhil.service.schemas import FILE, OBJECTS, ErrorView, FieldError, Route, adapter, plain
from tdhil.service.start_request import ValuesWrong
from tdhil.service.upload_request import label_of

T = TypeVar("T")
POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
    "form-action 'none'; base-uri 'none'; frame-ancestors 'none'"
)
"""Content security policy of every page: nothing from elsewhere, no script or style in the page itself."""
_NONE: Final[Mapping[str, str]] = MappingProxyType({})
LONGEST_WHOLE: Final = 300
"""Most digits of a whole number in a request. A double has at most 309, and Python refuses more than 4300."""
_BROKEN_HINT: Final = "See the terminal of tdhil serve"


class RequestGuard:
    """First check of a request: known host, no page of another site. It also sets the headers of every reply."""

    def __init__(self, app: ASGIApp, hosts: frozenset[str], viewers: frozenset[str] = frozenset()) -> None:
        self._app, self._hosts, self._viewers = app, hosts, viewers

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        connection = HTTPConnection(scope)
        why = self._wrong(connection, changes=scope["type"] == "websocket" or scope["method"] not in ("GET", "HEAD"))
        if why is None:
            await self._app(scope, receive, partial(_with_headers, send))
        elif scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 4403, "reason": why.what[:100]})
        else:
            await error_response(why)(scope, receive, partial(_with_headers, send))

    def _wrong(self, connection: HTTPConnection, *, changes: bool) -> NotAllowed | None:
        host = connection.headers.get("host", "")
        name = ""
        with suppress(ValueError):
            name = (urlsplit(f"//{host}").hostname or "").lower()
        if name not in self._hosts:
            return NotAllowed("this host name does not belong to the service", where=f"host {host[:100]}",
                              next_step=f"Use {', '.join(sorted(self._hosts))}")
        if connection.scope["type"] == "websocket" and token_in(connection) is not None:
            return None                # a page sends no token by itself; only the token gives rights here
        origin = connection.headers.get("origin")
        if origin in self._viewers and connection.scope["type"] == "websocket" and "/foxglove/" in connection.url.path:
            return None
        elsewhere = origin is not None
        with suppress(ValueError):
            sent_by = urlsplit(origin or "")
            elsewhere &= sent_by.scheme not in ("http", "https") or sent_by.netloc.lower() != host.lower()
        if changes and (elsewhere or connection.headers.get("sec-fetch-site") in ("cross-site", "same-site")):
            return NotAllowed("a page of another site sent this request", where=f"origin {(origin or '?')[:100]}")
        return None


async def _with_headers(send: Send, message: Message) -> None:
    if message["type"] == "http.response.start":
        headers = list(message.get("headers", ()))
        named = {name.lower() for name, _ in headers}
        for name, value in (
            (b"content-security-policy", POLICY.encode()), (b"x-content-type-options", b"nosniff"),
            (b"referrer-policy", b"no-referrer"), (b"x-frame-options", b"DENY"), (b"cache-control", b"no-store"),
            (b"cross-origin-resource-policy", b"same-origin"), (b"cross-origin-opener-policy", b"same-origin"),
        ):
            if name not in named:
                headers.append((name, value))
        message = {**message, "headers": headers}
    await send(message)


def status_of(error: BaseException) -> int:
    """Return the HTTP status of an error in the error tree."""
    error = disk_full(error) or error
    if isinstance(error, HTTPException):
        return int(error.status_code)
    for kind, status in (
        (NotThere, 404), (NotLoggedIn, 401), (TooManyTries, 429), (NotAllowed, 403),
        (TooLarge, 413), (TooSlow, 408), (PreflightRefused, 409), (UsageError, 422), (DataFileError, 422),
        (CsvMisnamed, 422), (CsvUnusable, 422), (NotReacting, 504), (FolderMissing, 504),
        (CommunicationLost, 503), (NoRoom, 507), (LogError, 503),
    ):
        if isinstance(error, kind):
            return status
    if isinstance(error, RunRefused):
        if error.reported.code == NoRoom.entry.code:
            return 507
        return {int(ExitCode.USAGE): 422, int(ExitCode.REFUSED): 409}.get(int(error.reported.exit_code), 500)
    return 500


def error_view(error: BaseException) -> ErrorView:
    """Return the reply's body for an error."""
    error = disk_full(error) or error
    if isinstance(error, RunRefused):
        return ErrorView(error.reported)
    if isinstance(error, HTTPException):
        return ErrorView(Told("UsageError", error.detail, error.detail, "", "", int(ExitCode.USAGE),
                              MessageCode.REQUEST_WRONG.code))
    if not isinstance(error, TdhilError):
        return ErrorView(Told("InternalError", "internal error", "internal error", "", _BROKEN_HINT, 1,
                              MessageCode.INTERNAL_ERROR.code))
    wrong = fields_of(error.fields) if isinstance(error, ValuesWrong) else None
    return ErrorView(Told.of(error), getattr(error, "holder", None) if isinstance(error, Conflict) else None, wrong)


def fields_of(wrong: Sequence[tuple[str, str]]) -> list[FieldError]:
    """Return wrong values, each with its label on the form."""
    return [FieldError(name, label_of(name), text) for name, text in wrong]


def error_response(error: BaseException, status: int | None = None, headers: Mapping[str, str] = _NONE) -> Response:
    """Return the whole reply to an error. ``status`` replaces the error's own HTTP status."""
    headers = {**headers, **({"www-authenticate": "Bearer"} if isinstance(error, NotLoggedIn) else {})}
    if isinstance(error, TooManyTries):
        headers["retry-after"] = f"{error.wait_s:.0f}"
    return JSONResponse(plain(error_view(error), ErrorView), status or status_of(error), headers=headers)


async def body_of(request: Request, route: Route) -> Any:
    """Return the checked body of the request; None for a file, which its handler receives. Raises UsageError."""
    if route.method == "GET" or route.body == FILE:
        return None
    data = b""
    async for piece in request.stream():
        data += piece
        if len(data) > route.longest:
            raise request_wrong(f"the body is longer than the limit of {route.longest} bytes", "body")
    media = request.headers.get("content-type", "application/json").split(";")[0].strip().lower()
    if media != "application/json":
        raise request_wrong("must be JSON", f"content-type {media[:60]}", "Use application/json")
    try:
        sent = json.loads(data or b"{}", parse_constant=_no_number, parse_int=_whole)
    except (ValueError, RecursionError) as error:
        raise request_wrong(f"is not JSON ({str(error)[:100]})", "body") from None
    if not isinstance(sent, dict):
        raise request_wrong("must be an object", "body", 'Send an object, such as {"seed": 7}')
    if (where := _not_text(sent)) is not None:
        raise request_wrong("contains half of a UTF-16 surrogate pair, not a character", where[:60] or "body",
                            "Nothing was changed. Enter the text again")
    if route.body in OBJECTS:
        return sent
    try:
        return adapter(route.body).validate_json(json.dumps(sent), strict=True)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))[:60] or "body"
        if first["type"] == "unexpected_keyword_argument":
            known = ", ".join(one.name for one in fields(route.body))
            raise request_wrong("is not a field of this request", where, f"Fields: {known}") from None
        raise request_wrong(first["msg"], where) from None


def _whole(text: str) -> int:
    if len(text) > LONGEST_WHOLE:
        raise ValueError(f"a number has {len(text)} digits; the limit is {LONGEST_WHOLE}")
    return int(text)


def whole_number(text: str, least: int, most: int) -> int | None:
    """Return the whole number; None if it is none, or outside the limits. Python refuses more than 4300 digits."""
    if not text.isdecimal() or len(text) > len(str(most)):
        return None
    return int(text) if least <= int(text) <= most else None


def _not_text(sent: Any, where: str = "") -> str | None:
    """Return the field of the first text that UTF-8 can't express, such as ``tags.0``; None without one."""
    if isinstance(sent, str):
        return where if any("\ud800" <= one <= "\udfff" for one in sent) else None
    pairs = sent.items() if isinstance(sent, dict) else enumerate(sent) if isinstance(sent, list) else ()
    for name, value in pairs:
        if _not_text(name) is not None:
            return where or "body"
        found = _not_text(value, f"{where}.{name}" if where else str(name))
        if found is not None:
            return found
    return None


def _no_number(name: str) -> Any:
    raise ValueError(f"{name} is not a number in JSON")


async def off(work: Callable[[], T]) -> T:
    """Run a function in a thread, since files may be slow. Return its result."""
    found: T = await anyio.to_thread.run_sync(work)
    return found
