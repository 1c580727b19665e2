"""Setpoints written at standstill, disabled, and read again: from their own registers and where the drive echoes them.

A wrong word order, sign, scale or address, and a write that is taken but not applied, show here before anything moves.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from drivers.drive import Limits
from drivers.errors import PreflightRefused
from drivers.modbus.access import Access
from drivers.modbus.codec import RANGES, register_name, to_counts
from drivers.modbus.scales import Scales, si_per_count
from drivers.preflight import Table
from profiles.modbus import Echo, ModbusProfile, Signal

SHARES = (0.25, -0.5, 0.75, -1.0 / 3.0)
"""Of the limit: of both signs, none a multiple of another's wrong scale, and each with two different halves."""
LOOKS, LOOK_S = 12, 0.05
"""At an echo: drives renew what they display every few ten milliseconds, field bus adapters more slowly still."""


def clear_setpoints(table: Table, access: Access, profile: ModbusProfile, off: int) -> bool:
    """The control word's off and setpoints of zero: no word of an earlier run may act when the drive is enabled."""
    cycle = profile.cycle
    entries = [entry for entry in (cycle.speed_setpoint, cycle.torque_setpoint) if entry is not None]
    if not profile.modes.torque:
        entries = entries[:1]
    where = ", ".join(register_name(entry.register_) for entry in entries)

    def work() -> tuple[str, bool]:
        access.write(cycle.control.register_, off)
        for entry in entries:
            access.write(entry.register_, 0)
        return "0", True

    return table.attempt("setpoints cleared", "0", where, work)


def check_setpoints(
    table: Table, access: Access, profile: ModbusProfile, scales: Scales, rated_nm: float,
    values: Mapping[str, float], limits: Limits,
) -> frozenset[str]:
    """A row for each setpoint: several values written, read back, and compared with the drive's echo if any.

    The setpoints ('speed', 'torque') whose own registers showed what was written.
    """
    read_back = set[str]()
    cycle = profile.cycle
    pairs: list[tuple[str, Signal, float, float, str]] = [
        ("speed", cycle.speed_setpoint, scales.speed_setpoint, limits.speed_rad_s, "rad/s")
    ]
    if cycle.torque_setpoint is not None and profile.modes.torque:
        pairs.append(("torque", cycle.torque_setpoint, scales.torque_setpoint, limits.torque_nm, "N·m"))
    for name, signal, lsb, limit, unit in pairs:
        tests = [share * limit for share in SHARES]
        if RANGES[signal.register_.type][0] == 0:
            tests = [abs(value) for value in tests]     # its sign stands in the control word, if anywhere
        echoes = [one for one in profile.echoes if one.setpoint == name]
        if name in profile.unseen:
            text = "this drive doesn't show it: its scale and sign can be seen in motion only"
            table.note(f"{name} setpoint as the drive understood it", text, "profile, echoes")
        for echo in (*echoes, None):
            if _check_one(table, access, name, signal, lsb, tests, unit, echo, rated_nm, values) and echo is None:
                read_back.add(name)
    return frozenset(read_back)


def _check_one(
    table: Table, access: Access, name: str, signal: Signal, lsb: float, tests: list[float], unit: str,
    echo: Echo | None, rated_nm: float, values: Mapping[str, float],
) -> bool:
    register = signal.register_
    seen_in = register if echo is None else echo.register_
    seen_lsb = lsb if echo is None else si_per_count(echo, values, rated_nm)
    title = f"{name} setpoint " + ("reads back" if echo is None else "as the drive understood it")
    where = f"{register_name(register)} → {register_name(seen_in)}"
    # Half a count of the echo for its rounding, and one more: a drive may cut off instead.
    slack = 0.0 if echo is None else 1.5 * seen_lsb
    if slack > 0.5 * max(map(abs, tests)):
        table.note(f"{title}, how finely", f"{seen_lsb:.3g} {unit} a count: too coarse for these limits to tell", where)

    def work() -> tuple[str, bool]:
        try:
            for value in tests:
                counts = to_counts(value, lsb, register, where)
                for look in range(1 if echo is None else LOOKS):
                    if look:
                        access.clock.wait_until(access.clock.now_s() + LOOK_S)
                    access.write(register, counts)      # each time: a watchdog may be on already
                    found = access.read(seen_in) * seen_lsb
                    if good := math.isclose(found, counts * lsb, rel_tol=1e-9, abs_tol=slack):
                        break
                if not good:
                    return f"{found:.6g} {unit} for {counts * lsb:.6g} {unit}", False
        finally:
            access.write(register, 0)
        return f"{len(tests)} values", True

    wanted = ", ".join(f"{value:.4g}" for value in tests) + f" {unit}"
    if echo is None:
        try:
            access.read(register)
        except PreflightRefused as error:
            table.note(title, f"can't be read: {error.what}", where)
            return False
    mend = "Word order, scale, sign or address of it is wrong in the profile, or the drive doesn't take it over"
    if echo is not None:
        mend += ". Does it take its reference from this bus, in both directions? See the profile's source for the echo"
    return table.attempt(title, wanted, where, work, mend)
