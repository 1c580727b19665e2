"""From a Recording to the printed result: the same road for a live run and for its replay."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from tdhil.cli.streams import OutputLost
from tdhil.errors import ExitCode, UsageError
from tdhil.estimation.result import Identification, Verdict
from tdhil.recording.recording import Recording

# ---------------------------------------------------------------------------------------------------------------------
# What a stopping rule means for the result: intervals a little wider, so that they cover as asked after looking.


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
    from tdhil.run.design.stopping_rule import interval_confidence

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


# ---------------------------------------------------------------------------------------------------------------------

def conclude(
    recording: Recording, run: Mapping[str, Any], log: str, warnings: Sequence[str] | None = None
) -> tuple[dict[str, Any], ExitCode]:
    """The result document and the exit code it means. ``run`` is the log's configuration.

    ``warnings``: what was assumed in reading a foreign trace; None for a run of ours.
    """
    from tdhil.estimation import identify
    from tdhil.estimation.result import Options, Verdict
    from tdhil.report.document import result_document
    from tdhil.run import preconditions, speed_check, stage_log

    asked = run.get("identify", {})
    known = {name: asked[name] for name in ("confidence", "tolerance", "model") if asked.get(name) is not None}
    try:
        options = Options(**known)
    except (TypeError, ValueError) as error:
        raise UsageError(str(error), where=log, next_step="Say --model, --confidence or --tolerance anew") from error
    working = working_confidence_of(run, options.confidence)
    identification = after_looks(identify(recording, replace(options, confidence=working)), run, options.confidence)
    said = (
        *(warnings or ()), *_stop_warnings(run), *preconditions.warnings(run), *speed_check.warnings(run),
        *stage_log.warnings(run),
    )
    if said:
        identification = replace(identification, warnings=(*said, *identification.warnings))
    stands = identification.verdict in (Verdict.VALID, Verdict.VALID_WIDE)
    return result_document(identification, recording, run, log), ExitCode.OK if stands else ExitCode.NOT_IDENTIFIABLE


def _stop_warnings(run: Mapping[str, Any]) -> tuple[str, ...]:
    """A run whose stop nobody saw through has no result of its own; its replay has one, and says so."""
    stop = run.get("stop")
    unseen = isinstance(stop, Mapping) and stop.get("confirmed") is False
    return ("at the end of this run the shaft was NOT seen at rest: the stop was not confirmed",) if unseen else ()


def save_report(document: Mapping[str, Any], recording: Recording, path: Path | None) -> None:
    """Where one was asked for, the page as a file. Raises UsageError if it can't be written."""
    if path is not None:
        from tdhil.report.html import write_report

        written = write_report(document, recording, path)
        if written != path:
            print(f"tdhil: {path} has come there meanwhile; the report is {written}", file=sys.stderr)  # noqa: T201


def print_result(document: Mapping[str, Any], as_json: bool) -> None:
    """Stdout: one JSON document, or the card. Where stdout takes nothing, the card goes to stderr, and it raises."""
    from tdhil.report.card import print_card
    from tdhil.report.console import PlainConsole

    try:
        if as_json:
            json.dump(document, sys.stdout, ensure_ascii=False, indent=2, allow_nan=False)
            sys.stdout.write("\n")
        else:
            print_card(document, PlainConsole())
        sys.stdout.flush()
    except (BrokenPipeError, OutputLost):
        print_card(document, PlainConsole(sys.stderr))
        raise
