"""The routes for ended runs, calibrations, fleets and rehearsals: pictures, samples, many logs, faults.

Each of `ANSWERS` is called with the site, the request and its body, like the web's own routes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final, TypeVar

from starlette.responses import FileResponse, Response

from tdhil.config import ASKED_AGAIN, resolve
from tdhil.errors import MessageCode, UsageError
from tdhil.service.access import principal
from tdhil.service.fleets import TABLE, FleetView
from tdhil.service.middleware import Answer, Site, off
from tdhil.service.run_state import NotAllowed, NotThere
from tdhil.service.schemas import CalibrationBody, CalibrationView, FaultView, FleetBody, PictureView, ReplayBody
from tdhil.service.start_request import options_of

if TYPE_CHECKING:
    from starlette.requests import Request

    from tdhil.report import ShownPicture

T = TypeVar("T")
_PICTURE_POLICY: Final = "default-src 'none'; style-src 'unsafe-inline'; sandbox"


async def _pictures(site: Site, request: Request, body: None) -> list[PictureView]:
    found = await _shown(site, request.path_params["run"])
    return [PictureView(number, one.heading, one.caption) for number, one in enumerate(found)]


async def _picture(site: Site, request: Request, body: None) -> Response:
    number = request.path_params["number"]
    found = await _shown(site, request.path_params["run"])
    if not number.isdecimal() or int(number) >= len(found):
        raise NotThere("this picture does not exist", where=f"run {request.path_params['run']}")
    said = {"content-security-policy": _PICTURE_POLICY}
    return Response(found[int(number)].svg, media_type="image/svg+xml", headers=said)


async def _shown(site: Site, run: str) -> tuple[ShownPicture, ...]:
    from tdhil.report import pictures_in

    def look() -> tuple[ShownPicture, ...]:
        report = site.store.place(run) / "report.html"
        return pictures_in(report.read_text("utf-8")) if report.is_file() else ()

    return await off(look)


async def _samples(site: Site, request: Request, body: None) -> Response:
    """Return the samples as CSV, made at the first request."""
    run = request.path_params["run"]
    folder = await off(lambda: site.store.place(run))
    if not (folder / "samples.csv").exists() and (folder / "run.mcap").exists():
        if not site.store.status(run).ended:
            raise UsageError("the run has no finished log", where=f"run {run}", next_step="Wait until it has ended",
                             entry=MessageCode.NOT_READY)
        await site.work("samples", run, {})
    return await site.file(request, "samples.csv", "text/csv")


async def _faults(site: Site, request: Request, body: None) -> list[FaultView]:
    from tdhil.buses import bus_named

    rig = await off(lambda: site.supervisor.rigs.get(request.path_params["rig"]))
    if not rig.simulated:
        raise NotAllowed("faults can be rehearsed only on a simulated rig", where=f"rig {rig.id}",
                         next_step="Use a rig whose file contains run: {simulate: true}")
    bus = bus_named(rig.way()[1].drive)
    return [FaultView(one.name, one.summary, one.row, one.value, one.takes, one.from_start) for one in bus.faults()]


_LARGEST: Final = 1e9
"""kg·m²; no body has more."""


async def _calibration(site: Site, request: Request, body: CalibrationBody) -> CalibrationView:
    """Return the torque calibration from two ended runs of the rig."""
    rig = await off(lambda: site.supervisor.rigs.get(request.path_params["rig"]))
    sd = body.added_sd_kg_m2
    if not 0.0 < body.added_kg_m2 <= _LARGEST:
        raise UsageError(f"{body.added_kg_m2:g}: must be a positive number of kg·m²", where="added_kg_m2",
                         entry=MessageCode.REQUEST_WRONG)
    if sd is not None and not 0.0 <= sd <= _LARGEST:
        raise UsageError(f"{sd:g}: must be a number of kg·m², not negative", where="added_sd_kg_m2",
                         entry=MessageCode.REQUEST_WRONG)

    def check() -> None:
        for run in (body.without, body.with_body):
            if site.store.request(run).rig != rig.id:
                raise UsageError(f"is not a run of rig {rig.id}", where=f"run {run}",
                                 next_step="Calibrate each drive by its own two runs", entry=MessageCode.REQUEST_WRONG)
            if not site.store.status(run).ended or not (site.store.place(run) / "run.mcap").is_file():
                raise UsageError("the run has no finished log", where=f"run {run}",
                                 next_step="Wait until it has ended", entry=MessageCode.NOT_READY)

    await off(check)
    asked = {"without": body.without, "with_body": body.with_body, "added_kg_m2": body.added_kg_m2,
             "added_sd_kg_m2": sd, "at": body.at}
    site.supervisor.note(principal(request).name, "torque calibration asked", body.with_body, rig.id, **asked)
    return CalibrationView(await site.work("calibrate", None, {**asked, "runs_folder": str(site.store.runs)}))


async def _fleet_folders(site: Site, request: Request, body: None) -> list[str]:
    return list(site.fleets.folders)


async def _fleets(site: Site, request: Request, body: None) -> list[FleetView]:
    return await off(site.fleets.all)


async def _fleet(site: Site, request: Request, body: None) -> FleetView:
    return await off(lambda: site.fleets.get(request.path_params["fleet"]))


def settings_of(body: ReplayBody | FleetBody) -> dict[str, Any]:
    """Return the settings of an identification. Raises UsageError for values that no run would accept."""
    given = {one.name: getattr(body, one.name) for one in ASKED_AGAIN}
    found = options_of(given)
    resolve(found, None)
    return found


async def _ask_fleet(site: Site, request: Request, body: FleetBody) -> FleetView:
    settings = settings_of(body)
    who = principal(request).name
    found = await off(lambda: site.fleets.ask(body.folder, body.below, settings, who))
    site.supervisor.note(who, "fleet asked", None, "", folder=body.folder, below=body.below, fleet=found.id, **settings)
    return found


async def _stop_fleet(site: Site, request: Request, body: Any) -> FleetView:
    found = await off(lambda: site.fleets.stop(request.path_params["fleet"]))
    site.supervisor.note(principal(request).name, "fleet stopped", None, "", fleet=found.id)
    return found


async def _fleet_rows(site: Site, request: Request, body: None) -> list[dict[str, Any]]:
    query = request.query_params
    start, limit = query.get("from", "0"), query.get("limit", "200")
    if not start.isdecimal() or len(start) > 9:
        raise UsageError("must be a number", where="from", entry=MessageCode.REQUEST_WRONG)
    if not limit.isdecimal() or not 1 <= int(limit) <= 1000:
        raise UsageError("must be 1 to 1000", where="limit", entry=MessageCode.REQUEST_WRONG)
    return await off(lambda: site.fleets.rows(request.path_params["fleet"], int(start), int(limit)))


async def _fleet_table(site: Site, request: Request, body: None) -> Response:
    which = request.path_params["fleet"]
    path = await off(lambda: site.fleets.table(which))
    site.supervisor.note(principal(request).name, f"downloaded {TABLE}", None, "", fleet=which)
    return FileResponse(path, media_type="text/csv", filename=f"fleet-{which}.csv")


ANSWERS: Final[Mapping[str, Answer]] = {
    one.__name__.removeprefix("_"): one for one in (
        _calibration, _pictures, _picture, _samples, _faults, _fleet_folders, _fleets, _fleet, _ask_fleet, _stop_fleet,
        _fleet_rows, _fleet_table,
    )
}
"""Answers by route name."""
