"""One page over all studies of a run: index.html with jinja2, index.md without."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tdhil.report.page import STYLE
from tdhil.studies.output import Written
from tdhil.studies.study import StudyOutcome
from tdhil.study.write_numbers import shown
from tdhil.study.write_terminal import MARKS


@dataclass(frozen=True)
class Chapter:
    """One study in the report; ``failure`` says why there is no outcome."""

    name: str
    outcome: StudyOutcome | None
    written: Written | None
    failure: str = ""


def write_report(chapters: Sequence[Chapter], folder: Path) -> Path:
    """The index of everything in ``folder``; the other kind of an earlier run is removed."""
    folder.mkdir(parents=True, exist_ok=True)
    try:
        text, path = _html(chapters, folder), folder / "index.html"
    except ModuleNotFoundError as error:
        if error.name != "jinja2":
            raise
        text, path = _markdown(chapters, folder), folder / "index.md"
    for old in (folder / "index.html", folder / "index.md"):
        if old != path:
            old.unlink(missing_ok=True)
    path.write_text(text, encoding="utf-8")
    return path


def tally(chapters: Sequence[Chapter]) -> str:
    """How many statements hold, don't, or are open."""
    counted = Counter(s.holds for chapter in chapters if chapter.outcome for s in chapter.outcome.statements)
    return f"{counted[True]} statements hold, {counted[False]} do not, {counted[None]} are open"


def _html(chapters: Sequence[Chapter], folder: Path) -> str:
    from jinja2 import Environment
    from markupsafe import Markup

    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters["shown"] = shown
    template = environment.from_string(_TEMPLATE)
    return template.render(chapters=chapters, tally=tally(chapters), marks=MARKS, beside=_beside(folder),
                           style=Markup(STYLE))


def _beside(folder: Path):  # type: ignore[no-untyped-def]
    return lambda path: path.relative_to(folder).as_posix()


def _markdown(chapters: Sequence[Chapter], folder: Path) -> str:
    lines = ["# Paper and program, side by side", "", tally(chapters), ""]
    for chapter in chapters:
        outcome, written = chapter.outcome, chapter.written
        lines += [f"## {chapter.name}: {outcome.title}" if outcome else f"## {chapter.name}", ""]
        if outcome is None or written is None:
            lines += [f"No result: {chapter.failure}", ""]
            continue
        if written.picture is not None:
            lines += [f"![{outcome.name}]({written.picture.relative_to(folder).as_posix()})", ""]
        for table in outcome.tables:
            lines += [f"**{table.name}**", "", "| " + " | ".join(table.columns) + " |"]
            lines.append("|" + "---|" * len(table.columns))
            lines += ["| " + " | ".join(shown(cell) for cell in row) + " |" for row in table.rows]
            lines.append("")
        for statement in outcome.statements:
            mark, word, _ = MARKS[statement.holds]
            lines.append(f"- {mark} {statement.text} ({word}). Published: {statement.published}. Ours: "
                         f"{statement.ours}.")
        lines.append("")
    return "\n".join(lines)


_TEMPLATE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>Paper and program, side by side</title>
<meta name="viewport" content="width=device-width">
<style>
{{ style }}
</style></head><body>
<h1>Paper and program, side by side</h1>
<p>Xu et al., <i>Appl. Sci.</i> 2026, 16, 2012, beside what comes out here. {{ tally }}. Everything here is SIMULATED;
figures 19 to 23 through the drive's own bus protocol.</p>
<nav>{% for c in chapters %}<a href="#{{ c.name }}">{{ c.name }}</a> {% endfor %}</nav>
{% for c in chapters %}
<h2 id="{{ c.name }}">{{ c.name }}{% if c.outcome %}: {{ c.outcome.title }}{% endif %}</h2>
{% if not c.outcome %}<p class="red">No result: {{ c.failure }}</p>{% else %}
{% if c.written.picture %}<p><a href="{{ beside(c.written.vector) }}"><img src="{{ beside(c.written.picture) }}"
alt="{{ c.outcome.title }}"></a></p>{% endif %}
<div class="wide"><table class="claims"><tr><th></th><th>statement</th><th>published</th><th>ours</th></tr>
{% for s in c.outcome.statements %}<tr><td class="{{ marks[s.holds][2] }}" title="{{ marks[s.holds][1] }}">\
{{ marks[s.holds][0] }}</td><td>{{ s.text }}</td><td>{{ s.published }}</td><td>{{ s.ours }}</td></tr>
{% endfor %}</table></div>
{% for t in c.outcome.tables %}<div class="wide"><table><caption>{{ t.name }}</caption>
<tr>{% for column in t.columns %}<th>{{ column }}</th>{% endfor %}</tr>
{% for row in t.rows %}<tr>{% for cell in row %}<td>{{ cell|shown }}</td>{% endfor %}</tr>
{% endfor %}</table></div>{% endfor %}
<p>Files: {% for path in c.written.files %}<a href="{{ beside(path) }}">{{ path.name }}</a> {% endfor %}</p>
{% endif %}{% endfor %}
<p>✓ holds · ✗ does not hold · ~ open: the paper contradicts itself or leaves out what decides</p>
</body></html>
"""
