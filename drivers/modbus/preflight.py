"""Checks and settings of a Modbus drive before its shaft may move, in the order of possible harm.

First only reads: parameters, scales, the checklist, name plate, state. An error there ends preflight: with a wrong
address even a limit would be written to the wrong place. Then setpoints, limits, echoes, mode, rate, watchdog.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from drivers.drive import DriveLimits, Mode, Outcome, PowerState
from drivers.errors import PreflightRefused
from drivers.modbus.access import RegisterAccess
from drivers.modbus.codec import RANGES, Scales, find_scales, from_words, register_name, si_per_count, to_counts
from drivers.modbus.cycle import shown_mode
from drivers.modbus.parameters import Parameters, check_name_plate, check_required, find_rated_torque, read_parameters
from drivers.modbus.state_machine import STILL_COUNTS, STILL_SHARE, decode, power_state, seen
from drivers.modbus.watchdog import counts_of, is_off
from drivers.preflight import PreflightTable, check_nothing_held
from drivers.standstill import STANDSTILL_RAD_S
from profiles.modbus import CyclicSignal, Echo, ModbusProfile

# ---------------------------------------------------------------------------------------------------------------------
# Setpoints written at standstill, disabled, and read back from their own registers and from the drive's echo.
#
# A wrong word order, sign, scale or address, and a write that is accepted but not applied, show here before motion.


SHARES = (0.25, -0.5, 0.75, -1.0 / 3.0)
"""Shares of the limit: both signs, no ratio that a wrong scale could produce, and two different halves each."""
ECHO_POLLS, ECHO_POLL_S = 12, 0.05
"""Polls of an echo, and their interval, s: drives update displayed values every few ten ms, adapters more slowly."""


def clear_setpoints(table: PreflightTable, access: RegisterAccess, profile: ModbusProfile, off: int) -> bool:
    """Write the off word and setpoints of zero: no word of an earlier run may act when the drive is enabled."""
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
    table: PreflightTable, access: RegisterAccess, profile: ModbusProfile, scales: Scales, rated_nm: float,
    values: Mapping[str, float], limits: DriveLimits,
) -> frozenset[str]:
    """Add a row for each setpoint: several values written, read back, and compared with the drive's echo if any.

    Return the setpoints ('speed', 'torque') whose own registers read back the written values.
    """
    read_back = set[str]()
    cycle = profile.cycle
    pairs: list[tuple[str, CyclicSignal, float, float, str]] = [
        ("speed", cycle.speed_setpoint, scales.speed_setpoint, limits.speed_rad_s, "rad/s")
    ]
    if cycle.torque_setpoint is not None and profile.modes.torque:
        pairs.append(("torque", cycle.torque_setpoint, scales.torque_setpoint, limits.torque_nm, "N·m"))
    for name, signal, lsb, limit, unit in pairs:
        tests = [share * limit for share in SHARES]
        if RANGES[signal.register_.type][0] == 0:
            tests = [abs(value) for value in tests]     # its sign is in the control word, if anywhere
        echoes = [one for one in profile.echoes if one.setpoint == name]
        if name in profile.unseen:
            text = "not reported by this drive: its scale and sign are checked in motion only"
            table.note(f"{name} setpoint as received by the drive", text, "profile, echoes")
        for echo in (*echoes, None):
            if _check_one(table, access, name, signal, lsb, tests, unit, echo, rated_nm, values) and echo is None:
                read_back.add(name)
    return frozenset(read_back)


def _check_one(
    table: PreflightTable, access: RegisterAccess, name: str, signal: CyclicSignal, lsb: float, tests: list[float],
    unit: str,
    echo: Echo | None, rated_nm: float, values: Mapping[str, float],
) -> bool:
    register = signal.register_
    seen_in = register if echo is None else echo.register_
    seen_lsb = lsb if echo is None else si_per_count(echo, values, rated_nm)
    title = f"{name} setpoint " + ("reads back" if echo is None else "as received by the drive")
    where = f"{register_name(register)} → {register_name(seen_in)}"
    # Half a count of the echo for its rounding, and one more because a drive may truncate instead.
    slack = 0.0 if echo is None else 1.5 * seen_lsb
    if slack > 0.5 * max(map(abs, tests)):
        table.note(f"{title}, resolution", f"{seen_lsb:.3g} {unit} a count: too coarse for this check", where)

    def work() -> tuple[str, bool]:
        try:
            for value in tests:
                counts = to_counts(value, lsb, register, where)
                for poll in range(1 if echo is None else ECHO_POLLS):
                    if poll:
                        access.clock.wait_until(access.clock.now_s() + ECHO_POLL_S)
                    access.write(register, counts)      # repeated, to feed a watchdog that may be on
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
    mend = "Its word order, scale, sign or address is wrong in the profile, or the drive does not apply the setpoint"
    if echo is not None:
        mend += ". Check that this bus is its reference source, in both directions"
    return table.attempt(title, wanted, where, work, mend)


# ---------------------------------------------------------------------------------------------------------------------

STILL_READINGS = 5
"""Number of readings whose median magnitude counts if one reading exceeds the noise of a standstill. Of 200 simulated
drives at standstill, three had one such reading."""
COARSEST_SHARE = 0.05
"""Largest value of one count, as a share of the limit."""
MODE_POLLS, MODE_POLL_S = 20, 0.05


def read_only_checks(
    table: PreflightTable, access: RegisterAccess, profile: ModbusProfile, given: Mapping[str, float],
    rated_torque_nm: float | None, limits: DriveLimits,
) -> tuple[Parameters, Scales | None, float]:
    """Run all checks that need no write. Scales are None if a row is refused."""
    spared = watchdogs_own(access, profile, given) if limits.accept_no_watchdog else frozenset()
    found = read_parameters(table, access, profile, given, spared)
    rated_nm = find_rated_torque(table, profile, found, rated_torque_nm)
    check_required(table, profile, found, spared)
    if rated_nm is not None:
        check_name_plate(table, profile, found, rated_nm)
    scales = find_scales(profile, found.values, rated_nm) if rated_nm is not None else None
    if rated_nm is not None and scales is None:
        table.row(
            "scales", "all known", "a parameter that scales speed or torque is missing or zero", False,
            "profile, cycle", "See the rows above",
        )
    if scales is not None:
        check_resolution(table, profile, scales, limits)
        check_state(table, access, profile, scales, limits.standstill_scale_rad_s)
        if limits.string:
            check_string(table, access, profile, scales, limits.torque_nm)
    refused = any(check.outcome is Outcome.REFUSED for check in table.checks)
    if refused:
        table.note("settings", "nothing was written to the drive: correct the rows above first", "driver")
    return found, None if refused else scales, rated_nm or 1.0


def watchdogs_own(access: RegisterAccess, profile: ModbusProfile, given: Mapping[str, float]) -> frozenset[str]:
    """Return the watchdog parameters that need not be right, if the operator accepts a missing watchdog and it is off.

    The set is empty if tdhil can arm the watchdog: then it tries, and the parameters must be right.
    """
    entry = profile.watchdog
    if entry.kind == "none" or entry.parameter is None:
        return frozenset()
    parameter = profile.parameter(entry.parameter)
    if not is_off(access, parameter, given):
        return frozenset()
    if parameter.set_to == "watchdog" and counts_of(access, parameter) is not None:
        return frozenset()
    return frozenset(name for name in (entry.parameter, entry.reaction_parameter) if name is not None)


def check_resolution(
    table: PreflightTable, profile: ModbusProfile, scales: Scales, limits: DriveLimits
) -> None:
    """Refuse counts that are too coarse for the limits: the scale was read in the wrong order or place."""
    cycle = profile.cycle
    pairs = (
        ("speed", cycle.speed, scales.speed, limits.speed_rad_s, "rad/s"),
        ("torque", cycle.torque, scales.torque, limits.torque_nm, "N·m"),
    )
    for name, signal, count, limit, unit in pairs:
        if count > COARSEST_SHARE * limit:
            table.row(
                f"{name} resolution", f"at most {COARSEST_SHARE * limit:.3g} {unit}", f"{count:.3g} {unit} a count",
                False, register_name(signal.register_),
                f"Check what scales it ({signal.times or 'rated torque'}: register, word order, count), and the "
                "limit in rig.yaml",
            )


def check_state(table: PreflightTable, access: RegisterAccess, profile: ModbusProfile, scales: Scales,
                standstill_scale_rad_s: float) -> None:
    """Refuse a drive in fault (it is never reset silently).

    Also refuse a turning shaft, and a drive that the field bus does not control.
    """
    control, cycle = profile.control, profile.cycle
    register = cycle.status.register_
    status = access.read(register) & 0xFFFF
    power = power_state(decode(control, status))
    speed_rad_s = access.read(cycle.speed.register_) * scales.speed
    still_rad_s = min(max(STILL_COUNTS * scales.speed, STILL_SHARE * standstill_scale_rad_s), STANDSTILL_RAD_S)
    if abs(speed_rad_s) > still_rad_s:
        readings = [access.read(cycle.speed.register_) * scales.speed for _ in range(STILL_READINGS)]
        speed_rad_s = sorted(readings, key=abs)[STILL_READINGS // 2]
    turning = abs(speed_rad_s) > still_rad_s
    found = f"{power.value}, status {status:04X}h" + (f", {speed_rad_s:.3g} rad/s" if turning else "")
    faulty = power in (PowerState.FAULT, PowerState.FAULT_REACTION)
    mend = "Clear the fault's cause, then start with --reset-fault" if faulty else "Wait for standstill of the shaft"
    where = f"{register_name(register)}, {register_name(cycle.speed.register_)}"
    known = power is not PowerState.UNKNOWN
    if not known:
        mend = "Check the drive behind a gateway, and that --profile is this drive's"
    table.row("state", "no fault, standstill", found, known and not faulty and not turning, where, mend)
    if control.remote is not None:
        remote = seen(control.remote, status)
        table.row(
            "control over the field bus", "yes", "yes" if remote else f"no, status {status:04X}h", remote,
            register_name(register), "Switch the drive from its panel (local) to remote, and check its command source",
        )


def check_string(table: PreflightTable, access: RegisterAccess, profile: ModbusProfile, scales: Scales,
                 torque_limit_nm: float) -> None:
    """Refuse a drive that holds trapped torque of a drill string after an earlier stop: `off` would release it."""
    cycle = profile.cycle
    if power_state(decode(profile.control, access.read(cycle.status.register_) & 0xFFFF)) is PowerState.QUICK_STOP:
        register = cycle.torque.register_
        held_nm = access.read(register) * scales.torque
        check_nothing_held(table, held_nm, torque_limit_nm, scales.torque, register_name(register))


def check_modes(table: PreflightTable, access: RegisterAccess, profile: ModbusProfile) -> None:
    """Write each mode while the drive is disabled; its display must follow. The drive stays in speed mode.

    A drive that switches by bits of its control word is only read: many show the mode only while they run.
    """
    modes = profile.modes
    display, register = modes.display, modes.register_
    wanted = [(Mode.TORQUE, modes.torque_value)] if modes.torque else []
    wanted.append((Mode.SPEED, modes.speed_value))
    if not modes.torque:
        table.note("modes", "speed only: the speed-mode variant of the protocol", "profile, modes")
    if display is None:
        if modes.torque:
            table.note("mode display", "the drive does not display its mode", "profile, modes.display")
        if register is None:
            return
    for mode, value in wanted:
        if register is not None and value is not None:
            where = register_name(register)
            if display is not None:
                where += f" → {register_name(display.register_)}"

            def work(value: int = value, mode: Mode = mode) -> tuple[str, bool]:
                back = access.change(register, value)
                if display is None or back != value:
                    return str(back), back == value
                shown = _poll_mode(access, profile, mode)
                return str(shown), shown_mode(profile, shown) is mode

            table.attempt(
                f"mode display for {mode.value}" if display is not None else f"mode {mode.value}", str(value),
                where, work, "The drive does not accept this mode; see its manual",
            )
        elif display is not None and mode is Mode.SPEED:
            shown = access.read(display.register_) & 0xFFFF
            text = f"{shown & display.mask:X}h before it is enabled; confirmed in motion, at each switch"
            table.note("mode display", text, register_name(display.register_))


def _poll_mode(access: RegisterAccess, profile: ModbusProfile, mode: Mode) -> int:
    display = profile.modes.display
    assert display is not None
    register, clock = display.register_, access.clock
    for _ in range(MODE_POLLS):
        words = access.read_words(register.table, register.address, register.count, register_name(register))
        shown = from_words(words, register.type, profile.line.word_order) & 0xFFFF
        if shown_mode(profile, shown) is mode:
            break
        clock.wait_until(clock.now_s() + MODE_POLL_S)
    return shown
