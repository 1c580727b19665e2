"""The pages of the service: templates with the views of the API, and the login page."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from hashlib import sha256
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from starlette.exceptions import HTTPException
from starlette.responses import HTMLResponse, RedirectResponse, Response
from starlette.routing import BaseRoute, Route

from tdhil.config import OPTION, STATED, Option, Origin, Setting, form_options
from tdhil.errors import TdhilError
from tdhil.report import GRAPHS
from tdhil.runner import MEAN_SPEED_SHARES
from tdhil.service.access import principal, require
from tdhil.service.accounts import Role
from tdhil.service.api_page import api_page
from tdhil.service.languages import Language, language_of, languages
from tdhil.service.limits import STOP_S
from tdhil.service.middleware import off
from tdhil.service.start_request import limits_text, number_with_unit
from tdhil.version import __version__

if TYPE_CHECKING:
    from starlette.requests import Request

    from tdhil.service.site import Site

HERE: Final = Path(str(files("tdhil.service")))
_OF_HERE: Final = re.compile(r"/(?![/\\])[\x21-\x5b\x5d-\x7e]*")
"""Pattern of addresses to which a login may redirect: paths of this service only."""
_MEDIA: Final = {".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}
AS_RIG: Final = "as rig.yaml, else "
"""First part of the text of an empty field whose value the rig's file may state (`Option.form_hint`)."""


def _to_start(site: Site, rig: str) -> dict[str, Any]:
    """Return the view of a rig, and the settings and the expected values that its run has without any request."""
    found = site.supervisor.rigs.get(rig)
    known: dict[str, Any] = {"rig": site.rig_view(found), "settings": {}, "expected": {}}
    with suppress(TdhilError):                 # an unusable rig has none
        known |= {"settings": found.way()[0].settings, "expected": {} if found.rig is None else found.rig.acceptance}
    return known


def _applies(language: Language, option: Option, settings: Mapping[str, Setting]) -> str | Markup:
    """Return the text of an empty field of a form: the value that applies, from the rig's file or built in."""
    setting = settings.get(option.name)
    if setting is not None and setting.origin is Origin.RIG_FILE and setting.value is not None and not option.joined:
        number = isinstance(setting.value, int | float)
        value = number_with_unit(option, setting.value).replace(".", language.decimal) if number else setting.value
        return language.text("{value} (rig's file)", value=value)
    hint = option.form_hint
    if hint.startswith(AS_RIG):
        value = language.word(hint.removeprefix(AS_RIG)).replace(".", language.decimal)
        return language.text("default: {value}", value=value)
    return language.word(hint)


def _about(language: Language, option: Option) -> str:
    """Return the help of an option with its limits, in a language."""
    said = language.word(option.form_help)
    text, values = limits_text(option)
    if not text:
        return f"{said[0].upper()}{said[1:]}."
    values = {name: value.replace(".", language.decimal) for name, value in values.items()}
    return f"{said[0].upper()}{said[1:]}; {language.text(text, **values)}."


class Pages:
    """Templates and routes of the pages, in each language."""

    def __init__(self, site: Site) -> None:
        self._site = site
        self._languages = languages()
        self._templates: dict[str, Environment] = {}
        self._files = {f"/static/{one.name}": one.read_bytes() for one in (HERE / "static").iterdir()}
        self._files |= {f"/texts/{tag}.js": one.script().encode() for tag, one in self._languages.items()}
        # A browser keeps a file whose address has the hash of its content: another content has another address.
        self._kept = {path: f"{path}?{sha256(found).hexdigest()[:16]}" for path, found in self._files.items()}
        for tag, language in self._languages.items():
            # In a template ``_("text")`` is a text, and ``word(text)`` one that varies.
            found = Environment(
                loader=FileSystemLoader(HERE / "templates"), autoescape=True, undefined=StrictUndefined,
                trim_blocks=True, lstrip_blocks=True)
            found.globals.update(
                version=__version__, stop_s=STOP_S, form_options=form_options,
                stated_options=[OPTION[name] for name in STATED], language=language, languages=self._languages.values(),
                graphs=GRAPHS, kept=self._kept.__getitem__, _=language.text, word=language.word,
                hint=partial(_applies, language, settings={}), applies=partial(_applies, language),
                about=partial(_about, language), stage_2=MEAN_SPEED_SHARES,
                code=Markup("<code>{}</code>").format, strong=Markup("<strong>{}</strong>").format,
                speed_unit=Markup("<span data-speed-unit>rad/s</span>"))
            found.filters["number"] = language.number
            self._templates[tag] = found

    def render(self, request: Request, template: str, here: str, status: int = 200, **known: Any) -> Response:
        """Return a page in the language of the request. ``here``: the page's entry in the menu."""
        templates = self._templates[language_of(request, self._languages)]
        text = templates.get_template(template).render(
            here=here, who=principal(request), login=self._site.access.login, **known)
        return HTMLResponse(text, status, {"vary": "Accept-Language, Cookie"})

    def routes(self) -> list[BaseRoute]:
        """Return the routes: every page with its template, its entry in the menu and its least role."""
        return [
            self._page("/", "rigs.html", "rigs"),
            self._page("/new-rig", "new_rig.html", "rigs", "engineer"),
            self._page("/rigs/{rig}", "history.html", "rigs"),
            self._page("/rigs/{rig}/file", "rig_file.html", "rigs"),
            self._page("/start/{rig}", "start.html", "rigs"),
            self._page("/runs", "runs.html", "runs"),
            self._page("/upload", "upload.html", "runs"),
            self._page("/runs/{run}", "run.html", "runs"),
            self._page("/runs/{run}/live", "live.html", "runs"),
            self._page("/calibrate/{rig}", "calibrate.html", "rigs"),
            self._page("/rehearse/{rig}", "rehearse.html", "rigs"),
            self._page("/compare", "compare.html", "runs"),
            self._page("/fleets", "fleets.html", "fleets"),
            self._page("/fleets/{fleet}", "fleet.html", "fleets"),
            self._page("/letterhead", "letterhead.html", "letterhead", "admin"),
            self._page("/audit", "audit.html", "audit", "admin"),
            self._page("/accounts", "accounts.html", "accounts"),
            self._page("/docs", "docs.html", "docs"),
            Route("/login", self._login),
            Route("/favicon.ico", lambda request: RedirectResponse("/static/icon.svg")),
            *(Route(f"/{folder}/{{name}}", self._file) for folder in ("static", "texts")),
        ]

    def _page(self, path: str, template: str, here: str, role: Role = "viewer") -> Route:
        site = self._site
        view_of: Mapping[str, Callable[[str], Any]] = {
            "rig": lambda rig: site.rig_view(site.supervisor.rig(rig)), "run": site.run_view, "fleet": site.fleets.get}

        async def serve(request: Request) -> Response:
            require(principal(request), role, route=request.url.path, open_here=not site.access.login)
            known: dict[str, Any] = {}
            for name, one in request.path_params.items():
                if template == "start.html":
                    known = await off(partial(_to_start, site, one))
                else:
                    known[name] = await off(partial(view_of[name], one))
            if template in ("rigs.html", "new_rig.html"):
                known["folder"] = site.supervisor.rigs.folder is not None
                known["built_in"] = await off(lambda: site.supervisor.rigs.built_in)
            if template == "runs.html":
                known["rig_names"] = await off(lambda: {one.id: one.name for one in site.supervisor.rigs.all()})
            if here == "docs":
                known["api"] = await off(api_page)
            return self.render(request, template, here, **known)

        return Route(path, serve)

    async def _file(self, request: Request) -> Response:
        if (found := self._files.get(path := request.url.path)) is None:
            raise HTTPException(404)
        kept = f"{path}?{request.url.query}" == self._kept[path]
        return Response(found, media_type=_MEDIA.get(Path(path).suffix, "text/plain"),
                        headers={"cache-control": "max-age=31536000, immutable"} if kept else None)

    async def _login(self, request: Request) -> Response:
        there = request.query_params.get("next", "/")
        there = there if _OF_HERE.fullmatch(there) else "/"
        if principal(request).roles or not self._site.access.login:
            return RedirectResponse(there, 303)
        return self.render(request, "login.html", "login", next=there)
