"""Modbus: its options, and a drive on TCP or a serial line, or the embedded simulator with its profile."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drivers import PreflightRefused, TdhilError
from profiles import MessageCode, Profile
from profiles.modbus import ModbusProfile
from tdhil.config import DriveData, Rig, RunOptions
from tdhil.session.buses.modbus_line import FLAGS, ModbusConfig, modbus_config
from tdhil.session.connection import BusKind, Connection, one_host

if TYPE_CHECKING:
    from drivers import Clock, Drive, FrameTap, Target
    from drivers.modbus import Link
    from sim_bus import KnownFault
    from tdhil.session.connection import PeerPlan


class SettingsRefused(PreflightRefused):
    """The serial device exists, but refuses these settings."""

    entry = MessageCode.SERIAL_LINE_REFUSED


class ModbusKind(BusKind):
    """Modbus over TCP if a host is named, else over a serial line. The options, or else the profile, name the unit."""

    name, title = "modbus", "Modbus"
    named_by = "--host or --serial, and --unit"
    section, place_keys = "modbus", "host or serial"
    flags = FLAGS
    default_profile = "generic/modbus"
    steps_over_a_wire = False          # Modbus has no SYNC

    @property
    def frame_channel(self) -> int:
        """Return the log's channel of requests and replies (PDU)."""
        from tdhil.recording import MODBUS

        return MODBUS

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Add the options of a TCP or a serial line."""
        group = parser.add_argument_group("Modbus (defaults: the profile's)")
        group.add_argument("--host", metavar="NAME", help="Modbus TCP: name or address of the drive")
        group.add_argument("--port", type=int, metavar="N", help="TCP port (default 502)")
        group.add_argument("--serial", metavar="DEVICE", help="Modbus RTU: serial device, such as /dev/ttyUSB0")
        group.add_argument("--baud", type=int, metavar="N", help="bit/s of the serial line")
        group.add_argument("--parity", choices=("N", "E", "O"), help="none, even or odd")
        group.add_argument("--stop-bits", type=int, choices=(1, 2), help="of the serial line")
        group.add_argument("--unit", type=int, metavar="N", help="unit (slave) number of the drive")

    def line(self, cli: Mapping[str, Any], rig: Rig | None, profile: Profile) -> ModbusConfig:
        """Return the configured line. Missing values are the drive's factory settings."""
        assert isinstance(profile, ModbusProfile)
        return modbus_config(cli, rig, profile)

    @property
    def nowhere(self) -> ModbusConfig:
        """Return a configuration without a line."""
        return ModbusConfig()

    def placed_in(self, rig: Rig) -> bool:
        """Return whether ``modbus:`` names a host or a device."""
        return bool(rig.modbus.host or rig.modbus.serial)

    @contextmanager
    def open(self, plan: PeerPlan, options: RunOptions, connection: Connection, data: DriveData, clock: Clock,
             tap: FrameTap, trace: Path | None) -> Iterator[Drive]:
        """Open the line and the drive on it. The line is closed afterwards."""
        from drivers.modbus import ModbusDrive

        with open_line(plan, connection, data, clock, trace) as line:
            yield ModbusDrive(
                line.link,
                line.profile,
                unit=config_of(connection).unit,
                rate_hz=options.rate_hz,
                rated_torque_nm=line.rated_torque_nm,
                given=line.given,
                tap=tap,
            )

    @contextmanager
    def open_target(self, options: RunOptions, connection: Connection, clock: Clock) -> Iterator[Target]:
        """Open the line and the unit alone."""
        from drivers.modbus import ModbusTarget

        config = config_of(connection)
        link = open_wire(config, clock)
        try:
            yield ModbusTarget(link, profile_of(connection), unit=config.unit)
        finally:
            link.close()

    def address(self, options: RunOptions, connection: Connection) -> str | None:
        """Return host and port, or the serial device with links resolved, and the unit."""
        line = config_of(connection)
        if line.host is not None:
            return f"modbus tcp {one_host(line.host)} port {line.port} unit {line.unit}"
        return f"modbus rtu {Path(str(line.serial)).resolve()} unit {line.unit}"

    def parse_faults(self, texts: Sequence[str]) -> tuple[Any, ...]:
        """Parse the faults of `sim_bus.modbus` that the embedded drive has."""
        from sim_bus.modbus import parse_all

        return parse_all(texts, "embedded")

    def faults(self) -> tuple[KnownFault, ...]:
        """Return the faults of `sim_bus.modbus` that the embedded drive has."""
        from sim_bus.modbus import listed

        return listed("embedded")

    def fault_listing(self) -> str:
        """Return the list of all faults of the simulated Modbus drive."""
        from sim_bus.modbus import listing

        return listing()


def profile_of(connection: Connection) -> ModbusProfile:
    """Return the drive's profile."""
    assert isinstance(connection.profile, ModbusProfile)
    return connection.profile


def config_of(connection: Connection) -> ModbusConfig:
    """Return the line."""
    assert isinstance(connection.line, ModbusConfig)
    return connection.line


@dataclass(frozen=True)
class OpenLine:
    """An open line, and the values that the drive at its end does not report."""

    link: Link
    profile: ModbusProfile
    rated_torque_nm: float | None
    given: Mapping[str, float]


@contextmanager
def open_line(
    plan: PeerPlan, connection: Connection, data: DriveData, clock: Clock, trace: Path | None = None
) -> Iterator[OpenLine]:
    """Open the line; it is closed afterwards. Raises the errors of opening, with the next step."""
    profile, config = profile_of(connection), config_of(connection)
    if plan.embedded:
        line = _embedded(plan, profile, config.unit, data, clock, trace)
    else:
        line = OpenLine(open_wire(config, clock), profile, data.rated_torque_nm, data.parameters)
    try:
        yield line
    finally:
        line.link.close()


def open_wire(line: ModbusConfig, clock: Clock) -> Link:
    """Open TCP if a host is named, else RTU on the serial device."""
    if line.host is not None:
        from drivers.modbus import TcpLink

        return TcpLink(line.host, line.port, clock)
    from drivers.modbus import RtuLink

    assert line.serial is not None
    try:
        return RtuLink(line.serial, clock, baud=line.baud, parity=line.parity, stop_bits=line.stop_bits)
    except TdhilError:
        raise
    except Exception as error:      # such as termios.error, which is not an OSError: a setting is refused
        raise SettingsRefused(
            f"the device refuses {line.baud} baud 8{line.parity}{line.stop_bits} ({error})", where=line.serial,
            next_step="Try other settings (--baud, --parity, --stop-bits); a pseudo terminal has no parity: --parity N",
        ) from error


def _embedded(plan: PeerPlan, profile: ModbusProfile, unit: int, data: DriveData, clock: Clock,
              trace: Path | None) -> OpenLine:
    """Return a simulated drive. It states missing values itself, because it has no panel to read them from."""
    from drivers.modbus import EmbeddedLink
    from sim_bus.modbus import EmbeddedModbusDrive

    drive = EmbeddedModbusDrive(plan.plant, profile, unit=unit, seed=plan.seed or 0, trace=trace,
                                script=plan.faults)
    rated_nm = data.rated_torque_nm
    if rated_nm is None and profile.rated_torque is None:
        rated_nm = drive.rated_torque_nm

    def ended() -> None:
        if not plan.never_came:             # it may be closed more than once
            plan.never_came.extend(drive.faults_waiting)
        drive.run_until(clock.now_s())      # the shaft's trace continues to now, and then to standstill
        drive.run_on()
        drive.close()

    link = EmbeddedLink(drive.serve, clock, on_close=ended)
    return OpenLine(link, profile, rated_nm, {**drive.untold, **data.parameters})


MODBUS = ModbusKind()
