"""PDOs, timing and the watchdog: the last settings of preflight, because the watchdog must be fed after them."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

from drivers.canopen.pdo import FrameShape, Slow, consumer_heartbeat
from drivers.canopen.pdo_mapping import layout, slow_syncs, switch_off_others, write_pdo, written
from drivers.cia402 import (
    ANSWER_S,
    INTERPOLATION,
    FeedbackSetting,
    Objects,
    arm,
    name,
    note_period,
    set_interpolation,
    with_angle,
)
from drivers.errors import CommunicationLost, ObjectRefused, PreflightRefused
from drivers.preflight import DIES, PreflightTable
from profiles import MARKER_INDEX, MessageCode
from profiles.canopen import CanopenProfile, Position, Watchdog

GUARD_TIME, LIFE_TIME_FACTOR = 0x100C, 0x100D


def map_pdos(
    table: PreflightTable, objects: Objects, node: int, shape: FrameShape, period_s: float, demand: bool,
    position: Position | None,
) -> tuple[Slow, dict[int, int]]:
    """Map both pairs of PDOs, and switch off the drive's other RPDOs.

    Return the content of the second TPDO: the torque demand 6074h and the angle ``position``, if they can be mapped.
    Also return the COB-IDs that were switched off, by RPDO number.
    """
    carried = Slow.fitting(demand, position, shape)
    *pdos, slow = layout(carried, shape, slow_syncs(period_s))
    others: dict[int, int] = {}

    def write_slow(angle: Position | None) -> Slow:
        found = carried if angle == carried.position else Slow(demand, None, shape.wide)
        write_pdo(objects, node, layout(found, shape, slow_syncs(period_s))[-1])
        return found

    def work() -> tuple[str, bool]:
        nonlocal carried
        for pdo in pdos:
            write_pdo(objects, node, pdo)
        carried, done = with_angle(table, carried.position, write_slow)
        return done, True

    table.attempt("PDO mapping", ", ".join(map(written, (*pdos, slow))), "1600h, 1A00h", work)
    try:
        others = switch_off_others(objects, (*pdos, slow))
    except PreflightRefused as error:
        table.row("other RPDOs", "off", error.what, False, error.where, error.next_step)
    if others:
        on = ", ".join(f"RPDO{number} ({cob_id & 0x7FF:X}h)" for number, cob_id in others.items())
        table.row("other RPDOs", "off", f"off (were on: {on})", True, "1400h and on")
    return carried, others


def set_period(objects: Objects, profile: CanopenProfile, period_s: float) -> int:
    """Write the cycle period 1006h. Return the value read back, µs. Raises ObjectRefused if the drive has none."""
    if not profile.cyclic.has_period:
        raise ObjectRefused("not in the profile", where="1006h")
    return objects.change(0x1006, 0, round(period_s * 1e6), 32)


def feedback_frames(objects: Objects) -> list[FeedbackSetting]:
    """Return the objects that define content and timing of the two TPDOs.

    These are COB-ID, transmission type, inhibit time and event timer (1800h:1, 2, 3, 5), if the drive has them; and the
    used part of the mapping (1A00h).
    """
    found: list[FeedbackSetting] = []
    for number in (0, 1):
        mapping = 0x1A00 + number
        places = [(f"TPDO{number + 1}", 0x1800 + number, sub) for sub in (1, 2, 3, 5)]
        used = objects.read_if_there(mapping, 0) or 0
        places += [(f"TPDO{number + 1} mapping", mapping, sub) for sub in range(used + 1)]
        for title, index, sub in places:
            with suppress(ObjectRefused):
                found.append((title, index, sub, objects.read_bytes(index, sub)))
    return found


def set_slow_syncs(objects: Objects, period_s: float) -> bytes:
    """Set the number of SYNCs between two TPDO2 (1801h:2) for another rate. Return the bytes read back.

    Raises ObjectRefused.
    """
    if objects.read(0x1801, 2) > 1:            # 1: it carries the statusword, with every SYNC
        objects.write(0x1801, 2, slow_syncs(period_s), 8)
    return objects.read_bytes(0x1801, 2)


def set_timing(
    table: PreflightTable, objects: Objects, profile: CanopenProfile, period_s: float, heartbeat_s: float,
    stepped: bool, interpolates: bool,
) -> bool:
    """Set cycle period 1006h, interpolation time period 60C2h, stepped time of a simulated peer, heartbeat 1017h.

    Return whether there is a heartbeat.
    """
    note_period(table, period_s, "1006h", lambda: set_period(objects, profile, period_s), "SYNC only")
    if interpolates:
        note_period(table, period_s, name(INTERPOLATION), lambda: set_interpolation(objects, period_s), "SYNC only",
                    "interpolation time period")
    if stepped:
        if not profile.cyclic.has_period:
            period_us = round(period_s * 1e6)
            back = objects.change(MARKER_INDEX, 3, period_us, 32)
            table.row("simulator's cycle", f"{period_us} µs", f"{back} µs", back == period_us, name(MARKER_INDEX, 3))
        on = objects.change(MARKER_INDEX, 2, 1, 8)
        table.row("stepped time", "on", "on" if on else "off", on == 1, name(MARKER_INDEX, 2))
    # CiA 301 allows a node one of the two: a node with a heartbeat is not guarded.
    time_ms = 0 if profile.watchdog.kind == "node_guarding" else round(heartbeat_s * 1000)
    try:
        back = objects.change(0x1017, 0, time_ms, 16)
    except ObjectRefused:
        if time_ms:
            table.note(
                "drive's heartbeat", "none: a lost drive shows only by missing feedback", "1017h"
            )
        return False
    good = table.row("drive's heartbeat", f"{time_ms} ms", f"{back} ms", back == time_ms, "1017h")
    return good and time_ms > 0


def keep_stepping(objects: Objects, profile: CanopenProfile, period_s: float) -> None:
    """Set the cycle of a simulated drive again (1006h, or the marker's): after a restart its time would not advance."""
    index, sub = (0x1006, 0) if profile.cyclic.has_period else (MARKER_INDEX, 3)
    wanted_us = round(period_s * 1e6)
    with objects.answered_within(ANSWER_S):
        try:
            if objects.read(index, sub) != wanted_us:
                objects.write(index, sub, wanted_us, 32)
        except (CommunicationLost, ObjectRefused):
            return


def arm_watchdog(
    table: PreflightTable,
    objects: Objects,
    entry: Watchdog,
    *,
    host_node: int,
    watchdog_s: float,
    period_s: float,
    beat: Callable[[], None],
    answered: Callable[[], bool],
    accept_none: bool,
) -> float:
    """Arm the drive's watchdog (`drivers.cia402.arm`). Return the period at which the host must feed it, s; 0: none.

    Supervision begins with the first ``beat`` (heartbeat, or request of node guarding), so one is sent before the
    read-back; ``answered`` waits for the drive's answer to a request.
    """

    def armed(tried: PreflightTable, time_ms: int) -> float:
        if entry.kind == "node_guarding":
            return _arm_guarding(tried, objects, time_ms, entry.life_time_factor, beat, answered)
        return _arm_heartbeat(tried, objects, entry, host_node, time_ms, beat)

    return arm(
        table, objects, entry, armed, lambda: _is_off(objects, entry),
        watchdog_s=watchdog_s, period_s=period_s, accept_none=accept_none,
    )


def _arm_heartbeat(
    table: PreflightTable, objects: Objects, entry: Watchdog, host_node: int, time_ms: int, beat: Callable[[], None]
) -> float:
    """Arm the consumer heartbeat time, 1016h in the standard: the drive reacts if the host's heartbeat is missing."""
    value = consumer_heartbeat(host_node, time_ms)

    def arm() -> tuple[str, bool]:
        objects.change(entry.consumer_index, entry.consumer_sub, value, 32)
        beat()
        found = objects.read(entry.consumer_index, entry.consumer_sub)
        return f"node {found >> 16 & 0x7F}, {found & 0xFFFF} ms", found == value

    table.attempt(
        "watchdog", f"node {host_node}, {time_ms} ms", name(entry.consumer_index, entry.consumer_sub), arm, DIES,
    )
    return time_ms / 5000.0


def _arm_guarding(
    table: PreflightTable, objects: Objects, time_ms: int, factor: int, ask: Callable[[], None],
    answered: Callable[[], bool]
) -> float:
    """Arm node guarding (CiA 301): guard time 100Ch in ms x factor 100Dh = life time. The drive reacts if no request
    comes within the life time.
    """
    factor = min(factor, time_ms)
    guard_ms = time_ms // factor

    def arm() -> tuple[str, bool]:
        # 100Dh is one byte in the standard and two on some drives: it is written with the length that was read.
        length = len(objects.read_bytes(LIFE_TIME_FACTOR))
        objects.change_bytes(LIFE_TIME_FACTOR, 0, factor.to_bytes(length, "little"))
        objects.change(GUARD_TIME, 0, guard_ms, 16)
        ask()
        if not answered():
            raise PreflightRefused("no answer to the remote frame of node guarding", where="node guarding",
                                   entry=MessageCode.WATCHDOG_NOT_ARMED)
        found = objects.read(GUARD_TIME), objects.read(LIFE_TIME_FACTOR)
        return f"{found[0]} ms x {found[1]}, answered", found == (guard_ms, factor)

    table.attempt(
        "watchdog", f"{guard_ms} ms x {factor}", f"{name(GUARD_TIME)}, {name(LIFE_TIME_FACTOR)}", arm,
        f"{DIES}. Node guarding needs remote frames: python-can's socketcand and some gateways don't carry them; use "
        "the adapter's own interface",
    )
    return guard_ms / 1000.0


def _is_off(objects: Objects, entry: Watchdog) -> bool:
    """Return whether the drive supervises no host: the object is missing, or holds a node or time of 0 (CiA 301).

    A guard time that was written although no request reaches the drive would stop the shaft later. So it is reset
    first.
    """
    if entry.kind == "node_guarding":
        with suppress(ObjectRefused):
            objects.change(GUARD_TIME, 0, 0, 16)
        return not (objects.read_if_there(GUARD_TIME) and objects.read_if_there(LIFE_TIME_FACTOR))
    value = objects.read_if_there(entry.consumer_index, entry.consumer_sub) or 0
    return not (value >> 16 & 0x7F and value & 0xFFFF)
