"""Summary of a profile in a few words: for the table of `tdhil profiles` and the head of a page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from pydantic import BaseModel

from profiles import Confidence, Profile, ProfileEntry, unit_text
from profiles.cia402 import Parameter
from tdhil.buses.bus import ProfileTable

MARKS = {"verified": "", "likely": "likely", "unverified": "UNVERIFIED"}
"""Mark of an entry's confidence in a table."""


def object_table(parameters: Sequence[Parameter]) -> ProfileTable:
    """Return the table of a drive's own objects of CiA 402, on any bus."""
    rows = []
    for one in parameters:
        scale = f"{one.per_lsb:g}{f' × {one.times}' if one.times else ''} {unit_text(one.unit)}".strip()
        scale = "2^count" if one.scale == "power_of_two" else scale
        at = f"{one.index:04X}h:{one.sub}" if one.sub else f"{one.index:04X}h"
        rows.append((at, one.type, one.title, scale, MARKS[one.confidence]))
    return ProfileTable("the drive's own objects", ("object", "type", "meaning", "one count", "confidence"),
                        tuple(rows))


LEVELS: tuple[Confidence, ...] = ("verified", "likely", "unverified")


def modes_text(profile: Profile) -> str:
    """Return the control modes that a run needs."""
    return "speed, torque" if profile.can_torque else "speed only"


def watchdog_text(profile: Profile) -> str:
    """Return the means that stops the drive when the host fails."""
    kind, reaction = profile.watchdog.kind, profile.watchdog.reaction
    if kind == "none":
        return "none: the drive would keep turning"
    return f"{kind.replace('_', ' ')}, then {reaction.replace('_', ' ')}"


def counts(profile: Profile) -> dict[str, int]:
    """Return the number of entries by confidence."""
    return {level: len(profile.below(level)) for level in LEVELS}


def sure_text(profile: Profile) -> str:
    """Return the numbers by confidence in words; missing ones are zero."""
    found = counts(profile)
    if found["verified"] == sum(found.values()):
        return "all verified"
    return ", ".join(f"{number} {level}" for level, number in found.items() if number)


def row(profile: Profile) -> dict[str, Any]:
    """Return one profile of the table, as plain data."""
    return {
        "name": profile.name,
        "bus": profile.bus,
        "title": profile.title,
        "modes": modes_text(profile),
        "watchdog": watchdog_text(profile),
        "entries": counts(profile),
        "experimental": profile.experimental,
    }


def facts_of(entry: ProfileEntry) -> Iterator[tuple[str, str, str]]:
    """Yield (key, value, description in the schema) of everything in an entry, with nested sections."""
    yield from _facts(entry, "")


def _facts(model: BaseModel, prefix: str) -> Iterator[tuple[str, str, str]]:
    for name, field in type(model).model_fields.items():
        value = getattr(model, name)
        if (name in ("source", "confidence") or isinstance(value, ProfileEntry) or _entries(value)
                or value in (None, ())):
            continue
        key = prefix + (field.alias or name)
        if isinstance(value, BaseModel):
            yield from _facts(value, f"{key}.")
        elif isinstance(value, tuple) and value and isinstance(value[0], BaseModel):
            for number, one in enumerate(value, start=1):
                parts = [(inner.alias or part, getattr(one, part)) for part, inner in type(one).model_fields.items()]
                text = ", ".join(f"{part} {_value(part, value)}" for part, value in parts if value is not None)
                yield f"{key} {number}", text, field.description or ""
        else:
            yield key, _value(name, value), field.description or ""


def _entries(value: Any) -> bool:
    return isinstance(value, tuple) and bool(value) and isinstance(value[0], ProfileEntry)


_HEX = {"mask", "value", "onward", "off", "quick_stop", "fault_reset", "speed_bits", "torque_bits", "reverse_bits",
        "index", "consumer_index", "reaction_index", "vendor", "product", "revision", "si_unit"}


def _value(name: str, value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int) and name in _HEX:
        return f"{value:04X}h"
    if isinstance(value, tuple):
        return ", ".join(_value(name, one) for one in value)
    return f"{value:g}" if isinstance(value, float) else str(value)
