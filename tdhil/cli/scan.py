"""`tdhil scan`: who is on the bus or on the line, which profile may be his, and a rig.yaml to start from.

Never writes to a drive. It asks every node of a bus: not to be done while another master is busy there.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from profiles import Profile, visible
from profiles.modbus import ModbusProfile
from tdhil.cli.found_drive import FoundDrive
from tdhil.cli.profile_text import required_text
from tdhil.config import Limits, Rig
from tdhil.session import doubtful, rated_torque_is_told_by_hand

if TYPE_CHECKING:
    from tdhil.config import RunOptions
    from tdhil.session import Connection, PeerPlan


# ---------------------------------------------------------------------------------------------------------------------
# The rig.yaml to start from: where the drive was found, and the limits as blanks that somebody has to fill in.


_PLAIN = re.compile(r"[A-Za-z_./][A-Za-z0-9_./-]*")
_WORDS = {"true", "false", "null", "yes", "no", "on", "off", "y", "n", "~", ".inf", ".nan"}


def starter(found: FoundDrive, line: Mapping[str, Any], profile: Profile | None) -> str:
    """The file's text. ``line``: what the section bus: or modbus: has to say."""
    parts = [
        "# Written by tdhil scan. Torque and speed are those of the motor shaft; every key: docs/rig.md",
        f"# Found: {_comment(found.name)}, {_comment(found.title)}; {_comment(found.identity)}"
        + (" (SIMULATED)" if found.simulated else ""),
        "",
        f"drive: {found.bus}",
    ]
    if line:
        parts.append(_section(found.bus, line))
    if found.bus == "canopen":
        parts.append(f"node: {found.address}")
    if found.profile is not None:
        parts.append(f"profile: {scalar(found.profile)}    # {_comment(found.why)}")
    else:
        parts += [f"#profile:    # {_comment(found.why)}"]
    parts += _doubts(profile)
    parts += ["", "# Nothing real moves without these. Take the '#' away and give every one your machine's value."]
    parts += ["#limits:", *(_blank(name) for name in _LIMITS)]
    parts += ["", "# What the drive does not tell of itself.", "#drive_data:"]
    if profile is None or rated_torque_is_told_by_hand(profile):
        parts.append("#  rated_torque_nm:         # N·m; name plate")
    parts.append("#  torque_scale_rel_sd:     # how right the drive's torque is, 1 sd as a share (0.02 = 2 %)")
    parts += _untold(profile)
    parts += _by_hand(profile)
    return "\n".join(parts) + "\n"


def blank_rig(profile: Profile, named: str, load: str) -> str:
    """The file's text with no drive at hand. ``named``: the profile as the operator names it."""
    line = {
        "canopen": "#bus: {interface: socketcan, channel: can0, bitrate: 500k}    # python-can's own names",
        "modbus": "#modbus: {host: 192.0.2.10, unit: 1}    # or {serial: /dev/ttyUSB0, baud: 19200, parity: E}",
    }[profile.bus]
    parts = [
        "# Written by tdhil rig new. Torque and speed are those of the motor shaft; every key: docs/rig.md,",
        "# which lies where tdhil docs says.",
        "# What stands behind a '#' has yet to be filled in. Without 'limits' nothing real moves.",
        "",
        f"drive: {profile.bus}",
        f"profile: {scalar(named)}    # {_comment(profile.title)}",
        "# Where the drive is. Left out, the embedded simulator runs, and says so.",
        line,
    ]
    if profile.bus == "canopen":
        parts.append("#node:    # CANopen node number, 1 to 127")
    parts += _doubts(profile)
    parts += ["", "# Nothing real moves without these. Take the '#' away and give every one your machine's value, in",
              "# the key's unit or with a unit of its own: speed_max_rad_s: 95 rpm"]
    parts += ["#limits:", *(_blank(name) for name in _LIMITS)]
    parts += ["", *_load(load)]
    parts += ["", "#gear: {ratio: }    # motor turns for one of the main shaft; without it 1",
              "", "# What the drive does not tell of itself. Leave out what you do not know.", "#drive_data:"]
    if rated_torque_is_told_by_hand(profile):
        parts.append("#  rated_torque_nm:         # N·m; name plate")
    parts.append("#  torque_scale_rel_sd:     # how right the drive's torque is, 1 sd (2 %)")
    parts += _untold(profile)
    parts += _by_hand(profile)
    return "\n".join(parts) + "\n"


def to_fill_in(profile: Profile, load: str) -> list[str]:
    """What a run on a real drive will miss."""
    found = [f"limits: {', '.join(_LIMITS)}", "where the drive is: bus and node" if profile.bus == "canopen" else
             "where the drive is: modbus"]
    if load == "string":
        found.append(f"{', '.join(_STRING)}: until then the file is refused")
    if doubtful(profile):
        found.append("accept_unverified: what nobody verified in this profile, once you have looked it up")
    if _untold(profile):
        found.append("drive_data.parameters: what this drive doesn't tell over the bus")
    if _by_hand(profile):
        found.append("and at the drive: what stands at the file's end")
    return found


def _load(load: str) -> list[str]:
    if load == "none":
        return ["load: none    # as you said: nothing on the shaft stores torque. With a drill string: string"]
    return ["load: string    # as you said; until these two are filled in, this file is refused",
            *(f"#{name}:    # {Rig.model_fields[name].description}" for name in _STRING)]


_STRING = ("make_up_torque_nm", "torque_ramp_nm_s")
_LIMITS = tuple(name for name, field in Limits.model_fields.items() if field.is_required())


def _blank(name: str) -> str:
    return f"#  {name + ':':<24} # {Limits.model_fields[name].description}"


def _section(bus: str, line: Mapping[str, Any]) -> str:
    name = "bus" if bus == "canopen" else "modbus"
    return f"{name}: {{{', '.join(f'{key}: {_value(value)}' for key, value in line.items())}}}"


def _value(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {_value(one)}" for key, one in value.items()) + "}"
    return scalar(value)


def scalar(value: Any) -> str:
    """A value as rig.yaml's strict reader takes it back."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return str(value)
    text = str(value)
    plain = _PLAIN.fullmatch(text) and text.lower() not in _WORDS
    return text if plain else json.dumps(text, ensure_ascii=False)


def _doubts(profile: Profile | None) -> list[str]:
    names = [] if profile is None else [name for name, _ in doubtful(profile)]
    if profile is None or not names:
        return []
    return [
        f"# Not verified in this profile: {', '.join(names)}.",
        f"# Compare them with the drive's manual (tdhil profiles show {profile.name}), then take them by name:",
        "#accept_unverified: []",
    ]


def _untold(profile: Profile | None) -> list[str]:
    """Parameters that can't be read over the bus."""
    if not isinstance(profile, ModbusProfile):
        return []
    untold = [one for one in profile.parameters if one.register_ is None]
    blanks = [f"#    {one.name}:    # {_comment(one.title)}" for one in untold]
    return ["#  parameters:", *blanks] if blanks else []


def _by_hand(profile: Profile | None) -> list[str]:
    required = [] if profile is None else [one for one in profile.parameters if one.require is not None]
    if not required:
        return []
    found = ["", "# To be set at the drive by hand; a run is refused until they read so:"]
    for one in required:
        assert one.require is not None
        found.append(f"# - {_comment(one.title)}: {required_text(one.require, '')}")
    return found


def _comment(text: str) -> str:
    """One line, whatever a drive calls itself."""
    return " ".join("".join(char if char.isprintable() else " " for char in text).split())


# ---------------------------------------------------------------------------------------------------------------------

LISTEN_S = 1.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The bus or line, as for identify; what to ask, and where a starter file goes."""
    from tdhil.cli.arguments import add_drive_arguments, add_line_arguments

    drive = add_drive_arguments(parser)
    drive.add_argument("--simulate", action="store_const", const=True, help="look at the embedded simulator")
    scan = parser.add_argument_group("scan")
    scan.add_argument("--units", metavar="N-M", help="Modbus units to ask, as 1-10,247 (default 1-5; TCP: and 255)")
    scan.add_argument("--listen", type=_seconds, default=LISTEN_S, metavar="S",
                      help=f"CANopen: how long to wait for answers and heartbeats (default {LISTEN_S:g} s)")
    scan.add_argument("--write", type=Path, metavar="rig.yaml", help="a rig.yaml to start from; never over a file")
    scan.add_argument("--json", action="store_const", const=True, help="one JSON document on stdout")
    add_line_arguments(parser)
    parser.set_defaults(run=run)


def run(namespace: argparse.Namespace) -> int:
    """0 if anybody answered. Raises CommunicationLost (exit 5) if nobody did, with the likely causes."""
    from tdhil.config import load_rig, resolve
    from tdhil.errors import UsageError
    from tdhil.session import connection_of, plan_peer

    if namespace.write is not None:
        _check_free(namespace.write)
    rig = load_rig(namespace.rig) if namespace.rig else None
    options, connection = connection_of(vars(namespace), rig, resolve(vars(namespace), rig))
    if not (options.simulate or connection.configured):
        raise UsageError(
            f"{connection.nothing_there}", where="scan",
            next_step="Say where to look, such as -i socketcan -c can0, --host 192.0.2.10 or --serial /dev/ttyUSB0",
        )
    plan = plan_peer(options, connection)
    if connection.drive == "modbus":
        found, remarks = _modbus(plan, connection, namespace.units)
    else:
        found, remarks = _canopen(plan, connection, options, namespace.listen)
    _print(found, remarks, namespace.json is True)
    if namespace.write is not None:
        _write(namespace.write, found, connection, options)
    return 0


def _canopen(
    plan: PeerPlan, connection: Connection, options: RunOptions, listen_s: float
) -> tuple[tuple[FoundDrive, ...], list[str]]:
    from drivers import CommunicationLost
    from profiles.canopen import CanopenProfile
    from tdhil.cli.buses.canopen_scan import ask_all, identify_all
    from tdhil.session import open_can

    profile = connection.profile
    assert isinstance(profile, CanopenProfile)
    own = options.node if options.node is not None else profile.node
    with open_can(plan, connection, own) as bus:
        link, heard = ask_all(bus, range(1, 128), listen_s)
        found = identify_all(link, heard)
        heard.error_frames = link.error_frames
    silent = sorted(set(heard.states) - set(heard.device_types))
    remarks = [f"node {node} sends heartbeats ({heard.states[node]}) and answers no SDO" for node in silent]
    if heard.error_frames:
        remarks.append(f"{heard.error_frames} error frames came: check bit rate, termination and cable")
    if found:
        return found, remarks
    if heard.error_frames:
        what = f"no node answers, and {heard.error_frames} error frames came"
        step = "The bit rate is most likely wrong (-b): compare it with the drives'; else termination or cable"
    elif heard.frames:
        what = f"no node answers, though {heard.frames} frames were heard" + "".join(f"; {text}" for text in remarks)
        step = "Is a drive stopped by NMT, or is this a bus of another protocol? Look with candump"
    else:
        what = "no node answers, and nothing was heard"
        step = "Check that a drive is powered, the bit rate (-b), the cable and its termination (60 ohms)"
    raise CommunicationLost(what, where=link.name, next_step=step)


def _modbus(plan: PeerPlan, connection: Connection, units: str | None) -> tuple[tuple[FoundDrive, ...], list[str]]:
    from tdhil.cli.buses.modbus_scan import UNITS_RTU, UNITS_TCP, parse_units, scan_lines
    from tdhil.config import Origin
    from tdhil.errors import UsageError

    serial = connection.modbus.serial is not None and not plan.embedded
    own = str(connection.modbus.unit)
    given = connection.modbus.origin("unit") is Origin.COMMAND_LINE
    text = units or (own if given else f"{own},{UNITS_RTU if serial else UNITS_TCP}")
    try:
        asked = parse_units(text)
    except ValueError as error:
        raise UsageError(f"{error}", where="--units", next_step="Write it like 1-10,247") from None
    return scan_lines(plan, connection, asked, say=lambda line: print(line, file=sys.stderr))  # noqa: T201


def _print(found: tuple[FoundDrive, ...], remarks: list[str], as_json: bool) -> None:
    if as_json:
        document = {"found": [asdict(one) for one in found], "remarks": remarks}
        json.dump(document, sys.stdout, ensure_ascii=False, indent=2)
        sys.stdout.write("\n")
        return
    for one in found:
        print(visible(f"{one.name}: {one.title or 'without a name'}{' · SIMULATED' if one.simulated else ''}"))  # noqa: T201
        for name, text in (
            ("identity", one.identity),
            ("profile", f"{one.profile or 'none'} ({one.why})"),
            ("line", ", ".join(f"{key} {value}" for key, value in one.line.items())),
            ("seen", one.seen),
        ):
            if text:
                print(visible(f"  {name:<9} {text}"))  # noqa: T201
    for remark in remarks:
        print(visible(remark, keep="\n"))  # noqa: T201


def _check_free(path: Path) -> None:
    from tdhil.errors import UsageError

    if path.exists():
        raise UsageError("is there already, and is not written over", where=str(path), next_step="Name another file")


def _write(path: Path, found: tuple[FoundDrive, ...], connection: Connection, options: RunOptions) -> None:
    """The starter file, of the one drive that was found, or of the one asked for among several."""
    from profiles import load_profile
    from tdhil.errors import UsageError

    one = _chosen(found, connection, options)
    if options.given("profile"):
        one = replace(one, profile=options.profile, why=f"as named: {options.source('profile')}")
    profile = load_profile(one.profile) if one.profile is not None else None
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(starter(one, _line_of(one, connection), profile))
    except FileExistsError:
        _check_free(path)
        raise
    except OSError as error:
        step = "Name a file in a folder that you may write to"
        raise UsageError(f"can't be written ({error.strerror or error})", where=str(path), next_step=step) from error
    print(f"{path}: written. Fill in its limits: before that nothing real moves", file=sys.stderr)  # noqa: T201


def _chosen(found: tuple[FoundDrive, ...], connection: Connection, options: RunOptions) -> FoundDrive:
    from tdhil.config import Origin
    from tdhil.errors import UsageError

    modbus = connection.drive == "modbus"
    by_flag = modbus and connection.modbus.origin("unit") is Origin.COMMAND_LINE
    named = connection.modbus.unit if by_flag else options.node
    drives = [one for one in found if named in (None, one.address)]
    if named is None and len(drives) > 1:
        drives = [one for one in drives if one.profile is not None] or drives
    if len(drives) == 1:
        return drives[0]
    flag = "--unit" if modbus else "--node"
    what = f"{len(drives)} drives were found" if drives else f"number {named} did not answer"
    raise UsageError(f"{what}, and a rig.yaml is for one", where="--write", next_step=f"Name it with {flag}")


def _line_of(one: FoundDrive, connection: Connection) -> Mapping[str, Any]:
    """The section bus: or modbus:."""
    if one.bus == "modbus":
        return {**one.line, "unit": one.address}
    settings = {name: setting.value for name, setting in connection.bus.settings.items()}
    own = ("interface", "channel", "bitrate")
    simple = {name: value for name, value in settings.items() if isinstance(value, str | int | float | bool)}
    line: dict[str, Any] = {name: simple[name] for name in own if name in simple}
    more = {name: value for name, value in simple.items() if name not in own}
    return {**line, "options": more} if more else line


def _seconds(text: str) -> float:
    from profiles.quantities import TIME
    from tdhil.cli.arguments import amount

    value = amount(TIME)(text)
    if not 0.0 < value <= 60.0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a time from 0 to 60 s")
    return value
