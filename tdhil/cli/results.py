"""The result on stdout, as a card or as one JSON document, and as a report if requested."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from tdhil.cli.standard_streams import OutputLost

if TYPE_CHECKING:
    from tdhil.cli.report_file import ReportFile
    from tdhil.recording import FloatArray, Recording


def save_report(
    document: Mapping[str, Any], recording: Recording, report: ReportFile | None,
    virtual_string: FloatArray | None = None,
) -> None:
    """Write the report if requested, and print its path on stderr. Raises UsageError if it can't be written.

    ``virtual_string``: its cycles, if the run has one.
    """
    if report is not None:
        path, head = report.path, report.letterhead
        if _is_verification(document):
            from tdhil.report import write_verification_report

            written = write_verification_report(document, path, head)
        elif _is_evaluation(document) and virtual_string is not None:
            from tdhil.report import write_evaluation_report

            written = write_evaluation_report(document, virtual_string, path, head)
        else:
            from tdhil.report import write_report

            written = write_report(document, recording, path, head)
        if written != path:
            print(f"tdhil: {path} was created by another program meanwhile", file=sys.stderr)  # noqa: T201
        print(f"report: {written}", file=sys.stderr)  # noqa: T201


def print_json(document: Mapping[str, Any]) -> None:
    """Print one document on stdout; a number that JSON does not have is an internal error."""
    json.dump(document, sys.stdout, ensure_ascii=False, indent=2, allow_nan=False)
    sys.stdout.write("\n")


def print_result(document: Mapping[str, Any], as_json: bool, *, of_motion: bool = False) -> None:
    """Print one JSON document, or the card, on stdout. If stdout fails, print the card on stderr and raise.

    A closed pipe counts as a failure only if the shaft moved for this result (``of_motion``): the reader of a replay,
    such as `head`, has read enough.
    """
    from tdhil.report import PlainConsole

    if _is_evaluation(document):
        from tdhil.report import print_evaluation as show
    elif _is_verification(document):
        from tdhil.report import print_verification as show
    else:
        from tdhil.report import print_card as show
    try:
        if as_json:
            print_json(document)
        else:
            show(document, PlainConsole())
        sys.stdout.flush()
    except (BrokenPipeError, OutputLost) as error:
        if isinstance(error, OutputLost) or of_motion:
            show(document, PlainConsole(sys.stderr))
        raise


def _is_evaluation(document: Mapping[str, Any]) -> bool:
    return document.get("kind") == "evaluation"


def _is_verification(document: Mapping[str, Any]) -> bool:
    return document.get("kind") == "verification"
