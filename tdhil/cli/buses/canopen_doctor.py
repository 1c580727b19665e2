"""A CAN bus and the CiA 402 drive on it, read only: link, bus state, reach, identity, watchdog, modes, state."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from drivers import NO_WATCHDOG_FLAG, CommunicationLost, MonotonicClock, ObjectRefused, PreflightTable
from drivers.canopen import CanLink, SdoObjects
from drivers.cia402 import State, check_parameters, decode, find_units, name
from profiles import MARKER_INDEX, MARKER_TEXT
from profiles.canopen import CanopenProfile
from tdhil.cli.doctor_finding import DoctorFinding, Grade, bad, note, of_check, ok

if TYPE_CHECKING:
    import can

_STATES: dict[str, tuple[Grade, str]] = {
    "ERROR-ACTIVE": ("ok", ""),
    "ERROR-WARNING": ("note", "Errors add up: check bit rate, termination (60 ohms between CAN_H and CAN_L) and cable"),
    "ERROR-PASSIVE": ("bad", "Check bit rate, termination (60 ohms between CAN_H and CAN_L), and other nodes"),
    "BUS-OFF": ("bad", "Correct cable or bit rate, then: sudo ip link set {0} down && sudo ip link set {0} up"),
    "STOPPED": ("bad", "Bring it up: sudo ip link set {0} up type can bitrate 500000"),
}
_UNKNOWN_STATE: tuple[Grade, str] = ("note", "")


def link_findings(text: str | None, channel: str) -> Iterator[DoctorFinding]:
    """Yield findings from ``ip -details -json link show`` for a SocketCAN link; ``text`` is None without ``ip``."""
    link = _link(text, channel)
    if link is None:
        yield note("link", f"{channel}: can't be read (no ip, or no answer)", "Try: ip -details link show " + channel)
        return
    data = _below(link, "linkinfo", "info_data")
    rate = _below(data, "bittiming").get("bitrate")
    yield ok("bit rate", f"{rate} bit/s, set in the link") if rate else note("bit rate", f"{channel} has none")
    state = data.get("state")
    if isinstance(state, str):
        grade, step = _STATES.get(state, _UNKNOWN_STATE)
        yield DoctorFinding(grade, "bus state", state, step.format(channel))
    counters = _below(data, "berr_counter")
    if counters:
        sent, received = counters.get("tx", 0), counters.get("rx", 0)
        text = f"errors sent {sent}, received {received} (128 is error-passive)"
        clean = sent == 0 and received == 0
        yield ok("error counters", text) if clean else note(
            "error counters", text, "Check whether they grow: ip -details -statistics link show " + channel
        )


def rate_finding(bitrate: int | None, source: str) -> DoctorFinding:
    """Return the finding for an adapter that sets the bit rate itself."""
    if bitrate is None:
        return note("bit rate", "not given: the interface's own default", "Give the bus's with -b, such as -b 500000")
    return ok("bit rate", f"{bitrate} bit/s ({source})")


def drive_findings(
    bus: can.BusABC, profile: CanopenProfile, node: int, rated_torque_nm: float | None
) -> Iterator[DoctorFinding]:
    """Yield findings on the drive. Raises CommunicationLost if it does not answer; nothing is written."""
    link = CanLink(bus, MonotonicClock())
    objects = SdoObjects(link, node)
    try:
        device = objects.read(0x1000)
    except CommunicationLost as error:
        if not link.error_frames:
            raise
        yield bad("drive", f"{error.what}, and {link.error_frames} error frames were received",
                  "The bit rate is most likely wrong: compare it with the drive's; check cable and termination")
        return
    kind = "a CiA 402 drive" if device & 0xFFFF == 402 else f"device type {device:08X}h, which is not a CiA 402 drive"
    answers = f"node {node} answers: {kind}"
    yield ok("drive", answers) if device & 0xFFFF == 402 else bad("drive", answers, "See tdhil scan")
    yield from _identity(objects, profile)
    yield from _watchdog(objects, profile)
    yield _modes(objects, profile)
    table = PreflightTable()
    find_units(table, objects, profile, rated_torque_nm)
    check_parameters(table, objects, profile)
    yield from map(of_check, table.checks)
    yield _state(objects)
    if link.error_frames:
        yield note("error frames", f"{link.error_frames} received", "Check bit rate, termination and cable")


def _identity(objects: SdoObjects, profile: CanopenProfile) -> Iterator[DoctorFinding]:
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


def _watchdog(objects: SdoObjects, profile: CanopenProfile) -> Iterator[DoctorFinding]:
    dog = profile.watchdog
    if dog.kind == "none":
        yield bad("watchdog", f"profile {profile.name} names none",
                  f"If the host fails, the shaft keeps turning: identify accepts this only with {NO_WATCHDOG_FLAG}")
        return
    wanted = [(0x100C, 0), (0x100D, 0)] if dog.kind == "node_guarding" else [(dog.consumer_index, dog.consumer_sub)]
    if dog.reaction_index is not None:
        wanted.append((dog.reaction_index, dog.reaction_sub))
    for at in wanted:
        try:
            value = objects.read_bytes(*at)
            yield ok("watchdog", f"{name(*at)} exists and reads {int.from_bytes(value, 'little'):X}h")
        except ObjectRefused:
            step = "Choose the drive's own profile: without a watchdog nothing is moved, "
            step += f"unless accepted with {NO_WATCHDOG_FLAG}"
            yield bad("watchdog", f"the drive has no {name(*at)}", step)


def _modes(objects: SdoObjects, profile: CanopenProfile) -> DoctorFinding:
    supported = objects.read_if_there(0x6502)
    if supported is None:
        return note("modes", "the drive does not report its modes (6502h)")
    has = [code for code in (*profile.modes.speed, *profile.modes.torque) if code < 1 or supported >> code - 1 & 1]
    speed = [code for code in has if code in profile.modes.speed]
    text = f"profile: speed {speed or 'none'}, torque {[code for code in has if code not in speed] or 'none'}"
    return ok("modes", text) if speed else bad("modes", text, "None controls speed: check the profile")


def _state(objects: SdoObjects) -> DoctorFinding:
    state = decode(objects.read(0x6041))
    if state in (State.FAULT, State.FAULT_REACTION_ACTIVE):
        code = objects.read_if_there(0x603F)
        known = f", error code {code:04X}h" if code is not None else ""
        return bad("state", f"{state.value}{known}", "Remove its cause, then start a run with --reset-fault")
    if state is State.OPERATION_ENABLED:
        return bad("state", "operation enabled: another master controls it", "Take that master off the bus first")
    return ok("state", state.value)


def _link(text: str | None, channel: str) -> dict[str, Any] | None:
    try:
        links = json.loads(text or "")
    except (ValueError, RecursionError):
        return None
    found = links if isinstance(links, list) else []
    return next((one for one in found if isinstance(one, dict) and one.get("ifname") == channel), None)


def _below(data: dict[str, Any], *keys: str) -> dict[str, Any]:
    """Return the section below these keys; empty if there is none."""
    found: Any = data
    for key in keys:
        found = found.get(key) if isinstance(found, dict) else None
    return found if isinstance(found, dict) else {}
