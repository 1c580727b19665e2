"""Torque calibration without a body: with pairs of torque, a reference sensor, or a known pipe.

The document is that of `tdhil calibrate torque` with a calibration factor and its budget. It has no moment of inertia.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from profiles.quantities import printed_share
from tdhil.report.blocks import Block, Column, Pairs, Picture, Report, ReportSection, Table, Text
from tdhil.report.calibration_page import (
    band_of,
    calibrated_item,
    date_and_signature,
    laboratory_page,
    print_calibration_card,
    quantity,
    recordings,
    result_rows,
    scale_error,
    shown_degrees,
)
from tdhil.report.console import PlainConsole
from tdhil.report.document import codes_of
from tdhil.report.intervals import part_with_interval
from tdhil.report.plots import DARK, OURS, QUIET
from tdhil.version import __version__

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

    from tdhil.calibration import FactorLine, KnownPipe, KnownPipeFit, PairsFit, ReferenceFit, TorquePairs
    from tdhil.estimation import MeasuredString

Part = Mapping[str, Any]

PAIRS, REFERENCE, KNOWN_PIPE = "pairs", "reference", "known_pipe"


def pairs_document(
    found: PairsFit, pairs: TorquePairs, source: str, drive: Part, settings: Part, *, date: str | None,
    confidence: float, simulated: bool, runs: Sequence[Part] = (),
) -> dict[str, Any]:
    """Return plain data for `json.dumps`; ``source``: file of the pairs; ``drive``: as in a log.

    ``date``: of the measurement; None if it is not known.
    """
    return {
        **_begun(PAIRS, "valid" if not found.refusal else "not_identifiable" if found.too_wide else "model_rejected",
                 found.refusal or (f"{len(pairs.direction)} pairs give κ to "
                                   f"{printed_share(found.factor.half_width_share)}"), ""),
        "calibration_factor": None if found.refusal else quantity(found.factor, confidence),
        "offset_nm": quantity(found.offset_nm, confidence),
        "budget": _budget_lines(found.budget),
        "scatter": asdict(found.scatter),
        "spread": found.spread,
        "hysteresis_nm": found.hysteresis_nm,
        "pairs": [
            {"reported_nm": float(x), "reference_nm": float(y), "reported_sd_nm": float(x_sd),
             "reference_sd_nm": float(y_sd), "residual_nm": float(left), "direction": direction}
            for x, y, x_sd, y_sd, left, direction in zip(
                pairs.reported_nm, pairs.reference_nm, pairs.reported_sd_nm, pairs.reference_sd_nm, found.residuals_nm,
                pairs.direction, strict=True)
        ],
        "line": {"slope": found.factor.value, "intercept_nm": found.offset_nm.value,
                 "covariance": found.covariance.tolist()},
        **_ended(source, runs, drive, settings, date, simulated, found.warnings),
    }


def reference_document(
    found: ReferenceFit, source: Part, runs: Sequence[Part], drive: Part, settings: Part, *, date: str,
    confidence: float, simulated: bool, warnings: Sequence[str],
) -> dict[str, Any]:
    """Return plain data for `json.dumps`; ``source``: file, hash and shaft of the sensor's recording."""
    factor = found.factor
    reason = found.refusal
    if not reason and factor is not None:
        reason = (f"{found.overlap_s:.0f} s of both records give κ to {printed_share(factor.half_width_share)}")
    series = found.series
    return {
        **_begun(REFERENCE, "not_identifiable" if found.refusal else "valid", reason, found.advice),
        "calibration_factor": None if found.refusal else quantity(factor, confidence),
        "offset_nm": quantity(found.offset_nm, confidence),
        "budget": _budget_lines(found.budget),
        "alignment": {name: _number(getattr(found, name)) for name in (
            "time_offset_s", "correlation", "overlap_s", "average_s", "filter_s", "swing_nm", "samples",
            "effective_samples")},
        "line": None if factor is None or found.offset_nm is None else {
            "slope": factor.value, "intercept_nm": found.offset_nm.value},
        "series": None if series is None else {
            name: [round(float(one), 6) for one in values] for name, values in asdict(series).items()},
        **_ended(str(source["file"]), runs, drive, settings, date, simulated, warnings),
        "reference": dict(source),
    }


def known_pipe_document(
    found: KnownPipeFit | None, measured: MeasuredString | None, known: KnownPipe, refusal: tuple[str, str],
    source: Part, runs: Sequence[Part], drive: Part, settings: Part, *, date: str, confidence: float, simulated: bool,
) -> dict[str, Any]:
    """Return plain data for `json.dumps`; ``refusal``: reason and advice if nothing was measured.

    ``measured_factor`` is present even if its interval is too wide for use; ``calibration_factor`` is then None.
    """
    reason, advice = refusal if found is None else (found.refusal, found.advice)
    verdict = "not_identifiable" if reason else "valid"
    factor = None if found is None else quantity(found.factor, confidence)
    if found is not None and not reason:
        reason = (f"the pipe gives κ to {printed_share(found.factor.half_width_share)}; the torque scale as stated so "
                  f"far leaves ±{100 * found.typed_half_width:.1f} %")
    return {
        **_begun(KNOWN_PIPE, verdict, reason, advice),
        "calibration_factor": None if verdict != "valid" else factor,
        "measured_factor": factor,
        "budget": () if found is None else _budget_lines(found.budget),
        "typed_half_width": None if found is None else found.typed_half_width,
        "pipe": {
            "impedance_nm_s_rad": known.impedance_nm_s_rad, "delay_s": known.delay_s, "exponent": known.exponent,
            "measured_impedance_nm_s_rad": None if measured is None else measured.impedance_nm_s_rad,
            "measured_delay_s": None if measured is None else measured.delay_s,
            "residual": None if measured is None or measured.residual is None else asdict(measured.residual),
            "inputs": [asdict(one) for one in known.inputs],
        },
        **_ended(str(source["file"]), runs, drive, settings, date, simulated,
                 () if found is None else found.warnings),
        "string": dict(source),
    }


def _begun(method: str, verdict: str, reason: str, advice: str) -> dict[str, Any]:
    return {"kind": "torque_calibration", "method": method, "verdict": verdict, "reason": reason, "advice": advice}


def _ended(
    source: str, runs: Sequence[Part], drive: Part, settings: Part, date: str | None, simulated: bool,
    warnings: Sequence[str],
) -> dict[str, Any]:
    return {"source": source, "runs": [dict(run) for run in runs], "drive": dict(drive) or None,
            "settings": dict(settings), "date": date, "simulated": simulated, "warnings": list(warnings),
            "warning_codes": codes_of(warnings), "tdhil": __version__}


def _budget_lines(budget: Sequence[FactorLine]) -> list[dict[str, Any]]:
    return [asdict(line) for line in budget]


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


# ---------------------------------------------------------------------------------------------------------------------
# Card of a calibration without a body


def print_factor(document: Part, console: PlainConsole) -> None:
    """Print the card of a calibration without a body on a console."""
    shown = document["calibration_factor"] or document.get("measured_factor")
    budget = [(line["source"], f"{100.0 * shown['coverage_factor'] * line['of_factor']:.3f}")
              for line in sorted(document["budget"], key=lambda one: -one["of_factor"])] if shown else []
    method = document["method"]
    print_calibration_card(document, _TITLES[method], _CARD_ROWS[method](document), ("± % of κ",), budget, console)


_TITLES = {PAIRS: "torque calibration by pairs", REFERENCE: "torque calibration by a reference sensor",
           KNOWN_PIPE: "torque calibration by a known pipe"}


def _pairs_rows(document: Part) -> Iterator[tuple[str, str]]:
    yield "offset", part_with_interval(document["offset_nm"], "N·m")
    yield "scatter", _scatter(document)
    yield "hysteresis", _hysteresis(document)
    for pair in document["pairs"]:
        yield "pair, N·m", (f"{pair['reported_nm']:9.2f} reported, {pair['reference_nm']:9.2f} true,"
                            f" residual {pair['residual_nm']:+.2g}, {pair['direction']}")


def _scatter(document: Part) -> str:
    return f"p = {document['scatter']['p_value']:.2g}" + (
        f"; {document['spread']:.2g} times as much as stated; the uncertainties include this"
        if document["spread"] > 1.0 else "")


def _hysteresis(document: Part) -> str:
    if document["hysteresis_nm"] is None:
        return "not known: all pairs are of one direction"
    return f"{document['hysteresis_nm']:+.2g} N·m, rising over falling torque"


def _reference_rows(document: Part) -> Iterator[tuple[str, str]]:
    if document["offset_nm"] is not None:
        yield "offset", part_with_interval(document["offset_nm"], "N·m")
    yield from _alignment(document)


def _alignment(document: Part) -> Iterator[tuple[str, str]]:
    found = document["alignment"]
    if found["time_offset_s"] is not None:
        yield "time offset", (f"{found['time_offset_s']:+.3f} s, reference less log; correlation"
                              f" {found['correlation']:.4f}")
    if found["average_s"] is None:
        return
    yield "common band", (f"Gaussian average of {found['average_s']:.2g} s: below"
                          f" {1.0 / (2.0 * math.pi * found['average_s']):.2g} Hz")
    slower = "reference" if found["filter_s"] > 0.0 else "reported torque"
    yield "filters", f"the {slower} is the slower, by a time constant of {abs(found['filter_s']):.2g} s"
    yield "samples", (f"{found['samples']} averages in {found['overlap_s']:.0f} s, equivalent to"
                      f" {found['effective_samples']:.0f} independent ones")


def _known_pipe_rows(document: Part) -> Iterator[tuple[str, str]]:
    pipe = document["pipe"]
    yield "pipe as stated", (f"{pipe['impedance_nm_s_rad']:.4g} N·m·s/rad; travel time {pipe['delay_s']:.4g} s to its"
                             " end")
    if pipe["measured_impedance_nm_s_rad"] is not None:
        yield "measured", (f"{pipe['measured_impedance_nm_s_rad']:.4g} N·m·s/rad in the drive's unit;"
                           f" {pipe['measured_delay_s']:.4g} s")
    if pipe["residual"] is not None:
        yield "residuals", f"p = {pipe['residual']['p_value']:.2g}, of the string's model"


_CARD_ROWS = {PAIRS: _pairs_rows, REFERENCE: _reference_rows, KNOWN_PIPE: _known_pipe_rows}


# ---------------------------------------------------------------------------------------------------------------------
# Page of a calibration without a body


def factor_report(document: Part) -> Report:
    """Return the report in the layout of a calibration laboratory, as `calibration_report`."""
    factor = document["calibration_factor"]
    lines = () if factor is None else (f"The drive reports {scale_error(factor)}",)
    return laboratory_page(document, lines, _sections(document))


def _sections(document: Part) -> Iterator[ReportSection]:
    yield calibrated_item(document)
    yield ReportSection("Method", (Text(_METHODS[document["method"]]),))
    if document["calibration_factor"] is not None:
        quantities = [("calibration factor κ", document["calibration_factor"], "1")]
        if document.get("offset_nm"):
            quantities.append(("offset of the reference a", document["offset_nm"], "N·m"))
        table = result_rows(quantities)
        yield ReportSection("Result", (table, Text(_RESULT_NOTE.format(
            confidence=100.0 * document["calibration_factor"]["confidence"]))))
        yield ReportSection("Uncertainty budget", (_page_budget(document), Text(_BUDGET_NOTE)))
    yield from _DATA[document["method"]](document)
    yield recordings(document)
    yield date_and_signature(document)


_METHODS = {
    PAIRS: (
        "Reported torque R and torque T of a reference sensor were noted in pairs, each with its standard"
        " uncertainty. The line T = κ R + a was fitted with errors in both (York 2004). If the pairs scatter by more"
        " than their stated uncertainties, all of these are enlarged in proportion. Half of the hysteresis between"
        " rising and falling torque has a rectangular distribution. Evaluation of uncertainty: JCGM 100 (GUM)."
    ),
    REFERENCE: (
        "Reported torque R and torque T of a reference sensor were recorded during one run. The time offset is that"
        " of the largest correlation, refined by least squares. Both torques passed the same Gaussian average, at"
        " their own sample times. T = κ R + a was fitted with errors in both, together with the first three"
        " derivatives of R, which stand for the difference of both low-pass filters. Residuals are correlated; their"
        " autocovariance enters the uncertainty of κ. The reference must carry the whole torque of the drive: an"
        " inertia that turns between drive and sensor is not part of this model. Evaluation of uncertainty: JCGM 100"
        " (GUM)."
    ),
}
_METHODS[KNOWN_PIPE] = (
    "A drill string of known sizes hangs on the shaft. The run was fitted with a string whose impedance ζ was free, in"
    " the drive's unit of torque, and whose travel time T was measured with it. κ is ζ T^(−e) of the stated sizes over"
    " the measured one; the exponent e is the one with the least uncertainty for the stated tolerances (−1: the"
    " string's inertia, 0: its impedance). Tolerances have rectangular distributions. Evaluation of uncertainty:"
    " JCGM 100 (GUM)."
)
_RESULT_NOTE = (
    "The expanded uncertainty U is the standard uncertainty multiplied by the coverage factor k for a coverage"
    " probability of {confidence:g} %."
)
_BUDGET_NOTE = (
    "c·u: contribution to the relative standard uncertainty of κ, %; ν: degrees of freedom of the input quantity."
)


def _page_budget(document: Part) -> Table:
    rows = [(line["source"], line["distribution"], shown_degrees(line["degrees_of_freedom"]),
             f"{100.0 * line['of_factor']:.3f}") for line in document["budget"]]
    factor = document["calibration_factor"]
    rows.append(("combined", "", shown_degrees(factor["degrees_of_freedom"]),
                 f"{100.0 * factor['standard_uncertainty'] / factor['value']:.3f}"))
    return Table((Column("input quantity X", 0.46), Column("distribution", 0.2), Column("ν", 0.14, True),
                  Column("c·u of κ, %", 0.2, True)), tuple(rows))


def _pairs_data(document: Part) -> Iterator[ReportSection]:
    rows = tuple((pair["direction"], *(f"{pair[name]:.5g}" for name in (
        "reported_nm", "reported_sd_nm", "reference_nm", "reference_sd_nm")), f"{pair['residual_nm']:+.2g}")
        for pair in document["pairs"])
    columns = (Column("direction", 0.15), *(Column(name, 0.17, True) for name in (
        "R, N·m", "u(R), N·m", "T, N·m", "u(T), N·m", "residual, N·m")))
    facts = (("source", document["source"]), ("scatter", _scatter(document)), ("hysteresis", _hysteresis(document)))
    picture = Picture("pairs", partial(draw_pairs, document=document), 4.2,
                      "Reference torque over reported torque, with the line and its 95 % band; below, the residuals of"
                      " rising and falling torque.")
    yield ReportSection("Reference over reported torque", (picture, Pairs(facts), Table(columns, rows)))


def _reference_data(document: Part) -> Iterator[ReportSection]:
    reference = document["reference"]
    facts = [("record", reference["file"]), ("SHA-256", reference["sha256"]), ("shaft", reference["at"]),
             ("standard uncertainty of its scale", f"{100.0 * reference['rel_sd']:.3g} %")]
    blocks: list[Block] = [Pairs((*facts, *_alignment(document)))]
    if document["series"] is not None:
        blocks.append(Picture("sensor", partial(draw_reference, document=document), 4.2,
                              "Both torques over the time of the log, after the same average, and the residuals."))
        blocks.append(Picture("linearity", partial(draw_linearity, document=document), 1.8,
                              "The residuals over torque."))
    yield ReportSection("Reference and reported torque", tuple(blocks))


def _known_pipe_data(document: Part) -> Iterator[ReportSection]:
    string = document["string"]
    facts = (("string", string["file"]), ("SHA-256", string["sha256"]),
             ("exponent e", f"{document['pipe']['exponent']:.2f}"))
    rows = tuple((one["source"], f"{one['low']:.4g}", f"{one['high']:.4g}", f"{one['of_impedance']:.2f}",
                  f"{one['of_delay']:.2f}") for one in document["pipe"]["inputs"])
    columns = (Column("input quantity", 0.4), *(Column(name, 0.15, True) for name in (
        "least", "largest", "c of ζ", "c of T")))
    note = Text("least and largest: factors on the stated value; c: relative sensitivity coefficients of ζ and of T.")
    yield ReportSection("Pipe", (Pairs((*facts, *_known_pipe_rows(document))), Table(columns, rows), note))


_DATA = {PAIRS: _pairs_data, REFERENCE: _reference_data, KNOWN_PIPE: _known_pipe_data}


# ---------------------------------------------------------------------------------------------------------------------
# Figures


def draw_pairs(figure: FigureBase, document: Part) -> None:
    """Draw, above, the pairs, the line and its band (dotted: an exact torque scale); below, residuals by
    direction.
    """
    pairs, line = document["pairs"], document["line"]
    x, y, x_sd, y_sd, left = (np.array([pair[name] for pair in pairs]) for name in (
        "reported_nm", "reference_nm", "reported_sd_nm", "reference_sd_nm", "residual_nm"))
    up = np.array([pair["direction"] == "up" for pair in pairs])
    margin = 0.05 * float(np.ptp(x))
    at = np.linspace(float(x.min()) - margin, float(x.max()) + margin, 100)
    design = np.column_stack([at, np.ones_like(at)])
    k, label = band_of(document["calibration_factor"])
    band = k * np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", design, np.array(line["covariance"]), design), 0.0))
    fitted = line["slope"] * at + line["intercept_nm"]
    top, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    top.fill_between(at, fitted - band, fitted + band, color=OURS, alpha=0.2, lw=0, label=label)
    top.plot(at, fitted, "-", color=OURS, lw=1.4, label=f"slope κ = {line['slope']:.4f}")
    top.plot(at, at, ":", color=QUIET, lw=1.2, label="exact torque scale")
    spread = np.hypot(y_sd, line["slope"] * x_sd)
    below.fill_between(at, -band, band, color=OURS, alpha=0.2, lw=0)
    for chosen, marker, name in ((up, "^", "rising torque"), (~up, "v", "falling torque")):
        if not chosen.any():
            continue
        top.plot(x[chosen], y[chosen], marker, color=DARK, ms=5, label=name)
        beside = x[chosen] + (0.1 if marker == "^" else -0.1) * margin      # so that error bars do not overlap
        below.errorbar(beside, left[chosen], 1.96 * spread[chosen], fmt=marker, color=DARK, ms=4, capsize=3, lw=1.0)
    top.set_ylabel("reference torque, N·m")
    top.legend(fontsize="small", loc="best")
    _residual_axes(below, "reported torque, N·m")
    top.grid(alpha=0.3)


def draw_reference(figure: FigureBase, document: Part) -> None:
    """Draw, above, both torques over time; below, residuals over time."""
    series = {name: np.array(values) for name, values in document["series"].items()}
    line = document["line"]
    top, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    top.plot(series["time_s"], series["reference_nm"], "-", color=DARK, lw=1.6, label="reference")
    top.plot(series["time_s"], line["slope"] * series["reported_nm"] + line["intercept_nm"], "-", color=OURS, lw=1.0,
             label="κ · reported + a")
    top.plot(series["time_s"], series["reported_nm"], ":", color=QUIET, lw=1.0, label="reported")
    top.set_ylabel("torque, N·m")
    top.legend(fontsize="small", loc="best")
    top.grid(alpha=0.3)
    below.plot(series["time_s"], series["residual_nm"], "-", color=OURS, lw=0.8)
    _residual_axes(below, "time of the log, s")


def draw_linearity(figure: FigureBase, document: Part) -> None:
    """Draw residuals over reported torque."""
    series = document["series"]
    axes = figure.subplots()
    axes.plot(series["reported_nm"], series["residual_nm"], ".", color=OURS, ms=3)
    _residual_axes(axes, "reported torque, N·m")


def _residual_axes(axes: Axes, across: str) -> None:
    axes.axhline(0.0, color=QUIET, lw=1.0)
    axes.set(xlabel=across, ylabel="residual,\nN·m")
    axes.grid(alpha=0.3)
