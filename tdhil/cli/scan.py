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

from profiles import Profile, load_profile, visible
from tdhil.cli.profile_text import required_text
from tdhil.cli.results import print_json
from tdhil.cli.scan_common import FoundDrive, bus_commands
from tdhil.config import BUSES, Limits, Rig, load_rig, resolve
from tdhil.errors import UsageError
from tdhil.session import bus_kind, doubtful

if TYPE_CHECKING:
    from tdhil.config import RunOptions
    from tdhil.session import Connection


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
    parts += [f"{key}: {_value(value)}" for key, value in bus_commands(found.bus).keys(found).items()]
    if found.profile is not None:
        parts.append(f"profile: {scalar(found.profile)}    # {_comment(found.why)}")
    else:
        parts += [f"#profile:    # {_comment(found.why)}"]
    parts += _doubts(profile)
    parts += ["", "# Nothing real moves without these. Take the '#' away and give every one your machine's value."]
    parts += ["#limits:", *(_blank(name) for name in _LIMITS)]
    parts += ["", "# What the drive does not tell of itself.", "#drive_data:"]
    if profile is None or profile.rated_torque_by_hand:
        parts.append("#  rated_torque_nm:         # N·m; name plate")
    parts.append("#  torque_scale_rel_sd:     # how right the drive's torque is, 1 sd as a share (0.02 = 2 %)")
    parts += _untold(profile)
    parts += _by_hand(profile)
    return "\n".join(parts) + "\n"


def blank_rig(profile: Profile, named: str, load: str) -> str:
    """The file's text with no drive at hand. ``named``: the profile as the operator names it."""
    parts = [
        "# Written by tdhil rig new. Torque and speed are those of the motor shaft; every key: docs/rig.md,",
        "# which lies where tdhil docs says.",
        "# What stands behind a '#' has yet to be filled in. Without 'limits' nothing real moves.",
        "",
        f"drive: {profile.bus}",
        f"profile: {scalar(named)}    # {_comment(profile.title)}",
        "# Where the drive is. Left out, the embedded simulator runs, and says so.",
        *bus_commands(profile.bus).blank(profile),
    ]
    parts += _doubts(profile)
    parts += ["", "# Nothing real moves without these. Take the '#' away and give every one your machine's value, in",
              "# the key's unit or with a unit of its own: speed_max_rad_s: 95 rpm"]
    parts += ["#limits:", *(_blank(name) for name in _LIMITS)]
    parts += ["", *_load(load)]
    parts += ["", "#gear: {ratio: }    # motor turns for one of the main shaft; without it 1",
              "", "# What the drive does not tell of itself. Leave out what you do not know.", "#drive_data:"]
    if profile.rated_torque_by_hand:
        parts.append("#  rated_torque_nm:         # N·m; name plate")
    parts.append("#  torque_scale_rel_sd:     # how right the drive's torque is, 1 sd (2 %)")
    parts += _untold(profile)
    parts += _by_hand(profile)
    return "\n".join(parts) + "\n"


def to_fill_in(profile: Profile, load: str) -> list[str]:
    """What a run on a real drive will miss."""
    found = [f"limits: {', '.join(_LIMITS)}", f"where the drive is: {bus_commands(profile.bus).to_fill_in}"]
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
    return f"{bus_kind(bus).section}: {{{', '.join(f'{key}: {_value(value)}' for key, value in line.items())}}}"


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
    blanks = [] if profile is None else [f"#    {one.name}:    # {_comment(one.title)}" for one in profile.untold]
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

def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The bus or line, as for identify; what to ask, and where a starter file goes."""
    from tdhil.cli.arguments import add_drive_arguments, add_line_arguments, add_option
    from tdhil.config import OPTION

    drive = add_drive_arguments(parser)
    add_option(drive, OPTION["simulate"], help="look at the embedded simulator")
    scan = parser.add_argument_group("scan")
    for name in BUSES:
        bus_commands(name).add_scan_arguments(scan)
    scan.add_argument("--write", type=Path, metavar="rig.yaml", help="a rig.yaml to start from; never over a file")
    add_option(scan, OPTION["json"])
    add_line_arguments(parser)
    parser.set_defaults(run=run)


def run(namespace: argparse.Namespace) -> int:
    """0 if anybody answered. Raises CommunicationLost (exit 5) if nobody did, with the likely causes."""
    from tdhil.session import connection_of, plan_peer

    if namespace.write is not None and namespace.write.exists():
        raise _there_already(namespace.write)
    rig = load_rig(namespace.rig) if namespace.rig else None
    options, connection = connection_of(vars(namespace), rig, resolve(vars(namespace), rig))
    if not (options.simulate or connection.configured):
        raise UsageError(
            f"{connection.nothing_there}", where="scan",
            next_step="Say where to look, such as -i socketcan -c can0, --host 192.0.2.10 or --serial /dev/ttyUSB0",
        )
    commands = bus_commands(connection.drive)
    found, remarks = commands.scan(plan_peer(options, connection), connection, options, namespace)
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
    """A file that isn't there yet. UsageError where it is, or can't be written."""
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise _there_already(path) from None
    except OSError as error:
        step = "Name a file in a folder that you may write to"
        raise UsageError(f"can't be written ({error.strerror or error})", where=str(path), next_step=step) from error


def _there_already(path: Path) -> UsageError:
    return UsageError("is there already, and is not written over", where=str(path), next_step="Name another file")


def _write(path: Path, found: tuple[FoundDrive, ...], connection: Connection, options: RunOptions) -> None:
    """The starter file, of the one drive that was found, or of the one asked for among several."""
    one = _chosen(found, connection, options)
    if options.given("profile"):
        one = replace(one, profile=options.profile, why=f"as named: {options.source('profile')}")
    profile = load_profile(one.profile) if one.profile is not None else None
    write_new(path, starter(one, bus_commands(one.bus).section(one, connection), profile))
    print(f"{path}: written. Fill in its limits: before that nothing real moves", file=sys.stderr)  # noqa: T201


def _chosen(found: tuple[FoundDrive, ...], connection: Connection, options: RunOptions) -> FoundDrive:
    commands = bus_commands(connection.drive)
    named = commands.wanted(connection, options)
    drives = [one for one in found if named in (None, one.address)]
    if named is None and len(drives) > 1:
        drives = [one for one in drives if one.profile is not None] or drives
    if len(drives) == 1:
        return drives[0]
    what = f"{len(drives)} drives were found" if drives else f"number {named} did not answer"
    raise UsageError(f"{what}, and a rig.yaml is for one", where="--write",
                     next_step=f"Name it with {commands.address_flag}")
