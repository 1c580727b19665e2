"""`tdhil scan`: the drives on a bus or line, the profile of each, and a first rig.yaml.

It never writes to a drive. It requests data from every node of a bus: do not use it while another master is active.
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

from profiles import Profile, load_profile, visible
from tdhil.buses import FoundDrive, all_buses, bus_named, examples, required_text
from tdhil.cli.results import print_json
from tdhil.config import Limits, Rig, load_rig, resolve
from tdhil.errors import MessageCode, UsageError
from tdhil.session import doubtful

if TYPE_CHECKING:
    from tdhil.buses import Connection
    from tdhil.config import RunOptions


# ---------------------------------------------------------------------------------------------------------------------
# First rig.yaml: the place of the drive, and blanks for the limits.


_PLAIN = re.compile(r"[A-Za-z_./][A-Za-z0-9_./-]*")
_WORDS = {"true", "false", "null", "yes", "no", "on", "off", "y", "n", "~", ".inf", ".nan"}


def _named(name: str | None) -> list[str]:
    return ["# The rig's own name: results of one name are one history (tdhil trend).",
            "# A real drive does not move without it.",
            "#name:    # such as bench 3" if name is None else f"name: {scalar(name)}"]


def starter(found: FoundDrive, line: Mapping[str, Any], profile: Profile | None) -> str:
    """Return the file's text. ``line``: the content of the section bus: or modbus:."""
    parts = [
        "# Written by tdhil scan. Torque and speed refer to the motor shaft. All keys: docs/reference/rig.md",
        f"# Found: {_comment(found.name)}, {_comment(found.title)}; {_comment(found.identity)}"
        + (" (SIMULATED)" if found.simulated else ""),
        "",
        *_named(None),
        f"drive: {found.bus}",
    ]
    if line:
        parts.append(_section(found.bus, line))
    parts += [f"{key}: {_value(value)}" for key, value in bus_named(found.bus).rig_keys(found).items()]
    if found.profile is not None:
        parts.append(f"profile: {scalar(found.profile)}    # {_comment(found.why)}")
    else:
        parts += [f"#profile:    # {_comment(found.why)}"]
    parts += _doubts(profile)
    parts += ["", "# A real drive does not move without these. Remove the '#' and give every value of your machine."]
    parts += ["#limits:", *(_blank(name) for name in _LIMITS)]
    parts += ["", "# Facts that the drive does not report.", "#drive_data:"]
    if profile is None or profile.rated_torque_by_hand:
        parts.append("#  rated_torque_nm:         # N·m; from the name plate")
    parts.append("#  torque_scale_rel_sd:     # standard uncertainty of the torque scale (0.02 = 2 %)")
    parts += _untold(profile)
    parts += _by_hand(profile)
    return "\n".join(parts) + "\n"


def blank_rig(profile: Profile, named: str, load: str, name: str | None = None) -> str:
    """Return the file's text without a drive. ``named``: profile as named by the operator."""
    parts = [
        "# Written by tdhil rig new. Torque and speed refer to the motor shaft. All keys: docs/reference/rig.md,",
        "# whose path tdhil docs prints.",
        "# Fill in the lines with a '#'. Without 'limits' a real drive does not move.",
        "",
        *_named(name),
        f"drive: {profile.bus}",
        f"profile: {scalar(named)}    # {_comment(profile.title)}",
        "# The drive's address. Without it the embedded simulator runs.",
        *bus_named(profile.bus).rig_blank(profile),
    ]
    parts += _doubts(profile)
    parts += ["", "# A real drive does not move without these. Remove the '#' and give every value of your machine, in",
              "# the key's unit or with another unit: speed_max_rad_s: 95 rpm"]
    parts += ["#limits:", *(_blank(name) for name in _LIMITS)]
    parts += ["", *_load(load)]
    parts += ["", "#gear: {ratio: }    # motor turns per turn of the main shaft; default 1",
              "", "# Facts that the drive does not report. Omit unknown ones.", "#drive_data:"]
    if profile.rated_torque_by_hand:
        parts.append("#  rated_torque_nm:         # N·m; from the name plate")
    parts.append("#  torque_scale_rel_sd:     # standard uncertainty of the torque scale (2 %)")
    parts += _untold(profile)
    parts += _by_hand(profile)
    return "\n".join(parts) + "\n"


def to_fill_in(profile: Profile, load: str, name: str | None = None) -> list[str]:
    """Return the further entries that a run on a real drive needs."""
    found = [f"limits: {', '.join(_LIMITS)}", f"the drive's address: {bus_named(profile.bus).to_fill_in}"]
    if name is None:
        found.append("name: the rig's own name, such as bench 3")
    if load == "string":
        found.append(f"{', '.join(_STRING)}: without them the file is refused")
    if doubtful(profile):
        found.append("accept_unverified: unverified entries of this profile, after you have checked them")
    if _untold(profile):
        found.append("drive_data.parameters: values that this drive does not report over the bus")
    if _by_hand(profile):
        found.append("and at the drive: the settings at the file's end")
    return found


def _load(load: str) -> list[str]:
    if load == "none":
        return ["load: none    # as requested: no load that stores torque. With a drill string: string"]
    return ["load: string    # as requested; this file is refused until these two are filled in",
            *(f"#{name}:    # {Rig.model_fields[name].description}" for name in _STRING)]


_STRING = ("make_up_torque_nm", "torque_ramp_nm_s")
_LIMITS = tuple(name for name, field in Limits.model_fields.items() if field.is_required())


def _blank(name: str) -> str:
    return f"#  {name + ':':<24} # {Limits.model_fields[name].description}"


def _section(bus: str, line: Mapping[str, Any]) -> str:
    return f"{bus_named(bus).section}: {{{', '.join(f'{key}: {_value(value)}' for key, value in line.items())}}}"


def _value(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {_value(one)}" for key, one in value.items()) + "}"
    return scalar(value)


def scalar(value: Any) -> str:
    """Return a value as the strict reader of rig.yaml accepts it."""
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
        f"# Compare them with the drive's manual (tdhil profiles show {profile.name}), then accept them by name:",
        "#accept_unverified: []",
    ]


def _untold(profile: Profile | None) -> list[str]:
    """Return lines for the parameters that cannot be read over the bus."""
    blanks = [] if profile is None else [f"#    {one.name}:    # {_comment(one.title)}" for one in profile.untold]
    return ["#  parameters:", *blanks] if blanks else []


def _by_hand(profile: Profile | None) -> list[str]:
    required = [] if profile is None else [one for one in profile.parameters if one.require is not None]
    if not required:
        return []
    found = ["", "# Set these at the drive by hand; a run is refused until they are read:"]
    for one in required:
        assert one.require is not None
        found.append(f"# - {_comment(one.title)}: {required_text(one.require, '')}")
    return found


def _comment(text: str) -> str:
    """Return one line of printable text, for any name that a drive reports."""
    return " ".join("".join(char if char.isprintable() else " " for char in text).split())


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
        raise _there_already(namespace.write)
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


def write_new(path: Path, text: str) -> None:
    """Write a new file. Raises UsageError if it exists or can't be written."""
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise _there_already(path) from None
    except OSError as error:
        step = "Name a file in a folder that you may write to"
        raise UsageError(f"can't be written ({error.strerror or error})", where=str(path), next_step=step,
                         entry=MessageCode.FILE_NOT_WRITABLE) from error


def _there_already(path: Path) -> UsageError:
    return UsageError("already exists and was not overwritten", where=str(path), next_step="Name another file",
                      entry=MessageCode.FILE_EXISTS)


def _write(path: Path, found: tuple[FoundDrive, ...], connection: Connection, options: RunOptions) -> None:
    """Write the first rig.yaml for the only drive, or for the requested one of several."""
    one = _chosen(found, connection, options)
    if options.given("profile"):
        one = replace(one, profile=options.profile, why=f"as given: {options.source('profile')}")
    profile = load_profile(one.profile) if one.profile is not None else None
    write_new(path, starter(one, connection.bus.rig_section(one, connection), profile))
    print(f"{path}: written. Fill in its limits: until then a real drive does not move", file=sys.stderr)  # noqa: T201


def _chosen(found: tuple[FoundDrive, ...], connection: Connection, options: RunOptions) -> FoundDrive:
    named = connection.bus.wanted(connection, options)
    drives = [one for one in found if named in (None, one.address)]
    if named is None and len(drives) > 1:
        drives = [one for one in drives if one.profile is not None] or drives
    if len(drives) == 1:
        return drives[0]
    what = f"{len(drives)} drives were found" if drives else f"number {named} did not answer"
    raise UsageError(f"{what}, but a rig.yaml is for one drive", where="--write",
                     next_step=f"Select it with {connection.bus.address_flag}")
