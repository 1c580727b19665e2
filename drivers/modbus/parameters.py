"""The drive's parameters in preflight: values, requirements, scales, name plate, filters.

Nothing is written here: a wrong address, word order, sign or scale must show before the first write.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

from drivers.drive import DriveLimits, ReportingFilters, SpeedLoopPresent
from drivers.errors import CommandRejected, PreflightRefused
from drivers.modbus.access import RegisterAccess
from drivers.modbus.codec import RANGES, per_count, register_name, settle, to_counts
from drivers.own_limits import LIMIT_SET_BY, NOT_KEPT, TORQUE, OwnLimits
from drivers.preflight import PreflightTable, agreed_rated_torque, spare
from drivers.speed_loop import ReadSetting, read_speed_loop
from profiles import unit_text
from profiles.modbus import ModbusProfile, Parameter, Register
from profiles.quantities import RAD_S_PER_RPM


@dataclass(frozen=True)
class Parameters:
    """Parameters from the drive and rig.yaml: counts as read, values in their own units."""

    counts: Mapping[str, int]
    values: Mapping[str, float]


def read_parameters(
    table: PreflightTable, access: RegisterAccess, profile: ModbusProfile, given: Mapping[str, float],
    spared: Collection[str] = (),
) -> Parameters:
    """Read every parameter that has a register. A needed value that is not available is a refused row.

    ``spared``: parameters of the watchdog, if it is off and the operator has accepted that.
    """
    counts: dict[str, int] = {}
    for parameter in profile.parameters:
        if parameter.register_ is None:
            continue
        try:
            counts[parameter.name] = access.read(parameter.register_)
        except PreflightRefused as error:
            where = register_name(parameter.register_)
            if parameter.name in spared:
                spare(table, parameter.title, "readable", error.what, where)
            elif needed(profile, parameter):
                table.row(parameter.title, "readable", error.what, False, where, error.next_step)
            else:
                table.note(parameter.title, f"not reported: {error.what}", where)
    values = settle(profile, counts, given)
    for parameter in profile.parameters:
        if parameter.name not in values and parameter.register_ is None and parameter.name in spared:
            spare(table, parameter.title, "known", "can't be read over the bus", parameter.name)
        elif parameter.name not in values and parameter.register_ is None and needed(profile, parameter):
            table.row(
                parameter.title, "known", "can't be read over the bus", False, parameter.name,
                f"Give drive_data.parameters.{parameter.name} in rig.yaml, as the drive's panel shows it",
            )
        elif parameter.name in given and parameter.name in counts and not (
            abs(values.get(parameter.name, math.nan) - given[parameter.name])
            <= max(0.5 * _lsb(parameter, values), 1e-6 * abs(given[parameter.name]))
        ):
            table.row(
                parameter.title, show(given[parameter.name], parameter), show(values[parameter.name], parameter), False,
                where_of(parameter), "rig.yaml and the drive state different values: correct the wrong one",
            )
    return Parameters(counts, values)


def needed(profile: ModbusProfile, parameter: Parameter) -> bool:
    """Return whether anything depends on this parameter's value."""
    if parameter.require is not None or parameter.set_to is not None:
        return True
    cycle, watchdog, plate = profile.cycle, profile.watchdog, profile.name_plate
    signals = (cycle.speed_setpoint, cycle.torque_setpoint, cycle.speed, cycle.torque, cycle.torque_demand)
    used = {signal.times for signal in signals if signal is not None}
    used |= {other.times for other in profile.parameters} | {echo.times for echo in profile.echoes}
    used |= {profile.rated_torque, watchdog.parameter, watchdog.reaction_parameter}
    if plate is not None:
        used |= {plate.power, plate.speed, plate.torque}
    return parameter.name in used


def check_required(
    table: PreflightTable, profile: ModbusProfile, found: Parameters, spared: Collection[str] = ()
) -> None:
    """Check the parameters that the profile requires; they are set at the drive, never by tdhil."""
    for parameter in profile.parameters:
        require, value = parameter.require, found.values.get(parameter.name)
        if require is None:
            continue
        if value is None:
            continue        # refused already, where it was read
        good = require.met_by(value, 0.5 * _lsb(parameter, found.values))       # half a count
        wanted = require.text(partial(show, parameter=parameter))
        if not good and parameter.name in spared:
            spare(table, parameter.title, wanted, show(value, parameter), where_of(parameter))
            continue
        advice = parameter.advice or f"Set '{parameter.title}' at the drive to {wanted}"
        table.row(parameter.title, wanted, show(value, parameter), good, where_of(parameter), advice)


def find_rated_torque(
    table: PreflightTable, profile: ModbusProfile, found: Parameters, rated_torque_nm: float | None
) -> float | None:
    """Return the rated torque (100 %), N·m: rig.yaml's, which the drive must confirm, otherwise the drive's; None
    without both.
    """
    name = profile.rated_torque
    from_drive = found.values.get(name) if name is not None else None
    where = "profile, rated_torque" if name is None else where_of(profile.parameter(name))
    if rated_torque_nm is None and from_drive is not None:
        good = math.isfinite(from_drive) and from_drive > 0.0
        step = "Set the motor's data at the drive, or check the register in the profile"
        table.row("rated torque", "above 0 N·m", f"{from_drive:g} N·m", good, where, step)
        return from_drive if good else None
    return agreed_rated_torque(table, from_drive, rated_torque_nm, where)


def check_name_plate(table: PreflightTable, profile: ModbusProfile, found: Parameters, rated_nm: float) -> None:
    """Check P = T·ω: a wrong address, scale, sign or word order in one of the three gives a mismatch."""
    plate = profile.name_plate
    if plate is None:
        table.note("name plate", "this profile names no power, speed and torque that must fit each other", "profile")
        return
    power, speed, torque = (found.values.get(name) for name in (plate.power, plate.speed, plate.torque))
    if power is None or speed is None or torque is None:
        return              # refused already, where it was read
    power_w = power * {"kw": 1e3}.get(profile.parameter(plate.power).unit, 1.0)
    torque_nm = torque * (rated_nm if profile.parameter(plate.torque).unit == "rated" else 1.0)
    product_w = torque_nm * speed * RAD_S_PER_RPM
    good = power_w > 0.0 and torque_nm > 0.0 and abs(product_w - power_w) <= plate.tolerance * power_w
    table.row(
        "name plate: torque × speed",
        f"{power_w / 1e3:.4g} kW within {100.0 * plate.tolerance:g} %",
        f"{torque_nm:.4g} N·m × {speed:.4g} rpm = {product_w / 1e3:.4g} kW",
        good,
        ", ".join(where_of(profile.parameter(name)) for name in (plate.power, plate.speed, plate.torque)),
        "Address, word order or scale of one of them is wrong in the profile, or the motor's data at the drive are",
    )


def find_filters(table: PreflightTable, profile: ModbusProfile, found: Parameters) -> ReportingFilters:
    """Return first-order lags of the reported signals, s; None if not reported. A cut-off frequency f_c is a lag of
    1/(2π f_c).
    """
    lags: dict[str, float] = {}
    sources = []
    for entry in profile.filters:
        title = f"{entry.signal} filter"
        if entry.documented_s is not None:
            lag_s, where, how = entry.documented_s, entry.source, "fixed, as documented"
        else:
            parameter = profile.parameter(entry.parameter or "")
            value, where, how = found.values.get(parameter.name), where_of(parameter), parameter.title
            if value is None or not math.isfinite(value) or value < 0.0:
                table.note(title, "the drive does not report it", where, entry.advice or "")
                continue
            hertz = parameter.unit == "hz"
            lag_s = value if not hertz else 1.0 / (2.0 * math.pi * value) if value > 0.0 else 0.0
        table.note(title, f"{lag_s * 1000.0:.4g} ms ({how})", where, entry.advice or "")
        lags[entry.signal] = lag_s
        sources.append(f"{entry.signal}: {where}" + (f"; {entry.advice}" if entry.advice else ""))
    return ReportingFilters(lags.get("speed"), lags.get("torque"), ", ".join(sources))


def find_speed_loop(
    table: PreflightTable, profile: ModbusProfile, found: Parameters, *, simulated: bool
) -> SpeedLoopPresent | None:
    """Return the gains of the drive's speed loop from the parameters that were read."""

    def read(name: str) -> ReadSetting:
        if name not in found.counts or name not in found.values:
            raise PreflightRefused("not reported", where=name)
        return ReadSetting(float(found.counts[name]), found.values[name])

    return read_speed_loop(table, profile.speed_controller, read, lambda name: where_of(profile.parameter(name)),
                           simulated=simulated)


def where_of(parameter: Parameter) -> str:
    """Return the register's name, or the parameter's name if it has no register."""
    return register_name(parameter.register_) if parameter.register_ is not None else parameter.name


def show(value: float, parameter: Parameter) -> str:
    """Return a value with its unit."""
    plain = f"{value:.0f}" if parameter.unit == "none" and value.is_integer() else f"{value:.6g}"
    return f"{plain} {unit_text(parameter.unit)}".strip()


def fits(parameter: Parameter, counts: int) -> bool:
    """Return whether these counts fit into the register."""
    if parameter.register_ is None:
        return False
    low, high = RANGES[parameter.register_.type]
    return low <= counts <= high


def _lsb(parameter: Parameter, values: Mapping[str, float]) -> float:
    return per_count(parameter, values) or parameter.per_lsb


# ---------------------------------------------------------------------------------------------------------------------
# Limits of rig.yaml written into the drive's own parameters (`set_to`), and read back.
#
# A tighter limit of the drive stays, unless the operator accepts a wider one by name (`drivers.own_limits`).
#
# Speed and quick-stop limits are rounded up to a count (too low a limit would act before ours), torque down. The
# acceleration ramp is set as steep as the quick stop and no steeper, because it stays in the drive if a run dies.
# Deceleration ramps are not changed, because the drive's own stops use them.


_SLACK = 1e-9
"""Slack of 1e-9: a limit of a whole number of counts must not lose or gain one to rounding."""


class RegisterSetting(NamedTuple):
    """Required counts in a parameter's register, and the unit for one count."""

    counts: int
    per_count: float


def set_limits(table: PreflightTable, access: RegisterAccess, profile: ModbusProfile, limits: DriveLimits,
               rated_nm: float,
               found: Parameters, own: OwnLimits) -> None:
    """Write every parameter with `set_to`, and add a row for each. The watchdog is set later. ``own`` decides which of
    the drive's limits stay.
    """
    kinds = set()
    for parameter in profile.parameters:
        if parameter.set_to is None or parameter.set_to == "watchdog":
            continue
        kinds.add(parameter.set_to)
        if parameter.set_to in LIMIT_SET_BY:
            _write_limit(table, access, parameter, limits, rated_nm, found.values, own)
        else:
            write_setting(table, access, parameter, limits, rated_nm, found.values)
    for kind, title in (("speed_limit", "speed limit"), ("torque_limit", "torque limit")):
        if kind not in kinds:
            text = "tdhil cannot set it over the bus: set it at the drive"
            if kind == "torque_limit":
                text += "; only guard and setpoint of the host limit torque"
            table.note(title, text, "profile")


def _write_limit(
    table: PreflightTable, access: RegisterAccess, parameter: Parameter, limits: DriveLimits, rated_nm: float,
    values: Mapping[str, float],
    own: OwnLimits,
) -> None:
    """Write one of the drive's own limits, unless the drive's is tighter and may not be widened."""
    register, where, limit = parameter.register_, where_of(parameter), LIMIT_SET_BY[parameter.set_to or ""]
    assert register is not None
    try:
        setting = wanted_setting(parameter, limits, rated_nm, values)
        before = access.read(register)
    except (CommandRejected, PreflightRefused) as error:
        table.row(parameter.title, "set from rig.yaml", error.what, False, error.where or where, error.next_step)
        return

    def bound(counts: int) -> float:
        """Return the limit that the counts mean, in one unit: a ramp time as deceleration, 0 as no ramp."""
        value = counts * setting.per_count
        if parameter.set_to != "quick_stop_time":
            return value
        from_rpm = values.get(parameter.times or "", limits.speed_rad_s / RAD_S_PER_RPM)
        return abs(from_rpm) / value if value > 0.0 else math.inf

    def shown(counts: int) -> str:
        return show(counts * setting.per_count, parameter)

    if own.stays(limit, bound(setting.counts), bound(before)):
        in_si = dict.fromkeys(("rpm", "rpm_s", "s"), RAD_S_PER_RPM) | {"rated": rated_nm}
        si = bound(before) * in_si.get(parameter.unit, 1.0)
        own.keep(table, limit, parameter.title, shown(setting.counts), shown(before), si, where)
        return
    if not parameter.writable_in_operation:
        write_setting(table, access, parameter, limits, rated_nm, values)
        return
    mend = parameter.advice or NOT_KEPT
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
    """Return the drive's own speed limits that may be set in motion: register, rad/s per count, counts as found."""
    limits = []
    for parameter in profile.parameters:
        register, before = parameter.register_, found.counts.get(parameter.name)
        lsb = per_count(parameter, found.values)
        settable = parameter.set_to in ("speed_limit", "speed_limit_reverse") and parameter.writable_in_operation
        if settable and register is not None and before is not None and lsb and parameter.unit == "rpm":
            limits.append((register, lsb * RAD_S_PER_RPM, before))
    return limits


def write_setting(
    table: PreflightTable, access: RegisterAccess, parameter: Parameter, limits: DriveLimits, rated_nm: float,
    values: Mapping[str, float],
) -> bool:
    """Write one parameter and read it back. Return whether it has the required value."""
    register, where = parameter.register_, where_of(parameter)
    assert register is not None
    try:
        counts, lsb = wanted_setting(parameter, limits, rated_nm, values)
    except CommandRejected as error:
        return table.row(parameter.title, "set from rig.yaml", error.what, False, error.where, error.next_step)
    wanted = show(counts * lsb, parameter)
    if not parameter.writable_in_operation:
        back = access.read(register)
        advice = parameter.advice or f"Set '{parameter.title}' at the drive, and restart the drive"
        return table.row(parameter.title, wanted, show(back * lsb, parameter), back == counts, where, advice)

    def work() -> tuple[str, bool]:
        back = access.change(register, counts)
        return show(back * lsb, parameter), back == counts

    advice = parameter.advice or NOT_KEPT
    return table.attempt(parameter.title, wanted, where, work, advice)


def wanted_setting(parameter: Parameter, limits: DriveLimits, rated_nm: float,
                   values: Mapping[str, float]) -> RegisterSetting:
    """Return the counts for rig.yaml's limit. Raises CommandRejected if the unit or the register can't hold it."""
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
        value = limits.speed_rad_s / _unit(parameter, {"rpm": RAD_S_PER_RPM})
    elif kind in ("torque_limit", "torque_limit_reverse"):
        value = limits.torque_nm / _unit(parameter, {"nm": 1.0, "rated": rated_nm})
        rounding = math.floor
    elif kind == "quick_stop_deceleration":
        value = limits.quick_stop_rad_s2 / _unit(parameter, {"rpm_s": RAD_S_PER_RPM})
    elif kind in ("quick_stop_time", "ramp_up_time"):
        from_rpm = values.get(parameter.times) if parameter.times is not None else limits.speed_rad_s / RAD_S_PER_RPM
        if from_rpm is None:
            raise CommandRejected(f"the speed '{parameter.times}' that it counts from is unknown", where=where)
        value = abs(from_rpm) * RAD_S_PER_RPM / limits.quick_stop_rad_s2 / _unit(parameter, {"s": 1.0})
        rounding = math.floor if kind == "quick_stop_time" else math.ceil
    else:
        value = limits.watchdog_s / _unit(parameter, {"s": 1.0})
        rounding = math.floor
    slack = _SLACK if rounding is math.floor else -_SLACK
    counts = to_counts(value * (1.0 + slack), lsb, register, where, rounding)
    if counts < 1 and LIMIT_SET_BY.get(kind or "") == TORQUE:        # one count would be a wider limit than requested
        raise CommandRejected(
            f"{show(value, parameter)} is less than one count, {show(lsb, parameter)}", where=where,
            next_step="The drive cannot represent so low a limit. Check its scale, and the limit in rig.yaml",
        )
    # A limit of zero counts would switch it off on many drives.
    return RegisterSetting(int(sign) * max(1, counts), lsb)


def _unit(parameter: Parameter, known: Mapping[str, float]) -> float:
    """Return SI for the parameter's unit. Raises CommandRejected for a unit that such a limit can't have."""
    if parameter.unit not in known:
        raise CommandRejected(
            f"a limit in '{parameter.unit}' can't be set for {parameter.set_to}: {' or '.join(known)} can",
            where=where_of(parameter),
            next_step="Correct its unit in the profile",
        )
    return known[parameter.unit]
