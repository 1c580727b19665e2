"""What came of a virtual string on a drive: as a document for machines, and on a terminal."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from rich.table import Table as Grid
from rich.text import Text as Words

from tdhil.recording import Recording
from tdhil.report.console import PlainConsole
from tdhil.report.document import SIMULATED, provenance
from tdhil.version import __version__

if TYPE_CHECKING:
    from tdhil.soft_torque import Evaluation, EvaluationCase

_STYLES = {"as_predicted": "bold green", "differs": "bold yellow"}


def evaluation_document(
    found: Evaluation, case: EvaluationCase, recording: Recording, run: Mapping[str, Any], log: str
) -> dict[str, Any]:
    """Plain data for `json.dumps`; speeds and torques at the main shaft of the machine that is meant."""
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
        "predicted_critical_rpm": asdict(prediction.cure_rpm),
        "least_damping": None if found.damping is None else {"value": found.damping, "hertz": found.damped_hz},
        "predicted_least_damping": asdict(prediction.least_damping),
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
        "gear_ratio": recording.gear_ratio,
        "simulated": recording.simulated,
        "complete": recording.complete,
        **provenance(run),
        "log": log,
        "cycle": run.get("cycle"),
        "stages": [
            {"name": stage.name, "outcome": stage.outcome, "duration_s": stage.end_s - stage.start_s}
            for stage in recording.stages
        ],
        "tdhil": __version__,
    }


def print_evaluation(document: Mapping[str, Any], console: PlainConsole) -> None:
    """Measured beside predicted. 80 columns do."""
    simulated = f" · {SIMULATED}" if document["simulated"] else ""
    name = document["string"] or "a virtual string"
    where = "in the drive's own loop, " if document["controller"]["own_loop"] else ""
    console.print(Words(f"{document['controller']['kind']} controller, {where}on {name}{simulated}", style="bold"))
    grid = Grid.grid(padding=(0, 2))
    grid.add_column(no_wrap=True, style="dim")
    grid.add_column(overflow="fold")
    verdict = document["verdict"]
    grid.add_row("verdict", Words(verdict.replace("_", " "), style=_STYLES.get(verdict, "bold red")))
    for label, text in _rows(document):
        grid.add_row(label, text)
    console.print(grid)


def _rows(document: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    yield "why", document["reason"]
    critical, predicted = document["critical_rpm"], document["predicted_critical_rpm"]
    told = f"tune: {predicted['value']:.0f} ({predicted['low']:.0f} to {predicted['high']:.0f})"
    yield "critical speed", (
        f"not found; {told}" if critical is None
        else f"{critical['value']:.1f} rpm, above {critical['low']:.1f}; {told}")
    damping, expected = document["least_damping"], document["predicted_least_damping"]
    told = f"tune: {expected['value']:.3f} ({expected['low']:.3f} to {expected['high']:.3f})"
    yield "least damping", (
        f"not seen; {told}" if damping is None else f"{damping['value']:.3f} at {damping['hertz']:.3f} Hz; {told}")
    rms = document["torque_rms_nm"]
    yield "torque at the top, rms", ", ".join(
        f"{value:.0f} N·m {what}" for what, value in rms.items() if value is not None) or "not seen"
    if document["trials"]:
        yield "trials, rpm", ", ".join(
            f"{one['set_rpm']:.1f} {'turns' if one['turns'] else 'sticks'}" for one in document["trials"])
    loop = document["loop"]
    yield "unknown torque", f"{loop['unknown_rms_nm']:.0f} N·m rms; {loop['put_in_j']:.0f} J by the loop's errors"
    if document["bit"]:
        yield "bit", f"{document['bit']}: all of this holds for it alone"
    yield "log", document["log"]
