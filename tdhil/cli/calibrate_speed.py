"""`tdhil calibrate speed`: calibration of the reported speed from counted turns or from the drive's position."""

from __future__ import annotations

import argparse
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from profiles.quantities import SPEED, TIME
from tdhil.cli.arguments import LARGEST_VALUE, add_option, amount, require_folder, share
from tdhil.cli.replay import add_trace_arguments, check_trace, read_recorded
from tdhil.cli.report_file import ReportFile, add_head_options, add_report_option
from tdhil.cli.results import print_json
from tdhil.config import OPTION
from tdhil.errors import ExitCode, UsageError
from tdhil.file_hash import sha256_of

if TYPE_CHECKING:
    from tdhil.calibration import SpeedCalibration
    from tdhil.session import RunRecord

_EXAMPLE = "tdhil calibrate speed --turns 100 --seconds 312.4 --speed 2.0"
_OF_TURNS = ("seconds", "speed", "from", "to", "turns_sd", "seconds_sd", "speed_sd")
_OF_LOG = ("from", "to")
_OF_DISPLAY = ("speed", "speed_sd")


def add_speed_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the speed calibration. A default of None means: not given."""
    parser.add_argument("log", type=Path, nargs="?", metavar="run.mcap",
                        help="a log whose drive reports a position; or, with --turns, the log of the counted turns")
    parser.add_argument("--turns", type=float, metavar="N", help="counted turns of the shaft")
    parser.add_argument("--turns-sd", type=float, metavar="SD",
                        help="standard uncertainty of the count (default 0.25 turns, assumed)")
    parser.add_argument("--seconds", type=amount(TIME), metavar="S", help="time in which they were counted, s")
    parser.add_argument("--seconds-sd", type=amount(TIME), metavar="SD",
                        help="standard uncertainty of the time (default 0.3 s, a stopwatch by hand, assumed)")
    parser.add_argument("--speed", type=amount(SPEED), metavar="W",
                        help="mean reported speed during the count, at the motor, rad/s, or such as 19.1rpm")
    parser.add_argument("--speed-sd", type=amount(SPEED), metavar="SD",
                        help="its standard uncertainty (default 0.1 %% of it, assumed)")
    parser.add_argument("--from", type=amount(TIME), metavar="S", help="time of the log at which the count began, s")
    parser.add_argument("--to", type=amount(TIME), metavar="S", help="time of the log at which the count ended, s")
    parser.add_argument("--at", choices=("motor", "main"), default="motor",
                        help="shaft that was counted; main: behind the gear (default motor)")
    add_option(parser, OPTION["confidence"])
    parser.add_argument("--want", type=share, default=0.01, metavar="SHARE",
                        help="largest half-width of the factor; a wider result is refused (default 1 %%)")
    parser.add_argument("--save", type=Path, metavar="calibration.json",
                        help="file for the result: a new one, or one that holds a torque calibration of this drive")
    add_option(parser, OPTION["json"])
    add_report_option(parser, "report")
    add_head_options(parser)
    add_trace_arguments(parser)
    parser.set_defaults(run=run_speed)


def run_speed(namespace: argparse.Namespace) -> int:
    """Read, compute, print, and save the result."""
    from tdhil.report import PlainConsole, print_speed_calibration, speed_document, speed_report, stderr_console
    from tdhil.session import (
        add_speed_calibration,
        check_speed_place,
        drive_identity,
        drive_settings,
        require_file,
    )

    _check(namespace)
    if namespace.save is not None:
        require_folder("--save", namespace.save)
        check_speed_place(namespace.save)
    report = ReportFile.of_files(namespace, *(() if namespace.log is None else (namespace.log,)))
    record = None
    if namespace.log is not None:
        require_file(namespace.log)
        record = read_recorded(namespace, namespace.log)
    found, inputs, warnings = _found(namespace, record)
    started = None if record is None else record.configuration.get("started")
    document = speed_document(
        found, inputs, {} if record is None else drive_identity(record.configuration),
        {} if record is None else drive_settings(record.configuration, record.recording),
        log=None if record is None else {"log": record.log, "sha256": sha256_of(Path(record.log)), "date": started},
        date=started or datetime.now().astimezone().isoformat(timespec="seconds"), confidence=_confidence(namespace),
        simulated=record is not None and record.recording.simulated, warnings=warnings)
    if namespace.json:
        print_json(document)
    else:
        print_speed_calibration(document, PlainConsole())
    if namespace.save is not None:
        console = stderr_console()
        if found.factor is None:
            console.print(f"tdhil: nothing was written to {namespace.save}: there is no calibration factor",
                          style="yellow", markup=False, soft_wrap=True)
        else:
            if not add_speed_calibration(document, namespace.save):
                console.print("tdhil: no log names the drive: whether both calibrations are of the same drive was not"
                              " checked", style="yellow", markup=False, soft_wrap=True)
            console.print(f"calibration: {namespace.save}", markup=False, soft_wrap=True)
    if report is not None:
        report.write(speed_report(document), () if record is None else (record.configuration,))
    return int(ExitCode.OK if found.factor is not None else ExitCode.NOT_IDENTIFIABLE)


def _confidence(namespace: argparse.Namespace) -> float:
    asked = OPTION["confidence"]
    return float(asked.default if namespace.confidence is None else namespace.confidence)


def _check(namespace: argparse.Namespace) -> None:
    """Raise UsageError for options that are impossible, or do not go together."""
    if namespace.columns and "=" not in namespace.columns[-1]:
        raise UsageError("takes all later words", where="--columns", next_step="Name the log before --columns")
    check_trace(namespace)
    confidence = _confidence(namespace)
    if wrong := OPTION["confidence"].refusal(confidence):
        raise UsageError(f"{confidence:g}: must be {wrong}", where=OPTION["confidence"].flag)
    if not 0.0 < namespace.want < 1.0:
        raise UsageError(f"{namespace.want:g}: must be a share between 0 and 1", where="--want")
    given = {name: getattr(namespace, name) for name in ("turns", *_OF_TURNS) if getattr(namespace, name) is not None}
    for name, value in given.items():
        zero, signed = name.endswith("_sd") or name in _OF_LOG, name in ("speed", "from", "to")
        size = abs(value) if signed else value
        if not (0.0 < size <= LARGEST_VALUE or (zero and size == 0.0)):
            raise UsageError(f"{value:g}: must be a positive number", where=_flag(name))
    if namespace.turns is None:
        if given:
            raise UsageError("needs --turns, the counted turns", where=_flag(next(iter(given))),
                             next_step=f"Such as: {_EXAMPLE}")
        if namespace.log is None:
            raise UsageError("neither a log nor counted turns are given", next_step=f"Such as: {_EXAMPLE}")
        if namespace.at != "motor":
            raise UsageError("is for counted turns; the position is of the motor shaft", where="--at")
    for name in _OF_LOG if namespace.log is None else _OF_DISPLAY:
        if name in given:
            raise UsageError("needs a log" if namespace.log is None else "is not needed: the log holds the speed",
                             where=_flag(name), next_step=f"Such as: {_EXAMPLE}")


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _found(
    namespace: argparse.Namespace, record: RunRecord | None
) -> tuple[SpeedCalibration, dict[str, object], tuple[str, ...]]:
    """Return the result, its inputs, and warnings."""
    from dataclasses import asdict

    from tdhil.session import SECONDS_SD, SPEED_REL_SD, TURNS_SD, TurnsCount, speed_by_position, speed_by_turns

    confidence = _confidence(namespace)
    if namespace.turns is None:
        assert record is not None
        return speed_by_position(record, namespace.want, confidence), {}, (
            "the counts per turn of the drive's position count as exact: a wrong number gives a wrong factor",)
    ratio = 1.0
    if namespace.at == "main":
        if record is None and namespace.gear_ratio is None:
            raise UsageError("needs the gear ratio, from a log or by --gear", where="--at main")
        ratio = namespace.gear_ratio if record is None else record.recording.gear_ratio
    count = TurnsCount(
        namespace.turns, namespace.turns_sd, namespace.seconds, namespace.seconds_sd, namespace.speed,
        namespace.speed_sd, getattr(namespace, "from"), namespace.to)
    counted, found = speed_by_turns(count, record, ratio, namespace.want, confidence)
    assumed = {"turns_sd": f"of the count was assumed to be {TURNS_SD:g} turns",
               "seconds_sd": f"of the time was assumed to be {SECONDS_SD:g} s"}
    if record is None:
        assumed["speed_sd"] = f"of the mean speed was assumed to be {100 * SPEED_REL_SD:.1f} % of it"
    inputs = {**asdict(counted), "counted_turns": namespace.turns, "at": namespace.at, "gear_ratio": ratio}
    return found, inputs, tuple(f"the standard uncertainty {text}; state it with {_flag(name)}"
                                for name, text in assumed.items() if getattr(namespace, name) is None)
