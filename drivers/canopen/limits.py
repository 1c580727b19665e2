"""The drive's own limits, written and read back: torque, speed, the ramp of a quick stop."""

from __future__ import annotations

import math
from collections.abc import Callable

from drivers.canopen.sdo import Objects, name
from drivers.cia402.objects import RPM
from drivers.cia402.parameters import Settings
from drivers.cia402.values import decode_value, encode_value
from drivers.drive import Check, Limits, Outcome
from drivers.errors import ObjectRefused, PreflightRefused
from drivers.own_limits import QUICK_STOP, SPEED, TORQUE, OwnLimits
from drivers.preflight import Table
from profiles.canopen import CanopenProfile
from profiles.canopen_parameter import Parameter

_LIMIT = {
    "torque_limit": TORQUE, "torque_limit_reverse": TORQUE, "speed_limit": SPEED, "speed_limit_reverse": SPEED,
    "quick_stop_time": QUICK_STOP, "quick_stop_deceleration": QUICK_STOP,
}
_TITLES = {
    "torque_limit": "torque limit", "torque_limit_reverse": "torque limit, reverse", "speed_limit": "speed limit",
    "speed_limit_reverse": "speed limit, reverse", "quick_stop_time": "quick-stop ramp",
    "quick_stop_deceleration": "quick-stop ramp",
}


def set_limits(
    table: Table, objects: Objects, profile: CanopenProfile, limits: Limits, rated_nm: float, own: OwnLimits
) -> None:
    """The drive's own torque limit, speed limit and quick stop, written and read back; ``own`` says which may be."""
    elsewhere = {one.set_to for one in profile.parameters}
    torque_lsb = profile.torque.max_torque_rated_per_lsb
    if torque_lsb is not None:
        lsb = torque_lsb * rated_nm
        _limit(table, objects, own, TORQUE, "torque limit", 0x6072, limits.torque_nm, lsb, 16, "N·m", math.floor)
    elif "torque_limit" not in elsewhere:
        table.note("torque limit", "the drive has no 6072h: the host alone limits it, by the guard and the setpoint")
    speed_lsb = profile.speed.max_motor_speed_rpm_per_lsb
    if speed_lsb is not None:
        lsb = speed_lsb * RPM
        _limit(table, objects, own, SPEED, "speed limit", 0x6080, limits.speed_rad_s, lsb, 32, "rad/s", math.ceil)
    elif "speed_limit" not in elsewhere:
        table.note("speed limit", "the drive has no 6080h: set its own speed limit by hand")
    settings = Settings(objects, profile)
    for one in profile.parameters:
        # What a ramp begins at is itself a limit: it has to stand before the ramp is worked out.
        if one.set_to is not None and one.from_speed is None:
            _set(table, objects, settings, one, limits, rated_nm, own)
    for one in profile.parameters:
        if one.from_speed is not None:
            _set(table, objects, settings, one, limits, rated_nm, own)
    ramp_lsb = profile.quick_stop.deceleration_rpm_s_per_lsb
    if ramp_lsb is not None:
        ramp, lsb = limits.quick_stop_rad_s2, ramp_lsb * RPM
        _limit(table, objects, own, QUICK_STOP, "quick-stop ramp", 0x6085, ramp, lsb, 32, "rad/s²", math.ceil)
    code = profile.quick_stop.option_code
    if code is not None:
        table.attempt(
            "quick-stop option", str(code), "605Ah", lambda: _same(objects.change(0x605A, 0, code, 16), code)
        )


def note_temperature(table: Table, limit_c: float | None) -> None:
    """CiA 402 has no object for one: nobody watches it here, and a limit would not be held."""
    if limit_c is None:
        text = "nobody watches it: CiA 402 has no object for one; the drive itself reports it by an EMCY"
        table.note("temperature", text, "profile")
    else:
        table.row("temperature limit", f"{limit_c:g} °C", "CiA 402 has no object for a temperature", False,
                  "limits.temperature_c", "Take it out of rig.yaml: it would not be held on CANopen")


def _set(
    table: Table, objects: Objects, settings: Settings, one: Parameter, limits: Limits, rated_nm: float, own: OwnLimits
) -> None:
    """One parameter of the profile that holds a limit; the row's numbers are in the parameter's unit."""
    where, mend = name(one.index, one.sub), one.advice or ""
    limit, title = _LIMIT[one.set_to or ""], _TITLES[one.set_to or ""]
    unit = {"rpm": " rpm", "rpm_s": " rpm/s", "nm": " N·m", "rated": " x rated torque", "s": " s"}.get(one.unit, "")
    wished = {
        "torque_limit": f"{limits.torque_nm:g} N·m", "torque_limit_reverse": f"{-limits.torque_nm:g} N·m",
        "speed_limit": f"{limits.speed_rad_s:g} rad/s", "speed_limit_reverse": f"{-limits.speed_rad_s:g} rad/s",
    }.get(one.set_to or "", f"{limits.quick_stop_rad_s2:g} rad/s²")
    try:
        per_lsb = settings.per_lsb(one)
        wanted = encode_value(one.type, _count(settings, one, limits, rated_nm) / per_lsb, where)
        before = objects.read_bytes(one.index, one.sub)

        def shown(data: bytes) -> float:
            return decode_value(one.type, data, where) * per_lsb

        def braking(value: float) -> float:
            """A time that a ramp takes → its deceleration; a time of 0 is no ramp at all."""
            if one.from_speed is None:
                return value * (RPM if limit is QUICK_STOP else 1.0)
            return RPM * settings.value(one.from_speed) / value if value > 0.0 else math.inf

        if own.stays(limit, braking(shown(wanted)), braking(shown(before))):
            si = abs(shown(before)) * {"rpm": RPM, "rated": rated_nm}.get(one.unit, 1.0)
            objects.stands[one.index, one.sub] = before
            own.keep(table, limit, title, wished, f"{shown(before):.6g}{unit}", si, where)
            return
        back = objects.change_bytes(one.index, one.sub, wanted)
        own.written(
            table, limit, title, wished, f"{shown(back):.6g}{unit}", f"{shown(before):.6g}{unit}", back == wanted,
            where, mend, wider=own.wider(limit, braking(shown(wanted)), braking(shown(before))),
        )
    except PreflightRefused as error:
        table.checks.append(
            Check(title, wished, error.what, Outcome.REFUSED, error.where or where, mend or error.next_step)
        )


def _count(settings: Settings, one: Parameter, limits: Limits, rated_nm: float) -> float:
    """The limit in the parameter's unit, rounded to its counts: torque down, speed and braking up."""
    per_lsb = settings.per_lsb(one)
    nm = 1.0 if one.unit == "nm" else 1.0 / rated_nm
    if one.set_to == "torque_limit":
        return _rounded(one, limits.torque_nm * nm, per_lsb, math.floor)
    if one.set_to == "torque_limit_reverse":
        return -_rounded(one, limits.torque_nm * nm, per_lsb, math.floor)
    if one.set_to == "speed_limit":
        return _rounded(one, limits.speed_rad_s / RPM, per_lsb, math.ceil)
    if one.set_to == "speed_limit_reverse":
        return -_rounded(one, limits.speed_rad_s / RPM, per_lsb, math.ceil)
    ramp_rpm_s = limits.quick_stop_rad_s2 / RPM
    if one.from_speed is None:
        return _rounded(one, ramp_rpm_s, per_lsb, math.ceil)
    return _rounded(one, settings.value(one.from_speed) / ramp_rpm_s, per_lsb, math.floor)


def _rounded(one: Parameter, value: float, per_lsb: float, rounding: Callable[[float], int]) -> float:
    if one.type == "f32":
        return value
    counts = max(1, rounding(value / per_lsb * (1.0 + (1e-9 if rounding is math.floor else -1e-9))))
    if counts > 0xFFFF_FFFF:
        raise ObjectRefused(f"{value:g} is out of its range", where=name(one.index, one.sub))
    return counts * per_lsb


def _limit(
    table: Table,
    objects: Objects,
    own: OwnLimits,
    limit: str,
    title: str,
    index: int,
    value: float,
    per_lsb: float,
    bits: int,
    unit: str,
    rounding: Callable[[float], int],
) -> None:
    # One part in 10^9 of slack: a limit that is a whole number of LSB must not lose one to the last bit.
    slack = 1e-9 if rounding is math.floor else -1e-9
    raw = max(1, rounding(value / per_lsb * (1.0 + slack)))
    wanted, where = f"{raw * per_lsb:.6g} {unit}", name(index)
    try:
        data = objects.read_bytes(index)
        before = int.from_bytes(data, "little")
        found = f"{before * per_lsb:.6g} {unit}"
        if own.stays(limit, raw, before):
            objects.stands[index, 0] = data
            own.keep(table, limit, title, wanted, found, before * per_lsb, where)
            return
        back = objects.change(index, 0, raw, bits)
        now, wider = f"{back * per_lsb:.6g} {unit}", own.wider(limit, raw, before)
        own.written(table, limit, title, wanted, now, found, back == raw, where, wider=wider)
    except PreflightRefused as error:
        table.checks.append(Check(title, wanted, error.what, Outcome.REFUSED, error.where or where, error.next_step))


def _same(found: int, wanted: int) -> tuple[str, bool]:
    return str(found), found == wanted
