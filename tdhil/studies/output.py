"""A study's outcome as files: one CSV a table, a PNG and an SVG, the settings it was run with; and as a document.

Without matplotlib everything but the picture is written.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from tdhil.report import page
from tdhil.studies.study import Cell, ResultTable, StudyOutcome

INSTALL = f"no pictures without matplotlib; install it with: {page.install_command()}"
DPI = 120


@dataclass(frozen=True)
class Written:
    """Where everything is. ``picture`` is None where none was drawn; ``without_matplotlib`` says whether that's why."""

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
    """Write into ``folder``, made if need be; what is there under the same names is replaced."""
    folder.mkdir(parents=True, exist_ok=True)
    tables = tuple(_csv(table, folder) for table in outcome.tables)
    own = _settings(outcome.name, settings, folder)
    if outcome.draw is None:
        return Written(folder, tables, own)
    try:
        picture, vector = _pictures(outcome, folder)
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "matplotlib":
            raise
        return Written(folder, tables, own, without_matplotlib=True)
    return Written(folder, tables, own, picture, vector)


def document(outcome: StudyOutcome, settings: BaseModel, written: Written) -> dict[str, Any]:
    """Plain data for `json.dumps`: what the study says of itself, its tables and its statements. Not finite is null."""
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


def _csv(table: ResultTable, folder: Path) -> Path:
    path = folder / f"{table.name}.csv"
    with path.open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(table.columns)
        rows.writerows([_cell(value) for value in row] for row in table.rows)
    return path


def _cell(value: Cell) -> str:
    """Every digit of a number, so that it reads back as the same; nothing for None."""
    if value is None:
        return ""
    return repr(float(value)) if isinstance(value, float) else str(value)


def _settings(name: str, settings: BaseModel, folder: Path) -> Path:
    """A study file: copy it, change it, run it with --study."""
    import yaml

    path = folder / "study.yaml"
    data = {"study": name, "settings": settings.model_dump(mode="json", by_alias=True)}
    head = f"# What {name} was run with. Copy it, change it, and run it: tdhil study --study my.yaml\n"
    text = yaml.safe_dump(data, sort_keys=False, allow_unicode=True, default_flow_style=None, width=100)
    path.write_text(head + text, encoding="utf-8")
    return path


def _pictures(outcome: StudyOutcome, folder: Path) -> tuple[Path, Path]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    assert outcome.draw is not None
    png, svg = folder / f"{outcome.name}.png", folder / f"{outcome.name}.svg"
    with page.repeatable_figures():
        figure = Figure(figsize=outcome.figure_size_in)
        FigureCanvasAgg(figure)
        outcome.draw(figure)
        figure.savefig(png, dpi=DPI)
        figure.savefig(svg, metadata={"Date": None})     # the same outcome gives the same file
    return png, svg


def _plain(value: Any) -> Any:
    """Lists, maps and numbers of Python's own: numpy's are turned into them."""
    if isinstance(value, Mapping):
        return {str(key): _plain(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return _plain(value.tolist())
