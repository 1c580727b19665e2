"""What is checked and set on a CiA 402 drive before its shaft may move: each line with what was read back.

A line that fails does not hide those after it: the whole table is worth more to an engineer than its first row.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from drivers.canopen.sdo import Objects, place
from drivers.canopen.state_machine import State, decode
from drivers.cia402.filters import read_filters
from drivers.cia402.objects import MODE_NAMES, TARGET_VELOCITY, VELOCITY_ACTUAL, VL_ACTUAL, VL_TARGET, Units
from drivers.drive import Identity, Mode, Preflight
from drivers.errors import ObjectRefused, PreflightRefused
from drivers.left_behind import LeftBehind
from drivers.own_limits import SPEED, TORQUE
from drivers.preflight import Table
from profiles.canopen import CanopenProfile

_HOLDS_FROM, _LAST_OPTION = 5, 8
"""CiA 402-2, 605Ah: codes after which quick stop active is kept; above the second they are reserved."""

STILL_LSB, STILL_RAD_S = 5, 0.05
"""Velocity counts, or speed where a count is less, that are the noise of a shaft at rest."""


def check_identity(table: Table, identity: Identity, profile: CanopenProfile) -> None:
    """Vendor, product and revision (1018h) against the profile's; None there = not checked."""
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
            f"This is not the drive of profile {profile.name}: choose its own with --profile",
        )


def give_back_left(table: Table, objects: Objects, left: LeftBehind, identity: Identity) -> None:
    """What an earlier run has left in the drive, since its host died: given back where it still stands so."""
    given, others = [], []
    for one in left.opened(identity):
        index, sub = place(one.where)
        try:
            if objects.read_bytes(index, sub) == one.after:
                objects.write_bytes(index, sub, one.before)
                given.append(one.text)
            else:
                others.append(one.where)
            left.given_back(one.where)
        except ObjectRefused as error:
            table.note("left by an earlier run", f"{one.text}; {error.what}", one.where, "Set it at the drive, by hand")
    if given:
        table.note("left by an earlier run", f"{', '.join(given)}: given back now", "log's folder")
    if others:
        table.note("left by an earlier run", f"{', '.join(others)}: changed by somebody since, left alone", "")
    objects.left = left


def check_state(table: Table, objects: Objects, units: Units, profile: CanopenProfile) -> None:
    """A drive in fault is refused, and never reset silently; so is one that still brakes after an earlier stop."""
    state = decode(objects.read(0x6041))
    faulty = state in (State.FAULT, State.FAULT_REACTION_ACTIVE)
    code = objects.read_if_there(0x603F)
    found = state.value + (f", error code {code:04X}h" if faulty and code is not None else "")
    braking = False
    if state is State.QUICK_STOP_ACTIVE:
        # Disabling would let it coast: it must have come to rest under its own quick stop.
        speed_lsb = objects.read((VL_ACTUAL if profile.speed.vl else VELOCITY_ACTUAL)[0], signed=True)
        braking = abs(speed_lsb) > max(STILL_LSB, STILL_RAD_S / units.speed_rad_s_per_lsb)
        found += f", velocity {speed_lsb}"
    mend = "Clear the fault's cause, then start with --reset-fault" if faulty else "Wait until the shaft is at rest"
    table.row("state", "no fault, at rest", found, not faulty and not braking, "6041h", mend)


def refuse_if_driven(objects: Objects) -> None:
    """Before anything is sent that could change what a turning shaft does. Raises PreflightRefused."""
    if decode(objects.read(0x6041)) is State.OPERATION_ENABLED:
        raise PreflightRefused(
            "the drive is enabled already: another master drives it",
            where="6041h",
            next_step="Take that master off the bus, or disable the drive there; nothing was written to it",
        )


def choose_modes(table: Table, objects: Objects, profile: CanopenProfile) -> dict[Mode, int]:
    """The first of the profile's modes that the drive says it supports (6502h), for speed and for torque."""
    supported = objects.read_if_there(0x6502)
    chosen: dict[Mode, int] = {}
    for mode, codes in ((Mode.SPEED, profile.modes.speed), (Mode.TORQUE, profile.modes.torque)):
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


def check_mode_display(table: Table, objects: Objects, code: int, wait: Callable[[], None]) -> None:
    """6060h is written while nothing is enabled; 6061h must follow."""

    def work() -> tuple[str, bool]:
        objects.change(0x6060, 0, code, 8)
        shown = objects.read(0x6061, signed=True)
        for _ in range(20):
            if shown == code:
                break
            wait()
            shown = objects.read(0x6061, signed=True)
        return str(shown), shown == code

    table.attempt(
        f"mode display for {code}", str(code), "6061h", work, "The drive doesn't take this mode over; see its manual"
    )


def clear_targets(table: Table, objects: Objects, profile: CanopenProfile) -> None:
    """No setpoint of an earlier run may act when the drive is enabled."""
    index, _, bits = VL_TARGET if profile.speed.vl else TARGET_VELOCITY
    targets = ((0x6071, 16), (index, bits)) if profile.modes.torque else ((index, bits),)

    def work() -> tuple[str, bool]:
        for index, bits in targets:
            objects.write(index, 0, 0, bits)
        return "0", True

    table.attempt("targets", "0", ", ".join(f"{index:04X}h" for index, _ in targets), work)


def quick_stop_holds(objects: Objects, profile: CanopenProfile) -> bool | None:
    """Does the drive hold the shaft once a quick stop has brought it to rest? By the profile, and by 605Ah.

    CiA 402-2, 605Ah: with 5 to 8 it stays in quick stop active, with 0 to 4 it switches its torque off; negative codes
    are the manufacturer's. None: neither the drive nor the profile tells.
    """
    entry = profile.quick_stop
    if entry.ends == "off":
        return False
    code = objects.read_if_there(0x605A, signed=True)
    if code is None and entry.option_code is None:
        return True if "ends" in entry.model_fields_set else None
    return None if code is None or code < 0 or code > _LAST_OPTION else code >= _HOLDS_FROM


def report(
    table: Table,
    identity: Identity,
    profile: CanopenProfile,
    objects: Objects,
    units: Units,
    rated_nm: float,
    modes: dict[Mode, int],
    watchdog_s: float,
    kept: Mapping[str, float],
) -> Preflight:
    """The table and what goes with it."""
    filters = read_filters(table.note, objects, profile)
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
        safe_action=profile.watchdog.reaction if watchdog_s else "none",
        filters=filters,
        torque_setpoint="6071h",
        kept_torque_nm=kept.get(TORQUE),
        kept_speed_rad_s=kept.get(SPEED),
        quick_stop_holds=quick_stop_holds(objects, profile),
    )
