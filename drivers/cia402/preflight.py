"""Checks and settings of a CiA 402 drive before its shaft may move; each row shows the value read back.

A failed row does not end the table: the engineer sees all rows.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import NamedTuple

from drivers.cia402.description import text_if_there
from drivers.cia402.limits import FAULT_COASTS, FAULT_REACTION_OPTION, QUICK_STOP_OPTION, DriveSettings
from drivers.cia402.objects import Objects, name, place
from drivers.cia402.polling import reported_torque
from drivers.cia402.process_data import (
    MODE_NAMES,
    TARGET_VELOCITY,
    VELOCITY_ACTUAL,
    VL_ACTUAL,
    VL_TARGET,
    Units,
    decode_value,
)
from drivers.cia402.state_machine import State, decode
from drivers.drive import DriveLimits, Identity, Mode, Preflight, ReportingFilters
from drivers.errors import CommunicationLost, ObjectRefused, PreflightRefused
from drivers.own_limits import SPEED, TORQUE
from drivers.preflight import PreflightTable, agreed_rated_torque, check_nothing_held
from drivers.speed_loop import ReadSetting, read_speed_loop
from drivers.standstill import standstill_limit_rad_s
from drivers.undo_journal import Change, UndoJournal, restore_left
from profiles import MARKER_INDEX, MARKER_TEXT, MessageCode
from profiles.cia402 import Cia402Profile, ReportingFilter
from profiles.quantities import RAD_S_PER_RPM

# ---------------------------------------------------------------------------------------------------------------------
# Filters on the reported signals of a drive, read from the objects that its profile names.


_FORMATS = {"u8": "<B", "u16": "<H", "u32": "<I", "i8": "<b", "i16": "<h", "i32": "<i", "f32": "<f"}


def read_filters(note: Callable[[str, str, str], None], objects: Objects, profile: Cia402Profile) -> ReportingFilters:
    """Return first-order lags in seconds, None if the drive does not report one; add each to the preflight table."""
    lags: dict[str, float] = {}
    sources = []
    for entry in profile.filters:
        where = name(entry.index, entry.sub)
        try:
            data = objects.rely_on(f"the filter of the reported {entry.signal}", entry.index, entry.sub)
            lag_s = lag_seconds(entry, data)
        except ObjectRefused:
            note(f"{entry.signal} filter", "not reported by the drive", where)
            continue
        note(f"{entry.signal} filter", f"{lag_s * 1000.0:.4g} ms", where)
        lags[entry.signal] = lag_s
        sources.append(f"{entry.signal} {where}")
    return ReportingFilters(lags.get("speed"), lags.get("torque"), ", ".join(sources))


def lag_seconds(entry: ReportingFilter, data: bytes) -> float:
    """Convert the object's bytes to a time constant. A cut-off frequency f_c is a lag of 1/(2π f_c); 0: no filter."""
    layout = struct.Struct(_FORMATS[entry.type])
    if len(data) < layout.size:
        raise ObjectRefused(f"{len(data)} bytes where {layout.size} were expected", where=name(entry.index, entry.sub))
    value = float(layout.unpack_from(data)[0]) * entry.per_lsb
    if not math.isfinite(value) or value < 0.0:
        raise ObjectRefused(f"{value} is not a valid filter setting", where=name(entry.index, entry.sub))
    if entry.quantity == "time_constant_s":
        return value
    return 1.0 / (2.0 * math.pi * value) if value > 0.0 else 0.0


# ---------------------------------------------------------------------------------------------------------------------
# Value of one count of speed and torque on this drive: from the drive if it reports it, else from the rig.


SI_UNIT_VELOCITY = 0x60A9


def find_units(
    table: PreflightTable, objects: Objects, profile: Cia402Profile, rated_torque_nm: float | None
) -> tuple[Units, float]:
    """Return the scaling of speed and torque, and the rated torque, N·m."""
    rated, per_lsb = profile.torque.rated, profile.torque.rated_torque_nm_per_lsb
    where, reported_nm = name(rated.index, rated.sub), None
    if per_lsb is not None:
        with suppress(ObjectRefused):
            raw = decode_value(rated.type, objects.rely_on("the rated torque", rated.index, rated.sub), where)
            reported_nm = raw * per_lsb if raw > 0.0 else None      # a rated torque of 0 is none
    agreed_nm = agreed_rated_torque(table, reported_nm, rated_torque_nm, where)
    rated_nm = 1.0 if agreed_nm is None else agreed_nm       # refused; the following rows still need a scale
    speed = speed_unit(table, objects, profile)
    target = profile.torque.rated_per_lsb * rated_nm
    actual = profile.torque.actual
    if actual is None:
        return Units(speed, target), rated_nm
    return Units(speed, actual.per_lsb * (rated_nm if actual.unit == "rated" else 1.0), target), rated_nm


def speed_unit(table: PreflightTable, objects: Objects, profile: Cia402Profile) -> float:
    """Return rad/s for one count. If the unit can be set, it must read back as required."""
    speed = profile.speed
    if speed.si_unit is not None:
        wanted = speed.si_unit

        def same() -> tuple[str, bool]:
            found = objects.rely_on_value("the unit of speed", SI_UNIT_VELOCITY)
            return f"{found:08X}h", found == wanted

        table.attempt(
            "unit of speed", f"{wanted:08X}h", name(SI_UNIT_VELOCITY), same,
            f"Every speed would be scaled wrongly. Set 60A9h to {wanted:08X}h, as in profile {profile.name}",
        )
    per_lsb = speed.rpm_per_lsb * RAD_S_PER_RPM
    if not (speed.times or speed.over):
        return per_lsb
    settings = DriveSettings(objects, profile)
    found = per_lsb

    def work() -> tuple[str, bool]:
        nonlocal found
        product = per_lsb
        for scale in speed.times:
            product *= _nonzero(settings.value(scale), scale)
        for scale in speed.over:
            product /= _nonzero(settings.value(scale), scale)
        found = product
        return f"{product / RAD_S_PER_RPM:.6g} rpm for one count", True

    scales = [profile.parameter(scale) for scale in (*speed.times, *speed.over)]
    table.attempt(
        "unit of speed", "known", ", ".join(name(one.index, one.sub) for one in scales), work,
        "The speed can't be scaled without it. " + " ".join(dict.fromkeys(one.advice for one in scales if one.advice)),
    )
    return found


def _nonzero(value: float, scale: str) -> float:
    if value <= 0.0:
        raise ObjectRefused(f"{scale} reads {value:g}")
    return value


# ---------------------------------------------------------------------------------------------------------------------

_HOLDS_FROM, _LAST_OPTION = 5, 8
"""CiA 402-2, 605Ah: from code 5 on the drive stays in quick stop active; codes above 8 are reserved."""

STILL_LSB = 5
"""Noise of the velocity at standstill before motion, counts."""


def check_identity(table: PreflightTable, identity: Identity, profile: Cia402Profile) -> None:
    """Check vendor, product and revision (1018h) against the profile; None there means not checked."""
    wanted = profile.identity
    pairs = (
        ("vendor", wanted.vendor, identity.vendor),
        ("product", wanted.product, identity.product),
        ("revision", wanted.revision, identity.revision),
    )
    asked = [(title, want, have) for title, want, have in pairs if want is not None]
    if not asked:
        table.note(
            "identity",
            f"vendor {identity.vendor:X}h product {identity.product:X}h, not checked by {profile.name}",
            "1018h",
        )
    for title, want, have in asked:
        table.row(
            f"identity: {title}",
            f"{want:X}h",
            f"{have:X}h",
            want == have,
            "1018h",
            f"This is not the drive of profile {profile.name}: choose the right profile with --profile",
        )


def restore_from(table: PreflightTable, objects: Objects, journal: UndoJournal, identity: Identity) -> None:
    """Restore the settings that an earlier run left in the drive because its host died, if they are unchanged."""
    def give_back(one: Change) -> bool:
        index, sub = place(one.where)
        unchanged = objects.read_bytes(index, sub) == one.after
        if unchanged:
            objects.write_bytes(index, sub, one.before)
        return unchanged

    restore_left(table, journal, journal.opened(identity), give_back)
    objects.journal = journal


def check_state(
    table: PreflightTable, objects: Objects, units: Units, profile: Cia402Profile, limits: DriveLimits
) -> bool:
    """Refuse a drive in fault (it is never reset silently), and one that still brakes after an earlier stop.

    Return whether settings may be written: not while it brakes, nor while it holds a drill string with trapped torque.
    """
    state = decode(objects.read(0x6041))
    faulty = state in (State.FAULT, State.FAULT_REACTION_ACTIVE)
    code = objects.read_if_there(0x603F)
    found = state.value + (f", error code {code:04X}h" if faulty and code is not None else "")
    braking, still = state is State.FAULT_REACTION_ACTIVE, True
    if state is State.QUICK_STOP_ACTIVE:
        # Disabling would let it coast: it must first reach standstill by its own quick stop.
        speed_lsb = objects.read((VL_ACTUAL if profile.speed.vl else VELOCITY_ACTUAL)[0], signed=True)
        count_rad_s = units.speed_rad_s_per_lsb
        braking = abs(speed_lsb) * count_rad_s > standstill_limit_rad_s(count_rad_s, STILL_LSB)
        found += f", velocity {speed_lsb}"
    mend = "Clear the fault's cause, then start with --reset-fault" if faulty else "Wait for standstill"
    if state is State.UNKNOWN:
        mend = "Check the drive behind a gateway, and whether --profile fits this drive"
    known = not faulty and not braking and state is not State.UNKNOWN
    table.row("state", "no fault, standstill", found, known, "6041h", mend)
    if state is State.QUICK_STOP_ACTIVE and not braking and limits.string:
        counts = reported_torque(objects, profile)
        held_nm = None if counts is None else counts * units.torque_nm_per_lsb
        still = check_nothing_held(table, held_nm, limits.torque_nm, units.torque_nm_per_lsb, "6077h")
    if braking or not still:
        table.note("settings", "nothing was written to the drive, because it brakes or holds the shaft", "driver")
    return still and not braking


def refuse_if_driven(objects: Objects) -> None:
    """Refuse an enabled drive before a frame could change a turning shaft's motion. Raises PreflightRefused."""
    if decode(objects.read(0x6041)) is State.OPERATION_ENABLED:
        raise PreflightRefused(
            "the drive is already enabled by another master",
            where="6041h",
            next_step="Stop the shaft with that master, disable the drive there, and disconnect the master. Without a"
            " master: tdhil stop. Nothing was written to the drive",
            entry=MessageCode.ANOTHER_MASTER,
        )


def choose_modes(
    table: PreflightTable, objects: Objects, profile: Cia402Profile, with_offset: bool = False
) -> dict[Mode, int]:
    """Choose the first of the profile's modes that the drive supports (6502h), for speed and for torque.

    With ``with_offset``, only speed modes in which the drive adds a torque offset are used.
    """
    supported = objects.read_if_there(0x6502)
    chosen: dict[Mode, int] = {}
    adding = profile.torque_offset.modes if with_offset and profile.torque_offset is not None else profile.modes.speed
    speed = [code for code in profile.modes.speed if code in adding]
    for mode, codes in ((Mode.SPEED, speed), (Mode.TORQUE, profile.modes.torque)):
        for code in codes:
            if supported is None or code < 1 or supported >> code - 1 & 1:
                chosen[mode] = code
                break
    found = ", ".join(f"{mode.value}: {code} ({MODE_NAMES.get(code, 'manufacturer')})" for mode, code in chosen.items())
    table.row(
        "modes of operation", "speed (and torque)", found or "none", Mode.SPEED in chosen, "6502h",
        f"The drive supports none of the speed modes of profile {profile.name}",
    )
    return chosen


def check_mode_display(table: PreflightTable, objects: Objects, code: int, wait: Callable[[], None]) -> None:
    """Write 6060h while the drive is disabled; 6061h must follow."""

    def work() -> tuple[str, bool]:
        if objects.read_if_there(0x6060) is None:      # write-only in some drives: its former value is unknown
            objects.write(0x6060, 0, code, 8)
        else:
            objects.change(0x6060, 0, code, 8)
        shown = objects.read(0x6061, signed=True)
        for _ in range(20):
            if shown == code:
                break
            wait()
            shown = objects.read(0x6061, signed=True)
        return str(shown), shown == code

    table.attempt(
        f"mode display for {code}", str(code), "6061h", work, "The drive does not accept this mode; see its manual"
    )


def clear_targets(table: PreflightTable, objects: Objects, profile: Cia402Profile) -> None:
    """Set the targets to zero: a setpoint of an earlier run must not act when the drive is enabled."""
    index, _, bits = VL_TARGET if profile.speed.vl else TARGET_VELOCITY
    targets = ((0x6071, 16), (index, bits)) if profile.modes.torque else ((index, bits),)
    offset = profile.torque_offset
    if offset is not None and objects.read_if_there(offset.index, offset.sub):
        targets = (*targets, (offset.index, 16))       # left by a host that died

    def work() -> tuple[str, bool]:
        for index, bits in targets:
            objects.write(index, 0 if offset is None or index != offset.index else offset.sub, 0, bits)
        return "0", True

    table.attempt("targets", "0", ", ".join(f"{index:04X}h" for index, _ in targets), work)


def find_torque_offset(
    table: PreflightTable, objects: Objects, profile: Cia402Profile, rated_nm: float
) -> tuple[tuple[int, int, int], float] | None:
    """Return index, subindex and bits of the torque offset, and N·m per count; None if refused, with the reason."""
    entry = profile.torque_offset
    if entry is None:
        table.row(
            "torque offset", "there", f"profile {profile.name} has none", False, "profile, torque_offset",
            "Measure the drive's impedance from its speed reference instead (--impedance reference)",
        )
        return None
    where = name(entry.index, entry.sub)

    def work() -> tuple[str, bool]:
        objects.write(entry.index, entry.sub, 0, 16)
        return str(objects.read(entry.index, entry.sub, signed=True)), True

    if not table.attempt("torque offset", "0", where, work, "The drive has no torque offset: see its manual"):
        return None
    return (entry.index, entry.sub, 16), entry.rated_per_lsb * rated_nm


def quick_stop_holds(objects: Objects, profile: Cia402Profile) -> bool | None:
    """Return whether the drive holds the shaft after a quick stop, by the profile and 605Ah.

    CiA 402-2, 605Ah: with 5 to 8 it stays in quick stop active, with 0 to 4 it switches its torque off; negative codes
    are the manufacturer's. None if neither the drive nor the profile states it.
    """
    entry = profile.quick_stop
    if entry.ends == "off":
        return False
    code = objects.read_if_there(QUICK_STOP_OPTION, signed=True)
    if code is None and entry.option_code is None:
        return True if "ends" in entry.model_fields_set else None
    return None if code is None or code < 0 or code > _LAST_OPTION else code >= _HOLDS_FROM


def _safe_action(objects: Objects, profile: Cia402Profile) -> str:
    """Return the reaction of the drive to a silent host: coast for a fault reaction that removes the torque (605Eh)."""
    found = objects.relied_on.get((FAULT_REACTION_OPTION, 0))     # there only if the watchdog trips into a fault
    coasts = found is not None and int.from_bytes(found[1], "little") == FAULT_COASTS
    return "coast" if coasts else profile.watchdog.reaction


class AngleComing(NamedTuple):
    """Resolution of the motor's angle, its period at the cycle in use, and the longest permitted period."""

    resolution_rad: float = 0.0
    period_s: float | None = None
    gap_s: float = math.inf


def report(
    table: PreflightTable,
    identity: Identity,
    profile: Cia402Profile,
    objects: Objects,
    units: Units,
    rated_nm: float,
    modes: dict[Mode, int],
    watchdog_s: float,
    kept: Mapping[str, float],
    angle: AngleComing,
) -> Preflight:
    """Return the table with the properties of the drive."""
    filters = read_filters(table.note, objects, profile)
    settings = DriveSettings(objects, profile, relied_on=False)      # no run depends on the gains
    speed_loop = read_speed_loop(
        table, profile.speed_controller, lambda wanted: ReadSetting(*settings.read(wanted)), settings.where,
        simulated=identity.simulated,
    )
    return Preflight(
        identity=identity,
        checks=tuple(table.checks),
        modes=frozenset(modes),
        switch_while_enabled=profile.modes.switch_while_enabled,
        quick_stop_in_torque_mode=profile.quick_stop.decelerates_in_torque_mode,
        rated_torque_nm=rated_nm,
        torque_resolution_nm=units.torque_nm_per_lsb,
        speed_resolution_rad_s=units.speed_rad_s_per_lsb,
        watchdog_s=watchdog_s,
        safe_action=_safe_action(objects, profile) if watchdog_s else "none",
        filters=filters,
        speed_loop=speed_loop,
        torque_setpoint="6071h",
        torque_offset_resolution_nm=units.offset_nm_per_lsb,
        kept_torque_nm=kept.get(TORQUE),
        kept_speed_rad_s=kept.get(SPEED),
        quick_stop_holds=quick_stop_holds(objects, profile),
        position_resolution_rad=angle.resolution_rad,
        position_period_s=angle.period_s,
        position_gap_s=angle.gap_s,
    )


# ---------------------------------------------------------------------------------------------------------------------
# Identity of the drive (CiA 301: 1000h, 1018h, 1008h, 100Ah).


def find_free_node(objects: Objects) -> None:
    """Check that the node answers and that no other master drives it. Writes nothing. Raises PreflightRefused."""
    try:
        objects.read(0x1000)
    except CommunicationLost as error:
        if error.entry in (MessageCode.NODE_SILENT, CommunicationLost.entry):
            raise PreflightRefused(error.what, where=error.where, next_step=error.next_step,
                                   entry=MessageCode.NO_DRIVE_FOUND) from error
        # a drive with a wrong answer is there, and a bus that failed is a cause of its own
        raise PreflightRefused(error.what, where=error.where, next_step=error.next_step) from error
    refuse_if_driven(objects)


def read_identity(objects: Objects) -> Identity:
    """Return vendor, product, revision and serial number (0 if absent), name, firmware, and whether it is simulated.

    The name and the manufacturer's software version (100Ah) are optional texts of CiA 301.
    """
    vendor, product, revision, serial = (objects.read_if_there(0x1018, sub) or 0 for sub in (1, 2, 3, 4))
    title = text_if_there(objects, 0x1008)
    return Identity(vendor, product, revision, serial, "CiA 402 drive" if title is None else title,
                    text_if_there(objects, MARKER_INDEX, 1) == MARKER_TEXT, text_if_there(objects, 0x100A) or "")


def refuse_stepped(identity: Identity) -> None:
    """Refuse a real drive in stepped time. Raises PreflightRefused."""
    if not identity.simulated:
        raise PreflightRefused(
            "stepped time was requested, but the peer does not have the simulator's marker",
            where=name(MARKER_INDEX, 1),
            next_step="Remove --stepped: a real shaft moves in real time",
            entry=MessageCode.NOT_THE_SIMULATOR,
        )
