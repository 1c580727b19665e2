"""Content of a report, in order, for any output: HTML and PDF show the same blocks.

All content comes from the result document and the recording. Lengths of figures are in inches, for a page 7 inches
wide.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from typing import TYPE_CHECKING, Any

from tdhil.config import OF_THE_HEAD
from tdhil.recording import Recording
from tdhil.report.acceptance import acceptance_rows, signature_rows
from tdhil.report.card import (
    COMPLIANT,
    budget_figures,
    estimate_text,
    in_degrees,
    in_milliradians,
    inertia_text,
    least_harmonics,
    minutes,
    quoted,
    sentence,
)
from tdhil.report.document import banner, coded_reason, coded_warnings, rehearsal_rows, text_of, uploaded_rows
from tdhil.report.graphs import GRAPHS
from tdhil.report.intervals import plus_minus, plus_minus_part, rounded
from tdhil.report.labels import (
    ACCELERATION_REGRESSION,
    BACKLASH,
    ESTIMATES,
    MOMENTUM_CROSS_CHECK,
    TORQUE_OVER_ANGLE,
    UNCERTAINTY_BUDGET,
)
from tdhil.report.letterhead import NO_LETTERHEAD, Letterhead

if TYPE_CHECKING:
    from matplotlib.figure import FigureBase

Part = Mapping[str, Any]
WIDTH_IN = 7.0

_COLOURS = {"valid": "green", "valid_wide": "yellow", "not_identifiable": "red", "model_rejected": "red"}
_VERDICTS = {
    "valid": "valid: the repeatability is within the requested tolerance",
    "valid_wide": "valid, but wide: the repeatability exceeds the requested tolerance",
    "not_identifiable": "not identifiable: these data do not determine the inertia",
    "model_rejected": "model rejected: the data contradict every candidate model",
}


@dataclass(frozen=True)
class AnswerBox:
    """Box at the top; ``colour`` green, yellow or red."""

    colour: str
    value: str
    lines: tuple[str, ...]
    verdict: str
    reason: str
    advice: str


@dataclass(frozen=True)
class Text:
    """A paragraph."""

    text: str


@dataclass(frozen=True)
class Pairs:
    """Names with their texts."""

    rows: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Column:
    """Column of a table. ``share`` of the table's width; numbers are aligned on the right."""

    title: str
    share: float
    number: bool = False


@dataclass(frozen=True)
class Table:
    """Rows of as many texts as there are columns."""

    columns: tuple[Column, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Picture:
    """Figure. ``graph`` is its row in `GRAPHS`; ``draw`` fills a figure of 7 by ``height_in`` inches; ``about``
    states what it shows; ``names_left``: long words stand beside its axis.
    """

    graph: str
    draw: Callable[[FigureBase], None]
    height_in: float
    about: str
    names_left: bool = False

    @property
    def caption(self) -> str:
        """Text below the figure: what it shows, and how to read it."""
        return f"{self.about} {GRAPHS[self.graph].reading}"


Block = Text | Pairs | Table | Picture


@dataclass(frozen=True)
class ReportSection:
    """Blocks under a heading."""

    heading: str
    blocks: tuple[Block, ...]


@dataclass(frozen=True)
class Report:
    """Complete report. ``simulated`` is the banner of `marks`, '' without a mark. ``reference``: customer, order
    number and place, as names with texts; every sheet repeats them. ``answer``: None without a verdict.
    """

    title: str
    subtitle: str
    simulated: str
    answer: AnswerBox | None
    warnings: tuple[str, ...]
    sections: tuple[ReportSection, ...]
    footer: str
    reference: tuple[tuple[str, str], ...] = ()
    letterhead: Letterhead = NO_LETTERHEAD


def report_of(document: Part, recording: Recording, sha256: str = "") -> Report:
    """Return the report of a result; ``sha256`` is that of its log."""
    rig = document["rig"] or {}
    facts = [name for name in (rig.get("name"), shown_date(document["date"])) if name]
    return Report(
        title="Moment of inertia at the motor shaft",
        subtitle=" · ".join(facts),
        simulated=banner(document),
        answer=_answer(document),
        warnings=coded_warnings(document),
        sections=tuple(section for section in _sections(document, recording, sha256) if section.blocks),
        footer=_footer(document, sha256),
        reference=reference_of(document),
    )


def report_of_run(
    document: Part, title: str, facts: Iterable[str | None], answer: AnswerBox, sections: Iterable[ReportSection],
    sha256: str,
) -> Report:
    """Return the report of a run that does not identify; ``facts``: of the subtitle, ``sha256``: of its log."""
    return Report(
        title=title,
        subtitle=" · ".join(fact for fact in facts if fact),
        simulated=banner(document),
        answer=answer,
        warnings=(*coded_warnings(document), *(() if document["complete"] else (
            "The run was cut short. The report shows the data recorded before.",))),
        sections=tuple(sections),
        footer=_footer(document, sha256),
        reference=reference_of(document),
    )


def _footer(document: Part, sha256: str) -> str:
    return f"tdhil {document['tdhil']}" + (f" · log SHA-256 {sha256[:16]}…" if sha256 else "")


def reference_of(document: Part) -> tuple[tuple[str, str], ...]:
    """Return customer, order number and place of a result or of a log's configuration, those that are stated.

    The document of an earlier version lacks them. A log is not trusted: what is no text is not stated.
    """
    return tuple((one.label, text) for one in OF_THE_HEAD if (text := text_of(document.get(one.name))))


def shown_date(text: str | None) -> str:
    """Return a time as shown on every page and report: ``2026-11-22 05:17:03 UTC+01:00``; '' for none."""
    if not text:
        return ""
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        return ""
    return f"{moment:%Y-%m-%d %H:%M:%S} {moment.tzname() or ''}".strip()


def _answer(document: Part) -> AnswerBox:
    inertia, shaft = document["inertia_kg_m2"], document["compliant"]
    value, lines = "No number", []
    if inertia is not None:
        value = f"{'J_r' if shaft else 'J'} = {inertia_text(inertia, '_total')}"
        lines.append(f"{100.0 * inertia['confidence']:g} % coverage interval, torque scale of the drive included")
        if shaft is not None:
            total = shaft["total_inertia_kg_m2"]
            open_or = "left open by the data" if total is None else f"= {estimate_text(quoted(total), 'kg·m²')}"
            lines.append(f"J_r is the motor side of a compliant shaft; J_r + J_L {open_or}")
        if document["gear_ratio"] != 1.0:
            lines.append(f"at the main shaft {inertia_text(document['inertia_main_shaft_kg_m2'], '_total')}")
        if inertia["high_total"] > inertia["high"]:
            lines.append(f"repeatability, this drive: {inertia_text(inertia)}")
    return AnswerBox(
        colour=_COLOURS.get(document["verdict"], "red"),
        value=value,
        lines=tuple(lines),
        verdict=_VERDICTS.get(document["verdict"], str(document["verdict"])),
        reason=coded_reason(sentence(document["reason"]), document),
        advice=sentence(document["advice"]),
    )


def _sections(document: Part, recording: Recording, sha256: str) -> Iterator[ReportSection]:
    from tdhil.report.plots import draw_budget, draw_friction, draw_lines, draw_opinions, draw_run

    if rehearsed := rehearsal_rows(document.get("rehearsal")):
        yield ReportSection("Rehearsal", (Pairs(tuple(rehearsed)),))
    if accepted := acceptance_rows(document.get("acceptance")):
        yield ReportSection("Acceptance", (Pairs((*accepted, *signature_rows(document["acceptance"]))),))
    yield ReportSection("The run", (Pairs(tuple(_run_rows(document, recording))),))
    if len(recording.time_s):
        picture = Picture("run", partial(draw_run, recording=recording), 2.9, "Reported values, not smoothed. Green: "
                          "operating points. Blue: excitation, its settling lighter.")
        yield ReportSection("Speed and torque", (picture,))
    if (impedance := document.get("impedance")) is not None:
        yield ReportSection("The drive's own impedance", tuple(_impedance(impedance)))
    if document["inertia_kg_m2"] is not None or document["second_opinions"]:
        rows = len(document["second_opinions"]) + 4
        picture = Picture(
            "estimates", partial(draw_opinions, document=document), 0.55 + 0.2 * rows,
            "The result beside other estimates from the same data. A momentum cross-check shares friction and torque "
            "scale with the result, and little else. If the two differ by more than their intervals, one of the "
            "assumptions is wrong.", names_left=True,
        )
        yield ReportSection("Estimates of the inertia", (picture, *_opinions(document)))
    if document["lines"]:
        picture = Picture(
            "lines", partial(draw_lines, document=document), 3.0,
            "Ratio of torque to acceleration at each excited frequency. It changes with frequency, because the drive "
            "reports speed and torque late. The model explains all frequencies with one J (the band). Below: the "
            "residuals of the model in standard deviations.",
        )
        yield ReportSection("Torque over acceleration at each excited frequency", (picture,))
    if (response := document.get("frequency_response")) is not None:
        yield ReportSection("Frequency response", tuple(_response(response)))
    if document["budget"]:
        picture = Picture(
            "budget", partial(draw_budget, document=document), 0.5 + 0.18 * len(document["budget"]),
            "Half-width that each source alone contributes. The contributions add up approximately in squares. The "
            "coverage interval includes the torque scale; the repeatability does not.", names_left=True,
        )
        yield ReportSection(UNCERTAINTY_BUDGET.capitalize(), (picture, _budget(document)))
    if document["friction_curve"]:
        picture = Picture("friction", partial(draw_friction, document=document), 1.8,
                          "Torque at steady speed, load included. Lags do not affect it.")
        yield ReportSection("Friction over speed", (picture, _friction(document)))
    harmonics, least = document.get("harmonics"), least_harmonics(document)
    if harmonics or least:
        limits = Text(f"{'' if harmonics else 'No order stands out. '}This motion shows {least}, in 95 of 100 runs.")
        yield ReportSection(
            TORQUE_OVER_ANGLE.capitalize(), (*_harmonics(harmonics or ()), *((limits,) if least else ())))
    yield ReportSection("Numbers", tuple(_numbers(document)))
    if document["lines"]:
        yield ReportSection("Excited frequencies", (_lines(document),))
    if document["stages"]:
        yield ReportSection("Stages", (_stages(document),))
    yield ReportSection("Basis of the result", (Pairs(tuple(_grounds(document, recording, sha256))),))


# -- data of the run ---------------------------------------------------------------------------------------------


def _run_rows(document: Part, recording: Recording) -> Iterator[tuple[str, str]]:
    rig, drive, profile = (document[name] or {} for name in ("rig", "drive", "profile"))
    yield "rig", rig.get("name") or rig.get("file") or "not named (name: in rig.yaml)"
    yield "date", shown_date(document["date"]) or "not recorded"
    yield "operator", document["operator"] or "not named (--operator)"
    if document["note"]:
        yield "note", document["note"]
    for one in document.get("edits") or ():
        yield "edited after the run", (f"{one['field'].replace('_', ' ')}, by {one['who']}, {shown_date(one['at'])}; "
                                       f"before: {one['old'] or 'not stated'}")
    if drive:
        yield "drive", drive["name"] or "reports no name"
        yield "identity", ", ".join(f"{name} {drive[name]:X}h" for name in ("vendor", "product", "revision"))
        yield "serial number", str(drive["serial"]) if drive["serial"] else "not reported by the drive"
    if profile:
        yield "profile", profile["name"] + (f" ({profile['title']})" if profile.get("title") else "")
    if document["connection"]:
        yield "connection", document["connection"]
    if limits := rig.get("limits"):
        yield "limits", _limits(limits)
    if rig.get("load"):
        yield "load", {"none": "none", "string": "drill string"}.get(rig["load"], rig["load"])
    yield from uploaded_rows(document.get("uploaded"))
    yield "gear, motor to main shaft", f"{document['gear_ratio']:g}"
    if recording.excitation is not None:
        yield "excitation", _excitation(recording)
    if len(recording.time_s):
        length = float(recording.time_s[-1] - recording.time_s[0])
        yield "recorded", f"{len(recording.time_s)} samples in {minutes(length)}"
    if ended := document["ended"]:
        yield "ended by", f"{ended['where']}: {ended['what']}" if ended["where"] else ended["what"]


def _limits(limits: Part) -> str:
    named = (
        ("speed {} to {} rad/s", ("speed_min_rad_s", "speed_max_rad_s")), ("torque {} N·m", ("torque_nm",)),
        ("time {} s", ("time_s",)), ("quick stop {} rad/s²", ("quick_stop_rad_s2",)),
        ("watchdog {} s", ("watchdog_s",)),
    )
    return "; ".join(text.format(*(f"{limits[key]:g}" for key in keys)) for text, keys in named
                     if all(key in limits for key in keys))


def _excitation(recording: Recording) -> str:
    found = recording.excitation
    assert found is not None
    text = f"{found.kind} in {found.mode} mode"
    if found.segments and found.segments[0].lines_hz:
        lines = found.segments[0].lines_hz
        about = " and ".join(f"{one.offset_rad_s:.3g}" for one in found.segments[:3])
        span = f"{len(lines)} lines, {min(lines):.3g} to {max(lines):.3g} Hz"
        text += f", {span if len(lines) > 1 else f'{lines[0]:.3g} Hz'}, about {about} rad/s"
    return text


# -- tables --------------------------------------------------------------------------------------------------

_QUANTITIES = (Column("quantity", 0.52), Column("value", 0.12, True), Column("from", 0.12, True),
               Column("to", 0.12, True), Column("unit", 0.12))


def _numbers(document: Part) -> Iterator[Block]:
    """Yield every estimate, beginning with the interval to quote."""
    rows: list[tuple[str, ...]] = []

    def add(title: str, part: Part | None, unit: str, kind: str = "") -> None:
        if part is not None:
            rows.append((title, *rounded(part["value"], part["low" + kind], part["high" + kind]), unit))

    inertia, shaft = document["inertia_kg_m2"], document["compliant"]
    side = "J_r, the motor's side" if shaft else "J"
    add(f"{side} at the motor shaft, torque scale included", inertia, "kg·m²", "_total")
    if document["gear_ratio"] != 1.0:
        add(f"{side} at the main shaft, torque scale included", document["inertia_main_shaft_kg_m2"], "kg·m²", "_total")
    add(f"{side}: repeatability, this drive", inertia, "kg·m²")
    for label in ESTIMATES:
        part = document[label.key]
        scaled = part is not None and "low_total" in part
        add(f"{label.name}, torque scale included" if scaled else label.name, part, label.unit,
            "_total" if scaled else "")
    for one in document.get("backlash") or ():
        if (play := one[BACKLASH.key]) is not None:
            add(BACKLASH.name, in_milliradians(play), BACKLASH.unit)
    if shaft is not None:
        for title, key, unit in COMPLIANT:
            scaled = shaft[key] is not None and "low_total" in shaft[key]
            add(f"{title}, torque scale included" if scaled else title, shaft[key], unit, "_total" if scaled else "")
    if rows:
        yield Table(_QUANTITIES, tuple(rows))
        yield Text("Intervals without the note 'torque scale included' take the torque scale as exact. Use them to "
                   "compare runs on this drive.")


def _response(found: Part) -> Iterator[Block]:
    """Yield the figure of the frequency response, and sentences on it."""
    from tdhil.report.frequency_response import draw_bode, response_sentences

    yield Picture(
        "response", partial(draw_bode, found=found), 3.4,
        "Speed over torque as the drive reports them, lags included, with intervals and the fitted model. Triangles: "
        "standard uncertainty by noise, and by nonlinear distortion. " + " ".join(response_sentences(found)))


def _impedance(found: Part) -> Iterator[Block]:
    """Yield the figure, the numbers of the loop and their conditions, or the refusal."""
    from tdhil.report.plots import draw_impedance

    if found["points"]:
        zeta = found["string_nm_s_rad"]
        caption = ("Impedance of the drive's speed loop at the shaft, measured without load: "
                   "Z = J s + B + H (P + I/s). Dots: impedance at each excited frequency.")
        if zeta:
            caption += (" Below: reflection |r| at a string of "
                        f"{zeta:.4g} N·m·s/rad (at the motor), with its interval. 1 reflects a wave completely.")
        yield Picture("impedance", partial(draw_impedance, found=found), 3.4 if zeta else 2.2, caption)
    rows = [
        (title, *rounded(part["value"], part["low"], part["high"]), unit)
        for title, key, unit in _LOOP if (part := found[key]) is not None
    ]
    if rows:
        yield Table(_QUANTITIES, tuple(rows))
    yield Text(f"{found['verdict']}: {sentence(found['reason'])} {sentence(found['advice'])}".strip())
    yield Text("Conditional on: " + "; ".join(found["conditions"]) + ".")


_LOOP = (
    ("gain P of the drive's speed loop", "gain_nm_s_rad", "N·m·s/rad"),
    ("integral gain I", "integral_nm_rad", "N·m/rad"),
    ("lags inside the loop, together", "inner_lag_s", "s"),
    ("lag of the torque inside the loop", "torque_lag_s", "s"),
    ("speed filter inside the loop", "speed_filter_s", "s"),
    ("inertia, from the impedance", "inertia_kg_m2", "kg·m²"),
    ("viscous friction, from the impedance", "viscous_nm_s_rad", "N·m·s/rad"),
    ("reference filter, not declared", "reference_filter_s", "s"),
)


def _opinions(document: Part) -> Iterator[Block]:
    words = {True: "agrees", False: "does not agree", None: "not compared: the run gives no J"}
    for one in document["second_opinions"]:
        yield Text(f"{MOMENTUM_CROSS_CHECK.capitalize()}, {one['route']}: "
                   f"{estimate_text(one['inertia_kg_m2'], 'kg·m²')}, {words[one['agrees']]}. {sentence(one['note'])}")


def _budget(document: Part) -> Table:
    inertia = document["inertia_kg_m2"]
    lines = sorted(document["budget"], key=lambda line: -(line["half_width_kg_m2"] or 0.0))
    rows = []
    for line in lines:
        figures = budget_figures(line["half_width_kg_m2"], None if inertia is None else inertia["value"])
        rows.append((line["source"], *figures, line["note"]))
    return Table((Column("source", 0.2), Column("± kg·m²", 0.11, True), Column("± %", 0.11, True), Column("", 0.58)),
                 tuple(rows))


def _friction(document: Part) -> Table:
    """Return the friction points, two a row."""
    cells = [(f"{p['speed_rad_s']:.2f}", plus_minus_part(p["torque_nm"]))
             for p in document["friction_curve"]]
    middle = (len(cells) + 1) // 2
    rows = [(*cells[k], *(cells[middle + k] if middle + k < len(cells) else ("", ""))) for k in range(middle)]
    head = (Column("speed, rad/s", 0.25, True), Column("torque, N·m", 0.25, True))
    return Table(head + head, tuple(rows))


def _harmonics(harmonics: Sequence[Part]) -> Iterator[Block]:
    """Yield the orders of the torque that depends on the angle, the largest first; nothing without any."""
    if not harmonics:
        return
    rows = [
        (f"{one['order']}", *rounded(*(one["amplitude_nm"][key] for key in ("value", "low", "high"))),
         *rounded(**in_degrees(one["phase_rad"])))
        for one in harmonics
    ]
    heads = (("order", 0.1), ("amplitude, N·m", 0.18), ("from", 0.14), ("to", 0.14), ("phase, °", 0.16), ("from", 0.14),
             ("to", 0.14))
    yield Table(tuple(Column(title, share, True) for title, share in heads), tuple(rows))
    yield Text("Torque a·cos(nθ + φ) against positive rotation, with order n and the angle θ of the motor shaft since "
               "the first reading. J and friction are without it. Cogging has the orders of slots and poles; an "
               "eccentric or unbalanced part has order 1.")


def _lines(document: Part) -> Table:
    rows = []
    for p in document["lines"]:
        seen, damping = p["apparent_inertia_kg_m2"], p["apparent_damping_nm_s_rad"]
        rows.append((
            f"{p['hertz']:.4g}", plus_minus_part(seen), _as(p["fitted_inertia_kg_m2"], _half(seen)),
            plus_minus_part(damping), _as(p["fitted_damping_nm_s_rad"], _half(damping)),
            f"{p['residual_sd']:.2f}",
        ))
    heads = (("frequency, Hz", 0.14), ("Im(T/ω)/2πf, kg·m²", 0.22), ("model", 0.12), ("Re(T/ω), N·m·s/rad", 0.22),
             ("model", 0.12), ("residual, sd", 0.18))
    return Table(tuple(Column(title, share, True) for title, share in heads), tuple(rows))


def _stages(document: Part) -> Table:
    rows = tuple((s["name"], s["outcome"], minutes(s["duration_s"]), s.get("detail", "")) for s in document["stages"])
    heads = (Column("stage", 0.14), Column("outcome", 0.14), Column("duration", 0.12, True), Column("", 0.6))
    return Table(heads, rows)


def _grounds(document: Part, recording: Recording, sha256: str) -> Iterator[tuple[str, str]]:
    yield "model", document["model"]
    if (inertia := document["inertia_kg_m2"]) is not None:
        yield "the repeatability is conditional on", "; ".join(inertia["conditional_on"])
        yield "coverage of every interval", f"{100.0 * inertia['confidence']:g} %"
    yield "standard uncertainty of the torque scale", f"{100.0 * recording.torque_scale_rel_sd:g} %"
    if document["reference_inertia_kg_m2"] is not None:
        yield "reference J (rig.yaml)", f"{document['reference_inertia_kg_m2']:g} kg·m²"
    if (paper := document["paper"]) is not None and paper["inertia_kg_m2"] is not None:
        r2 = "" if paper["r2"] is None else f", r² {paper['r2']:.3f}"
        raw = paper["raw_rate"]["inertia_kg_m2"]
        yield ACCELERATION_REGRESSION, (f"{paper['inertia_kg_m2']:.5g} kg·m²{r2}"
                                     + ("" if raw is None else f"; at the raw rate {raw:.4g} kg·m²"))
    if (test := document["residual"]) is not None and test["p_value"] is not None:
        yield "residual test", f"p = {test['p_value']:.2g}, {test['degrees_of_freedom']:.3g} degrees of freedom"
    yield "data used", f"{document['periods_used']} periods, {document['samples_used']} samples"
    yield "log complete", "yes" if document["complete"] else "no: the log ended before the run did"
    yield "log", document["log"]
    if sha256:
        yield "SHA-256 of the log", sha256
    if document["recorded_by"]:
        yield "recorded by", f"tdhil {document['recorded_by']}"
    yield "evaluated by", f"tdhil {document['tdhil']}"


def _half(part: Part) -> float:
    return 0.5 * (part["high"] - part["low"]) if part["high"] is not None and part["low"] is not None else math.inf


def _as(value: float, half: float) -> str:
    """Round ``value`` to the decimals of ``half``."""
    return plus_minus(value, half).split(" ")[0]
