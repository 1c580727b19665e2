"""Outcome of a study as files (one CSV a table, a PNG and an SVG, the settings) and as a document.

Without matplotlib everything except the plot is written.
"""

from __future__ import annotations

import csv
import math
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel
from rich import box
from rich.console import Console, Group, RenderableType
from rich.padding import Padding
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar
from rich.table import Table
from rich.text import Text

from tdhil.csv_text import cell_of
from tdhil.report import SIMULATED, STYLE, install_command, repeatable_figures
from tdhil.studies.study import Cell, Progress, ResultTable, Statement, Study, StudyOutcome

# ---------------------------------------------------------------------------------------------------------------------
# Numbers of a table for display: one number of decimals for each column.


_DIGITS = 5          # digits of a column's largest number
_MOST_DECIMALS = 5
_WIDE = 1e3          # ratio of a column's numbers beyond which each number has its own decimals


def shown(value: Cell) -> str:
    """Return a single value with six digits at most; '-' for None."""
    if value is None:
        return "-"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def column_texts(values: Sequence[Cell]) -> list[str]:
    """Return the texts of a column, with as many decimals as its largest number has; whole numbers are unchanged."""
    sizes = [abs(value) for value in values if isinstance(value, float) and math.isfinite(value) and value != 0.0]
    whole = all(size == int(size) for size in sizes)
    if not sizes or whole or max(sizes) > _WIDE * min(sizes) or max(sizes) < 1e-3:
        return [f"{value:.{_DIGITS}g}" if isinstance(value, float) and not whole else shown(value) for value in values]
    decimals = min(_MOST_DECIMALS, max(0, _DIGITS - 1 - math.floor(math.log10(max(sizes)))))
    while decimals and all(f"{value:.{decimals}f}".endswith("0") for value in values if isinstance(value, float)):
        decimals -= 1
    return [f"{value:.{decimals}f}" if isinstance(value, float) else shown(value) for value in values]


# ---------------------------------------------------------------------------------------------------------------------
# Progress of the studies, on stderr, because stdout is for results.


LINE_EVERY_S = 60.0


class StudyBar:
    """Progress bar over all studies on a terminal, hidden during other output; elsewhere a line per study and
    minute.
    """

    def __init__(self, console: Console, count: int) -> None:
        self._console = console
        self._told_s = 0.0
        self._bar = Bar(
            TextColumn("{task.fields[name]:<9}"), BarColumn(28), TextColumn("{task.percentage:3.0f} %"),
            TimeElapsedColumn(), TextColumn("{task.description}"), console=console, transient=True,
            redirect_stdout=False, redirect_stderr=False, disable=not console.is_terminal,
        )
        self._task = self._bar.add_task("", total=float(count), name="")

    @contextmanager
    def of(self, index: int, name: str) -> Iterator[Progress]:
        """Show progress while study ``index`` runs."""
        if not self._console.is_terminal:
            self._console.print(f"study {name} …", markup=False)
        self._bar.update(self._task, completed=float(index), name=name, description="")
        self._told_s = time.monotonic()
        with self._bar:
            yield lambda share, text: self._show(index, name, share, text)

    def _show(self, index: int, name: str, share: float, text: str) -> None:
        self._bar.update(self._task, completed=index + share, description=text)
        if not self._console.is_terminal and time.monotonic() - self._told_s >= LINE_EVERY_S:
            self._told_s = time.monotonic()
            self._console.print(f"study {name} {100.0 * share:3.0f} %  {text}", markup=False, soft_wrap=True)


# ---------------------------------------------------------------------------------------------------------------------

INSTALL = f"no pictures without matplotlib; install it with: {install_command()}"
DPI = 120


@dataclass(frozen=True)
class Written:
    """Paths of the files. ``picture``: None without a plot; ``without_matplotlib``: True if that is the reason."""

    folder: Path
    tables: tuple[Path, ...]
    settings: Path
    picture: Path | None = None
    vector: Path | None = None
    without_matplotlib: bool = False

    @property
    def files(self) -> tuple[Path, ...]:
        return tuple(path for path in (*self.tables, self.picture, self.vector, self.settings) if path is not None)


def write_study(outcome: StudyOutcome, settings: BaseModel, folder: Path) -> Written:
    """Write into ``folder``, created if needed. Files of the same names are replaced."""
    folder.mkdir(parents=True, exist_ok=True)
    tables = tuple(folder / f"{table.name}.csv" for table in outcome.tables)
    for table, path in zip(outcome.tables, tables, strict=True):
        with path.open("w", encoding="utf-8", newline="") as file:
            rows = csv.writer(file, lineterminator="\n")
            rows.writerow(table.columns)
            rows.writerows([_cell(value) for value in row] for row in table.rows)
    own = _settings(outcome.name, settings, folder)
    if outcome.draw is None:
        return Written(folder, tables, own)
    picture, vector = folder / f"{outcome.name}.png", folder / f"{outcome.name}.svg"
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        with repeatable_figures():
            figure = Figure(figsize=outcome.figure_size_in)
            FigureCanvasAgg(figure)
            outcome.draw(figure)
            figure.savefig(picture, dpi=DPI)
            figure.savefig(vector, metadata={"Date": None})     # so that the same outcome gives the same file
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "matplotlib":
            raise
        return Written(folder, tables, own, without_matplotlib=True)
    return Written(folder, tables, own, picture, vector)


def document(outcome: StudyOutcome, settings: BaseModel, written: Written) -> dict[str, Any]:
    """Return plain data for `json.dumps`: the study's description, tables and statements. Non-finite values are
    null.
    """
    whole = {
        "study": outcome.name,
        "title": outcome.title,
        "simulated": True,
        "settings": settings.model_dump(mode="json", by_alias=True),
        **outcome.document,
        "tables": {
            table.name: [dict(zip(table.columns, row, strict=True)) for row in table.rows] for table in outcome.tables
        },
        "statements": [asdict(statement) for statement in outcome.statements],
        "simulated_s": outcome.simulated_s,
        "files": [str(path) for path in written.files],
    }
    plain = _plain(whole)
    assert isinstance(plain, dict)
    return plain


def _cell(value: Cell) -> str:
    """Return every digit of a number, so that it reads back unchanged; '' for None."""
    if value is None:
        return ""
    return repr(float(value)) if isinstance(value, float) else cell_of(value) if isinstance(value, str) else str(value)


def _settings(name: str, settings: BaseModel, folder: Path) -> Path:
    """Write a study file, for the user to copy, change and run with --study."""
    import yaml

    path = folder / "study.yaml"
    data = {"study": name, "settings": settings.model_dump(mode="json", by_alias=True)}
    head = f"# What {name} was run with. Copy it, change it, and run it: tdhil study --study my.yaml\n"
    text = yaml.safe_dump(data, sort_keys=False, allow_unicode=True, default_flow_style=None, width=100)
    path.write_text(head + text, encoding="utf-8")
    return path


def _plain(value: Any) -> Any:
    """Return lists, maps and numbers of Python instead of those of numpy."""
    if isinstance(value, Mapping):
        return {str(key): _plain(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return _plain(value.tolist())


# ---------------------------------------------------------------------------------------------------------------------
# Outcome of a study on a terminal of 80 columns: tables, then statements.


MARKS: dict[bool | None, tuple[str, str, str]] = {
    True: ("✓", "holds", "green"),
    False: ("✗", "does not hold", "red"),
    None: ("~", "open: the paper contradicts itself or leaves out what decides", "yellow"),
}
_GAP = 2          # characters between columns


def print_outcome(outcome: StudyOutcome, written: Written, console: Console) -> None:
    """Print the whole outcome, and the paths of the files."""
    console.print(Text.assemble((f"{outcome.name}  {outcome.title}", "bold"), (f"  {SIMULATED}", "magenta")))
    for table in outcome.tables:
        console.print(Text(table.name.replace("_", " "), style="italic"))
        for part in _tables(table, console.width):
            console.print(part)
            console.print()
    console.print(statements(outcome.statements))
    console.print(Text(f"files: {written.folder}", style="dim"), soft_wrap=True)
    console.print()


def print_list(studies: Iterable[Study], console: Console) -> None:
    """Print names and titles of the studies."""
    grid = Table.grid(padding=(0, 2))
    grid.add_column(no_wrap=True)
    grid.add_column(overflow="fold")
    for study in studies:
        grid.add_row(Text(study.name, style="bold"), study.title)
    console.print(grid)


def statements(all_of_them: Iterable[Statement]) -> RenderableType:
    """Return each statement with its mark, the published value and that of tdhil."""
    parts: list[RenderableType] = []
    for statement in all_of_them:
        mark, word, style = MARKS[statement.holds]
        parts.append(Text.assemble((f"{mark} ", style), statement.text, (f"  [{word.partition(':')[0]}]", style)))
        grid = Table.grid(padding=(0, 1))
        grid.add_column(style="dim", no_wrap=True)
        grid.add_column(overflow="fold")
        grid.add_row("published", Text(statement.published))
        grid.add_row("ours", Text(statement.ours))
        parts.append(Padding(grid, (0, 0, 0, 4)))
    return Group(*parts)


def _tables(table: ResultTable, width: int) -> Iterator[Table]:
    """Yield the table in parts that fit the width, each with the first column, so that no number is wrapped."""
    cells = [column_texts([row[index] for row in table.rows]) for index in range(len(table.columns))]
    widths = [
        max([len(word) for word in name.split("_")] + [len(text) for text in texts])
        for name, texts in zip(table.columns, cells, strict=True)
    ]
    part, used = [0], widths[0]
    for index in range(1, len(table.columns)):
        if len(part) > 1 and used + _GAP + widths[index] > width:
            yield _part(table, cells, widths, part)
            part, used = [0], widths[0]
        part.append(index)
        used += _GAP + widths[index]
    yield _part(table, cells, widths, part)


def _part(table: ResultTable, cells: list[list[str]], widths: list[int], columns: list[int]) -> Table:
    drawn = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, _GAP - 1, 0, 0))
    for index in columns:
        numeric = any(isinstance(row[index], int | float) for row in table.rows)
        drawn.add_column(table.columns[index].replace("_", " "), justify="right" if numeric else "left",
                         header_style="dim", vertical="bottom", width=widths[index])
    for number in range(len(table.rows)):
        drawn.add_row(*(Text(cells[index][number], no_wrap=True) for index in columns))
    return drawn


# ---------------------------------------------------------------------------------------------------------------------
# Page over all studies of a run: index.html with jinja2, index.md without.


@dataclass(frozen=True)
class Chapter:
    """One study in the report; ``failure``: reason for a missing outcome."""

    name: str
    outcome: StudyOutcome | None
    written: Written | None
    failure: str = ""


def write_report(chapters: Sequence[Chapter], folder: Path) -> Path:
    """Write the index of all outcomes in ``folder``; an index of the other kind from an earlier run is removed."""
    folder.mkdir(parents=True, exist_ok=True)
    try:
        from jinja2 import Environment
        from markupsafe import Markup

        environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
        environment.filters["shown"] = shown
        text, path = environment.from_string(_TEMPLATE).render(
            chapters=chapters, tally=tally(chapters), marks=MARKS, style=Markup(STYLE),
            relative=lambda path: path.relative_to(folder).as_posix()), folder / "index.html"
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
    """Return how many statements hold, do not hold, or are open."""
    counted = Counter(s.holds for chapter in chapters if chapter.outcome for s in chapter.outcome.statements)
    return f"{counted[True]} statements hold, {counted[False]} do not, {counted[None]} are open"


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
{% if c.written.picture %}<p><a href="{{ relative(c.written.vector) }}"><img src="{{ relative(c.written.picture) }}"
alt="{{ c.outcome.title }}"></a></p>{% endif %}
<div class="wide"><table class="claims"><tr><th></th><th>statement</th><th>published</th><th>ours</th></tr>
{% for s in c.outcome.statements %}<tr><td class="{{ marks[s.holds][2] }}" title="{{ marks[s.holds][1] }}">\
{{ marks[s.holds][0] }}</td><td>{{ s.text }}</td><td>{{ s.published }}</td><td>{{ s.ours }}</td></tr>
{% endfor %}</table></div>
{% for t in c.outcome.tables %}<div class="wide"><table><caption>{{ t.name }}</caption>
<tr>{% for column in t.columns %}<th>{{ column }}</th>{% endfor %}</tr>
{% for row in t.rows %}<tr>{% for cell in row %}<td>{{ cell|shown }}</td>{% endfor %}</tr>
{% endfor %}</table></div>{% endfor %}
<p>Files: {% for path in c.written.files %}<a href="{{ relative(path) }}">{{ path.name }}</a> {% endfor %}</p>
{% endif %}{% endfor %}
<p>✓ holds · ✗ does not hold · ~ open: the paper contradicts itself or leaves out what decides</p>
</body></html>
"""
