"""`tdhil identify`: from a drive on the bus to a moment of inertia."""

from __future__ import annotations

import argparse
import io
import json
import sys
from collections.abc import Callable
from contextlib import nullcontext, suppress
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

    from drivers.drive import Identity, Preflight
    from profiles.library import Profile
    from tdhil.cli.connection import Connection
    from tdhil.cli.open_drive import PeerPlan
    from tdhil.config.options import RunOptions
    from tdhil.config.rig import Rig
    from tdhil.recording.run_log import RunLog
    from tdhil.run.task import Idle, RunOutcome, Task


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of identify. None as a default means: rig.yaml, else the built-in default (`tdhil.config.options`)."""
    from profiles.quantities import FREQUENCY, SPEED, TIME
    from tdhil.cli.arguments import add_drive_arguments, add_line_arguments
    from tdhil.commands.models import EXCITATIONS, MODELS
    from tdhil.commands.quantities import amount, share

    drive = add_drive_arguments(parser)
    drive.add_argument("--rate", dest="rate_hz", type=amount(FREQUENCY), metavar="HZ",
                       help="cycles a second (default: what this computer holds, up to the profile's)")
    drive.add_argument("--real-time-priority", action="store_true",
                       help="the control loop before all other programs, its memory locked, where that is allowed")
    drive.add_argument("--accept-unverified", action="append", metavar="NAME",
                       help="take this entry of the profile although nobody verified it; 'likely' takes all of those")
    drive.add_argument("--accept-no-watchdog", action="store_true",
                       help="take a drive whose watchdog can't be armed: it won't stop by itself if this host dies")
    drive.add_argument("--accept-shared-watchdog", action="store_true",
                       help="Modbus: take a drive whose watchdog other clients feed, too: it won't stop by itself if "
                       "this host dies while one of them goes on asking")
    drive.add_argument("--accept-wider-limit", action="append", choices=("torque", "speed", "quick-stop"),
                       help="let the run widen this limit of the drive's own; otherwise a tighter one stays")
    drive.add_argument("--accept-speed-unit", action="store_true",
                       help="take the profile's unit of speed without seeing the shaft turn as fast as it says")
    drive.add_argument("--reset-fault", action="store_true", help="reset a drive that is in fault; never done unasked")
    motion = parser.add_argument_group("motion")
    motion.add_argument("--excitation", choices=EXCITATIONS, help="stage 5 (default multisine)")
    motion.add_argument("--mode", choices=("torque", "speed"), help="what the drive regulates in stage 5")
    motion.add_argument("--frequency", dest="frequency_hz", type=amount(FREQUENCY), metavar="HZ",
                        help="lowest line or the tone")
    motion.add_argument("--amplitude", dest="amplitude_rad_s", type=amount(SPEED), metavar="RAD_S",
                        help="peak of the speed, such as 1.5 or 15rpm")
    motion.add_argument("--offset", dest="offset_rad_s", type=amount(SPEED), metavar="RAD_S",
                        help="mean speed, such as 4 or 40rpm")
    motion.add_argument("--periods", type=int, metavar="N", help="periods per mean speed, settling included")
    motion.add_argument("--max-time", dest="max_time_s", type=amount(TIME), metavar="TIME",
                        help="longest stage 5, such as 300 or 5min (default: what limits.time_s leaves)")
    motion.add_argument("--dry-run", action="store_true", help="show the plan and what to expect; nothing moves")
    motion.add_argument("--yes", action="store_const", const=True, help="no prompt before motion; limits stay")
    result = parser.add_argument_group("result")
    result.add_argument("--tolerance", type=share, metavar="SHARE",
                        help="acquire until the half-width of J's interval is this share of it, such as 1%% or 0.01")
    result.add_argument("--confidence", type=share, metavar="P", help="of the interval (default 0.95)")
    result.add_argument("--model", choices=MODELS, help="of the shaft (default auto: the simplest that fits)")
    result.add_argument("--log", metavar="run.mcap", help="where the log goes; an older one is moved aside")
    result.add_argument("--report", type=Path, metavar="FILE",
                        help="the result with pictures in one file: report.html, or report.pdf on A4")
    result.add_argument("--operator", metavar="NAME", help="who ran it, for log and report")
    result.add_argument("--note", metavar="TEXT", help="whatever else log and report shall say of this run")
    result.add_argument("--json", action="store_const", const=True, help="one JSON document on stdout")
    simulated = parser.add_argument_group("simulated rig")
    simulated.add_argument("--simulate", action="store_const", const=True,
                           help="embedded simulator; the default where nobody says where the drive is")
    simulated.add_argument("--plant", metavar="plant.yaml", help="other parameters of the embedded rig")
    simulated.add_argument("--fault", action="append", metavar="FAULT",
                           help="rehearse a fault of the embedded rig, such as sto@hold+2s; 'list' shows them all")
    simulated.add_argument("--seed", type=int, metavar="N", help="repeats a simulated run")
    simulated.add_argument("--real-time", action="store_const", const=True, help="against the wall clock")
    simulated.add_argument("--stepped", action="store_const", const=True, help="step a simulator on the bus by SYNC")
    simulated.add_argument("--trace", metavar="shaft.csv", help="true shaft of the embedded rig")
    add_line_arguments(parser)
    parser.set_defaults(run=run)


def run(namespace: argparse.Namespace) -> int:
    """The whole path. Raises TdhilError before the drive is touched; afterwards everything ends in an exit code."""
    from tdhil.cli.connection import can_torque, connection_of
    from tdhil.cli.dry_run import dry_run, refuse_hopeless
    from tdhil.cli.open_drive import plan_peer
    from tdhil.commands.rehearsal import list_faults, with_faults
    from tdhil.commands.settings_said import show_settings
    from tdhil.commands.simulated_bench import suited
    from tdhil.commands.unverified import check_names
    from tdhil.config.options import resolve
    from tdhil.config.rig import load_rig
    from tdhil.report.live import stderr_console

    if "list" in (namespace.fault or ()):
        return list_faults()
    rig = load_rig(namespace.rig) if namespace.rig else None
    options = resolve(vars(namespace), rig)
    if options.json is True:
        namespace.json = True
    options, connection = connection_of(vars(namespace), rig, options)
    check_names(connection.profile, options.accept_unverified, options.source("accept_unverified"))
    console = stderr_console()
    if namespace.report is not None:
        from tdhil.report.html import check_report_path

        check_report_path(namespace.report, Path(options.log))
    _check_files(namespace, options)
    if namespace.dry_run:
        simulated = options.simulate or not connection.configured
        lets_go = connection.profile.quick_stop.ends == "off"
        return dry_run(options, rig, simulated, can_torque(connection.profile), lets_go)
    peer = with_faults(plan_peer(options, connection), namespace.fault, connection.drive)
    show_settings(console, options, connection, peer, rig)
    bench = suited(rig, peer.plant)
    refuse_hopeless(options, bench, can_torque(connection.profile))
    return _run(namespace, options, connection, peer, bench, console)


def _check_files(namespace: argparse.Namespace, options: RunOptions) -> None:
    """Before anything is opened: no file of this run is another's. UsageError names the option."""
    from tdhil.commands.log_file import check_log_path, check_names

    log, trace = Path(options.log), options.trace
    profile = options.profile
    check_names({
        "--rig": namespace.rig,
        "--profile": Path(profile) if profile.endswith((".yaml", ".yml")) else None,
        "--plant": None if options.plant is None else Path(options.plant),
        "--log": log,
        "--report": namespace.report,
        "--trace": None if trace is None else Path(trace),
    })
    check_log_path(log, options.source("log") if options.given("log") else "--log")
    if trace is not None:
        from sim_bus.trace import check_trace_path

        check_trace_path(Path(trace), "--trace")


def _load_the_end(report: bool) -> None:
    """What stop, result and messages need, before anything moves: later there may be no descriptor left to read it."""
    import traceback  # noqa: F401

    import scipy.optimize
    import scipy.signal
    import scipy.special
    import scipy.stats  # noqa: F401
    from rich.console import Console

    from tdhil.commands import stop_signals  # noqa: F401
    from tdhil.estimation import identify  # noqa: F401
    from tdhil.estimation.result import Verdict  # noqa: F401
    from tdhil.report import card, document, html  # noqa: F401
    from tdhil.run import runner, stop  # noqa: F401

    with Console(file=io.StringIO()).status(""):
        pass      # rich loads its spinners when it needs them
    if report:
        from tdhil.report import page, plots  # noqa: F401


def _run(
    namespace: argparse.Namespace,
    options: RunOptions,
    connection: Connection,
    peer: PeerPlan,
    rig: Rig | None,
    console: Console,
) -> int:
    from tdhil.cli.conclude import print_result, save_report
    from tdhil.cli.open_drive import open_drive
    from tdhil.cli.real_time import real_time_priority
    from tdhil.commands.confirm import confirm_motion, confirm_speed
    from tdhil.commands.log_file import LogPlace
    from tdhil.commands.settings_said import configuration
    from tdhil.commands.stop_signals import stop_on_signals
    from tdhil.commands.unverified import accepted_lines
    from tdhil.errors import exit_code
    from tdhil.record.errors import LogError
    from tdhil.recording.log_writer import RunWriter
    from tdhil.recording.run_log import RunLog
    from tdhil.report.live import LiveDisplay
    from tdhil.run.runner import Runner

    _load_the_end(namespace.report is not None)
    place = LogPlace(Path(options.log))
    writer = RunWriter(place.wanted, epoch_ns=peer.epoch_ns, block=peer.stepped, opener=place.open,
                       modbus=connection.drive == "modbus")
    writer.path = place.path
    if place.live:
        console.print(f"another run is writing {place.wanted}: this one's log is {place.path}", style="yellow",
                      markup=False, soft_wrap=True)
    elif place.older is not None:
        console.print(f"an older {place.wanted} was kept as {place.older}", style="dim", markup=False)
    outcome = None

    def stub() -> bool:
        stopped = outcome is not None and outcome.stop is not None
        return not (place.motion or stopped)

    def confirm(task: Task, preflight: Preflight, idle: Idle) -> None:
        confirm_motion(
            task, preflight, idle, yes=options.yes, console=console, pause_display=display.pause,
            unverified=accepted_lines(connection.profile, options.accept_unverified),
        )
        place.motion = True

    said = {"operator": namespace.operator, "note": namespace.note}
    log = RunLog(writer, configuration(options, connection, peer, rig) | said)
    data = rig.drive_data if rig is not None else None
    trace = None if options.trace is None else Path(options.trace)
    say = partial(console.print, style="dim", markup=False, highlight=False)
    try:
        with stop_on_signals() as stop_request, open_drive(
            peer, options, connection, data, log.frame, trace
        ) as drive, LiveDisplay(console, show_preflight=False) as display, real_time_priority(
            namespace.real_time_priority, stepped=peer.stepped
        ) as raised:
            if raised.said:
                log.configure(real_time_priority=raised.plain())
                display.say(raised.said)
            outcome = Runner(
                drive,
                partial(_task, options, connection.profile, rig, log, say, namespace),
                log,
                stop_request,
                display,
                confirm,
                reset_fault=namespace.reset_fault,
                say=display.say,
                confirm_speed=partial(
                    confirm_speed, console=console, pause_display=display.pause,
                    gear_ratio=1.0 if rig is None else rig.gear.ratio,
                ),
            ).run()
        for fault in peer.never_came:
            with suppress(LogError):
                log.event(drive.clock.now_s(), "fault", f"--fault {fault} never came")
            console.print(f"tdhil: --fault {fault} never came: this run did not reach its moment", style="yellow",
                          markup=False, soft_wrap=True)
        code, document = _finish(outcome, log, str(place.name(stub=stub())), options.json, console)
    except BaseException:
        with suppress(LogError):  # the first cause stays the cause
            log.close()
        place.settle(stub=stub())
        raise
    try:
        if document is not None:
            print_result(document, options.json)
    finally:            # whoever should have read stdout may be gone: log and report are finished all the same
        try:
            log.close()
        except LogError as error:
            # Stdout has its one document already; and where the log was what ended the run, all is said.
            if not isinstance(outcome.cause, LogError):
                console.print(f"tdhil: {error}", style="bold red", markup=False, soft_wrap=True)
            code = code or int(exit_code(error))
        place.settle(stub=stub())
        if document is not None:
            save_report(document, log.recording(complete=True), namespace.report)      # it names the log's SHA-256
    return code


def _task(
    options: RunOptions,
    profile: Profile,
    rig: Rig | None,
    log: RunLog,
    say: Callable[[str], None],
    accepted: argparse.Namespace,
    identity: Identity,
) -> Task:
    from tdhil.cli.task import bench_of, excitation_request, facts, machine_limits
    from tdhil.commands.unverified import accepted_lines, note, require_accepted
    from tdhil.run.task import Task

    bench = bench_of(identity, rig)
    log.configure(bench=bench.model_dump(mode="json", by_alias=True), identity=asdict(identity))
    if not identity.simulated:
        require_accepted(profile, options.accept_unverified)
        log.configure(unverified=list(accepted_lines(profile, options.accept_unverified)))
    elif text := note(profile):
        say(text)
    limits = machine_limits(
        bench,
        accept_no_watchdog=accepted.accept_no_watchdog,
        accept_shared_watchdog=accepted.accept_shared_watchdog,
        accept_wider=tuple(accepted.accept_wider_limit or ()),
        accept_speed_unit=accepted.accept_speed_unit,
    )
    return Task(limits, excitation_request(options), facts(bench))


def _finish(
    outcome: RunOutcome, log: RunLog, path: str, as_json: bool, console: Console
) -> tuple[int, dict[str, Any] | None]:
    """Identify, or say what ended the run; the exit code, and the result, still to be printed, if there is one."""
    from tdhil.cli.conclude import conclude
    from tdhil.record.errors import LogError

    if outcome.cause is not None or (outcome.stop is not None and not outcome.stop.confirmed):
        return _failed(outcome, path, as_json, console), None
    with console.status("identifying …") if console.is_terminal else nullcontext():
        document, code = conclude(log.recording(complete=True), log.run, path)
    with suppress(LogError):  # a log that has just failed must not take the result with it; closing it says so
        log.result(document)
    return int(code), document


def _failed(outcome: RunOutcome, path: str, as_json: bool, console: Console) -> int:
    """The first cause, how the stop went, and where the log is."""
    import traceback

    from tdhil.errors import ExitCode, TdhilError, exit_code
    from tdhil.run.stop import not_confirmed

    cause, stop = outcome.cause, outcome.stop
    code = exit_code(cause) if cause is not None else ExitCode.OK
    if cause is not None:
        if not isinstance(cause, TdhilError):
            traceback.print_exception(cause, file=sys.stderr)
        console.print(f"tdhil: {cause}", style="bold red", markup=False, soft_wrap=True)
    said = "the drive was never enabled; nothing has moved"
    if stop is not None and stop.confirmed:
        said = f"the shaft is at rest (seen at {stop.at_rest_s:.1f} s) and the drive is disabled"
    elif stop is not None:
        loud = not_confirmed(stop)
        console.print(f"tdhil: {loud}", style="bold white on red", markup=False, soft_wrap=True)
        said = str(loud)
        # Whatever came first: a script that reads the code alone must learn that the shaft may still turn.
        code = ExitCode.STOP_NOT_CONFIRMED
    if stop is None or stop.confirmed:
        console.print(f"tdhil: {said}", markup=False, soft_wrap=True)
    console.print(f"tdhil: log: {path} (tdhil replay {path})", markup=False, soft_wrap=True)
    if as_json:
        document = {
            "error": {"kind": type(cause).__name__, "message": str(cause)} if cause is not None else None,
            "exit_code": int(code),
            "stop": said,
            "stages": [
                {"name": stage.name, "outcome": stage.outcome, "duration_s": stage.end_s - stage.start_s}
                for stage in outcome.stages
            ],
            "log": path,
        }
        print(json.dumps(document, ensure_ascii=False, indent=2))  # noqa: T201
    return int(code)


__all__ = ["add_arguments", "run"]
