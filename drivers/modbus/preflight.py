"""What is checked on a Modbus drive before its shaft may move, in the order in which it can do harm.

First only reading: parameters, scales, the checklist, name plate, state. Whatever is wrong there ends it: with a wrong
address even a limit would be written to the wrong place. Then setpoints, limits, echoes, mode, rate, watchdog.
"""

from __future__ import annotations

from collections.abc import Mapping

from drivers.drive import Mode, Outcome, PowerState
from drivers.modbus.access import Access
from drivers.modbus.codec import from_words, register_name
from drivers.modbus.cycle import shown_mode
from drivers.modbus.parameters import Parameters, check_name_plate, check_required, find_rated_torque, read_parameters
from drivers.modbus.scales import Scales, find_scales
from drivers.modbus.state_machine import decode, power_state, seen
from drivers.modbus.watchdog import counts_of, is_off
from drivers.preflight import Table
from profiles.modbus import ModbusProfile

STILL_COUNTS, STILL_SHARE = 5, 0.005
"""What counts as a shaft at rest before motion: so many counts, or this share of the speed limit if that is more."""
COARSEST_SHARE = 0.05
"""Of a limit, that one count may be worth."""
LOOKS_AT_MODE, LOOK_S = 20, 0.05


def read_only_checks(
    table: Table, access: Access, profile: ModbusProfile, given: Mapping[str, float], rated_torque_nm: float | None,
    speed_limit_rad_s: float, torque_limit_nm: float, accept_no_watchdog: bool = False,
) -> tuple[Parameters, Scales | None, float]:
    """All that can be known without writing; no scales where something is refused."""
    spared = watchdogs_own(access, profile, given) if accept_no_watchdog else frozenset()
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
        check_resolution(table, profile, scales, speed_limit_rad_s, torque_limit_nm)
        check_state(table, access, profile, scales, speed_limit_rad_s)
    refused = any(check.outcome is Outcome.REFUSED for check in table.checks)
    if refused:
        table.note("settings", "nothing was written to the drive: mend the rows above first", "driver")
    return found, None if refused else scales, rated_nm or 1.0


def watchdogs_own(access: Access, profile: ModbusProfile, given: Mapping[str, float]) -> frozenset[str]:
    """Parameters that don't matter where the operator accepts a drive without a watchdog, and this one's is off.

    None where it can be armed from here: that is tried, and what it needs must be right.
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
    table: Table, profile: ModbusProfile, scales: Scales, speed_limit_rad_s: float, torque_limit_nm: float
) -> None:
    """Counts far too coarse for the limits: a parameter that scales them was read in the wrong order or place."""
    cycle = profile.cycle
    pairs = (
        ("speed", cycle.speed, scales.speed, speed_limit_rad_s, "rad/s"),
        ("torque", cycle.torque, scales.torque, torque_limit_nm, "N·m"),
    )
    for name, signal, count, limit, unit in pairs:
        if count > COARSEST_SHARE * limit:
            table.row(
                f"{name} resolution", f"at most {COARSEST_SHARE * limit:.3g} {unit}", f"{count:.3g} {unit} a count",
                False, register_name(signal.register_),
                f"Is what scales it right ({signal.times or 'rated torque'}: register, word order, count), and the "
                "limit in rig.yaml?",
            )


def check_state(table: Table, access: Access, profile: ModbusProfile, scales: Scales, speed_limit_rad_s: float) -> None:
    """A drive in fault is refused, and never reset silently.

    So is a shaft that still turns, and a drive that the field bus has no say over.
    """
    control, cycle = profile.control, profile.cycle
    register = cycle.status.register_
    status = access.read(register) & 0xFFFF
    power = power_state(decode(control, status))
    speed_rad_s = access.read(cycle.speed.register_) * scales.speed
    still_rad_s = max(STILL_COUNTS * scales.speed, STILL_SHARE * speed_limit_rad_s)
    turning = abs(speed_rad_s) > still_rad_s
    found = f"{power.value}, status {status:04X}h" + (f", {speed_rad_s:.3g} rad/s" if turning else "")
    faulty = power is PowerState.FAULT
    mend = "Clear the fault's cause, then start with --reset-fault" if faulty else "Wait until the shaft is at rest"
    where = f"{register_name(register)}, {register_name(cycle.speed.register_)}"
    table.row("state", "no fault, at rest", found, not faulty and not turning, where, mend)
    if control.remote is not None:
        remote = seen(control.remote, status)
        table.row(
            "control over the field bus", "yes", "yes" if remote else f"no, status {status:04X}h", remote,
            register_name(register), "Switch the drive from its panel (local) to remote, and check its command source",
        )


def check_modes(table: Table, access: Access, profile: ModbusProfile) -> None:
    """The mode is written while nothing is enabled, and its display must follow; left in speed mode.

    A drive that switches by bits of its control word is only looked at: many show the mode while they run only.
    """
    modes = profile.modes
    display, register = modes.display, modes.register_
    wanted = [(Mode.TORQUE, modes.torque_value)] if modes.torque else []
    wanted.append((Mode.SPEED, modes.speed_value))
    if not modes.torque:
        table.note("modes", "speed only: the speed-mode variant of the protocol", "profile, modes")
    if display is None:
        if modes.torque:
            table.note("mode display", "the drive doesn't show what it regulates", "profile, modes.display")
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
                shown = _look(access, profile, mode)
                return str(shown), shown_mode(profile, shown) is mode

            table.attempt(
                f"mode display for {mode.value}" if display is not None else f"mode {mode.value}", str(value),
                where, work, "The drive doesn't take this mode over; see its manual",
            )
        elif display is not None and mode is Mode.SPEED:
            shown = access.read(display.register_) & 0xFFFF
            text = f"{shown & display.mask:X}h before it is enabled; confirmed in motion, at each switch"
            table.note("mode display", text, register_name(display.register_))


def _look(access: Access, profile: ModbusProfile, mode: Mode) -> int:
    display = profile.modes.display
    assert display is not None
    register, clock = display.register_, access.clock
    for _ in range(LOOKS_AT_MODE):
        words = access.read_words(register.table, register.address, register.count, register_name(register))
        shown = from_words(words, register.type, profile.line.word_order) & 0xFFFF
        if shown_mode(profile, shown) is mode:
            break
        clock.wait_until(clock.now_s() + LOOK_S)
    return shown
