"""Option ``--report`` of every command, and the head of its file: letterhead, customer, order number and place.

The options of the head are rows of the one table of options. A run adds them with all rows of its groups; a command
that reads files adds them here.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from tdhil.cli.arguments import add_option
from tdhil.config import OF_THE_HEAD, OPTION, Option
from tdhil.errors import MessageCode, UsageError

if TYPE_CHECKING:
    from tdhil.report import Letterhead, Report

FLAG: Final = "--report"
_LETTERHEAD: Final = OPTION["letterhead"]


def add_report_option(section: argparse._ActionsContainer, name: str) -> None:
    """Add ``--report``; ``name``: name of the file without its ending, as an example."""
    section.add_argument(FLAG, type=Path, metavar="FILE",
                         help=f"the result with graphs in one file: {name}.html, or {name}.pdf on A4")


def add_head_options(
    section: argparse._ActionsContainer, default: str = "from the log", texts: Iterable[Option] = OF_THE_HEAD,
) -> None:
    """Add the options of a report's head, for a command that reads its runs from files. ``texts``: those of a run."""
    for one in texts:
        add_option(section, one, help=f"{one.help.replace('log and report', 'the report')} (default: {default})")
    add_option(section, _LETTERHEAD)


@dataclass(frozen=True)
class ReportFile:
    """Requested report: its path, checked before any work, and its letterhead.

    ``stated``: customer, order number and place of the command line, by the names of the options.
    """

    path: Path
    letterhead: Letterhead
    stated: Mapping[str, str]

    @staticmethod
    def requested(namespace: argparse.Namespace, *inputs: Path, letterhead: str | None = None) -> ReportFile | None:
        """Return the report that the command line requests, or None. Raises UsageError and DataFileError.

        ``inputs``: files that the report must not replace; ``letterhead``: file of rig.yaml, or of the command line.
        """
        if namespace.report is None:
            return None
        from tdhil.report import check_report_path, load_letterhead

        check_report_path(namespace.report, *inputs, where=FLAG)
        found = load_letterhead(None if letterhead is None else Path(letterhead))
        return ReportFile(namespace.report, found, _stated(namespace))

    @staticmethod
    def of_files(namespace: argparse.Namespace, *inputs: Path) -> ReportFile | None:
        """Return the requested report of a command that reads files. Raises UsageError for a head without a report."""
        if namespace.report is None:
            given = [OPTION[name].flag for name in _stated(namespace)]
            for flag in given + ([] if namespace.letterhead is None else [_LETTERHEAD.flag]):
                raise UsageError("is for the head of a report, and no report is requested", where=flag,
                                 next_step=f"Add {FLAG} report.html", entry=MessageCode.VALUE_NOT_ALLOWED)
        return ReportFile.requested(namespace, *inputs, letterhead=namespace.letterhead)

    def write(self, report: Report, runs: Iterable[Mapping[str, Any]]) -> None:
        """Write the report with its head, and print its path on stderr. Raises UsageError if it cannot be written.

        ``runs``: results or configurations of the runs, which state customer, order number and place. If they state
        different texts, the report states none, and the person reads which option decides.
        """
        from tdhil.report import reference_of, stderr_console, write_blocks

        found: dict[str, str] = dict(self.stated)
        of_runs = [dict(reference_of(run)) for run in runs]
        console = stderr_console()
        for one in OF_THE_HEAD:
            label = one.label
            texts = list(dict.fromkeys(run[label] for run in of_runs if label in run))
            if one.name in found or not texts:
                continue
            if len(texts) == 1:
                found[one.name] = texts[0]
                continue
            console.print(f"tdhil: the runs state different texts for {label.lower()} ({', '.join(texts[:3])}). The"
                          f" report states none. Add {one.flag}.", style="yellow", markup=False, soft_wrap=True)
        written = write_blocks(replace(report, letterhead=self.letterhead, reference=reference_of(found)), self.path)
        console.print(f"report: {written}", markup=False, soft_wrap=True)


def _stated(namespace: argparse.Namespace) -> dict[str, str]:
    given = {one.name: getattr(namespace, one.name, None) for one in OF_THE_HEAD}
    return {name: text for name, text in given.items() if text is not None}
