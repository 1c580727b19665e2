"""Limits of rig.yaml written into the drive's own parameters (`set_to`), and read back.

A limit that the drive has tighter stays so, unless the operator takes a wider one by name (`drivers.own_limits`).

Speed and quick-stop limits are rounded up to a count (too low a limit would act before ours), torque down. A ramp up is
set as steep as the quick stop and no steeper, for it stays in the drive where a run dies; ramps down are left alone,
since a drive's own stops rest on them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

from drivers.drive import Limits
from drivers.errors import CommandRejected, PreflightRefused
from drivers.modbus.access import Access
from drivers.modbus.codec import to_counts
from drivers.modbus.parameters import Parameters, show, where_of
from drivers.modbus.scales import RPM, per_count
from drivers.own_limits import QUICK_STOP, SPEED, TORQUE, OwnLimits
from drivers.preflight import Table
from profiles.modbus import ModbusProfile, Parameter, Register

_SLACK = 1e-9
"""One part in 10^9: a limit that is a whole number of counts must not lose or gain one to the last bit."""


class Setting(NamedTuple):
    """Counts that are to stand in a parameter's register, and the unit for one count."""

    counts: int
    per_count: float


_LIMIT = {
    "torque_limit": TORQUE, "torque_limit_reverse": TORQUE, "speed_limit": SPEED, "speed_limit_reverse": SPEED,
    "quick_stop_time": QUICK_STOP, "quick_stop_deceleration": QUICK_STOP,
}


def set_limits(table: Table, access: Access, profile: ModbusProfile, limits: Limits, rated_nm: float,
               found: Parameters, own: OwnLimits) -> None:
    """Every parameter with `set_to` but the watchdog, which comes last of all; a row each. ``own``: which may be."""
    kinds = set()
    for parameter in profile.parameters:
        if parameter.set_to is None or parameter.set_to == "watchdog":
            continue
        kinds.add(parameter.set_to)
        if parameter.set_to in _LIMIT:
            _write_limit(table, access, parameter, limits, rated_nm, found.values, own)
        else:
            write_setting(table, access, parameter, limits, rated_nm, found.values)
    for kind, title in (("speed_limit", "speed limit"), ("torque_limit", "torque limit")):
        if kind not in kinds:
            text = "the drive's own can't be set over the bus: set it by hand"
            if kind == "torque_limit":
                text += "; only the guard and the setpoint hold it"
            table.note(title, text, "profile")


def _write_limit(
    table: Table, access: Access, parameter: Parameter, limits: Limits, rated_nm: float, values: Mapping[str, float],
    own: OwnLimits,
) -> None:
    """One of the drive's own limits: left alone where it is the tighter one, unless that may be widened."""
    register, where, limit = parameter.register_, where_of(parameter), _LIMIT[parameter.set_to or ""]
    assert register is not None
    try:
        setting = wanted_setting(parameter, limits, rated_nm, values)
        before = access.read(register)
    except (CommandRejected, PreflightRefused) as error:
        table.row(parameter.title, "set from rig.yaml", error.what, False, error.where or where, error.next_step)
        return

    def bound(counts: int) -> float:
        """What the counts allow, in one unit; a time that a ramp takes is its deceleration, of 0 none at all."""
        value = counts * setting.per_count
        if parameter.set_to != "quick_stop_time":
            return value
        from_rpm = values.get(parameter.times or "", limits.speed_rad_s / RPM)
        return abs(from_rpm) / value if value > 0.0 else math.inf

    def shown(counts: int) -> str:
        return show(counts * setting.per_count, parameter)

    if own.stays(limit, bound(setting.counts), bound(before)):
        si = bound(before) * {"rpm": RPM, "rpm_s": RPM, "rated": rated_nm, "s": RPM}.get(parameter.unit, 1.0)
        own.keep(table, limit, parameter.title, shown(setting.counts), shown(before), si, where)
        return
    if not parameter.writable_in_operation:
        write_setting(table, access, parameter, limits, rated_nm, values)
        return
    mend = parameter.advice or "The drive took the value but didn't keep it: is it locked, or its range narrower?"
    try:
        back = access.change(register, setting.counts)
    except PreflightRefused as error:
        step = parameter.advice or error.next_step
        table.row(parameter.title, shown(setting.counts), error.what, False, error.where or where, step)
        return
    own.written(
        table, limit, parameter.title, shown(setting.counts), shown(back), shown(before), back == setting.counts,
        where, mend, wider=own.wider(limit, bound(setting.counts), bound(before)),
    )


def own_speed_limits(profile: ModbusProfile, found: Parameters) -> list[tuple[Register, float, int]]:
    """The drive's own speed limits that may be set in motion: register, rad/s for one count, counts as found."""
    limits = []
    for parameter in profile.parameters:
        register, before = parameter.register_, found.counts.get(parameter.name)
        lsb = per_count(parameter, found.values)
        settable = parameter.set_to in ("speed_limit", "speed_limit_reverse") and parameter.writable_in_operation
        if settable and register is not None and before is not None and lsb and parameter.unit == "rpm":
            limits.append((register, lsb * RPM, before))
    return limits


def write_setting(
    table: Table, access: Access, parameter: Parameter, limits: Limits, rated_nm: float, values: Mapping[str, float]
) -> bool:
    """Write one parameter and read it back; whether it stands as wanted."""
    register, where = parameter.register_, where_of(parameter)
    assert register is not None
    try:
        counts, lsb = wanted_setting(parameter, limits, rated_nm, values)
    except CommandRejected as error:
        return table.row(parameter.title, "set from rig.yaml", error.what, False, error.where, error.next_step)
    wanted = show(counts * lsb, parameter)
    if not parameter.writable_in_operation:
        back = access.read(register)
        advice = parameter.advice or f"Set '{parameter.title}' at the drive; it takes effect after a restart only"
        return table.row(parameter.title, wanted, show(back * lsb, parameter), back == counts, where, advice)

    def work() -> tuple[str, bool]:
        back = access.change(register, counts)
        return show(back * lsb, parameter), back == counts

    advice = parameter.advice or "The drive took the value but didn't keep it: is it locked, or its range narrower?"
    return table.attempt(parameter.title, wanted, where, work, advice)


def wanted_setting(parameter: Parameter, limits: Limits, rated_nm: float, values: Mapping[str, float]) -> Setting:
    """The counts that say what rig.yaml wants. Raises CommandRejected where the unit or the register can't hold it."""
    register, kind, where = parameter.register_, parameter.set_to, where_of(parameter)
    assert register is not None
    lsb = per_count(parameter, values)
    if lsb is None or not math.isfinite(lsb) or lsb <= 0.0:
        raise CommandRejected(
            f"its scale is unknown: '{parameter.times}' could not be read", where=where, next_step="See that row"
        )
    signless = register.type in ("u16", "u32")
    sign = -1.0 if kind in ("speed_limit_reverse", "torque_limit_reverse") and not signless else 1.0
    rounding: Callable[[float], int] = math.ceil
    if kind in ("speed_limit", "speed_limit_reverse"):
        value = limits.speed_rad_s / _unit(parameter, {"rpm": RPM})
    elif kind in ("torque_limit", "torque_limit_reverse"):
        value = limits.torque_nm / _unit(parameter, {"nm": 1.0, "rated": rated_nm})
        rounding = math.floor
    elif kind == "quick_stop_deceleration":
        value = limits.quick_stop_rad_s2 / _unit(parameter, {"rpm_s": RPM})
    elif kind in ("quick_stop_time", "ramp_up_time"):
        from_rpm = values.get(parameter.times) if parameter.times is not None else limits.speed_rad_s / RPM
        if from_rpm is None:
            raise CommandRejected(f"the speed '{parameter.times}' that it counts from is unknown", where=where)
        value = abs(from_rpm) * RPM / limits.quick_stop_rad_s2 / _unit(parameter, {"s": 1.0})
        rounding = math.floor if kind == "quick_stop_time" else math.ceil
    else:
        value = limits.watchdog_s / _unit(parameter, {"s": 1.0})
        rounding = math.floor
    slack = _SLACK if rounding is math.floor else -_SLACK
    counts = to_counts(value * (1.0 + slack), lsb, register, where, rounding)
    # A limit of no count at all would switch it off on many drives.
    return Setting(int(sign) * max(1, counts), lsb)


def _unit(parameter: Parameter, known: Mapping[str, float]) -> float:
    """SI for the parameter's unit. Raises CommandRejected for a unit that such a limit can't have."""
    if parameter.unit not in known:
        raise CommandRejected(
            f"a limit in '{parameter.unit}' can't be set for {parameter.set_to}: {' or '.join(known)} can",
            where=where_of(parameter),
            next_step="Correct its unit in the profile",
        )
    return known[parameter.unit]
