"""Every register that a Modbus profile names, with its meaning: for `profiles show` and for `doctor`. Pure."""

from __future__ import annotations

from dataclasses import dataclass

from profiles.entry import Entry
from profiles.modbus import ModbusProfile, Register

_UNITS = {"rpm_s": "rpm/s", "nm": "N·m", "rated": "of rated torque", "hz": "Hz", "kw": "kW", "none": ""}
_SIGNALS = {
    "control": "control word",
    "status": "status word",
    "speed_setpoint": "speed setpoint",
    "torque_setpoint": "torque setpoint",
    "speed": "reported speed",
    "torque": "reported torque",
    "torque_demand": "torque demand",
}


@dataclass(frozen=True)
class RegisterUse:
    """One register. ``per_lsb``: units for one count, None for words of bits; ``times``: parameter that multiplies."""

    name: str                   # as in `ModbusProfile.entries`
    meaning: str
    register: Register
    per_lsb: float | None
    unit: str                   # as people write it
    times: str | None
    entry: Entry

    @property
    def address(self) -> str:
        """As on the wire, and as the manual writes it."""
        at = self.register
        table = "" if at.table == "holding" else " input"
        return f"{at.address} ({at.address:04X}h){table}" + (f" = {at.reference}" if at.reference else "")

    @property
    def scale(self) -> str:
        """What one count means."""
        if self.per_lsb is None:
            return "bits"
        times = f" × {self.times}" if self.times else ""
        return f"{self.per_lsb:g}{times} {self.unit}".strip()


def register_uses(profile: ModbusProfile) -> tuple[RegisterUse, ...]:
    """In the order of the profile: the cycle, the mode, parameters, echoes. Each use once, also where two share one."""
    found = [
        RegisterUse(
            f"cycle.{name}", meaning, part.register_, getattr(part, "per_lsb", None),
            _UNITS.get(getattr(part, "unit", "none"), getattr(part, "unit", "")), getattr(part, "times", None), part,
        )
        for name, meaning in _SIGNALS.items()
        if (part := getattr(profile.cycle, name)) is not None
    ]
    modes = profile.modes
    if modes.register_ is not None:
        found.append(RegisterUse("modes", "speed or torque", modes.register_, None, "", None, modes))
    if modes.display is not None:
        found.append(RegisterUse("modes", "speed or torque, as shown", modes.display.register_, None, "", None, modes))
    found += [
        RegisterUse(f"parameters.{one.name}", one.title, one.register_, one.per_lsb, unit_text(one.unit),
                    one.factor, one)
        for one in profile.parameters
        if one.register_ is not None
    ]
    found += [
        RegisterUse(f"echoes.{one.setpoint}", f"{one.setpoint} setpoint, as understood", one.register_, one.per_lsb,
                    unit_text(one.unit), one.times, one)
        for one in profile.echoes
    ]
    return tuple(found)


def unit_text(unit: str) -> str:
    """A unit of the schema as people write it."""
    return _UNITS.get(unit, unit)
