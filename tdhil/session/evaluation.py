"""Virtual string on a drive: the case from the files of `tune` and `identify`, and its evaluation."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tdhil.errors import ExitCode, LogError, MessageCode, UsageError
from tdhil.session.rehearsal import code_with
from tdhil.session.run_warnings import run_warnings

if TYPE_CHECKING:
    from tdhil.recording import FloatArray, Recording
    from tdhil.soft_torque import DrillString, EvaluationCase, Interval

SAME_STRING = 1e-6
_CONFIDENCE = 0.95        # confidence of the interval of the torque ratio
_TUNE_AGAIN = "Write one with: tdhil tune soft-torque result.json --string string.yaml --json > tune.json"


def load_document(path: Path, wanted: str, keys: frozenset[str], next_step: str) -> Mapping[str, Any]:
    """Return a JSON document with these keys. Raises UsageError if the file has none."""
    if not path.is_file():
        raise UsageError("this file does not exist", where=str(path), next_step=next_step,
                         entry=MessageCode.FILE_NOT_FOUND)
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        why = "" if isinstance(error, UnicodeDecodeError) else f" ({str(error)[:80]})"
        raise UsageError(f"is not JSON{why}", where=str(path), next_step=next_step,
                         entry=MessageCode.NOT_A_TUNING) from None
    if not isinstance(document, dict) or not keys <= document.keys():
        raise UsageError(f"is JSON, but not a {wanted}", where=str(path), next_step=next_step,
                         entry=MessageCode.NOT_A_TUNING)
    return document


def load_tuning(path: Path) -> Mapping[str, Any]:
    """Return the document that `tdhil tune --json` wrote."""
    keys = frozenset({"main_shaft", "string", "controllers", "identified"})
    return load_document(path, "tuning of tdhil tune", keys, _TUNE_AGAIN)


def evaluation_case(
    string: DrillString, tuning: Mapping[str, Any], use: str, rig: Mapping[str, Any], where: str, *,
    own_loop: bool = False, torque_factor: float = 1.0,
) -> EvaluationCase:
    """Return the tuned machine, its controller of kind ``use``, and the rig from the result document.

    ``where``: the tuning's file. ``rig``: in the drive's own N·m; ``torque_factor``: as in `IdentifiedRig`. Raises
    UsageError if the files do not belong together or lack a needed value.
    """
    from tdhil.soft_torque import EvaluationCase, IdentifiedRig, Prediction, SpeedController, TopDrive

    try:
        _same_string(string, tuning["string"], where)
        found = {one["kind"]: one for one in tuning["controllers"]}
        chosen = found.get(use)
        if chosen is None or chosen["refused"]:
            why = f"{use} was refused: {chosen['refused']}" if chosen else f"it contains no {use}"
            held = ", ".join(kind for kind, one in found.items() if not one["refused"])
            raise UsageError(why, where=where, next_step=f"--use one of: {held}")
        if chosen["critical_rpm"] is None or chosen["critical_rpm"]["cure"]["value"] is None:
            raise UsageError(f"it contains no critical speed of {use} to compare with", where=where,
                             next_step="Tune without --no-simulation, with a bit in string.yaml",
                             entry=MessageCode.NOT_A_TUNING)
        cure, main = chosen["critical_rpm"]["cure"], tuning["main_shaft"]
        meant = TopDrive(main["inertia_kg_m2"]["value"], main["viscous_nm_s_rad"], main["coulomb_nm"],
                         tuple(main["inner_lags_s"]))
        lag, inertia = rig["speed_lag_s"], rig["inertia_kg_m2"]
        if not isinstance(lag, Mapping) or not isinstance(inertia, Mapping) or lag["value"] is None:
            raise UsageError("the result that it was tuned from has no J, or no lag of the reported speed", where=where,
                             next_step="Identify with a multisine, then tune with that result",
                             entry=MessageCode.NOT_A_TUNING)
        low, high = lag.get("low"), lag.get("high")
        error_s = 0.5 * (high - low) if low is not None and high is not None else 0.0
        real = IdentifiedRig(inertia["value"], _value(rig["viscous_nm_s_rad"]), _value(rig["coulomb_nm"]),
                             max(0.0, lag["value"]), rig["gear_ratio"], torque_factor)
        prediction = Prediction(
            use, _interval(cure), _interval(chosen["least_damping"]), tuple(tuning["string"]["modes_hz"]),
            cure["high"] is None)
        return EvaluationCase(string, meant, SpeedController(**chosen["at_main_shaft"]), real, prediction, error_s,
                              own_loop)
    except (KeyError, TypeError, AttributeError, IndexError) as error:
        raise UsageError(f"is not a tuning that tdhil tune wrote ({type(error).__name__}: {error})", where=where,
                         next_step=_TUNE_AGAIN, entry=MessageCode.NOT_A_TUNING) from None


def _interval(part: Mapping[str, Any]) -> Interval:
    from tdhil.soft_torque import Interval

    value = float(part["value"])
    low, high = part["low"], part["high"]
    return Interval(value, value if low is None else float(low), value if high is None else float(high))


def _value(part: Any) -> float:
    value = part.get("value") if isinstance(part, Mapping) else None
    return max(0.0, float(value)) if value is not None else 0.0


def _same_string(string: DrillString, stated: Mapping[str, Any], where: str) -> None:
    bit = string.bit
    pairs = [
        (string.impedance_nm_s_rad, stated["impedance_nm_s_rad"]),
        (string.stiffness_nm_rad, stated["stiffness_nm_rad"]),
        (string.echo_s, stated["echo_s"]), (string.bottom_inertia_kg_m2, stated["bottom_inertia_kg_m2"]),
    ]
    if bit is not None and stated["bit"] is not None:
        pairs += [(bit.coulomb_nm, stated["bit"]["coulomb_nm"]), (bit.static_nm, stated["bit"]["static_nm"])]
    if (bit is None) is not (stated["bit"] is None) or any(
        abs(one - other) > SAME_STRING * max(abs(one), abs(other)) for one, other in pairs
    ):
        raise UsageError("was tuned for a different string than --virtual-string", where=where, next_step=_TUNE_AGAIN,
                         entry=MessageCode.NOT_A_TUNING)


# ---------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class EvaluationConclusion:
    """The evaluation as a document, and the exit code of the process."""

    document: dict[str, Any]
    exit_code: ExitCode


def is_evaluation(run: Mapping[str, Any]) -> bool:
    """Return whether this configuration belongs to a run with a virtual string."""
    return isinstance(run.get("evaluation"), Mapping)


def conclude_evaluation(
    rows: FloatArray, recording: Recording, run: Mapping[str, Any], log: str
) -> EvaluationConclusion:
    """Evaluate from the log alone, the same live and in replay. Raises LogError if the log lacks data.

    Of an aborted run only the time before the abort counts.
    """
    from tdhil.estimation import torque_contradiction, torque_ratios
    from tdhil.recording import before_abort, counts_until_s
    from tdhil.report import evaluation_document
    from tdhil.soft_torque import COLUMNS, EvaluationOutcome, SpeedProgram, case_of, evaluate

    try:
        asked = run["evaluation"]
        case, program = case_of(asked["case"]), SpeedProgram(**asked["program"])
        counts = before_abort(recording)
        rows = rows[rows[:, COLUMNS.index("time_s")] < counts_until_s(recording)]
        signals = torque_contradiction(torque_ratios(counts, _CONFIDENCE), counts.torque_scale_rel_sd)
        found = evaluate(rows, case, program, "" if signals is None else f"{signals.reason}. Next: {signals.advice}")
    except (KeyError, TypeError, ValueError) as error:
        raise LogError(f"contains no readable evaluation ({error})", where=log,
                       next_step="Repeat the run") from None
    stands = found.outcome in (EvaluationOutcome.AS_PREDICTED, EvaluationOutcome.DIFFERS)
    document = evaluation_document(found, case, recording, run, log, run_warnings(run))
    code = code_with(document["rehearsal"], ExitCode.OK if stands else ExitCode.NOT_IDENTIFIABLE)
    return EvaluationConclusion(document, ExitCode(code))
