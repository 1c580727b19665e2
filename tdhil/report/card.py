"""The result card: what a field engineer reads first, in 80 columns."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.console import Console, Group, RenderableType
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from tdhil.report.card_parts import (
    budget_table,
    compliant_rows,
    estimate_text,
    friction_rows,
    inertia_text,
    opinion_rows,
)
from tdhil.report.document import SIMULATED

_VERDICT_STYLE = {
    "valid": "bold green",
    "valid_wide": "bold yellow",
    "not_identifiable": "bold red",
    "model_rejected": "bold red",
}


def result_card(document: Mapping[str, Any]) -> RenderableType:
    """A panel of the result document."""
    rows = Table.grid(padding=(0, 2))
    rows.add_column(style="dim", no_wrap=True)
    rows.add_column(overflow="fold")
    verdict = document["verdict"]
    rows.add_row("verdict", Text(verdict, style=_VERDICT_STYLE.get(verdict, "bold")))
    inertia = document["inertia_kg_m2"]
    if inertia is not None:
        title = f"J, {100 * inertia['confidence']:g} % interval"
        rows.add_row(title, Text(inertia_text(inertia, "_total"), style="bold"))
        if document["gear_ratio"] != 1.0:
            rows.add_row("J at main shaft", inertia_text(document["inertia_main_shaft_kg_m2"], "_total"))
        if inertia["high_total"] > inertia["high"]:
            rows.add_row("repeatability", f"{inertia_text(inertia)}, this drive")
    if document["reference_inertia_kg_m2"] is not None:
        rows.add_row("reference J", f"{document['reference_inertia_kg_m2']:g} kg·m² (rig.yaml)")
    for title, key, unit in (
        ("viscous friction B", "viscous_nm_s_rad", "N·m·s/rad"),
        ("Coulomb friction", "coulomb_nm", "N·m"),
        ("lag of speed", "speed_lag_s", "s"),
        ("lag of torque", "torque_lag_s", "s"),
        ("skew", "skew_s", "s"),
    ):
        if (part := document[key]) is not None:
            rows.add_row(title, estimate_text(part, unit))
    for title, text in (*compliant_rows(document), *friction_rows(document), *opinion_rows(document)):
        rows.add_row(title, text)
    if (paper := document["paper"]) is not None and paper["inertia_kg_m2"] is not None:
        rows.add_row("the paper's method", _paper_text(paper, inertia))
    for stage in document.get("stages", ()):
        if stage["outcome"] == "skipped":
            rows.add_row(f"stage {stage['name']}", f"skipped: {stage.get('detail', '')}")
    rows.add_row("model", document["model"])
    body: list[RenderableType] = [rows, Text()]
    if inertia is not None and document["budget"]:
        body += [budget_table(document["budget"], inertia["value"]), Text()]
    body.append(Text(_sentence(document["reason"])))
    if document["advice"]:
        body.append(Text(_sentence(document["advice"]), style="italic"))
    body += [Text(f"! {warning}", style="yellow") for warning in document["warnings"]]
    body.append(Text(f"log: {document['log']}", style="dim", overflow="fold"))
    title = "moment of inertia at the motor shaft" + (f" · {SIMULATED}" if document["simulated"] else "")
    return Panel(Group(*body), title=title, border_style="magenta" if document["simulated"] else "blue")


def _paper_text(paper: Mapping[str, Any], inertia: Mapping[str, Any] | None) -> str:
    """The paper's own number, how far it is from ours, and what it becomes at the raw rate."""
    parts = []
    if inertia is not None:
        parts.append(f"{100.0 * (paper['inertia_kg_m2'] / inertia['value'] - 1.0):+.1f} %")
    if paper["r2"] is not None:
        parts.append(f"r² {paper['r2']:.3f}")
    raw = paper["raw_rate"]["inertia_kg_m2"]
    if raw is not None:
        parts.append(f"at the raw rate {raw:.4g}")
    return f"{paper['inertia_kg_m2']:.5g} kg·m²  ({'; '.join(parts)})"


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:] + ("" if text.endswith((".", "!", "?")) else ".")


def print_card(document: Mapping[str, Any], console: Console) -> None:
    """The card, on a console."""
    console.print(result_card(document))
