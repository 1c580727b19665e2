"""Period of the cycle in the drive, on any bus, and 60C2h, its object of CiA 402-2 for the cyclic synchronous modes."""

from __future__ import annotations

from collections.abc import Callable

from drivers.cia402.objects import Objects
from drivers.errors import ObjectRefused
from drivers.preflight import PreflightTable

INTERPOLATION = 0x60C2
"""Period of the setpoints in the cyclic synchronous modes: value (u8), exponent of ten (i8), in s."""


def note_period(
    table: PreflightTable, period_s: float, where: str, set_period: Callable[[], int], follows: str,
    title: str = "cycle",
) -> None:
    """Set the period and add a row. ``set_period`` returns the period read back, µs.

    A drive that lacks or refuses the object ``where`` follows what the text ``follows`` names.
    """
    period_us = round(period_s * 1e6)
    try:
        back = set_period()
        table.row(title, f"{period_us} µs", f"{back} µs", back == period_us, where)
    except ObjectRefused as error:
        table.note(title, f"{period_us} µs, not set: {error.what}. The drive follows {follows}", where)


def interpolation(period_s: float) -> tuple[int, int]:
    """Return value and exponent of 60C2h for a period, s. Raises ObjectRefused if there is none."""
    for exponent in (-3, -4, -5, -6):
        value = period_s / 10.0**exponent
        if 1 <= round(value) <= 0xFF and abs(value - round(value)) < 1e-6:
            return round(value), exponent
    raise ObjectRefused(f"{period_s * 1e6:g} µs can't be written", where="60C2h")


def set_interpolation(objects: Objects, period_s: float) -> int:
    """Write 60C2h. Return the period read back, µs. Raises ObjectRefused; the period is then the former one."""
    value, exponent = interpolation(period_s)
    former = objects.read_bytes(INTERPOLATION, 2)
    exponent = objects.change(INTERPOLATION, 2, exponent, 8)
    try:
        value = objects.change(INTERPOLATION, 1, value, 8)
    except ObjectRefused:
        objects.write_bytes(INTERPOLATION, 2, former)
        raise
    exponent -= 256 if exponent > 127 else 0
    return round(value * 10.0 ** (exponent + 6))
