"""What is checked and set on a CiA 402 drive before its shaft may move: each line with what was read back.

A line that fails does not hide those after it: the whole table is worth more to an engineer than its first row.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from drivers.cia402.filters import read_filters
from drivers.cia402.objects import MODE_NAMES, RPM, Units
from drivers.cia402.sdo import Objects, name
from drivers.cia402.state import State, decode
from drivers.drive import Check, Identity, Limits, Mode, Outcome, Preflight
from drivers.errors import PreflightRefused
from profiles.schema import CanopenProfile

STILL_LSB = 5
"""Velocity counts that are the noise of a shaft at rest."""


class Table:
    """Collects the rows."""

    def __init__(self) -> None:
        self.checks: list[Check] = []

    def row(self, title: str, wanted: str, found: str, good: bool, where: str = "", next_step: str = "") -> bool:
        outcome = Outcome.OK if good else Outcome.REFUSED
        self.checks.append(Check(title, wanted, found, outcome, where, "" if good else next_step))
        return good

    def note(self, title: str, found: str, where: str = "") -> None:
        self.checks.append(Check(title, "", found, Outcome.NOTE, where))

    def attempt(
        self, title: str, wanted: str, where: str, work: Callable[[], tuple[str, bool]], mend: str = ""
    ) -> None:
        """A row whose work may be refused by the drive: that refusal is then the row."""
        try:
            found, good = work()
        except PreflightRefused as error:
            self.checks.append(
                Check(title, wanted, error.what, Outcome.REFUSED, error.where or where, mend or error.next_step)
            )
        else:
            self.row(title, wanted, found, good, where, mend)


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


def check_state(table: Table, objects: Objects) -> None:
    """A drive in fault is refused, and never reset silently; so is one that still brakes after an earlier stop."""
    state = decode(objects.read(0x6041))
    faulty = state in (State.FAULT, State.FAULT_REACTION_ACTIVE)
    code = objects.read_if_there(0x603F)
    found = state.value + (f", error code {code:04X}h" if faulty and code is not None else "")
    braking = False
    if state is State.QUICK_STOP_ACTIVE:
        # Disabling would let it coast: it must have come to rest under its own quick stop.
        speed_lsb = objects.read(0x606C, signed=True)
        braking = abs(speed_lsb) > STILL_LSB
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


def find_units(
    table: Table, objects: Objects, profile: CanopenProfile, rated_torque_nm: float | None
) -> tuple[Units, float]:
    """Scaling, from the drive where it has it, else from the rig; and the rated torque, N·m."""
    per_lsb = profile.torque.rated_torque_nm_per_lsb
    raw = None if per_lsb is None else objects.read_if_there(0x6076)
    from_drive = raw * per_lsb if raw and per_lsb is not None else None
    rated_nm = rated_torque_nm if rated_torque_nm is not None else from_drive
    if rated_nm is None:
        table.row(
            "rated torque", "known", "the drive does not tell", False, "6076h",
            "Give drive_data.rated_torque_nm in rig.yaml (motor name plate)",
        )
        rated_nm = 1.0
    elif from_drive is None:
        table.note("rated torque", f"{rated_nm:g} N·m, from the rig", "6076h")
    else:
        agree = abs(from_drive - rated_nm) <= 0.001 * rated_nm
        table.row(
            "rated torque", f"{rated_nm:g} N·m", f"{from_drive:g} N·m", agree, "6076h",
            "rig.yaml and the drive disagree, and every torque is scaled by it: find out which is right",
        )
    units = Units(profile.speed.rpm_per_lsb * RPM, profile.torque.rated_per_lsb * rated_nm)
    return units, rated_nm


def set_limits(
    table: Table, objects: Objects, profile: CanopenProfile, limits: Limits, rated_nm: float
) -> None:
    """The drive's own torque limit, speed limit and quick stop, written and read back."""
    torque_lsb = profile.torque.max_torque_rated_per_lsb
    if torque_lsb is None:
        table.note("torque limit", "the drive has no 6072h: only the guard and the setpoint hold it")
    else:
        _limit(table, objects, "torque limit", 0x6072, limits.torque_nm, torque_lsb * rated_nm, 16, "N·m", math.floor)
    if profile.speed.max_motor_speed_rpm_per_lsb is None:
        table.note("speed limit", "the drive has no 6080h: set its own speed limit by hand")
    else:
        per_lsb = profile.speed.max_motor_speed_rpm_per_lsb * RPM
        _limit(table, objects, "speed limit", 0x6080, limits.speed_rad_s, per_lsb, 32, "rad/s", math.ceil)
    if profile.quick_stop.deceleration_rpm_s_per_lsb is not None:
        per_lsb = profile.quick_stop.deceleration_rpm_s_per_lsb * RPM
        _limit(
            table, objects, "quick-stop ramp", 0x6085, limits.quick_stop_rad_s2, per_lsb, 32, "rad/s²", math.ceil
        )
    code = profile.quick_stop.option_code
    if code is not None:
        table.attempt(
            "quick-stop option", str(code), "605Ah", lambda: _same(objects.change(0x605A, 0, code, 16), code)
        )


def clear_targets(table: Table, objects: Objects) -> None:
    """No setpoint of an earlier run may act when the drive is enabled."""

    def work() -> tuple[str, bool]:
        for index, bits in ((0x6071, 16), (0x60FF, 32)):
            objects.write(index, 0, 0, bits)
        return "0", True

    table.attempt("targets", "0", "6071h, 60FFh", work)


def _limit(
    table: Table,
    objects: Objects,
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

    def work() -> tuple[str, bool]:
        back = objects.change(index, 0, raw, bits)
        return f"{back * per_lsb:.6g} {unit}", back == raw

    table.attempt(title, f"{raw * per_lsb:.6g} {unit}", name(index), work)


def _same(found: int, wanted: int) -> tuple[str, bool]:
    return str(found), found == wanted


def report(
    table: Table,
    identity: Identity,
    profile: CanopenProfile,
    objects: Objects,
    units: Units,
    rated_nm: float,
    modes: dict[Mode, int],
    watchdog_s: float,
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
        safe_action=profile.watchdog.reaction,
        filters=filters,
    )
