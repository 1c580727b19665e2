"""Common parts of all calibrations, on the card and on the laboratory's page."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.table import Table as Grid
from rich.text import Text as Words

from tdhil.report.acceptance import SIGNATURE_LINE
from tdhil.report.blocks import AnswerBox, Column, Pairs, Report, ReportSection, Table, shown_date
from tdhil.report.card import sentence
from tdhil.report.console import PlainConsole, names_and_texts
from tdhil.report.document import NO_REAL_SHAFT, SIMULATED, coded_warnings
from tdhil.report.intervals import interval_and_share, percent, rounded

if TYPE_CHECKING:
    from tdhil.calibration import MeasuredValue

Part = Mapping[str, Any]

VERDICT_STYLE = {"valid": "bold green", "not_identifiable": "bold red", "model_rejected": "bold red"}
VERDICT_COLOUR = {"valid": "green", "not_identifiable": "red", "model_rejected": "red"}
MANY = 1e4
"""Degrees of freedom above which the page shows ∞."""


def quantity(one: MeasuredValue | None, confidence: float) -> dict[str, Any] | None:
    """Return a measured value for the document."""
    return None if one is None else {**asdict(one), "confidence": confidence}


def band_of(factor: Part | None) -> tuple[float, str]:
    """Return the coverage factor k of a calibration factor, and the label of a band with it; of 95 % without one."""
    if factor is None:
        return 1.96, "95 % band"
    return float(factor["coverage_factor"]), f"{100.0 * factor['confidence']:g} % band"


def run_name(run: Part) -> str:
    """Return the short name of a run's log; a file of an earlier version has only its path."""
    return str(run.get("name") or Path(run["log"]).name)


def with_share(part: Part, unit: str) -> str:
    """Return a quantity with its interval, and with half of the interval in percent."""
    return interval_and_share(part["value"], part["low"], part["high"], unit)


def scale_error(factor: Part, quantity: str = "torque") -> str:
    """Return the error of the drive's own quantity, with the digits of its interval: ``4.8 % too much torque``."""
    error, high, low = (100.0 * (1.0 / factor[name] - 1.0) for name in ("value", "low", "high"))
    text = rounded(error, low, high)[0].removeprefix("-")
    if not float(text):
        return f"the true {quantity} to {percent(0.5 * (high - low), 100.0)}"
    return f"{text} % too {'much' if error > 0.0 else 'little'} {quantity}"


def print_calibration_card(
    document: Part, title: str, rows: Iterable[tuple[str, str | Words]], headings: Collection[str],
    budget: Sequence[tuple[str, ...]], console: PlainConsole, *, quantity: str = "torque", remark: str = "",
) -> None:
    """Print the card of a calibration: verdict, κ, ``rows``, budget, reason, advice, ``remark`` and warnings.

    ``budget``: the sources with their figures under ``headings``; empty without one.
    """
    verdict, factor = document["verdict"], document["calibration_factor"]
    shown = names_and_texts([("verdict", Words(verdict, style=VERDICT_STYLE.get(verdict, "bold")))])
    if factor is not None:
        shown.add_row("calibration factor", Words(with_share(factor, ""), style="bold"))
        shown.add_row(
            "", f"true {quantity} = κ · reported {quantity}: the drive reports {scale_error(factor, quantity)}")
    for row in rows:
        shown.add_row(*row)
    body: list[RenderableType] = [shown]
    if budget:
        table = Grid.grid(padding=(0, 2))
        table.add_column(style="dim")
        for _ in headings:
            table.add_column(justify="right", no_wrap=True)
        table.add_row(Words("uncertainty budget", style="italic"), *(Words(one, style="dim") for one in headings))
        for line in budget:
            table.add_row(*line)
        body.append(table)
    body.append(Words(sentence(document["reason"])))
    if document["advice"]:
        body.append(Words(sentence(document["advice"]), style="italic"))
    if remark:
        body.append(Words(sentence(remark), style="dim"))
    body += [Words(f"! {warning}", style="yellow") for warning in coded_warnings(document)]
    title += f" · {SIMULATED}" if document["simulated"] else ""
    console.print(Panel(Group(*body), title=title, border_style="magenta" if document["simulated"] else "blue"))


def shown_degrees(dof: float) -> str:
    """Return ``50``, or ``∞``."""
    return "∞" if dof > MANY else f"{dof:.0f}"


_IN_HEX = ("vendor", "product", "revision")
"""Numbers of 1018h that manuals give in hexadecimal."""


def calibrated_item(document: Part) -> ReportSection:
    """Return identity and settings of the drive; without blocks if neither is known."""
    drive = document["drive"] or {}
    identity = [(name, f"{drive[name]:X}h" if name in _IN_HEX and isinstance(drive[name], int) else str(drive[name]))
                for name in ("name", *_IN_HEX, "serial") if name in drive]
    settings = [(_SETTINGS.get(name, name), str(value)) for name, value in document["settings"].items()
                if value is not None]
    return ReportSection("Calibrated item", (Pairs((*identity, *settings)),) if identity or settings else ())


_SETTINGS = {"rated_torque_nm": "rated torque, N·m", "torque_count_nm": "one count of torque, N·m",
             "gear_ratio": "gear ratio"}


def recordings(document: Part) -> ReportSection:
    """Return logs of the calibration with date and hash; without blocks if there is none."""
    rows = tuple((run_name(run), f"{shown_date(run['date'])}, SHA-256 {run['sha256']}") for run in document["runs"])
    return ReportSection("Recordings", (Pairs(rows),) if rows else ())


def date_and_signature(document: Part) -> ReportSection:
    """Return the last section of the page."""
    return ReportSection("Date and signature", (Pairs((
        ("date of calibration", shown_date(document["date"])), ("conditions", "temperature, warm-up: ____________"),
        ("signature", SIGNATURE_LINE))),))


def result_rows(quantities: Iterable[tuple[str, Part, str]]) -> Table:
    """Return a table of (name, measured value, unit), with the columns of a certificate."""
    rows = tuple((name, unit, f"{part['value']:.5g}", f"{part['standard_uncertainty']:.3g}",
                  shown_degrees(part["degrees_of_freedom"]), f"{part['coverage_factor']:.2f}",
                  f"{0.5 * (part['high'] - part['low']):.3g}") for name, part, unit in quantities)
    columns = (Column("quantity", 0.26), Column("unit", 0.1), *(Column(name, 0.128, True)
                                                               for name in ("value", "u", "ν_eff", "k", "U")))
    return Table(columns, rows)


def laboratory_page(
    document: Part, lines: Iterable[str], sections: Iterable[ReportSection], quantity: str = "torque"
) -> Report:
    """Return the page of a calibration in the layout of a laboratory; ``lines``: below κ in the answer."""
    factor = document["calibration_factor"]
    return Report(
        title=f"Calibration of a drive's {quantity}",
        subtitle=shown_date(document["date"]),
        simulated=f"{SIMULATED}: {NO_REAL_SHAFT}" if document["simulated"] else "",
        answer=AnswerBox(
            VERDICT_COLOUR.get(document["verdict"], "yellow"),
            "No number" if factor is None else f"κ = {with_share(factor, '')}", tuple(lines), document["verdict"],
            sentence(document["reason"]), sentence(document["advice"])),
        warnings=coded_warnings(document),
        sections=tuple(one for one in sections if one.blocks),
        footer=f"tdhil {document['tdhil']}",
    )
