"""The routes of the service itself: audit, health, metrics, OpenAPI document."""

from __future__ import annotations

import json
from functools import cache
from typing import TYPE_CHECKING

from prometheus_client import generate_latest
from starlette.responses import Response

from tdhil.service import letterhead as letterheads
from tdhil.service.access import principal
from tdhil.service.audit import ChainHead
from tdhil.service.letterhead import stored_letterhead
from tdhil.service.middleware import off, whole_number
from tdhil.service.routing import api
from tdhil.service.run_state import request_wrong
from tdhil.service.schemas import AuditView, HealthView, LetterheadBody, LetterheadView, document
from tdhil.version import __version__

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.routing import Route

    from tdhil.service.site import Site


def routes(site: Site) -> list[Route]:
    """Return the routes. Health and metrics are also at the root, where monitoring systems expect them."""
    return [
        api(site, audit),
        api(site, letterhead),
        api(site, change_letterhead),
        api(site, health),
        api(site, health, base=""),
        api(site, metrics),
        api(site, metrics, base=""),
        api(site, openapi),
    ]


async def audit(site: Site, request: Request, body: None) -> AuditView:
    """Return the newest lines of the audit, and whether its chain is intact."""
    limit = request.query_params.get("limit", "200")
    if whole_number(limit, 1, 5000) is None:
        raise request_wrong("must be 1 to 5000", "limit")

    given = request.query_params.get("head")
    kept = None if given is None else ChainHead.of(given)

    def look() -> AuditView:
        book = site.supervisor.audit
        entries, broken, head = book.examined(kept)
        return AuditView(entries[-int(limit):][::-1], broken, None if head is None else str(head), book.made())

    return await off(look)


async def letterhead(site: Site, request: Request, body: None) -> LetterheadView:
    """Return company, address and logo of the reports."""
    return LetterheadView(**(await off(lambda: stored_letterhead(site.store.folder))).plain())


async def change_letterhead(site: Site, request: Request, body: LetterheadBody) -> LetterheadView:
    """Change company, address and logo of the reports."""
    who = principal(request).name
    found = await off(lambda: letterheads.change_letterhead(
        site.store, site.supervisor.audit, who, company=body.company, address=body.address, logo=body.logo))
    return LetterheadView(**found.plain())


async def health(site: Site, request: Request, body: None) -> HealthView:
    """Return the health of the service. Only an identified client gets the live runs."""
    rigs = await off(site.supervisor.rigs.all)
    live = site.supervisor.live() if principal(request).roles else []
    return HealthView("ok", __version__, live, len(rigs))


async def metrics(site: Site, request: Request, body: None) -> Response:
    """Return the metrics in the text format of Prometheus."""
    found = site.metrics
    rehearsed = await off(lambda: [site.store.rehearsed(run) for run in site.supervisor.live()])
    found.live.set(rehearsed.count(False))
    found.rehearsed.set(rehearsed.count(True))
    found.viewers.set(site.feeds.viewers)
    found.relayed.set(site.relays)
    views = await off(lambda: site.rig_views(site.supervisor.rigs.all()))
    found.unsigned.set(sum(one.state == "blocked" for one in views))
    return Response(generate_latest(found.registry), media_type="text/plain; version=0.0.4; charset=utf-8")


async def openapi(site: Site, request: Request, body: None) -> Response:
    """Return the OpenAPI document."""
    return Response(openapi_text(), media_type="application/json")


@cache
def openapi_text() -> bytes:
    """Return the OpenAPI document as JSON. The first call takes 0.4 s."""
    return json.dumps(document(), ensure_ascii=False).encode()
