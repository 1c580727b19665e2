"""A Modbus drive, read only: does it answer, is it simulated, and each register of its profile beside its meaning."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from drivers import NO_WATCHDOG_FLAG, ObjectRefused, PowerState, PreflightTable
from drivers.modbus import (
    Link,
    RegisterAccess,
    check_name_plate,
    check_required,
    decode,
    find_filters,
    find_rated_torque,
    power_state,
    read_marker,
    read_parameters,
    seen,
    settle,
)
from profiles.modbus import ModbusProfile, Parameter
from tdhil.cli.doctor_finding import DoctorFinding, bad, note, of_check, ok
from tdhil.cli.profile_text import RegisterUse, register_uses, unit_text, watchdog_text


@dataclass(frozen=True)
class RegisterSeen:
    """What stands in one register: ``counts``, and ``value`` in its unit; ``error`` where it can't be read."""

    use: RegisterUse
    counts: int | None
    value: float | None
    error: str = ""

    @property
    def shown(self) -> str:
        """The value in its unit, bits in hexadecimal."""
        if self.counts is None:
            return self.error
        if self.use.per_lsb is None:
            return f"{self.counts & 0xFFFF:04X}h"
        return f"{self.value:.9g} {self.use.unit}".strip() if self.value is not None else "scale not known"

    def cells(self) -> tuple[str, str, str, str]:
        """Address, counts, value, meaning."""
        return self.use.address, "-" if self.counts is None else str(self.counts), self.shown, self.use.meaning

    def plain(self) -> dict[str, Any]:
        """As the JSON document has it."""
        return {
            "name": self.use.name, "address": self.use.register.address, "table": self.use.register.table,
            "meaning": self.use.meaning, "counts": self.counts, "value": self.value, "unit": self.use.unit,
            "error": self.error or None,
        }


def access_of(link: Link, profile: ModbusProfile, unit: int) -> RegisterAccess:
    """The drive's registers, for reading."""
    return RegisterAccess(link, unit, profile.line.word_order, frozenset(profile.cycle.functions))


def read_registers(access: RegisterAccess, profile: ModbusProfile, given: dict[str, float]) -> tuple[RegisterSeen, ...]:
    """Every register of the profile, one by one: one that is refused hides no other."""
    uses = register_uses(profile)
    counts: dict[str, int] = {}
    errors: dict[int, str] = {}
    found: list[int | None] = []
    for number, use in enumerate(uses):
        try:
            raw = access.read(use.register)
        except ObjectRefused as error:
            errors[number] = error.what
            found.append(None)
            continue
        found.append(raw)
        if use.name.startswith("parameters."):
            counts[use.name.partition(".")[2]] = raw
    values = settle(profile, counts, given)
    return tuple(
        RegisterSeen(use, raw, _value(use, raw, values), errors.get(number, ""))
        for number, (use, raw) in enumerate(zip(uses, found, strict=True))
    )


def drive_findings(
    access: RegisterAccess, profile: ModbusProfile, unit: int, given: dict[str, float], rated_torque_nm: float | None,
    keep: Callable[[tuple[RegisterSeen, ...]], None],
) -> Iterator[DoctorFinding]:
    """Raises CommunicationLost where it doesn't answer. ``keep`` gets what stands in the registers."""
    try:
        word = access.read(profile.cycle.status.register_)
        yield ok("drive", f"unit {unit} answers")
        yield _state(profile, word & 0xFFFF)
    except ObjectRefused as error:
        yield bad("drive", f"unit {unit} answers, but {error.where}: {error.what}",
                  error.next_step or "Is this the drive of this profile? See tdhil scan")
    simulated = read_marker(access).simulated
    yield note("peer", "SIMULATED: bears the simulator's marker") if simulated else ok("peer", "no simulator")
    found = read_registers(access, profile, given)
    keep(found)
    refused = [one for one in found if one.counts is None]
    if refused:
        first = refused[0]
        said = f"{len(refused)} of {len(found)} can't be read, such as {first.use.address}: {first.error}"
        yield bad("registers", said, f"Compare them with the drive's manual; is {profile.name} its profile?")
    else:
        yield ok("registers", f"all {len(found)} of profile {profile.name} can be read")
    table = PreflightTable()
    parameters = read_parameters(table, access, profile, given)
    check_required(table, profile, parameters)
    rated_nm = find_rated_torque(table, profile, parameters, rated_torque_nm)
    if rated_nm is not None:
        check_name_plate(table, profile, parameters, rated_nm)
    find_filters(table, profile, parameters)
    yield from map(of_check, table.checks)
    yield _watchdog(profile, parameters.values)


def _value(use: RegisterUse, raw: int | None, values: Mapping[str, float]) -> float | None:
    if raw is None or use.per_lsb is None:
        return None
    if use.name.startswith("parameters."):
        return values.get(use.name.partition(".")[2])
    factor = values.get(use.times) if use.times is not None else 1.0
    return None if factor is None else raw * use.per_lsb * factor


def _state(profile: ModbusProfile, word: int) -> DoctorFinding:
    """As the status word shows it."""
    state = power_state(decode(profile.control, word))
    said = f"{state.value} (status word {word:04X}h)"
    if state is PowerState.FAULT:
        return bad("state", said, "Clear its cause, then start a run with --reset-fault")
    if state is PowerState.ENABLED:
        return bad("state", f"{said}: somebody else drives it", "Disable it there first")
    if profile.control.remote is not None and not seen(profile.control.remote, word):
        return bad("state", f"{said}: the field bus has no control",
                   "Switch the drive from its panel (local) to remote, and check its command source")
    return ok("state", said)


def _watchdog(profile: ModbusProfile, values: Mapping[str, float]) -> DoctorFinding:
    dog = profile.watchdog
    if dog.kind == "none":
        return bad("watchdog", f"profile {profile.name} knows none",
                   "A host that dies would leave the shaft turning: "
                   f"identify takes it by name only, {NO_WATCHDOG_FLAG}")
    parameter: Parameter | None = profile.parameter(dog.parameter) if dog.parameter is not None else None
    if parameter is None:
        return note("watchdog", watchdog_text(profile))
    value = values.get(parameter.name)
    if value is None:
        return bad("watchdog", f"{parameter.title} can't be read", "Compare its address with the drive's manual")
    set_by = "a run sets and gives it back" if parameter.set_to is not None else "set by hand"
    return ok("watchdog", f"{parameter.title}: {value:g} {unit_text(parameter.unit)} ({set_by}), "
                          f"then {dog.reaction.replace('_', ' ')}")
