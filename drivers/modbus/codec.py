"""The pure register codec: whole numbers in 16-bit registers, and counts of a unit as whole numbers.

A 32-bit number takes two registers; which half comes first is the drive's choice (`BusLine.word_order`). Within a
register the high byte comes first on the wire (Modbus Application Protocol, section 4.2); `access.requests` does that.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from drivers.errors import CommandRejected
from profiles.modbus import CyclicSignal, Echo, ModbusProfile, Parameter, Register
from profiles.quantities import RAD_S_PER_RPM

# ---------------------------------------------------------------------------------------------------------------------
# Value of one count, in SI at the motor shaft: parameters' values first, then the scale of every signal. Pure.


@dataclass(frozen=True)
class Scales:
    """SI for one count: rad/s or N·m."""

    speed_setpoint: float
    torque_setpoint: float
    speed: float
    torque: float
    torque_demand: float


def per_count(parameter: Parameter, values: Mapping[str, float]) -> float | None:
    """Return the parameter's unit for one count; None while the parameter that multiplies it is unknown."""
    if parameter.factor is None:
        return parameter.per_lsb
    factor = values.get(parameter.factor)
    return None if factor is None else parameter.per_lsb * factor


def settle(profile: ModbusProfile, counts: Mapping[str, int], given: Mapping[str, float]) -> dict[str, float]:
    """Return the known values of the parameters in their own units: read from the drive, else given in rig.yaml."""
    values = {name: value for name, value in given.items() if name not in counts}
    open_ones = [parameter for parameter in profile.parameters if parameter.name in counts]
    while open_ones:
        rest = []
        for parameter in open_ones:
            scale = per_count(parameter, values)
            if scale is None:
                rest.append(parameter)
            else:
                values[parameter.name] = counts[parameter.name] * scale
        if len(rest) == len(open_ones):
            break
        open_ones = rest
    return values


def si_per_count(signal: CyclicSignal | Echo, values: Mapping[str, float], rated_nm: float) -> float:
    """Return rad/s or N·m for one count. Raises KeyError if a parameter that it needs is unknown."""
    unit = {"rpm": RAD_S_PER_RPM, "nm": 1.0, "rated": rated_nm}[signal.unit]
    factor = values[signal.times] if signal.times is not None else 1.0
    return signal.per_lsb * factor * unit


def find_scales(profile: ModbusProfile, values: Mapping[str, float], rated_nm: float) -> Scales | None:
    """Return all scales of the cycle; None if a parameter that one of them needs is unknown, zero or not finite."""
    cycle = profile.cycle
    found = []
    for signal in (cycle.speed_setpoint, cycle.torque_setpoint, cycle.speed, cycle.torque, cycle.torque_demand):
        try:
            found.append(1.0 if signal is None else si_per_count(signal, values, rated_nm))
        except KeyError:
            return None
    if not all(math.isfinite(scale) and scale > 0.0 for scale in found):
        return None
    return Scales(*found)


# ---------------------------------------------------------------------------------------------------------------------

WordOrder = Literal["high_first", "low_first"]
RegisterType = Literal["u16", "i16", "u32", "i32"]

RANGES: dict[str, tuple[int, int]] = {
    "u16": (0, 0xFFFF),
    "i16": (-0x8000, 0x7FFF),
    "u32": (0, 0xFFFF_FFFF),
    "i32": (-0x8000_0000, 0x7FFF_FFFF),
}


def to_words(number: int, kind: RegisterType, order: WordOrder) -> tuple[int, ...]:
    """Return the registers of a whole number, lowest address first. Raises CommandRejected outside the type's range."""
    low, high = RANGES[kind]
    if not low <= number <= high:
        raise CommandRejected(f"{number} doesn't fit into {kind} ({low} to {high})")
    if kind in ("u16", "i16"):
        return (number & 0xFFFF,)
    upper, lower = number >> 16 & 0xFFFF, number & 0xFFFF
    return (upper, lower) if order == "high_first" else (lower, upper)


def from_words(words: Sequence[int], kind: RegisterType, order: WordOrder) -> int:
    """Return the whole number in registers, lowest address first."""
    if kind in ("u16", "i16"):
        (number,) = words
        bits = 16
    else:
        upper, lower = words if order == "high_first" else reversed(words)
        number = upper << 16 | lower
        bits = 32
    if kind in ("i16", "i32") and number >> bits - 1:
        number -= 1 << bits
    return number


def to_counts(
    value: float, per_lsb: float, register: Register, where: str, rounding: Callable[[float], int] = round
) -> int:
    """Convert a value in its unit to counts of ``per_lsb``.

    Raises CommandRejected if it is not finite or doesn't fit into the register.
    """
    if not math.isfinite(value):
        raise CommandRejected(f"{value} is not finite", where=where, next_step="Nothing was sent to the drive")
    counts = value / per_lsb
    low, high = RANGES[register.type]
    # Compared before rounding: a float beyond all integers of the register must not be rounded at all.
    number = rounding(counts) if low - 1.0 <= counts <= high + 1.0 else None
    if number is None or not low <= number <= high:
        raise CommandRejected(
            f"{value:g} doesn't fit: the register holds {low * per_lsb:g} to {high * per_lsb:g}",
            where=where,
            next_step="Nothing was sent to the drive. Stay within, or check the scale in the profile",
        )
    return number


def register_name(register: Register) -> str:
    """Return a register's name for messages: its wire address, and the manual's name if the profile has it."""
    name = f"{'register' if register.table == 'holding' else 'input register'} {register.address}"
    return f"{name} ({register.reference})" if register.reference else name
