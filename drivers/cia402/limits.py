"""The drive's own limits, written and read back: torque, speed, the ramp of a quick stop."""

from __future__ import annotations

import math
from collections.abc import Callable

from drivers.cia402.objects import Objects, name
from drivers.cia402.process_data import decode_value, encode_value
from drivers.drive import Check, DriveLimits, Outcome
from drivers.errors import ObjectRefused, PreflightRefused
from drivers.own_limits import FLOAT_ROUNDING, LIMIT_SET_BY, QUICK_STOP, SPEED, TITLES, TORQUE, OwnLimits
from drivers.preflight import PreflightTable
from profiles import Require, with_unit
from profiles.cia402 import QUICK_STOP_COASTS, Cia402Profile, Parameter
from profiles.quantities import RAD_S_PER_RPM

QUICK_STOP_OPTION, FAULT_REACTION_OPTION = 0x605A, 0x605E
FAULT_COASTS = 0
"""Value of 605Eh with which a fault removes the torque at once (CiA 402-2, 605Eh)."""
_IN_A_FAULT = {
    FAULT_COASTS: "a fault removes the torque at once, and the shaft coasts", 1: "a fault brakes on the slow-down ramp",
    2: "a fault brakes on the quick-stop ramp", 3: "a fault brakes at the current limit",
    4: "a fault brakes at the voltage limit",
}

# ---------------------------------------------------------------------------------------------------------------------
# Settings of the drive that the profile names: read, compared with the required values, and used as scales.


class DriveSettings:
    """The drive's settings by name, in their units, read on request. ``relied_on``: they must not change in a run."""

    def __init__(self, objects: Objects, profile: Cia402Profile, *, relied_on: bool = True) -> None:
        self._objects = objects
        self._profile = profile
        self._relied_on = relied_on

    def value(self, wanted: str) -> float:
        """Return the setting in its unit. Raises ObjectRefused."""
        return self.read(wanted)[1]

    def where(self, wanted: str) -> str:
        """Return the name of its object."""
        one = self._profile.parameter(wanted)
        return name(one.index, one.sub)

    def read(self, wanted: str) -> tuple[float, float]:
        """Return the setting in counts, and in its unit. Raises ObjectRefused."""
        one = self._profile.parameter(wanted)
        where = name(one.index, one.sub)
        data = (self._objects.rely_on(one.title, one.index, one.sub) if self._relied_on
                else self._objects.read_bytes(one.index, one.sub))
        raw = decode_value(one.type, data, where)
        if one.scale == "power_of_two":
            if not 0 <= raw <= 64:
                raise ObjectRefused(f"{raw:g} is not a number of bits from 0 to 64", where=where)
            return raw, float(2.0**raw)
        return raw, raw * self.per_lsb(one)

    def per_lsb(self, one: Parameter) -> float:
        """Return the units for one count. Raises ObjectRefused, also for a scale of zero."""
        factor = 1.0 if one.times is None else self.value(one.times)
        if factor == 0.0 and one.times is not None:
            scale = self._profile.parameter(one.times)
            raise ObjectRefused(f"{scale.title} reads 0", where=name(scale.index, scale.sub))
        return one.per_lsb * factor


def check_parameters(table: PreflightTable, objects: Objects, profile: Cia402Profile) -> None:
    """Add one row for each setting that the operator must set; tdhil writes none of them."""
    settings = DriveSettings(objects, profile)
    for one in profile.parameters:
        if one.require is None:
            continue

        def work(one: Parameter = one, require: Require = one.require) -> tuple[str, bool]:
            value = settings.value(one.name)
            return with_unit(value, one.unit), require.met_by(value, FLOAT_ROUNDING * abs(value))

        table.attempt(
            one.title, one.require.text_in(one.unit), name(one.index, one.sub), work,
            one.advice or "Set it at the drive; tdhil does not write it",
        )


# ---------------------------------------------------------------------------------------------------------------------


def set_limits(
    table: PreflightTable, objects: Objects, profile: Cia402Profile, limits: DriveLimits, rated_nm: float,
    own: OwnLimits
) -> None:
    """Write the drive's own torque limit, speed limit and quick stop and read them back, where ``own`` permits it."""
    elsewhere = {one.set_to for one in profile.parameters}
    torque_lsb = profile.torque.max_torque_rated_per_lsb
    if torque_lsb is not None:
        lsb = torque_lsb * rated_nm
        _limit(table, objects, own, TORQUE, "torque limit", 0x6072, limits.torque_nm, lsb, 16, "N·m", math.floor)
    elif "torque_limit" not in elsewhere:
        table.note("torque limit", "the drive has no 6072h; only the guard and the setpoint of the host limit torque")
    speed_lsb = profile.speed.max_motor_speed_rpm_per_lsb
    if speed_lsb is not None:
        lsb = speed_lsb * RAD_S_PER_RPM
        _limit(table, objects, own, SPEED, "speed limit", 0x6080, limits.speed_rad_s, lsb, 32, "rad/s", math.ceil)
    elif "speed_limit" not in elsewhere:
        table.note("speed limit", "the drive has no 6080h; set its own speed limit at the drive")
    settings = DriveSettings(objects, profile)
    for one in profile.parameters:
        # The speed that a ramp starts from is itself a limit, so it is set before the ramp is computed.
        if one.set_to is not None and one.from_speed is None:
            _set(table, objects, settings, one, limits, rated_nm, own)
    for one in profile.parameters:
        if one.from_speed is not None:
            _set(table, objects, settings, one, limits, rated_nm, own)
    ramp_lsb = profile.quick_stop.deceleration_rpm_s_per_lsb
    if ramp_lsb is not None:
        ramp, lsb = limits.quick_stop_rad_s2, ramp_lsb * RAD_S_PER_RPM
        _limit(table, objects, own, QUICK_STOP, "quick-stop ramp", 0x6085, ramp, lsb, 32, "rad/s²", math.ceil)
    _set_quick_stop_option(table, objects, profile.quick_stop.option_code)
    _note_fault_reaction(table, objects, profile.watchdog.reaction == "fault_reaction")


def _set_quick_stop_option(table: PreflightTable, objects: Objects, code: int | None) -> None:
    """Write the profile's quick-stop option and read it back. Without one, refuse a drive whose quick stop coasts."""
    title, where = "quick-stop option", name(QUICK_STOP_OPTION)
    if code is not None:
        table.attempt(title, str(code), where, lambda: _same(objects.change(QUICK_STOP_OPTION, 0, code, 16), code))
        return
    try:
        data = objects.read_bytes(QUICK_STOP_OPTION)
    except ObjectRefused as error:
        found = f"not readable: {error.what}. The drive's own setting decides how a quick stop brakes"
        table.note(title, found, where, "Check at the drive that its quick stop brakes the shaft")
        return
    objects.stands[QUICK_STOP_OPTION, 0] = data
    option = int.from_bytes(data, "little", signed=True)
    coasts = option == QUICK_STOP_COASTS
    table.row(
        title, f"not {QUICK_STOP_COASTS}", f"{option}: quick stop lets the shaft coast" if coasts else str(option),
        not coasts, where, f"Set {where} to 6 at the drive, so that its quick stop brakes the shaft",
    )


def _note_fault_reaction(table: PreflightTable, objects: Objects, trips: bool) -> None:
    """Add a row of the drive's reaction to a fault, 605Eh, which is not written.

    ``trips``: the drive's watchdog trips into a fault. Then a row states a missing object, too, and the setting must
    not change during the run.
    """
    title, where = "fault reaction", name(FAULT_REACTION_OPTION)
    try:
        data = (objects.rely_on("the fault reaction", FAULT_REACTION_OPTION) if trips
                else objects.read_bytes(FAULT_REACTION_OPTION))
    except ObjectRefused:
        if trips:
            table.note(title, "not in the drive", where, "Check at the drive that a fault brakes the shaft")
        return
    option = int.from_bytes(data, "little", signed=True)
    text = _IN_A_FAULT.get(option, "a reaction of the manufacturer, unknown to tdhil" if option < 0 else "reserved")
    mend = "" if option in _IN_A_FAULT else "See the drive's manual"
    if option == FAULT_COASTS:
        mend = f"Set {where} to 2 at the drive, so that a fault brakes the shaft"
    table.note(title, f"{option}: {text}", where, mend)


def note_temperature(table: PreflightTable, limit_c: float | None) -> None:
    """Add the temperature row. CiA 402 has no temperature object, so a limit cannot be enforced."""
    if limit_c is None:
        text = "not supervised by tdhil: CiA 402 has no object for it; the drive reports overheating by an EMCY"
        table.note("temperature", text, "profile")
    else:
        table.row("temperature limit", f"{limit_c:g} °C", "not supervised: CiA 402 has no temperature object", False,
                  "limits.temperature_c", "Remove it from rig.yaml: it has no effect on CANopen")


def _set(
    table: PreflightTable, objects: Objects, settings: DriveSettings, one: Parameter, limits: DriveLimits,
    rated_nm: float,
    own: OwnLimits
) -> None:
    """Write one parameter of the profile that holds a limit; the row's numbers are in the parameter's unit."""
    where, mend = name(one.index, one.sub), one.advice or ""
    limit, title = LIMIT_SET_BY[one.set_to or ""], TITLES[one.set_to or ""]
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

        def in_unit(data: bytes) -> str:
            return with_unit(shown(data), one.unit, 6)

        def braking(value: float) -> float:
            """Convert the time of a ramp to its deceleration; a time of 0 means no ramp."""
            if one.from_speed is None:
                return value * (RAD_S_PER_RPM if limit is QUICK_STOP else 1.0)
            return RAD_S_PER_RPM * settings.value(one.from_speed) / value if value > 0.0 else math.inf

        if own.stays(limit, braking(shown(wanted)), braking(shown(before))):
            si = abs(shown(before)) * {"rpm": RAD_S_PER_RPM, "rated": rated_nm}.get(one.unit, 1.0)
            objects.stands[one.index, one.sub] = before
            own.keep(table, limit, title, wished, in_unit(before), si, where)
            return
        back = objects.change_bytes(one.index, one.sub, wanted)
        own.written(
            table, limit, title, wished, in_unit(back), in_unit(before), back == wanted, where, mend,
            wider=own.wider(limit, braking(shown(wanted)), braking(shown(before))),
        )
    except PreflightRefused as error:
        table.checks.append(
            Check(title, wished, error.what, Outcome.REFUSED, error.where or where, mend or error.next_step)
        )


def _count(settings: DriveSettings, one: Parameter, limits: DriveLimits, rated_nm: float) -> float:
    """Return the limit in the parameter's unit, rounded to its counts: torque down, speed and braking up."""
    per_lsb = settings.per_lsb(one)
    nm = 1.0 if one.unit == "nm" else 1.0 / rated_nm
    if one.set_to == "torque_limit":
        return _rounded(one, limits.torque_nm * nm, per_lsb, math.floor)
    if one.set_to == "torque_limit_reverse":
        return -_rounded(one, limits.torque_nm * nm, per_lsb, math.floor)
    if one.set_to == "speed_limit":
        return _rounded(one, limits.speed_rad_s / RAD_S_PER_RPM, per_lsb, math.ceil)
    if one.set_to == "speed_limit_reverse":
        return -_rounded(one, limits.speed_rad_s / RAD_S_PER_RPM, per_lsb, math.ceil)
    ramp_rpm_s = limits.quick_stop_rad_s2 / RAD_S_PER_RPM
    if one.from_speed is None:
        return _rounded(one, ramp_rpm_s, per_lsb, math.ceil)
    return _rounded(one, settings.value(one.from_speed) / ramp_rpm_s, per_lsb, math.floor)


def _rounded(one: Parameter, value: float, per_lsb: float, rounding: Callable[[float], int]) -> float:
    if one.type == "f32":
        return value
    counts = rounding(value / per_lsb * (1.0 + (1e-9 if rounding is math.floor else -1e-9)))
    if counts > 0xFFFF_FFFF:
        raise ObjectRefused(f"{value:g} is above the range of the object", where=name(one.index, one.sub))
    if counts < 1 and LIMIT_SET_BY[one.set_to or ""] == TORQUE:      # one count would be a wider limit than requested
        raise ObjectRefused(f"{value:g} is less than one count, {per_lsb:g}", where=name(one.index, one.sub))
    counts = max(1, counts)
    return counts * per_lsb


def _limit(
    table: PreflightTable,
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
    # Slack of 1e-9: a limit of a whole number of LSB must not lose one LSB to rounding.
    slack = 1e-9 if rounding is math.floor else -1e-9
    counts = rounding(value / per_lsb * (1.0 + slack))
    raw = max(1, counts)
    wanted, where = f"{raw * per_lsb:.6g} {unit}", name(index)
    if counts < 1 and limit == TORQUE:     # one count would be a wider limit than requested
        table.row(title, f"{value:g} {unit}", f"one count is {per_lsb:g} {unit}", False, where,
                  "The limit is below one count. Check the unit in the profile and the limit in rig.yaml")
        return
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
