"""Severity of torsional oscillation: as a JSON document, on a terminal, and as a page with figures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich import box
from rich.table import Table as Grid
from rich.text import Text as Words

from profiles.quantities import printed_ends, printed_interval
from tdhil.report.blocks import AnswerBox, Column, Pairs, Picture, Report, ReportSection, Table
from tdhil.report.card import minutes
from tdhil.report.console import PlainConsole, names_and_texts
from tdhil.report.document import marks
from tdhil.report.figure_words import meanings_section, print_meanings
from tdhil.report.plots import DARK, OURS, QUIET, envelope
from tdhil.soft_torque import AT_RISK_INDEX, RPM, STICK_SLIP_INDEX, BitNoiseEstimate, DrillString, Interval, Severity
from tdhil.version import __version__

if TYPE_CHECKING:
    from matplotlib.figure import FigureBase

Part = Mapping[str, Any]

_STYLES = {"stick-slip": "bold red", "at risk": "bold yellow", "smooth": "bold green"}
_COLOURS = {"stick-slip": "red", "at risk": "yellow", "smooth": "green"}
MOST_EPISODES = 200
"""Most episodes in the document."""
SHOWN_EPISODES = 3
SHOWN_PERIODS = 12.0
"""Length of the detail figure, in periods."""


def severity_document(
    found: Sequence[tuple[Severity, str]], noises: Sequence[BitNoiseEstimate | str], string: DrillString,
    inertia: Interval, *, simulated: bool, rehearsed_faults: Sequence[str] = (), warnings: tuple[str, ...],
) -> dict[str, Any]:
    """Return plain data for `json.dumps`, at the main shaft; one record, or two, the second of which is later.

    ``noises``: bit noise of each record, or the reason why the record does not determine it.
    """
    records = [_record(one, name) | _noise(noise) for (one, name), noise in zip(found, noises, strict=True)]
    return {
        "kind": "severity", "records": records, "sentence": _sentence(records), "simulated": simulated,
        "rehearsed_faults": list(rehearsed_faults),
        "string": {"name": string.name, "impedance_nm_s_rad": string.impedance_nm_s_rad, "echo_s": string.echo_s},
        "inertia_kg_m2": asdict(inertia), "warnings": list(warnings), "tdhil": __version__,
    }


def _record(one: Severity, name: str) -> dict[str, Any]:
    check = one.reflection
    return {
        "file": name, "level": one.level, "turning_s": one.turning_s, "mean_rpm": one.mean_rad_s / RPM,
        "severity_index": asdict(one.index), "severity_index_worst_5_percent": one.index_worst,
        "stick_slip_share": one.stick_slip_share, "at_risk_share": one.at_risk_share,
        "period_s": None if one.period_s is None else asdict(one.period_s), "cycles": one.cycles,
        "window_s": one.window_s,
        "downhole_swing_rpm": {key: value / RPM for key, value in asdict(one.downhole_rad_s).items()},
        "string_torque_swing_nm": asdict(one.torque_nm),
        "episodes": [asdict(part) for part in one.episodes[:MOST_EPISODES]], "episode_count": len(one.episodes),
        "reflection": None if check is None else {
            "from_hz": check.from_hz, "to_hz": check.to_hz, "measured": asdict(check.measured),
            "coherence": check.coherence, "expected": check.expected, "verdict": check.verdict,
        },
        "reflection_refused": one.reflection_refused or None,
    }


def _noise(found: BitNoiseEstimate | str) -> dict[str, Any]:
    if isinstance(found, str):
        return {"bit_noise": None, "bit_noise_refused": found}
    return {
        "bit_noise": {
            "rms_nm": asdict(found.rms_nm), "correlation_s": asdict(found.correlation_s),
            "correlation_measured": found.correlation_measured, "from_hz": found.band_hz[0],
            "to_hz": found.band_hz[1], "segments": found.segments, "report_share": found.report_share,
        },
        "bit_noise_refused": None,
    }


def _sentence(records: Sequence[Part]) -> str:
    """Return the finding in a sentence; for two records, the change."""
    first, last = records[0], records[-1]
    if len(records) == 1:
        if first["level"] == "stick-slip":
            return (f"Stick-slip in {100.0 * first['stick_slip_share']:.0f} % of {minutes(first['turning_s'])} of "
                    f"rotation at {first['mean_rpm']:.0f} rpm.")
        if first["level"] == "at risk":
            return (f"No stick-slip in {minutes(first['turning_s'])} of rotation at {first['mean_rpm']:.0f} rpm, but "
                    f"the downhole speed oscillates by ±{first['downhole_swing_rpm']['value']:.0f} rpm.")
        return f"No stick-slip in {minutes(first['turning_s'])} of rotation at {first['mean_rpm']:.0f} rpm."
    return (f"Severity index {first['severity_index']['value']:.2f} → {last['severity_index']['value']:.2f}, downhole "
            f"oscillation ±{first['downhole_swing_rpm']['value']:.0f} → ±{last['downhole_swing_rpm']['value']:.0f} rpm,"
            f" stick-slip {100.0 * first['stick_slip_share']:.0f} → {100.0 * last['stick_slip_share']:.0f} % of the "
            "time.")


def print_severity(document: Part, console: PlainConsole) -> None:
    """Print sentence, figures and their meaning, in 80 columns."""
    records = document["records"]
    console.print(Words(document["sentence"], style=_STYLES[records[-1]["level"]]))
    console.print()
    simulated = f" · {found}" if (found := marks(document)) else ""
    console.print(Words(f"torsional severity, {document['string']['name'] or 'drill string'}{simulated}", style="bold"))
    if len(records) == 1:
        console.print(names_and_texts([(name, cells[0]) for name, cells in _rows(records)]))
    else:
        grid = Grid(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))
        for name in ("", "before", "after"):
            grid.add_column(name, overflow="fold")
        for name, cells in _rows(records):
            grid.add_row(name, *cells)
        console.print(grid)
    console.print()
    print_meanings(_figures(records), console)
    for warning in document["warnings"]:
        console.print(Words(warning, style="yellow"))


def _figures(records: Sequence[Part]) -> list[str]:
    """Return the names of all rows and columns."""
    return ["in brackets", *(name for name, _ in _rows(records)), *(("before", "after") if len(records) > 1 else ())]


def _with(part: Part, digits: int, unit: str = "", sign: str = "") -> str:
    low, high = printed_ends(part["low"], part["high"], digits)
    return f"{sign}{part['value']:.{digits}f}{unit} ({sign}{low} to {sign}{high})"


def _rows(records: Sequence[Part]) -> Iterator[tuple[str, list[str]]]:
    """Yield the name and a cell for each record."""
    yield "level", [one["level"] for one in records]
    yield "record", [f"{Path(one['file']).name}, {minutes(one['turning_s'])} of rotation" for one in records]
    yield "severity index", [f"{_with(one['severity_index'], 2)}; 5 % of the time above "
                             f"{one['severity_index_worst_5_percent']:.2f}" for one in records]
    yield "stick-slip", [_episodes(one) for one in records]
    yield "oscillation", [_period(one) for one in records]
    yield "downhole speed", [f"{one['mean_rpm']:.0f} {_with(one['downhole_swing_rpm'], 0, ' rpm', '±')}"
                             for one in records]
    yield "string torque", [_with(one["string_torque_swing_nm"], 0, " N·m", "±") for one in records]
    yield "|r|, top drive", [_reflection(one) for one in records]
    yield "bit noise", [_noise_words(one) for one in records]


def _episodes(one: Part) -> str:
    if not one["episodes"]:
        return f"none; at risk for {100.0 * one['at_risk_share']:.0f} % of the time"
    shown = ", ".join(f"{part['start_s']:.0f} to {part['end_s']:.0f} s" for part in one["episodes"][:SHOWN_EPISODES])
    more = one["episode_count"] - SHOWN_EPISODES
    return f"{100.0 * one['stick_slip_share']:.0f} % of the time: {shown}" + (f" and {more} more" if more > 0 else "")


def _period(one: Part) -> str:
    part = one["period_s"]
    if part is None:
        return "no periodic oscillation"
    return f"every {_with(part, 2, ' s')}, {1.0 / part['value']:.3f} Hz, {one['cycles']} cycles"


def _noise_words(one: Part) -> str:
    found = one["bit_noise"]
    if found is None:
        return f"not known: {one['bit_noise_refused']}"
    time_s = found["correlation_s"]
    rms = f"{_with(found['rms_nm'], 0, ' N·m')} rms"
    if found["correlation_measured"]:
        return f"{rms}, correlation time {time_s['value']:.2f} s"
    return f"{rms} for the stated correlation time of {time_s['value']:.2f} s: the record does not determine this time"


def _reflection(one: Part) -> str:
    check = one["reflection"]
    if check is None:
        return f"not known: {one['reflection_refused']}"
    words = f"{_with(check['measured'], 2)} at {check['from_hz']:.2f} to {check['to_hz']:.2f} Hz"
    if check["expected"] is None:
        return words
    return f"{words}; these gains give {check['expected']:.2f}: {check['verdict']}"


# ---------------------------------------------------------------------------------------------------------------------
# Page of the severity.


def severity_report(document: Part, found: Sequence[Severity]) -> Report:
    """Return the blocks of the page."""
    records = document["records"]
    last = records[-1]
    names = ("before", "after") if len(records) > 1 else ("record",)
    width = 0.8 / len(records)
    pictures = []
    for name, one in zip(names, found, strict=True):
        lead = f"{name}: " if len(records) > 1 else ""
        pictures += [
            Picture("bit_speed", partial(draw_detail, one=one), 2.6,
                    f"{lead}speed at the bit (estimated) and at the top, around the highest severity of the record."),
            Picture("severity", partial(draw_index, one=one), 2.0,
                    f"{lead}severity index over the whole record. Above the upper line a bit that nearly stops sticks "
                    "and slips; above the lower one it is at risk."),
        ]
    rows = tuple((name, *cells) for name, cells in _rows(records))
    check = last["reflection"]
    expected = "" if check is None or check["expected"] is None else f"Reflection of the top drive: {check['verdict']}."
    return Report(
        title="Torsional severity", subtitle=document["string"]["name"] or "drill string",
        simulated=f"{marks(document)}: the record is that of a simulated rig" if document["simulated"] else "",
        answer=AnswerBox(_COLOURS[last["level"]], last["level"], (expected,) if expected else (),
                         f"severity index {last['severity_index']['value']:.2f}", document["sentence"], ""),
        warnings=tuple(document["warnings"]),
        sections=(
            ReportSection("Figures", (Table((Column("", 0.2), *(Column(name, width) for name in names)), rows),)),
            ReportSection("Over time", tuple(pictures)),
            ReportSection("Basis of the result", (Pairs((
                ("J, main shaft", f"{document['inertia_kg_m2']['value']:.4g} kg·m² "
                 f"({printed_interval(document['inertia_kg_m2']['low'], document['inertia_kg_m2']['high'])})"),
                ("ζ", f"{document['string']['impedance_nm_s_rad']:.4g} N·m·s/rad"),
                ("echo", f"after {document['string']['echo_s']:.3f} s"),
                *(("record" if len(records) == 1 else name, one["file"])
                  for name, one in zip(names, records, strict=True)))),)),
            meanings_section((*_figures(records), "J", "ζ", "echo")),
        ),
        footer=f"tdhil {document['tdhil']}",
    )


def draw_detail(figure: FigureBase, one: Severity) -> None:
    """Draw bit and top around the highest severity."""
    axes = figure.subplots()
    course = one.course
    known = np.isfinite(course.index)
    worst = float(course.time_s[int(np.argmax(np.where(known, course.index, -1.0)))])
    half = 0.5 * SHOWN_PERIODS * one.window_s
    shown = np.abs(course.time_s - worst) <= half
    axes.plot(course.time_s[shown], course.bit_rad_s[shown] / RPM, color=OURS, lw=1.2, label="bit, estimated")
    axes.plot(course.time_s[shown], course.top_rad_s[shown] / RPM, color=DARK, lw=1.0, label="top drive")
    axes.axhline(0.0, color=QUIET, lw=0.6)
    axes.set(xlabel="time, s", ylabel="rpm")
    axes.margins(x=0.0)
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small", loc="upper right")


def draw_index(figure: FigureBase, one: Severity) -> None:
    """Draw the severity index over the record."""
    axes = figure.subplots()
    time_s, _, high = envelope(one.course.time_s, one.course.index)
    axes.plot(time_s, high, color=OURS, lw=1.0)
    axes.axhline(STICK_SLIP_INDEX, color="#b42318", lw=0.8)
    axes.axhline(AT_RISK_INDEX, color="#8a6100", lw=0.8)
    axes.set(xlabel="time, s", ylabel="severity index", ylim=(0.0, None))
    axes.margins(x=0.0)
    axes.grid(alpha=0.3)
