"""The pure register codec: whole numbers in 16-bit registers, and counts of a unit as whole numbers.

A 32-bit number takes two registers; which half comes first is the drive's choice (`Line.word_order`). Within a
register the high byte comes first on the wire (Modbus Application Protocol, section 4.2); `requests` does that.
"""

import math
from collections.abc import Callable, Sequence
from typing import Literal

from drivers.errors import CommandRejected
from profiles.modbus import Register

WordOrder = Literal["high_first", "low_first"]
RegisterType = Literal["u16", "i16", "u32", "i32"]

RANGES: dict[str, tuple[int, int]] = {
    "u16": (0, 0xFFFF),
    "i16": (-0x8000, 0x7FFF),
    "u32": (0, 0xFFFF_FFFF),
    "i32": (-0x8000_0000, 0x7FFF_FFFF),
}


def to_words(number: int, kind: RegisterType, order: WordOrder) -> tuple[int, ...]:
    """A whole number → its registers, lowest address first. Raises CommandRejected outside the type's range."""
    low, high = RANGES[kind]
    if not low <= number <= high:
        raise CommandRejected(f"{number} doesn't fit into {kind} ({low} to {high})")
    if kind in ("u16", "i16"):
        return (number & 0xFFFF,)
    upper, lower = number >> 16 & 0xFFFF, number & 0xFFFF
    return (upper, lower) if order == "high_first" else (lower, upper)


def from_words(words: Sequence[int], kind: RegisterType, order: WordOrder) -> int:
    """Registers, lowest address first → the whole number."""
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
    """A value in its unit → counts of ``per_lsb``.

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
    """How a register is written in messages: its wire address, and the manual's way where the profile has it."""
    name = f"{'register' if register.table == 'holding' else 'input register'} {register.address}"
    return f"{name} ({register.reference})" if register.reference else name
