"""What a profile comes down to, in a few words each: for the table of `tdhil profiles` and for the head of a page."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel

from profiles.entry import Confidence, Entry
from profiles.library import Profile
from profiles.modbus import ModbusProfile
from profiles.requirement import Require
from tdhil.cli.connection import can_torque

LEVELS: tuple[Confidence, ...] = ("verified", "likely", "unverified")


def modes_text(profile: Profile) -> str:
    """What can be regulated, as far as a run needs it."""
    return "speed, torque" if can_torque(profile) else "speed only"


def watchdog_text(profile: Profile) -> str:
    """What stops the drive when the host falls silent."""
    kind, reaction = profile.watchdog.kind, profile.watchdog.reaction
    if kind == "none":
        return "none: the drive would go on turning"
    return f"{kind.replace('_', ' ')}, then {reaction.replace('_', ' ')}"


def counts(profile: Profile) -> dict[str, int]:
    """How many of its entries are how sure."""
    return {level: len(profile.below(level)) for level in LEVELS}


def sure_text(profile: Profile) -> str:
    """The same in words; what is missing is zero."""
    found = counts(profile)
    if found["verified"] == sum(found.values()):
        return "all verified"
    return ", ".join(f"{number} {level}" for level, number in found.items() if number)


def row(profile: Profile) -> dict[str, Any]:
    """One profile of the table, as plain data."""
    return {
        "name": profile.name,
        "bus": profile.bus,
        "title": profile.title,
        "modes": modes_text(profile),
        "watchdog": watchdog_text(profile),
        "entries": counts(profile),
        "experimental": profile.experimental,
    }


def required_text(require: Require, unit: str) -> str:
    """What a parameter must read."""
    parts = []
    if require.equals is not None:
        parts.append(f"{require.equals:.10g}")
    if require.one_of is not None:
        parts.append(" or ".join(f"{value:.10g}" for value in require.one_of))
    if require.at_least is not None:
        parts.append(f"at least {require.at_least:.10g}")
    if require.at_most is not None:
        parts.append(f"at most {require.at_most:.10g}")
    return f"{', '.join(parts)} {unit}".strip()


def rated_torque_is_told_by_hand(profile: Profile) -> bool:
    """Does rig.yaml have to say what 100 % torque is?"""
    if isinstance(profile, ModbusProfile):
        return profile.rated_torque is None
    return profile.torque.rated_torque_nm_per_lsb is None


def facts_of(entry: Entry) -> Iterator[tuple[str, str, str]]:
    """(key, value, what the schema says of it) of everything an entry claims, below nested sections too."""
    yield from _facts(entry, "")


def _facts(model: BaseModel, prefix: str) -> Iterator[tuple[str, str, str]]:
    for name, field in type(model).model_fields.items():
        value = getattr(model, name)
        if name in ("source", "confidence") or isinstance(value, Entry) or _entries(value) or value in (None, ()):
            continue
        key = prefix + (field.alias or name)
        if isinstance(value, BaseModel):
            yield from _facts(value, f"{key}.")
        elif isinstance(value, tuple) and value and isinstance(value[0], BaseModel):
            for number, one in enumerate(value, start=1):
                yield f"{key} {number}", _flat(one), field.description or ""
        else:
            yield key, _value(name, value), field.description or ""


def _entries(value: Any) -> bool:
    return isinstance(value, tuple) and bool(value) and isinstance(value[0], Entry)


def _flat(model: BaseModel) -> str:
    shown = [(field.alias or name, getattr(model, name)) for name, field in type(model).model_fields.items()]
    return ", ".join(f"{name} {_value(name, value)}" for name, value in shown if value is not None)


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
