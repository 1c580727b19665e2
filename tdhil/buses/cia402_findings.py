"""Findings of scan and doctor about a CiA 402 drive by its objects, on any bus. Nothing is written."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from drivers import NO_WATCHDOG_FLAG, ObjectRefused, PreflightTable, cia402
from profiles import MARKER_INDEX, MARKER_TEXT
from profiles.cia402 import Cia402Profile
from tdhil.buses.doctor_finding import DoctorFinding, bad, note, of_check, ok

_CIA402 = 402


def match(device_type: int, identity: Sequence[int | None], profiles: Iterable[Cia402Profile],
          plain: str = "generic/cia402") -> tuple[str | None, str]:
    """Return (profile, reason) for the profile whose identity (vendor, product, revision of 1018h) fits best."""
    best, most = None, 0
    for profile in profiles:
        wanted = (profile.identity.vendor, profile.identity.product, profile.identity.revision)
        asked = [(want, have) for want, have in zip(wanted, identity, strict=True) if want is not None]
        if len(asked) > most and all(want == have for want, have in asked):
            best, most = profile.name, len(asked)
    if best is not None:
        return best, ("vendor", "vendor and product", "vendor, product and revision")[most - 1]
    if device_type & 0xFFFF == _CIA402:
        return plain, "a CiA 402 drive without a profile of its own: check every unit"
    return None, f"not a CiA 402 drive (device type {device_type:08X}h)"


def identity_text(identity: Sequence[int | None]) -> str:
    """Return vendor, product, revision and serial number (1018h) in words; empty if none is known."""
    parts = zip(("vendor", "product", "revision", "serial"), identity, strict=True)
    return ", ".join(f"{part} {value:X}h" for part, value in parts if value is not None)


def drive_type(place: str, device_type: int) -> DoctorFinding:
    """Return the finding on 1000h."""
    if device_type & 0xFFFF == _CIA402:
        return ok("drive", f"{place} answers: a CiA 402 drive")
    return bad("drive", f"{place} answers: device type {device_type:08X}h, which is not a CiA 402 drive",
               "See tdhil scan")


def identity_findings(objects: cia402.Objects, profile: Cia402Profile) -> Iterator[DoctorFinding]:
    """Yield the findings on 1018h and on the simulator's marker."""
    found = {part: objects.read_if_there(0x1018, sub) for sub, part in ((1, "vendor"), (2, "product"), (3, "revision"))}
    text = ", ".join(f"{part} {value:X}h" for part, value in found.items() if value is not None) or "not reported"
    wrong = [
        f"{part} {wanted:X}h"
        for part in found
        if (wanted := getattr(profile.identity, part)) is not None and wanted != found[part]
    ]
    yield bad("identity", f"{text}; profile {profile.name} needs {', '.join(wrong)}", "Choose its own with --profile") \
        if wrong else ok("identity", text)
    try:
        marked = objects.read_bytes(MARKER_INDEX, 1).decode("ascii", "replace").rstrip("\0") == MARKER_TEXT
    except ObjectRefused:
        marked = False
    yield note("peer", "SIMULATED: it has the simulator's marker") if marked else ok("peer", "not a simulator")


def watchdog_object(objects: cia402.Objects, index: int, sub: int) -> DoctorFinding:
    """Return the finding on an object that the drive's watchdog needs."""
    try:
        value = objects.read_bytes(index, sub)
    except ObjectRefused:
        step = "Choose the drive's own profile: without a watchdog nothing is moved, "
        step += f"unless accepted with {NO_WATCHDOG_FLAG}"
        return bad("watchdog", f"the drive has no {cia402.name(index, sub)}", step)
    return ok("watchdog", f"{cia402.name(index, sub)} exists and reads {int.from_bytes(value, 'little'):X}h")


def settings_findings(
    objects: cia402.Objects, profile: Cia402Profile, rated_torque_nm: float | None
) -> Iterator[DoctorFinding]:
    """Yield the findings on modes, units, required settings and state."""
    yield _modes(objects, profile)
    table = PreflightTable()
    cia402.find_units(table, objects, profile, rated_torque_nm)
    cia402.check_parameters(table, objects, profile)
    yield from map(of_check, table.checks)
    yield _state(objects)


def _modes(objects: cia402.Objects, profile: Cia402Profile) -> DoctorFinding:
    supported = objects.read_if_there(0x6502)
    if supported is None:
        return note("modes", "the drive does not report its modes (6502h)")
    has = [code for code in (*profile.modes.speed, *profile.modes.torque) if code < 1 or supported >> code - 1 & 1]
    speed = [code for code in has if code in profile.modes.speed]
    text = f"profile: speed {speed or 'none'}, torque {[code for code in has if code not in speed] or 'none'}"
    return ok("modes", text) if speed else bad("modes", text, "None controls speed: check the profile")


def _state(objects: cia402.Objects) -> DoctorFinding:
    state = cia402.decode(objects.read(0x6041))
    if state in (cia402.State.FAULT, cia402.State.FAULT_REACTION_ACTIVE):
        code = objects.read_if_there(0x603F)
        known = f", error code {code:04X}h" if code is not None else ""
        return bad("state", f"{state.value}{known}", "Remove its cause, then start a run with --reset-fault")
    if state is cia402.State.OPERATION_ENABLED:
        return bad("state", "operation enabled: another master controls it",
                   "Stop the shaft and disable the drive there, then disconnect that master")
    return ok("state", state.value)
