"""Modbus, above its driver: options, rig.yaml, the line, the simulated drive, scan, doctor, profile page.

The address of a drive has its source for each value. Order: command line, rig.yaml's ``modbus:``, the profile's
``line:`` (factory settings of the drive). A host means TCP, a serial device means RTU. If the command line names one of
them, rig.yaml's value for the other is ignored.
"""

from __future__ import annotations

import argparse
import contextlib
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, cast

from pydantic import Field

from drivers import (
    NO_WATCHDOG_FLAG,
    CommunicationLost,
    MonotonicClock,
    ObjectRefused,
    PowerState,
    PreflightRefused,
    PreflightTable,
    SteppedClock,
    TdhilError,
)
from drivers import modbus as driver
from profiles import DataModel, Finding, Profile, ProfileEntry, load_profile, profile_names, unit_text
from profiles.modbus import BusLine, ModbusProfile, Parameter, Register
from tdhil.buses.bus import Bus, Connection, FoundDrive, Line, Opening, PeerPlan, ProfileTable, ValueSeen, one_host
from tdhil.buses.doctor_finding import DoctorFinding, attempted, bad, note, of_check, of_error, ok
from tdhil.buses.profile_text import MARKS, watchdog_text
from tdhil.config import DriveData, Origin, Rig, RunOptions, Setting, check_values
from tdhil.errors import MessageCode, UsageError

if TYPE_CHECKING:
    from drivers import Clock, Drive, Target
    from sim_bus import KnownFault

# ---------------------------------------------------------------------------------------------------------------------
# The section modbus: of rig.yaml.


class ModbusSection(DataModel):
    """The address of a Modbus drive. Missing values come from the profile's ``line``."""

    host: str | None = Field(default=None, min_length=1, description="Modbus TCP: name or address of the drive")
    port: int | None = Field(default=None, ge=1, le=65535, description="TCP port")
    serial: str | None = Field(default=None, min_length=1, description="Modbus RTU: device, such as /dev/ttyUSB0")
    baud: int | None = Field(default=None, ge=1200, le=1_000_000, description="bit/s on the serial line")
    parity: Literal["N", "E", "O"] | None = Field(default=None, description="of the serial line: N, E or O")
    stop_bits: Literal[1, 2] | None = Field(default=None, description="of the serial line")
    unit: int | None = Field(default=None, ge=0, le=255, description="unit (slave) number of the drive")

    @classmethod
    def contradictions(cls, values: Mapping[str, Any]) -> list[Finding]:
        """Return two lines at once, or a unit out of range."""
        findings = []
        host, serial, unit = (values.get(name) for name in ("host", "serial", "unit"))
        if host is not None and serial is not None:
            findings.append(("serial", "and host exclude each other; keep one"))
        if serial is not None and unit is not None and not 1 <= unit <= 247:
            findings.append(("unit", f"must be 1 to 247 on a serial line, not {unit}"))
        return findings


# ---------------------------------------------------------------------------------------------------------------------
# The address of a drive, with the source of each value.


FLAGS: Mapping[str, str] = MappingProxyType({
    "host": "--host",
    "port": "--port",
    "serial": "--serial",
    "baud": "--baud",
    "parity": "--parity",
    "stop_bits": "--stop-bits",
    "unit": "--unit",
})
TCP, RTU = ("host", "port", "unit"), ("serial", "baud", "parity", "stop_bits", "unit")


@dataclass(frozen=True)
class ModbusLine(Line):
    """Each value and its origin; only those of the transport in use (TCP or RTU)."""

    @property
    def host(self) -> str | None:
        return cast("str | None", self.value("host"))

    @property
    def port(self) -> int:
        return cast(int, self.value("port"))

    @property
    def serial(self) -> str | None:
        return cast("str | None", self.value("serial"))

    @property
    def baud(self) -> int:
        return cast(int, self.value("baud"))

    @property
    def parity(self) -> Literal["N", "E", "O"]:
        return cast(Literal["N", "E", "O"], self.value("parity"))

    @property
    def stop_bits(self) -> Literal[1, 2]:
        return cast(Literal[1, 2], self.value("stop_bits"))

    @property
    def unit(self) -> int:
        return cast(int, self.value("unit"))


def modbus_line(cli: Mapping[str, Any], rig: Rig | None, profile: ModbusProfile | None) -> ModbusLine:
    """Return the line from all sources; ``cli`` is keyed by the names in `FLAGS`.

    Raises UsageError for an unusable value. Without a profile the defaults are those of the Modbus standard.
    """
    given = {name: Setting.by_flag(cli[name], flag) for name, flag in FLAGS.items() if cli.get(name) is not None}
    values = {name: setting.value for name, setting in given.items()}
    check_values(ModbusSection, values, {(name,): flag for name, flag in FLAGS.items()})
    settings = dict(given)
    section = ModbusSection() if rig is None else MODBUS.section_of(rig)
    for name in FLAGS:
        if rig is not None and (value := getattr(section, name)) is not None:
            settings.setdefault(name, Setting.by_rig(value, rig, f"modbus.{name}"))
    for one, other in (("host", "serial"), ("serial", "host")):
        if one in given and other not in given:
            settings.pop(other, None)
    line, source, origin = _STANDARD, "default", Origin.BUILT_IN
    if profile is not None:
        line, source, origin = profile.line, f"profile {profile.name}", Origin.PROFILE
    for name in FLAGS:
        if name not in ("host", "serial"):
            settings.setdefault(name, Setting(getattr(line, name), source, origin))
    known = RTU if "serial" in settings else TCP if "host" in settings else ("unit",)
    found = ModbusLine(MappingProxyType({name: settings[name] for name in known if name in settings}))
    for name in given:
        if name not in known:
            needs = "--serial" if name in RTU else "--host"
            raise UsageError(f"has no effect without {needs}", where=FLAGS[name], next_step="See tdhil identify --help",
                             entry=MessageCode.BUS_OPTIONS_WRONG)
    if found.serial is not None and not 1 <= found.unit <= 247:
        raise UsageError(
            f"unit {found.unit} is outside 1 to 247, the range of a serial line", where=found.source("unit"),
            next_step="Give the drive's unit with --unit",
            entry=MessageCode.BUS_OPTIONS_WRONG,
        )
    return found


_STANDARD = BusLine(transports=("tcp", "rtu"), source="the Modbus specification", confidence="verified")


# ---------------------------------------------------------------------------------------------------------------------
# The command line, and the drive on its line.


class SettingsRefused(PreflightRefused):
    """The serial device exists, but refuses these settings."""

    entry = MessageCode.SERIAL_LINE_REFUSED


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of a TCP or a serial line."""
    group = parser.add_argument_group("Modbus (defaults: the profile's)")
    group.add_argument("--host", metavar="NAME", help="Modbus TCP: name or address of the drive")
    group.add_argument("--port", type=int, metavar="N", help="Modbus TCP: port (default 502)")
    group.add_argument("--serial", metavar="DEVICE", help="Modbus RTU: serial device, such as /dev/ttyUSB0")
    group.add_argument("--baud", type=int, metavar="N", help="Modbus RTU: bit rate of the serial line, bit/s")
    group.add_argument("--parity", choices=("N", "E", "O"), help="Modbus RTU: parity: none, even or odd")
    group.add_argument("--stop-bits", type=int, choices=(1, 2), help="Modbus RTU: number of stop bits")
    group.add_argument("--unit", type=int, metavar="N", help="unit (slave) address of the drive")


def _line(cli: Mapping[str, Any], rig: Rig | None, profile: Profile) -> ModbusLine:
    """Return the configured line. Missing values are the drive's factory settings."""
    assert isinstance(profile, ModbusProfile)
    return modbus_line(cli, rig, profile)


def _address(options: RunOptions, connection: Connection) -> str | None:
    """Return host and port, or the serial device with links resolved, and the unit."""
    line = line_of(connection)
    if line.host is not None:
        return f"modbus tcp {one_host(line.host)} port {line.port} unit {line.unit}"
    return f"modbus rtu {Path(str(line.serial)).resolve()} unit {line.unit}"


@contextmanager
def _open(asked: Opening) -> Iterator[Drive]:
    """Open the line and the drive on it. The line is closed afterwards."""
    from drivers.undo_journal import UndoJournal

    plan, options, connection = asked.plan, asked.options, asked.connection
    with open_line(plan, connection, asked.data, asked.clock, asked.trace) as line:
        yield driver.ModbusDrive(
            line.link,
            line.profile,
            unit=line_of(connection).unit,
            rate_hz=options.rate_hz,
            rated_torque_nm=line.rated_torque_nm,
            given=line.given,
            tap=asked.tap,
            journal=None if plan.embedded else UndoJournal(
                plan.left_in or Path(options.log).parent, journal_address(line_of(connection), line.profile)),
        )


def journal_address(line: ModbusLine, profile: ModbusProfile) -> str:
    """Return the drive's part of the name of its undo journal: Modbus reports no serial number of a drive.

    The profile belongs to it, because another profile may give another meaning to a register.
    """
    place = line.serial if line.host is None else f"{one_host(line.host)}-{line.port}"
    return re.sub(r"[^\w.-]+", "-", f"{place}-unit{line.unit}-{profile.name}").strip("-")


@contextmanager
def _open_target(options: RunOptions, connection: Connection, clock: Clock) -> Iterator[Target]:
    """Open the line and the unit alone."""
    line = line_of(connection)
    link = open_wire(line, clock)
    try:
        yield driver.ModbusTarget(link, profile_of(connection), unit=line.unit)
    finally:
        link.close()


def _parse_faults(texts: Sequence[str]) -> tuple[Any, ...]:
    from sim_bus.modbus import parse_all

    return parse_all(texts, "embedded")


def _faults() -> tuple[KnownFault, ...]:
    from sim_bus.modbus import listed

    return listed("embedded")


def _fault_listing(width: int) -> str:
    from sim_bus.modbus import listing

    return listing(width)


def profile_of(connection: Connection) -> ModbusProfile:
    """Return the drive's profile."""
    assert isinstance(connection.profile, ModbusProfile)
    return connection.profile


def line_of(connection: Connection) -> ModbusLine:
    """Return the line."""
    assert isinstance(connection.line, ModbusLine)
    return connection.line


@dataclass(frozen=True)
class OpenLine:
    """An open line, and the values that the drive at its end does not report."""

    link: driver.Link
    profile: ModbusProfile
    rated_torque_nm: float | None
    given: Mapping[str, float]


@contextmanager
def open_line(
    plan: PeerPlan, connection: Connection, data: DriveData, clock: Clock, trace: Path | None = None
) -> Iterator[OpenLine]:
    """Open the line; it is closed afterwards. Raises the errors of opening, with the next step."""
    profile, config = profile_of(connection), line_of(connection)
    if plan.embedded:
        line = _embedded(plan, profile, config.unit, data, clock, trace)
    else:
        line = OpenLine(open_wire(config, clock), profile, data.rated_torque_nm, data.parameters)
    try:
        yield line
    finally:
        line.link.close()


def open_wire(line: ModbusLine, clock: Clock) -> driver.Link:
    """Open TCP if a host is named, else RTU on the serial device."""
    if line.host is not None:
        return driver.TcpLink(line.host, line.port, clock)
    assert line.serial is not None
    try:
        return driver.RtuLink(line.serial, clock, baud=line.baud, parity=line.parity, stop_bits=line.stop_bits)
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

    link = driver.EmbeddedLink(drive.serve, clock, on_close=ended)
    return OpenLine(link, profile, rated_nm, {**drive.untold, **data.parameters})


# ---------------------------------------------------------------------------------------------------------------------
# Every register that a profile names, with its meaning: for its page and for doctor.


_SIGNALS = {
    "control": "control word",
    "status": "status word",
    "speed_setpoint": "speed setpoint",
    "torque_setpoint": "torque setpoint",
    "speed": "reported speed",
    "torque": "reported torque",
    "torque_demand": "torque demand",
}


@dataclass(frozen=True)
class RegisterUse:
    """The use of one register. ``per_lsb``: units for one count, None for words of bits; ``times``: parameter that
    multiplies.
    """

    name: str                   # as in `ModbusProfile.entries`
    meaning: str
    register: Register
    per_lsb: float | None
    unit: str                   # the unit as in texts
    times: str | None
    entry: ProfileEntry

    @property
    def address(self) -> str:
        """Return the address as on the wire and as in the manual."""
        at = self.register
        table = "" if at.table == "holding" else " input"
        return f"{at.address} ({at.address:04X}h){table}" + (f" = {at.reference}" if at.reference else "")

    @property
    def scale(self) -> str:
        """Return the value of one count."""
        if self.per_lsb is None:
            return "bits"
        times = f" × {self.times}" if self.times else ""
        return f"{self.per_lsb:g}{times} {self.unit}".strip()


def register_uses(profile: ModbusProfile) -> tuple[RegisterUse, ...]:
    """Return all uses in the profile's order: cycle, mode, parameters, echoes. Two uses may share a register."""
    found = [
        RegisterUse(
            f"cycle.{name}", meaning, part.register_, getattr(part, "per_lsb", None),
            unit_text(getattr(part, "unit", "")), getattr(part, "times", None), part,
        )
        for name, meaning in _SIGNALS.items()
        if (part := getattr(profile.cycle, name)) is not None
    ]
    modes = profile.modes
    if modes.register_ is not None:
        found.append(RegisterUse("modes", "speed or torque", modes.register_, None, "", None, modes))
    if modes.display is not None:
        found.append(RegisterUse("modes", "speed or torque, as shown", modes.display.register_, None, "", None, modes))
    found += [
        RegisterUse(f"parameters.{one.name}", one.title, one.register_, one.per_lsb, unit_text(one.unit),
                    one.factor, one)
        for one in profile.parameters
        if one.register_ is not None
    ]
    found += [
        RegisterUse(f"echoes.{one.setpoint}", f"{one.setpoint} setpoint, as received", one.register_, one.per_lsb,
                    unit_text(one.unit), one.times, one)
        for one in profile.echoes
    ]
    return tuple(found)


def _profile_facts(profile: ModbusProfile) -> Sequence[tuple[str, str]]:
    line = profile.line
    ways = {"tcp": f"TCP port {line.port}", "rtu": f"RTU {line.baud} baud 8{line.parity}{line.stop_bits}"}
    return (
        ("line", f"{' or '.join(ways[way] for way in line.transports)}; unit {line.unit}; 32 bit "
                 f"{line.word_order.replace('_', ' ')}"),
        ("cycle", f"{profile.cycle.rate_hz:g} Hz unless another rate is given, if the line allows it"),
    )


def _profile_tables(profile: ModbusProfile) -> Iterator[ProfileTable]:
    """Yield the registers, and the filters on the reported signals."""
    rows = tuple((use.address, use.register.type, use.meaning, use.scale, MARKS[use.entry.confidence])
                 for use in register_uses(profile))
    yield ProfileTable("registers, as on the wire, counted from 0",
                       ("address", "type", "meaning", "one count", "confidence"), rows)
    if not profile.filters:
        yield ProfileTable(remarks=("This profile names no filter on the reported signals.",))
        return
    filters = tuple((
        one.signal,
        f"{one.documented_s:g} s, as documented" if one.parameter is None
        else f"read from {profile.parameter(one.parameter).title}",
        one.advice or "",
    ) for one in profile.filters)
    notes = tuple(f"  {name}: {note}" for name in ("speed", "torque") if (note := getattr(profile.cycle, name).note))
    yield ProfileTable("filters on the reported signals",
                       ("signal", "time constant", "to change for a better result"), filters, notes)


# ---------------------------------------------------------------------------------------------------------------------
# Scan: the units of a line, on a serial line at one of its usual settings after the other. It reads only.


UNITS_TCP, UNITS_RTU = "1-5,255", "1-5"
BAUDS = (19200, 9600, 38400, 115200, 57600)
FORMATS = (("E", 1), ("N", 1), ("N", 2))
"""Usual factory settings of parity and stop bits, the most common first."""
@dataclass(frozen=True)
class ProfileFit:
    """How well a profile suits a drive: whether all its registers answer and its name plate fits (None: it has
    none).
    """

    profile: str
    plate: bool | None
    named: bool                 # the drive's vendor name is the profile's vendor


def parse_units(text: str) -> tuple[int, ...]:
    """Parse ``1-5,247`` → 1 2 3 4 5 247. Raises ValueError for other text and numbers beyond 0 to 255."""
    found: list[int] = []
    for part in text.split(","):
        first, dash, last = part.partition("-")
        low, high = int(first), int(last if dash else first)
        if not 0 <= low <= high <= 255:
            raise ValueError(f"{part}: unit numbers are 0 to 255")
        found += range(low, high + 1)
    return tuple(dict.fromkeys(found))


def identify(link: driver.Link, unit: int, transport: str, line: dict[str, Any]) -> FoundDrive:
    """Return name and profile of a unit that answered."""
    vendor, product, revision = driver.device_identification(link, unit)
    said = " ".join(part for part in (vendor, product, revision) if part)
    plain = driver.RegisterAccess(link, unit, "high_first", frozenset({driver.READ_HOLDING}))
    simulated = False
    with contextlib.suppress(CommunicationLost):
        simulated = driver.read_marker(plain).simulated
    known = [one for name in profile_names() if isinstance(one := load_profile(name), ModbusProfile)]
    fits = [fit for one in known
            if transport in one.line.transports and (fit := _fit(link, unit, one, vendor)) is not None]
    profile, why = choose(fits)
    return FoundDrive("modbus", unit, product or vendor or "Modbus device", said or "unknown (function 43)", simulated,
                      profile, why, line=line)


def choose(fits: Sequence[ProfileFit]) -> tuple[str | None, str]:
    """Return (profile, reason): by name and name plate. Registers that only answer are no reason."""
    good = [fit for fit in fits if fit.plate is not False]
    ranked = sorted(good, key=lambda fit: (fit.plate is True, fit.named), reverse=True)
    if ranked and (ranked[0].plate or ranked[0].named):
        best = ranked[0]
        reasons = [text for text, holds in (
            ("the vendor's name", best.named), ("a name plate that fits P = T·ω", best.plate is True)) if holds]
        return best.profile, "all registers answer, and " + " and ".join(reasons)
    if good:
        names = ", ".join(fit.profile for fit in good)
        return None, f"the registers of {names} answer, which is no proof: choose by the drive's name plate"
    return None, "no profile fits, all have registers without an answer: copy profiles/generic/modbus.yaml and adapt it"


def _fit(link: driver.Link, unit: int, profile: ModbusProfile, vendor: str) -> ProfileFit | None:
    """Return the fit; None if one of the profile's registers can't be read."""
    counts: dict[str, int] = {}
    access = driver.RegisterAccess(link, unit, profile.line.word_order, frozenset(profile.cycle.functions))
    for use in register_uses(profile):
        register = use.register
        function = driver.READ_HOLDING if register.table == "holding" else driver.READ_INPUT
        try:      # without the retries of a preflight: a scan reads many registers that do not exist
            words = access.once(driver.read(function, register.address, register.count), driver.ANSWER_S).words
            raw = driver.from_words(words, register.type, profile.line.word_order)
        except (CommunicationLost, PreflightRefused):
            return None
        if use.name.startswith("parameters."):
            counts[use.name.partition(".")[2]] = raw
    plate: bool | None = None
    if profile.name_plate is not None:
        table = PreflightTable()
        found = driver.Parameters(counts, driver.settle(profile, counts, {}))
        rated_nm = driver.find_rated_torque(table, profile, found, None)
        if rated_nm is not None or profile.parameter(profile.name_plate.torque).unit != "rated":
            table.checks.clear()
            driver.check_name_plate(table, profile, found, rated_nm or 0.0)
            plate = bool(table.checks) and all(check.outcome.value == "ok" for check in table.checks)
    maker = profile.name.partition("/")[0]
    return ProfileFit(profile.name, plate, bool(vendor) and maker in vendor.lower())


SCAN = "scan"
"""Source of a line setting that the scan tried."""


def scan_lines(
    plan: PeerPlan, connection: Connection, units: tuple[int, ...], say: Callable[[str], None]
) -> tuple[tuple[FoundDrive, ...], list[str]]:
    """Return all units at the first line setting with an answer. Raises CommunicationLost without any answer."""
    garbled = tried = 0
    where = ""
    refused: SettingsRefused | None = None
    for setting in _settings(plan, line_of(connection)):
        clock: Clock = SteppedClock() if plan.stepped else MonotonicClock()
        try:
            with open_line(plan, replace(connection, line=setting), DriveData(), clock) as line:
                where = line.link.description
                if setting.serial is not None and not plan.embedded:
                    say(f"asking {len(units)} units at {setting.baud} baud 8{setting.parity}{setting.stop_bits} …")
                present, spoiled = driver.probe(line.link, units)
                garbled, tried = garbled + spoiled, tried + 1
                if present:
                    transports = line.profile.line.transports
                    found = _identify(line.link, present, setting, transports[0] if plan.embedded else "")
                    return found, [f"{spoiled} replies could not be read"] if spoiled else []
        except SettingsRefused as error:
            refused = error                                # this adapter has no such setting; others may work
    if refused is not None and not tried:
        raise refused
    asked = f"units {', '.join(map(str, units))}" + (f" at {tried} settings of the line" if tried > 1 else "")
    if garbled:
        raise CommunicationLost(
            f"no readable answer ({asked}), but {garbled} garbled replies were received", where=where,
            next_step="Check baud rate and parity at the drive, the polarity of the wires, termination and shielding",
            entry=MessageCode.BAD_REPLY,
        )
    more = "that Modbus TCP is on, and its address"
    if line_of(connection).serial is not None:
        more = "baud rate, the two wires and their polarity"
    step = f"Check the drive's unit number (tdhil scan --units 1-247 scans all), {more}"
    raise CommunicationLost(f"no unit answers ({asked})", where=where, next_step=step, entry=MessageCode.NO_REPLY)


def _identify(link: driver.Link, units: list[int], setting: ModbusLine, embedded: str) -> tuple[FoundDrive, ...]:
    """Identify the units. ``embedded``: the transport of an embedded simulator, '' of a real line."""
    transport = embedded or ("rtu" if setting.serial is not None else "tcp")
    serial = not embedded and setting.serial is not None
    names = ("serial", "baud", "parity", "stop_bits") if serial else ("host", "port")
    known = {} if embedded else setting.settings
    values: dict[str, Any] = {name: known[name].value for name in names if name in known}
    return tuple(identify(link, unit, transport, values) for unit in units)


def _settings(plan: PeerPlan, line: ModbusLine) -> Iterator[ModbusLine]:
    """Yield the given settings first; on a serial line then the usual ones for settings that are not given."""
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
                yield ModbusLine(MappingProxyType(
                    {**line.settings, **{name: Setting(value, SCAN, Origin.SCAN) for name, value in changed.items()}}
                ))


def _said(line: ModbusLine, name: str) -> bool:
    """Return whether the setting is given on the command line or in rig.yaml, not by the profile."""
    return line.origin(name) in (Origin.COMMAND_LINE, Origin.RIG_FILE)


def _add_scan_arguments(scan: argparse._ArgumentGroup) -> None:
    """Add the option for the units."""
    scan.add_argument("--units", metavar="N-M",
                      help="Modbus units to scan, such as 1-10,247 (default 1-5; TCP: and 255)")


def _wanted(connection: Connection, options: RunOptions) -> int | None:
    """Return the unit of --unit. The unit of the profile or rig.yaml is only the first one to try."""
    line = line_of(connection)
    return line.unit if line.origin("unit") is Origin.COMMAND_LINE else None


def _scan(
    plan: PeerPlan, connection: Connection, options: RunOptions, asked: argparse.Namespace
) -> tuple[tuple[FoundDrive, ...], list[str]]:
    """Return all units at the first line setting at which a unit answers."""
    line = line_of(connection)
    own = str(line.unit)
    usual = UNITS_RTU if line.serial is not None and not plan.embedded else UNITS_TCP
    text = asked.units or (own if line.origin("unit") is Origin.COMMAND_LINE else f"{own},{usual}")
    try:
        units = parse_units(text)
    except ValueError as error:
        raise UsageError(f"{error}", where="--units", next_step="Write it like 1-10,247") from None
    return scan_lines(plan, connection, units, say=lambda line: print(line, file=sys.stderr))  # noqa: T201


# ---------------------------------------------------------------------------------------------------------------------
# Doctor: answers, simulator marker, and each register of the profile. It reads only.


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
        """Return the register as in the JSON document."""
        return {
            "name": self.use.name, "address": self.use.register.address, "table": self.use.register.table,
            "meaning": self.use.meaning, "counts": self.counts, "value": self.value, "unit": self.use.unit,
            "error": self.error or None,
        }


def access_of(link: driver.Link, profile: ModbusProfile, unit: int) -> driver.RegisterAccess:
    """Return the drive's registers, for reading."""
    return driver.RegisterAccess(link, unit, profile.line.word_order, frozenset(profile.cycle.functions))


def read_registers(
    access: driver.RegisterAccess, profile: ModbusProfile, given: dict[str, float]
) -> tuple[RegisterSeen, ...]:
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
    values = driver.settle(profile, counts, given)
    return tuple(
        RegisterSeen(use, raw, _value(use, raw, values), errors.get(number, ""))
        for number, (use, raw) in enumerate(zip(uses, found, strict=True))
    )


def drive_findings(
    access: driver.RegisterAccess, profile: ModbusProfile, unit: int, given: dict[str, float],
    rated_torque_nm: float | None, keep: Callable[[tuple[RegisterSeen, ...]], None],
) -> Iterator[DoctorFinding]:
    """Yield findings on the drive. Raises CommunicationLost without an answer. ``keep`` receives the registers."""
    try:
        word = access.read(profile.cycle.status.register_)
        yield ok("drive", f"unit {unit} answers")
        yield _state(profile, word & 0xFFFF)
    except ObjectRefused as error:
        yield bad("drive", f"unit {unit} answers, but {error.where}: {error.what}",
                  error.next_step or "Check with tdhil scan that the profile fits the drive")
    simulated = driver.read_marker(access).simulated
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
    parameters = driver.read_parameters(table, access, profile, given)
    driver.check_required(table, profile, parameters)
    rated_nm = driver.find_rated_torque(table, profile, parameters, rated_torque_nm)
    if rated_nm is not None:
        driver.check_name_plate(table, profile, parameters, rated_nm)
    driver.find_filters(table, profile, parameters)
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
    state = driver.power_state(driver.decode(profile.control, word))
    said = f"{state.value} (status word {word:04X}h)"
    if state in (PowerState.FAULT, PowerState.FAULT_REACTION):
        return bad("state", said, "Remove its cause, then start a run with --reset-fault")
    if state is PowerState.ENABLED:
        return bad("state", f"{said}: another master controls it", "Stop the shaft and disable the drive there first")
    if profile.control.remote is not None and not driver.seen(profile.control.remote, word):
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


def _findings(
    plan: PeerPlan, connection: Connection, options: RunOptions, rig: Rig | None, seen: list[ValueSeen]
) -> Iterator[DoctorFinding]:
    """Yield findings on line, drive, and each register of the profile."""
    clock: Clock = SteppedClock() if plan.stepped else MonotonicClock()
    unit = line_of(connection).unit
    try:
        with open_line(plan, connection, rig.drive_data if rig is not None else DriveData(), clock) as line:
            yield ok("line", f"open: {line.link.description}")
            access = access_of(line.link, line.profile, unit)
            yield from attempted(
                "drive",
                lambda: drive_findings(access, line.profile, unit, dict(line.given), line.rated_torque_nm, seen.extend),
            )
    except TdhilError as error:
        yield of_error("line", error)


# ---------------------------------------------------------------------------------------------------------------------
# rig.yaml for a drive that was found.


def _rig_section(found: FoundDrive, connection: Connection) -> Mapping[str, Any]:
    """Return the line setting at which the drive answered, and its unit."""
    return {**found.line, "unit": found.address}


def _rig_blank(profile: ModbusProfile) -> tuple[str, ...]:
    """Return a blank line with the drive's factory settings."""
    line = profile.line
    ways = {
        "tcp": f"{{host: 192.0.2.10, unit: {line.unit}}}",
        "rtu": f"{{serial: /dev/ttyUSB0, baud: {line.baud}, parity: {line.parity}, unit: {line.unit}}}",
    }
    return (f"#modbus: {'    # or '.join(ways[way] for way in line.transports)}",)


# ---------------------------------------------------------------------------------------------------------------------

MODBUS = Bus(
    name="modbus",
    title="Modbus",
    named_by="--host or --serial, and --unit",
    examples=("--host 192.0.2.10", "--serial /dev/ttyUSB0"),
    nothing_there="no Modbus host and no serial device is named",
    simulated_text="Modbus drive and rig",
    row_name="line",
    address_word="unit",
    address_flag="--unit",
    to_fill_in="modbus",
    flags=FLAGS,
    common_flags=frozenset({"--host", "--serial"}),
    place=("host", "serial"),
    default_profile="generic/modbus",
    add_arguments=_add_arguments,
    line=_line,
    line_type=ModbusLine,
    address=_address,
    section="modbus",
    section_model=ModbusSection,
    place_keys="host or serial",
    rig_section=_rig_section,
    rig_blank=_rig_blank,
    open=_open,
    open_target=_open_target,
    frame_topic="/modbus",
    parse_faults=_parse_faults,
    faults=_faults,
    fault_listing=_fault_listing,
    scan=_scan,
    add_scan_arguments=_add_scan_arguments,
    wanted=_wanted,
    findings=_findings,
    libraries=MappingProxyType({"pymodbus": (3, 16)}),
    profile_facts=_profile_facts,
    profile_tables=_profile_tables,
    profile_sections=("line", "control", "modes", "quick_stop", "watchdog", "name_plate"),
)
