"""`tdhil tune verify`'s findings: as a document for machines, on a terminal, as a picture and as a page."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich import box
from rich.table import Table as Grid
from rich.text import Text as Words

from tdhil.recording import Recording, aborted_stage
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
from tdhil.report.document import coded_warnings, marks, only_finite, rehearsal_rows, run_facts
from tdhil.report.html import log_hash, write_blocks
from tdhil.report.intervals import table_cell
from tdhil.report.letterhead import NO_LETTERHEAD, Letterhead
from tdhil.report.plots import DARK, OURS, QUIET

if TYPE_CHECKING:
    from matplotlib.figure import FigureBase

    from tdhil.speed_loop import StepCase, StepProgram, StepVerification

Part = Mapping[str, Any]

_STYLES = {"agrees": "bold green", "differs": "bold yellow"}
_COLOURS = {"agrees": "green", "differs": "yellow"}
_VERDICTS = {
    "agrees": "agrees: the drive steps as tuned",
    "differs": "differs: the drive does not step as tuned",
    "cannot_tell": "cannot tell: the steps do not decide it",
}
_NEXT = {
    "agrees": "",
    "differs": "Compare the gains in the drive with the typed values, and their units with the drive's manual. Check "
               "that no ramp and no filter of the set speed acts.",
    "cannot_tell": "Raise limits.torque_nm or limits.time_s within the machine's limits, or tune with narrower "
                   "intervals.",
}
_AFTER_ABORT = "Remove the cause of the abort, and repeat the run."
_NAMES = {
    "overshoot_share": ("overshoot, %", 100.0), "rise_s": ("rise 10–90 %, s", 1.0), "settling_s": ("settling, s", 1.0),
    "gain_nm_s_rad": ("P, N·m·s/rad", 1.0), "integral_nm_rad": ("I, N·m/rad", 1.0),
}


def verification_document(
    found: StepVerification, case: StepCase, program: StepProgram, recording: Recording, run: Part, log: str,
    warnings: Sequence[str] = (),
) -> dict[str, Any]:
    """Plain data for `json.dumps`, at the motor shaft; null in place of an infinite value."""
    from tdhil.speed_loop import StepOutcome

    ended_early = aborted_stage(recording) is not None and found.outcome is StepOutcome.CANNOT_TELL
    document = {
        "kind": "verification",
        "verdict": found.outcome.value,
        "reason": found.reason,
        "next_step": _AFTER_ABORT if ended_early else _NEXT[found.outcome.value],
        "confidence": found.confidence,
        "rows": [{"name": row.name, "measured": asdict(row.measured), "predicted": asdict(row.predicted),
                  "within": row.within if found.explained else None} for row in found.rows],
        "tuned_for": {"kind": case.kind, "source": case.source},
        "steps": asdict(program) | {"step_rad_s": program.step_rad_s, "counted_pairs": found.pairs},
        "misfit": {"rms_share": found.misfit_rms, "p": found.misfit_p},
        "response": {name: getattr(found, name).tolist() for name in ("time_s", "reported", "fitted", "predicted")},
        **run_facts(recording, run, log, warnings),
    }
    cleaned = only_finite(document)
    assert isinstance(cleaned, dict)
    return cleaned


def print_verification(document: Part, console: PlainConsole) -> None:
    """Print measured beside predicted. 80 columns do."""
    simulated = f" · {marks(document)}" if document["simulated"] else ""
    console.print(Words(f"speed loop of the drive, verified by steps{simulated}", style="bold"))
    verdict = document["verdict"]
    head = ("verdict", Words(verdict.replace("_", " "), style=_STYLES.get(verdict, "bold red")))
    warned = (("warning", Words(one, style="yellow")) for one in coded_warnings(document))
    console.print(names_and_texts((head, *warned, *_rows(document))))
    if document["rows"]:
        console.print()
        grid = Grid(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))
        grid.add_column("motor shaft")
        grid.add_column("measured", justify="right")
        grid.add_column("predicted or typed", justify="right")
        grid.add_column("")
        for name, measured, predicted, said in _table(document):
            grid.add_row(name, measured, predicted, Words(said, style="bold red" if said == "differs" else ""))
        console.print(grid)
        percent = 100.0 * document["confidence"]
        console.print(Words(f"The measured intervals have a joint coverage of {percent:g} %.", style="dim"))


def _rows(document: Part) -> Iterator[tuple[str, str]]:
    yield "why", document["reason"]
    if document["next_step"]:
        yield "next", document["next_step"]
    yield from rehearsal_rows(document.get("rehearsal"))
    yield "gains", f"{document['tuned_for']['kind']}, of {document['tuned_for']['source']}"
    steps = document["steps"]
    yield "steps", (f"{steps['counted_pairs']} pairs: {steps['step_rad_s']:.3g} rad/s up from "
                    f"{steps['low_rad_s']:.3g} rad/s and down again, {steps['half_s']:.3g} s each")
    rms = document["misfit"]["rms_share"]
    if rms is not None:
        yield "misfit", f"{100.0 * rms:.2g} % of the step (rms), p {document['misfit']['p']:.2g}"
    yield "log", document["log"]


def _table(document: Part) -> Iterator[tuple[str, str, str, str]]:
    """Yield name, measured, predicted, and whether both meet; nothing if no gains explain the response."""
    for row in document["rows"]:
        name, times = _NAMES[row["name"]]
        yield (name, table_cell(row["measured"], times), table_cell(row["predicted"], times),
               "" if row["within"] is None else "agrees" if row["within"] else "differs")


# ---------------------------------------------------------------------------------------------------------------------
# As a page.


def write_verification_report(document: Part, path: Path, letterhead: Letterhead = NO_LETTERHEAD) -> Path:
    """Write the page, HTML or PDF by its name; return where it went. Raises UsageError if it can't be written."""
    return write_blocks(replace(verification_report(document, log_hash(document)), letterhead=letterhead), path)


def verification_report(document: Part, sha256: str = "") -> Report:
    """Return the blocks of the page."""
    verdict = document["verdict"]
    sections = []
    if document["rows"]:
        sections.append(ReportSection("Measured, and as predicted", (
            Table((Column("at the motor shaft", 0.28), Column("measured", 0.28, number=True),
                   Column("predicted or typed", 0.28, number=True), Column("", 0.16)), tuple(_table(document))),)))
    sections += [
        ReportSection("Step of the set speed, as reported", (
            Picture("verified_step", partial(draw_verification, document=document), 2.8,
                    "Mean of all steps."),)),
        ReportSection("Run", (Pairs((*_rows(document), ("stages", ", ".join(
            f"{one['name']} {one['outcome']} ({one['duration_s']:.0f} s)" for one in document["stages"])),
            *((("SHA-256", sha256),) if sha256 else ()))),)),
    ]
    facts = [(document["rig"] or {}).get("name"), shown_date(document["date"])]
    answer = AnswerBox(_COLOURS.get(verdict, "red"), verdict.replace("_", " ").capitalize(), (), _VERDICTS[verdict],
                       f"{document['reason']}.", document["next_step"])
    return report_of_run(document, "Speed loop of the drive, verified", facts, answer, sections, sha256)


def draw_verification(figure: FigureBase, document: Part) -> None:
    """Draw the mean response as reported, fitted and predicted."""
    of, axes = document["response"], figure.subplots()
    axes.plot(of["time_s"], of["reported"], ".", color=QUIET, ms=3, label="reported, mean of all steps")
    axes.plot(of["time_s"], of["fitted"], color=OURS, lw=1.4, label="fitted P and I")
    axes.plot(of["time_s"], of["predicted"], color=DARK, ls="--", lw=1.2, label="predicted, as reported")
    axes.axhline(1.0, color="0.3", lw=0.8)
    axes.set(xlabel="time, s", ylabel="speed / step of set speed")
    axes.grid(alpha=0.3)
    axes.margins(x=0.0)
    axes.legend(fontsize="small", loc="lower right")
