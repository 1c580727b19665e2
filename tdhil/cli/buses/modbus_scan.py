"""The Modbus lines of a scan: one for TCP, one after the other of the usual settings for a serial device."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from drivers.clock import Clock, MonotonicClock, SteppedClock
from drivers.errors import CommunicationLost
from drivers.modbus.link import Link
from tdhil.cli.buses.modbus import SettingsRefused, open_line
from tdhil.cli.buses.modbus_line import ModbusConfig
from tdhil.cli.connection import Connection
from tdhil.cli.found_drive import FoundDrive
from tdhil.commands.scan_modbus import BAUDS, FORMATS, identify, probe
from tdhil.config.options import Origin, Setting
from tdhil.config.rig import DriveData

if TYPE_CHECKING:
    from tdhil.cli.open_drive import PeerPlan

SCAN = "scan"
"""Where a setting of the line came from that was tried."""


def scan_lines(
    plan: PeerPlan, connection: Connection, units: tuple[int, ...], say: Callable[[str], None]
) -> tuple[tuple[FoundDrive, ...], list[str]]:
    """Everybody on the first line setting at which anybody answers. Raises CommunicationLost if nobody does."""
    garbled = tried = 0
    where = ""
    refused: SettingsRefused | None = None
    for setting in _settings(plan, connection.modbus):
        clock: Clock = SteppedClock() if plan.stepped else MonotonicClock()
        try:
            with open_line(plan, replace(connection, modbus=setting), DriveData(), clock) as line:
                where = line.link.description
                if setting.serial is not None and not plan.embedded:
                    say(f"asking {len(units)} units at {setting.baud} baud 8{setting.parity}{setting.stop_bits} …")
                present, spoiled = probe(line.link, units)
                garbled, tried = garbled + spoiled, tried + 1
                if present:
                    transports = line.profile.line.transports
                    found = _identify(line.link, present, setting, transports[0] if plan.embedded else "")
                    return found, [f"{spoiled} replies could not be read"] if spoiled else []
        except SettingsRefused as error:
            refused = error                                # this adapter has no such setting; others may do
    if refused is not None and not tried:
        raise refused
    asked = f"units {', '.join(map(str, units))}" + (f" at {tried} settings of the line" if tried > 1 else "")
    if garbled:
        raise CommunicationLost(
            f"nobody answers so that it can be read ({asked}), but {garbled} garbled replies came", where=where,
            next_step="Check baud rate and parity at the drive, the polarity of the wires, termination and shielding",
        )
    step = "Check the drive's unit number (--units 1-247 asks all), that Modbus TCP is on, and its address"
    if connection.modbus.serial is not None:
        step = "Check the drive's unit number (--units 1-247 asks all), its baud rate, the two wires and their polarity"
    raise CommunicationLost(f"nobody answers ({asked})", where=where, next_step=step)


def _identify(link: Link, units: list[int], setting: ModbusConfig, embedded: str) -> tuple[FoundDrive, ...]:
    """``embedded``: the transport of an embedded simulator, '' of a real line."""
    transport = embedded or ("rtu" if setting.serial is not None else "tcp")
    serial = not embedded and setting.serial is not None
    names = ("serial", "baud", "parity", "stop_bits") if serial else ("host", "port")
    known = {} if embedded else setting.settings
    values: dict[str, Any] = {name: known[name].value for name in names if name in known}
    return tuple(identify(link, unit, transport, values) for unit in units)


def _settings(plan: PeerPlan, line: ModbusConfig) -> Iterator[ModbusConfig]:
    """What was said first; on a serial line then the usual ones, as far as nobody named them."""
    yield line
    if plan.embedded or line.serial is None:
        return
    bauds = (line.baud,) if _said(line, "baud") else BAUDS
    parities = tuple(
        (parity, stops) for parity, stops in FORMATS
        if (not _said(line, "parity") or parity == line.parity) and (not _said(line, "stop_bits")
                                                                     or stops == line.stop_bits)
    )
    for baud in bauds:
        for parity, stops in parities:
            if (baud, parity, stops) != (line.baud, line.parity, line.stop_bits):
                changed = {"baud": baud, "parity": parity, "stop_bits": stops}
                yield ModbusConfig(MappingProxyType(
                    {**line.settings, **{name: Setting(value, SCAN, Origin.SCAN) for name, value in changed.items()}}
                ))


def _said(line: ModbusConfig, name: str) -> bool:
    """On the command line or in rig.yaml, not by the profile."""
    return line.origin(name) in (Origin.COMMAND_LINE, Origin.RIG_FILE)
