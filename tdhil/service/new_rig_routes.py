"""The routes of a new rig: what it can be, its draft, a scan for its drive, its file."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from tdhil.service.access import principal
from tdhil.service.middleware import off
from tdhil.service.new_rig import draft_of, new_rig_view
from tdhil.service.routing import apis
from tdhil.service.schemas import DraftBody, DraftView, NewRigBody, NewRigView, RigView, ScanView, adapter
from tdhil.service.start_request import ValuesWrong

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.routing import Route

    from tdhil.service.site import Site


def routes(site: Site) -> list[Route]:
    """Return the routes of a new rig."""
    return apis(site, new_rig, draft_rig, scan_bus, add_rig)


async def new_rig(site: Site, request: Request, body: None) -> NewRigView:
    """Return the fields and profiles for a new rig."""
    return await off(new_rig_view)


async def draft_rig(site: Site, request: Request, body: DraftBody) -> DraftView:
    """Return the draft of a rig's file with all its mistakes."""
    return await off(lambda: draft_of(body))


async def scan_bus(site: Site, request: Request, body: DraftBody) -> ScanView:
    """Scan for drives. Raises Conflict while a real shaft turns, and UsageError if the bus may have another master."""
    if not body.alone:
        raise ValuesWrong([("alone", "A scan requests data from every node. Confirm that no other master is active.")])
    await off(lambda: site.supervisor.refuse_turning("scan"))
    who = principal(request).name
    site.supervisor.note(who, "bus scanned", None, None, profile=body.profile, address=dict(body.address))
    plain: dict[str, Any] = adapter(DraftBody).dump_python(body, mode="json")
    found: ScanView = adapter(ScanView).validate_python(await site.work("scan", None, {"draft": plain}))
    return found


async def add_rig(site: Site, request: Request, body: NewRigBody) -> tuple[int, RigView]:
    """Write the file of a new rig. It moves only with a code that the service shows at the rig, or never."""
    who = principal(request).name
    return 201, await off(lambda: site.rig_view(site.supervisor.add_rig(body.id, body.text, who)))
