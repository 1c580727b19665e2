"""`tdhil scan`: who is on the bus or on the line, which profile may be his, and a rig.yaml to start from.

Never writes to a drive. It asks every node of a bus: not to be done while another master is busy there.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from profiles.visible import visible

if TYPE_CHECKING:
    from tdhil.cli.connection import Connection
    from tdhil.cli.found_drive import FoundDrive
    from tdhil.cli.open_drive import PeerPlan
    from tdhil.config.options import RunOptions

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
    from tdhil.cli.connection import connection_of
    from tdhil.cli.open_drive import plan_peer
    from tdhil.config.options import resolve
    from tdhil.config.rig import load_rig
    from tdhil.errors import UsageError

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
    from drivers.errors import CommunicationLost
    from profiles.canopen import CanopenProfile
    from tdhil.cli.buses.canopen import open_can
    from tdhil.cli.buses.canopen_scan import ask_all, identify_all

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
    from tdhil.cli.buses.modbus_scan import scan_lines
    from tdhil.commands.scan_modbus import UNITS_RTU, UNITS_TCP, parse_units
    from tdhil.config.options import Origin
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
    from profiles.library import load_profile
    from tdhil.commands.scan_rig import starter
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
    from tdhil.config.options import Origin
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
    from tdhil.commands.quantities import amount

    value = amount(TIME)(text)
    if not 0.0 < value <= 60.0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a time from 0 to 60 s")
    return value
