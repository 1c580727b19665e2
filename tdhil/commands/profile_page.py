"""`tdhil profiles show`: all that a person at the drive needs of a profile, on the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

from profiles.canopen import CanopenProfile
from profiles.canopen_parameter import Parameter
from profiles.entry import Entry
from profiles.library import Profile
from profiles.modbus import ModbusProfile
from profiles.modbus import Parameter as ModbusParameter
from tdhil.cli.profile_text import (
    facts_of,
    modes_text,
    rated_torque_is_told_by_hand,
    required_text,
    sure_text,
    watchdog_text,
)
from tdhil.commands.profile_registers import register_uses, unit_text
from tdhil.commands.unverified import FLAG, doubtful

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

_MARKS = {"verified": "", "likely": "likely", "unverified": "UNVERIFIED"}


def show(profile: Profile, console: Console) -> None:
    """The page. What is not verified stands last, where it is seen."""
    _head(profile, console)
    _by_hand(profile, console)
    if isinstance(profile, ModbusProfile):
        _registers(profile, console)
        _filters(profile, console)
        sections: tuple[str, ...] = ("line", "control", "modes", "quick_stop", "watchdog", "name_plate")
    else:
        _objects(profile, console)
        sections = tuple(name for name, _ in profile.entries() if not name.startswith("parameters."))
    for name, entry in profile.entries():
        if name in sections:
            _section(name, entry, console)
    _not_verified(profile, console)


def _head(profile: Profile, console: Console) -> None:
    console.print(f"{profile.name}: {profile.title}", style="bold", markup=False)
    rows = [("bus", profile.bus), ("modes", modes_text(profile)), ("watchdog", watchdog_text(profile))]
    if isinstance(profile, ModbusProfile):
        line = profile.line
        rows.append(("line", f"{' or '.join(line.transports)}; TCP port {line.port}; {line.baud} baud 8{line.parity}"
                             f"{line.stop_bits}; unit {line.unit}; 32 bit {line.word_order.replace('_', ' ')}"))
        rows.append(("cycle", f"{profile.cycle.rate_hz:g} Hz unless told otherwise, if the line carries it"))
    if profile.experimental:
        rows.append(("EXPERIMENTAL", "second-hand, or never tried on this bus"))
    rows.append(("how sure", sure_text(profile)))
    for name, text in rows:
        console.print(f"  {name:<12}  {text}", markup=False)
    for hint in getattr(profile, "hints", ()):
        console.print(f"  - {hint}", markup=False)


def _by_hand(profile: Profile, console: Console) -> None:
    """The checklist: what to set at the drive, what rig.yaml must say for it, and what a run sets itself."""
    required = [one for one in profile.parameters if one.require is not None]
    if required:
        table = _table("set by hand at the drive; a run is refused until it reads so", "parameter", "must be", "do")
        for one in required:
            assert one.require is not None
            table.add_row(one.title, required_text(one.require, unit_text(one.unit)), _advice(one))
        console.print(table)
    told = [(f"parameters: {{{one.name}: …}}", one.title, unit_text(one.unit)) for one in _untold(profile)]
    if rated_torque_is_told_by_hand(profile):
        told.insert(0, ("rated_torque_nm", "torque that is 100 %", "N·m"))
    if told:
        table = _table("to be told in rig.yaml, since the drive does not", "key under drive_data", "what it is", "unit")
        for row in told:
            table.add_row(*row)
        console.print(table)
    written = [one for one in profile.parameters if one.set_to is not None]
    if written:
        table = _table("written by a run, read back, and given back afterwards", "parameter", "gets")
        for one in written:
            table.add_row(one.title, str(one.set_to).replace("_", " "))
        console.print(table)


def _untold(profile: Profile) -> tuple[ModbusParameter, ...]:
    """Parameters that can't be read over the bus."""
    if not isinstance(profile, ModbusProfile):
        return ()
    return tuple(one for one in profile.parameters if one.register_ is None)


def _advice(one: Parameter | ModbusParameter) -> str:
    stated = ""
    if isinstance(one, ModbusParameter) and one.register_ is None:
        stated = f"and state it in rig.yaml: drive_data.parameters.{one.name}"
    return "; ".join(part for part in (one.advice or "", stated) if part)


def _objects(profile: CanopenProfile, console: Console) -> None:
    """Objects beyond those of CiA 402."""
    if profile.parameters:
        table = _table("the drive's own objects", "object", "type", "meaning", "one count", "how sure")
        for one in profile.parameters:
            scale = f"{one.per_lsb:g}{f' × {one.times}' if one.times else ''} {unit_text(one.unit)}".strip()
            scale = "2^count" if one.scale == "power_of_two" else scale
            at = f"{one.index:04X}h:{one.sub}" if one.sub else f"{one.index:04X}h"
            table.add_row(at, one.type, one.title, scale, _MARKS[one.confidence])
        console.print(table)


def _registers(profile: ModbusProfile, console: Console) -> None:
    table = _table("registers, as on the wire, counted from 0", "address", "type", "meaning", "one count", "how sure")
    for use in register_uses(profile):
        table.add_row(use.address, use.register.type, use.meaning, use.scale, _MARKS[use.entry.confidence])
    console.print(table)


def _filters(profile: ModbusProfile, console: Console) -> None:
    if not profile.filters:
        console.print("No filter on the reported signals is known of this drive.")
        return
    table = _table("smoothing of what the drive reports", "signal", "time constant", "to change for a better result")
    for one in profile.filters:
        where = f"{one.documented_s:g} s, as documented" if one.parameter is None else (
            f"read from {profile.parameter(one.parameter).title}"
        )
        table.add_row(one.signal, where, one.advice or "")
    console.print(table)
    for name in ("speed", "torque"):
        if note := getattr(profile.cycle, name).note:
            console.print(f"  {name}: {note}", markup=False)


def _section(name: str, entry: Entry, console: Console) -> None:
    table = _table(f"{name} ({entry.confidence}: {entry.source})", "", "", "")
    table.show_header = False
    for key, value, said in facts_of(entry):
        table.add_row(key, value, said)
    if table.row_count:
        console.print(table)


def _not_verified(profile: Profile, console: Console) -> None:
    found = doubtful(profile)
    if not found:
        console.print("Every entry is verified.")
        return
    table = _table("not verified: look these up in the drive's manual", "entry", "how sure", "claims", "from")
    for name, entry in found:
        claims = "; ".join(f"{key} {value}" for key, value, _ in facts_of(entry))
        table.add_row(name, _MARKS[entry.confidence], claims, entry.source)
    console.print(table)
    console.print(
        f"A real drive is refused until you say 'confidence: verified' in a copy of the profile, or take them as they "
        f"are: {FLAG} likely takes all that are likely, {FLAG} NAME one of them.", markup=False
    )


def _table(title: str, *headings: str) -> Table:
    from rich.table import Table
    from rich.text import Text

    table = Table(title=Text(f"\n{title}"), title_justify="left", expand=False)
    for heading in headings:
        table.add_column(heading, overflow="fold")
    return table
