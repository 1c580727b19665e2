"""Result as one self-contained file, HTML or PDF by its name: verdict, figures, all numbers."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from html import unescape
from importlib.resources import files
from pathlib import Path
from typing import Any

from tdhil.errors import MessageCode, UsageError, existing_file
from tdhil.file_hash import sha256_of
from tdhil.recording import Recording
from tdhil.report.blocks import WIDTH_IN, Picture, Report, report_of
from tdhil.report.letterhead import NO_LETTERHEAD, Letterhead
from tdhil.report.page import inline_svg, require_extra

PDF = ".pdf"
_SUFFIXES = (PDF, ".html", ".htm")
_PARTS = re.compile(
    r"<h2>(?P<heading>[^<]*)</h2>|<figure>(?P<svg><svg.*?</svg>)\s*<figcaption>(?P<caption>[^<]*)<", re.DOTALL)
_TEMPLATE, _STYLE = (files("tdhil.report").joinpath(name).read_text("utf-8")
                     for name in ("report.html.j2", "report.css"))
"""Template and style, read at import: at the end of a run there may be no file descriptor left."""


def check_report_path(path: Path, *inputs: Path, where: str = "--report") -> None:
    """Check before motion that a report can be written, and replaces no older file. Raises UsageError.

    ``inputs``: the log, or other files that the report must not replace.
    """
    require_extra(where)
    if any(path.resolve() == one.resolve() for one in inputs):
        raise UsageError("is the log itself", where=f"{where} {path}", next_step="Such as report.html or report.pdf",
                         entry=MessageCode.SAME_FILE_TWICE)
    if path.is_dir():
        raise UsageError("is a folder; a report is a file", where=f"{where} {path}", next_step="Such as report.html",
                         entry=MessageCode.FILE_NOT_WRITABLE)
    if path.exists() and (path.is_file() or path.is_symlink()):
        raise existing_file(f"{where} {path}")
    if path.suffix.lower() not in _SUFFIXES and not path.exists():      # an existing path here is a device
        raise UsageError("ends neither in .html nor in .pdf", where=f"{where} {path}",
                         next_step="Name the file report.html or report.pdf",
                         entry=MessageCode.VALUE_NOT_ALLOWED)
    if not path.parent.is_dir():
        raise UsageError("there is no such folder", where=f"{where} {path}", next_step=f"Make {path.parent} first",
                         entry=MessageCode.FILE_NOT_WRITABLE)


def fresh(path: Path) -> Path:
    """Return ``path``, or the first of report-2.html, report-3.html … that does not exist."""
    number, found = 1, path
    while found.exists():
        number += 1
        found = path.with_name(f"{path.stem}-{number}{path.suffix}")
    return found


def write_report(
    document: Mapping[str, Any], recording: Recording, path: Path, letterhead: Letterhead = NO_LETTERHEAD
) -> Path:
    """Write a report of a finished log, HTML or PDF by its name, and return its path.

    The path differs if such a file was created meanwhile. Raises UsageError if the report cannot be written.
    """
    try:
        return _put(replace(report_of(document, recording, log_hash(document)), letterhead=letterhead), path)
    except OSError as error:      # of the file, or of a module or a font that cannot be read without a file descriptor
        raise UsageError(
            f"can't be written ({error.strerror or error})",
            where=f"--report {path}",
            next_step=f"The run and its log are whole: tdhil replay {document['log']} --report {path.name}",
            entry=MessageCode.FILE_NOT_WRITABLE,
        ) from error


def write_blocks(report: Report, path: Path) -> Path:
    """Write any report, HTML or PDF by its name, and return its path. Raises UsageError if it cannot be written."""
    try:
        return _put(report, path)
    except OSError as error:
        raise UsageError(f"can't be written ({error.strerror or error})", where=f"--report {path}",
                         entry=MessageCode.FILE_NOT_WRITABLE) from error


def _put(report: Report, path: Path) -> Path:
    if path.suffix.lower() == PDF:
        from tdhil.report.pdf import pdf_bytes

        data = pdf_bytes(report)
    else:
        data = report_page(report).encode()
    if path.is_file():
        path = fresh(path)
    with path.open("xb" if not path.exists() else "wb") as file:
        file.write(data)
    return path


def log_hash(document: Mapping[str, Any]) -> str:
    """Return the SHA-256 of the document's log in hex; '' if it can't be read, since a report needs no log."""
    try:
        return sha256_of(Path(document["log"]))
    except UsageError:
        return ""


@dataclass(frozen=True)
class ShownPicture:
    """Figure of a page, as a separate SVG, with the heading above and the text below it."""

    heading: str
    caption: str
    svg: str


def pictures_in(page: str) -> tuple[ShownPicture, ...]:
    """Return the figures of a page from `report_page`, in order."""
    found, heading = [], ""
    for part in _PARTS.finditer(page):
        if part["heading"] is not None:
            heading = unescape(part["heading"])
        else:
            found.append(ShownPicture(heading, unescape(part["caption"]), part["svg"]))
    return tuple(found)


def report_page(report: Report) -> str:
    """Return the page; the same report gives the same text."""
    from jinja2 import Environment
    from markupsafe import Markup

    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)

    def picture(block: Picture) -> Markup:                      # SVG made by tdhil
        return Markup(inline_svg(block.draw, (WIDTH_IN, block.height_in), names_left=block.names_left))

    return environment.from_string(_TEMPLATE).render(
        r=report, style=Markup(_STYLE), picture=picture, kind_of=lambda block: type(block).__name__
    )
