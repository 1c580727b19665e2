"""The last steps of preflight: measure the rate that the line carries, and arm the watchdog, which must then be fed."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from drivers.drive import LEAST_CYCLES, DriveLimits
from drivers.errors import CommunicationLost, PreflightRefused
from drivers.modbus import pdu
from drivers.modbus.access import RegisterAccess
from drivers.modbus.cycle import Round
from drivers.modbus.parameters import Parameters, show, where_of, write_setting
from drivers.preflight import ANY_CLIENT, DIES, SHARED_FLAG, PreflightTable, settle
from profiles.modbus import ModbusProfile, Parameter

MEASURED_ROUNDS = 20
CARRIES, MARGIN = 1.02, 1.1
"""Factors for the period. The line carries a period that is longer than its slowest usual round by the first factor. If
it does not carry the requested rate, the period is longer than that round by the second factor."""
COUNT_S, COUNT_EVERY_S = 3.0, 0.2
"""Time of counting other clients' requests, s, and longest interval between two readings, s."""
LEAST_TIMEOUT_S = 0.05
"""Least time-out of a reply in the cycle, s. A late reply is better than a lost one: its time is just less certain."""


@dataclass(frozen=True)
class CyclePace:
    """Rate of the cycle. ``timeout_s`` is for one transaction; ``usual_s`` is the duration of a whole round."""

    period_s: float
    timeout_s: float
    usual_s: float


def measure_pace(
    table: PreflightTable, line: str, asked_hz: float, watchdog_s: float, plan_text: str, go: Callable[[], Round],
    now_s: Callable[[], float],
) -> CyclePace:
    """Return the requested period, or the one that the line carries if longer, measured over some rounds."""
    took_s: list[float] = []
    longest_s, failed = 0.0, 0
    while len(took_s) < MEASURED_ROUNDS and failed < MEASURED_ROUNDS // 4:
        begun_s = now_s()
        try:
            longest_s = max(longest_s, go().longest_s)
        except CommunicationLost:
            failed += 1
            continue
        took_s.append(now_s() - begun_s)
    if len(took_s) < MEASURED_ROUNDS:
        table.row(
            "cycle rate", f"{asked_hz:g} Hz", f"{failed} of {failed + len(took_s)} cycles failed", False, line,
            "The line is not good enough: check wiring, shielding, termination and baud rate",
        )
        return CyclePace(1.0 / asked_hz, LEAST_TIMEOUT_S, 1.0 / asked_hz)
    # 80 % of the rounds are faster: a few delays of the host must not slow the whole run down.
    usual_s = sorted(took_s)[4 * len(took_s) // 5]
    # In whole µs; a measured period is rounded up, so that the line carries it.
    asked_us = round(1e6 / asked_hz)
    slower = 1e6 * CARRIES * usual_s > asked_us
    period_s = (math.ceil(1e6 * MARGIN * usual_s - 1e-6) if slower else asked_us) * 1e-6
    text = f"{1.0 / period_s:.4g} Hz; {1e3 * usual_s:.3g} ms a cycle in {plan_text}"
    if slower:
        table.note("cycle rate", f"{text}: the line carries no {asked_hz:g} Hz", line)
    else:
        table.row("cycle rate", f"{asked_hz:g} Hz", text, True, line)
    timeout_s = min(max(4.0 * longest_s, LEAST_TIMEOUT_S), 0.25 * watchdog_s)
    return CyclePace(period_s, timeout_s, usual_s)


def arm_watchdog(
    table: PreflightTable, access: RegisterAccess, profile: ModbusProfile, limits: DriveLimits, rated_nm: float,
    found: Parameters,
    period_s: float, feed: Callable[[], object],
) -> bool:
    """Set or check the drive's time-out for a silent host; feed it once, then read it back.

    Return whether it is armed. If not, it is refused, unless the operator accepts that and it is known to be off.
    """
    entry, accepted, tried = profile.watchdog, limits.accept_no_watchdog, PreflightTable()
    if entry.kind == "none":
        tried.row("watchdog", "armed", "this drive has none", False, "profile", DIES)
        return settle(table, tried, accepted, lambda: True)
    table.note("watchdog reaction", entry.reaction.replace("_", " "), "profile, watchdog.reaction")
    if limits.watchdog_s < LEAST_CYCLES * period_s:
        table.row(
            "watchdog time", f"at least {LEAST_CYCLES} cycles", f"{limits.watchdog_s:g} s", False, "limits.watchdog_s",
            f"Set it to at least {LEAST_CYCLES * period_s:.2g} s, or use a faster line",
        )
        return False
    if entry.parameter is None:
        tried.row(
            "watchdog", "armed and read back", "the profile does not name the parameter of its time", False, "profile",
            "Name it in the profile (watchdog.parameter). tdhil must read the time back",
        )
        return settle(table, tried, accepted, lambda: True)
    parameter = profile.parameter(entry.parameter)
    value = found.values.get(parameter.name)
    if value is None and not accepted:
        return False        # refused already, where it was read
    if value is None:
        tried.row("watchdog", "armed and read back", "it can't be read", False, where_of(parameter))
    elif parameter.set_to == "watchdog":
        _write(tried, access, parameter, limits, rated_nm, found, feed)
    else:
        feed()
        good = LEAST_CYCLES * period_s <= value <= limits.watchdog_s * (1.0 + 1e-9)
        wanted = f"{LEAST_CYCLES * period_s:.2g} to {limits.watchdog_s:g} s"
        tried.row("watchdog", wanted, show(value, parameter), good, where_of(parameter), parameter.advice or DIES)
    return settle(table, tried, accepted, lambda: is_off(access, parameter, found.values))


def check_who_feeds(
    table: PreflightTable, access: RegisterAccess, profile: ModbusProfile, limits: DriveLimits,
    feed: Callable[[], object], *,
    simulated: bool
) -> bool:
    """Add a row on what feeds an armed watchdog. Return whether any other client does.

    Such a watchdog does not detect a dead host. So it needs the operator's acceptance by name; a simulated peer does
    not. If the drive counts its requests, those of other clients are shown.
    """
    entry = profile.watchdog
    sure = f"{entry.fed_by.replace('_', ' ')} ({entry.fed_by_confidence})"
    if not entry.fed_by_any_client:
        table.note("watchdog fed by", sure, "profile, watchdog.fed_by")
        return False
    accepted = limits.accept_shared_watchdog
    others = _others_requests(access, profile, min(COUNT_EVERY_S, 0.25 * limits.watchdog_s), feed)
    found = f"{sure}: {ANY_CLIENT}"
    if others:
        found += f". Another client is active: it sent {others} requests in {COUNT_S:g} s"
    elif others is None:
        found += ". tdhil cannot detect such a client: this drive does not count requests"
    else:
        found += f". No other client sent a request within {COUNT_S:g} s"
    if accepted:
        found += f"; accepted by {SHARED_FLAG}"
    if simulated or accepted:
        table.note("watchdog fed by", found, "profile, watchdog.fed_by")
    else:
        table.row(
            "watchdog fed by", "this host alone, or its control word", found, False, "profile, watchdog.fed_by",
            "Disconnect all other clients (PLC, panel, historian, gateway with several connections), then add"
            f" {SHARED_FLAG}. If the drive's manual states what feeds its time-out, correct the profile",
        )
    return True


def _others_requests(
    access: RegisterAccess, profile: ModbusProfile, every_s: float, feed: Callable[[], object]
) -> int | None:
    """Return the number of foreign requests in `COUNT_S`; None if the drive does not count requests."""
    def count() -> int:
        register = profile.watchdog.request_counter
        return access.read(register) if register is not None else access.once(pdu.count_requests(), 1.0).words[0]

    try:
        first, asked, clock = count(), access.asked, access.clock
        last = first
        until_s = clock.now_s() + COUNT_S
        while clock.now_s() < until_s:
            clock.wait_until(clock.now_s() + every_s)
            feed()                     # it is armed already
            last = count()
    except (CommunicationLost, PreflightRefused):
        return None
    return max(0, (last - first) % 0x1_0000 - (access.asked - asked))


def _write(
    table: PreflightTable, access: RegisterAccess, parameter: Parameter, limits: DriveLimits, rated_nm: float,
    found: Parameters,
    feed: Callable[[], object],
) -> None:
    if not write_setting(table, access, parameter, limits, rated_nm, found.values):
        return
    register = parameter.register_
    assert register is not None
    counts = access.read(register)

    def fed() -> tuple[str, bool]:
        feed()
        back = access.read(register)
        return f"{back} counts", back == counts and back > 0

    wanted = f"{counts} counts, once it was fed"
    table.attempt("watchdog", wanted, where_of(parameter), fed, parameter.advice or DIES)


def is_off(access: RegisterAccess, parameter: Parameter, stated: Mapping[str, float]) -> bool:
    """Return whether the time-out is 0, which switches it off, or the drive refuses to report it.

    ``stated``: values by name, for a time-out without a register, such as a 0 in rig.yaml.
    """
    return stated.get(parameter.name) == 0.0 if parameter.register_ is None else not counts_of(access, parameter)


def counts_of(access: RegisterAccess, parameter: Parameter) -> int | None:
    """Return the counts in its register; None without one, or if the drive refuses to report it."""
    try:
        return None if parameter.register_ is None else access.read(parameter.register_)
    except PreflightRefused:
        return None
