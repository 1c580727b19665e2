"""Result document of a Recording, made in the same way for a live run and for its replay."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from profiles import CodedText
from tdhil.config import ASKED_AGAIN
from tdhil.errors import ExitCode, MessageCode, UsageError
from tdhil.estimation import Identification, Options, Verdict
from tdhil.recording import FloatArray, Recording
from tdhil.session.rehearsal import code_with
from tdhil.session.run_warnings import run_warnings
from tdhil.session.stored_calibration import apply_calibration

if TYPE_CHECKING:
    from tdhil.session.evaluation import EvaluationConclusion
    from tdhil.session.verification import VerificationConclusion

TORQUE_SCALE = "torque scale"
"""Source in the uncertainty budget that a torque calibration reduces."""
_CALIBRATED = "the torque calibration is most of the interval: a larger body, or longer runs, would reduce it"


def working_confidence_of(run: Mapping[str, Any], confidence: float) -> float:
    """Return the confidence for the identification; ``confidence`` itself if stage 5 had a fixed length.

    The run's own working confidence is in its log. Another requested confidence follows from the same rule. A log that
    ends before the first interim analysis needs no correction.
    """
    stopping = run.get("stopping")
    if not isinstance(stopping, Mapping) or not stopping.get("decisions"):
        return confidence
    last = stopping["decisions"][-1]
    if stopping.get("confidence") == confidence:
        return float(last["working_confidence"])
    from tdhil.runner import interval_confidence

    return interval_confidence(confidence, float(stopping["pilot_dof"]), int(last["seen"]))


def after_looks(found: Identification, run: Mapping[str, Any], confidence: float) -> Identification:
    """Return the result with its coverage probability, and with advice on how to reach the tolerance."""
    stopping = run.get("stopping")
    if not isinstance(stopping, Mapping):
        return found
    if found.inertia is not None:
        found = replace(found, inertia=replace(found.inertia, confidence=confidence))
    if found.frequency_response is not None:
        found = replace(found, frequency_response=replace(found.frequency_response, confidence=confidence))
    if found.verdict is Verdict.VALID_WIDE and stopping.get("advice"):
        found = replace(found, advice=str(stopping["advice"]))
    return found


@dataclass(frozen=True)
class Conclusion:
    """The identification, its document, and the exit code of the process."""

    identification: Identification
    document: dict[str, Any]
    exit_code: ExitCode


def _options(run: Mapping[str, Any], log: str) -> Options:
    """Return what the run's configuration requests of identification. Raises UsageError if it can't be."""
    asked = run.get("identify", {})
    known = {one.name: one.default if asked.get(one.name) is None else asked[one.name] for one in ASKED_AGAIN}
    try:
        return Options(**known)
    except (TypeError, ValueError) as error:
        flags = " or ".join(one.flag for one in ASKED_AGAIN)
        raise UsageError(str(error), where=log, next_step=f"Give {flags} again") from error


def identified_so_far(run: Mapping[str, Any], recording: Recording, confidence: float) -> Identification:
    """Return the identification during a run, with its options and its calibration: as `conclude` identifies."""
    from tdhil.estimation import identify

    recording = apply_calibration(recording, run).recording
    return identify(recording, replace(_options(run, "the run"), confidence=confidence))


def conclude_run(
    recording: Recording, run: Mapping[str, Any], log: str, virtual_string: FloatArray | None = None,
    warnings: Sequence[str] | None = None,
) -> Conclusion | EvaluationConclusion | VerificationConclusion:
    """Identify, evaluate the virtual string or compare the steps, whichever the run did.

    ``virtual_string``: rows of its channel; the others as for `conclude`.
    """
    from tdhil.session.evaluation import conclude_evaluation, is_evaluation
    from tdhil.session.verification import conclude_verification, is_verification

    if is_evaluation(run):
        assert virtual_string is not None
        return conclude_evaluation(virtual_string, recording, run, log)
    if is_verification(run):
        return conclude_verification(recording, run, log)
    return conclude(recording, run, log, warnings)


def conclude(
    recording: Recording, run: Mapping[str, Any], log: str, warnings: Sequence[str] | None = None
) -> Conclusion:
    """Return the identification, its document, and its exit code. ``run`` is the log's configuration.

    ``warnings``: assumptions in reading a foreign trace; None for a tdhil log.
    """
    from tdhil.estimation import identify
    from tdhil.report import result_document

    options = _options(run, log)
    working = working_confidence_of(run, options.confidence)
    applied = apply_calibration(recording, run)
    recording = applied.recording
    identification = after_looks(identify(recording, replace(options, confidence=working)), run, options.confidence)
    identification = _dated(identification, applied.day)
    said = (
        *(CodedText(one, MessageCode.TRACE_ASSUMPTION) for one in warnings or ()),
        *applied.warnings,
        *(one for one in run_warnings(run) if not _repeated(one, identification.warnings)),
    )
    if said:
        identification = replace(identification, warnings=(*said, *identification.warnings))
    # for a run that measured the drive's own impedance, this result decides
    measured = identification.impedance
    stands = (identification if measured is None else measured).verdict in (Verdict.VALID, Verdict.VALID_WIDE)
    document = result_document(identification, recording, run, log, calibrated=bool(applied.day))
    code = code_with(document["rehearsal"], _accepted(document["acceptance"], stands=stands))
    return Conclusion(identification, document, ExitCode(code))


def _repeated(warning: str, later: Sequence[str]) -> bool:
    """Return whether the identification has this warning, too: speed and angle are compared in each stage."""
    entries = [one.entry for one in later if isinstance(one, CodedText)]
    unlike = MessageCode.SPEED_UNLIKE_ANGLE
    return isinstance(warning, CodedText) and warning.entry is unlike and unlike in entries


def _accepted(acceptance: Mapping[str, Any] | None, *, stands: bool) -> ExitCode:
    """Return the exit code: not passed, if the result contradicts the expectation; otherwise by whether the result is
    valid.
    """
    from tdhil.report import AcceptanceVerdict

    verdict = None if acceptance is None else acceptance["verdict"]
    if verdict == AcceptanceVerdict.FAIL:
        return ExitCode.NOT_PASSED
    return ExitCode.OK if stands and verdict != AcceptanceVerdict.CANNOT_TELL else ExitCode.NOT_IDENTIFIABLE


def _dated(found: Identification, day: str) -> Identification:
    """Return the result with the day of the torque calibration in the budget's line."""
    if not day:
        return found
    advice = _CALIBRATED if found.calibration_advised else found.advice
    return replace(found, advice=advice, calibration_advised=False, budget=tuple(
        replace(line, source=f"{TORQUE_SCALE}, calibrated {day}") if line.source == TORQUE_SCALE else line
        for line in found.budget))
