"""The routes of evidence: make the archive of a run, and download it. The audit records both."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from tdhil.service.access import principal
from tdhil.service.evidence_request import ABOUT, ARCHIVE, EvidenceView, stated_in
from tdhil.service.file_routes import file_of
from tdhil.service.middleware import off
from tdhil.service.routing import apis
from tdhil.service.run_state import now
from tdhil.service.store import write_json

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response
    from starlette.routing import Route

    from tdhil.service.site import Site

KEY: Final = "evidence.key"
"""File in the data folder with the key of the hashes of serial numbers. It never leaves this computer."""
_KEY_BYTES: Final = 32


def routes(site: Site) -> list[Route]:
    """Return the routes of evidence."""
    return apis(site, make_evidence, evidence)


async def make_evidence(site: Site, request: Request, body: Mapping[str, Any]) -> EvidenceView:
    """Make the archive of a run, in place of an earlier one."""
    which, who = request.path_params["run"], principal(request).name
    stated = stated_in(body)
    rig = await off(lambda: site.records.ask_evidence(
        which, who, publisher=stated.publisher or "", publish=stated.publish or ""))
    key = site.store.folder / KEY
    await off(lambda: _make_key(key))
    made = await site.work("evidence", which, {"stated": asdict(stated), "key_file": str(key.resolve())})
    view = EvidenceView(run=which, by=who, at=now(), **made)
    await off(lambda: write_json(site.store.place(which) / ABOUT, asdict(view)))
    site.supervisor.note(who, "evidence made", which, rig, sha256=view.sha256)
    return view


async def evidence(site: Site, request: Request, body: None) -> Response:
    """Return the archive of a run."""
    return await file_of(site, request, ARCHIVE, "application/zip")


def _make_key(path: Path) -> None:
    """Make the key of this service, unless it exists. Only its own user may read it."""
    with suppress(FileExistsError):
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(file, "wb") as out:
            out.write(os.urandom(_KEY_BYTES))
