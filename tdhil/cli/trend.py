"""`tdhil trend` and `tdhil compare`: changes of a rig over time, and differences between runs."""

from __future__ import annotations

import argparse
import html
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tdhil.cli.arguments import add_archived, add_option, add_settings, settings_in
from tdhil.cli.results import print_json
from tdhil.config import OPTION
from tdhil.errors import MessageCode, UsageError

if TYPE_CHECKING:
    from matplotlib.figure import FigureBase

_COLOURS = ("#0b5cad", "#c2410c", "#15803d", "#7e22ce", "#525252", "#b45309", "#0e7490", "#be123c")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of trend."""
    parser.add_argument("table", type=Path, metavar="FILE", help="a table that `tdhil fleet` wrote")
    parser.add_argument("--rig", metavar="NAME", help="name of the rig in rig.yaml (default: the only one)")
    _add_output(parser)
    parser.set_defaults(run=run)


def add_compare_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of compare."""
    parser.add_argument("logs", nargs="+", type=Path, metavar="run.mcap",
                        help="two or more; each is compared with the first")
    add_settings(parser, "each run's")
    _add_output(parser)
    parser.set_defaults(run=run_compare)


def _add_output(parser: argparse.ArgumentParser) -> None:
    add_archived(parser)
    add_option(parser, OPTION["json"])
    parser.add_argument("--report", type=Path, metavar="FILE.html", help="write a report with a picture, in one "
                                                                         "file (extra `report`)")


def run(namespace: argparse.Namespace) -> int:
    """Read the table, and report changes."""
    from tdhil.fleet import counted, is_archived, read_table, trend_document

    _check_report(namespace.report, (namespace.table,))
    rows = read_table(namespace.table)
    kept = rows if namespace.archived else [row for row in rows if not is_archived(row.log)]
    if rows and not kept:
        raise UsageError("every run of this table is archived", where=str(namespace.table),
                         next_step="Add --archived", entry=MessageCode.LOG_NEEDED)
    document = trend_document(kept, namespace.rig)
    if left := len(rows) - len(kept):
        text = f"{counted(left, 'archived run')} left out; --archived includes them"
        document = {**document, "notes": [*document["notes"], text]}
    if namespace.json:
        print_json(document)
    else:
        _print_trend(document)
    if namespace.report is not None:
        title = f"{document['rig']} over time{_simulated(document)}"
        lines = [_followed_text(one) for one in document["quantities"]] + list(document["notes"])
        if any(point["in_part"] is not None for one in document["quantities"] for point in one["points"]):
            lines.append("hollow: a result from a part of the run")
        _write(namespace.report, "trend", title, lines, "", lambda figure: _draw_trend(figure, document), (7.2, 7.5))
    return 0


def run_compare(namespace: argparse.Namespace) -> int:
    """Identify each log, and compare it with the first."""
    from tdhil.fleet import FleetSettings, compare_document, identified, is_archived

    if len(namespace.logs) < 2:
        raise UsageError(f"{len(namespace.logs)} log is named, and compare needs two or more",
                         next_step="Name another log: tdhil compare before.mcap after.mcap",
                         entry=MessageCode.LOG_NEEDED)
    for log in namespace.logs:
        if not log.is_file():
            raise UsageError("this log does not exist", where=str(log), next_step="Name a run.mcap of tdhil",
                             entry=MessageCode.FILE_NOT_FOUND)
        if not namespace.archived and is_archived(log):
            raise UsageError("tdhil serve has archived this run", where=str(log),
                             next_step="Add --archived, or leave it out", entry=MessageCode.VALUE_NOT_ALLOWED)
    settings = FleetSettings(**settings_in(namespace))
    _check_report(namespace.report, namespace.logs)
    document = compare_document([identified(log, settings) for log in namespace.logs])
    if namespace.json:
        print_json(document)
    else:
        _print_compared(document)
    if namespace.report is not None:
        lines = [f"{one['to']}: {one['text']}" for one in document["differences"]]
        _write(namespace.report, "compare", f"Runs compared{_simulated(document)}", lines, _settings_html(document),
               lambda figure: _draw_curves(figure, document), (7.2, 3.4))
    return 0


# ---------------------------------------------------------------------------------------------------------------------
# Output on the terminal


def _print_trend(document: Mapping[str, Any]) -> None:
    from tdhil.fleet import counted
    from tdhil.report import PlainConsole

    console = PlainConsole()
    stand = "stands" if document["results"] == 1 else "stand"
    results, logs = counted(document["results"], "result"), counted(document["logs"], "log")
    console.print(f"rig {document['rig']}{_simulated(document)}: {results} that {stand}, of {logs}", soft_wrap=True)
    for one in document["quantities"]:
        console.print(_followed_text(one), soft_wrap=True)
    for note in document["notes"]:
        console.print(f"note: {note}", soft_wrap=True)


def _followed_text(one: Mapping[str, Any]) -> str:
    """Return the trend of a quantity as text, after the least and the greatest of its values."""
    values = [point["value"] for point in one["points"]]
    seen = f", {min(values):.4g} to {max(values):.4g} {one['unit']}" if values else ""
    return f"{one['name']}{seen}: {one['text']}"


def _print_compared(document: Mapping[str, Any]) -> None:
    from rich.table import Table

    from tdhil.report import PlainConsole

    console = PlainConsole()
    if document["simulated"]:
        console.print(_simulated(document).strip(" ·"), style="magenta")
    table = Table(box=None, pad_edge=False)
    table.add_column("")
    table.add_column("setting")
    for heading in _headings(document["logs"]):
        table.add_column(heading, overflow="fold")
    for one in document["settings"]:
        table.add_row("≠" if one["differs"] else "", one["name"], *one["values"])
    table.add_section()
    table.add_row("", "verdict", *(one["verdict"] for one in document["results"]))
    table.add_row("", "J, kg·m²", *(_inertia_text(one) for one in document["results"]))
    for hertz, values in _by_line(document).items():
        table.add_row("", f"apparent J, {hertz:.4g} Hz", *("–" if one is None else f"{one:#.4g}" for one in values))
    console.print(table)
    for one in document["differences"]:
        console.print(f"{one['from']} and {one['to']}: {one['text']}", soft_wrap=True)
        rest = [f"{other['name']}: {'differs' if other['differs'] else 'no significant difference'}"
                for other in one["quantities"] if other["column"] != "inertia_kg_m2"]
        if rest:
            console.print("  " + ", ".join(rest), soft_wrap=True)


def _simulated(document: Mapping[str, Any]) -> str:
    """Return the suffix of a title if any of the runs is simulated."""
    from tdhil.report import SIMULATED

    return f" · {SIMULATED}" if document["simulated"] else ""


def _headings(logs: Sequence[str]) -> Sequence[str]:
    """Return the file names; if two are the same, the given paths."""
    names = [Path(log).name for log in logs]
    return names if len(set(names)) == len(names) else logs


def _inertia_text(row: Mapping[str, Any]) -> str:
    from tdhil.report import rounded

    value, low, high = (row[f"inertia{part}_kg_m2"] for part in ("", "_low", "_high"))
    return "–" if value is None else "{} ({} to {})".format(*rounded(value, low, high))


def _by_line(document: Mapping[str, Any]) -> dict[float, list[float | None]]:
    """Return the apparent inertia by frequency, a column per log; the mean if there are several mean speeds."""
    found: dict[float, list[float | None]] = {}
    for number, lines in enumerate(document["apparent_inertia"]):
        by_hertz: dict[float, list[float]] = {}
        for line in lines:
            if line["value"] is not None:
                by_hertz.setdefault(round(line["hertz"], 6), []).append(line["value"])
        for hertz, values in by_hertz.items():
            row = found.setdefault(hertz, [None] * len(document["logs"]))
            row[number] = sum(values) / len(values)
    return dict(sorted(found.items()))


# ---------------------------------------------------------------------------------------------------------------------
# Output in one file, with a figure


def _check_report(path: Path | None, inputs: Sequence[Path]) -> None:
    if path is None:
        return
    from tdhil.report import require_extra

    if path.suffix != ".html":
        raise UsageError("must end in .html", where=f"--report {path}", entry=MessageCode.VALUE_NOT_ALLOWED)
    if path.exists() or any(path.resolve() == one.resolve() for one in inputs):
        raise UsageError("already exists and was left unchanged", where=f"--report {path}",
                         next_step="Name another file", entry=MessageCode.FILE_EXISTS)
    require_extra("--report")


def _write(
    path: Path, graph: str, title: str, lines: Sequence[str], table: str, draw: Any, size_in: tuple[float, float]
) -> None:
    from tdhil.report import GRAPHS, STYLE, inline_svg

    said = "".join(f"<li>{html.escape(line)}</li>" for line in lines)
    page = (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f"<style>{STYLE}</style><h1>{html.escape(title)}</h1><ul>{said}</ul><div class=\"wide\">"
        f"{inline_svg(draw, size_in)}</div>"
        f"<p>{html.escape(GRAPHS[graph].reading)}</p>{table}</html>\n"
    )
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(page)
    except OSError as error:
        raise UsageError(f"can't be written: {error.strerror or error}", where=f"--report {path}",
                         entry=MessageCode.FILE_NOT_WRITABLE) from error


def _draw_trend(figure: FigureBase, document: Mapping[str, Any]) -> None:
    dates: Any = import_module("matplotlib.dates")
    shown = [one for one in document["quantities"] if one["points"]]
    axes: Any = figure.subplots(max(1, len(shown)), 1, squeeze=False, sharex=True)[:, 0]
    for one, axis in zip(shown, axes, strict=False):
        for in_part, face in ((False, _COLOURS[0]), (True, "white")):
            points = [point for point in one["points"] if (point["in_part"] is not None) is in_part]
            axis.errorbar(
                [_moment(point["date"]) for point in points], [point["value"] for point in points],
                fmt="o", ms=3.5, lw=1, color=_COLOURS[0], mfc=face,
                yerr=[[max(0.0, point["value"] - point["low"]) for point in points],
                      [max(0.0, point["high"] - point["value"]) for point in points]])
        for change in one["changes"]:
            before, after = _moment(change["before_date"]), _moment(change["after_date"])
            axis.axvline(before + (after - before) / 2, color=_COLOURS[1], lw=1)
        axis.set_ylabel(f"{one['name']}\n{one['unit']}")
        axis.grid(alpha=0.3)
    locator = dates.AutoDateLocator(minticks=3, maxticks=8)
    axes[-1].xaxis.set_major_locator(locator)
    axes[-1].xaxis.set_major_formatter(dates.ConciseDateFormatter(locator))
    axes[-1].set_xlabel("UTC")
    figure.align_ylabels(list(axes))


def _moment(date: str) -> datetime:
    """Return a row's date; without a zone it counts as local time."""
    return datetime.fromisoformat(date).astimezone(UTC)


def _draw_curves(figure: FigureBase, document: Mapping[str, Any]) -> None:
    axis: Any = figure.subplots()
    headings = _headings(document["logs"])
    for number, (heading, lines) in enumerate(zip(headings, document["apparent_inertia"], strict=True)):
        known = [line for line in lines if None not in (line["value"], line["low"], line["high"])]
        axis.errorbar(
            [line["hertz"] for line in known], [line["value"] for line in known],
            yerr=[[max(0.0, line["value"] - line["low"]) for line in known],
                  [max(0.0, line["high"] - line["value"]) for line in known]],
            # concentric rings, so that equal runs do not hide each other
            fmt="o", ms=3 + 3 * number, mfc="none", lw=1, color=_COLOURS[number % len(_COLOURS)], label=heading)
    axis.set_xlabel("Hz")
    axis.set_ylabel("apparent inertia, kg·m²")
    axis.grid(alpha=0.3)
    axis.legend(frameon=False)


def _settings_html(document: Mapping[str, Any]) -> str:
    head = "".join(f"<th>{html.escape(heading)}</th>" for heading in _headings(document["logs"]))
    rows = "".join(
        f"<tr><td>{'≠' if one['differs'] else ''}</td><td>{html.escape(one['name'])}</td>"
        + "".join(f"<td>{html.escape(value)}</td>" for value in one["values"]) + "</tr>"
        for one in document["settings"]
    )
    return f'<table class="claims"><tr><th></th><th>setting</th>{head}</tr>{rows}</table>'
