"""Speed calibration as a JSON document, and on a terminal."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Group
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from tdhil.report.card import sentence, with_interval
from tdhil.report.console import PlainConsole, names_and_texts
from tdhil.report.document import SIMULATED
from tdhil.version import __version__

if TYPE_CHECKING:
    from tdhil.calibration import SpeedCalibration

Part = Mapping[str, Any]
_NOT_APPLIED = ("The factor is not applied to any run. Multiply the scale of the speed in the profile by it. A torque"
                " calibration by a known body already contains the unit of speed, as far as J is concerned")


def speed_document(
    found: SpeedCalibration, inputs: Part, drive: Part, settings: Part, *, log: Part | None, date: str,
    confidence: float, simulated: bool, warnings: tuple[str, ...],
) -> dict[str, Any]:
    """Return plain data for `json.dumps`. ``inputs``: of a count; ``log``: its name, hash and date."""
    return {
        "kind": "speed_calibration",
        "method": found.method,
        "verdict": found.verdict.value,
        "reason": found.reason,
        "advice": found.advice,
        "calibration_factor": None if found.factor is None else {**asdict(found.factor), "confidence": confidence},
        "budget": [asdict(line) for line in found.budget],
        "least_turns": found.least_turns,
        "inputs": dict(inputs),
        "log": None if log is None else dict(log),
        "drive": dict(drive) or None,
        "settings": dict(settings),
        "date": date,
        "simulated": simulated,
        "warnings": list(warnings),
        "tdhil": __version__,
    }


def print_speed_calibration(document: Part, console: PlainConsole) -> None:
    """Print the card of a speed calibration on a console."""
    factor, verdict = document["calibration_factor"], document["verdict"]
    rows = names_and_texts([("verdict", Text(verdict, style="bold green" if verdict == "valid" else "bold red"))])
    if factor is not None:
        half = 50.0 * (factor["high"] - factor["low"]) / factor["value"]
        error = 100.0 * (1.0 / factor["value"] - 1.0)
        rows.add_row("calibration factor", Text(
            f"{with_interval(factor['value'], factor['low'], factor['high'], '').rstrip()}  ±{half:#.2g} %",
            style="bold"))
        rows.add_row("", "true speed = κ · reported speed: the drive reports"
                         f" {abs(error):.2g} % too {'much' if error > 0.0 else 'little'} speed")
    inputs = document["inputs"]
    if inputs:
        rows.add_row("counted", f"{inputs['counted_turns']:g} turns of the {inputs['at']} shaft in"
                                f" {inputs['seconds']:.5g} s, {abs(inputs['speed_rad_s']):.5g} rad/s reported")
    if document["log"] is not None:
        rows.add_row("log", Path(document["log"]["log"]).name)
    body: list[Any] = [rows]
    if document["budget"]:
        body.append(_budget(document["budget"], None if factor is None else factor["coverage_factor"]))
    body.append(Text(sentence(document["reason"])))
    if document["advice"]:
        body.append(Text(sentence(document["advice"]), style="italic"))
    if factor is not None:
        body.append(Text(sentence(_NOT_APPLIED), style="dim"))
    body += [Text(f"! {warning}", style="yellow") for warning in document["warnings"]]
    title = "speed calibration" + (f" · {SIMULATED}" if document["simulated"] else "")
    console.print(Panel(Group(*body), title=title, border_style="magenta" if document["simulated"] else "blue"))


def _budget(lines: list[Part], k: float | None) -> Table:
    table = Table.grid(padding=(0, 2))
    table.add_column(style="dim")
    for _ in range(2):
        table.add_column(justify="right", no_wrap=True)
    shown = "1 sd, % of κ" if k is None else "± % of κ"
    table.add_row(Text("uncertainty budget", style="italic"), Text("1 sd", style="dim"), Text(shown, style="dim"))
    for line in sorted(lines, key=lambda one: -one["of_factor"]):
        unit = "" if line["unit"] == "1" else f" {line['unit']}"
        table.add_row(line["source"], f"{line['standard_uncertainty']:.3g}{unit}",
                      f"{100.0 * (k or 1.0) * line['of_factor']:.3f}")
    return table
