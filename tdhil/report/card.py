"""Result card: the most important values for a field engineer, in 80 columns."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from rich.console import Console, Group, RenderableType
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from profiles.quantities import plain_number, printed_bound
from tdhil.report.acceptance import acceptance_rows
from tdhil.report.console import PlainConsole, names_and_texts
from tdhil.report.document import coded_reason, coded_warnings, marks, rehearsal_rows, uploaded_rows
from tdhil.report.intervals import interval_and_share, part_with_interval, percent, plus_minus_part, rounded
from tdhil.report.labels import (
    ACCELERATION_REGRESSION,
    BACKLASH,
    ESTIMATES,
    MOMENTUM_CROSS_CHECK,
    TORQUE_OVER_ANGLE,
    UNCERTAINTY_BUDGET,
)


def minutes(seconds: float) -> str:
    """Return ``4:07``, or ``12 s`` under a minute."""
    whole = max(0, round(seconds))
    return f"{whole // 60}:{whole % 60:02d}" if whole >= 60 else f"{whole} s"


# ---------------------------------------------------------------------------------------------------------------------
# Small tables of the result card: uncertainty budget, cross-checks, friction over speed, a compliant shaft.


_AGREES = {True: ("agrees", "green"), False: ("DOES NOT AGREE", "bold red"),
           None: ("not compared: the run gives no J", "dim")}

_NOTHING = 1e-5           # of J: a smaller contribution is left out

Row = tuple[str, Text | str]


COMPLIANT = (
    ("J_L behind the spring", "load_inertia_kg_m2", "kg·m²"),
    ("J_r + J_L", "total_inertia_kg_m2", "kg·m²"),
    ("spring k", "stiffness_nm_rad", "N·m/rad"),
    ("damping c", "damping_nm_s_rad", "N·m·s/rad"),
    ("resonance", "resonance_hz", "Hz"),
    ("antiresonance", "antiresonance_hz", "Hz"),
)


def compliant_rows(document: Mapping[str, Any]) -> Iterator[Row]:
    """Yield the rows of the inertia behind the spring; a quantity that the data leave open is marked."""
    shaft = document["compliant"]
    if shaft is None:
        return
    yield "shaft", "compliant: J above is the motor's side, J_r"
    if all(shaft[key] is None for _, key, _ in COMPLIANT):      # no quantity below the motor was measured
        return
    for title, key, unit in COMPLIANT:
        part = shaft[key]
        yield title, "left open by the data" if part is None else estimate_text(quoted(part), unit)


def impedance_rows(document: Mapping[str, Any]) -> Iterator[Row]:
    """Yield the rows of the drive's speed loop, if measured; |r| if a string was given."""
    found = document.get("impedance")
    if found is None:
        return
    title = "drive's impedance"
    if found["verdict"] != "valid":
        yield title, Text(f"{found['verdict']}: {found['reason']}", style="bold red")
        if found["advice"]:
            yield "", Text(found["advice"], style="italic")
        return
    yield title, Text.assemble((found["verdict"], "bold green"), f", by its {_BY[found['by']]}")
    yield "its P", estimate_text(found["gain_nm_s_rad"], "N·m·s/rad")
    yield "its I", estimate_text(found["integral_nm_rad"], "N·m/rad")
    yield "lags in its loop", estimate_text(found["inner_lag_s"], "s")
    if found["advice"]:
        yield "", Text(found["advice"], style="italic")
    seen = [point for point in found["points"] if point["reflection_total"] is not None]
    if seen:
        least = min(seen, key=lambda point: float(point["reflection_total"]["value"]))
        chosen = dict.fromkeys([min(seen, key=lambda point: abs(float(point["hertz"]) - hertz))["hertz"]
                              for hertz in (0.1, 0.2, 0.5)])
        parts = [f"{point['hertz']:.2g} Hz: {plus_minus_part(point['reflection_total'])}" for point in seen
                 if point["hertz"] in chosen]
        yield "|r| at the string", f"least at {least['hertz']:.2g} Hz: {plus_minus_part(least['reflection_total'])}"
        yield "", "   ".join(parts)


_BY = {"offset": "torque offset", "reference": "speed reference"}


def opinion_rows(document: Mapping[str, Any]) -> Iterator[Row]:
    """Yield every cross-check, and whether it agrees with the result."""
    for opinion in document["second_opinions"]:
        word, style = _AGREES[opinion["agrees"]]
        value = estimate_text(opinion["inertia_kg_m2"], "kg·m²")
        yield MOMENTUM_CROSS_CHECK, Text.assemble(f"{value}  ", (word, style), f", {opinion['route']}")
        if (least := opinion.get("least_scale_change")) is not None:
            yield "scale change", f"of torque or speed: {100.0 * least:.0f} % or more would show"


def friction_rows(document: Mapping[str, Any], to_a_line: int = 2) -> Iterator[Row]:
    """Yield the friction torque at every steady speed of the run."""
    points = [f"{p['speed_rad_s']:.2f} rad/s: {plus_minus_part(p['torque_nm'])}" for p in document["friction_curve"]]
    if points:
        width = max(len(point) for point in points)
        pairs = [points[k : k + to_a_line] for k in range(0, len(points), to_a_line)]
        yield "friction, N·m", "\n".join("   ".join(f"{point:<{width}}" for point in pair).rstrip() for pair in pairs)


def harmonic_rows(document: Mapping[str, Any]) -> Iterator[Row]:
    """Yield the torque that depends on the shaft's angle, a row for each order; a document before 0.4 has none."""
    title = TORQUE_OVER_ANGLE
    for one in document.get("harmonics") or ():
        amplitude, phase = estimate_text(one["amplitude_nm"], "N·m"), in_degrees(one["phase_rad"])
        yield title, f"order {one['order']}: {amplitude}, phase {plus_minus_part(phase)}°"
        title = ""
    if not title and (least := least_harmonics(document)):
        yield title, f"would show {least}"


def least_harmonics(document: Mapping[str, Any]) -> str:
    """Return the detection limits of a few orders, from the lowest to the highest; "" if there are none."""
    limits = [one for one in document.get("least_harmonics") or () if one["order"] in (1, 6, 36)]
    return ", ".join(
        f"order {one['order']} from {printed_bound(one['amplitude_nm'], 2, up=True)} N·m" for one in limits)


def backlash_rows(document: Mapping[str, Any]) -> Iterator[Row]:
    """Yield the play of a coupling with backlash; an older document has none."""
    for one in document.get("backlash") or ():
        if (play := one[BACKLASH.key]) is None:
            yield BACKLASH.on_card, "found, size not known"
        else:
            yield BACKLASH.on_card, f"{estimate_text(in_milliradians(play), BACKLASH.unit)}, at the motor shaft"
    if (motion := document.get("backlash_motion")) and not document["backlash"] and not motion["torque_reverses"]:
        yield BACKLASH.on_card, f"may be hidden: the torque stays above {motion['least_torque_nm']:.2g} N·m"


def in_milliradians(part: Mapping[str, Any]) -> dict[str, float]:
    """Return an angle with its interval, converted from rad to mrad."""
    return {key: 1e3 * part[key] for key in ("value", "low", "high")}


def in_degrees(part: Mapping[str, Any]) -> dict[str, Any]:
    """Return an angle with its interval, converted from rad to degrees."""
    return {key: math.degrees(part[key]) for key in ("value", "low", "high")}


def budget_table(budget: Sequence[Mapping[str, Any]], value: float, notes: bool = True) -> Table:
    """Return the uncertainty budget, largest contribution first; ``notes``: with explanations."""
    table = Table.grid(padding=(0, 2))
    table.add_column(style="dim", no_wrap=True)
    table.add_column(justify="right", no_wrap=True)
    table.add_column(justify="right", no_wrap=True)
    if notes:
        table.add_column(style="dim", overflow="fold")
    table.add_row(Text(UNCERTAINTY_BUDGET, style="italic"), Text("± kg·m²", style="dim"), Text("± %", style="dim"))
    for line in sorted(budget, key=lambda line: -(line["half_width_kg_m2"] or 0.0)):
        note = (line["note"],) if notes else ()
        table.add_row(line["source"], *budget_figures(line["half_width_kg_m2"], value), *note)
    return table


def budget_figures(half_width: float | None, value: float | None) -> tuple[str, str]:
    """Return a half-width of the budget, and its share of J in %, rounded up. A contribution below `_NOTHING` is 0."""
    if half_width is None:
        return "open", ""
    if value is not None and half_width < _NOTHING * value:
        return "0", "0"
    return printed_bound(half_width, 2, up=True), percent(half_width, value).strip("±% ") if value else ""


def estimate_text(part: Mapping[str, Any], unit: str) -> str:
    """Return an estimate of the document with its interval; an open side is named. At a bound of zero: "at most"."""
    if part["low"] is None or part["high"] is None:
        sides = "both sides" if part["low"] == part["high"] else "one side"
        return f"{plain_number(part['value'])} {unit}, open on {sides}"
    shown, _, most = rounded(part["value"], part["low"], part["high"])
    if part["low"] == 0.0 and part["high"] > 0.0 and float(shown) == 0.0:
        return f"at most {most} {unit}"
    return part_with_interval(part, unit)


def quoted(part: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the estimate with the interval to quote: with the torque scale, if it is proportional to the torque."""
    return {**part, "low": part["low_total"], "high": part["high_total"]} if "low_total" in part else part


def inertia_text(part: Mapping[str, Any], kind: str = "") -> str:
    """Return J with the interval that includes the torque scale (``_total``), or with that of the repeatability."""
    return interval_and_share(part["value"], part["low" + kind], part["high" + kind], "kg·m²")


# ---------------------------------------------------------------------------------------------------------------------

_NARROW = 72          # columns; in a narrower terminal, tables keep their numbers and lose their notes

_VERDICT_STYLE = {
    "valid": "bold green",
    "valid_wide": "bold yellow",
    "not_identifiable": "bold red",
    "model_rejected": "bold red",
}


_TEST_STYLE = {"pass": "bold green", "fail": "bold red", "inconclusive": "yellow", "cannot tell": "yellow"}


def result_card(document: Mapping[str, Any], width: int = 80) -> RenderableType:
    """Return a panel of the result document; ``width``: available columns."""
    narrow = width < _NARROW
    rows = names_and_texts(())
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
    for label in ESTIMATES:
        if (part := document[label.key]) is not None:
            rows.add_row(label.on_card, estimate_text(quoted(part), label.unit))
    more = (*impedance_rows(document), *compliant_rows(document), *harmonic_rows(document),
            *backlash_rows(document), *friction_rows(document, 1 if narrow else 2), *opinion_rows(document))
    for title, text in more:
        rows.add_row(title, text)
    if (paper := document["paper"]) is not None and paper["inertia_kg_m2"] is not None:
        rows.add_row(ACCELERATION_REGRESSION.replace(" ", "\n", 1), _paper_text(paper, inertia))
    for stage in document.get("stages", ()):
        if stage["outcome"] == "skipped":
            rows.add_row(f"stage {stage['name']}", f"skipped: {stage.get('detail', '')}")
    rows.add_row("model", document["model"])
    if document.get("rehearsed_faults") and not document.get("rehearsal"):
        rows.add_row("rehearsed", ", ".join(document["rehearsed_faults"]))
    for title, text in (*uploaded_rows(document.get("uploaded")), *rehearsal_rows(document.get("rehearsal")),
                        *acceptance_rows(document.get("acceptance"))):
        rows.add_row(title, Text(text, style=_TEST_STYLE.get(text, ""), overflow="fold"))
    body: list[RenderableType] = [rows, Text()]
    if inertia is not None and document["budget"]:
        body += [budget_table(document["budget"], inertia["value"], not narrow), Text()]
    body.append(Text(coded_reason(sentence(document["reason"]), document)))
    if document["advice"]:
        body.append(Text(sentence(document["advice"]), style="italic"))
    body += [Text(f"! {warning}", style="yellow") for warning in coded_warnings(document)]
    body.append(Text(f"log: {document['log']}", style="dim", overflow="fold"))
    title = "J at the motor shaft" if narrow else "moment of inertia at the motor shaft"
    title += f" · {found}" if (found := marks(document)) else ""
    return Panel(Group(*body), title=title, border_style="magenta" if document["simulated"] else "blue")


def _paper_text(paper: Mapping[str, Any], inertia: Mapping[str, Any] | None) -> str:
    """Return the slope, its distance from J in percent, r², and the slope at the raw rate."""
    parts = []
    if inertia is not None:
        parts.append(f"{100.0 * (paper['inertia_kg_m2'] / inertia['value'] - 1.0):+.1f} %")
    if paper["r2"] is not None:
        parts.append(f"r² {paper['r2']:.3f}")
    raw = paper["raw_rate"]["inertia_kg_m2"]
    if raw is not None:
        parts.append(f"at the raw rate {raw:.4g}")
    return f"{paper['inertia_kg_m2']:.5g} kg·m²\n{'; '.join(parts)}"


def sentence(text: str) -> str:
    """Return the text with a capital and a full stop; '' for an empty text."""
    return text[:1].upper() + text[1:] + ("" if text.endswith((".", "!", "?")) else ".") if text else ""


def print_card(document: Mapping[str, Any], console: Console) -> None:
    """Print the card on a console."""
    console.print(result_card(document, console.width))


def card_text(document: Mapping[str, Any], width: int = 80) -> str:
    """Return the card as plain text."""
    console = PlainConsole(io.StringIO())
    console.width = width
    console.print(result_card(document, console.width))
    return console.file.getvalue()      # type: ignore[attr-defined, no-any-return]


def card_html(document: Mapping[str, Any], width: int = 100) -> str:
    """Return the card as a piece of HTML with its own colours, for a notebook."""
    console = PlainConsole(io.StringIO(), record=True)
    console.width = width
    console.print(result_card(document, console.width))
    return console.export_html(inline_styles=True, code_format=_HTML)


_HTML = '<pre style="font-family:monospace;line-height:normal;white-space:pre;overflow-x:auto">{code}</pre>'
