"""What one count means, in SI at the motor shaft: parameters' values first, then every signal's scale. Pure."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from profiles.modbus import Echo, ModbusProfile, Parameter, Signal

RPM = 2.0 * math.pi / 60.0
"""rad/s in one rev/min."""


@dataclass(frozen=True)
class Scales:
    """SI for one count: rad/s or N·m."""

    speed_setpoint: float
    torque_setpoint: float
    speed: float
    torque: float
    torque_demand: float


def per_count(parameter: Parameter, values: Mapping[str, float]) -> float | None:
    """The parameter's unit for one count; None while the parameter that multiplies it isn't known."""
    if parameter.factor is None:
        return parameter.per_lsb
    factor = values.get(parameter.factor)
    return None if factor is None else parameter.per_lsb * factor


def settle(profile: ModbusProfile, counts: Mapping[str, int], given: Mapping[str, float]) -> dict[str, float]:
    """Every parameter's value in its own unit, as far as it can be told: what was read, else what rig.yaml states."""
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


def si_per_count(signal: Signal | Echo, values: Mapping[str, float], rated_nm: float) -> float:
    """Rad/s or N·m for one count. Raises KeyError if a parameter that it needs isn't known."""
    unit = {"rpm": RPM, "nm": 1.0, "rated": rated_nm}[signal.unit]
    factor = values[signal.times] if signal.times is not None else 1.0
    return signal.per_lsb * factor * unit


def find_scales(profile: ModbusProfile, values: Mapping[str, float], rated_nm: float) -> Scales | None:
    """All of the cycle's scales; None if a parameter that one of them needs is unknown, zero or not finite."""
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
