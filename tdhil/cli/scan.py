"""`tdhil scan`: the drives on a bus or line, the profile of each, and a first rig.yaml.

It never writes to a drive. It requests data from every node of a bus: do not use it while another master is active.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from profiles import load_profile, visible
from tdhil.buses import FoundDrive, all_buses, examples
from tdhil.cli.results import print_json
from tdhil.config import load_rig, resolve
from tdhil.errors import MessageCode, UsageError, existing_file
from tdhil.session import starter

if TYPE_CHECKING:
    from tdhil.buses import Connection
    from tdhil.config import RunOptions


# ---------------------------------------------------------------------------------------------------------------------

def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of bus and line, as for identify; the scan's range, and the path of a first rig.yaml."""
    from tdhil.cli.arguments import add_drive_arguments, add_line_arguments, add_option
    from tdhil.config import OPTION

    drive = add_drive_arguments(parser)
    add_option(drive, OPTION["simulate"], help="scan the embedded simulator")
    scan = parser.add_argument_group("scan")
    for bus in all_buses():
        bus.add_scan_arguments(scan)
    scan.add_argument("--write", type=Path, metavar="rig.yaml", help="write a rig.yaml to start from; no file is "
                                                                     "overwritten")
    add_option(scan, OPTION["json"])
    add_line_arguments(parser)
    parser.set_defaults(run=run)


def run(namespace: argparse.Namespace) -> int:
    """Scan. Return 0 with an answer. Raises CommunicationLost (exit 5) without one, with the likely causes."""
    from tdhil.session import connection_of, plan_peer

    if namespace.write is not None and namespace.write.exists():
        raise existing_file(namespace.write)
    rig = load_rig(namespace.rig) if namespace.rig else None
    options, connection = connection_of(vars(namespace), rig, resolve(vars(namespace), rig))
    if not (options.simulate or connection.configured):
        raise UsageError(
            f"{connection.bus.nothing_there}", where="scan",
            next_step=f"Name a bus or line, such as {examples()}",
            entry=MessageCode.BUS_NOT_CONFIGURED,
        )
    found, remarks = connection.bus.scan(plan_peer(options, connection), connection, options, namespace)
    _print(found, remarks, namespace.json is True)
    if namespace.write is not None:
        _write(namespace.write, found, connection, options)
    return 0


def _print(found: tuple[FoundDrive, ...], remarks: list[str], as_json: bool) -> None:
    if as_json:
        print_json({"found": [asdict(one) for one in found], "remarks": remarks})
        return
    for one in found:
        print(visible(f"{one.name}: {one.title or 'no device name'}{' · SIMULATED' if one.simulated else ''}"))  # noqa: T201
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


def write_new(path: Path, text: str) -> None:
    """Write a new file. Raises UsageError if it exists or can't be written."""
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise existing_file(path) from None
    except OSError as error:
        step = "Name a file in a folder that you may write to"
        raise UsageError(f"can't be written ({error.strerror or error})", where=str(path), next_step=step,
                         entry=MessageCode.FILE_NOT_WRITABLE) from error


def _write(path: Path, found: tuple[FoundDrive, ...], connection: Connection, options: RunOptions) -> None:
    """Write the first rig.yaml for the only drive, or for the requested one of several."""
    one = _chosen(found, connection, options)
    if options.given("profile"):
        one = replace(one, profile=options.profile, why=f"as given: {options.source('profile')}")
    profile = load_profile(one.profile) if one.profile is not None else None
    write_new(path, starter(one, connection.bus.rig_section(one, connection), profile))
    print(f"{path} was written. Fill in its limits: a real drive does not move without them", file=sys.stderr)  # noqa: T201


def _chosen(found: tuple[FoundDrive, ...], connection: Connection, options: RunOptions) -> FoundDrive:
    named = connection.bus.wanted(connection, options)
    drives = [one for one in found if named in (None, one.address)]
    if named is None and len(drives) > 1:
        drives = [one for one in drives if one.profile is not None] or drives
    if len(drives) == 1:
        return drives[0]
    what = f"{len(drives)} drives were found" if drives else f"no drive with the number {named} answered"
    raise UsageError(f"{what}; a rig.yaml describes one drive", where="--write",
                     next_step=f"Select it with {connection.bus.address_flag}")
