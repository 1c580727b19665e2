"""A virtual string on a drive: what is meant, from the files that `tune` and `identify` wrote; what came of it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tdhil.errors import ExitCode, LogError, UsageError

if TYPE_CHECKING:
    from tdhil.recording import FloatArray, Recording
    from tdhil.soft_torque import DrillString, EvaluationCase, Interval

SAME_STRING = 1e-6
_CONFIDENCE = 0.95        # of the interval that is shown of a ratio of torques
_TUNE_AGAIN = "tdhil tune result.json --string string.yaml --json > tune.json"


def load_document(path: Path, wanted: str, keys: frozenset[str], next_step: str) -> Mapping[str, Any]:
    """A JSON document with these keys. UsageError where it is none."""
    if not path.is_file():
        raise UsageError("there is no such file", where=str(path), next_step=next_step)
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UsageError(f"is no JSON ({str(error)[:80]})", where=str(path), next_step=next_step) from None
    if not isinstance(document, dict) or not keys <= document.keys():
        raise UsageError(f"is JSON, but no {wanted}", where=str(path), next_step=next_step)
    return document


def load_tuning(path: Path) -> Mapping[str, Any]:
    """What `tdhil tune --json` wrote."""
    keys = frozenset({"main_shaft", "string", "controllers", "identified"})
    return load_document(path, "tuning of tdhil tune", keys, _TUNE_AGAIN)


def evaluation_case(
    string: DrillString, tuning: Mapping[str, Any], use: str, rig: Mapping[str, Any], where: str, *,
    own_loop: bool = False,
) -> EvaluationCase:
    """The machine that was tuned for, its controller of that kind, and the rig as a result document has it.

    ``where``: the tuning's file. UsageError where they don't go together, or lack what is needed.
    """
    from tdhil.soft_torque import EvaluationCase, IdentifiedRig, Prediction, SpeedController, TopDrive

    try:
        _same_string(string, tuning["string"], where)
        found = {one["kind"]: one for one in tuning["controllers"]}
        chosen = found.get(use)
        if chosen is None or chosen["refused"]:
            why = f"{use} was refused: {chosen['refused']}" if chosen else f"there is no {use} in it"
            held = ", ".join(kind for kind, one in found.items() if not one["refused"])
            raise UsageError(why, where=where, next_step=f"--use one of: {held}")
        if chosen["critical_rpm"] is None or chosen["critical_rpm"]["cure"]["value"] is None:
            raise UsageError(f"no critical speed of {use} is in it to compare with", where=where,
                             next_step="Tune without --no-simulation, with a bit in string.yaml")
        cure, main = chosen["critical_rpm"]["cure"], tuning["main_shaft"]
        meant = TopDrive(main["inertia_kg_m2"]["value"], main["viscous_nm_s_rad"], main["coulomb_nm"],
                         tuple(main["inner_lags_s"]))
        lag, inertia = rig["speed_lag_s"], rig["inertia_kg_m2"]
        if not isinstance(lag, Mapping) or not isinstance(inertia, Mapping) or lag["value"] is None:
            raise UsageError("the result behind it has no J, or no lag of the reported speed", where=where,
                             next_step="Identify with a multisine, and tune with what comes of it")
        low, high = lag.get("low"), lag.get("high")
        error_s = 0.5 * (high - low) if low is not None and high is not None else 0.0
        real = IdentifiedRig(inertia["value"], _value(rig["viscous_nm_s_rad"]), _value(rig["coulomb_nm"]),
                             max(0.0, lag["value"]), rig["gear_ratio"])
        prediction = Prediction(
            use, _interval(cure), _interval(chosen["least_damping"]), tuple(tuning["string"]["modes_hz"]))
        return EvaluationCase(string, meant, SpeedController(**chosen["at_main_shaft"]), real, prediction, error_s,
                              own_loop)
    except (KeyError, TypeError, AttributeError, IndexError) as error:
        raise UsageError(f"is no tuning as tdhil tune writes it ({type(error).__name__}: {error})", where=where,
                         next_step=_TUNE_AGAIN) from None


def _interval(part: Mapping[str, Any]) -> Interval:
    from tdhil.soft_torque import Interval

    value = float(part["value"])
    low, high = part["low"], part["high"]
    return Interval(value, value if low is None else float(low), value if high is None else float(high))


def _value(part: Any) -> float:
    value = part.get("value") if isinstance(part, Mapping) else None
    return max(0.0, float(value)) if value is not None else 0.0


def _same_string(string: DrillString, told: Mapping[str, Any], where: str) -> None:
    bit = string.bit
    pairs = [
        (string.impedance_nm_s_rad, told["impedance_nm_s_rad"]), (string.stiffness_nm_rad, told["stiffness_nm_rad"]),
        (string.echo_s, told["echo_s"]), (string.bottom_inertia_kg_m2, told["bottom_inertia_kg_m2"]),
    ]
    if bit is not None and told["bit"] is not None:
        pairs += [(bit.coulomb_nm, told["bit"]["coulomb_nm"]), (bit.static_nm, told["bit"]["static_nm"])]
    if (bit is None) is not (told["bit"] is None) or any(
        abs(one - other) > SAME_STRING * max(abs(one), abs(other)) for one, other in pairs
    ):
        raise UsageError("was tuned for another string than --virtual-string", where=where, next_step=_TUNE_AGAIN)


# ---------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class EvaluationConclusion:
    """What came of it, as it is printed and kept, and how a process ends with it."""

    document: dict[str, Any]
    exit_code: ExitCode


def is_evaluation(run: Mapping[str, Any]) -> bool:
    """Is this log's configuration that of a run with a virtual string?"""
    return isinstance(run.get("evaluation"), Mapping)


def conclude_evaluation(
    rows: FloatArray, recording: Recording, run: Mapping[str, Any], log: str
) -> EvaluationConclusion:
    """From what the log holds alone: the same live and replayed. LogError where that is not enough."""
    from tdhil.estimation import torque_contradiction, torque_ratios
    from tdhil.report import evaluation_document
    from tdhil.soft_torque import EvaluationOutcome, SpeedProgram, case_of, evaluate

    try:
        asked = run["evaluation"]
        case, program = case_of(asked["case"]), SpeedProgram(**asked["program"])
        signals = torque_contradiction(torque_ratios(recording, _CONFIDENCE), recording.torque_scale_rel_sd)
        found = evaluate(rows, case, program, "" if signals is None else f"{signals.reason}. Next: {signals.advice}")
    except (KeyError, TypeError, ValueError) as error:
        raise LogError(f"holds no evaluation that can be read ({error})", where=log,
                       next_step="The run has to be done again") from None
    stands = found.outcome in (EvaluationOutcome.AS_PREDICTED, EvaluationOutcome.DIFFERS)
    document = evaluation_document(found, case, recording, run, log)
    return EvaluationConclusion(document, ExitCode.OK if stands else ExitCode.NOT_IDENTIFIABLE)
