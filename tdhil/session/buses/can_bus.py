"""The CAN bus: python-can's own options, with the source of each value.

Order: command line, rig.yaml's ``bus:``, CAN_INTERFACE, CAN_CHANNEL, CAN_BITRATE and CAN_CONFIG, python-can's files.
Among the files the last one that names an option applies, as in python-can. Values from the environment and from files
pass through python-can's own conversion, so they mean the same as there.
"""

import contextlib
import errno
import json
import os
import shutil
import socket
import subprocess
from collections.abc import Callable, Mapping
from configparser import ConfigParser
from configparser import Error as ConfigParserError
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, cast

from drivers import CommunicationLost, DataFileError, PreflightRefused, Problem
from tdhil.config import Origin, Rig, Setting, bit_rate_problem
from tdhil.errors import MessageCode, UsageError
from tdhil.session.connection import LineConfig

if TYPE_CHECKING:
    import can


_FLAGS = {
    "interface": "--interface",
    "channel": "--channel",
    "bitrate": "--bitrate",
    "fd": "--fd",
    "data_bitrate": "--data-bitrate",
    "timing": "--timing",
    "can_filters": "--filter",
}
_VARIABLES = {"interface": "CAN_INTERFACE", "channel": "CAN_CHANNEL", "bitrate": "CAN_BITRATE"}


@dataclass(frozen=True)
class BusConfig(LineConfig):
    """Each option of the bus and its origin, in python-can's order."""

    nothing_there = "no CAN bus is configured"
    simulated_text = "drive and rig on a virtual bus"

    @property
    def configured(self) -> bool:
        """Return whether an interface is named. If not, the embedded simulator is meant."""
        return self.interface is not None

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


def bus_config(cli: Mapping[str, Any], rig: Rig | None = None) -> BusConfig:
    """Return the bus from all sources; ``cli`` is the namespace that `can.cli.add_bus_arguments` filled.

    Raises UsageError and DataFileError for an unusable value. A file or variable that names a bit rate but no
    interface leaves the bus unconfigured.
    """
    settings: dict[str, Setting] = {}
    for source in (_from_cli(cli), _from_rig(rig), _from_environment(), _from_files()):
        for name, setting in source.items():
            settings.setdefault(name, setting)
    if "interface" in settings and not settings["interface"].value:
        settings.pop("interface", None)
    _check(settings)
    first = [name for name in ("interface", "channel", "bitrate") if name in settings]
    ordered = {name: settings[name] for name in (*first, *(name for name in settings if name not in first))}
    return BusConfig(MappingProxyType(ordered))


def _from_cli(cli: Mapping[str, Any]) -> dict[str, Setting]:
    found = {name: Setting.by_flag(cli[name], flag) for name, flag in _FLAGS.items() if cli.get(name) is not None}
    for name, value in (cli.get("bus_kwargs") or {}).items():
        found.setdefault(name, Setting.by_flag(value, "--bus-kwargs"))
    return found


def _from_rig(rig: Rig | None) -> dict[str, Setting]:
    if rig is None:
        return {}
    found = {}
    for name in ("interface", "channel", "bitrate"):
        if (value := getattr(rig.bus, name)) is not None:
            found[name] = Setting.by_rig(value, rig, f"bus.{name}")
    for name, value in rig.bus.options.items():
        found.setdefault(name, Setting.by_rig(value, rig, f"bus.options.{name}"))
    return found


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


def _from_files() -> dict[str, Setting]:
    """Return the options of python-can's files, section [default]. A later file overrides an earlier one."""
    from can.util import CONFIG_FILES

    found: dict[str, Setting] = {}
    for name in CONFIG_FILES:
        for option, value in _section(Path(os.path.expanduser(name))).items():  # noqa: PTH111 (as python-can does)
            found[_option(option)] = Setting(_cast(value), name, Origin.BUS_FILE)
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


def open_bus(config: BusConfig) -> "can.BusABC":
    """Return the open bus; the caller shuts it down.

    Raises UsageError without an interface. Raises PreflightRefused if the device is missing, is down, has another bit
    rate, or is not permitted. Raises CommunicationLost if a socketcand server can't be reached.
    """
    import can

    if not config.configured:
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


def check_link(config: BusConfig) -> None:
    """Raise PreflightRefused for a SocketCAN link that is down or runs at another bit rate than requested."""
    text = _read_link(config.channel)
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
    try:
        links = json.loads(text)
    except (ValueError, RecursionError):
        return True, None
    for link in links if isinstance(links, list) else []:
        if isinstance(link, dict) and link.get("ifname") == channel:
            flags = link.get("flags")
            rate: Any = link
            for key in ("linkinfo", "info_data", "bittiming", "bitrate"):
                rate = rate.get(key) if isinstance(rate, dict) else None
            return not isinstance(flags, list) or "UP" in flags, rate if isinstance(rate, int) and rate > 0 else None
    return True, None


def _read_link(channel: str) -> str | None:
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
            greeting = _greeting(probe)
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


def _greeting(probe: socket.socket) -> bytes:
    """Return the server's greeting, as far as it arrives in time."""
    found = b""
    probe.settimeout(PROBE_S)
    with contextlib.suppress(TimeoutError):
        while len(found) < len(_GREETING) and (more := probe.recv(len(_GREETING) - len(found))):
            found += more
    return found


def _explained(config: BusConfig, error: Exception) -> Exception:
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


def link_report(channel: str) -> str | None:
    """Return the text of ``ip -details -json link show`` for a SocketCAN link; None without ``ip``.

    Raises PreflightRefused if there is no such link.
    """
    return _read_link(channel)
