"""The result as one file that needs nothing beside it, HTML or PDF by its name: verdict, pictures, every number."""

from __future__ import annotations

from collections.abc import Mapping
from hashlib import file_digest
from pathlib import Path
from typing import Any

from tdhil.errors import UsageError
from tdhil.recording.recording import Recording
from tdhil.report.content import WIDTH_IN, Picture, Report, report_of
from tdhil.report.page import inline_svg, require_extra

# ---------------------------------------------------------------------------------------------------------------------
# The report's page, for jinja2: the blocks of `report.content`, for the screen and for A4. It loads nothing.


STYLE = """\
@page { size: A4; margin: 15mm 16mm 16mm }
* { box-sizing: border-box }
body { font: 14px/1.45 "DejaVu Sans", system-ui, sans-serif; max-width: 52rem; margin: 2rem auto; padding: 0 1rem;
  color: #222 }
h1 { font-size: 1.55rem; margin: 0 }
h2 { font-size: 1.08rem; margin: 1.5rem 0 .4rem; border-bottom: 1px solid #bbb; padding-bottom: .15rem }
p { margin: .35rem 0 }
.subtitle { color: #555; margin: .1rem 0 1rem }
.banner { background: #a21caf; color: #fff; padding: .45rem .9rem; font-weight: 700; margin-bottom: 1rem }
.answer { border: 1px solid #ddd; border-left: .5rem solid; padding: .5rem 1rem; margin: .8rem 0 }
.answer.green { border-left-color: #1a7f37 } .answer.yellow { border-left-color: #8a6100 }
.answer.red { border-left-color: #b42318 }
.green .verdict { color: #1a7f37 } .yellow .verdict { color: #8a6100 } .red .verdict { color: #b42318 }
.big { font-size: 1.6rem; line-height: 1.25; font-weight: 700 }
.verdict { font-weight: 700 }
.advice { font-style: italic }
.warn { background: #fff8e6; border-left: .25rem solid #8a6100; padding: .3rem .8rem }
table { border-collapse: collapse; margin: .5rem 0; font-size: 12.5px; width: 100% }
th, td { border-bottom: 1px solid #ddd; padding: .18rem .5rem; text-align: left; vertical-align: top;
  overflow-wrap: anywhere }
thead th { background: #f4f4f4; font-weight: 600 }
.number { text-align: right; white-space: nowrap }
.pairs th { font-weight: 400; color: #555; width: 30% }
figure { margin: .4rem 0 } figcaption { color: #555; font-size: 12.5px }
svg { max-width: 100%; height: auto; display: block }
footer { color: #777; font-size: 11.5px; margin-top: 1.5rem }
@media print {
  body { margin: 0; padding: 0; max-width: none; font-size: 9pt; line-height: 1.3; print-color-adjust: exact;
    -webkit-print-color-adjust: exact }
  h1 { font-size: 17pt } .big { font-size: 15pt }
  table, figcaption { font-size: 8pt; line-height: 1.25 }
  th, td { padding: 1.5pt 5pt }
  p, figure, .answer { margin: 3pt 0 } table { margin: 4pt 0 } .subtitle { margin: 0 0 6pt }
  .banner { padding: 3pt 8pt; margin-bottom: 8pt; font-size: 8pt }
  .answer { padding: 5pt 10pt }
  h2 { break-after: avoid; font-size: 10.5pt; margin: 9pt 0 3pt }
  figure, .answer, .warn, tr, table { break-inside: avoid }
  thead { display: table-header-group }
  p { orphans: 3; widows: 3 }
}
"""

TEMPLATE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8">
<title>{{ r.title }}{% if r.subtitle %} · {{ r.subtitle }}{% endif %}{% if r.simulated %} (SIMULATED){% endif %}</title>
<meta name="viewport" content="width=device-width">
<style>
{{ style }}</style></head><body>
{% if r.simulated %}<div class="banner">{{ r.simulated }}</div>
{% endif %}
<h1>{{ r.title }}</h1>
<p class="subtitle">{{ r.subtitle }}</p>
<div class="answer {{ r.answer.colour }}">
<p class="big">{{ r.answer.value }}</p>
{% for line in r.answer.lines %}<p>{{ line }}</p>
{% endfor %}
<p class="verdict">{{ r.answer.verdict }}</p>
<p>{{ r.answer.reason }}{% if r.answer.advice %} <span class="advice">{{ r.answer.advice }}</span>{% endif %}</p>
</div>
{% for warning in r.warnings %}<p class="warn">{{ warning }}</p>
{% endfor %}
{% for section in r.sections %}<section><h2>{{ section.heading }}</h2>
{% for block in section.blocks %}{% set kind = kind_of(block) %}
{% if kind == "Text" %}<p>{{ block.text }}</p>
{% elif kind == "Picture" %}<figure>{{ picture(block) }}<figcaption>{{ block.caption }}</figcaption></figure>
{% elif kind == "Pairs" %}<table class="pairs">
{% for name, text in block.rows %}<tr><th>{{ name }}</th><td>{{ text }}</td></tr>
{% endfor %}</table>
{% else %}<table><thead><tr>\
{% for column in block.columns %}<th style="width: {{ "%.4g"|format(100 * column.share) }}%"\
{% if column.number %} class="number"{% endif %}>{{ column.title }}</th>{% endfor %}</tr></thead>
{% for row in block.rows %}<tr>{% for cell in row %}<td{% if block.columns[loop.index0].number %} class="number"\
{% endif %}>{{ cell }}</td>{% endfor %}</tr>
{% endfor %}</table>
{% endif %}{% endfor %}</section>
{% endfor %}
<footer>{{ r.footer }}</footer>
</body></html>
"""


# ---------------------------------------------------------------------------------------------------------------------

PDF = ".pdf"


def check_report_path(path: Path, log: Path, where: str = "--report") -> None:
    """Before anything moves: can a report be made, and put there? Never over an older file. Raises UsageError."""
    require_extra(where)
    if path.resolve() == log.resolve():
        raise UsageError("is the log itself", where=f"{where} {path}", next_step="Such as report.html or report.pdf")
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
    """Write a report of a finished log, as PDF where the name ends so; and where it went.

    That is beside a file that has come there meanwhile. Raises UsageError where it can't be written.
    """
    try:
        report = report_of(document, recording, sha256_of(Path(document["log"])))
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
    except OSError as error:      # of the file; or of a module or a font, with no descriptor left to read it by
        raise UsageError(
            f"can't be written ({error.strerror or error})",
            where=f"--report {path}",
            next_step=f"The run and its log are whole: tdhil replay {document['log']} --report {path.name}",
        ) from error


def sha256_of(path: Path) -> str:
    """Of the file as it is now, in hex; '' where it can't be read."""
    try:
        with path.open("rb") as file:
            return file_digest(file, "sha256").hexdigest()
    except OSError:
        return ""


def report_page(report: Report) -> str:
    """The page; the same report gives the same text."""
    from jinja2 import Environment
    from markupsafe import Markup

    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)

    def picture(block: Picture) -> Markup:                      # our own SVG
        return Markup(inline_svg(block.draw, (WIDTH_IN, block.height_in), names_left=block.names_left))

    return environment.from_string(TEMPLATE).render(
        r=report, style=Markup(STYLE), picture=picture, kind_of=lambda block: type(block).__name__
    )
