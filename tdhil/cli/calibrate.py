"""`tdhil calibrate`: calibration of a drive's torque and speed from recordings and known quantities; nothing moves."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from profiles.quantities import INERTIA
from tdhil.cli.arguments import add_option, amount, require_inertia, require_new, share
from tdhil.cli.calibrate_reference import WITHOUT_BODY, run_without_body
from tdhil.cli.calibrate_speed import add_speed_arguments
from tdhil.cli.replay import add_trace_arguments, check_trace, read_recorded
from tdhil.cli.report_file import ReportFile, add_head_options, add_report_option
from tdhil.cli.results import print_json
from tdhil.config import OPTION
from tdhil.errors import ExitCode, UsageError

if TYPE_CHECKING:
    from tdhil.session import CalibrationRun

_EXAMPLE = "tdhil calibrate torque without.mcap with.mcap --added 55"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the kinds of calibration, with their options."""
    kinds = parser.add_subparsers(dest="kind", metavar="torque|speed", required=True)
    torque = kinds.add_parser(
        "torque", allow_abbrev=False, help="with bodies of known inertia, a torque sensor or a known pipe",
        description="Find the calibration factor of the drive's torque from a run without and a run with a body of"
        " known inertia on the shaft. More bodies are given with --body.")
    _add_torque(torque)
    speed = kinds.add_parser(
        "speed", allow_abbrev=False, help="with counted turns, or the position that the drive reports",
        description="Find the calibration factor of the drive's speed: from a log whose drive reports a position, or"
        " from turns of the shaft that an operator counted.")
    add_speed_arguments(speed)


def _add_torque(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("logs", type=Path, nargs="*", metavar="WITHOUT.mcap WITH.mcap",
                        help="the run without the body and the run with it, of --added; or runs without a body, beside"
                        " --body")
    parser.add_argument("--added", type=amount(INERTIA), metavar="J", help="inertia of the body, kg·m²")
    parser.add_argument("--added-sd", type=amount(INERTIA), metavar="SD",
                        help="its standard uncertainty, kg·m² (default 0.2 %% of it, assumed)")
    parser.add_argument("--body", action="append", default=[], metavar="FILE=J",
                        help="a run with a body of this inertia, kg·m²; repeatable; FILE=J±SD states its uncertainty")
    parser.add_argument("--pairs", type=Path, metavar="pairs.csv",
                        help="torque of a reference sensor beside reported torque, in N·m, with the columns"
                        " reported_nm, reported_sd_nm, reference_nm, reference_sd_nm and direction (up or down); a log"
                        " beside it names the drive")
    parser.add_argument("--reference", type=Path, metavar="trace.csv",
                        help="record of a torque sensor during the run of one log; the time offset is estimated")
    parser.add_argument("--column", nargs="+", metavar="QUANTITY=NAME:UNIT",
                        help="its columns, such as time=t_s torque=m:Nm; default: time_s torque_nm")
    parser.add_argument("--reference-sd", type=share, metavar="SHARE",
                        help="standard uncertainty of the sensor's scale (default 0.3 %%: accuracy class 0.5)")
    parser.add_argument("--known-pipe", type=Path, metavar="string.yaml",
                        help="sizes and tolerances of the pipe below the drive, in the run of one log: its"
                        " characteristic impedance follows from them")
    parser.add_argument("--at", choices=("motor", "main"), default="motor",
                        help="shaft to which the inertia, or the torque of --reference or --pairs, refers; main: behind"
                        " the gear (default motor)")
    add_option(parser, OPTION["confidence"])
    parser.add_argument("--plan", action="store_true",
                        help="from one log: the body and the duration of a run that reach --want")
    parser.add_argument("--want", type=share, default=0.01, metavar="SHARE",
                        help="with --plan: requested half-width of J (default 1 %%)")
    parser.add_argument("--save", type=Path, metavar="calibration.json",
                        help="new file for the calibration, for torque_calibration in rig.yaml")
    add_option(parser, OPTION["json"])
    add_report_option(parser, "report")
    add_head_options(parser)
    add_trace_arguments(parser)
    parser.set_defaults(run=run_torque)


def run_torque(namespace: argparse.Namespace) -> int:
    """Read the logs, fit them together, and print the result; or print a plan."""
    for flag, names in (("--columns", namespace.columns), ("--column", namespace.column)):
        if names and "=" not in names[-1]:
            raise UsageError("takes all later words", where=flag, next_step=f"Name the logs before {flag}")
    check_trace(namespace)
    asked = OPTION["confidence"]
    confidence = asked.default if namespace.confidence is None else namespace.confidence
    if wrong := asked.refusal(confidence):
        raise UsageError(f"{confidence:g}: must be {wrong}", where=asked.flag)
    if namespace.plan:
        return _plan(namespace)
    if any(getattr(namespace, name) is not None for name in WITHOUT_BODY):
        return run_without_body(namespace, confidence)
    for name in ("column", "reference_sd"):
        if getattr(namespace, name) is not None:
            raise UsageError("needs the torque of a sensor: --reference, or --pairs",
                             where=f"--{name.replace('_', '-')}")
    wanted = _wanted(namespace)
    if namespace.save is not None:
        require_new("--save", namespace.save)
    report = ReportFile.of_files(namespace, *(path for path, _, _ in wanted))
    runs = _read(namespace, wanted)
    from tdhil.report import PlainConsole, calibration_report, print_calibration, stderr_console, working
    from tdhil.session import document_of_calibration, find_calibration, save_calibration

    with working("fitting the runs together …"):
        found = find_calibration(runs, namespace.at, confidence)
    document = document_of_calibration(found)
    if namespace.json:
        print_json(document)
    else:
        print_calibration(document, PlainConsole())
    if namespace.save is not None:
        if found.calibration.factor is None:
            stderr_console().print(f"tdhil: nothing was written to {namespace.save}: there is no calibration factor",
                                   style="yellow", markup=False, soft_wrap=True)
        else:
            save_calibration(document, namespace.save)
            stderr_console().print(f"calibration: {namespace.save}", markup=False, soft_wrap=True)
    if report is not None:
        report.write(calibration_report(document), [run.record.configuration for run in runs])
    return int(ExitCode.OK if found.calibration.factor is not None else ExitCode.NOT_IDENTIFIABLE)


def calibrate_two(without: Path, with_body: Path, added: float, added_sd: float | None, save: Path) -> int:
    """Calibrate from two logs, as the command does. Return the exit code."""
    parser = argparse.ArgumentParser()
    _add_torque(parser)
    more = [] if added_sd is None else ["--added-sd", repr(added_sd)]
    return run_torque(parser.parse_args(
        [str(without), str(with_body), "--added", repr(added), *more, "--save", str(save)]))


Wanted = list[tuple[Path, float, float | None]]


def _wanted(namespace: argparse.Namespace) -> Wanted:
    """Return (log, body, its standard uncertainty) of each run. Raises UsageError for impossible values."""
    logs, added = namespace.logs, namespace.added
    require_inertia("--added", added)
    require_inertia("--added-sd", namespace.added_sd, zero=True)
    bodies: Wanted = []
    for text in namespace.body:
        name, equals, value = text.rpartition("=")
        number, _, sd = value.replace("+-", "±").partition("±")
        try:
            body = Path(name), float(number), float(sd) if sd else None
        except ValueError:
            equals = ""
        if not equals or not name:
            raise UsageError(f"{text[:60]!r} is not FILE=J", where="--body", next_step="Such as --body with.mcap=55.0")
        require_inertia("--body", body[1], zero=True)
        require_inertia("--body", body[2], zero=True)
        bodies.append(body)
    if added is None:
        if namespace.added_sd is not None:
            raise UsageError("needs --added, the inertia that it is the uncertainty of", where="--added-sd")
        if not bodies:
            raise UsageError("the inertia of the body is not given", next_step=f"Such as: {_EXAMPLE}")
        return [*((path, 0.0, 0.0) for path in logs), *bodies]
    if len(logs) != 2:
        raise UsageError(f"takes two logs, without the body and with it, not {len(logs)}", where="--added",
                         next_step=f"Such as: {_EXAMPLE}; more bodies with --body FILE=J")
    return [(logs[0], 0.0, 0.0), (logs[1], added, namespace.added_sd), *bodies]


def _read(namespace: argparse.Namespace, wanted: Wanted) -> list[CalibrationRun]:
    from tdhil.session import CalibrationRun, require_file

    for path, _, _ in wanted:
        require_file(path)
    paths = [path for path, _, _ in wanted]
    return [CalibrationRun(read_recorded(namespace, path, paths), added, sd) for path, added, sd in wanted]


def _plan(namespace: argparse.Namespace) -> int:
    from tdhil.report import PlainConsole, working
    from tdhil.session import ASSUMED_BODY_REL_SD, find_plan, require_file

    if len(namespace.logs) != 1 or namespace.body:
        raise UsageError("takes one log, of a run without a body", where="--plan",
                         next_step="Such as: tdhil calibrate torque without.mcap --plan --want 1%")
    if not 0.0 < namespace.want < 1.0:
        raise UsageError(f"{namespace.want:g}: must be a share between 0 and 1", where="--want")
    for name in WITHOUT_BODY:
        if getattr(namespace, name) is not None:
            raise UsageError("is for a body of known inertia, not for another reference",
                             where=f"--plan, --{name.replace('_', '-')}", next_step="Leave one of them out")
    require_inertia("--added", namespace.added)
    require_inertia("--added-sd", namespace.added_sd, zero=True)
    require_file(namespace.logs[0])
    record = read_recorded(namespace, namespace.logs[0])
    sd_share = ASSUMED_BODY_REL_SD
    if namespace.added_sd is not None and namespace.added:
        sd_share = namespace.added_sd / namespace.added
    ratio = record.recording.gear_ratio if namespace.at == "main" else 1.0
    sizes = () if namespace.added is None else (namespace.added / ratio**2,)
    with working("identifying …"):
        inertia, minutes, plans = find_plan(record, namespace.want, sd_share, sizes)
    document = {
        "kind": "torque_calibration_plan", "inertia_kg_m2": inertia, "minutes": minutes, "want": namespace.want,
        "added_rel_sd": sd_share, "at": namespace.at,
        "bodies": [{"added_kg_m2": one.added_kg_m2 * ratio**2, "half_width_share": one.half_width_share,
                    "minutes": one.minutes} for one in plans],
    }
    if namespace.json:
        print_json(document)
        return int(ExitCode.OK)
    from rich.table import Table

    table = Table(title=f"J {inertia:.4g} kg·m² in the drive's unit; stage 5 took {minutes:.1f} min", box=None,
                  title_justify="left", padding=(0, 3))
    wanted = f"minutes each\nfor ±{100 * namespace.want:.4g} %"
    for name in (f"body, kg·m² ({namespace.at})", "J after two such runs", wanted):
        table.add_column(name, justify="right")
    for one in plans:
        longer = "not in a day" if one.minutes is None else f"{math.ceil(10.0 * one.minutes) / 10.0:.1f}"
        table.add_row(f"{one.added_kg_m2 * ratio**2:.4g}", f"±{100 * one.half_width_share:.2f} %", longer)
    PlainConsole().print(table)
    return int(ExitCode.OK)
