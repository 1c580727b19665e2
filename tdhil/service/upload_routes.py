"""The routes of uploads: receive a file, preview it with a mapping of its columns, identify it, delete it."""

from __future__ import annotations

import time
import traceback
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

import anyio

from tdhil.errors import TdhilError
from tdhil.recording import survey_trace
from tdhil.service.access import principal
from tdhil.service.door import ADMITTED, HEADERS_S
from tdhil.service.middleware import error_view, fields_of, off
from tdhil.service.routing import apis
from tdhil.service.run_state import TooSlow, request_wrong
from tdhil.service.schemas import PreviewView, UploadsView
from tdhil.service.start_request import require_right
from tdhil.service.upload_request import RIG, columns_wrong, upload_options
from tdhil.service.uploads import TRACE, Receiving, Upload

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.routing import Route

    from tdhil.service.site import Site

PIECE: Final = 2**20
"""Bytes that are collected before they are written: a thread for each packet would cost more than the disk."""
SLOWEST: Final = 32 * 1024
"""Slowest mean rate of an upload, bytes/s. It extends the time limit of a request by the received bytes."""
MEDIA: Final = "application/octet-stream"
"""The one media type of an upload. A form of another site can't send it without the browser's question first."""
POLL_S: Final = 0.5
"""Interval of the check whether a shaft turns, before an identification begins, s."""


def routes(site: Site) -> list[Route]:
    """Return the routes of uploads."""
    return apis(site, uploads, upload, one_upload, preview, identify_upload, delete_upload)


async def uploads(site: Site, request: Request, body: None) -> UploadsView:
    """Return the uploads that wait to be identified."""
    return await off(lambda: _all(site))


def _all(site: Site) -> UploadsView:
    return UploadsView(site.uploads.limit, site.uploads.all())


async def one_upload(site: Site, request: Request, body: None) -> Upload:
    """Return one upload."""
    return await off(lambda: site.uploads.get(request.path_params["upload"]))


async def upload(site: Site, request: Request, body: None) -> Upload:
    """Receive a file as the body. What is cut off, too slow or too large leaves nothing."""
    who, name = principal(request).name, request.query_params.get("name", "")
    media = request.headers.get("content-type", "").split(";")[0].strip().lower()
    if media != MEDIA:
        raise request_wrong("must be the file itself, as raw bytes", f"content-type {media[:60]}", f"Use {MEDIA}")
    stated = request.headers.get("content-length", "")
    received = await off(lambda: site.uploads.begin(int(stated) if stated.isdecimal() else None))
    request.scope[ADMITTED] = True
    try:
        await _receive(request, received)
        return await off(lambda: site.uploads.finish(received, name, who))
    finally:
        request.scope[ADMITTED] = False
        with anyio.CancelScope(shield=True):
            await off(lambda: site.uploads.close(received))


async def _receive(request: Request, received: Receiving) -> None:
    """Write the body to the file. Raises TooSlow, TooLarge, NoRoom and LogError."""
    began_s, size, stream, waiting = time.monotonic(), 0, request.stream(), bytearray()
    while True:
        left_s = began_s + HEADERS_S + size / SLOWEST - time.monotonic()
        try:
            with anyio.fail_after(max(0.0, left_s)):
                piece = await anext(stream)
        except StopAsyncIteration:
            break
        except TimeoutError:
            raise TooSlow(f"{size} bytes arrived in {HEADERS_S + size / SLOWEST:.0f} s, which is too slow",
                          where="upload", next_step="Nothing was kept. Use a faster connection") from None
        size += len(piece)
        waiting += piece
        if len(waiting) >= PIECE:
            await _write(received, waiting)
    await _write(received, waiting)


async def _write(received: Receiving, waiting: bytearray) -> None:
    piece = bytes(waiting)
    waiting.clear()
    await off(lambda: received.write(piece))


async def preview(site: Site, request: Request, body: Mapping[str, Any]) -> PreviewView:
    """Return the content of an upload, how it is read with this mapping, and every wrong value."""
    found = await off(lambda: site.uploads.get(request.path_params["upload"]))
    place = await off(lambda: site.uploads.place(found.id))
    options, wrong = upload_options(body, found.kind)
    document = await site.work("preview", None, {
        "place": str(place), "kind": found.kind, "options": options, "read": not wrong})
    wrong += [(name, text) for name, text in document.pop("mistakes")]
    return PreviewView(found.id, document, fields_of(wrong))


async def identify_upload(site: Site, request: Request, body: Mapping[str, Any]) -> tuple[int, Upload]:
    """Identify an upload in the background. It becomes a run that has ended."""
    who = principal(request).name
    found = await off(lambda: site.uploads.get(request.path_params["upload"]))
    options, wrong = upload_options(body, found.kind)
    rig = body.get(RIG) or ""
    if not isinstance(rig, str) or (rig and rig not in {one.id for one in await off(site.supervisor.rigs.all)}):
        wrong.append((RIG, "this rig does not exist"))
    if found.kind == "trace" and found.run is None:
        place = await off(lambda: site.uploads.place(found.id))
        wrong += columns_wrong(options, (await off(lambda: survey_trace(place / TRACE))).names)
    require_right(wrong)
    found = await off(lambda: site.uploads.begin_identifying(found.id))
    site.in_background(_identify_later(site, found, rig, options, who))
    return 202, found


async def _identify_later(site: Site, found: Upload, rig: str, options: dict[str, Any], who: str) -> None:
    """Identify an upload as soon as no shaft of this service may turn, and make it a run."""
    try:
        while await off(site.supervisor.turning):
            site.uploads.delay(found.id, delayed=True)
            await anyio.sleep(POLL_S)
        site.uploads.delay(found.id, delayed=False)
        place = await off(lambda: site.uploads.place(found.id))
        facts = await site.work("upload", None, {
            "place": str(place), "kind": found.kind, "options": options, "source": {**found.source, "rig": rig}})
        run = await off(lambda: site.uploads.become_run(found, rig, options, who, facts))
        site.supervisor.reindex(run)
    except Exception as error:
        site.uploads.failed(found.id, error_view(error).error)
        if not isinstance(error, TdhilError):          # a defect: the page has a message, the terminal its cause
            traceback.print_exception(error)


async def delete_upload(site: Site, request: Request, body: Any) -> UploadsView:
    """Delete an upload."""
    which, who = request.path_params["upload"], principal(request).name
    await off(lambda: site.uploads.delete(which, who))
    return await off(lambda: _all(site))
