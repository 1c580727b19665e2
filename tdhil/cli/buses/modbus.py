"""Modbus for scan, doctor and rig new."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from profiles.modbus import ModbusProfile
from tdhil.cli.scan_common import BusCommands, FoundDrive, ValueSeen

if TYPE_CHECKING:
    from profiles import Profile
    from tdhil.cli.doctor_finding import DoctorFinding
    from tdhil.config import Rig, RunOptions
    from tdhil.session import Connection, PeerPlan


class ModbusCommands(BusCommands):
    """Scans units one by one, on a serial line at its usual settings; checks a drive register by register."""

    address, address_flag = "unit", "--unit"
    to_fill_in = "modbus"

    def add_scan_arguments(self, scan: argparse._ArgumentGroup) -> None:
        """Add the option for the units."""
        scan.add_argument("--units", metavar="N-M",
                          help="Modbus units to scan, such as 1-10,247 (default 1-5; TCP: and 255)")

    def scan(
        self, plan: PeerPlan, connection: Connection, options: RunOptions, asked: argparse.Namespace
    ) -> tuple[tuple[FoundDrive, ...], list[str]]:
        """Return all units at the first line setting at which a unit answers."""
        from tdhil.cli.buses.modbus_scan import UNITS_RTU, UNITS_TCP, parse_units, scan_lines
        from tdhil.config import Origin
        from tdhil.errors import UsageError
        from tdhil.session.buses import modbus

        line = modbus.config_of(connection)
        own = str(line.unit)
        usual = UNITS_RTU if line.serial is not None and not plan.embedded else UNITS_TCP
        text = asked.units or (own if line.origin("unit") is Origin.COMMAND_LINE else f"{own},{usual}")
        try:
            units = parse_units(text)
        except ValueError as error:
            raise UsageError(f"{error}", where="--units", next_step="Write it like 1-10,247") from None
        return scan_lines(plan, connection, units, say=lambda line: print(line, file=sys.stderr))  # noqa: T201

    def findings(
        self, plan: PeerPlan, connection: Connection, options: RunOptions, rig: Rig | None, seen: list[ValueSeen]
    ) -> Iterator[DoctorFinding]:
        """Yield findings on line, drive, and each register of the profile."""
        from drivers import Clock, MonotonicClock, SteppedClock, TdhilError
        from tdhil.cli.buses import modbus_doctor
        from tdhil.cli.doctor_finding import attempted, of_error, ok
        from tdhil.config import DriveData
        from tdhil.session.buses import modbus

        clock: Clock = SteppedClock() if plan.stepped else MonotonicClock()
        unit = modbus.config_of(connection).unit
        try:
            with modbus.open_line(plan, connection, rig.drive_data if rig is not None else DriveData(), clock) as line:
                yield ok("line", f"open: {line.link.description}")
                access = modbus_doctor.access_of(line.link, line.profile, unit)
                yield from attempted(
                    "drive",
                    lambda: modbus_doctor.drive_findings(
                        access, line.profile, unit, dict(line.given), line.rated_torque_nm, seen.extend
                    ),
                )
        except TdhilError as error:
            yield of_error("line", error)

    def wanted(self, connection: Connection, options: RunOptions) -> int | None:
        """Return the unit of --unit. The unit of the profile or rig.yaml is only the first one to try."""
        from tdhil.config import Origin

        line = connection.line
        return line.value("unit") if line.origin("unit") is Origin.COMMAND_LINE else None

    def section(self, found: FoundDrive, connection: Connection) -> Mapping[str, Any]:
        """Return the line setting at which the drive answered, and its unit."""
        return {**found.line, "unit": found.address}


    def blank(self, profile: Profile) -> tuple[str, ...]:
        """Return a blank line with the drive's factory settings."""
        assert isinstance(profile, ModbusProfile)
        line = profile.line
        ways = {
            "tcp": f"{{host: 192.0.2.10, unit: {line.unit}}}",
            "rtu": f"{{serial: /dev/ttyUSB0, baud: {line.baud}, parity: {line.parity}, unit: {line.unit}}}",
        }
        return (f"#modbus: {'    # or '.join(ways[way] for way in line.transports)}",)


MODBUS = ModbusCommands()
