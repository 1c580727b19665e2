"""PDOs, timing and the drive's watchdog: what preflight sets last, since the watchdog wants to be fed from then on."""

from __future__ import annotations

from collections.abc import Callable

from drivers.cia402.mapping import layout, write_pdo
from drivers.cia402.objects import consumer_heartbeat
from drivers.cia402.preflight import Table
from drivers.cia402.sdo import Objects, name
from drivers.errors import ObjectRefused
from profiles.marker import MARKER_INDEX
from profiles.schema import CanopenProfile, Watchdog

LEAST_CYCLES = 5
"""The watchdog must not bite on account of a lost frame or two."""


def map_pdos(table: Table, objects: Objects, node: int, profile: CanopenProfile) -> bool:
    """Map both pairs of PDOs; whether the slow one carries the torque demand 6074h too."""
    with_demand = profile.torque.has_demand and objects.read_if_there(0x6074) is not None

    def work() -> tuple[str, bool]:
        for pdo in layout(with_demand):
            write_pdo(objects, node, pdo)
        return "as wanted", True

    table.attempt("PDO mapping", "6040+6071+60FF, 6041+6077+606C, 6060, 6061", "1600h, 1A00h", work)
    return with_demand


def set_timing(table: Table, objects: Objects, period_s: float, heartbeat_s: float, stepped: bool) -> bool:
    """Cycle period 1006h, stepped time of a simulated peer, heartbeat 1017h; whether the drive produces one."""
    period_us = round(period_s * 1e6)
    try:
        back = objects.change(0x1006, 0, period_us, 32)
        table.row("cycle", f"{period_us} µs", f"{back} µs", back == period_us, "1006h")
    except ObjectRefused:
        table.note("cycle", f"{period_us} µs; the drive has no 1006h and follows the SYNC alone", "1006h")
    if stepped:
        on = objects.change(MARKER_INDEX, 2, 1, 8)
        table.row("stepped time", "on", "on" if on else "off", on == 1, name(MARKER_INDEX, 2))
    time_ms = round(heartbeat_s * 1000)
    try:
        back = objects.change(0x1017, 0, time_ms, 16)
    except ObjectRefused:
        table.note("drive's heartbeat", "the drive produces none: its silence shows in missing feedback only", "1017h")
        return False
    return table.row("drive's heartbeat", f"{time_ms} ms", f"{back} ms", back == time_ms, "1017h")


def arm_watchdog(
    table: Table,
    objects: Objects,
    entry: Watchdog,
    *,
    host_node: int,
    watchdog_s: float,
    period_s: float,
    beat: Callable[[], None],
) -> None:
    """1016h and its reaction, written and read back. Supervision begins with the first beat, so one is sent."""
    if entry.kind == "none":
        table.row(
            "watchdog", "armed", "this drive has none", False, "profile",
            "A host that dies would leave the shaft turning: this drive can't be used",
        )
        return
    index, sub, wanted = entry.reaction_index, entry.reaction_sub, entry.reaction_value
    if index is not None and wanted is not None:

        def react() -> tuple[str, bool]:
            found = objects.change(index, sub, wanted, 16)
            return str(found), found == wanted

        table.attempt("watchdog reaction", f"{wanted} ({entry.reaction})", name(index, sub), react)
    time_ms = round(watchdog_s * 1000)
    if not 1 <= time_ms <= 0xFFFF or watchdog_s < LEAST_CYCLES * period_s:
        table.row(
            "watchdog time", f"{LEAST_CYCLES} cycles to 65 s", f"{time_ms} ms", False, "limits.watchdog_s",
            f"Give it at least {LEAST_CYCLES * period_s:g} s, or a higher rate",
        )
        return
    value = consumer_heartbeat(host_node, time_ms)

    def arm() -> tuple[str, bool]:
        objects.change(entry.consumer_index, entry.consumer_sub, value, 32)
        beat()
        found = objects.read(entry.consumer_index, entry.consumer_sub)
        return f"node {found >> 16 & 0x7F}, {found & 0xFFFF} ms", found == value

    table.attempt(
        "watchdog", f"node {host_node}, {time_ms} ms", name(entry.consumer_index, entry.consumer_sub), arm,
        "Without it a host that dies would leave the shaft turning",
    )
