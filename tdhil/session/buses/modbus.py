"""Modbus: its options, and a drive on TCP or on a serial line, or the embedded simulator that wears its profile."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drivers import PreflightRefused, TdhilError
from profiles import Profile
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
    """The serial device is there, but not with these settings."""


class ModbusKind(BusKind):
    """TCP where a host is named, else a serial line; of its units, the one that the options, or the profile, name."""

    name, title = "modbus", "Modbus"
    named_by = "--host or --serial, and --unit"
    section, place_keys = "modbus", "host or serial"
    flags = FLAGS
    default_profile = "generic/modbus"
    steps_over_a_wire = False          # it has no SYNC

    @property
    def frame_channel(self) -> int:
        """Requests and replies (PDU)."""
        from tdhil.recording import MODBUS

        return MODBUS

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Of a TCP or a serial line."""
        group = parser.add_argument_group("Modbus (what is left out is as the profile says)")
        group.add_argument("--host", metavar="NAME", help="Modbus TCP: name or address of the drive")
        group.add_argument("--port", type=int, metavar="N", help="TCP port (default 502)")
        group.add_argument("--serial", metavar="DEVICE", help="Modbus RTU: serial device, such as /dev/ttyUSB0")
        group.add_argument("--baud", type=int, metavar="N", help="bit/s of the serial line")
        group.add_argument("--parity", choices=("N", "E", "O"), help="none, even or odd")
        group.add_argument("--stop-bits", type=int, choices=(1, 2), help="of the serial line")
        group.add_argument("--unit", type=int, metavar="N", help="unit (slave) number of the drive")

    def line(self, cli: Mapping[str, Any], rig: Rig | None, profile: Profile) -> ModbusConfig:
        """As configured; for the rest as the drive leaves the factory."""
        assert isinstance(profile, ModbusProfile)
        return modbus_config(cli, rig, profile)

    @property
    def nowhere(self) -> ModbusConfig:
        """No line."""
        return ModbusConfig()

    def placed_in(self, rig: Rig) -> bool:
        """Does ``modbus:`` name a host or a device?"""
        return bool(rig.modbus.host or rig.modbus.serial)

    @contextmanager
    def open(self, plan: PeerPlan, options: RunOptions, connection: Connection, data: DriveData, clock: Clock,
             tap: FrameTap, trace: Path | None) -> Iterator[Drive]:
        """The line, closed afterwards, and the drive on it."""
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
        """The unit alone, on an open line."""
        from drivers.modbus import ModbusTarget

        config = config_of(connection)
        link = open_wire(config, clock)
        try:
            yield ModbusTarget(link, profile_of(connection), unit=config.unit)
        finally:
            link.close()

    def address(self, options: RunOptions, connection: Connection) -> str | None:
        """Host and port, or the serial device whatever links lead to it, and the unit."""
        line = config_of(connection)
        if line.host is not None:
            return f"modbus tcp {one_host(line.host)} port {line.port} unit {line.unit}"
        return f"modbus rtu {Path(str(line.serial)).resolve()} unit {line.unit}"

    def parse_faults(self, texts: Sequence[str]) -> tuple[Any, ...]:
        """Of `sim_bus.modbus`, as far as the embedded drive has them."""
        from sim_bus.modbus import parse_all

        return parse_all(texts, "embedded")

    def faults(self) -> tuple[KnownFault, ...]:
        """Of `sim_bus.modbus`, as far as the embedded drive has them."""
        from sim_bus.modbus import listed

        return listed("embedded")

    def fault_listing(self) -> str:
        """All faults of the simulated Modbus drive."""
        from sim_bus.modbus import listing

        return listing()


def profile_of(connection: Connection) -> ModbusProfile:
    """What is known of the drive."""
    assert isinstance(connection.profile, ModbusProfile)
    return connection.profile


def config_of(connection: Connection) -> ModbusConfig:
    """Which line."""
    assert isinstance(connection.line, ModbusConfig)
    return connection.line


@dataclass(frozen=True)
class OpenLine:
    """An open line, and what the drive at its end can't tell of itself."""

    link: Link
    profile: ModbusProfile
    rated_torque_nm: float | None
    given: Mapping[str, float]


@contextmanager
def open_line(
    plan: PeerPlan, connection: Connection, data: DriveData, clock: Clock, trace: Path | None = None
) -> Iterator[OpenLine]:
    """Closed afterwards. Raises what opening it raises, with what to do."""
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
    """TCP where a host is named, else RTU on the serial device."""
    if line.host is not None:
        from drivers.modbus import TcpLink

        return TcpLink(line.host, line.port, clock)
    from drivers.modbus import RtuLink

    assert line.serial is not None
    try:
        return RtuLink(line.serial, clock, baud=line.baud, parity=line.parity, stop_bits=line.stop_bits)
    except TdhilError:
        raise
    except Exception as error:      # termios.error, say, which is no OSError: the device refuses a setting
        raise SettingsRefused(
            f"the device refuses {line.baud} baud 8{line.parity}{line.stop_bits} ({error})", where=line.serial,
            next_step="Try other settings (--baud, --parity, --stop-bits); a pseudo terminal has no parity: --parity N",
        ) from error


def _embedded(plan: PeerPlan, profile: ModbusProfile, unit: int, data: DriveData, clock: Clock,
              trace: Path | None) -> OpenLine:
    """What nobody states of a simulated drive it states itself: there is no panel to read it from."""
    from drivers.modbus import EmbeddedLink
    from sim_bus.modbus import EmbeddedModbusDrive

    drive = EmbeddedModbusDrive(plan.plant, profile, unit=unit, seed=plan.seed or 0, trace=trace,
                                script=plan.faults)
    rated_nm = data.rated_torque_nm
    if rated_nm is None and profile.rated_torque is None:
        rated_nm = drive.rated_torque_nm

    def ended() -> None:
        if not plan.never_came:             # closed more than once, by whoever ends first
            plan.never_came.extend(drive.faults_waiting)
        drive.run_until(clock.now_s())      # the shaft's trace goes up to now, and on to rest
        drive.run_on()
        drive.close()

    link = EmbeddedLink(drive.serve, clock, on_close=ended)
    return OpenLine(link, profile, rated_nm, {**drive.untold, **data.parameters})


MODBUS = ModbusKind()
