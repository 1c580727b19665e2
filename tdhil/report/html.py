"""The result as one HTML file that needs nothing beside it: verdict, pictures, every number."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tdhil.errors import UsageError
from tdhil.record.recording import Recording
from tdhil.report.card_parts import estimate_text, inertia_text
from tdhil.report.document import SIMULATED
from tdhil.report.html_rows import estimate_rows, fact_rows
from tdhil.report.html_template import TEMPLATE
from tdhil.report.numbers import minutes, percent, plus_minus
from tdhil.report.page import STYLE, inline_svg, require_extra

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLOURS = {"valid": "green", "valid_wide": "yellow", "not_identifiable": "red", "model_rejected": "red"}
_VERDICTS = {
    "valid": "valid: the interval is as narrow as was asked for",
    "valid_wide": "valid, but wide: the interval holds, and is wider than was asked for",
    "not_identifiable": "not identifiable: these data can't tell the inertia",
    "model_rejected": "model rejected: these data contradict every model that was tried",
}


def check_report_path(path: Path, log: Path, where: str = "--report") -> None:
    """Before anything moves: can a report be made, and put there? Never over an older file. Raises UsageError."""
    require_extra(where)
    if path.resolve() == log.resolve():
        raise UsageError("is the log itself", where=f"{where} {path}", next_step="Such as report.html")
    if path.is_dir():
        raise UsageError("is a folder; a report is a file", where=f"{where} {path}", next_step="Such as report.html")
    if path.exists() and (path.is_file() or path.is_symlink()):
        raise UsageError("is there already, and is left as it is", where=f"{where} {path}",
                         next_step=f"Name another file, such as {fresh(path).name}, or move that one away")
    if not path.parent.is_dir():
        raise UsageError("there is no such folder", where=f"{where} {path}", next_step=f"Make {path.parent} first")


def fresh(path: Path) -> Path:
    """``path``, or the first of report-2.html, report-3.html … that isn't there."""
    number, found = 1, path
    while found.exists():
        number += 1
        found = path.with_name(f"{path.stem}-{number}{path.suffix}")
    return found


def write_report(document: Mapping[str, Any], recording: Recording, path: Path) -> Path:
    """Write the page, and where it went: beside a file that has come there meanwhile. Raises UsageError."""
    text = report_page(document, recording)
    if path.is_file():
        path = fresh(path)
    try:
        with path.open("x" if not path.exists() else "w", encoding="utf-8") as file:
            file.write(text)
        return path
    except OSError as error:
        raise UsageError(f"can't be written ({error.strerror or error})", where=f"--report {path}") from error


def report_page(document: Mapping[str, Any], recording: Recording) -> str:
    """The page; the same document and recording give the same text."""
    from jinja2 import Environment
    from markupsafe import Markup

    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters.update(minutes=minutes)
    environment.globals.update(interval=estimate_text, plus_minus=plus_minus, percent=percent, inertia=inertia_text)
    environment.globals.update(total=partial(inertia_text, kind="_total"))
    pictures = {name: Markup(svg) for name, svg in _pictures(document, recording).items()}     # our own SVG
    return environment.from_string(TEMPLATE).render(
        d=document,
        style=Markup(STYLE),
        pictures=pictures,
        colour=_COLOURS.get(document["verdict"], "red"),
        verdict=_VERDICTS.get(document["verdict"], document["verdict"]),
        estimates=estimate_rows(document),
        facts=fact_rows(document, recording),
        simulated=SIMULATED,
    )


def _pictures(document: Mapping[str, Any], recording: Recording) -> dict[str, str]:
    """Only those that there is something to draw in."""
    from tdhil.report.picture_run import draw_run
    from tdhil.report.pictures import draw_budget, draw_friction, draw_lines, draw_opinions

    def with_document(draw: Any) -> Any:
        def drawn(figure: Figure) -> None:
            draw(figure, document)

        return drawn

    found: dict[str, str] = {}
    if len(recording.time_s):
        found["run"] = inline_svg(partial(draw_run, recording=recording), (9.0, 4.8))
    if document["inertia_kg_m2"] is not None or document["second_opinions"]:
        found["opinions"] = inline_svg(with_document(draw_opinions), (9.0, 2.6))
    if document["lines"]:
        found["lines"] = inline_svg(with_document(draw_lines), (9.0, 5.0))
    if document["budget"]:
        found["budget"] = inline_svg(with_document(draw_budget), (9.0, 0.8 + 0.35 * len(document["budget"])))
    if document["friction_curve"]:
        found["friction"] = inline_svg(with_document(draw_friction), (9.0, 3.6))
    return found
