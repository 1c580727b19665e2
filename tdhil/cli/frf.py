"""`tdhil frf`: the frequency response ω/T of a run, with intervals, and with noise and nonlinear distortion
separated.
"""

from __future__ import annotations

import argparse
import csv
import math
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from profiles import with_code
from tdhil.cli.arguments import PICTURES, add_option, add_settings, require_target, settings_in
from tdhil.cli.replay import add_trace_arguments, check_trace, read_recorded
from tdhil.cli.results import print_json
from tdhil.config import OPTION
from tdhil.csv_text import cell_of
from tdhil.errors import ExitCode, MessageCode, UsageError
from tdhil.file_kind import require_log_kind
from tdhil.new_file import whole_or_none
from tdhil.session import is_evaluation, is_verification, require_file

if TYPE_CHECKING:
    from tdhil.api import Result

_TABLES: Final = (".csv", ".parquet")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of frf."""
    # optional for argparse only: after --columns it takes the name of a file as another column
    parser.add_argument("logs", type=Path, nargs="*", metavar="run.mcap|trace.csv",
                        help="logs of runs with a periodic excitation, or traces in CSV; several are drawn together")
    add_option(parser, OPTION["json"])
    parser.add_argument("--out", type=Path, metavar="FILE",
                        help="the excited frequencies as a table: frf.csv, or frf.parquet (extra `parquet`)")
    parser.add_argument("--plot", type=Path, metavar="FILE",
                        help="magnitude, phase, apparent inertia, residuals and coherence as frf.png, frf.svg or "
                        "frf.pdf")
    add_settings(parser, "the run's")
    add_trace_arguments(parser)
    parser.set_defaults(run=run)


def run(namespace: argparse.Namespace) -> int:
    """Print the responses. Exit 0: every log has one; 3: a log is not complete; 9: a log has no response."""
    from tdhil.api import identify
    from tdhil.report import SIMULATED, PlainConsole, print_responses, save_responses, stderr_console, working

    logs: list[Path] = list(namespace.logs)
    while namespace.columns and "=" not in namespace.columns[-1]:
        logs.insert(len(namespace.logs), Path(namespace.columns.pop()))
    if not logs:
        raise UsageError("no log is named", next_step="For example: tdhil frf run.mcap", entry=MessageCode.LOG_NEEDED)
    settings = settings_in(namespace)
    check_trace(namespace)
    for path in logs:
        require_file(path)
        require_log_kind(path, "tdhil frf run.mcap", trace=True)
    _check_targets(namespace, logs)
    found: list[Result] = []
    for path in logs:
        recorded = read_recorded(namespace, path, logs)
        if is_evaluation(recorded.configuration) or is_verification(recorded.configuration):
            raise UsageError("contains a virtual string or single steps, which have no frequency response",
                             where=str(path), next_step="Name the log of an identification",
                             entry=MessageCode.WRONG_KIND_OF_FILE)
        recorded.require_motion()
        for problem in recorded.problems:
            stderr_console().print(f"tdhil: {path}: {problem}", style="yellow", markup=False, soft_wrap=True)
        with working("identifying …"):
            found.append(identify(recorded, **settings))
    responses = [_part(one) for one in found]
    if namespace.out is not None:
        _write_table(found, namespace.out)
    if namespace.plot is not None:
        parts = [(Path(one["log"]).name + (f" · {SIMULATED}" if one["simulated"] else ""), one["frequency_response"])
                 for one in responses if one["frequency_response"]]
        try:
            if parts:
                save_responses(parts, namespace.plot)
        except OSError as error:
            raise UsageError(f"can't be written ({error.strerror or error})", where=f"--plot {namespace.plot}",
                             entry=MessageCode.FILE_NOT_WRITABLE) from error
    if namespace.json:
        print_json({"kind": "frequency_response", "responses": responses})
    else:
        print_responses(responses, PlainConsole())
    if any(one["frequency_response"] is None for one in responses):
        return int(ExitCode.NOT_IDENTIFIABLE)
    return int(ExitCode.PARTIAL if any(one.record.partial for one in found) else ExitCode.OK)


def _check_targets(namespace: argparse.Namespace, logs: Sequence[Path]) -> None:
    """Check both files before a log is read. Raises UsageError."""
    for flag, path, endings in (("--out", namespace.out, _TABLES), ("--plot", namespace.plot, PICTURES)):
        if path is None:
            continue
        if path.suffix.lower() not in endings:
            raise UsageError(f"ends in none of {', '.join(endings)}", where=f"{flag} {path}",
                             next_step=f"Such as {flag} frf{endings[0]}", entry=MessageCode.VALUE_NOT_ALLOWED)
        require_target(flag, path, logs, "the log")
    if namespace.out is not None and namespace.out.suffix.lower() == ".parquet":
        _duckdb()
    if namespace.plot is not None:
        from tdhil.report import require_extra

        require_extra("--plot")


def _part(result: Result) -> dict[str, Any]:
    """Return one log's response as plain data; without a response, ``reason`` states why."""
    from tdhil.recording import aborted_stage

    document = result.document
    part = {name: document[name] for name in ("log", "simulated", "frequency_response", "warnings", "warning_codes")}
    stage = aborted_stage(result.record.recording)
    if stage is not None and result.identification.inertia is None:        # else it is the first of the warnings
        part["warnings"] = [f"the run was {stage.aborted_text}. The result uses the data recorded before",
                            *part["warnings"]]
        part["warning_codes"] = [MessageCode.RUN_ENDED_EARLY.code, *part["warning_codes"]]
    excitation, found = result.record.recording.excitation, result.identification
    if part["frequency_response"] is not None:
        reason = None
    elif excitation is None or not excitation.segments:
        reason = with_code("this recording has no periodic excitation. Run tdhil identify with --excitation multisine, "
                           "or describe the motion of a trace with --excitation", MessageCode.NO_EXCITATION.code)
    elif found.periods_used and found.periods_used < 2 * len(excitation.segments):
        reason = with_code(f"{found.periods_used} usable periods do not show the scatter. Run two whole periods or "
                           "more at a mean speed (--periods)", MessageCode.TOO_FEW_PERIODS.code)
    else:
        reason = with_code(f"{found.reason}. Advice: {found.advice}", found.entry.code)
    return part | {"reason": reason}


def _write_table(found: Sequence[Result], path: Path) -> None:
    """Write a row for each line of each log. A CSV has all digits, and an empty cell for an unknown value.

    ``distortion_detected``: 1 if distortion was detected in the log; with 0, ``distortion_rel`` is not significant.
    """
    from tdhil.estimation import response_columns

    rows: list[dict[str, Any]] = []
    for one in found:
        if (response := one.frf) is not None:
            columns = response_columns(response)
            detected = {"distortion_detected": float(response.distortion.detected)}
            rows += [{"log": str(one.document["log"]), **dict(zip(columns, row, strict=True)), **detected}
                     for row in zip(*columns.values(), strict=True)]
    if not rows:
        return
    try:
        with whole_or_none(path):
            (_write_parquet if path.suffix.lower() == ".parquet" else _write_csv)(rows, path)
    except OSError as error:
        raise UsageError(f"can't be written ({error.strerror or error})", where=f"--out {path}",
                         entry=MessageCode.FILE_NOT_WRITABLE) from error


def _write_csv(rows: Sequence[dict[str, Any]], path: Path) -> None:
    with path.open("x", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(rows[0])
        for row in rows:
            table.writerow([_cell(value) for value in row.values()])


def _cell(value: Any) -> Any:
    if isinstance(value, str):
        return cell_of(value)                       # the name of a log comes from anyone
    return "" if isinstance(value, float) and math.isnan(value) else value


def _write_parquet(rows: Sequence[dict[str, Any]], path: Path) -> None:
    quoted = str(path).replace("'", "''")
    columns = ", ".join(f"{name} {'VARCHAR' if name == 'log' else 'DOUBLE'}" for name in rows[0])
    with closing(_duckdb().connect()) as base:
        base.execute(f"CREATE TABLE lines ({columns})")
        marks = ", ".join("?" for _ in rows[0])
        base.executemany(f"INSERT INTO lines VALUES ({marks})", [
            [None if isinstance(cell, float) and math.isnan(cell) else cell for cell in row.values()] for row in rows])
        base.execute(f"COPY lines TO '{quoted}' (FORMAT parquet)")


def _duckdb() -> Any:
    from tdhil.fleet import load_duckdb

    return load_duckdb("--out", "end it in .csv")
