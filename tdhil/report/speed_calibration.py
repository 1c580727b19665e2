"""Speed calibration as a JSON document, on a terminal, and in the layout of a calibration laboratory."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tdhil.report.blocks import Column, Pairs, Report, ReportSection, Table, Text
from tdhil.report.calibration_page import (
    calibrated_item,
    date_and_signature,
    laboratory_page,
    print_calibration_card,
    recordings,
    result_rows,
    scale_error,
    shown_degrees,
)
from tdhil.report.card import sentence
from tdhil.report.console import PlainConsole
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
    factor, inputs = document["calibration_factor"], document["inputs"]
    rows = []
    if inputs:
        rows.append(("counted", _counted(inputs)))
    if document["log"] is not None:
        rows.append(("log", Path(document["log"]["log"]).name))
    k = 1.0 if factor is None else factor["coverage_factor"]
    budget = [(line["source"],
               f"{line['standard_uncertainty']:.3g}" + ("" if line["unit"] == "1" else f" {line['unit']}"),
               f"{100.0 * k * line['of_factor']:.3f}")
              for line in sorted(document["budget"], key=lambda one: -one["of_factor"])]
    print_calibration_card(
        document, "speed calibration", rows, ("1 sd", "1 sd, % of κ" if factor is None else "± % of κ"), budget,
        console, quantity="speed", remark="" if factor is None else _NOT_APPLIED)


def _counted(inputs: Part) -> str:
    return (f"{inputs['counted_turns']:g} turns of the {inputs['at']} shaft in {inputs['seconds']:.5g} s,"
            f" {abs(inputs['speed_rad_s']):.5g} rad/s reported")


# ---------------------------------------------------------------------------------------------------------------------
# Page of a speed calibration


def speed_report(document: Part) -> Report:
    """Return the report in the layout of a calibration laboratory, as that of a torque calibration."""
    factor = document["calibration_factor"]
    lines = () if factor is None else (f"The drive reports {scale_error(factor, 'speed')}",)
    return laboratory_page(document, lines, _sections(document), "speed")


def _sections(document: Part) -> Iterator[ReportSection]:
    factor, inputs = document["calibration_factor"], document["inputs"]
    yield calibrated_item(document)
    yield ReportSection("Method", (Text(_METHODS[document["method"]]),))
    if inputs:
        yield ReportSection("Counted turns", (Pairs((("counted", _counted(inputs)),)),))
    if factor is not None:
        yield ReportSection("Result", (
            result_rows((("calibration factor κ", factor, "1"),)), Text(
                "The expanded uncertainty U is the standard uncertainty multiplied by the coverage factor k for a"
                f" coverage probability of {100.0 * factor['confidence']:g} %. {sentence(_NOT_APPLIED)}")))
    if document["budget"]:
        yield ReportSection("Uncertainty budget", (_page_budget(document), Text(_BUDGET_NOTE)))
    yield recordings({"runs": [] if document["log"] is None else [document["log"]]})
    yield date_and_signature(document)


_METHODS = {
    "turns": (
        "Turns N of the shaft were counted in a time t, and the mean reported speed Ω was noted. With true speed"
        " ω = κ Ω, the measurement equation is κ = 2π N/(Ω t). Evaluation of uncertainty: JCGM 100 (GUM), first order,"
        " effective degrees of freedom after Welch and Satterthwaite."
    ),
    "position": (
        "The angle that the drive's position counter shows was divided by the integral of the reported speed, in"
        " stretches of one run. The counts per turn are taken as exact. The mean has the weights of the stretches."
        " Evaluation of uncertainty: JCGM 100 (GUM), first order, effective degrees of freedom after Welch and"
        " Satterthwaite."
    ),
}
_BUDGET_NOTE = (
    "u: standard uncertainty of the input quantity; ν: its degrees of freedom; c·u: contribution to the relative"
    " standard uncertainty of κ, %."
)


def _page_budget(document: Part) -> Table:
    rows = [(line["source"], f"{line['standard_uncertainty']:.3g}", "" if line["unit"] == "1" else line["unit"],
             line["distribution"], shown_degrees(line["degrees_of_freedom"]), f"{100.0 * line['of_factor']:.3f}")
            for line in document["budget"]]
    if (factor := document["calibration_factor"]) is not None:
        rows.append(("combined", "", "", "", shown_degrees(factor["degrees_of_freedom"]),
                     f"{100.0 * factor['standard_uncertainty'] / factor['value']:.3f}"))
    columns = (Column("input quantity X", 0.38), Column("u", 0.12, True), Column("unit", 0.1),
               Column("distribution", 0.16), Column("ν", 0.08, True), Column("c·u of κ, %", 0.16, True))
    return Table(columns, tuple(rows))
