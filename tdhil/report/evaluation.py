"""Result of a virtual string on a drive: as a JSON document, on a terminal, and as a page with figures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.text import Text as Words

from tdhil.recording import FloatArray, Recording
from tdhil.report.blocks import (
    AnswerBox,
    Column,
    Pairs,
    Picture,
    Report,
    ReportSection,
    Table,
    report_of_run,
    shown_date,
)
from tdhil.report.console import PlainConsole, names_and_texts
from tdhil.report.document import coded_warnings, marks, rehearsal_rows, run_facts
from tdhil.report.figure_words import meanings_section, print_meanings
from tdhil.report.html import log_hash, write_blocks
from tdhil.report.letterhead import NO_LETTERHEAD, Letterhead
from tdhil.report.plots import DARK, OURS, QUIET, envelope
from tdhil.soft_torque import COLUMNS, RPM, Phase

if TYPE_CHECKING:
    from matplotlib.figure import FigureBase

    from tdhil.soft_torque import Evaluation, EvaluationCase

Part = Mapping[str, Any]

_STYLES = {"as_predicted": "bold green", "differs": "bold yellow"}
_CRITICAL_ONLY = "critical speed as predicted; the damping is not compared"


def evaluation_document(
    found: Evaluation, case: EvaluationCase, recording: Recording, run: Mapping[str, Any], log: str,
    warnings: Sequence[str] = (),
) -> dict[str, Any]:
    """Return plain data for `json.dumps`; speeds and torques at the main shaft of the represented machine."""
    prediction, bit = case.prediction, case.string.bit
    return {
        "kind": "evaluation",
        "verdict": found.outcome.value,
        "reason": found.why,
        "controller": {
            "kind": prediction.kind, "own_loop": case.own_loop, "at_main_shaft": asdict(case.law),
            "inner_lags_s": list(case.meant.inner_lags_s),
        },
        "critical_rpm": None if found.critical_rpm is None else asdict(found.critical_rpm),
        "predicted_critical_rpm": asdict(prediction.cure_rpm) | ({"high": None} if prediction.cure_open else {}),
        "least_damping": None if found.damping is None else {
            "value": found.damping, "hertz": found.damped_hz,
            "low": None if found.damping_interval is None else found.damping_interval.low,
            "high": None if found.damping_interval is None else found.damping_interval.high,
        },
        "predicted_least_damping": asdict(prediction.least_damping),
        "damping_compared": found.damping_compared,
        "ramp_rpm": found.ramp_rpm,
        "trials": [asdict(one) for one in found.trials],
        "torque_rms_nm": {"sticking": found.sticking_rms_nm, "turning": found.turning_rms_nm},
        "loop": {
            "clamped_cycles": found.clamped_cycles, "innovation_rms_rad_s": found.innovation_rms_rad_s,
            "unknown_rms_nm": found.unknown_rms_nm, "put_in_j": found.put_in_j, "scale": case.scale,
        },
        "meant_inertia_kg_m2": case.meant.inertia_kg_m2,
        "rig_at_motor": asdict(case.rig),
        "string": case.string.name,
        "bit": None if bit is None else
        f"{bit.describe()}, viscous {case.string.bottom_viscous_nm_s_rad:g} N·m·s/rad",
        **run_facts(recording, run, log, warnings),
    }


def print_evaluation(document: Mapping[str, Any], console: PlainConsole) -> None:
    """Print measured beside predicted values, in 80 columns."""
    simulated = f" · {marks(document)}" if document["simulated"] else ""
    name = document["string"] or "a virtual string"
    where = "in the drive's own loop, " if document["controller"]["own_loop"] else ""
    console.print(Words(f"{document['controller']['kind']} controller, {where}on {name}{simulated}", style="bold"))
    verdict = document["verdict"]
    head = ("verdict", Words(_CRITICAL_ONLY, style="bold yellow") if _critical_only(document) else
            Words(verdict.replace("_", " "), style=_STYLES.get(verdict, "bold red")))
    rows = tuple(_rows(document))
    warned = (("warning", Words(one, style="yellow")) for one in coded_warnings(document))
    console.print(names_and_texts((head, *warned, *rows)))
    console.print()
    names = ("tune", "in brackets", document["controller"]["kind"], head[0], *(name for name, _ in rows))
    print_meanings(names, console)


def _critical_only(document: Part) -> bool:
    """Return whether only the critical speed is as predicted. An old document does not state it."""
    return document["verdict"] == "as_predicted" and not document.get("damping_compared", True)


def _damping(part: Part) -> str:
    """Return the damping with its 95 % interval; an old document has none."""
    if part.get("low") is None or part.get("high") is None:
        return f"{part['value']:.3f}"
    return f"{part['value']:.3f} ({part['low']:.3f} to {part['high']:.3f})"


def _rows(document: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    yield "why", document["reason"]
    yield from rehearsal_rows(document.get("rehearsal"))
    critical, predicted = document["critical_rpm"], document["predicted_critical_rpm"]
    expected_text = f"tune: {_predicted(predicted)}"
    yield "critical speed", (
        f"not found; {expected_text} rpm" if critical is None
        else f"{critical['value']:.1f} rpm, sticks at {critical['low']:.1f}; {expected_text} rpm")
    damping, expected = document["least_damping"], document["predicted_least_damping"]
    expected_text = f"tune: {expected['value']:.3f} ({expected['low']:.3f} to {expected['high']:.3f})"
    yield "least damping", (
        f"not found in the decay; {expected_text}" if damping is None
        else f"{_damping(damping)} at {damping['hertz']:.3f} Hz; {expected_text}")
    rms = document["torque_rms_nm"]
    yield "torque at the top, rms", ", ".join(
        f"{value:.0f} N·m {what}" for what, value in rms.items() if value is not None) or "not measured"
    if document["trials"]:
        yield "trials, rpm", ", ".join(
            f"{one['set_rpm']:.1f} {'turns' if one['turns'] else 'sticks'}" for one in document["trials"])
    loop = document["loop"]
    yield "unknown torque", f"{loop['unknown_rms_nm']:.0f} N·m rms; {loop['put_in_j']:.0f} J by the loop's own errors"
    if document["bit"]:
        yield "bit", f"{document['bit']}: the results are valid for this bit only"
    yield "log", document["log"]


# ---------------------------------------------------------------------------------------------------------------------
# Page of the evaluation.

_COLOURS = {"as_predicted": "green", "differs": "yellow"}
_VERDICTS = {
    "as_predicted": "as predicted: drive and string behave as computed by tune",
    "differs": "differs from the prediction of tune",
    "not_found": "not found: the run shows no critical speed",
    "invalid": "invalid: the shaft did not move like the string",
}
_CLOSE_S = 60.0
_CLOSE = (
    (Phase.HOLD, 5.0, "At the first set speed the bit must stick and slip."),
    (Phase.RELEASED, 35.0, "The bit turns and is lifted off bottom. The oscillation decays."),
)
"""Phases shown in detail, for `_CLOSE_S`, from so many seconds before."""


def write_evaluation_report(
    document: Part, rows: FloatArray, path: Path, letterhead: Letterhead = NO_LETTERHEAD
) -> Path:
    """Write the page, HTML or PDF by its name, and return its path. ``rows``: of `COLUMNS`, one per cycle of the log.

    Raises UsageError if it cannot be written.
    """
    return write_blocks(replace(evaluation_report(document, rows, log_hash(document)), letterhead=letterhead), path)


def evaluation_report(document: Part, rows: FloatArray, sha256: str = "") -> Report:
    """Return the blocks of the page."""
    facts = [document["string"] or "a virtual string", shown_date(document["date"])]
    sections = [ReportSection("Measured and predicted by tune", (
        Table((Column("", 0.34), Column("measured", 0.33, number=True), Column("by tune", 0.33, number=True)),
              tuple(_beside(document))),
    ))]
    if len(rows):
        shown = (
            Picture("string_close", partial(draw_close, rows=rows, phase=Phase(phase), before_s=before_s), 1.9, caption)
            for phase, before_s, caption in _CLOSE if np.any(rows[:, COLUMNS.index("phase")] == phase)
        )
        sections.append(ReportSection("Bit and top drive", (
            *shown,
            Picture("string_course", partial(draw_course, rows=rows), 3.4,
                    "The whole stage: the ramp of the set speed, then trials at steady set speeds, each from a bit "
                    "that is about to break away. Below: torque of drive and string at the main shaft."),
        )))
    if document["trials"]:
        sections.append(ReportSection("Trials", (
            Table((Column("set speed, rpm", 0.3, number=True), Column("the bit finally", 0.7)),
                  tuple((f"{one['set_rpm']:.1f}", "turns" if one["turns"] else "sticks")
                        for one in sorted(document["trials"], key=lambda one: float(one["set_rpm"])))),
        )))
    sections += [
        ReportSection("Basis of the result", (Pairs(tuple(_rests_on(document))),)),
        ReportSection("Run", (Pairs(tuple(_run(document, sha256))),)),
        meanings_section(("measured", "tune", "in brackets", document["controller"]["kind"],
                          *(one[0] for one in (*_beside(document), *_rests_on(document))))),
    ]
    return report_of_run(
        document, "Speed controller on a virtual drill string", facts, _answer(document), sections, sha256)


def _answer(document: Part) -> AnswerBox:
    verdict, critical, law = document["verdict"], document["critical_rpm"], document["controller"]
    value = "No critical speed" if critical is None else f"The bit comes free from {critical['value']:.1f} rpm"
    gains = law["at_main_shaft"]
    line = (f"{law['kind']} controller, in {'the drive' if law['own_loop'] else 'the host'}: P = "
            f"{gains['gain_nm_s_rad']:.4g} N·m·s/rad, I = {gains['integral_nm_rad']:.4g} N·m/rad at the main shaft")
    colour, words = _COLOURS.get(verdict, "red"), _VERDICTS[verdict]
    if _critical_only(document):
        colour, words = "yellow", _CRITICAL_ONLY
    return AnswerBox(colour, value, (line,), words, f"{document['reason']}.", "")


def _predicted(cure: Part) -> str:
    """Return the predicted critical speed with its interval, rpm; '?' for an end above all speeds that were tried."""
    end = "?" if cure["high"] is None else f"{cure['high']:.0f}"
    return f"{cure['value']:.0f} ({cure['low']:.0f} to {end})"


def _beside(document: Part) -> Iterator[tuple[str, str, str]]:
    """Yield (quantity, measured, predicted)."""
    critical, cure = document["critical_rpm"], document["predicted_critical_rpm"]
    yield ("critical speed, rpm",
           "not found" if critical is None else f"{critical['value']:.1f}, sticks at {critical['low']:.1f}",
           _predicted(cure))
    damping, expected = document["least_damping"], document["predicted_least_damping"]
    yield ("least damping of the lowest modes",
           "not found in the decay" if damping is None else f"{_damping(damping)} at {damping['hertz']:.3f} Hz",
           f"{expected['value']:.3f} ({expected['low']:.3f} to {expected['high']:.3f})")
    for what, value in document["torque_rms_nm"].items():
        yield f"torque at the top, rms, {what}, N·m", "not measured" if value is None else f"{value:.0f}", "–"
    ramp = document["ramp_rpm"]
    yield "last stick on the ramp, rpm", "none" if ramp is None else f"{ramp:.1f}", "–"


def _rests_on(document: Part) -> Iterator[tuple[str, str]]:
    loop, rig, law = document["loop"], document["rig_at_motor"], document["controller"]["at_main_shaft"]
    if document["bit"]:
        yield "bit", f"{document['bit']}: the results are valid for this bit only"
    yield "tuned for", f"{document['meant_inertia_kg_m2']:.4g} kg·m² at the main shaft"
    if law["compensated_kg_m2"]:
        yield "inertia compensated", f"{law['compensated_kg_m2']:.4g} kg·m²"
    yield "real machine", (
        f"{rig['inertia_kg_m2']:.4g} kg·m² at the motor, gear {rig['gear_ratio']:g}; lag of the reported speed "
        f"{rig['speed_lag_s']:.3g} s; torques scaled by {loop['scale']:.3g}")
    yield "torque limit", ("never acted" if not loop["clamped_cycles"] else
                           f"acted in {loop['clamped_cycles']} cycles: the string's torque was cut off")
    yield "torque without a command", f"{loop['unknown_rms_nm']:.0f} N·m rms"
    yield "energy by the loop's own errors", f"{loop['put_in_j']:.0f} J at most"
    yield "reported less observed speed", f"{loop['innovation_rms_rad_s']:.2g} rad/s rms"


def _run(document: Part, sha256: str) -> Iterator[tuple[str, str]]:
    cycle = document["cycle"] or {}
    if cycle.get("rate_hz"):
        yield "cycles a second", f"{cycle['rate_hz']:g}"
    for name in ("operator", "note", "connection"):
        if document.get(name):
            yield name, str(document[name])
    for key, name in (("profile", "name"), ("rig", "name"), ("drive", "name")):
        if (document.get(key) or {}).get(name):
            yield key, str(document[key][name])
    yield "stages", ", ".join(f"{one['name']} {one['outcome']} ({one['duration_s']:.0f} s)"
                              for one in document["stages"])
    yield "log", document["log"]
    if sha256:
        yield "SHA-256", sha256


def _columns(rows: FloatArray) -> dict[str, FloatArray]:
    return {name: rows[:, number] for number, name in enumerate(COLUMNS)}


def draw_close(figure: FigureBase, rows: FloatArray, phase: Phase, before_s: float) -> None:
    """Draw a minute around the beginning of a phase."""
    of = _columns(rows)
    time, axes = of["time_s"], figure.subplots()
    begin = max(time[0], time[of["phase"] == phase][0] - before_s)
    at = np.flatnonzero((time >= begin) & (time <= begin + _CLOSE_S))
    at = at[:: max(1, len(at) // 1200)]
    for name, (label, colour, style) in _SPEEDS.items():
        axes.plot(time[at] - time[0], of[name][at] / RPM, color=colour, ls=style, lw=1.0, label=label)
    axes.set(xlabel="time, s", ylabel="rpm")
    axes.grid(alpha=0.3)
    axes.margins(x=0.0)
    axes.legend(fontsize="small", loc="upper right", ncols=3)


_SPEEDS = {"bit_rad_s": ("bit", OURS, "-"), "top_rad_s": ("top drive", QUIET, "-"), "set_rad_s": ("set", DARK, "--")}


def draw_course(figure: FigureBase, rows: FloatArray) -> None:
    """Draw the whole run: every column spans all values of its time."""
    of = _columns(rows)
    time = of["time_s"] - of["time_s"][0]
    above, below = figure.subplots(2, 1, sharex=True)
    speeds, torques = (("bit_rad_s", OURS), ("top_rad_s", QUIET)), (("string_nm", OURS), ("drive_nm", QUIET))
    for axes, scale, signals in ((above, RPM, speeds), (below, 1e3, torques)):
        for name, colour in signals:
            at, low, high = envelope(time, of[name] / scale)
            axes.fill_between(at, low, high, color=colour, edgecolor=colour, lw=0.6, alpha=0.8,
                              label=_SPEEDS[name][0] if name in _SPEEDS else name.removesuffix("_nm"))
        axes.grid(alpha=0.3)
        axes.margins(x=0.0)
    at, low, _ = envelope(time, of["set_rad_s"] / RPM)
    above.plot(at, low, color=DARK, ls="--", lw=1.0, label="set")
    above.set_ylabel("rpm")
    below.set(xlabel="time, s", ylabel="torque, kN·m")
    for axes in (above, below):
        axes.legend(fontsize="small", loc="upper right", ncols=3)
