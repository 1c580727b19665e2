"""`tdhil identify`: from a drive on the bus to a moment of inertia."""

from __future__ import annotations

import argparse
import json
import sys
from contextlib import nullcontext, suppress
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tdhil import __version__

if TYPE_CHECKING:
    from rich.console import Console

    from drivers.drive import Identity
    from tdhil.bus_options import BusConfig
    from tdhil.commands.peer import PeerPlan
    from tdhil.options import Resolved
    from tdhil.protocol.runner import RunOutcome, Task
    from tdhil.record.run_log import RunLog
    from tdhil.rig import Rig


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of identify. None as a default means: rig.yaml, else the built-in default (`tdhil.options`)."""
    from can.cli import add_bus_arguments

    from tdhil.commands.models import MODELS
    from tdhil.commands.quantities import seconds, share

    drive = parser.add_argument_group("drive")
    drive.add_argument("--drive", choices=("canopen", "modbus"), help="how the drive is spoken to (default canopen)")
    drive.add_argument("--node", type=int, metavar="N", help="CANopen node number (default: the profile's)")
    drive.add_argument("--profile", metavar="NAME", help="vendor/model, or a .yaml file (default generic/cia402)")
    drive.add_argument("--rig", type=Path, metavar="rig.yaml", help="the bench; needed to move anything real")
    drive.add_argument("--rate", dest="rate_hz", type=float, metavar="HZ", help="cycles a second (default 250)")
    drive.add_argument("--reset-fault", action="store_true", help="reset a drive that is in fault; never done unasked")
    motion = parser.add_argument_group("motion")
    motion.add_argument("--excitation", choices=("multisine", "sine", "step"), help="stage 5 (default multisine)")
    motion.add_argument("--mode", choices=("torque", "speed"), help="what the drive regulates in stage 5")
    motion.add_argument("--frequency", dest="frequency_hz", type=float, metavar="HZ", help="lowest line or the tone")
    motion.add_argument("--amplitude", dest="amplitude_rad_s", type=float, metavar="RAD_S", help="peak of the speed")
    motion.add_argument("--offset", dest="offset_rad_s", type=float, metavar="RAD_S", help="mean speed")
    motion.add_argument("--periods", type=int, metavar="N", help="periods per mean speed, settling included")
    motion.add_argument("--max-time", dest="max_time_s", type=seconds, metavar="TIME",
                        help="longest stage 5, such as 300 or 5min (default: what limits.time_s leaves)")
    motion.add_argument("--dry-run", action="store_true", help="show the plan and what to expect; nothing moves")
    motion.add_argument("--yes", action="store_const", const=True, help="no prompt before motion; limits stay")
    result = parser.add_argument_group("result")
    result.add_argument("--tolerance", type=share, metavar="SHARE",
                        help="acquire until the half-width of J's interval is this share of it, such as 1%% or 0.01")
    result.add_argument("--confidence", type=float, metavar="P", help="of the interval (default 0.95)")
    result.add_argument("--model", choices=MODELS, help="of the shaft (default auto: the simplest that fits)")
    result.add_argument("--log", metavar="run.mcap", help="where the log goes; an older one is moved aside")
    result.add_argument("--report", type=Path, metavar="report.html", help="the result with pictures, as one HTML file")
    result.add_argument("--json", action="store_const", const=True, help="one JSON document on stdout")
    simulated = parser.add_argument_group("simulated rig")
    simulated.add_argument(
        "--simulate", action="store_const", const=True, help="embedded simulator; the default without a bus"
    )
    simulated.add_argument("--plant", metavar="plant.yaml", help="other parameters of the embedded rig")
    simulated.add_argument("--seed", type=int, metavar="N", help="repeats a simulated run")
    simulated.add_argument("--real-time", action="store_const", const=True, help="against the wall clock")
    simulated.add_argument("--stepped", action="store_const", const=True, help="step a simulator on the bus by SYNC")
    simulated.add_argument("--trace", metavar="shaft.csv", help="true shaft of the embedded rig")
    add_bus_arguments(parser, group_title="CAN bus (python-can's own options)")
    parser.set_defaults(run=run)


def run(namespace: argparse.Namespace) -> int:
    """The whole path. Raises TdhilError before the drive is touched; afterwards everything ends in an exit code."""
    from tdhil.bus_options import bus_config
    from tdhil.commands.peer import plan_peer
    from tdhil.errors import UsageError
    from tdhil.options import resolve
    from tdhil.report.live import stderr_console
    from tdhil.rig import load_rig

    rig = load_rig(namespace.rig) if namespace.rig else None
    options = resolve(vars(namespace), rig)
    if options["drive"] == "modbus":
        raise UsageError("Modbus is not spoken yet", where="--drive", next_step="Use --drive canopen")
    if options["json"] is True:
        namespace.json = True
    bus = bus_config(vars(namespace), rig)
    console = stderr_console()
    if namespace.report is not None:
        from tdhil.report.html import check_report_path

        check_report_path(namespace.report, Path(options["log"]))
    if namespace.dry_run:
        from tdhil.commands.dry_run import dry_run

        return dry_run(options, rig, simulated=bool(options["simulate"]) or not bus.configured)
    peer = plan_peer(options, bus)
    _show_settings(console, options, bus, peer)
    return _run(namespace, options, bus, peer, rig, console)


def _run(
    namespace: argparse.Namespace,
    options: Resolved,
    bus: BusConfig,
    peer: PeerPlan,
    rig: Rig | None,
    console: Console,
) -> int:
    from tdhil.commands.confirm import confirm_motion
    from tdhil.commands.log_file import make_room
    from tdhil.commands.peer import open_drive
    from tdhil.commands.stop_signals import stop_on_signals
    from tdhil.errors import exit_code
    from tdhil.protocol.runner import Runner
    from tdhil.record.errors import LogError
    from tdhil.record.run_log import RunLog
    from tdhil.record.writer import RunWriter
    from tdhil.report.live import LiveDisplay

    path = Path(options["log"])
    if (older := make_room(path)) is not None:
        console.print(f"an older {path} was kept as {older}", style="dim", markup=False)
    writer = RunWriter(path, epoch_ns=peer.epoch_ns, block=peer.stepped)
    log = RunLog(writer, _configuration(options, bus, peer, rig))
    rated_nm = rig.drive_data.rated_torque_nm if rig is not None else None
    trace = None if options["trace"] is None else Path(options["trace"])
    try:
        with stop_on_signals() as stop_request, open_drive(
            peer, options, bus, rated_nm, log.frame, trace
        ) as drive, LiveDisplay(console, show_preflight=False) as display:
            outcome = Runner(
                drive,
                partial(_task, options, rig, log),
                log,
                stop_request,
                display,
                partial(confirm_motion, yes=bool(options["yes"]), console=console, pause_display=display.pause),
                reset_fault=namespace.reset_fault,
                say=partial(console.print, style="dim", markup=False, highlight=False),
            ).run()
        code = _finish(outcome, log, str(path), bool(options["json"]), console, namespace.report)
    except BaseException:
        with suppress(LogError):  # the first cause stays the cause
            log.close()
        raise
    try:
        log.close()
    except LogError as error:
        # Stdout has its one document already; and where the log was what ended the run, all is said.
        if not isinstance(outcome.cause, LogError):
            console.print(f"tdhil: {error}", style="bold red", markup=False, soft_wrap=True)
        code = code or int(exit_code(error))
    return code


def _task(options: Resolved, rig: Rig | None, log: RunLog, identity: Identity) -> Task:
    from tdhil.commands.task import bench_of, excitation_request, facts, machine_limits
    from tdhil.protocol.runner import Task

    bench = bench_of(identity, rig)
    log.configure(bench=bench.model_dump(mode="json", by_alias=True), identity=asdict(identity))
    return Task(machine_limits(bench), excitation_request(options), facts(bench))


def _finish(
    outcome: RunOutcome, log: RunLog, path: str, as_json: bool, console: Console, report: Path | None = None
) -> int:
    """Identify and print, or say what ended the run."""
    from tdhil.commands.conclude import conclude, print_result, save_report

    if outcome.cause is not None or (outcome.stop is not None and not outcome.stop.confirmed):
        return _failed(outcome, path, as_json, console)
    with console.status("identifying …") if console.is_terminal else nullcontext():
        document, code = conclude(log.recording(complete=True), log.run, path)
    log.result(document)
    print_result(document, as_json)
    save_report(document, log.recording(complete=True), report)
    return int(code)


def _failed(outcome: RunOutcome, path: str, as_json: bool, console: Console) -> int:
    """The first cause, how the stop went, and where the log is."""
    import traceback

    from drivers.errors import CommunicationLost
    from tdhil.errors import ExitCode, TdhilError, exit_code
    from tdhil.protocol.stop import not_confirmed

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
        # Without a bus nothing can be confirmed: then the lost communication is the cause and the watchdog acts.
        if not isinstance(cause, CommunicationLost):
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


def _configuration(options: Resolved, bus: BusConfig, peer: PeerPlan, rig: Rig | None) -> dict[str, Any]:
    """What the log keeps of how the run was set up; everything that identification needs is in it."""
    return {
        "tdhil": __version__,
        "options": {name: {"value": value, "source": source} for name, value, source in options.rows()},
        "bus": {name: {"value": value, "source": source} for name, value, source in bus.rows()},
        "embedded_simulator": peer.embedded,
        "stepped": peer.stepped,
        "seed": peer.seed,
        "plant": None if peer.plant is None else peer.plant.model_dump(mode="json"),
        "identify": {name: options[name] for name in ("confidence", "tolerance", "model")},
        "reference_inertia_kg_m2": None if rig is None else rig.reference_inertia_kg_m2,
    }


def _show_settings(console: Console, options: Resolved, bus: BusConfig, peer: PeerPlan) -> None:
    """Which value came from where: everything that isn't a default."""
    if peer.embedded:
        why = "as asked for" if options["simulate"] else "no CAN bus is configured"
        clock = "stepped time" if peer.stepped else "real time"
        console.print(
            f"SIMULATED: embedded drive and rig on a virtual bus ({why}), {clock}, seed {peer.seed}", style="magenta"
        )
    else:
        for name, value, source in bus.rows():
            console.print(f"bus {name:<10} {value}  ({source})", style="dim", markup=False)
    for name, value, source in options.rows():
        if source != "default":
            console.print(f"{name:<14} {value}  ({source})", style="dim", markup=False)


__all__ = ["add_arguments", "run"]
