"""The drive's watchdog on the host: its reaction and its time, before the bus arms it in its own way."""

from __future__ import annotations

from collections.abc import Callable

from drivers.cia402.objects import Objects, name
from drivers.drive import LEAST_CYCLES
from drivers.preflight import DIES, PreflightTable, settle
from profiles.cia402 import HostWatchdog


def arm(
    table: PreflightTable,
    objects: Objects,
    entry: HostWatchdog,
    armed: Callable[[PreflightTable, int], float],
    is_off: Callable[[], bool],
    *,
    watchdog_s: float,
    period_s: float,
    accept_none: bool,
) -> float:
    """Write and read back the drive's watchdog and its reaction. Return the period at which the host must feed it, s.

    ``armed`` writes the time, ms, and returns that period; ``is_off`` returns whether the drive supervises no host. 0
    if it is not armed: refused, unless ``accept_none`` and it is known to be off.
    """
    tried = PreflightTable()
    if entry.kind == "none":
        tried.row("watchdog", "armed", "this drive has none", False, "profile", DIES)
        settle(table, tried, accept_none, lambda: True)
        return 0.0
    index, sub, wanted = entry.reaction_index, entry.reaction_sub, entry.reaction_value
    if index is not None and wanted is not None:

        def react() -> tuple[str, bool]:
            found = objects.change(index, sub, wanted, 16)
            return str(found), found == wanted

        tried.attempt("watchdog reaction", f"{wanted} ({entry.reaction})", name(index, sub), react)
    time_ms = round(watchdog_s * 1000)
    if not 1 <= time_ms <= 0xFFFF or watchdog_s < LEAST_CYCLES * period_s:
        table.checks += tried.checks
        table.row(
            "watchdog time", f"{LEAST_CYCLES} cycles to 65 s", f"{time_ms} ms", False, "limits.watchdog_s",
            f"Set it to at least {LEAST_CYCLES * period_s:g} s, or use a higher rate",
        )
        return 0.0
    feed_s = armed(tried, time_ms)
    return feed_s if settle(table, tried, accept_none, is_off) else 0.0
