"""Read-only checks of a Modbus drive: answers, simulator marker, and each register of its profile."""

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
    """The content of one register: ``counts``, and ``value`` in its unit; ``error`` if it can't be read."""

    use: RegisterUse
    counts: int | None
    value: float | None
    error: str = ""

    @property
    def shown(self) -> str:
        """Return the value in its unit, bits in hexadecimal."""
        if self.counts is None:
            return self.error
        if self.use.per_lsb is None:
            return f"{self.counts & 0xFFFF:04X}h"
        return f"{self.value:.9g} {self.use.unit}".strip() if self.value is not None else "scale unknown"

    def cells(self) -> tuple[str, str, str, str]:
        """Return address, counts, value and meaning."""
        return self.use.address, "-" if self.counts is None else str(self.counts), self.shown, self.use.meaning

    def plain(self) -> dict[str, Any]:
        """Return it as in the JSON document."""
        return {
            "name": self.use.name, "address": self.use.register.address, "table": self.use.register.table,
            "meaning": self.use.meaning, "counts": self.counts, "value": self.value, "unit": self.use.unit,
            "error": self.error or None,
        }


def access_of(link: Link, profile: ModbusProfile, unit: int) -> RegisterAccess:
    """Return the drive's registers, for reading."""
    return RegisterAccess(link, unit, profile.line.word_order, frozenset(profile.cycle.functions))


def read_registers(access: RegisterAccess, profile: ModbusProfile, given: dict[str, float]) -> tuple[RegisterSeen, ...]:
    """Read every register of the profile, one by one: a refused one hides no other."""
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
    """Yield findings on the drive. Raises CommunicationLost without an answer. ``keep`` receives the registers."""
    try:
        word = access.read(profile.cycle.status.register_)
        yield ok("drive", f"unit {unit} answers")
        yield _state(profile, word & 0xFFFF)
    except ObjectRefused as error:
        yield bad("drive", f"unit {unit} answers, but {error.where}: {error.what}",
                  error.next_step or "Check with tdhil scan that the profile fits the drive")
    simulated = read_marker(access).simulated
    yield note("peer", "SIMULATED: it has the simulator's marker") if simulated else ok("peer", "not a simulator")
    found = read_registers(access, profile, given)
    keep(found)
    refused = [one for one in found if one.counts is None]
    if refused:
        first = refused[0]
        said = f"{len(refused)} of {len(found)} can't be read, such as {first.use.address}: {first.error}"
        yield bad("registers", said, f"Compare them with the drive's manual; check that {profile.name} is its profile")
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
    """Return the finding on the state in the status word."""
    state = power_state(decode(profile.control, word))
    said = f"{state.value} (status word {word:04X}h)"
    if state is PowerState.FAULT:
        return bad("state", said, "Remove its cause, then start a run with --reset-fault")
    if state is PowerState.ENABLED:
        return bad("state", f"{said}: another master controls it", "Disable it there first")
    if profile.control.remote is not None and not seen(profile.control.remote, word):
        return bad("state", f"{said}: the fieldbus has no control",
                   "Switch the drive from its panel (local) to remote, and check its command source")
    return ok("state", said)


def _watchdog(profile: ModbusProfile, values: Mapping[str, float]) -> DoctorFinding:
    dog = profile.watchdog
    if dog.kind == "none":
        return bad("watchdog", f"profile {profile.name} names none",
                   "If the host fails, the shaft keeps turning: "
                   f"identify accepts this only with {NO_WATCHDOG_FLAG}")
    parameter: Parameter | None = profile.parameter(dog.parameter) if dog.parameter is not None else None
    if parameter is None:
        return note("watchdog", watchdog_text(profile))
    value = values.get(parameter.name)
    if value is None:
        return bad("watchdog", f"{parameter.title} can't be read", "Compare its address with the drive's manual")
    set_by = "a run sets and restores it" if parameter.set_to is not None else "set by hand"
    return ok("watchdog", f"{parameter.title}: {value:g} {unit_text(parameter.unit)} ({set_by}), "
                          f"then {dog.reaction.replace('_', ' ')}")
