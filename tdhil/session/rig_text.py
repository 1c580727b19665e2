"""Text of a new rig.yaml: the place of the drive, known entries, and blanks for the others."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Final

from profiles import Profile
from tdhil.buses import FoundDrive, bus_named
from tdhil.config import Limits, Rig
from tdhil.session.overrides import doubtful

LIMIT_KEYS: Final = tuple(name for name, field in Limits.model_fields.items() if field.is_required())
"""Keys of the section limits: that a real drive needs."""
STRING_KEYS: Final = ("make_up_torque_nm", "torque_ramp_nm_s")
"""Keys that a drill string needs."""
_NUMBER: Final = re.compile(r"-?(0|[1-9][0-9]*)(\.[0-9]+)?")
_POWER_OF_TEN: Final = re.compile(_NUMBER.pattern + r"[eE][-+]?[0-9]+")
_PLAIN: Final = re.compile(r"[A-Za-z_./][A-Za-z0-9_./-]*")
_WORDS: Final = {"true", "false", "null", "yes", "no", "on", "off", "y", "n", "~", ".inf", ".nan"}


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
        parts.append(_section(found.bus, line, _value))
    parts += [f"{key}: {_value(value)}" for key, value in bus_named(found.bus).rig_keys(found).items()]
    if found.profile is not None:
        parts.append(f"profile: {scalar(found.profile)}    # {_comment(found.why)}")
    else:
        parts += [f"#profile:    # {_comment(found.why)}"]
    parts += _doubts(profile)
    parts += ["", "# A real drive does not move without these. Remove the '#' and give every value of your machine."]
    parts += ["#limits:", *(_entry(name, {}, Limits.model_fields[name].description) for name in LIMIT_KEYS)]
    parts += ["", "# Facts that the drive does not report.", "#drive_data:"]
    if profile is None or profile.rated_torque_by_hand:
        parts.append("#  rated_torque_nm:         # N·m; from the name plate")
    parts.append("#  torque_scale_rel_sd:     # standard uncertainty of the torque scale (0.02 = 2 %)")
    parts += _untold(profile)
    parts += _by_hand(profile)
    return "\n".join(parts) + "\n"


@dataclass(frozen=True)
class RigEntries:
    """Entries that are known already, as typed: in the unit of the key, or with another unit.

    ``address``: keys of the bus's section, and further keys beside it. ``string``: make-up torque and torque ramp.
    ``parameters``: parameters of the drive that can't be read over the bus, in the profile's units. ``simulated``:
    there is no drive, and the file has no address.
    """

    name: str | None = None
    address: Mapping[str, Any] = field(default_factory=dict)
    limits: Mapping[str, Any] = field(default_factory=dict)
    string: Mapping[str, Any] = field(default_factory=dict)
    drive_data: Mapping[str, Any] = field(default_factory=dict)
    parameters: Mapping[str, Any] = field(default_factory=dict)
    gear_ratio: Any = None
    accept_unverified: Sequence[str] = ()
    motion: str = "never"
    simulated: bool = False


_NO_ENTRIES: Final = RigEntries()


def blank_rig(
    profile: Profile, named: str, load: str, known: RigEntries = _NO_ENTRIES, written_by: str = "tdhil rig new"
) -> str:
    """Return the text of a new rig.yaml: known entries, and a commented line for each one to fill in.

    ``named``: profile as named by the operator. ``load``: none or string.
    """
    parts = [
        f"# Written by {written_by}. Torque and speed refer to the motor shaft. All keys: docs/reference/rig.md,",
        "# whose path tdhil docs prints.",
        "# Fill in the lines with a '#'. Without 'limits' a real drive does not move.",
        "",
        *_named(known.name),
        f"drive: {profile.bus}",
        f"profile: {scalar(named)}    # {_comment(profile.title)}",
        *_place(profile, known),
    ]
    parts += _doubts(profile, known.accept_unverified)
    parts += ["", "# A real drive does not move without these. Remove the '#' and give every value of your machine, in",
              "# the key's unit or with another unit: speed_max_rad_s: 95 rpm"]
    parts += ["limits:" if known.limits else "#limits:",
              *(_entry(name, known.limits, Limits.model_fields[name].description) for name in LIMIT_KEYS)]
    parts += ["", *_load(load, known.string)]
    parts += ["", "#gear: {ratio: }    # motor turns per turn of the main shaft; default 1" if known.gear_ratio is None
              else f"gear: {{ratio: {_quantity(known.gear_ratio)}}}    # motor turns per turn of the main shaft",
              "", "# Facts that the drive does not report. Omit unknown ones.",
              "drive_data:" if known.drive_data or known.parameters else "#drive_data:"]
    if profile.rated_torque_by_hand or "rated_torque_nm" in known.drive_data:
        parts.append(_entry("rated_torque_nm", known.drive_data, "N·m; from the name plate"))
    parts.append(_entry("torque_scale_rel_sd", known.drive_data, "standard uncertainty of the torque scale (2 %)"))
    parts += _untold(profile, known.parameters)
    if known.motion != "never":
        parts += ["", "# A run over HTTP moves this rig only with a code from the operator at the rig.",
                  f"service: {{motion: {known.motion}}}"]
    parts += _by_hand(profile)
    return "\n".join(parts) + "\n"


def _place(profile: Profile, known: RigEntries) -> tuple[str, ...]:
    """Return the lines that state where the drive is: simulated, or its address; blank ones without any known key."""
    if known.simulated:
        return ("# No drive: the embedded simulator runs, and no real shaft moves.", "run: {simulate: true}")
    what = "# The drive's address. Without it the embedded simulator runs."
    if not known.address:
        return (what, *bus_named(profile.bus).rig_blank(profile))
    model = bus_named(profile.bus).section_model
    fields = () if model is None else model.model_fields
    section = {key: value for key, value in known.address.items() if key in fields}
    beside = {key: value for key, value in known.address.items() if key not in section}
    return (what, *((_section(profile.bus, section, _typed),) if section else ()),
            *(f"{key}: {_typed(value)}" for key, value in beside.items()))


def to_fill_in(profile: Profile, load: str, name: str | None = None) -> list[str]:
    """Return the further entries that a run on a real drive needs."""
    found = [f"limits: {', '.join(LIMIT_KEYS)}", f"the drive's address: {bus_named(profile.bus).to_fill_in}"]
    if name is None:
        found.append("name: the rig's own name, such as bench 3")
    if load == "string":
        found.append(f"{', '.join(STRING_KEYS)}: without them the file is refused")
    if doubtful(profile):
        found.append("accept_unverified: unverified entries of this profile, after you have checked them")
    if _untold(profile):
        found.append("drive_data.parameters: values that this drive does not report over the bus")
    if _by_hand(profile):
        found.append("and at the drive: the settings at the file's end")
    return found


def _load(load: str, known: Mapping[str, Any]) -> list[str]:
    if load == "none":
        return ["load: none    # as requested: no load that stores torque. With a drill string: string"]
    return ["load: string    # as requested; this file is refused until these two are filled in",
            *(f"{name}: {_quantity(known[name])}    # {Rig.model_fields[name].description}" if name in known
              else f"#{name}:    # {Rig.model_fields[name].description}" for name in STRING_KEYS)]


def _entry(name: str, known: Mapping[str, Any], description: str | None) -> str:
    """Return the line of a key in a section: its known value, or a blank."""
    if name in known:
        return f"  {name + ':':<24} {_quantity(known[name]):<10} # {description}"
    return f"#  {name + ':':<24} # {description}"


def _section(bus: str, line: Mapping[str, Any], text: Callable[[Any], str]) -> str:
    return f"{bus_named(bus).section}: {{{', '.join(f'{key}: {text(value)}' for key, value in line.items())}}}"


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


def _typed(value: Any) -> str:
    """Return an entry as typed: a number stays a number, and a value with a unit becomes a text."""
    text = str(value).strip()
    return text if _NUMBER.fullmatch(text) else scalar(value)


def _quantity(value: Any) -> str:
    """Return a quantity as typed: a power of ten, which in an address is a text, is a number, too."""
    text = str(value).strip()
    return text if _POWER_OF_TEN.fullmatch(text) else _typed(value)


def _doubts(profile: Profile | None, accepted: Sequence[str] = ()) -> list[str]:
    names = [] if profile is None else [name for name, _ in doubtful(profile)]
    if profile is None or not names:
        return []
    if accepted:
        return ["# Compared with the drive's manual, and accepted:",
                f"accept_unverified: [{', '.join(scalar(one) for one in accepted)}]"]
    return [
        f"# Not verified in this profile: {', '.join(names)}.",
        f"# Compare them with the drive's manual (tdhil profiles show {profile.name}), then accept them by name:",
        "#accept_unverified: []",
    ]


def _untold(profile: Profile | None, known: Mapping[str, Any] = MappingProxyType({})) -> list[str]:
    """Return lines for the parameters that cannot be read over the bus."""
    lines = [] if profile is None else [
        f"    {one.name}: {_quantity(known[one.name])}    # {_comment(one.title)}" if one.name in known
        else f"#    {one.name}:    # {_comment(one.title)}" for one in profile.untold]
    return ["  parameters:" if known else "#  parameters:", *lines] if lines else []


def by_hand(profile: Profile) -> list[str]:
    """Return the settings that the operator makes at the drive, a line each. A run is refused until they are read."""
    return [f"{_comment(one.title)}: {one.require.text_in(one.unit)}" for one in profile.parameters
            if one.require is not None]


def _by_hand(profile: Profile | None) -> list[str]:
    required = [] if profile is None else by_hand(profile)
    if not required:
        return []
    return ["", "# Set these at the drive by hand; a run is refused until they are read:",
            *(f"# - {one}" for one in required)]


def _comment(text: str) -> str:
    """Return one line of printable text, for any name that a drive reports."""
    return " ".join("".join(char if char.isprintable() else " " for char in text).split())
