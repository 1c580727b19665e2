"""Settings of the drive that the profile names: read, held against what they must be, and used as scales."""

from __future__ import annotations

from drivers.canopen.sdo import Objects, name
from drivers.cia402.values import decode_value
from drivers.errors import ObjectRefused
from drivers.preflight import Table
from profiles.canopen import CanopenProfile
from profiles.canopen_parameter import Parameter
from profiles.requirement import Require

_UNITS = {"rpm": " rpm", "rpm_s": " rpm/s", "nm": " N·m", "rated": " x rated torque", "s": " s", "hz": " Hz"}


class Settings:
    """The drive's settings by name, in their units, read when they are asked for."""

    def __init__(self, objects: Objects, profile: CanopenProfile) -> None:
        self._objects = objects
        self._profile = profile

    def value(self, wanted: str) -> float:
        """In its unit. Raises ObjectRefused."""
        one = self._profile.parameter(wanted)
        where = name(one.index, one.sub)
        raw = decode_value(one.type, self._objects.read_bytes(one.index, one.sub), where)
        if one.scale == "power_of_two":
            if not 0 <= raw <= 64:
                raise ObjectRefused(f"{raw:g} is no number of bits", where=where)
            return float(2.0**raw)
        return raw * self.per_lsb(one)

    def per_lsb(self, one: Parameter) -> float:
        """Units for one count. Raises ObjectRefused, also for a scale of zero."""
        factor = 1.0 if one.times is None else self.value(one.times)
        if factor == 0.0 and one.times is not None:
            scale = self._profile.parameter(one.times)
            raise ObjectRefused(f"{scale.title} reads 0", where=name(scale.index, scale.sub))
        return one.per_lsb * factor


def check_parameters(table: Table, objects: Objects, profile: CanopenProfile) -> None:
    """One row for each setting that must stand by hand; this program writes none of them."""
    settings = Settings(objects, profile)
    for one in profile.parameters:
        if one.require is None:
            continue
        unit = _UNITS.get(one.unit, "")

        def work(one: Parameter = one, unit: str = unit) -> tuple[str, bool]:
            value = settings.value(one.name)
            return f"{value:.10g}{unit}", one.require is None or fulfils(one.require, value)

        table.attempt(
            one.title, wanted_text(one.require, unit), name(one.index, one.sub), work,
            one.advice or "Set it at the drive, by hand: this program does not",
        )


def fulfils(require: Require, value: float) -> bool:
    """Does ``value`` do, give or take the last bits of a 32-bit float?"""
    slack = 1e-6 * abs(value)
    exact = [wanted for wanted in (require.equals,) if wanted is not None] + list(require.one_of or ())
    return (
        (not exact or any(abs(value - wanted) <= slack for wanted in exact))
        and (require.at_least is None or value >= require.at_least - slack)
        and (require.at_most is None or value <= require.at_most + slack)
    )


def wanted_text(require: Require, unit: str) -> str:
    """The demand in words."""
    parts = []
    if require.equals is not None:
        parts.append(f"{require.equals:.10g}{unit}")
    if require.one_of is not None:
        parts.append(" or ".join(f"{value:.10g}" for value in require.one_of) + unit)
    if require.at_least is not None:
        parts.append(f"at least {require.at_least:.10g}{unit}")
    if require.at_most is not None:
        parts.append(f"at most {require.at_most:.10g}{unit}")
    return ", ".join(parts)
