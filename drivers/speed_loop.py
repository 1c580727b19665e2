"""Parameters of the drive's own speed loop, read once in preflight where its profile names them. Nothing is written.

::

    integral time    I = P/T_I        0: no integral part
    cut-off          τ = 1/(2π f_c)   0: no filter

A refused read is a note in the preflight table, because no run depends on these values.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

from drivers.drive import ReportedSetting, SpeedLoopPresent
from drivers.errors import CommandRejected, PreflightRefused
from drivers.preflight import PreflightTable
from profiles import CONTROLLER_UNITS, SpeedControllerParameters

_SECONDS: Mapping[str, float] = {"s": 1.0, "ms": 1e-3}


class ReadSetting(NamedTuple):
    """Counts of a parameter, and its value in the unit of the profile's ``speed_controller``."""

    raw: float
    value: float


def read_speed_loop(
    table: PreflightTable, parameters: SpeedControllerParameters | None, read: Callable[[str], ReadSetting],
    where: Callable[[str], str], *, simulated: bool,
) -> SpeedLoopPresent | None:
    """Return the gains in the drive; None if the profile names no parameter that is read from this drive.

    ``read`` reads a parameter of the profile by its name. It may raise PreflightRefused and ObjectRefused.
    """
    names = {} if parameters is None else parameters.read_from()
    if parameters is None or not names or not parameters.belongs_to(simulated=simulated):
        return None
    entries = {"gain": parameters.gain, "integral": parameters.integral, "filter": parameters.filter}
    found: dict[str, ReportedSetting] = {}
    for part, name in names.items():
        entry, place = entries[part], where(name)
        assert entry is not None
        try:
            raw, value = read(name)
        except (PreflightRefused, CommandRejected):
            table.note(f"speed loop: {part}", "not reported by the drive", place)
            continue
        if not math.isfinite(value) or value < 0.0:
            table.note(f"speed loop: {part}", f"{value:g} is not a valid setting, and is not used", place)
            continue
        unit = f" {CONTROLLER_UNITS[entry.unit]}" if entry.unit in CONTROLLER_UNITS else ", unit unknown"
        table.note(f"speed loop: {part}", f"{value:.6g}{unit}", place)
        found[part] = ReportedSetting(entry.title, place, raw, value, entry.unit, entry.confidence)
    return in_si(found.get("gain"), found.get("integral"), found.get("filter"))


def in_si(
    gain: ReportedSetting | None, integral: ReportedSetting | None, smoothing: ReportedSetting | None
) -> SpeedLoopPresent:
    """Return the settings with P in N·m·s/rad, I in N·m/rad and the filter in s, where their units give them."""
    proportional = gain.value if gain is not None and gain.unit == "nm_s_rad" else None
    integral_gain = None
    if integral is not None:
        time_s = integral.value * _SECONDS.get(integral.unit, math.nan)
        if integral.unit == "nm_rad":
            integral_gain = integral.value
        elif proportional is not None and time_s >= 0.0:
            integral_gain = proportional / time_s if time_s > 0.0 else 0.0
    filter_s = None
    if smoothing is not None and smoothing.unit == "hz":
        filter_s = 1.0 / (2.0 * math.pi * smoothing.value) if smoothing.value > 0.0 else 0.0
    elif smoothing is not None and smoothing.unit in _SECONDS:
        filter_s = smoothing.value * _SECONDS[smoothing.unit]
    return SpeedLoopPresent(gain, integral, smoothing, proportional, integral_gain, filter_s)
