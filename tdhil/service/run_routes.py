"""The routes of a run: lists and comparison, confirmation, lease, stop, sign-off, annotations, deletion, replays."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import anyio

from tdhil.config import ASKED_AGAIN, STATED, resolve
from tdhil.errors import LogError, TdhilError
from tdhil.service.acceptance_signature import SIGNED
from tdhil.service.access import principal
from tdhil.service.accounts import ROLES
from tdhil.service.attendance import LEASE_S
from tdhil.service.middleware import error_view, off, whole_number
from tdhil.service.routing import apis
from tdhil.service.run_filter import NEWEST, SORTS, Order, RunFilter, Summary
from tdhil.service.run_state import NotThere, State, now, request_wrong
from tdhil.service.schemas import (
    AcceptanceView,
    AnnotationsBody,
    ArchiveBody,
    CompareView,
    ConfirmBody,
    DeleteBody,
    DeletedView,
    FleetBody,
    LeaseBody,
    LeaseView,
    ReplayBody,
    ReplayView,
    RunsPageView,
    RunView,
    SignatureBody,
    SignOffBody,
    plain,
)
from tdhil.service.site import BEGUN_BY
from tdhil.service.start_request import ValuesWrong, options_of
from tdhil.service.store import LOG, write_json
from tdhil.version import __version__

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.routing import Route

    from tdhil.service.site import Site

LONGEST_SEARCH: Final = 200
"""Longest text of a search, characters."""
LAST_PAGE: Final = 100_000
"""Highest number of a page that is accepted: far more runs than a disk holds."""


def routes(site: Site) -> list[Route]:
    """Return the routes. ``runs_page`` and ``compare`` come before ``run``, whose path matches theirs, too."""
    return apis(
        site, runs, runs_page, compare, run, confirm, renew, stop, sign_off, annotate, archive, delete_run,
        acceptance, sign_acceptance, ask_replay, replay)


async def runs(site: Site, request: Request, body: None) -> list[Summary]:
    """Return the runs, the newest first."""
    query = request.query_params
    limit = query.get("limit", "100")
    if whole_number(limit, 1, 1000) is None:
        raise request_wrong("must be 1 to 1000", "limit")
    wanted = _filter(request)
    return await off(lambda: site.find_runs(wanted, limit=int(limit)))


async def runs_page(site: Site, request: Request, body: None) -> RunsPageView:
    """Return a page of the list of runs."""
    query, wanted = request.query_params, _filter(request)
    page, key, way = query.get("page", "1"), query.get("sort", NEWEST.key), query.get("order", "desc")
    if whole_number(page, 1, LAST_PAGE) is None:
        raise request_wrong(f"must be 1 to {LAST_PAGE}", "page")
    if key not in SORTS or way not in ("asc", "desc"):
        raise request_wrong("is not a sort order of this list", "sort" if key not in SORTS else "order",
                            f"Give sort={', '.join(SORTS)} and order=asc or desc")
    return await off(lambda: site.runs_page(wanted, Order(key, way == "desc"), int(page)))


def _filter(request: Request) -> RunFilter:
    """Return the conditions on the runs of a list. Raises UsageError."""
    query = request.query_params
    if (state := query.get("state")) is not None and state not in set(State):
        raise request_wrong(f"{state[:40]!r} is not a state", "state", f"States: {', '.join(State)}")
    for name in ("text", "rig", "verdict", "tag", "until", "acceptance"):
        if len(query.get(name, "")) > LONGEST_SEARCH:
            raise request_wrong(f"must be at most {LONGEST_SEARCH} characters", name)
    return RunFilter(query.get("rig"), state, query.get("verdict"), query.get("tag"), query.get("text", ""),
                     asks_for(request, "archived"), query.get("until"), acceptance=query.get("acceptance"))


def asks_for(request: Request, what: str) -> bool:
    """Return whether the request asks for ``archived`` runs, or ``rehearsals``, too. Raises UsageError."""
    text = request.query_params.get(what, "false")
    if text not in ("true", "false"):
        raise request_wrong("must be true or false", what)
    return bool(text == "true")


async def compare(site: Site, request: Request, body: None) -> CompareView:
    """Compare two to eight runs."""
    which = [one for one in request.query_params.get("runs", "").split(",") if one]
    if not 2 <= len(set(which)) == len(which) <= 8:
        raise request_wrong("name two to eight different runs", "runs", "?runs=ID,ID")
    archived, rehearsals = asks_for(request, "archived"), asks_for(request, "rehearsals")
    for one in which:
        if not (await off(partial(site.store.place, one)) / LOG).is_file():
            raise NotThere("this run has no log", where=f"run {one}")
        if not archived and (await off(partial(site.store.annotations, one))).archived:
            raise request_wrong("this run is archived", f"run {one}", "Add archived=true, or leave it out")
        if not rehearsals and await off(partial(site.store.rehearsed, one)):
            raise request_wrong("this run is a rehearsal of faults", f"run {one}",
                                "Add rehearsals=true, or leave it out")
    asked = {"runs": which, "runs_folder": str(site.store.runs)}
    return CompareView(which, await off(partial(_asked_at, site, which, await site.work("compare", None, asked))))


def _asked_at(site: Site, which: list[str], comparison: dict[str, Any]) -> dict[str, Any]:
    """Return the comparison with the time of each run's request, as on every page, and whether it was uploaded."""
    requests = [site.store.request(one) for one in which]
    times = [one.asked for one in requests]
    return {
        **comparison,
        "results": [{**one, "date": of.asked, "uploaded": of.uploaded is not None}
                    for one, of in zip(comparison["results"], requests, strict=False)],
        "settings": [{**one, "values": times, "differs": True} if one["name"] == "date" else one
                     for one in comparison["settings"]],
    }


async def run(site: Site, request: Request, body: None) -> RunView:
    """Return one run."""
    return await off(lambda: site.run_view(request.path_params["run"]))


async def confirm(site: Site, request: Request, body: ConfirmBody) -> RunView:
    """Confirm motion with the code from the terminal at the rig."""
    which, who = request.path_params["run"], principal(request).name
    code = body.code.replace(" ", "")
    _require_key(body.lease, "lease")
    await off(lambda: site.supervisor.confirm(which, code, body.binding, who, body.lease))
    return await off(lambda: site.run_view(which))


async def renew(site: Site, request: Request, body: LeaseBody) -> LeaseView:
    """Renew the lease of a watched run."""
    which, who = request.path_params["run"], principal(request).name
    _require_key(body.key, "key")
    _require_key(body.new_key, "new_key")
    renewed = partial(site.supervisor.renew, which, body.key, who, new_key=body.new_key, gone=body.gone)
    return LeaseView(which, await anyio.to_thread.run_sync(renewed, limiter=site.leases), LEASE_S)


def _require_key(key: str | None, where: str) -> None:
    if key is not None and not 16 <= len(key) <= 200:
        raise request_wrong("must have 16 to 200 characters", where, "Use a random key")


async def stop(site: Site, request: Request, body: Any) -> RunView:
    """Stop the run."""
    which, who = request.path_params["run"], principal(request).name
    site.metrics.stops_asked.inc()
    site.stop_beside(which, await site.at_once(partial(site.supervisor.held_beside, which)), who)
    status = await site.shared_stop(
        f"run {which}", partial(site.supervisor.stop, which, who),
        lambda: site.supervisor.note(who, "stop asked", which, None, joined=True))
    return await site.at_once(partial(site.run_view, which, status))


async def sign_off(site: Site, request: Request, body: SignOffBody) -> RunView:
    """Sign off a stop that was not confirmed."""
    which, who = request.path_params["run"], principal(request).name
    if not body.note.strip() or len(body.note) > 500:
        raise ValuesWrong([("note", "must be 1 to 500 characters: state what you saw")])
    await off(lambda: site.supervisor.sign_off(which, who, body.note))
    return await off(lambda: site.run_view(which))


async def annotate(site: Site, request: Request, body: AnnotationsBody) -> RunView:
    """Edit tags, operator, note, customer, order number and place of a run."""
    which, who = request.path_params["run"], principal(request).name
    await off(lambda: site.records.annotate(which, who, tags=body.tags,
                                            **{name: getattr(body, name) for name in STATED}))
    return await off(lambda: site.run_view(which))


async def archive(site: Site, request: Request, body: ArchiveBody) -> RunView:
    """Archive a run, or show it again."""
    which, who = request.path_params["run"], principal(request).name
    await off(lambda: site.records.archive(which, who, archived=body.archived))
    return await off(lambda: site.run_view(which))


async def delete_run(site: Site, request: Request, body: DeleteBody) -> DeletedView:
    """Delete a run with all its files."""
    which, who = request.path_params["run"], principal(request).name
    return DeletedView(which, *await off(lambda: site.records.delete(which, who, body.confirm)))


async def acceptance(site: Site, request: Request, body: None) -> AcceptanceView:
    """Return the acceptance of a run."""
    return await off(lambda: _acceptance_of(site, request.path_params["run"]))


async def sign_acceptance(site: Site, request: Request, body: SignatureBody) -> AcceptanceView:
    """Sign the acceptance of a run with the highest role of the client."""
    which, who = request.path_params["run"], principal(request)
    role = next(one for one in reversed(ROLES) if one in who.roles)
    await off(lambda: site.records.sign_acceptance(
        which, who.name, role, name=body.name, verdict=body.verdict, log_sha256=body.log_sha256, remark=body.remark))
    return await off(lambda: _acceptance_of(site, which))


def _acceptance_of(site: Site, run: str) -> AcceptanceView:
    found, log_sha256 = site.records.acceptance(run)
    signature = site.records.signature(run)
    problem = "" if signature is None else signature.problem(
        found, log_sha256, site.supervisor.audit.last_details(SIGNED, run))
    return AcceptanceView(run, found, log_sha256, signature, problem)


# ---------------------------------------------------------------------------------------------------------------------
# Replays: a run is identified again.


def settings_of(body: ReplayBody | FleetBody) -> dict[str, Any]:
    """Return the settings of an identification. Raises UsageError for values outside the limits of a run."""
    given = {one.name: getattr(body, one.name) for one in ASKED_AGAIN}
    found = options_of(given)
    resolve(found, None)
    return found


async def ask_replay(site: Site, request: Request, body: ReplayBody) -> tuple[int, ReplayView]:
    """Identify the run again, in the background. Its first result is kept."""
    which, who = request.path_params["run"], principal(request).name
    asked = settings_of(body)
    before = await off(lambda: next((one for one in site.replays(which) if _answers(one, asked)), None))
    if before is not None:
        return 200, before
    view = await off(lambda: _new_replay(site, which, asked, who))
    rig = (await off(lambda: site.store.request(which))).rig
    site.supervisor.note(who, f"replay {view.name} asked", which, rig, options=asked)
    site.in_background(_replay_later(site, which, view))
    return 202, view


def _answers(made: ReplayView, asked: Mapping[str, Any]) -> bool:
    """Return whether this replay has these settings and this version, so that its result would be the same."""
    return made.asked == asked and made.result is not None and made.result.get("tdhil") == __version__


def _new_replay(site: Site, which: str, asked: dict[str, Any], who: str) -> ReplayView:
    folder = site.store.place(which)
    site.store.require_finished_log(which)
    with site.replay_names:
        _written(lambda: (folder / "replays").mkdir(exist_ok=True), which)
        taken = [int(name) for name, _ in site.store.replays(which)] + [
            int(name) for at, name in site.waiting_replays if at == which]
        view = ReplayView(f"{max(taken, default=0) + 1:03d}", asked, now(), who, "waiting")
        kept = {**plain(view, ReplayView), BEGUN_BY: site.start_id}
        _written(lambda: write_json(folder / "replays" / f"{view.name}.json", kept), which)
        site.waiting_replays[which, view.name] = view
    return view


def _written(write: Callable[[], None], which: str) -> None:
    """Write a part of an accepted replay. Raises LogError."""
    try:
        write()
    except OSError as error:
        raise LogError(f"the replay can't be written ({error.strerror or error})", where=f"run {which}",
                       next_step="Nothing was started. Free some disk space, or check the folder"
                       " of the service") from error


async def _replay_later(site: Site, which: str, view: ReplayView) -> None:
    """Execute a replay as soon as no shaft of this service may turn."""
    try:
        while (holder := await off(site.supervisor.turned_by)) is not None:
            site.waiting_replays[which, view.name] = replace(view, state="delayed", holder=holder)
            await anyio.sleep(0.5)
        site.waiting_replays[which, view.name] = view
        found = await site.work("replay", which, view.asked)
        done = ReplayView(view.name, view.asked, view.at, view.by, "done", found)
    except TdhilError as error:
        done = ReplayView(view.name, view.asked, view.at, view.by, "failed", error=error_view(error).error)
    except Exception as error:                 # such as no memory for a process: the page must not wait for ever
        traceback.print_exception(error)
        what = f"the replay can't be computed ({getattr(error, 'strerror', None) or error})"
        done = ReplayView(view.name, view.asked, view.at, view.by, "failed", error=error_view(
            LogError(what, where=f"run {which}", next_step="Repeat it later")).error)
    name = f"{view.name}.json"
    try:
        await off(lambda: write_json(site.store.place(which) / "replays" / name, plain(done, ReplayView)))
    except NotThere:                           # the run was deleted meanwhile
        site.waiting_replays.pop((which, view.name), None)
    except OSError as error:
        lost = error_view(LogError(f"the replay can't be written ({error.strerror or error})", where=name)).error
        site.waiting_replays[which, view.name] = ReplayView(
            view.name, view.asked, view.at, view.by, "failed", error=lost)
    else:
        site.waiting_replays.pop((which, view.name), None)


async def replay(site: Site, request: Request, body: None) -> ReplayView:
    """Return one replay. Raises NotThere."""
    which, name = request.path_params["run"], request.path_params["replay"]
    found = next((one for one in await off(lambda: site.replays(which)) if one.name == name), None)
    if found is None:
        raise NotThere("this replay does not exist", where=f"run {which[:40]}")
    return found
