"""From a Recording to the printed result: the same road for a live run and for its replay."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from tdhil.errors import ExitCode
from tdhil.record.recording import Recording

_MOTION_UNKNOWN = (
    "no periodic excitation is known for this trace, so acceleration, friction and lags can't be told apart",
    "say with --excitation excitation.yaml which periods and lines were run and when, or record a run that has them: "
    "a multisine about two mean speeds",
)


def conclude(
    recording: Recording, run: Mapping[str, Any], log: str, warnings: Sequence[str] | None = None
) -> tuple[dict[str, Any], ExitCode]:
    """The result document and the exit code it means. ``run`` is the log's configuration.

    ``warnings``: what was assumed in reading a foreign trace; None for a run of ours.
    """
    from tdhil.identify import identify
    from tdhil.identify.identification import Verdict
    from tdhil.identify.options import Options
    from tdhil.report.document import result_document

    asked = run.get("identify", {})
    known = {name: asked[name] for name in ("confidence", "tolerance", "model") if asked.get(name) is not None}
    identification = identify(recording, Options(**known))
    if warnings is not None:
        identification = replace(identification, warnings=(*warnings, *identification.warnings))
        # A foreign trace doesn't say what was run; its user may know. Samples that are none stay the reason.
        refused = identification.verdict is Verdict.NOT_IDENTIFIABLE and identification.samples_used > 0
        if recording.excitation is None and refused:
            identification = replace(identification, reason=_MOTION_UNKNOWN[0], advice=_MOTION_UNKNOWN[1])
    stands = identification.verdict in (Verdict.VALID, Verdict.VALID_WIDE)
    return result_document(identification, recording, run, log), ExitCode.OK if stands else ExitCode.NOT_IDENTIFIABLE


def print_result(document: Mapping[str, Any], as_json: bool) -> None:
    """Stdout: one JSON document, or the card."""
    if as_json:
        json.dump(document, sys.stdout, ensure_ascii=False, indent=2, allow_nan=False)
        sys.stdout.write("\n")
        return
    from rich.console import Console

    from tdhil.report.card import print_card

    print_card(document, Console(highlight=False))
