"""CANopen, above its driver: options, rig.yaml, python-can, the simulated drive, scan, doctor, profile page.

The options of the bus are python-can's own, each with its source. Order: command line, rig.yaml's ``bus:``,
CAN_INTERFACE, CAN_CHANNEL, CAN_BITRATE and CAN_CONFIG, python-can's files. Among the files the last one that names an
option applies, as in python-can. Values from the environment and from files pass through python-can's own conversion,
so they mean the same as there.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import json
import math
import os
import shutil
import socket
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from configparser import ConfigParser
from configparser import Error as ConfigParserError
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, cast

from pydantic import Field

from drivers import (
    NO_WATCHDOG_FLAG,
    CommunicationLost,
    DataFileError,
    MonotonicClock,
    PreflightRefused,
    Problem,
    TdhilError,
    cia402,
)
from drivers import canopen as driver
from profiles import DataModel, Finding, Profile, load_profile, profile_names
from profiles.canopen import CanopenProfile
from profiles.quantities import BIT_RATE, TIME, read
from tdhil.buses.bus import Bus, Connection, FoundDrive, Line, Opening, PeerPlan, ProfileTable, ValueSeen, one_host
from tdhil.buses.cia402_findings import (
    drive_type,
    identity_findings,
    identity_text,
    match,
    settings_findings,
    watchdog_object,
)
from tdhil.buses.doctor_finding import DoctorFinding, Grade, attempted, bad, note, of_error, ok
from tdhil.buses.profile_text import object_table
from tdhil.config import DriveData, Origin, Rig, RunOptions, Setting
from tdhil.errors import MessageCode, UsageError

if TYPE_CHECKING:
    import can

    from drivers import Clock, Drive, Target
    from sim_bus import KnownFault
    from sim_bus.canopen import Simulator

PLAIN = "generic/cia402"
"""Profile of the simulator if none is named."""
MOST_NODES = 127
"""Highest node number (CiA 301)."""


# ---------------------------------------------------------------------------------------------------------------------
# The section bus: of rig.yaml.


CAN_BIT_RATES = (
    5_000, 10_000, 20_000, 33_000, 33_333, 47_000, 47_619, 50_000, 62_000, 62_500, 83_000, 83_300, 83_333, 95_000,
    95_238, 100_000, 125_000, 200_000, 250_000, 400_000, 500_000, 750_000, 800_000, 1_000_000,
)
"""Bit rates of CiA 301, and others that adapters offer, bit/s."""


def bit_rate_problem(bit_s: int) -> str:
    """Return the error of a CAN bit rate; '' if it is valid."""
    if bit_s in CAN_BIT_RATES:
        return ""
    if bit_s * 1000 in CAN_BIT_RATES:
        return f"{bit_s} bit/s is not a CAN bit rate; {bit_s}k is one: {bit_s * 1000}"
    nearest = min(CAN_BIT_RATES, key=lambda one: abs(math.log(one / max(bit_s, 1))))
    return f"{bit_s} bit/s is not a CAN bit rate; the nearest is {nearest}"


class CanSection(DataModel):
    """python-can's own options. Missing ones come from its environment variables and files."""

    interface: str | None = Field(default=None, min_length=1,
                                  description="type of the CAN adapter, such as socketcan, pcan or slcan")
    channel: str | int | None = Field(default=None, description="channel of the adapter, such as can0 or PCAN_USBBUS1")
    bitrate: int | None = Field(default=None, gt=0, description="bit/s; for socketcan the bit rate of the link")
    options: dict[str, str | int | float | bool] = Field(default={}, description="further options of the interface")

    @classmethod
    def contradictions(cls, values: Mapping[str, Any]) -> list[Finding]:
        """Return an invalid CAN bit rate."""
        bitrate = values.get("bitrate")
        wrong = "" if bitrate is None else bit_rate_problem(bitrate)
        return [("bitrate", wrong)] if wrong else []


# ---------------------------------------------------------------------------------------------------------------------
# The options of the bus, with the source of each value.


_FLAGS = {
    "interface": "--interface",
    "channel": "--channel",
    "bitrate": "--bitrate",
    "fd": "--fd",
    "data_bitrate": "--data-bitrate",
    "timing": "--timing",
}
_VARIABLES = {"interface": "CAN_INTERFACE", "channel": "CAN_CHANNEL", "bitrate": "CAN_BITRATE"}


@dataclass(frozen=True)
class CanLine(Line):
    """Each option of the bus and its origin, in python-can's order."""

    @property
    def interface(self) -> str | None:
        return str(self.value("interface")) if "interface" in self.settings else None

    @property
    def channel(self) -> str:
        return str(self.value("channel", ""))

    @property
    def bitrate(self) -> int | None:
        return cast("int | None", self.value("bitrate"))

    def kwargs(self) -> dict[str, Any]:
        """Return the arguments of `can.Bus`. It reads the same sources again, but finds nothing new there."""
        return {name: setting.value for name, setting in self.settings.items()}


def can_line(cli: Mapping[str, Any], rig: Rig | None = None) -> CanLine:
    """Return the bus from all sources; ``cli`` is the namespace that `can.cli.add_bus_arguments` filled.

    Raises UsageError and DataFileError for an unusable value. A file or variable that names a bit rate but no
    interface leaves the bus unconfigured.
    """
    from can.util import CONFIG_FILES

    settings = {name: Setting.by_flag(cli[name], flag) for name, flag in _FLAGS.items() if cli.get(name) is not None}
    for name, value in (cli.get("bus_kwargs") or {}).items():
        settings.setdefault(name, Setting.by_flag(value, "--bus-kwargs"))
    if rig is not None:
        section = CANOPEN.section_of(rig)
        for name in ("interface", "channel", "bitrate"):
            if (value := getattr(section, name)) is not None:
                settings.setdefault(name, Setting.by_rig(value, rig, f"bus.{name}"))
        for name, value in section.options.items():
            settings.setdefault(name, Setting.by_rig(value, rig, f"bus.options.{name}"))
    files: dict[str, Setting] = {}      # of python-can, section [default]; a later file overrides an earlier one
    environment = _from_environment()
    for path in CONFIG_FILES:
        for option, value in _section(Path(os.path.expanduser(path))).items():  # noqa: PTH111 (as python-can does)
            files[_option(option)] = Setting(_cast(value), path, Origin.BUS_FILE)
    for name, setting in (*environment.items(), *files.items()):
        settings.setdefault(name, setting)
    if "interface" in settings and not settings["interface"].value:
        settings.pop("interface", None)
    _check(settings)
    first = [name for name in ("interface", "channel", "bitrate") if name in settings]
    ordered = {name: settings[name] for name in (*first, *(name for name in settings if name not in first))}
    return CanLine(MappingProxyType(ordered))


def _from_environment() -> dict[str, Setting]:
    found = {
        name: Setting(_cast(value), key, Origin.BUS_FILE)
        for name, key in _VARIABLES.items() if (value := os.environ.get(key))
    }
    text = os.environ.get("CAN_CONFIG")
    if text is None:
        return found
    try:
        more = json.loads(text)
    except (ValueError, RecursionError):
        more = None
    if not isinstance(more, dict):
        step = 'Write it like {"interface": "socketcan"}, or unset it'
        raise UsageError("not a JSON object", where="CAN_CONFIG", next_step=step, entry=MessageCode.BUS_OPTIONS_WRONG)
    for name, value in more.items():
        found.setdefault(_option(name), Setting(_cast(value), "CAN_CONFIG", Origin.BUS_FILE))
    return found


def _section(path: Path) -> dict[str, str]:
    config = ConfigParser()
    config.optionxform = _as_written  # type: ignore[assignment,method-assign]
    try:
        config.read(path)
        return dict(config.items("default")) if config.has_section("default") else {}
    except (ConfigParserError, UnicodeDecodeError) as error:
        line = getattr(error, "lineno", None) or next((number for number, _ in getattr(error, "errors", ())), 0)
        message = f"not a python-can configuration ({str(error).splitlines()[0]})"
        raise DataFileError((Problem(str(path), line, message),)) from None


def _as_written(option: str) -> str:
    return option


def _option(name: str) -> str:
    return "interface" if name == "bustype" else name      # python-can's old name for it


def _cast(value: Any) -> Any:
    from can.util import cast_from_string

    cast: Callable[[str], Any] = cast_from_string
    return cast(value) if isinstance(value, str) else value


def _check(settings: dict[str, Setting]) -> None:
    import can

    if (chosen := settings.get("interface")) and chosen.value not in can.VALID_INTERFACES:
        raise UsageError(
            f"python-can knows no interface '{chosen.value}'",
            where=chosen.source,
            next_step=f"It knows {', '.join(sorted(can.VALID_INTERFACES))}",
            entry=MessageCode.BUS_OPTIONS_WRONG,
        )
    for name in ("bitrate", "port"):
        if (given := settings.get(name)) and (not isinstance(given.value, int) or given.value <= 0):
            raise UsageError(f"{name} must be a positive whole number, not {given.value!r}", where=given.source,
                             entry=MessageCode.BUS_OPTIONS_WRONG)
    if (given := settings.get("bitrate")) and (wrong := bit_rate_problem(given.value)):
        raise UsageError(f"bitrate {wrong}", where=given.source, entry=MessageCode.BUS_OPTIONS_WRONG)


# ---------------------------------------------------------------------------------------------------------------------
# Open the bus. If that fails, report the cause and the next step in place of python-can's traceback.
#
# On socketcan the kernel's link has the bit rate and ``-b`` has no effect: the link is read, and a mismatch refused.


PROBE_S = 2.0
"""Time in which a socketcand server must answer a connection, s. python-can would wait 10 s in a busy loop."""

_GREETING = b"< hi >"


def open_bus(config: CanLine) -> can.BusABC:
    """Return the open bus; the caller shuts it down.

    Raises UsageError without an interface. Raises PreflightRefused if the device is missing, is down, has another bit
    rate, or is not permitted. Raises CommunicationLost if a socketcand server can't be reached.
    """
    import can

    if config.interface is None:
        raise UsageError("no CAN interface", next_step="Name one, such as -i socketcan -c can0, or use --simulate",
                         entry=MessageCode.BUS_NOT_CONFIGURED)
    arguments = config.kwargs()
    if config.interface == "socketcan" and not config.channel:
        raise UsageError("socketcan needs a channel", next_step="Name one, such as -c can0",
                         entry=MessageCode.BUS_NOT_CONFIGURED)
    if config.interface == "socketcan":
        check_link(config)
    elif config.interface == "socketcand":
        arguments.setdefault("tcp_tune", True)     # without it Nagle and delayed ACK leave 22 cycles a second
        _probe_server(arguments)
    try:
        return can.Bus(**arguments)
    except Exception as error:      # each backend raises what its library raises
        raise _explained(config, error) from error


def check_link(config: CanLine) -> None:
    """Raise PreflightRefused for a SocketCAN link that is down or runs at another bit rate than requested."""
    text = read_link(config.channel)
    if text is None:
        return
    up, bitrate = parse_link(text, config.channel)
    wanted = config.bitrate
    rate = wanted or bitrate or 500_000
    # A virtual link has neither a bit rate nor a way to set one.
    setting = f" type can bitrate {rate}" if bitrate is not None or not config.channel.startswith("vcan") else ""
    set_up = f"sudo ip link set {config.channel} up{setting}"
    if not up:
        raise PreflightRefused("the CAN link is down", where=config.channel, next_step=f"Run: {set_up}",
                               entry=MessageCode.BUS_UNUSABLE)
    if wanted is not None and bitrate is not None and wanted != bitrate:
        raise PreflightRefused(
            f"the CAN link runs at {bitrate} bit/s, but {config.source('bitrate')} requests {wanted} bit/s",
            where=config.channel,
            next_step=f"Check the bit rate of the drive. To change the link: "
            f"sudo ip link set {config.channel} down && {set_up}",
            entry=MessageCode.BIT_RATE_DIFFERS,
        )


def parse_link(text: str, channel: str) -> tuple[bool, int | None]:
    """Return (link is up, bit rate in bit/s or None) from ``ip -details -json link show``.

    Unexpected text counts as up and without a rate: opening the bus will show the cause.
    """
    link = _link(text, channel)
    if link is None:
        return True, None
    flags, rate = link.get("flags"), _below(link, "linkinfo", "info_data", "bittiming").get("bitrate")
    return not isinstance(flags, list) or "UP" in flags, rate if isinstance(rate, int) and rate > 0 else None


def read_link(channel: str) -> str | None:
    """Return the report of ``ip`` on the link; None without ``ip``. Raises PreflightRefused for a missing link."""
    command = shutil.which("ip", path="/usr/sbin:/sbin:/usr/bin:/bin")
    if command is None:
        return None
    try:
        done = subprocess.run(
            [command, "-details", "-json", "link", "show", "dev", channel],
            capture_output=True, text=True, timeout=5, check=False,
        )
    except (OSError, subprocess.TimeoutExpired, ValueError):
        return None
    if done.returncode and "does not exist" in done.stderr:
        raise _no_device(channel)
    return done.stdout if done.returncode == 0 else None


def _no_device(channel: str) -> PreflightRefused:
    step = "List the devices: ip link show type can. Is the adapter plugged in and its kernel module loaded?"
    if channel.startswith("vcan"):
        step = f"Create it: sudo ip link add dev {channel} type vcan && sudo ip link set {channel} up"
    return PreflightRefused("no such CAN device", where=channel or "channel", next_step=step,
                            entry=MessageCode.BUS_UNUSABLE)


def _probe_server(arguments: dict[str, Any]) -> None:
    for name in ("channel", "host", "port"):
        if arguments.get(name) in (None, ""):
            raise UsageError(
                f"socketcand needs '{name}'",
                next_step="Give it, for example -i socketcand -c can0 --bus-kwargs host=127.0.0.1 port=29536",
                entry=MessageCode.BUS_NOT_CONFIGURED,
            )
    host, port = str(arguments["host"]), arguments["port"]
    try:
        with socket.create_connection((host, port), timeout=PROBE_S) as probe:
            greeting = b""      # as far as it arrives in time
            probe.settimeout(PROBE_S)
            with contextlib.suppress(TimeoutError):
                while len(greeting) < len(_GREETING) and (more := probe.recv(len(_GREETING) - len(greeting))):
                    greeting += more
    except (OSError, OverflowError, UnicodeError) as error:
        raise CommunicationLost(
            f"no socketcand server answers ({error})",
            where=f"{host}:{port}",
            next_step=f"Is it started? Is the port right? Does a firewall block it? Try: nc -vz {host} {port}",
            entry=MessageCode.SERVER_UNREACHABLE,
        ) from error
    if greeting != _GREETING:      # python-can would wait for it for ever
        raise CommunicationLost(
            "the program at this address is not a socketcand server", where=f"{host}:{port}",
            next_step="Check host and port",
            entry=MessageCode.SERVER_UNREACHABLE,
        )


def _explained(config: CanLine, error: Exception) -> Exception:
    """Return an error with the likely cause, from the error number below python-can's wrapping if there is one."""
    where = f"{config.interface} {config.channel}".strip()
    number = _number(error)
    if number in {errno.ENODEV, errno.ENOENT, errno.ENXIO}:
        if config.interface == "socketcan":
            return _no_device(config.channel)
        return PreflightRefused("no such device", where=where, next_step="Is the adapter plugged in? Check -c",
                                entry=MessageCode.BUS_UNUSABLE)
    if number in {errno.EACCES, errno.EPERM}:
        step = "Give your user the right: sudo usermod -aG dialout $USER (serial adapters), then log in again"
        return PreflightRefused("permission denied", where=where, next_step=step, entry=MessageCode.BUS_UNUSABLE)
    if number == errno.EBUSY:
        return PreflightRefused("in use by another program", where=where, next_step="End it, then try again",
                                entry=MessageCode.BUS_UNUSABLE)
    if number in {errno.EAFNOSUPPORT, errno.EPROTONOSUPPORT}:
        step = "Load it: sudo modprobe can_raw. Without it, use an adapter through python-can, or socketcand"
        return PreflightRefused("this kernel has no SocketCAN", where=where, next_step=step,
                                entry=MessageCode.BUS_UNUSABLE)
    if isinstance(error, ImportError | NotImplementedError):
        step = "Install the vendor's driver and the Python package that python-can's manual names for it"
        return UsageError(f"the interface can't be used here ({error})", where=where, next_step=step,
                          entry=MessageCode.BUS_OPTIONS_WRONG)
    if isinstance(error, TypeError | ValueError):
        return UsageError(f"the interface refuses its options ({error})", where=where, next_step="Check its options",
                          entry=MessageCode.BUS_OPTIONS_WRONG)
    if config.interface == "socketcand":
        step = "Is the channel name one that the server offers?"
        return CommunicationLost(f"the socketcand server refused the connection ({error})", where=where, next_step=step,
                                 entry=MessageCode.SERVER_UNREACHABLE)
    return PreflightRefused(f"can't be opened ({error})", where=where, next_step="Check the adapter, its driver and -c",
                            entry=MessageCode.BUS_UNUSABLE)


def _number(error: BaseException | None) -> int | None:
    while error is not None:
        if isinstance(error, OSError) and error.errno is not None:
            return error.errno
        error = error.__cause__ or error.__context__
    return None


# ---------------------------------------------------------------------------------------------------------------------
# The command line, and the drive on its bus.


_ADAPTER = ("host", "port", "serial", "unique_hardware_id", "app_name")     # they identify the adapter


_OPTIONS: Final = {
    "channel": ("NAME", "channel of the adapter, such as can0"),
    "interface": ("NAME", "kind of adapter, such as socketcan, pcan or vector; on EtherCAT the network interface"),
    "bitrate": ("BIT_S", "bit rate, such as 500000 or 500k; on socketcan the link has it"),
}
"""Metavar and help of those options of python-can that most runs need."""


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add python-can's own options."""
    from can.cli import add_bus_arguments

    add_bus_arguments(parser, group_title="CAN bus (python-can's own options)")
    for action in parser._actions:  # python-can's own type does not accept 500k
        if action.dest in ("bitrate", "data_bitrate"):
            action.type = _bit_rate
        if action.dest == "interface":  # `_check` knows python-can's; on another bus it is a network interface
            action.choices = None
        if (named := _OPTIONS.get(action.dest)) is not None:
            action.metavar, action.help = named


def _line(cli: Mapping[str, Any], rig: Rig | None, profile: Profile) -> CanLine:
    return can_line(cli, rig)


def _address(options: RunOptions, connection: Connection) -> str | None:
    """Return adapter, channel and node. None for python-can's virtual bus, which exists only in this process."""
    config = line_of(connection)
    if config.interface == "virtual":
        return None
    named = {name: str(config.value(name)) for name in _ADAPTER if name in config.settings}
    if "host" in named:
        named["host"] = one_host(named["host"])
    words = (f"canopen {config.interface} {config.channel}", *map(" ".join, named.items()))
    return " ".join((*words, f"node {node_of(options, connection)}"))


@contextmanager
def _open(asked: Opening) -> Iterator[Drive]:
    """Open the bus and the drive on it. The bus is shut down afterwards."""
    from drivers.undo_journal import UndoJournal

    plan, options, connection = asked.plan, asked.options, asked.connection
    profile, node = profile_of(connection), node_of(options, connection)
    with open_can(plan, connection, node, asked.trace) as channel:
        yield driver.CanopenDrive(
            channel,
            profile,
            asked.clock,
            node=node,
            rate_hz=options.rate_hz,
            rated_torque_nm=rated_torque_nm(plan, profile, asked.data),
            tap=asked.tap,
            journal=None if plan.embedded else UndoJournal(plan.left_in or Path(options.log).parent, f"node{node}"),
        )


@contextmanager
def _open_target(options: RunOptions, connection: Connection, clock: Clock) -> Iterator[Target]:
    """Open the bus and the node alone."""
    bus = open_bus(line_of(connection))
    target = driver.CanopenTarget(bus, profile_of(connection), clock, node=node_of(options, connection))
    try:
        yield target
    finally:
        target.close()


def _parse_faults(texts: Sequence[str]) -> tuple[Any, ...]:
    from sim_bus.canopen import parse_all

    return parse_all(texts)


def _faults() -> tuple[KnownFault, ...]:
    from sim_bus.canopen import listed

    return listed()


def _fault_listing(width: int) -> str:
    from sim_bus.canopen import listing

    return listing(width)


def _bit_rate(text: str) -> int:
    try:
        return int(read(text, BIT_RATE))
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text[:60]!r}: {error}") from None


def profile_of(connection: Connection) -> CanopenProfile:
    """Return the drive's profile."""
    assert isinstance(connection.profile, CanopenProfile)
    return connection.profile


def line_of(connection: Connection) -> CanLine:
    """Return the CAN bus."""
    assert isinstance(connection.line, CanLine)
    return connection.line


def node_of(options: RunOptions, connection: Connection) -> int:
    """Return the node that the options, or else the profile, name."""
    return options.node if options.node is not None else profile_of(connection).node


def rated_torque_nm(plan: PeerPlan, profile: CanopenProfile, data: DriveData) -> float | None:
    """Return rig.yaml's rated torque; for a simulated motor without one, the plant's."""
    if data.rated_torque_nm is None and plan.embedded and profile.rated_torque_by_hand:
        return float(plan.plant.drive.rated_torque_nm)
    return data.rated_torque_nm


@contextmanager
def open_can(plan: PeerPlan, connection: Connection, node: int, trace: Path | None = None) -> Iterator[can.BusABC]:
    """Open the bus, with the simulated drive on it if requested. It is shut down afterwards."""
    with ExitStack() as stack:
        if plan.embedded:
            simulator, channel = _embedded(stack, plan, connection, node, trace)
            # Before the simulator continues alone to its end: what happens then is not part of the run.
            stack.callback(lambda: plan.never_came.extend(simulator.faults_waiting))
        else:
            channel = open_bus(line_of(connection))
        stack.callback(channel.shutdown)
        yield channel


def _embedded(
    stack: ExitStack, plan: PeerPlan, connection: Connection, node: int, trace: Path | None
) -> tuple[Simulator, can.BusABC]:
    """Return the simulator and the host's bus to it. A stepped one runs in this thread, else in its own thread."""
    worn = None if connection.profile.name == PLAIN else profile_of(connection)
    if plan.stepped:
        from sim_bus.canopen import InlineSimulator

        inline = stack.enter_context(
            InlineSimulator(plan.plant, node_id=node, seed=plan.seed or 0, trace=trace, profile=worn,
                            faults=plan.faults)
        )
        return inline.simulator, inline.bus
    import can

    from sim_bus.canopen import EmbeddedSimulator

    simulated = stack.enter_context(
        EmbeddedSimulator(plan.plant, node_id=node, seed=plan.seed or 0, trace=trace, stepped=False, profile=worn,
                          faults=plan.faults)
    )
    return simulated.simulator, can.Bus(interface="virtual", channel=simulated.channel)


# ---------------------------------------------------------------------------------------------------------------------
# Scan. It reads only.


def identify_all(link: driver.CanLink, heard: driver.Heard) -> tuple[FoundDrive, ...]:
    """Return name and profile of every node that answered."""
    profiles = [profile for name in profile_names() if isinstance(profile := load_profile(name), CanopenProfile)]
    return tuple(_identify(link, node, heard, profiles) for node in sorted(heard.device_types))


def _identify(link: driver.CanLink, node: int, heard: driver.Heard, profiles: list[CanopenProfile]) -> FoundDrive:
    found = cia402.describe(driver.SdoObjects(link, node))
    profile, why = match(heard.device_types[node], found.identity[:3], profiles)
    return FoundDrive("canopen", node, found.title, identity_text(found.identity) or "not reported (1018h)",
                      found.simulated, profile, why, heard.states.get(node, ""))


LISTEN_S = 1.0


def _add_scan_arguments(scan: argparse._ArgumentGroup) -> None:
    """Add the option for the listening time."""
    scan.add_argument("--listen", type=_seconds, default=LISTEN_S, metavar="S",
                      help=f"CANopen: time to wait for answers and heartbeats (default {LISTEN_S:g} s)")


def _seconds(text: str) -> float:
    try:
        value = read(text, TIME)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text[:60]!r}: {error}") from None
    if not 0.0 < value <= 60.0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a time from 0 to 60 s")
    return value


def _wanted(connection: Connection, options: RunOptions) -> int | None:
    """Return the node of --node or rig.yaml."""
    return options.node


def _scan(
    plan: PeerPlan, connection: Connection, options: RunOptions, asked: argparse.Namespace
) -> tuple[tuple[FoundDrive, ...], list[str]]:
    """Return the nodes that answer SDO requests, and remarks on the others."""
    with open_can(plan, connection, node_of(options, connection)) as bus:
        link, heard = driver.ask_all(bus, range(1, MOST_NODES + 1), asked.listen)
        found = identify_all(link, heard)
        heard.error_frames = link.error_frames
    silent = sorted(set(heard.states) - set(heard.device_types))
    remarks = [f"node {node} sends heartbeats ({heard.states[node]}) but answers no SDO request" for node in silent]
    if heard.error_frames:
        remarks.append(f"{heard.error_frames} error frames were received: check bit rate, termination and cable")
    if found:
        return found, remarks
    if heard.error_frames:
        what = f"no node answers, and {heard.error_frames} error frames were received"
        step = "The bit rate is most likely wrong (-b): compare it with the drives'; else termination or cable"
    elif heard.frames:
        what = f"no node answers, but {heard.frames} frames were received" + "".join(f"; {one}" for one in remarks)
        step = "Check with candump whether a drive is stopped by NMT, or the bus uses another protocol"
    else:
        what = "no node answers, and no frame was received"
        step = "Check that a drive is powered, the bit rate (-b), the cable and its termination (60 ohms)"
    raise CommunicationLost(what, where=link.name, next_step=step, entry=MessageCode.BUS_FAILED)


# ---------------------------------------------------------------------------------------------------------------------
# Doctor: link, bus state, reach, identity, watchdog, modes, state. It reads only.


_STATES: dict[str, tuple[Grade, str]] = {
    "ERROR-ACTIVE": ("ok", ""),
    "ERROR-WARNING": ("note", "Errors add up: check bit rate, termination (60 ohms between CAN_H and CAN_L) and cable"),
    "ERROR-PASSIVE": ("bad", "Check bit rate, termination (60 ohms between CAN_H and CAN_L), and other nodes"),
    "BUS-OFF": ("bad", "Correct cable or bit rate, then: sudo ip link set {0} down && sudo ip link set {0} up"),
    "STOPPED": ("bad", "Read the bit rate at the drive. Then: sudo ip link set {0} up type can bitrate RATE"),
}
_UNKNOWN_STATE: tuple[Grade, str] = ("note", "")


def link_findings(text: str | None, channel: str) -> Iterator[DoctorFinding]:
    """Yield findings from ``ip -details -json link show`` for a SocketCAN link; ``text`` is None without ``ip``."""
    link = _link(text, channel)
    if link is None:
        yield note("link", f"{channel}: can't be read (no ip, or no answer)", "Try: ip -details link show " + channel)
        return
    data = _below(link, "linkinfo", "info_data")
    rate = _below(data, "bittiming").get("bitrate")
    yield ok("bit rate", f"{rate} bit/s, set in the link") if rate else note("bit rate", f"{channel} has none")
    state = data.get("state")
    if isinstance(state, str):
        grade, step = _STATES.get(state, _UNKNOWN_STATE)
        yield DoctorFinding(grade, "bus state", state, step.format(channel))
    counters = _below(data, "berr_counter")
    if counters:
        sent, received = counters.get("tx", 0), counters.get("rx", 0)
        text = f"errors sent {sent}, received {received} (128 is error-passive)"
        clean = sent == 0 and received == 0
        yield ok("error counters", text) if clean else note(
            "error counters", text, "Check whether they grow: ip -details -statistics link show " + channel
        )


def rate_finding(bitrate: int | None, source: str) -> DoctorFinding:
    """Return the finding for an adapter that sets the bit rate itself."""
    if bitrate is None:
        return note("bit rate", "not given: the interface's own default", "Give the bus's with -b, such as -b 500000")
    return ok("bit rate", f"{bitrate} bit/s ({source})")


def drive_findings(
    bus: can.BusABC, profile: CanopenProfile, node: int, rated_torque_nm: float | None
) -> Iterator[DoctorFinding]:
    """Yield findings on the drive. Raises CommunicationLost if it does not answer; nothing is written."""
    link = driver.CanLink(bus, MonotonicClock())
    objects = driver.SdoObjects(link, node)
    try:
        device = objects.read(0x1000)
    except CommunicationLost as error:
        if not link.error_frames:
            raise
        yield bad("drive", f"{error.what}, and {link.error_frames} error frames were received",
                  "The bit rate is most likely wrong: compare it with the drive's; check cable and termination")
        return
    yield drive_type(f"node {node}", device)
    yield from identity_findings(objects, profile)
    yield from _watchdog(objects, profile)
    yield from settings_findings(objects, profile, rated_torque_nm)
    if link.error_frames:
        yield note("error frames", f"{link.error_frames} received", "Check bit rate, termination and cable")


def _watchdog(objects: driver.SdoObjects, profile: CanopenProfile) -> Iterator[DoctorFinding]:
    dog = profile.watchdog
    if dog.kind == "none":
        yield bad("watchdog", f"profile {profile.name} names none",
                  f"If the host fails, the shaft keeps turning: identify accepts this only with {NO_WATCHDOG_FLAG}")
        return
    wanted = [(0x100C, 0), (0x100D, 0)] if dog.kind == "node_guarding" else [(dog.consumer_index, dog.consumer_sub)]
    if dog.reaction_index is not None:
        wanted.append((dog.reaction_index, dog.reaction_sub))
    for at in wanted:
        yield watchdog_object(objects, *at)


def _link(text: str | None, channel: str) -> dict[str, Any] | None:
    try:
        links = json.loads(text or "")
    except (ValueError, RecursionError):
        return None
    found = links if isinstance(links, list) else []
    return next((one for one in found if isinstance(one, dict) and one.get("ifname") == channel), None)


def _below(data: dict[str, Any], *keys: str) -> dict[str, Any]:
    """Return the section below these keys; empty if there is none."""
    found: Any = data
    for key in keys:
        found = found.get(key) if isinstance(found, dict) else None
    return found if isinstance(found, dict) else {}


def _findings(
    plan: PeerPlan, connection: Connection, options: RunOptions, rig: Rig | None, seen: list[ValueSeen]
) -> Iterator[DoctorFinding]:
    """Yield findings on link or bit rate, adapter and drive."""
    profile, bus = profile_of(connection), line_of(connection)
    node = node_of(options, connection)
    if not plan.embedded and bus.interface == "socketcan" and bus.channel:
        found = attempted("link", lambda: link_findings(read_link(bus.channel), bus.channel))
        yield from found
        if found and found[-1].name == "link" and found[-1].grade == "bad":
            return                                     # the link does not exist: opening it would report the same
    elif not plan.embedded:
        yield rate_finding(bus.bitrate, bus.source("bitrate"))
    try:
        with open_can(plan, connection, node) as channel:
            yield ok("adapter", f"opened: {channel.channel_info}")
            data = rig.drive_data if rig is not None else DriveData()
            rated_nm = rated_torque_nm(plan, profile, data)
            yield from attempted("drive", lambda: drive_findings(channel, profile, node, rated_nm))
    except TdhilError as error:
        yield of_error("adapter", error)


# ---------------------------------------------------------------------------------------------------------------------
# rig.yaml for a drive that was found, and the page of a profile.


def _rig_section(found: FoundDrive, connection: Connection) -> Mapping[str, Any]:
    """Return python-can's options in force."""
    settings = {name: setting.value for name, setting in connection.line.settings.items()}
    own = ("interface", "channel", "bitrate")
    simple = {name: value for name, value in settings.items() if isinstance(value, str | int | float | bool)}
    line: dict[str, Any] = {name: simple[name] for name in own if name in simple}
    more = {name: value for name, value in simple.items() if name not in own}
    return {**line, "options": more} if more else line


def _rig_keys(found: FoundDrive) -> Mapping[str, Any]:
    """Return the node."""
    return {"node": found.address}


def _rig_blank(profile: Profile) -> tuple[str, ...]:
    """Return blank lines for bus and node."""
    return ("#bus: {interface: socketcan, channel: can0, bitrate: 500k}    # python-can's own names",
            "#node:    # CANopen node number, 1 to 127")


def _profile_tables(profile: CanopenProfile) -> Iterator[ProfileTable]:
    """Yield the objects beyond those of CiA 402."""
    if profile.parameters:
        yield object_table(profile.parameters)


# ---------------------------------------------------------------------------------------------------------------------

CANOPEN = Bus(
    name="canopen",
    title="CANopen",
    named_by="--interface and --channel, and --node",
    examples=("-i socketcan -c can0",),
    nothing_there="no CAN bus is configured",
    simulated_text="drive and rig on a virtual bus",
    address_word="node",
    address_flag="--node",
    to_fill_in="bus and node",
    flags=MappingProxyType({
        "node": "--node", "interface": "--interface", "channel": "--channel", "bitrate": "--bitrate",
    }),
    common_flags=frozenset({"--channel", "--interface", "--bitrate"}),
    place=("interface",),
    default_profile=PLAIN,
    add_arguments=_add_arguments,
    line=_line,
    line_type=CanLine,
    address=_address,
    section="bus",
    section_model=CanSection,
    place_keys="interface, channel",
    rig_section=_rig_section,
    rig_keys=_rig_keys,
    rig_blank=_rig_blank,
    open=_open,
    open_target=_open_target,
    steps_over_a_wire=True,
    frame_topic="/can",
    parse_faults=_parse_faults,
    faults=_faults,
    fault_listing=_fault_listing,
    scan=_scan,
    add_scan_arguments=_add_scan_arguments,
    wanted=_wanted,
    findings=_findings,
    libraries=MappingProxyType({"python-can": (4, 6), "canopen": (2, 4)}),
    variables=tuple(_VARIABLES.values()),
    profile_tables=_profile_tables,
)
