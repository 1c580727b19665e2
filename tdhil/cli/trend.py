"""`tdhil trend` and `tdhil compare`: changes of a rig over time, and differences between runs."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tdhil.cli.arguments import add_left_out, add_option, add_settings, require_log, settings_in
from tdhil.cli.report_file import ReportFile, add_head_options, add_report_option
from tdhil.cli.results import print_json
from tdhil.config import OPTION
from tdhil.errors import MessageCode, UsageError
from tdhil.file_kind import require_log_kind

if TYPE_CHECKING:
    from matplotlib.figure import FigureBase

    from tdhil.report import Report, ReportSection

_COLOURS = ("#0b5cad", "#c2410c", "#15803d", "#7e22ce", "#525252", "#b45309", "#0e7490", "#be123c")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of trend."""
    parser.add_argument("table", type=Path, metavar="FILE", help="a table that `tdhil fleet` wrote")
    parser.add_argument("--rig", metavar="NAME", help="name of the rig in rig.yaml (default: the only one)")
    _add_output(parser, "none", "left out")
    parser.set_defaults(run=run)


def add_compare_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of compare."""
    parser.add_argument("logs", nargs="+", type=Path, metavar="run.mcap",
                        help="two or more logs; each is compared with the first")
    add_settings(parser, "each run's")
    _add_output(parser, "from the logs", "refused")
    parser.set_defaults(run=run_compare)


def _add_output(parser: argparse.ArgumentParser, stated: str, archived_are: str) -> None:
    add_left_out(parser, archived_are)
    add_option(parser, OPTION["json"])
    add_report_option(parser, "report")
    add_head_options(parser, stated)


def run(namespace: argparse.Namespace) -> int:
    """Read the table, and report changes."""
    from tdhil.fleet import counted, is_archived, read_table, trend_document
    from tdhil.report import Picture, PlainConsole, ReportSection, Text

    report = ReportFile.of_files(namespace, namespace.table)
    rows = read_table(namespace.table)
    kept = rows if namespace.archived else [row for row in rows if not is_archived(row.log)]
    if rows and not kept:
        raise UsageError("every run of this table is archived", where=str(namespace.table),
                         next_step="Add --archived", entry=MessageCode.LOG_NEEDED)
    document = trend_document(kept, namespace.rig, rehearsals=namespace.rehearsals)
    if left := len(rows) - len(kept):
        document["notes"].append(f"{counted(left, 'archived run')} left out; --archived includes them")
    if not namespace.rehearsals and any(row.rehearsed_faults and row.rig == document["rig"] for row in kept):
        document["notes"].append("--rehearsals includes the rehearsals")
    if namespace.json:
        print_json(document)
    else:
        console = PlainConsole()
        stand = "stands" if document["results"] == 1 else "stand"
        results, logs = counted(document["results"], "result"), counted(document["logs"], "log")
        console.print(f"rig {document['rig']}{_marks(document)}: {results} that {stand}, of {logs}", soft_wrap=True)
        for one in document["quantities"]:
            console.print(_followed_text(one), soft_wrap=True)
        for note in document["notes"]:
            console.print(f"note: {note}", soft_wrap=True)
    if report is not None:
        caption = "Each result with its repeatability; a vertical line marks a change."
        if document["rehearsed_faults"]:
            caption += " Hollow: a rehearsal of faults on the simulated drive."
        lines = (*(_followed_text(one) for one in document["quantities"]), *document["notes"])
        picture = Picture("trend", partial(_draw_trend, document=document), 7.5, caption)
        report.write(_report(f"{document['rig']} over time", document, (
            ReportSection("Changes", tuple(map(Text, lines))), ReportSection("Over time", (picture,)))), ())
    return 0


def run_compare(namespace: argparse.Namespace) -> int:
    """Identify each log, and compare it with the first."""
    from tdhil.fleet import FleetSettings, compare_document, identified, is_archived
    from tdhil.report import Column, Picture, ReportSection, Table, Text, working

    if len(namespace.logs) < 2:
        raise UsageError(f"{len(namespace.logs)} log is named, and compare needs two or more",
                         next_step="Name another log: tdhil compare before.mcap after.mcap",
                         entry=MessageCode.LOG_NEEDED)
    for log in namespace.logs:
        require_log(log)
        if not namespace.archived and is_archived(log):
            raise UsageError("tdhil serve has archived this run", where=str(log),
                             next_step="Add --archived, or leave it out", entry=MessageCode.VALUE_NOT_ALLOWED)
    for log in namespace.logs:
        require_log_kind(log, "tdhil compare before.mcap after.mcap")
    settings = FleetSettings(**settings_in(namespace))
    report = ReportFile.of_files(namespace, *namespace.logs)
    runs = []
    for log in namespace.logs:
        with working("identifying …"):
            runs.append(identified(log, settings))
        if not namespace.rehearsals and (faults := runs[-1].row.rehearsed_faults):
            raise UsageError(f"this run is a rehearsal of faults: {faults}", where=str(log),
                             next_step="Add --rehearsals, or leave it out", entry=MessageCode.VALUE_NOT_ALLOWED)
    document = compare_document(runs)
    if namespace.json:
        print_json(document)
    else:
        _print_compared(document)
    if report is not None:
        headings = _headings(document["logs"])
        table = Table(
            (Column("", 0.04), Column("setting", 0.26), *(Column(one, 0.7 / len(headings)) for one in headings)), tuple(
                ("≠" if one["differs"] else "", one["name"], *map(str, one["values"])) for one in document["settings"]))
        picture = Picture(
            "compare", partial(_draw_curves, document=document), 3.4, "Apparent inertia at the excited frequencies.")
        report.write(_report("Runs compared", document, (
            ReportSection("Differences", tuple(Text(f"{one['to']}: {one['text']}") for one in document["differences"])),
            ReportSection("Apparent inertia", (picture,)), ReportSection("Settings", (table,)),
        )), [run.document for run in runs])
    return 0


# ---------------------------------------------------------------------------------------------------------------------
# Output on the terminal


def _followed_text(one: Mapping[str, Any]) -> str:
    """Return the trend of a quantity as text, after the least and the greatest of its values."""
    values = [point["value"] for point in one["points"]]
    seen = f", {min(values):.4g} to {max(values):.4g} {one['unit']}" if values else ""
    return f"{one['name']}{seen}: {one['text']}"


def _print_compared(document: Mapping[str, Any]) -> None:
    from rich.table import Table
    from rich.text import Text as Words

    from tdhil.report import PlainConsole, names_and_texts, rounded

    console = PlainConsole()
    if document["simulated"]:
        console.print(_marks(document).strip(" ·"), style="magenta")
    table = Table(box=None, pad_edge=False)
    table.add_column("")
    table.add_column("setting")
    for heading in _headings(document["logs"]):
        table.add_column(heading, overflow="fold")
    for one in document["settings"]:
        table.add_row("≠" if one["differs"] else "", one["name"], *one["values"])
    table.add_section()
    table.add_row("", "verdict", *(one["verdict"] for one in document["results"]))
    inertias = ([one[f"inertia{part}_kg_m2"] for part in ("", "_low", "_high")] for one in document["results"])
    table.add_row("", "J, kg·m²", *("–" if parts[0] is None else "{} ({} to {})".format(*rounded(*parts))
                                   for parts in inertias))
    for hertz, values in _by_line(document).items():
        table.add_row("", f"apparent J, {hertz:.4g} Hz", *("–" if one is None else f"{one:#.4g}" for one in values))
    console.print(table)
    for one in document["differences"]:
        console.print()
        console.print(Words(f"{one['from']} and {one['to']}", style="bold"))
        console.print(names_and_texts((("J", one["text"]), *(
            (other["name"], "differs" if other["differs"] else "no significant difference")
            for other in one["quantities"] if other["column"] != "inertia_kg_m2"))))


def _marks(document: Mapping[str, Any]) -> str:
    """Return the suffix of a title if any of the runs is simulated or a rehearsal."""
    from tdhil.report import marks

    return f" · {marks(document)}" if document["simulated"] else ""


def _headings(logs: Sequence[str]) -> Sequence[str]:
    """Return the file names; if two are the same, the given paths."""
    names = [Path(log).name for log in logs]
    return names if len(set(names)) == len(names) else logs


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
# Output as a report, with a figure


def _report(title: str, document: Mapping[str, Any], sections: tuple[ReportSection, ...]) -> Report:
    from tdhil.report import Report, marks
    from tdhil.version import __version__

    said = f"{marks(document)}: at least one drive and rig is simulated" if document["simulated"] else ""
    if faults := ", ".join(document["rehearsed_faults"]):
        said += f"; rehearsed: {faults}"
    return Report(title=title, subtitle="", simulated=said, answer=None, warnings=(),
                  sections=tuple(one for one in sections if one.blocks), footer=f"tdhil {__version__}")


def _draw_trend(figure: FigureBase, document: Mapping[str, Any]) -> None:
    dates: Any = import_module("matplotlib.dates")
    shown = [one for one in document["quantities"] if one["points"]]
    axes: Any = figure.subplots(max(1, len(shown)), 1, squeeze=False, sharex=True)[:, 0]
    for one, axis in zip(shown, axes, strict=False):
        for rehearsed, face in ((False, _COLOURS[0]), (True, "white")):
            points = [point for point in one["points"] if (point["rehearsed_faults"] is not None) is rehearsed]
            axis.errorbar(
                [_moment(point["date"]) for point in points], [point["value"] for point in points],
                fmt="o", ms=3.5, lw=1, color=_COLOURS[0], mfc=face,
                yerr=[[max(0.0, point["value"] - point["low"]) for point in points],
                      [max(0.0, point["high"] - point["value"]) for point in points]])
        for change in one["changes"]:
            before, after = _moment(change["before_date"]), _moment(change["after_date"])
            axis.axvline(before + (after - before) / 2, color=_COLOURS[1], lw=1)
        axis.set_ylabel(f"{one['name']}\n{one['unit']}", fontsize="small")
        axis.tick_params(axis="y", labelsize="small")
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
