"""`tdhil identify`: from a drive on the bus to a moment of inertia."""

from __future__ import annotations

import argparse
import io
import json
import math
import os
import queue
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import asdict, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from types import FrameType
from typing import IO, TYPE_CHECKING, Any

from rich.console import Console

from drivers.drive import Preflight
from drivers.errors import PreflightRefused
from drivers.preflight import ACCEPTED_BY, ANY_CLIENT, NOTHING_STOPS_IT
from profiles.quantities import RPM
from profiles.visible import visible
from tdhil import __version__
from tdhil.cli.connection import PeerPlan
from tdhil.errors import UsageError
from tdhil.report.card import minutes
from tdhil.run.settings import ExcitationRequest, MachineLimits, StopRequest
from tdhil.run.task import Idle, Task

if TYPE_CHECKING:
    from drivers.drive import Identity
    from profiles.library import Profile
    from tdhil.cli.connection import Connection
    from tdhil.config.options import RunOptions
    from tdhil.config.rig import Rig
    from tdhil.recording.run_log import RunLog
    from tdhil.run.task import RunOutcome


# ---------------------------------------------------------------------------------------------------------------------
# The typed confirmation before a real shaft moves. While it waits, the drive's watchdog is fed.


WORD = "MOVE"
SPEED_FLAG = "--accept-speed-unit"
_UNWATCHED = "  [ ] somebody stands at that stop for the whole run: nothing else stops the shaft if this host fails\n"

_SHARED = (
    "  [ ] every other client of this drive is switched off (PLC, panel, historian, gateway), and somebody stands at\n"
    "      that stop for the whole run\n"
)


def confirm_motion(
    task: Task,
    preflight: Preflight,
    idle: Idle,
    *,
    yes: bool,
    console: Console,
    pause_display: Callable[[], None],
    unverified: Sequence[str] = (),
) -> None:
    """Return if the shaft may be moved; raises PreflightRefused (exit 4) if not.

    A simulated peer needs no confirmation. ``--yes`` replaces the prompt, not the limits.
    """
    if preflight.identity.simulated:
        return
    pause_display()
    console.print(summary(preflight, task.limits, task.request, unverified), markup=False)
    if yes:
        console.print("Confirmed by --yes.")
        return
    if sys.stdin is None or not sys.stdin.isatty():
        raise PreflightRefused(
            "nobody is there to confirm that the shaft may move",
            where="no terminal",
            next_step="Run it at a terminal, or pass --yes if somebody stands at the hard-wired stop",
        )
    console.print(f"Type {WORD} and Enter to turn the shaft, anything else to leave it alone: ", end="")
    if _ask(idle).strip() != WORD:
        raise PreflightRefused("not confirmed", where="prompt", next_step="Nothing has moved")


def confirm_speed(
    speed_rad_s: float,
    why: str,
    idle: Idle,
    *,
    console: Console,
    pause_display: Callable[[], None],
    gear_ratio: float = 1.0,
) -> None:
    """Return if the operator sees the shaft turn as fast as the drive reports; PreflightRefused (exit 4) if not.

    Asked while the shaft turns, one cycle after the other; ``--yes`` is no answer to it.
    """
    turning = turns_text(speed_rad_s)
    pause_display()
    if sys.stdin is None or not sys.stdin.isatty():
        raise PreflightRefused(
            f"nobody is there to see whether the shaft turns {turning}, as the drive reports ({why})",
            where="no terminal",
            next_step="Run it at a terminal, where somebody sees the shaft; say in the profile where the drive tells"
            f" its angle (position); or take the unit of speed by name: {SPEED_FLAG}",
        )
    main = f" (the main shaft, behind the gear, {turns_text(speed_rad_s / gear_ratio)})" if gear_ratio != 1.0 else ""
    console.print(
        f"\nThe shaft turns, and {why}.\n"
        f"The drive reports {speed_rad_s:.3g} rad/s: watch a mark on the motor's shaft for some turns.",
        markup=False,
    )
    console.print(
        f"Is it turning {turning}{main}? Type yes and Enter; anything else stops it: ", end="", markup=False
    )
    answer = _ask(idle).strip().lower()
    if answer not in ("y", "yes"):
        raise PreflightRefused(
            f"the shaft was not seen to turn {turning}, as the drive reports: its unit of speed is not what the profile"
            " says",
            where="prompt",
            next_step="Check the speed scaling in the profile: how long one turn really takes, against what was asked,"
            " is the factor",
        )


def turns_text(speed_rad_s: float) -> str:
    """A speed as somebody with a watch sees it."""
    way = "forward" if speed_rad_s >= 0.0 else "backwards"
    turn_s = 2.0 * math.pi / max(abs(speed_rad_s), 1e-9)
    if turn_s >= 2.0:
        return f"{way} once every {turn_s:.3g} s"
    return f"{way} {10.0 / turn_s:.3g} times in 10 s"


def summary(
    preflight: Preflight, limits: MachineLimits, request: ExcitationRequest, unverified: Sequence[str] = ()
) -> str:
    """What will happen, and what the operator must have seen to. ``unverified``: what he took of the profile."""
    silent = f"{preflight.watchdog_s:g} s in the drive, then {preflight.safe_action.replace('_', ' ')}"
    watchdog, seen_to = (silent, "") if preflight.watched else (f"NONE, {ACCEPTED_BY}: {NOTHING_STOPS_IT}", _UNWATCHED)
    if preflight.watched and preflight.fed_by_any_client:
        watchdog, seen_to = f"{silent}; but {ANY_CLIENT}", _SHARED
    return (
        f"\nThis run will move {visible(preflight.identity.name)}:\n"
        f"  sign probe      torque up to {limits.probe_torque_nm:g} N·m, at most {limits.probe_travel_rad:g} rad\n"
        f"  speed window    {limits.speed_min_rad_s:.4g} to {limits.speed_max_rad_s:.4g} rad/s "
        f"({RPM.of_si(limits.speed_min_rad_s):.4g} to {RPM.of_si(limits.speed_max_rad_s):.4g} rpm)\n"
        f"  peak torque     {limits.torque_nm:g} N·m\n"
        f"  excitation      {request.kind}\n"
        f"  duration        at most {minutes(limits.time_s)}\n"
        f"  watchdog        {watchdog}\n"
        f"{_taken(unverified)}"
        "Before you confirm:\n"
        "  [ ] brake released\n"
        "  [ ] pipe handler and people clear of the shaft\n"
        "  [ ] hard-wired emergency stop tested and within reach (Ctrl-C stops, but is no emergency stop)\n"
        f"{seen_to}"
    )


def _taken(unverified: Sequence[str]) -> str:
    if not unverified:
        return ""
    lines = "".join(f"  {visible(one)}\n" for one in unverified)
    return f"Taken as the profile has it, although nobody verified it:\n{lines}"


def _ask(idle: Idle) -> str:
    """A line from the terminal, with a cycle of nothing again and again until it is there."""
    answers: queue.Queue[str] = queue.Queue()
    threading.Thread(target=lambda: answers.put(sys.stdin.readline()), name="prompt", daemon=True).start()
    while True:
        idle()
        try:
            return answers.get_nowait()
        except queue.Empty:
            continue


# ---------------------------------------------------------------------------------------------------------------------
# Where a run's files go: never over an older log, never into a live one, never over a file that isn't theirs.


_LARGEST_STUB = 1_000_000      # bytes; a log that holds motion is read no further than its size


class LogPlace:
    """The file of one run. ``open`` takes it; ``settle`` gives it its last name once it is closed.

    A log that another run is writing is left alone, and this one gets a name of its own. What a run that ended before
    anything moved leaves behind goes beside the last good log, which keeps its name.
    """

    def __init__(self, wanted: Path) -> None:
        self.wanted = wanted
        self.path = wanted
        self.older: Path | None = None         # where an older log was moved to
        self.live = False                      # somebody else is writing ``wanted``
        self.motion = False                    # set by whoever lets the shaft move

    def open(self, wanted: Path) -> IO[bytes]:
        """The file, held against other runs for as long as it is open. OSError, or UsageError for a foreign file."""
        with _held(wanted.parent):
            if wanted.exists() and not wanted.is_file():
                return wanted.open("wb", buffering=0)      # a device
            check_log_path(wanted)
            self.live = wanted.is_file() and is_live(wanted)
            if self.live:
                self.path = _dated(wanted, time.time())
            else:
                self.older = make_room(wanted)
            file = self.path.open("xb", buffering=0)
            _lock(file.fileno())
            return file

    def name(self, *, stub: bool) -> Path:
        """What the file will be called in the end. ``stub``: nothing moved in this run."""
        if stub and self.older is not None and not _is_stub(self.older):
            return self.wanted.with_name(f"{self.wanted.stem}.refused{self.wanted.suffix}")
        return self.path

    def settle(self, *, stub: bool) -> None:
        """Once the file is closed: a stub makes room for the older log again."""
        final = self.name(stub=stub)
        if final != self.path and self.older is not None:
            with suppress(OSError), _held(self.wanted.parent):      # nothing is lost under the names as they are
                self.path.replace(final)
                self.older.rename(self.path)
                self.path = final


def check_log_path(path: Path, where: str = "--log") -> None:
    """UsageError for a file that is no log: it would be moved aside by mistake."""
    from tdhil.recording.mcap_container import MAGIC

    if not path.is_file() or path.suffix == ".mcap":
        return
    with suppress(OSError), path.open("rb") as file:
        if file.read(5) in (b"", MAGIC[:5]):
            return
    raise UsageError("is no log; it is left as it is", where=f"{where} {path}", next_step="Name another, as run.mcap")


def check_names(paths: Mapping[str, Path | None]) -> None:
    """UsageError where two of the files that a run reads or writes are the same one; by option."""
    seen: dict[Path, str] = {}
    for option, path in paths.items():
        if path is None:
            continue
        real = path.resolve()
        if real in seen:
            raise UsageError(f"is the file of {seen[real]} too", where=f"{option} {path}", next_step="Name another")
        seen[real] = option


def make_room(path: Path) -> Path | None:
    """Move an older log at ``path`` aside, named by the time it was last written; its new place, if there was one."""
    if not path.is_file():
        return None
    older = _dated(path, path.stat().st_mtime)
    path.rename(older)
    return older


def is_live(path: Path) -> bool:
    """Is some process writing this log now? False where the system can't tell."""
    try:
        import fcntl
    except ImportError:
        try:
            path.rename(path)      # Windows renames nothing that is open
        except OSError:
            return True
        return False
    with suppress(OSError), path.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def _dated(path: Path, time_s: float) -> Path:
    stamp = time.strftime("%Y%m%d-%H%M%S", time.localtime(time_s))
    dated = path.with_name(f"{path.stem}-{stamp}{path.suffix}")
    number = 1
    while dated.exists():
        number += 1
        dated = path.with_name(f"{path.stem}-{stamp}-{number}{path.suffix}")
    return dated


def _is_stub(path: Path) -> bool:
    """Does an older log hold no motion either?"""
    from tdhil.errors import LogError
    from tdhil.recording.log_reader import read_run

    with suppress(OSError, LogError):
        return path.stat().st_size < _LARGEST_STUB and not any(
            stage.name != "setup" for stage in read_run(path).stages
        )
    return True


@contextmanager
def _held(folder: Path) -> Iterator[None]:
    """No other run chooses a name in this folder meanwhile; where the system has no such lock, nothing is held."""
    descriptor = None
    try:
        import fcntl

        with suppress(OSError):
            descriptor = os.open(folder, os.O_RDONLY)
            fcntl.flock(descriptor, fcntl.LOCK_EX)
    except ImportError:
        pass
    try:
        yield
    finally:
        if descriptor is not None:
            os.close(descriptor)


def _lock(descriptor: int) -> None:
    with suppress(ImportError, OSError):
        import fcntl

        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


# ---------------------------------------------------------------------------------------------------------------------
# `tdhil identify --simulate --fault …`: what the embedded drive shall do wrong, and when.


def with_faults(plan: PeerPlan, texts: Sequence[str] | None, drive: str) -> PeerPlan:
    """The plan with these faults. UsageError where the peer isn't ours to spoil."""
    if not texts:
        return plan
    if not plan.embedded:
        raise UsageError(
            "faults can be scripted in the embedded simulator only", where="--fault",
            next_step="Add --simulate, or give --fault to tdhil simulate",
        )
    if drive == "modbus":
        from sim_bus.modbus.faults import parse_all as parse_modbus

        return replace(plan, faults=parse_modbus(texts, "embedded"))
    from sim_bus.canopen.faults import parse_all

    return replace(plan, faults=parse_all(texts))


def list_faults() -> int:
    """Prints what there is; the exit code."""
    from sim_bus.canopen.faults import listing
    from sim_bus.modbus.faults import listing as listing_of_modbus

    print(f"--drive canopen\n\n{listing()}\n\n--drive modbus\n\n{listing_of_modbus()}")  # noqa: T201
    return 0


# ---------------------------------------------------------------------------------------------------------------------
# How a run was set up: what is printed of it, and what its log keeps.


def configuration(options: RunOptions, connection: Connection, peer: PeerPlan, rig: Rig | None) -> dict[str, Any]:
    """For the log: everything that identification needs.

    And the whole profile, so that a later decoder can start again from the raw frames.
    """
    return {
        "tdhil": __version__,
        "started": datetime.now().astimezone().isoformat(timespec="seconds"),
        "rig_file": None if rig is None or not rig.file else rig.file,
        "options": {name: {"value": value, "source": source} for name, value, source in options.rows()},
        "drive": connection.drive,
        "bus": {name: {"value": value, "source": source} for name, value, source in connection.rows()},
        "profile": connection.profile.model_dump(mode="json", by_alias=True),
        "embedded_simulator": peer.embedded,
        "stepped": peer.stepped,
        "seed": peer.seed,
        "plant": None if peer.plant is None else peer.plant.model_dump(mode="json"),
        "faults": [fault.text for fault in peer.faults],
        "identify": {"confidence": options.confidence, "tolerance": options.tolerance, "model": options.model},
        "converted": [list(row) for row in rig.conversions] if rig is not None else [],
        "reference_inertia_kg_m2": None if rig is None else rig.reference_inertia_kg_m2,
    }


def show_settings(
    console: Console, options: RunOptions, connection: Connection, peer: PeerPlan, rig: Rig | None = None
) -> None:
    """Which value came from where: everything that isn't a default; and what became of a value with a unit."""
    if peer.embedded:
        why = "as asked for" if options.simulate else connection.nothing_there
        clock = "stepped time" if peer.stepped else "real time"
        what = "Modbus drive and rig" if connection.drive == "modbus" else "drive and rig on a virtual bus"
        console.print(f"SIMULATED: embedded {what} ({why}), {clock}, seed {peer.seed}", style="magenta")
        for fault in peer.faults:
            console.print(f"SIMULATED: scripted fault {fault.text}", style="magenta", markup=False)
    else:
        for name, value, source in connection.rows():
            console.print(f"{_PREFIX[connection.drive]} {name:<10} {value}  ({source})", style="dim", markup=False)
    for name, value, source in options.rows():
        if source != "default":
            console.print(f"{name:<14} {value}  ({source})", style="dim", markup=False)
    for key, text, source in rig.conversions if rig is not None else ():
        console.print(f"{key:<14} {text}  ({source})", markup=False)


_PREFIX = {"canopen": "bus", "modbus": "line"}


# ---------------------------------------------------------------------------------------------------------------------
# Ctrl-C, SIGQUIT, SIGTERM and SIGHUP become a wish to stop, which the control loop sees in its next cycle.


_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGBREAK")  # the last three don't exist everywhere


@contextmanager
def stop_on_signals() -> Iterator[StopRequest]:
    """Handlers that only note the wish; the former ones come back afterwards. A second Ctrl-C changes nothing."""
    request = StopRequest()

    def handler(signum: int, frame: FrameType | None) -> None:
        request.ask(signum)

    known = [getattr(signal, name) for name in _NAMES if hasattr(signal, name)]
    former = {number: signal.signal(number, handler) for number in known}
    try:
        yield request
    finally:
        for number, before in former.items():
            signal.signal(number, before)


# ---------------------------------------------------------------------------------------------------------------------

def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of identify. None as a default means: rig.yaml, else the built-in default (`tdhil.config.options`)."""
    from profiles.quantities import FREQUENCY, SPEED, TIME
    from tdhil.cli.arguments import EXCITATIONS, MODELS, add_drive_arguments, add_line_arguments, amount, share

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
    from tdhil.cli.profile_text import check_names
    from tdhil.cli.task import suited
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

    from tdhil.cli import conclude  # noqa: F401
    from tdhil.estimation import identify  # noqa: F401
    from tdhil.estimation.result import Verdict  # noqa: F401
    from tdhil.report import card, document, html  # noqa: F401
    from tdhil.run import preconditions, runner, stop  # noqa: F401

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
    from tdhil.cli.profile_text import accepted_lines
    from tdhil.cli.real_time import real_time_priority
    from tdhil.errors import LogError, exit_code
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
    from tdhil.cli.profile_text import accepted_lines, note, require_accepted
    from tdhil.cli.task import bench_of, excitation_request, facts, machine_limits
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
    from tdhil.errors import LogError

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


__all__ = ["LogPlace", "add_arguments", "check_log_path", "check_names", "is_live", "make_room", "run"]
