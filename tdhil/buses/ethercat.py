"""EtherCAT, above its driver: options, rig.yaml, the simulated drive, scan, doctor, profile page.

One master owns a segment. So tdhil locks the interface and not the drive, and refuses a segment that another master
drives before it changes an AL state.
"""

from __future__ import annotations

import argparse
import itertools
import shutil
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from pydantic import Field

from drivers import TdhilError
from drivers import ethercat as driver
from profiles import DataModel, Profile, load_profile, profile_names
from profiles.ethercat import EthercatProfile
from tdhil.buses.bus import Bus, Connection, FoundDrive, Line, Opening, PeerPlan, ProfileTable, ValueSeen
from tdhil.buses.cia402_findings import (
    drive_type,
    identity_findings,
    identity_text,
    match,
    settings_findings,
    watchdog_object,
)
from tdhil.buses.doctor_finding import DoctorFinding, attempted, bad, of_error, ok
from tdhil.buses.profile_text import object_table
from tdhil.config import OPTION, DriveData, Rig, RunOptions, Setting
from tdhil.errors import MessageCode, UsageError

if TYPE_CHECKING:
    from drivers import Clock, Drive, Target
    from sim_bus import KnownFault

PLAIN = "generic/cia402-ethercat"
"""Profile of the simulator if none is named."""
MOST_POSITION = 199
"""Highest position that pysoem supports."""


class EthercatSection(DataModel):
    """The section ethercat: of rig.yaml."""

    interface: str | None = Field(default=None, min_length=1, description="network interface, such as eth1")
    position: int | None = Field(default=None, ge=0, le=MOST_POSITION, description="position of the drive; 0 is first")
    alias: int | None = Field(default=None, ge=1, le=0xFFFF, description="its configured station alias instead")

    @classmethod
    def contradictions(cls, values: Mapping[str, Any]) -> list[tuple[str, str]]:
        """Return two addresses of one drive."""
        both = values.get("position") is not None and values.get("alias") is not None
        return [("alias", "position and alias name one drive twice; give one of them")] if both else []


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the drive's place on the segment. -i is an option of python-can, and names the network interface here."""
    group = parser.add_argument_group("EtherCAT (with -i: the network interface, such as eth1)")
    group.add_argument("--position", type=_number(0, MOST_POSITION), metavar="N",
                       help="position of the drive on the segment (0: the first slave)")
    group.add_argument("--alias", type=_number(1, 0xFFFF), metavar="N",
                       help="configured station alias of the drive, instead of --position")


def _number(least: int, most: int) -> Any:
    def number(text: str) -> int:
        try:
            value = int(text, 0)
        except ValueError:
            value = least - 1
        if not least <= value <= most:
            raise argparse.ArgumentTypeError(f"{text[:60]!r} is not a number from {least} to {most}")
        return value

    return number


_KEYS = ("interface", "position", "alias")


def _line(cli: Mapping[str, Any], rig: Rig | None, profile: Profile) -> Line:
    """Return the address from command line and rig.yaml; a given position replaces the alias of the rig."""
    found = {name: Setting.by_flag(cli[name], f"--{name}") for name in _KEYS if cli.get(name) is not None}
    if "position" in found and "alias" in found:
        raise UsageError("--position and --alias name one drive twice", next_step="Give one of them",
                         entry=MessageCode.BUS_OPTIONS_WRONG)
    if rig is not None:
        section, placed = ETHERCAT.section_of(rig), {"position", "alias"} & set(found)
        for name in _KEYS:
            value = getattr(section, name)
            if value is not None and not (placed and name in ("position", "alias")):
                found.setdefault(name, Setting.by_rig(value, rig, f"ethercat.{name}"))
    return Line(MappingProxyType({name: found[name] for name in _KEYS if name in found}))


def _address(options: RunOptions, connection: Connection) -> str | None:
    """Return the interface: one master owns all drives of a segment."""
    return f"ethercat {connection.line.value('interface')}"


def profile_of(connection: Connection) -> EthercatProfile:
    """Return the drive's profile."""
    assert isinstance(connection.profile, EthercatProfile)
    return connection.profile


def _place(connection: Connection) -> tuple[int, int | None]:
    """Return position and alias of the drive."""
    return connection.line.value("position", 0), connection.line.value("alias")


def _rated_torque_nm(plan: PeerPlan, profile: EthercatProfile, data: DriveData) -> float | None:
    """Return rig.yaml's rated torque; for a simulated motor without one, the plant's."""
    if data.rated_torque_nm is None and plan.embedded and profile.rated_torque_by_hand:
        return float(plan.plant.drive.rated_torque_nm)
    return data.rated_torque_nm


# ---------------------------------------------------------------------------------------------------------------------
# Open the drive, real or simulated.


@contextmanager
def _interface(plan: PeerPlan, connection: Connection, trace: Path | None = None) -> Iterator[str]:
    """Yield the network interface, with the simulated drive behind it if requested."""
    if plan.embedded:
        worn = None if connection.profile.name == PLAIN else profile_of(connection)
        with _simulated(plan, worn, trace) as interface:
            yield interface
        return
    interface = connection.line.value("interface")
    if interface is None:
        raise UsageError("no network interface", next_step="Name one, such as -i eth1, or use --simulate",
                         entry=MessageCode.BUS_NOT_CONFIGURED)
    yield str(interface)


# The simulated drive is a process of its own, at the other end of a pair of virtual Ethernet interfaces (veth). pysoem
# keeps the lock of the interpreter while it waits for a frame, so a thread could not answer. The process removes the
# pair at its end, also if this program dies.


_PAIRS = itertools.count()
SIMULATOR_STARTS_S = 30.0
"""Longest time for the start of the simulator's process, s."""


@contextmanager
def _simulated(plan: PeerPlan, worn: EthercatProfile | None, trace: Path | None) -> Iterator[str]:
    """Yield the host's end of the pair. ``worn``: the drive's profile, unless it is the plain one.

    Raises SimulatorUnusable if the system does not permit it.
    """
    import multiprocessing
    import os

    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    number = next(_PAIRS)
    ends = (f"ec{os.getpid()}h{number}", f"ec{os.getpid()}d{number}")
    faults = [fault.text for fault in plan.faults]
    asked = (plan.plant, plan.seed or 0, trace, plan.stepped, worn, faults, ends, theirs)
    process = context.Process(target=_serve, args=asked, daemon=True)
    _ip("link", "add", ends[0], "type", "veth", "peer", "name", ends[1])
    try:
        for end in ends:
            _ip("link", "set", end, "up")
        process.start()
        theirs.close()
        wrong = ours.recv() if ours.poll(SIMULATOR_STARTS_S) else "it does not start"
        if wrong:
            raise SimulatorUnusable(f"the simulated drive can't be started: {wrong}", where=ends[1])
        yield ends[0]
    finally:
        with suppress(OSError, EOFError):
            ours.send("end")
            if process.pid is not None and ours.poll(SIMULATOR_STARTS_S) and isinstance(left := ours.recv(), list):
                plan.never_came.extend(left)
        if process.pid is not None:
            process.join(SIMULATOR_STARTS_S)
        with suppress(TdhilError):                     # the process has removed it, if it was started
            _ip("link", "del", ends[0])


def _ip(*words: str) -> None:
    """Run ``ip``. Raises SimulatorUnusable with its reason."""
    command = shutil.which("ip", path="/usr/sbin:/sbin:/usr/bin:/bin")
    why = "the program ip is missing"
    if command is not None:
        done = subprocess.run([command, *words], capture_output=True, text=True, timeout=30, check=False)
        if done.returncode == 0:
            return
        why = done.stderr.strip() or f"ip ends with {done.returncode}"
    raise SimulatorUnusable(
        f"the simulated EtherCAT drive needs a pair of virtual Ethernet interfaces (veth): {why}",
        where=OPTION["simulate"].flag,
        next_step="Start as root on Linux with veth, or simulate the drive on another bus: --drive canopen",
    )


def _serve(
    plant: Any, seed: int, trace: Path | None, stepped: bool, worn: EthercatProfile | None, faults: Sequence[str],
    ends: tuple[str, str], host: Any,
) -> None:
    """Simulate the drive in this process until the host has ended."""
    import signal
    import threading

    from sim_bus.ethercat import Simulator, parse_all, raw_socket

    signal.signal(signal.SIGINT, signal.SIG_IGN)       # Ctrl-C is for the host, which needs the drive for its stop
    stop = threading.Event()

    def wait() -> None:
        with suppress(OSError, EOFError):
            host.recv()
        stop.set()

    try:
        simulator = Simulator(plant, seed=seed, trace=trace, stepped=stepped, profile=worn, faults=parse_all(faults))
        with raw_socket(ends[1]) as line:
            host.send("")
            threading.Thread(target=wait, daemon=True).start()
            simulator.run(line, stop)
        with suppress(OSError):
            host.send(list(simulator.faults_waiting))
    except Exception as error:
        with suppress(OSError):
            host.send(str(error))
    finally:
        with suppress(TdhilError):
            _ip("link", "del", ends[0])


class SimulatorUnusable(TdhilError):
    """The system does not permit the simulated drive."""

    entry = MessageCode.SIMULATOR_UNUSABLE


@contextmanager
def _open(asked: Opening) -> Iterator[Drive]:
    """Open the segment and the drive on it. `EthercatDrive.close` closes it, or the end of this context."""
    from drivers.undo_journal import UndoJournal

    plan, options, connection = asked.plan, asked.options, asked.connection
    profile, (position, alias) = profile_of(connection), _place(connection)
    with _interface(plan, connection, asked.trace) as interface:
        segment = driver.open_segment(interface, position, alias)
        try:
            yield driver.EthercatDrive(
                segment,
                profile,
                asked.clock,
                rate_hz=options.rate_hz,
                rated_torque_nm=_rated_torque_nm(plan, profile, asked.data),
                tap=asked.tap,
                journal=None if plan.embedded else UndoJournal(
                    plan.left_in or Path(options.log).parent, f"{interface}-{segment.position}"),
            )
        finally:
            segment.close()


@contextmanager
def _open_target(options: RunOptions, connection: Connection, clock: Clock) -> Iterator[Target]:
    """Open the drive alone, without a change of its AL state if possible."""
    position, alias = _place(connection)
    with _interface(_REAL, connection) as interface:
        target = driver.open_target(interface, position, alias, profile_of(connection), clock)
        try:
            yield target
        finally:
            target.close()


_REAL = PeerPlan(embedded=False, stepped=False, seed=None, plant=None)


def _parse_faults(texts: Sequence[str]) -> tuple[Any, ...]:
    from sim_bus.ethercat import parse_all

    return parse_all(texts)


def _faults() -> tuple[KnownFault, ...]:
    from sim_bus.ethercat import listed

    return listed()


def _fault_listing(width: int) -> str:
    from sim_bus.ethercat import listing

    return listing(width)


# ---------------------------------------------------------------------------------------------------------------------
# Scan and doctor. They write no object. If no master drives the segment, its slaves are set to PRE-OP. If one does,
# only AL states are read: an answer in a mailbox could be the other master's.


def _found(slave: driver.FoundSlave, profiles: Sequence[EthercatProfile]) -> FoundDrive:
    identity = slave.identity
    profile, why = None, "it has no objects in this state, or none at all (no mailbox)"
    if slave.device_type is not None:
        profile, why = match(slave.device_type, identity[:3], profiles, PLAIN)
    seen = slave.state + (f", alias {slave.alias}" if slave.alias else "")
    return FoundDrive("ethercat", slave.position, slave.title, identity_text(identity) or "not reported (1018h)",
                      slave.simulated, profile, why, seen)


def _scan(
    plan: PeerPlan, connection: Connection, options: RunOptions, asked: argparse.Namespace
) -> tuple[tuple[FoundDrive, ...], list[str]]:
    """Return the slaves of the segment, and remarks."""
    profiles = [profile for name in profile_names() if isinstance(profile := load_profile(name), EthercatProfile)]
    with _interface(plan, connection) as interface, driver.stations_at(interface) as (stations, driven):
        slaves = [driver.found_slave(number, one, bool(driven)) for number, one in enumerate(stations)]
    return tuple(_found(slave, profiles) for slave in slaves), [driven] if driven else []


def _wanted(connection: Connection, options: RunOptions) -> int | None:
    """Return the position of --position or rig.yaml."""
    position: int | None = connection.line.value("position")
    return position


def _drive_findings(
    station: driver.Station, profile: EthercatProfile, rated_torque_nm: float | None
) -> Iterator[DoctorFinding]:
    """Yield findings on the drive. Raises CommunicationLost if it does not answer."""
    objects = driver.objects_of(station)
    yield ok("AL state", station.al_status().text)
    yield drive_type(station.place, objects.read(0x1000))
    yield from identity_findings(objects, profile)
    time_s, divider = driver.watchdog_s(station)
    yield ok("watchdog", f"{time_s * 1e3:g} ms are set (registers 0400h = {divider}, 0420h); a run sets its own")
    dog = profile.watchdog
    if dog.reaction_index is not None:
        yield watchdog_object(objects, dog.reaction_index, dog.reaction_sub)
    clocks = driver.has_clocks(station)
    yield ok("distributed clocks", "the slave controller has them" if clocks else "none; the drive follows the frames")
    yield from settings_findings(objects, profile, rated_torque_nm)


def _findings(
    plan: PeerPlan, connection: Connection, options: RunOptions, rig: Rig | None, seen: list[ValueSeen]
) -> Iterator[DoctorFinding]:
    """Yield findings on interface, segment and drive."""
    profile, (position, alias) = profile_of(connection), _place(connection)
    try:
        with _interface(plan, connection) as interface, driver.stations_at(interface) as (stations, driven):
            yield ok("segment", f"{interface}: {len(stations)} slaves answer")
            if driven:
                yield bad("segment", driven, "Stop that master before a run. Its drives are not asked further")
                return
            station = driver.station_of(stations, interface, position, alias)
            data = rig.drive_data if rig is not None else DriveData()
            rated_nm = _rated_torque_nm(plan, profile, data)
            yield from attempted("drive", lambda: _drive_findings(station, profile, rated_nm))
    except TdhilError as error:
        yield of_error("segment", error)


# ---------------------------------------------------------------------------------------------------------------------


def _rig_section(found: FoundDrive, connection: Connection) -> Mapping[str, Any]:
    """Return interface and position."""
    interface = connection.line.value("interface")
    return {**({} if interface is None else {"interface": interface}), "position": found.address}


def _rig_blank(profile: Profile) -> tuple[str, ...]:
    """Return a blank line for the address."""
    return ("#ethercat: {interface: eth1, position: 0}    # or alias, in place of position",)


def _profile_tables(profile: EthercatProfile) -> Iterator[ProfileTable]:
    """Yield the objects beyond those of CiA 402."""
    if profile.parameters:
        yield object_table(profile.parameters)


def _profile_facts(profile: EthercatProfile) -> Sequence[tuple[str, str]]:
    """Return the PDOs."""
    cyclic = profile.cyclic
    pdos = ", ".join(f"{pdo:04X}h" for pdo in (*cyclic.rx_pdos, *cyclic.tx_pdos))
    return (("PDOs", pdos + (", with their own content" if cyclic.fixed else ", mapped by tdhil")),)


ETHERCAT = Bus(
    name="ethercat",
    title="EtherCAT",
    named_by="--interface and --position (or --alias)",
    examples=("-i eth1 --position 0",),
    nothing_there="no network interface is named",
    simulated_text="drive and rig on a virtual EtherCAT segment",
    row_name="segment",
    address_word="position",
    address_flag="--position",
    to_fill_in="ethercat: (interface, and position or alias)",
    flags=MappingProxyType({"position": "--position", "alias": "--alias"}),
    also=frozenset({"interface"}),
    place=("interface",),
    default_profile=PLAIN,
    add_arguments=_add_arguments,
    line=_line,
    address=_address,
    section="ethercat",
    section_model=EthercatSection,
    place_keys="interface, position",
    rig_section=_rig_section,
    rig_blank=_rig_blank,
    open=_open,
    open_target=_open_target,
    steps_over_a_wire=True,
    parse_faults=_parse_faults,
    faults=_faults,
    fault_listing=_fault_listing,
    scan=_scan,
    wanted=_wanted,
    findings=_findings,
    profile_facts=_profile_facts,
    profile_tables=_profile_tables,
)
