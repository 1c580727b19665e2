"""From a Recording to the result document: the same road for a live run and for its replay."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from tdhil.config import ASKED_AGAIN
from tdhil.errors import ExitCode, UsageError
from tdhil.estimation import Identification, Verdict
from tdhil.recording import Recording


def working_confidence_of(run: Mapping[str, Any], confidence: float) -> float:
    """The confidence to identify with; ``confidence`` itself where stage 5 had a fixed length.

    The run's own is in its log. Another one, asked for in a replay, is worked out by the same rule. A log that was cut
    before the first look owes nothing to it.
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
    """The result under the confidence that it holds with, and what would have brought the tolerance within reach."""
    stopping = run.get("stopping")
    if not isinstance(stopping, Mapping):
        return found
    if found.inertia is not None:
        found = replace(found, inertia=replace(found.inertia, confidence=confidence))
    if found.verdict is Verdict.VALID_WIDE and stopping.get("advice"):
        found = replace(found, advice=str(stopping["advice"]))
    return found


@dataclass(frozen=True)
class Conclusion:
    """What was identified, as it is printed and kept, and how a process ends with it."""

    identification: Identification
    document: dict[str, Any]
    exit_code: ExitCode


def conclude(
    recording: Recording, run: Mapping[str, Any], log: str, warnings: Sequence[str] | None = None
) -> Conclusion:
    """The identification, its document, and the exit code it means. ``run`` is the log's configuration.

    ``warnings``: what was assumed in reading a foreign trace; None for a run of ours.
    """
    from tdhil.estimation import Options, Verdict, identify
    from tdhil.report import result_document
    from tdhil.runner import precondition_warnings, speed_warnings, stage_warnings

    asked = run.get("identify", {})
    known = {one.name: one.default if asked.get(one.name) is None else asked[one.name] for one in ASKED_AGAIN}
    try:
        options = Options(**known)
    except (TypeError, ValueError) as error:
        flags = " or ".join(one.flag for one in ASKED_AGAIN)
        raise UsageError(str(error), where=log, next_step=f"Say {flags} anew") from error
    working = working_confidence_of(run, options.confidence)
    identification = after_looks(identify(recording, replace(options, confidence=working)), run, options.confidence)
    said = (
        *(warnings or ()), *_stop_warnings(run), *precondition_warnings(run), *speed_warnings(run),
        *stage_warnings(run),
    )
    if said:
        identification = replace(identification, warnings=(*said, *identification.warnings))
    # a run that measured the drive's own impedance stands or falls with that
    measured = identification.impedance
    stands = (identification if measured is None else measured).verdict in (Verdict.VALID, Verdict.VALID_WIDE)
    document = result_document(identification, recording, run, log)
    return Conclusion(identification, document, ExitCode.OK if stands else ExitCode.NOT_IDENTIFIABLE)


def _stop_warnings(run: Mapping[str, Any]) -> tuple[str, ...]:
    """A run whose stop nobody saw through has no result of its own; its replay has one, and says so."""
    stop = run.get("stop")
    unseen = isinstance(stop, Mapping) and stop.get("confirmed") is False
    return ("at the end of this run the shaft was NOT seen at rest: the stop was not confirmed",) if unseen else ()
