"""`tdhil replay`: identification from a tdhil log, or from a trace of a drive's own tool, as in a run."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from profiles.quantities import SHARE
from tdhil.cli.arguments import add_option, add_settings, settings_in
from tdhil.cli.report_file import ReportFile, add_head_options, add_report_option
from tdhil.cli.results import print_result, save_report
from tdhil.config import OF_A_TRACE, OPTION, STATED, expectations_in, expectations_of, form_options
from tdhil.errors import ExitCode, MessageCode, UsageError
from tdhil.file_hash import sha256_of
from tdhil.session import (
    check_lags,
    conclude_run,
    is_evaluation,
    is_log,
    is_verification,
    load_calibration,
    read,
    require_file,
    trace_arguments,
    with_calibration,
)

if TYPE_CHECKING:
    from tdhil.session import RunRecord

def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of replay. A default of None means: not given."""
    # optional for argparse only: after --columns it takes the name of the file as another column (`_log`)
    parser.add_argument("log", type=Path, nargs="?", metavar="run.mcap|trace.csv",
                        help="log of a run, complete or cut short, or a trace in CSV; recognised by its content")
    add_option(parser, OPTION["json"])
    add_report_option(parser, "report")
    add_head_options(parser, texts=[OPTION[name] for name in STATED])
    add_option(parser, OPTION["expect"])
    add_settings(parser, "the run's")
    parser.add_argument("--torque-calibration", type=Path, metavar="calibration.json",
                        help="file of tdhil calibrate torque: every torque in calibrated N·m (default: as the log has)")
    add_trace_arguments(parser)
    parser.set_defaults(run=run)


def add_trace_arguments(parser: argparse.ArgumentParser, *, motion: bool = True) -> None:
    """Add the options for reading a trace in CSV. A default of None means: not given.

    ``motion``: with the options of a periodic motion. They have no effect on a command that fits none.
    """
    trace = parser.add_argument_group("a trace in CSV (a run.mcap contains all this)")
    left_out = [] if motion else [*form_options("motion"), *form_options("motion-file")]
    for option in OF_A_TRACE:
        if option in left_out:
            parser.set_defaults(**{option.name: None})
        elif option.joined:
            trace.add_argument(option.flag, dest=option.name, nargs="+", metavar=option.metavar,
                               help=option.help_text.replace("%", "%%"))
        else:
            add_option(trace, option)


def run(namespace: argparse.Namespace) -> int:
    """Read, identify or evaluate, print."""
    from tdhil.report import stderr_console

    path = _log(namespace)
    settings_in(namespace)
    check_trace(namespace)
    require_file(path)
    report = ReportFile.requested(namespace, path, letterhead=namespace.letterhead)
    recorded = read_recorded(namespace, path).with_said(_said(namespace))
    if namespace.expect:        # each expected value of the command line replaces that of the run
        both = (*expectations_in(recorded.configuration), *expectations_of({}, namespace.expect))
        found = {one.name: one for one in both}
        recorded = replace(recorded, configuration={**recorded.configuration,
                                                    "acceptance": [asdict(one) for one in found.values()]})
    if is_evaluation(recorded.configuration) or is_verification(recorded.configuration):
        what = "steps of tdhil tune verify" if is_verification(recorded.configuration) else "a virtual string"
        for name in settings_in(namespace):
            raise UsageError(f"is for a run that identifies; this log contains {what}", where=OPTION[name].flag)
        recorded.require_motion()
        evaluated = conclude_run(recorded.recording, recorded.configuration, recorded.log, recorded.virtual_string)
        for problem in recorded.problems:
            stderr_console().print(f"tdhil: {recorded.log}: {problem}", style="yellow", markup=False)
        try:
            print_result(evaluated.document, namespace.json)
        finally:
            save_report(evaluated.document, recorded.recording, report, recorded.virtual_string)
        return int(ExitCode.PARTIAL if not recorded.whole and evaluated.exit_code is ExitCode.OK
                   else evaluated.exit_code)
    return _identify(namespace, recorded, report)


def read_recorded(namespace: argparse.Namespace, path: Path, among: Sequence[Path] = ()) -> RunRecord:
    """Return the content of a log, or of a trace by its options. ``among``: all files of the command, if several.

    Raises UsageError for options of a trace if no file is one.
    """
    from tdhil.report import working

    trace: dict[str, Any] = {}
    if is_log(path):
        given = [option.flag for option in OF_A_TRACE if getattr(namespace, option.name) is not None]
        if given and all(map(is_log, among)):
            raise UsageError(f"is for a trace in CSV; {path} is a log of a run and contains its own", where=given[0],
                             entry=MessageCode.OPTION_FOR_CSV_ONLY)
    else:
        options = {option.name: getattr(namespace, option.name) for option in OF_A_TRACE}
        trace = trace_arguments(options, "the command line")
    with working("reading the record …"):
        return read(path, **trace)


def _identify(namespace: argparse.Namespace, recorded: RunRecord, report: ReportFile | None) -> int:
    """Identify and print. Return the exit code of the result, or the one for a result from a part of the run."""
    from tdhil.api import identify
    from tdhil.report import stderr_console, working

    if namespace.torque_calibration is not None:
        path = namespace.torque_calibration
        changed = with_calibration(recorded.configuration, recorded.recording, load_calibration(path), str(path),
                                   sha256_of(Path(recorded.log)))
        recorded = replace(recorded, configuration=changed)
    console = stderr_console()
    with working("identifying …", console):
        result = identify(recorded, **settings_in(namespace))
    for problem in recorded.problems:
        console.print(f"tdhil: {recorded.log}: {problem}", style="yellow", markup=False)
    try:
        print_result(result.document, namespace.json)
    finally:
        save_report(result.document, recorded.recording, report)
    return int(ExitCode.PARTIAL if recorded.partial and result.exit_code is ExitCode.OK else result.exit_code)


def _log(namespace: argparse.Namespace) -> Path:
    if namespace.log is None and namespace.columns and "=" not in namespace.columns[-1]:
        namespace.log = Path(namespace.columns.pop())
    if namespace.log is None:
        raise UsageError("no log is named", next_step="For example: tdhil replay run.mcap",
                         entry=MessageCode.LOG_NEEDED)
    log: Path = namespace.log
    return log


def _said(namespace: argparse.Namespace) -> dict[str, str]:
    return {name: getattr(namespace, name) for name in STATED if getattr(namespace, name) is not None}


def check_trace(namespace: argparse.Namespace) -> None:
    """Check numbers that are impossible for a trace. Raises UsageError with the option."""
    for option in OF_A_TRACE:
        value = getattr(namespace, option.name)
        if option.kind is float and value is not None and (wanted := option.refusal(value)):
            symbol = "" if option.unit in (None, SHARE) else f" {option.unit.symbol}"
            raise UsageError(f"{value:g}{symbol}: must be {wanted}{symbol}", where=option.flag,
                             entry=MessageCode.VALUE_NOT_ALLOWED)
    check_lags({option.name: getattr(namespace, option.name) for option in OF_A_TRACE})
