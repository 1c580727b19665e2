"""`tdhil replay`: a log of ours, or a trace exported from a drive's own tool, identified like a run."""

from __future__ import annotations

import argparse
import math
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from profiles.quantities import SHARE, TIME, TORQUE
from tdhil.cli.arguments import MODELS, amount, share
from tdhil.cli.conclude import conclude, print_result, save_report
from tdhil.errors import ExitCode, LogError, NothingRecoverable, UsageError

if TYPE_CHECKING:
    from tdhil.recording.log_reader import Run
    from tdhil.recording.run_log import Ended

_TRACE_ONLY = (
    "columns", "excitation", "rated_torque", "torque_limit", "gear", "torque_scale_sd",
    "speed_lag", "speed_lag_sd", "torque_lag", "torque_lag_sd",
)

_REPEATED = frozenset(ExitCode) - {ExitCode.INTERNAL, ExitCode.INTERRUPTED, ExitCode.TERMINATED}
"""Exit codes of a run that tell of the run; the others tell of the process that it was."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of replay. None as a default: not given."""
    # Optional for argparse only: behind --columns the file's name is taken for one more column (`_log`).
    parser.add_argument("log", type=Path, nargs="?", metavar="run.mcap|trace.csv",
                        help="the log of a run, whole or cut short, or a trace in CSV; told apart by their content")
    parser.add_argument("--json", action="store_true", help="one JSON document on stdout")
    parser.add_argument("--report", type=Path, metavar="FILE",
                        help="the result with pictures in one file: report.html, or report.pdf on A4")
    parser.add_argument("--operator", metavar="NAME", help="who ran it, for the report (default: as the log says)")
    parser.add_argument("--note", metavar="TEXT", help="what else the report shall say (default: as the log says)")
    parser.add_argument("--model", choices=MODELS, help="of the shaft (default: the run's, or auto)")
    parser.add_argument("--confidence", type=share, metavar="P", help="of the interval (default: the run's, or 0.95)")
    parser.add_argument("--tolerance", type=share, metavar="SHARE",
                        help="half-width of the interval that is enough (default: the run's, or 0.05)")
    trace = parser.add_argument_group("a trace in CSV (a run.mcap brings all this along)")
    trace.add_argument("--columns", nargs="+", metavar="QUANTITY=NAME:UNIT",
                       help="such as time=t_s speed=n_rpm:rpm torque=m_pct:%%; default: time_s speed_rad_s torque_nm")
    trace.add_argument("--excitation", type=Path, metavar="excitation.yaml",
                       help="the periodic motion that was run: period, lines, mean speeds, start times")
    for flag, unit, metavar, text in (
        ("--rated-torque", TORQUE, "NM", "what torque in %% or ‰ is a share of, N·m"),
        ("--torque-limit", TORQUE, "NM", "the drive's torque limit, N·m: what is cut off there is refused"),
        ("--gear", None, "RATIO", "i = ω_motor/ω_main (default 1)"),
        ("--torque-scale-sd", SHARE, "SHARE", "how right the drive's torque is, 1 sd (default 0.03)"),
        ("--speed-lag", TIME, "S", "time constant of the filter on the reported speed"),
        ("--speed-lag-sd", TIME, "S", "its standard deviation (default a tenth of it)"),
        ("--torque-lag", TIME, "S", "time constant of the filter on the reported torque"),
        ("--torque-lag-sd", TIME, "S", "its standard deviation (default a tenth of it)"),
    ):
        trace.add_argument(flag, type=float if unit is None else amount(unit), metavar=metavar, help=text)
    parser.set_defaults(run=run)


def run(namespace: argparse.Namespace) -> int:
    """Read, identify, print."""
    path = _log(namespace)
    _check(namespace)
    if not path.is_file():
        raise UsageError("there is no such log", where=str(path),
                         next_step="Name a run.mcap of this tool, or a trace in CSV")
    if namespace.report is not None:
        from tdhil.report.html import check_report_path

        check_report_path(namespace.report, path)
    return _run_log(namespace, path) if _is_log(path) else _run_trace(namespace, path)


def _run_log(namespace: argparse.Namespace, path: Path) -> int:
    from tdhil.recording.log_reader import read_run
    from tdhil.recording.recording import aborted_stage
    from tdhil.recording.run_log import find_ended
    from tdhil.report.live import stderr_console

    for name in _TRACE_ONLY:
        if getattr(namespace, name) is not None:
            raise UsageError("is for a trace in CSV; this log brings its own", where=f"--{name.replace('_', '-')}")
    try:
        found = read_run(path)
    except LogError as error:
        raise NothingRecoverable(error.what, where=error.where, next_step=error.next_step) from error
    ended = find_ended(found.configuration, found.events)
    _refuse_empty(found, ended, path)
    configuration: dict[str, Any] = found.configuration | ({} if ended is None else {"ended": asdict(ended)})
    configuration |= _said(namespace)
    if "started" not in configuration and found.epoch_ns:      # a log of before 0.2, of a run in real time
        began = datetime.fromtimestamp(found.epoch_ns / 1e9, UTC).astimezone()
        configuration["started"] = began.isoformat(timespec="seconds")
    asked = _asked(namespace)
    if asked:
        configuration = configuration | {"identify": {**configuration.get("identify", {}), **asked}}
    document, code = conclude(found.recording, configuration, str(path))
    console = stderr_console()
    for problem in found.problems:
        console.print(f"tdhil: {path}: {problem}", style="yellow", markup=False)
    try:
        print_result(document, namespace.json)
    finally:
        save_report(document, found.recording, namespace.report)
    whole = found.recording.complete and aborted_stage(found.recording) is None
    return int(code if whole or code is not ExitCode.OK else ExitCode.PARTIAL)


def _refuse_empty(found: Run, ended: Ended | None, path: Path) -> None:
    """A run that was refused, or ended in setup, holds nothing to identify from: what ended it is all to be said.

    Raises NothingRecorded with that run's own exit code, but for one that tells of a process and not of a run.
    """
    from tdhil.errors import NothingRecorded

    if len(found.recording.time_s) and any(stage.name != "setup" for stage in found.stages):
        return
    if ended is not None:
        in_stage = f"in stage {found.stages[-1].name}" if found.stages else "before its first stage"
        raise NothingRecorded(
            f"the run in this log ended {in_stage}, with nothing to identify from: {ended.message}",
            ended.exit_code if ended.exit_code in _REPEATED else ExitCode.PARTIAL,
            where=str(path), next_step=ended.next_step,
        )


def _run_trace(namespace: argparse.Namespace, path: Path) -> int:
    from tdhil.cli.task import ASSUMED_TORQUE_SCALE_REL_SD
    from tdhil.recording.csv.layout import USUAL, parse_columns
    from tdhil.recording.csv.reader import Bench, read_recording

    scale = namespace.torque_scale_sd
    bench = Bench(
        rated_torque_nm=namespace.rated_torque,
        torque_limit_nm=namespace.torque_limit,
        torque_scale_rel_sd=ASSUMED_TORQUE_SCALE_REL_SD if scale is None else scale,
        gear_ratio=1.0 if namespace.gear is None else namespace.gear,
        lag_prior=_lag_prior(namespace),
    )
    choices = USUAL if namespace.columns is None else parse_columns(namespace.columns)
    recording, warnings = read_recording(path, choices, namespace.excitation, bench)
    if scale is None:
        warnings = (*warnings, f"the torque scale was assumed right to {ASSUMED_TORQUE_SCALE_REL_SD:.0%} (1 sd)")
    asked = {"tolerance": 0.05, "confidence": 0.95} | _asked(namespace)
    document, code = conclude(recording, {"identify": asked} | _said(namespace), str(path), warnings)
    print_result(document, namespace.json)
    save_report(document, recording, namespace.report)
    return int(code)


def _lag_prior(namespace: argparse.Namespace) -> Any:
    from tdhil.cli.task import UNKNOWN_LAG_SD_SHARE
    from tdhil.recording.recording import LagPrior

    sds = []
    for lag, sd in ((namespace.speed_lag, namespace.speed_lag_sd), (namespace.torque_lag, namespace.torque_lag_sd)):
        sds.append((lag or 0.0) * UNKNOWN_LAG_SD_SHARE if sd is None else sd)
    known = namespace.speed_lag is not None or namespace.torque_lag is not None
    return LagPrior(namespace.speed_lag, sds[0], namespace.torque_lag, sds[1], "the command line" if known else "")


def _log(namespace: argparse.Namespace) -> Path:
    if namespace.log is None and namespace.columns and "=" not in namespace.columns[-1]:
        namespace.log = Path(namespace.columns.pop())
    if namespace.log is None:
        raise UsageError("which log? None is named", next_step="Such as: tdhil replay run.mcap")
    log: Path = namespace.log
    return log


def _is_log(path: Path) -> bool:
    """MCAP by its first bytes, also if there are no more than some of them."""
    from tdhil.recording.mcap_container import MAGIC

    try:
        with path.open("rb") as file:
            head = file.read(len(MAGIC))
    except OSError as error:
        raise NothingRecoverable(f"can't be read ({error.strerror or error})", where=str(path)) from error
    return head.startswith(MAGIC[:5]) or (bool(head) and MAGIC.startswith(head))


def _said(namespace: argparse.Namespace) -> dict[str, str]:
    return {name: getattr(namespace, name) for name in ("operator", "note") if getattr(namespace, name) is not None}


def _asked(namespace: argparse.Namespace) -> dict[str, float | str]:
    names = ("confidence", "tolerance", "model")
    return {name: getattr(namespace, name) for name in names if getattr(namespace, name) is not None}


def _check(namespace: argparse.Namespace) -> None:
    """Numbers that no trace could make sense of. UsageError names the option."""
    for name, low, high, wanted in (
        ("confidence", 0.5, 1.0, "at least 0.5 and below 1"),
        ("tolerance", 1e-9, math.inf, "a positive share"),
        ("rated_torque", 1e-9, 1e9, "a positive number of N·m"),
        ("torque_limit", 1e-9, 1e9, "a positive number of N·m"),
        ("gear", 1e-6, 1e6, "a positive number"),
        ("torque_scale_sd", 0.0, 1.0, "a share from 0 to below 1"),
        *((lag, 0.0, 1e6, "a time in s, not negative")
          for lag in ("speed_lag", "speed_lag_sd", "torque_lag", "torque_lag_sd")),
    ):
        value = getattr(namespace, name)
        if value is not None and not low <= value < high:      # NaN neither
            raise UsageError(f"{value:g}: must be {wanted}", where=f"--{name.replace('_', '-')}")
    for lag in ("speed_lag", "torque_lag"):
        if getattr(namespace, lag) is None and getattr(namespace, f"{lag}_sd") is not None:
            flag = lag.replace("_", "-")
            raise UsageError(f"needs --{flag}, the value that it is the deviation of", where=f"--{flag}-sd")
