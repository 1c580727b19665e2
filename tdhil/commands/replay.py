"""`tdhil replay run.mcap`: what the live run concluded, again, from the log alone."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from tdhil.commands.conclude import conclude, print_result
from tdhil.errors import ExitCode, UsageError
from tdhil.record.errors import LogError


class NothingRecoverable(LogError):
    """A log of which nothing can be read."""

    exit_code = ExitCode.NOTHING_RECOVERABLE


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of replay."""
    parser.add_argument("log", type=Path, metavar="run.mcap", help="the log of a run, whole or cut short")
    parser.add_argument("--json", action="store_true", help="one JSON document on stdout")
    parser.set_defaults(run=run)


def run(namespace: argparse.Namespace) -> int:
    """Read, identify, print."""
    from tdhil.record.reader import read_run
    from tdhil.report.live import stderr_console

    if not namespace.log.is_file():
        raise UsageError("there is no such log", where=str(namespace.log), next_step="Name a run.mcap of this tool")
    try:
        found = read_run(namespace.log)
    except LogError as error:
        raise NothingRecoverable(error.what, where=error.where, next_step=error.next_step) from error
    configuration: dict[str, Any] = found.configuration
    document, code = conclude(found.recording, configuration, str(namespace.log))
    console = stderr_console()
    for problem in found.problems:
        console.print(f"tdhil: {namespace.log}: {problem}", style="yellow", markup=False)
    print_result(document, namespace.json)
    return int(code if found.recording.complete or code is not ExitCode.OK else ExitCode.PARTIAL)
