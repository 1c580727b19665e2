"""Starlette route from a declared route of the API (`schemas.ROUTES`) and its handler.

The declaration states method, path, role, body and replies. A handler is a function of the site, the request and its
checked body. It returns a view, a status with a view, or a whole reply.
"""

from __future__ import annotations

from collections.abc import Awaitable
from typing import Any, Final, Protocol

from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from tdhil.errors import TdhilError
from tdhil.service import schemas
from tdhil.service.access import principal, require
from tdhil.service.limits import API
from tdhil.service.middleware import body_of, error_response
from tdhil.service.schemas import CSRF_HEADER, plain
from tdhil.service.site import Site


class Handler(Protocol):
    """Function that answers the requests of one route. Its name is the route's."""

    __name__: str

    def __call__(self, site: Site, request: Request, body: Any, /) -> Awaitable[Any]:
        """Answer a request with its checked body."""


DECLARED: Final = {one.name: one for one in schemas.ROUTES}


def api(site: Site, handler: Handler, *, base: str = API) -> Route:
    """Return the route that is declared with the name of ``handler``. It checks role and body, then calls it."""
    name = handler.__name__
    declared = DECLARED[name]
    first = next(iter(declared.answers))

    async def serve(request: Request) -> Response:
        try:
            sent = None if declared.method == "GET" else request.headers.get(CSRF_HEADER, "")
            require(principal(request), declared.role, route=name, open_here=not site.access.login, csrf=sent)
            found = await handler(site, request, await body_of(request, declared))
        except TdhilError as error:
            return error_response(error)
        except ClientDisconnect:               # disconnected during the request: no reply can reach the client
            return Response(status_code=400)
        if isinstance(found, Response):
            return found
        code, value = found if isinstance(found, tuple) else (first, found)
        return JSONResponse(plain(value, declared.answers[code]), code)

    return Route(f"{base}{declared.path}", serve, methods=[declared.method], name=name)


def apis(site: Site, *handlers: Handler) -> list[Route]:
    """Return the declared route of each handler, in this order."""
    return [api(site, one) for one in handlers]
