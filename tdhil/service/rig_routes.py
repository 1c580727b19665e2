"""The routes of a rig: its state and file, plan, start and stop of a run, trend, torque calibration, faults."""

from __future__ import annotations

import hashlib
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from tdhil.buses import DoctorFinding
from tdhil.errors import ExitCode, UsageError
from tdhil.service.access import address_of, principal, require_options
from tdhil.service.middleware import off
from tdhil.service.routing import apis
from tdhil.service.run_routes import asks_for
from tdhil.service.run_state import FolderMissing, NotAllowed, request_wrong
from tdhil.service.schemas import (
    CalibrationBody,
    CalibrationView,
    FaultView,
    PaceView,
    PlanView,
    RigFileBody,
    RigFileView,
    RigView,
    RunView,
    StoppedView,
    TrendView,
)
from tdhil.service.start_request import EDITABLE, RigFile, ValuesWrong, options_of, require_motion, require_unwatched

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.routing import Route

    from tdhil.service.site import Site
    from tdhil.session import Holder

LARGEST_KG_M2: Final = 1e9
"""Largest added moment of inertia that a calibration accepts, kg·m²; no body has more."""


def routes(site: Site) -> list[Route]:
    """Return the routes of the rigs."""
    return apis(site, rigs, rig, rig_file, edit_rig, trend, calibration, plan, pace, check_rig, start, stop_rig, faults)


async def rigs(site: Site, request: Request, body: None) -> list[RigView]:
    """Return every rig."""
    return await off(lambda: site.rig_views(site.supervisor.all_rigs()))


async def rig(site: Site, request: Request, body: None) -> RigView:
    """Return one rig."""
    return await off(lambda: site.rig_view(site.supervisor.rig(request.path_params["rig"])))


async def rig_file(site: Site, request: Request, body: None) -> RigFileView:
    """Return a rig's file."""
    return await off(lambda: _file_view(site.supervisor.rigs.get(request.path_params["rig"])))


async def edit_rig(site: Site, request: Request, body: RigFileBody) -> RigFileView:
    """Write a rig's file. Raises NotAllowed without a login."""
    which, who = request.path_params["rig"], principal(request)
    if not who.known:
        raise NotAllowed("only a logged-in user may edit a rig's file", where=f"rig {which}",
                         next_step="Edit the file on the service's computer, or add users")
    return await off(lambda: _file_view(site.supervisor.edit_rig(which, body.text, body.sha256, who.name)))


def _file_view(found: RigFile) -> RigFileView:
    """Return the view of a rig's file. Raises UsageError."""
    try:
        data = found.path.read_bytes()
        return RigFileView(found.id, data.decode("utf-8", "replace"), hashlib.sha256(data).hexdigest(),
                           sorted(EDITABLE))
    except OSError as error:
        raise UsageError(f"can't be read as text ({error})", where=found.path.name) from error


async def plan(site: Site, request: Request, body: dict[str, Any]) -> PlanView:
    """Plan a run. No drive is connected."""
    found = await off(lambda: site.supervisor.rigs.get(request.path_params["rig"]))
    options = await off(lambda: options_of(body, found))
    _, connection = await off(lambda: found.way(options))
    asked = {"rig_file": str(found.path.resolve()), "options": options,
             "profile": hashlib.sha256(connection.profile.model_dump_json().encode()).hexdigest()}
    return PlanView(found.id, found.sha256, await site.work("plan", None, asked))


async def pace(site: Site, request: Request, body: None) -> PaceView:
    """Measure whether this computer sustains a simulated rig's cycle rate in real time. Raises NotAllowed."""
    found = await off(lambda: site.supervisor.rigs.get(request.path_params["rig"]))
    if not found.simulated:
        raise NotAllowed("only a simulated rig is measured from here", where=f"rig {found.id}",
                         next_step="A run on a real drive measures the rate itself, before motion")
    await off(lambda: site.supervisor.refuse_turning(f"rig {found.id}"))
    asked = {"rig_file": str(found.path.resolve()), "options": {}}
    return PaceView(found.id, await site.work("pace", None, asked))


async def check_rig(site: Site, request: Request, body: Any) -> list[DoctorFinding]:
    """Check a rig's drive without motion. Raises Conflict while a real shaft may turn."""
    found = await off(lambda: site.supervisor.rigs.get(request.path_params["rig"]))
    await off(lambda: site.supervisor.refuse_turning(f"rig {found.id}"))
    site.supervisor.note(principal(request).name, "rig checked", None, found.id)
    asked = {"rig_file": str(found.path.resolve()), "runs_folder": str(site.store.runs)}
    return [DoctorFinding(**one) for one in (await site.work("check", None, asked))["checks"]]


async def trend(site: Site, request: Request, body: None) -> TrendView:
    """Return how the results of a rig changed over time."""
    which = await off(lambda: site.supervisor.rigs.get(request.path_params["rig"]))
    archived, rehearsals = asks_for(request, "archived"), asks_for(request, "rehearsals")
    found = await off(lambda: site.trend_rows(which.id, archived=archived, rehearsals=rehearsals))
    notes = await off(lambda: site.left_out(which.id, archived=archived, rehearsals=rehearsals))
    if not found:
        nothing = {"rig": which.id, "logs": 0, "results": 0, "quantities": []}
        return TrendView(which.id, {**nothing, "notes": ["no run has a result yet", *notes]})
    document = await site.work("trend", None, {"rows": found, "rig": which.id})
    return TrendView(which.id, {**document, "notes": [*document["notes"], *notes]} if notes else document)


async def start(site: Site, request: Request, body: dict[str, Any]) -> tuple[int, RunView]:
    """Request a run. The same key returns the same run."""
    key = request.headers.get("idempotency-key")
    if key is not None and not 1 <= len(key) <= 200:
        raise request_wrong("must have 1 to 200 characters", "Idempotency-Key")
    which, who = request.path_params["rig"], principal(request)

    def check() -> None:
        found = site.supervisor.rigs.get(which)
        require_motion(found)
        if not who.known:
            require_unwatched(found)
        require_options(who, options_of(body, found))

    await off(check)
    asked = await off(lambda: site.supervisor.start_run(which, body, who.name, key, address_of(request)))
    if asked.new:
        (site.metrics.rehearsals_asked if asked.request.rehearsal else site.metrics.runs_asked).inc()
    return 201 if asked.new else 200, await off(lambda: site.run_view(asked.request.id))


async def stop_rig(site: Site, request: Request, body: Any) -> StoppedView:
    """Stop the rig's run, or its drive if there is no run."""
    which, asking = request.path_params["rig"], principal(request)
    who = asking.name
    site.metrics.stops_asked.inc()

    def look() -> tuple[str | None, Holder | None, RigFile | None]:
        if (run := site.supervisor.run_of(which)) is not None:
            return run, site.supervisor.held_beside(run), None
        found = site.supervisor.rig(which)
        if "operator" not in asking.roles and site.supervisor.certainly_idle(found):
            raise NotAllowed("no tdhil moves this rig: a stop would open its bus and act on a drive that another"
                             " program may control", where=f"rig {which}",
                             next_step="Ask an operator. If the shaft turns, use the hard-wired emergency stop")
        return None, None, found

    def noted() -> None:
        site.supervisor.note(who, "stop asked", run, which, joined=True)

    run, holder, found = await site.at_once(look)          # for each request: a run may have begun since another stop
    if run is not None:
        drive = site.stop_beside(run, holder, who)
        try:
            await site.shared_stop(f"run {run}", partial(site.supervisor.stop, run, who), noted)
        except FolderMissing as error:
            return StoppedView(which, [run], int(ExitCode.STOP_NOT_CONFIRMED), error.what)
        code, said = (None, "") if drive is None else await drive
        return StoppedView(which, [run], code, said)
    assert found is not None
    code, said = await site.shared_stop(f"rig {which}", partial(site.supervisor.stop_drive, found, who), noted)
    return StoppedView(which, [], code, said)


async def faults(site: Site, request: Request, body: None) -> list[FaultView]:
    """Return the faults that can be rehearsed. Raises NotAllowed for a real rig."""
    from tdhil.buses import bus_named
    from tdhil.session import required_reaction

    which = await off(lambda: site.supervisor.rigs.get(request.path_params["rig"]))
    if not which.simulated:
        raise NotAllowed("faults can be rehearsed only on a simulated rig", where=f"rig {which.id}",
                         next_step="Use a rig whose file contains run: {simulate: true}")
    bus = bus_named(which.way()[1].drive)
    return [FaultView(one.name, one.summary, one.row, one.value, one.takes, one.from_start,
                      required_reaction(one).words) for one in bus.faults()]


async def calibration(site: Site, request: Request, body: CalibrationBody) -> CalibrationView:
    """Return the torque calibration from two ended runs of the rig."""
    which = await off(lambda: site.supervisor.rigs.get(request.path_params["rig"]))
    sd = body.added_sd_kg_m2
    added_wrong = not 0.0 < body.added_kg_m2 <= LARGEST_KG_M2
    sd_wrong = sd is not None and not 0.0 <= sd <= LARGEST_KG_M2
    if added_wrong or sd_wrong:
        raise ValuesWrong([one for wrong, one in (
            (added_wrong, ("added_kg_m2", f"{body.added_kg_m2}: must be a positive number of kg·m²")),
            (sd_wrong, ("added_sd_kg_m2", f"{sd}: must be a number of kg·m², not negative"))) if wrong])

    def check() -> None:
        for name, run in (("without", body.without), ("with_body", body.with_body)):
            known = site.store.request(run)
            if known.rehearsal:
                raise ValuesWrong([(name, "is a rehearsal of faults: no drive is calibrated by it")])
            if known.rig != which.id:
                raise request_wrong(f"is not a run of rig {which.id}", f"run {run}",
                                    "Calibrate each drive by its own two runs")
            if known.uploaded is not None:
                raise request_wrong("is an uploaded recording: it is not certain that it is of this drive",
                                    f"run {run}", "Calibrate with tdhil calibrate torque")
            site.store.require_finished_log(run)

    await off(check)
    asked = {"without": body.without, "with_body": body.with_body, "added_kg_m2": body.added_kg_m2,
             "added_sd_kg_m2": sd, "at": body.at}
    site.supervisor.note(principal(request).name, "torque calibration asked", body.with_body, which.id, **asked)
    return CalibrationView(await site.work("calibrate", None, {**asked, "runs_folder": str(site.store.runs)}))
