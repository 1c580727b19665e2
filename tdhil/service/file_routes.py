"""The routes of a run's files: log, report, result, samples, pictures. The audit records each download."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Final

from starlette.responses import FileResponse, Response, StreamingResponse

from tdhil.service.acceptance_signature import FILE
from tdhil.service.access import principal
from tdhil.service.evidence_request import ARCHIVE
from tdhil.service.letterhead import outdated_reports
from tdhil.service.middleware import off, whole_number
from tdhil.service.routing import apis
from tdhil.service.run_state import NotThere, page_text
from tdhil.service.schemas import PictureView
from tdhil.service.store import LOG, RECOVERED
from tdhil.service.uploads import TRACE

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.routing import Route

    from tdhil.report import ShownPicture
    from tdhil.service.site import Site

MISSING: Final = {
    LOG: page_text("The run ended without a log"), "samples.csv": page_text("The run ended without a log"),
    "result.json": page_text("The run ended without a result"), ARCHIVE: page_text("Make the evidence first"),
    RECOVERED: page_text("Only a log that broke off has a recovered copy"),
    TRACE: page_text("Only a run from an uploaded trace has this file"),
}
"""Why an ended run has no such file, or what makes it."""
REPORT_POLICY: Final = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; sandbox allow-downloads"
PICTURE_POLICY: Final = "default-src 'none'; style-src 'unsafe-inline'; sandbox"
"""Content security policies of a report and of a picture: both contain their own style, and run no script."""


def routes(site: Site) -> list[Route]:
    """Return the routes of a run's files."""
    return apis(site, log, recovered, report, report_pdf, result, samples, recording, pictures, picture)


async def log(site: Site, request: Request, body: None) -> Response:
    """Return the log, also during the run."""
    return await file_of(site, request, LOG, "application/octet-stream")


async def report(site: Site, request: Request, body: None) -> Response:
    """Return the report, for display in the browser. It is made again if signature, edits or letterhead are newer."""
    await _renew(site, request.path_params["run"], "report.html")
    response = await file_of(site, request, "report.html", "text/html", shown=True)
    response.headers["content-security-policy"] = REPORT_POLICY
    return response


async def report_pdf(site: Site, request: Request, body: None) -> Response:
    """Return the report as PDF on A4 pages. It is made at the first request, and again as `report`."""
    run = request.path_params["run"]
    await _renew(site, run, "report.pdf")
    folder = await off(lambda: site.store.place(run))
    if not (folder / "report.pdf").exists() and (folder / "result.json").exists():
        await site.work("report", run, {"name": "report.pdf"})
    return await file_of(site, request, "report.pdf", "application/pdf")


async def _renew(site: Site, run: str, name: str) -> None:
    """Make a report again that is older than what it shows beside the result. Raises NotThere and Refused."""
    folder = await off(lambda: site.store.place(run))
    if name in await off(lambda: outdated_reports(folder, FILE, site.store.annotations(run))):
        await site.work("report", run, {"name": name})


async def result(site: Site, request: Request, body: None) -> Response:
    """Return the result."""
    return await file_of(site, request, "result.json", "application/json")


async def samples(site: Site, request: Request, body: None) -> Response:
    """Return the samples as CSV. The file is made at the first request."""
    run = request.path_params["run"]
    folder = await off(lambda: site.store.place(run))
    if not (folder / "samples.csv").exists() and (folder / LOG).exists():
        await off(lambda: site.store.require_finished_log(run))
        await site.work("samples", run, {})
    return await file_of(site, request, "samples.csv", "text/csv")


async def recovered(site: Site, request: Request, body: None) -> Response:
    """Return the undamaged copy of a log that broke off."""
    return await file_of(site, request, RECOVERED, "application/octet-stream")


async def recording(site: Site, request: Request, body: None) -> Response:
    """Return the uploaded trace of a run, as it was received."""
    return await file_of(site, request, TRACE, "text/csv")


async def pictures(site: Site, request: Request, body: None) -> list[PictureView]:
    """Return the headings of the report's pictures."""
    found = await _shown(site, request.path_params["run"])
    return [PictureView(number, one.heading, one.caption) for number, one in enumerate(found)]


async def picture(site: Site, request: Request, body: None) -> Response:
    """Return one picture of the report. Raises NotThere."""
    number = request.path_params["number"]
    found = await _shown(site, request.path_params["run"])
    if whole_number(number, 0, len(found) - 1) is None:
        raise NotThere("this picture does not exist", where=f"run {request.path_params['run']}")
    said = {"content-security-policy": PICTURE_POLICY}
    return Response(found[int(number)].svg, media_type="image/svg+xml", headers=said)


async def _shown(site: Site, run: str) -> tuple[ShownPicture, ...]:
    def look() -> tuple[ShownPicture, ...]:
        found = site.store.place(run) / "report.html"
        return _pictures(found, found.stat().st_mtime_ns) if found.is_file() else ()

    return await off(look)


@lru_cache(maxsize=4)
def _pictures(report: Path, stamp_ns: int) -> tuple[ShownPicture, ...]:
    """Return the pictures of a report. A page asks for each of them in a request of its own."""
    from tdhil.report import pictures_in

    return pictures_in(report.read_text("utf-8"))


async def file_of(site: Site, request: Request, name: str, media: str, *, shown: bool = False) -> Response:
    """Return a file of the run as a download; with ``shown``, for display. Raises NotThere."""
    run, who = request.path_params["run"], principal(request).name
    path = (await off(lambda: site.store.place(run))) / name
    if not path.is_file():
        ended = (await off(lambda: site.store.status(run))).ended
        without = MISSING.get(name, page_text("The run ended without a report"))
        raise NotThere(f"this run has no {name}", where=f"run {run}",
                       next_step=without if ended else page_text("Wait until the run has ended"))
    rig = (await off(lambda: site.store.request(run))).rig
    if request.method == "GET":
        site.supervisor.note(who, f"downloaded {name}", run, rig)
    called = f"{rig}-{run}-{name}" if rig else f"{run}-{name}"
    grows = name == LOG and not (await off(lambda: site.store.status(run))).ended
    if grows and ("range" not in request.headers or "if-range" in request.headers):
        said = {"content-disposition": f'attachment; filename="{called}"'}
        return StreamingResponse(_as_it_is(path), media_type=media, headers=said)
    return FileResponse(path, media_type=media, filename=None if shown else called)


def _as_it_is(path: Path) -> Iterator[bytes]:
    """Yield the content of a growing file up to its present end."""
    left = path.stat().st_size
    with path.open("rb") as file:
        while left > 0 and (piece := file.read(min(left, 2**16))):
            left -= len(piece)
            yield piece
