"""`tdhil tune verify`: the case from the document of `tune speed`, and the comparison from the log alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tdhil.errors import ExitCode, LogError, MessageCode, UsageError
from tdhil.session.evaluation import load_document
from tdhil.session.rehearsal import code_with
from tdhil.session.run_warnings import run_warnings

if TYPE_CHECKING:
    from tdhil.recording import Recording
    from tdhil.speed_loop import StepCase

VERIFICATION = "verification"
"""Key of the run's configuration, and kind of the document."""
_TUNE_AGAIN = "Write one with: tdhil tune speed result.json --json > tune.json"
_KEYS = frozenset({"plant", "controllers", "reported_speed_lag_s"})


def load_step_case(path: Path, use: str) -> StepCase:
    """Return the prediction for the gains ``use`` (tuned or present) in the document of `tdhil tune speed --json`.

    Raises UsageError if the file is none, or lacks what a comparison needs.
    """
    from tdhil.speed_loop import step_case_of

    tuning = load_document(path, "tuning of tdhil tune speed", _KEYS, _TUNE_AGAIN)
    try:
        chosen = next((one for one in tuning["controllers"] if one["kind"] == use), None)
        if chosen is None:
            raise UsageError(f"it contains no {use} gains", where=str(path),
                             next_step="Give tdhil tune speed --present P I", entry=MessageCode.NOT_A_TUNING)
        if tuning["reported_speed_lag_s"] is None:
            raise UsageError("the result that it was tuned from has no lag of the reported speed", where=str(path),
                             next_step="Identify with a multisine, then tune with that result",
                             entry=MessageCode.NOT_A_TUNING)
        if any(chosen[name]["high"] is None for name in ("overshoot_share", "rise_s", "settling_s")):
            raise UsageError(f"the loop with the {use} gains is unstable in the worst case", where=str(path),
                             next_step="Type in stable gains first", entry=MessageCode.NOT_A_TUNING)
        return step_case_of({
            "kind": use, "plant": tuning["plant"], "gains": chosen,
            **{name: chosen[name] for name in ("overshoot_share", "rise_s", "settling_s")},
            "reported_lag_s": tuning["reported_speed_lag_s"], "source": str(path),
            "coulomb_nm": tuning["plant"].get("coulomb_nm"),
        })
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise UsageError(f"is not a tuning that tdhil tune speed wrote ({type(error).__name__}: {error})",
                         where=str(path), next_step=_TUNE_AGAIN, entry=MessageCode.NOT_A_TUNING) from None


@dataclass(frozen=True)
class VerificationConclusion:
    """The comparison as a document, and the exit code of the process."""

    document: dict[str, Any]
    exit_code: ExitCode


def is_verification(run: Mapping[str, Any]) -> bool:
    """Return whether this configuration belongs to a run that verifies the speed loop."""
    return isinstance(run.get(VERIFICATION), Mapping)


def conclude_verification(recording: Recording, run: Mapping[str, Any], log: str) -> VerificationConclusion:
    """Compare from the log alone, the same live and in replay. Raises LogError if the log lacks data.

    The steps of an aborted run end before the abort: its stop would be taken for the response of a step.
    """
    from tdhil.recording import before_abort
    from tdhil.report import verification_document
    from tdhil.runner import step_record
    from tdhil.speed_loop import StepOutcome, StepProgram, step_case_of, verify_record

    try:
        said = run[VERIFICATION]
        case, program = step_case_of(said["case"]), StepProgram(**said["program"])
        starts = [float(one) for one in said["starts_s"]]
        period_s = float(run["cycle"]["period_s"])
        filter_s = float(said["reference_filter_s"])
    except (KeyError, TypeError, ValueError) as error:
        raise LogError(f"contains no readable steps of the set speed ({error})", where=log,
                       next_step="Repeat the run") from None
    found = verify_record(case, program, step_record(before_abort(recording), starts, period_s, filter_s))
    document = verification_document(found, case, program, recording, run, log, run_warnings(run))
    codes = {StepOutcome.AGREES: ExitCode.OK, StepOutcome.DIFFERS: ExitCode.NOT_PASSED,
             StepOutcome.CANNOT_TELL: ExitCode.NOT_IDENTIFIABLE}
    return VerificationConclusion(document, ExitCode(code_with(document["rehearsal"], codes[found.outcome])))
