"""`tdhil identify`: from a drive on the bus to a moment of inertia."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from profiles import with_code
from tdhil.buses import PeerPlan, all_buses
from tdhil.cli.arguments import add_drive_arguments, add_line_arguments, add_options
from tdhil.cli.calibrate_run import add_calibrate_arguments, check_calibrate, run_calibration
from tdhil.cli.report_file import ReportFile, add_report_option
from tdhil.cli.results import print_json
from tdhil.config import OPTION, Overrides, RunDetails, Topic, load_rig, resolve
from tdhil.errors import ExitCode, LogError, TdhilError, code_of, error_document, exit_code

if TYPE_CHECKING:
    from tdhil.buses import Connection
    from tdhil.config import Rig, RunOptions
    from tdhil.runner import RunOutcome
    from tdhil.session import Ending, Rehearsal, RunRequest, RunSession
    from tdhil.soft_torque import EvaluationCase
    from tdhil.speed_loop import StepCase


def list_faults(drive: str | None, *, as_json: bool = False) -> int:
    """Print the known faults of one bus, or of all of them. Return the exit code."""
    from sim_bus import printed_width

    shown, width = [bus for bus in all_buses() if drive in (None, bus.name)], printed_width()
    if as_json:
        print_json({"kind": "faults", "buses": {bus.name: bus.fault_listing(width).splitlines() for bus in shown}})
        return 0
    print("\n\n".join(f"--drive {bus.name}\n\n{bus.fault_listing(width)}" for bus in shown))  # noqa: T201
    return 0


def show_settings(
    console: Console, options: RunOptions, connection: Connection, peer: PeerPlan, rig: Rig | None = None
) -> None:
    """Print the source of every value that is not a default, and conversions of values with a unit."""
    if peer.embedded:
        why = "as requested" if options.simulate else connection.bus.nothing_there
        clock = "stepped time" if peer.stepped else "real time"
        what = connection.bus.simulated_text
        console.print(f"SIMULATED: embedded {what} ({why}), {clock}, seed {peer.seed}", style="magenta")
        for fault in peer.faults:
            console.print(f"SIMULATED: scripted fault {fault.text}", style="magenta", markup=False)
    else:
        for name, value, source in connection.line.rows():
            console.print(f"{connection.bus.row_name} {name:<10} {value}  ({source})", style="dim", markup=False)
    for name, value, source in options.rows():
        if options.given(name):
            number = options.settings[name].value       # 20rpm is 2.0943951023931953 rad/s in the log
            shown = f"{number:.6g}" if isinstance(number, float) else value
            console.print(f"{name:<14} {shown}  ({source})", style="dim", markup=False)
    for key, text, source in rig.conversions if rig is not None else ():
        console.print(f"{key:<14} {text}  ({source})", markup=False)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of identify. A default of None means: rig.yaml, else the built-in default
    (`tdhil.config.options`).
    """
    sections = add_options(parser, Topic.MOTION, Topic.RESULT)
    sections[Topic.MOTION].add_argument("--dry-run", action="store_true",
                                        help="show the plan and the expected result; nothing moves")
    add_report_option(sections[Topic.RESULT], "report")
    add_calibrate_arguments(sections[Topic.RESULT])
    add_peer_arguments(parser)
    parser.set_defaults(run=run)


def add_peer_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of any run: drive and address, overrides, log, simulated rig."""
    add_drive_arguments(parser, moves=True)
    add_options(parser, Topic.CYCLE, Topic.OVERRIDES, Topic.OUTPUT, Topic.SIMULATED)
    add_line_arguments(parser)


def run(namespace: argparse.Namespace) -> int:
    """Run the command; with --calibrate both runs and the calibration."""
    check_calibrate(namespace)
    if namespace.calibrate:
        return run_calibration(namespace, lambda one, logs: run_with(one, logs=logs))
    return run_with(namespace)


def run_with(
    namespace: argparse.Namespace, case: EvaluationCase | StepCase | None = None, logs: list[Path] | None = None,
) -> int:
    """Run the command; ``case``: a virtual string, or steps of the set speed, in stage 5.

    ``logs``: receives the path of the run's log; the process then continues after the run.

    Raises TdhilError before the drive is accessed; after that every error becomes an exit code.
    """
    from tdhil.cli.dry_run import dry_run, dry_run_case, say_before
    from tdhil.report import stderr_console, working
    from tdhil.session import RunRequest, check_unverified, connection_of, plan_peer, suited, with_faults

    if "list" in (namespace.fault or ()):
        return list_faults(vars(namespace).get("drive"), as_json=namespace.json is True)
    rig = load_rig(namespace.rig) if namespace.rig else None
    options = resolve(vars(namespace), rig)
    if options.json is True:
        namespace.json = True
    options, connection = connection_of(vars(namespace), rig, options)
    check_unverified(connection.profile, options)
    console = stderr_console()
    report = ReportFile.requested(namespace, Path(options.log), letterhead=options.letterhead)
    _check_files(namespace, options)
    simulated = options.simulate or not connection.configured
    if namespace.dry_run:
        bench = suited(rig, plan_peer(options, connection).plant)
        if case is not None:
            return dry_run_case(options, bench, case, simulated, options.rate_hz or connection.profile.usual_rate_hz)
        return dry_run(options, bench, simulated, connection.profile)
    peer = with_faults(plan_peer(options, connection), namespace.fault, connection.drive)
    show_settings(console, options, connection, peer, rig)
    details = RunDetails.of(vars(namespace))
    request = RunRequest.of(
        options, connection, peer, rig, overrides=Overrides.of(vars(namespace)), stated=details.texts(),
        real_time_priority=bool(details.real_time_priority), case=case, expect=details.expect,
    )
    if vars(namespace).get("calibrate"):
        request = replace(request, acceptance=())      # the body changes J, and the torque scale is not yet calibrated
    if case is None:
        with working("planning …", console):
            said = say_before(options, request.rig, connection.profile, simulated)
        if said is not None:
            console.print(said, style="yellow", markup=False)
    return _run(request, console, report, logs)


def _check_files(namespace: argparse.Namespace, options: RunOptions) -> None:
    """Check, before anything is opened, that all files differ. Raises UsageError with the option."""
    from tdhil.session import check_different_files, check_log_path

    check_different_files({"--rig": namespace.rig, "--report": namespace.report, **options.files()})
    check_log_path(Path(options.log), options.source("log") if options.given("log") else OPTION["log"].flag)
    if options.trace is not None:
        from sim_bus import check_trace_path

        check_trace_path(Path(options.trace), options.source("trace"))


def _run(request: RunRequest, console: Console, report: ReportFile | None, logs: list[Path] | None) -> int:
    import tdhil.cli.main as entry
    from tdhil.session import Ending, RunSession, TerminalOperator

    options = request.options
    operator_interface = TerminalOperator(
        console, yes=options.yes, gear_ratio=1.0 if request.rig is None else request.rig.gear.ratio
    )
    # After a run of a calibration the process continues, so signals must work again, at the prompt and later.
    with Ending(own_process=entry.process.own and logs is None) as ending:
        session = RunSession(request, operator_interface, report=report is not None)
        code = ending.code(_finish(session, ending, options, console, report))
        if logs is not None:
            logs.append(session.path)
        return code


def _finish(
    session: RunSession, ending: Ending, options: RunOptions, console: Console, report: ReportFile | None,
) -> int:
    from tdhil.cli.results import print_result, save_report
    from tdhil.report import working

    try:
        outcome = session.move(ending.request)
        document: dict[str, Any] | None = None
        if outcome.cause is not None or (outcome.stop is not None and not outcome.stop.confirmed):
            code = _failed(outcome, str(session.path), options.json, console, session.rehearsal)
        else:
            with working("identifying …", console):
                found = session.conclude()
            document, code = found.document, int(found.exit_code)
    except BaseException:
        ending.calm()
        session.abandon()
        raise
    ending.calm()
    try:
        if document is not None:
            print_result(document, options.json, of_motion=True)
    finally:            # stdout may be closed: log and report are finished nevertheless
        try:
            session.close()
        except LogError as error:
            # Stdout already has its one document. If the log ended the run, everything is reported.
            if not isinstance(outcome.cause, LogError):
                console.print(f"tdhil: {error.coded}", style="bold red", markup=False, soft_wrap=True)
            code = code or int(exit_code(error))
        if document is not None:
            # the report contains the log's SHA-256
            save_report(document, session.log.recording(complete=True), report, session.log.virtual_string)
    return code


def _failed(
    outcome: RunOutcome, path: str, as_json: bool, console: Console, rehearsal: Rehearsal | None
) -> int:
    """Print the first cause, the outcome of the stop, and the path of the log."""
    import traceback

    from tdhil.runner import not_confirmed

    cause, stop = outcome.cause, outcome.stop
    code = exit_code(cause) if cause is not None else ExitCode.OK
    if cause is not None:
        if not isinstance(cause, TdhilError):
            traceback.print_exception(cause, file=sys.stderr)
        console.print(f"tdhil: {with_code(str(cause), code_of(cause))}", style="bold red", markup=False, soft_wrap=True)
    said = "the drive was never enabled; nothing has moved"
    if stop is not None and stop.confirmed:
        said = f"the shaft is at standstill (seen at {stop.at_rest_s:.1f} s) and the drive is disabled"
        said = "; ".join((said, *stop.trouble))
    elif stop is not None:
        loud = not_confirmed(stop)
        console.print(f"tdhil: {loud.coded}", style="bold white on red", markup=False, soft_wrap=True)
        said = str(loud)
        # In any case: a script that reads only the exit code must know that the shaft may still turn.
        code = ExitCode.STOP_NOT_CONFIRMED
    if stop is None or stop.confirmed:
        console.print(f"tdhil: {said}", markup=False, soft_wrap=True)
    if rehearsal is not None:
        for line in rehearsal.lines:
            console.print(f"tdhil: {line}", markup=False, soft_wrap=True)
        code = ExitCode(rehearsal.exit_code(int(code)))
    console.print(f"tdhil: log: {path} (tdhil replay {path})", markup=False, soft_wrap=True)
    if as_json:
        document = {
            "error": error_document(cause) if cause is not None else None,
            "exit_code": int(code),
            "stop": said,
            "stages": [
                {"name": stage.name, "outcome": stage.outcome, "duration_s": stage.end_s - stage.start_s}
                for stage in outcome.stages
            ],
            "log": path,
        } | ({} if rehearsal is None else {"rehearsal": rehearsal.plain()})
        print(json.dumps(document, ensure_ascii=False, indent=2))  # noqa: T201
    return int(code)

