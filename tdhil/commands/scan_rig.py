"""The rig.yaml to start from: where the drive was found, and the limits as blanks that somebody has to fill in."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

from profiles.library import Profile
from profiles.modbus import ModbusProfile
from tdhil.cli.found_drive import FoundDrive
from tdhil.cli.profile_text import rated_torque_is_told_by_hand, required_text
from tdhil.commands.unverified import doubtful
from tdhil.config.rig import Limits, Rig

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
