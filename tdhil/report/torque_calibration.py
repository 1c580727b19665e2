"""Torque calibration as a JSON document, on a terminal, and in the layout of a calibration laboratory."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.text import Text as Words

from tdhil.report.blocks import Block, Column, Picture, Report, ReportSection, Table, Text
from tdhil.report.calibration_page import (
    band_of,
    calibrated_item,
    date_and_signature,
    laboratory_page,
    print_calibration_card,
    quantity,
    recordings,
    result_rows,
    run_name,
    scale_error,
    shown_degrees,
    with_share,
)
from tdhil.report.console import PlainConsole
from tdhil.report.document import codes_of
from tdhil.report.intervals import plus_minus
from tdhil.report.plots import DARK, OURS, QUIET
from tdhil.version import __version__

if TYPE_CHECKING:
    from matplotlib.figure import FigureBase

    from tdhil.calibration import TorqueCalibration

Part = Mapping[str, Any]


def calibration_document(
    found: TorqueCalibration, runs: tuple[Part, ...], drive: Part, settings: Part, *, date: str, at: str,
    confidence: float, simulated: bool, warnings: tuple[str, ...],
) -> dict[str, Any]:
    """Return plain data for `json.dumps`. ``runs``: log, its hash, its date, the body; in the order of the points.

    ``at``: the shaft for which the bodies were stated; every inertia is at the motor shaft. ``date``: of the
    calibration.
    """
    points = [{**run, **asdict(point)} for run, point in zip(runs, found.points, strict=True)] if found.points else [
        dict(run) for run in runs]
    return {
        "kind": "torque_calibration",
        "method": "bodies",
        "verdict": found.verdict.value,
        "reason": found.reason,
        "advice": found.advice,
        "calibration_factor": quantity(found.factor, confidence),
        "inertia_kg_m2": quantity(found.inertia_kg_m2, confidence),
        "budget": [asdict(line) for line in found.budget],
        "runs": points,
        "line": None if not math.isfinite(found.slope) else {
            "slope": found.slope, "intercept_kg_m2": found.intercept_kg_m2,
            "covariance": [list(row) for row in found.line_covariance],
        },
        "linearity": None if found.linearity is None else asdict(found.linearity),
        "sharing": None if found.sharing is None else asdict(found.sharing),
        "least_added_kg_m2": found.least_added_kg_m2,
        "at": at,
        "drive": dict(drive) or None,
        "settings": dict(settings),
        "date": date,
        "simulated": simulated,
        "warnings": list(warnings),
        "warning_codes": codes_of(warnings),
        "tdhil": __version__,
    }


# ---------------------------------------------------------------------------------------------------------------------
# Card of a torque calibration


def print_calibration(document: Part, console: PlainConsole) -> None:
    """Print the card of a torque calibration on a console."""
    factor, inertia = document["calibration_factor"], document["inertia_kg_m2"]
    rows: list[tuple[str, str | Words]] = []
    if inertia is not None:
        rows.append(("J without the body", Words(with_share(inertia, "kg·m²"), style="bold")))
    for run in document["runs"]:
        text = f"{run_name(run)}: {run['added_kg_m2']:.4g} kg·m² added"
        if "reported_kg_m2" in run:
            text += f", identified {plus_minus(run['reported_kg_m2'], 2.0 * run['standard_uncertainty_kg_m2'])}"
        rows.append(("run", text))
    for name, key in (("straight line", "linearity"), ("filters shared", "sharing")):
        if document[key] is not None:
            rows.append((name, f"p = {document[key]['p_value']:.2g}"))
    # each input quantity's contribution to κ and to J, at the coverage factor of the result
    budget = [] if factor is None else [
        (line["source"], f"{100.0 * factor['coverage_factor'] * line['of_factor']:.2f}",
         f"{100.0 * inertia['coverage_factor'] * line['of_inertia']:.2f}")
        for line in sorted(document["budget"], key=lambda one: -one["of_inertia"])]
    print_calibration_card(document, "torque calibration", rows, ("± % of κ", "± % of J"), budget, console)


# ---------------------------------------------------------------------------------------------------------------------
# Page of a torque calibration


def calibration_report(document: Part) -> Report:
    """Return the report in the layout of a laboratory: item, conditions, result, budget, data, date and signature."""
    factor, inertia = document["calibration_factor"], document["inertia_kg_m2"]
    lines = []
    if factor is not None and inertia is not None:
        lines = [f"J without the body {with_share(inertia, 'kg·m²')}", f"The drive reports {scale_error(factor)}"]
    return laboratory_page(document, lines, _sections(document))


def _sections(document: Part) -> Iterator[ReportSection]:
    yield calibrated_item(document)
    yield ReportSection("Method", (Text(_METHOD),))
    if (factor := document["calibration_factor"]) is not None:
        yield ReportSection("Result", (_results(document), Text(
            "The expanded uncertainty U is the standard uncertainty multiplied by the coverage factor k for a coverage"
            f" probability of {100 * factor['confidence']:g} %. Of a calibrated torque, the share that comes from the"
            " unit of speed is part of κ: κ is valid for inertia and for torque over acceleration.")))
        rows = []
        for line in document["budget"]:
            dof, sd = line["degrees_of_freedom"], line["standard_uncertainty_kg_m2"]
            shares = [cell for key in ("of_factor", "of_inertia") for cell in (
                f"{100 * line[key] / sd:.3g}" if sd > 0.0 else "", f"{100 * line[key]:.3f}")]
            rows.append((line["source"], f"{sd:.3g}", line["distribution"], shown_degrees(dof), *shares))
        total = ["combined", "", "", ""]
        for key in ("calibration_factor", "inertia_kg_m2"):
            total += ["", f"{100 * document[key]['standard_uncertainty'] / document[key]['value']:.3f}"]
        columns = (Column("input quantity X", 0.26), Column("u, kg·m²", 0.12, True), Column("distribution", 0.14),
                   Column("ν", 0.08, True), Column("c of κ", 0.1, True), Column("c·u of κ, %", 0.1, True),
                   Column("c of J", 0.1, True), Column("c·u of J, %", 0.1, True))
        yield ReportSection("Uncertainty budget", (Table(columns, (*rows, tuple(total))), Text(_BUDGET_NOTE)))
    if document["line"] is not None:
        yield ReportSection("Identified over known inertia", (_picture(document), _data(document)))
    yield recordings(document)
    yield date_and_signature(document)


_METHOD = (
    "The moment of inertia y was identified from the drive's reported torque and speed, without and with bodies of"
    " known inertia b on the shaft. With the calibration factor κ, true torque T = κ T_rep, the measurement equation is"
    " y = (J + b)/κ. The runs were fitted together with the filters of the drive's reports in common; the line over b"
    " was fitted by generalised least squares. Evaluation of uncertainty: JCGM 100 (GUM), first order, effective"
    " degrees of freedom after Welch and Satterthwaite."
)
_BUDGET_NOTE = (
    "u: standard uncertainty of the input quantity; ν: its degrees of freedom; c: magnitude of the relative sensitivity"
    " coefficient of κ and of J, % per kg·m²; c·u: contribution to the relative standard uncertainty, %. “Filters of"
    " the reports” acts on all runs together: its c is effective."
)


def _results(document: Part) -> Table:
    return result_rows((("calibration factor κ", document["calibration_factor"], "1"),
                        ("moment of inertia J", document["inertia_kg_m2"], "kg·m²")))


def _data(document: Part) -> Table:
    rows = tuple((run_name(run), f"{run['added_kg_m2']:.5g}", f"{run['reported_kg_m2']:.5g}",
                  f"{run['standard_uncertainty_kg_m2']:.2g}", f"{_residual(run):+.2g}" if _residual(run) else "0")
                 for run in document["runs"])
    return Table((Column("recording", 0.36), *(Column(name, 0.16, True) for name in
                                              ("b, kg·m²", "y, kg·m²", "u(y)", "residual"))), rows)


def _residual(run: Part) -> float:
    """Return the residual; 0 if it is rounding only, as with two runs."""
    left = float(run["residual_kg_m2"])
    return left if abs(left) > _ROUNDING * abs(run["reported_kg_m2"]) else 0.0


_ROUNDING = 1e-9


def _picture(document: Part) -> Block:
    return Picture("bodies", partial(draw_calibration, document=document), 4.2,
                   "Identified over known added inertia, in the drive's unit of torque; the line, its coverage band,"
                   " and the residuals.")


def draw_calibration(figure: FigureBase, document: Part) -> None:
    """Draw, above, the runs, the line and its band (dotted: an exact torque scale); below, residuals."""
    runs, line = document["runs"], document["line"]
    added = np.array([run["added_kg_m2"] for run in runs])
    seen = np.array([run["reported_kg_m2"] for run in runs])
    k, label = band_of(document["calibration_factor"])
    half = k * np.array([run["standard_uncertainty_kg_m2"] for run in runs])
    left = np.array([run["residual_kg_m2"] for run in runs])
    x = np.linspace(min(0.0, float(added.min())), 1.08 * float(added.max()), 100)
    y = line["intercept_kg_m2"] + line["slope"] * x
    covariance = np.array(line["covariance"])
    design = np.column_stack([np.ones_like(x), x])
    band = k * np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", design, covariance, design), 0.0))
    top, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    top.fill_between(x, y - band, y + band, color=OURS, alpha=0.2, lw=0, label=label)
    top.plot(x, y, "-", color=OURS, lw=1.4, label=f"slope 1/κ = {line['slope']:.4f}")
    top.plot(x, line["intercept_kg_m2"] + x, ":", color=QUIET, lw=1.2, label="exact torque scale")
    top.errorbar(added, seen, half, fmt="o", color=DARK, ms=5, capsize=3, lw=1.2, label="runs")
    top.set_ylabel("identified, kg·m²")
    top.legend(fontsize="small", loc="best")
    below.axhline(0.0, color=OURS, lw=1.0)
    below.fill_between(x, -band, band, color=OURS, alpha=0.2, lw=0)
    below.errorbar(added, left, half, fmt="o", color=DARK, ms=4, capsize=3, lw=1.0)
    below.set(xlabel="known added inertia at the motor shaft, kg·m²", ylabel="residual,\nkg·m²")
    for axes in (top, below):
        axes.grid(alpha=0.3)
