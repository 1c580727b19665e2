"""A Modbus drive on TCP or on a serial line, or the embedded simulator that wears its profile."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drivers import Clock, FrameTap, PreflightRefused, TdhilError
from drivers.modbus import ModbusDrive
from profiles.modbus import ModbusProfile
from tdhil.config import DriveData, RunOptions
from tdhil.session.buses.modbus_line import ModbusConfig
from tdhil.session.connection import BusKind, Connection

if TYPE_CHECKING:
    from drivers.modbus import Link
    from tdhil.session.connection import PeerPlan


class SettingsRefused(PreflightRefused):
    """The serial device is there, but not with these settings."""


@contextmanager
def open_modbus(plan: PeerPlan, options: RunOptions, connection: Connection, data: DriveData, clock: Clock,
                tap: FrameTap, trace: Path | None) -> Iterator[ModbusDrive]:
    """The unit that the options, or else the profile, name."""
    with open_line(plan, connection, data, clock, trace) as line:
        yield ModbusDrive(
            line.link,
            line.profile,
            unit=connection.modbus.unit,
            rate_hz=options.rate_hz,
            rated_torque_nm=line.rated_torque_nm,
            given=line.given,
            tap=tap,
        )


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
    profile = connection.profile
    assert isinstance(profile, ModbusProfile)
    if plan.embedded:
        line = _embedded(plan, profile, connection.modbus.unit, data, clock, trace)
    else:
        line = OpenLine(open_wire(connection.modbus, clock), profile, data.rated_torque_nm, data.parameters)
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


def _faults(texts: Sequence[str]) -> tuple[Any, ...]:
    from sim_bus.modbus import parse_all

    return parse_all(texts, "embedded")


MODBUS = BusKind(open_modbus, _faults, steps_over_a_wire=False)     # it has no SYNC
