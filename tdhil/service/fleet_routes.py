"""The routes of fleet requests: many logs identified again."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from starlette.responses import FileResponse, Response

from tdhil.service.access import principal
from tdhil.service.fleets import TABLE, FleetView
from tdhil.service.middleware import off, whole_number
from tdhil.service.routing import apis
from tdhil.service.run_routes import settings_of
from tdhil.service.run_state import request_wrong
from tdhil.service.schemas import FleetBody

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.routing import Route

    from tdhil.service.site import Site


def routes(site: Site) -> list[Route]:
    """Return the routes. ``fleet_folders`` comes before ``fleet``, since the path of ``fleet`` matches it, too."""
    return apis(site, fleets, fleet_folders, ask_fleet, fleet, stop_fleet, fleet_rows, fleet_table)


async def fleet_folders(site: Site, request: Request, body: None) -> list[str]:
    """Return the names of the folders of logs."""
    return list(site.fleets.folders)


async def fleets(site: Site, request: Request, body: None) -> list[FleetView]:
    """Return the fleet requests, the newest first."""
    return await off(site.fleets.all)


async def fleet(site: Site, request: Request, body: None) -> FleetView:
    """Return one fleet request."""
    return await off(lambda: site.fleets.get(request.path_params["fleet"]))


async def ask_fleet(site: Site, request: Request, body: FleetBody) -> FleetView:
    """Identify the logs of a folder again."""
    settings = settings_of(body)
    who = principal(request).name
    found = await off(lambda: site.fleets.ask(body.folder, body.below, settings, who, archived=body.archived,
                                              rehearsals=body.rehearsals))
    site.supervisor.note(who, "fleet asked", None, "", folder=body.folder, below=body.below, fleet=found.id, **settings)
    return found


async def stop_fleet(site: Site, request: Request, body: Any) -> FleetView:
    """End a fleet request. Finished rows are kept."""
    found = await off(lambda: site.fleets.stop(request.path_params["fleet"]))
    site.supervisor.note(principal(request).name, "fleet stopped", None, "", fleet=found.id)
    return found


async def fleet_rows(site: Site, request: Request, body: None) -> list[dict[str, Any]]:
    """Return rows of a fleet request."""
    query = request.query_params
    start, limit = query.get("from", "0"), query.get("limit", "200")
    if not start.isdecimal() or len(start) > 9:
        raise request_wrong("must be a number", "from")
    if whole_number(limit, 1, 1000) is None:
        raise request_wrong("must be 1 to 1000", "limit")
    return await off(lambda: site.fleets.rows(request.path_params["fleet"], int(start), int(limit)))


async def fleet_table(site: Site, request: Request, body: None) -> Response:
    """Return the table of a fleet request as a download."""
    which = request.path_params["fleet"]
    path = await off(lambda: site.fleets.table(which))
    site.supervisor.note(principal(request).name, f"downloaded {TABLE}", None, "", fleet=which)
    return FileResponse(path, media_type="text/csv", filename=f"fleet-{which}.csv")
