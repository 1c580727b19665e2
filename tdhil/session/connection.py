"""How the drive is spoken to: which bus, which profile, and where on that bus; each with who had the say.

Nothing here, nor above, names a bus: `BusKind` is what a run asks of one, and `tdhil.config.registry.BUSES` lists them.
"""

from __future__ import annotations

import argparse
import socket
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar

from drivers import DataFileError, Problem
from profiles import Profile, load_profile
from tdhil.config import BUSES, DEFAULT_BUS, Origin, RunOptions, Setting, load
from tdhil.errors import UsageError

if TYPE_CHECKING:
    from drivers import Clock, Drive, FrameTap, Target
    from sim_bus import KnownFault
    from tdhil.config import DriveData, Rig


@dataclass(frozen=True)
class LineConfig(ABC):
    """Where a drive is: every value with the place that it came from. What is there to ask for is its bus's own."""

    nothing_there: ClassVar[str]       # why the embedded simulator runs although nobody asked for it
    simulated_text: ClassVar[str]      # what that is then, in words
    row_name: ClassVar[str] = "bus"    # what stands before each row

    settings: Mapping[str, Setting] = field(default_factory=lambda: MappingProxyType({}))

    @property
    @abstractmethod
    def configured(self) -> bool:
        """Has anybody said where the drive is? If not, the embedded simulator is meant."""

    def value(self, name: str, default: Any = None) -> Any:
        """What an option is; ``default`` where nobody said it."""
        return self.settings[name].value if name in self.settings else default

    def source(self, name: str) -> str:
        """Where an option's value came from, in words; '' where nobody said it."""
        return self.settings[name].source if name in self.settings else ""

    def origin(self, name: str) -> Origin | None:
        """Who said it, None where nobody did."""
        return self.settings[name].origin if name in self.settings else None

    def rows(self) -> Iterator[tuple[str, str, str]]:
        """(option, value, source) to print."""
        for name, setting in self.settings.items():
            yield name, str(setting.value), setting.source


class BusKind(ABC):
    """What a run asks of a bus: its options, where they put the drive, and how that is opened.

    An object of it stands where `tdhil.config.registry.BUSES` says. Its module is imported for every ``--help``: what
    loads a library of the bus is imported where it is used.
    """

    name: ClassVar[str]                # as in BUSES, --drive, and `bus:` of a profile
    title: ClassVar[str]               # as people write it
    named_by: ClassVar[str]            # the options that name a drive on it, in words
    section: ClassVar[str] = ""        # its section in rig.yaml; '' where it has none …
    place_keys: ClassVar[str] = ""     # … and which keys of that say where a drive is
    flags: ClassVar[Mapping[str, str]] = MappingProxyType({})
    """Options of the command line that no other bus has: name in the namespace → flag."""
    default_profile: ClassVar[str]     # worn and spoken where nobody names another
    steps_over_a_wire: ClassVar[bool] = False     # can a simulator in another process be stepped over it?

    @property
    def frame_channel(self) -> int:
        """The log's channel for its raw frames (`tdhil.recording.CHANNELS`)."""
        from tdhil.recording import CAN

        return CAN

    @abstractmethod
    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Its options, in a group of their own."""

    @abstractmethod
    def line(self, cli: Mapping[str, Any], rig: Rig | None, profile: Profile) -> LineConfig:
        """Where the drive is, by all who have a say. Raises UsageError and DataFileError for what can't be used."""

    @property
    @abstractmethod
    def nowhere(self) -> LineConfig:
        """The same where nobody was asked: an embedded simulator is meant."""

    @abstractmethod
    def open(self, plan: PeerPlan, options: RunOptions, connection: Connection, data: DriveData, clock: Clock,
             tap: FrameTap, trace: Path | None) -> AbstractContextManager[Drive]:
        """The drive, or the embedded simulator's; closed afterwards, with all that was opened for it."""

    @abstractmethod
    def open_target(self, options: RunOptions, connection: Connection, clock: Clock) -> AbstractContextManager[Target]:
        """What ``tdhil stop`` needs of the drive, and no more; closed afterwards."""

    def address(self, options: RunOptions, connection: Connection) -> str | None:
        """The drive's place as one text, the same for every program that means this drive: what `hold` locks.

        None where other processes can't reach it. Unless a bus knows better, all that was said of the place.
        """
        return " ".join((self.name, *(f"{name} {value}" for name, value, _ in connection.line.rows())))

    @abstractmethod
    def parse_faults(self, texts: Sequence[str]) -> tuple[Any, ...]:
        """Faults of the embedded simulator, from what ``--fault`` says. Raises UsageError."""

    @abstractmethod
    def faults(self) -> tuple[KnownFault, ...]:
        """What ``--fault`` knows of the embedded simulator."""

    @abstractmethod
    def fault_listing(self) -> str:
        """What ``--fault list`` shows of it."""

    def asked_for(self, cli: Mapping[str, Any]) -> str | None:
        """The flag on the command line that only this bus has; None if there is none."""
        return next((flag for name, flag in self.flags.items() if cli.get(name) is not None), None)

    def placed_in(self, rig: Rig) -> bool:
        """Does rig.yaml say where a drive on this bus is?"""
        return False


def bus_kind(name: str) -> BusKind:
    """The bus of that name. KeyError where there is none."""
    found: BusKind = load(BUSES, name)
    return found


def bus_kinds() -> tuple[BusKind, ...]:
    """All of them, in their order."""
    return tuple(bus_kind(name) for name in BUSES)


@dataclass(frozen=True)
class Connection:
    """Which bus, what is known of the drive on it, and where that is."""

    kind: BusKind
    profile: Profile
    line: LineConfig

    @property
    def drive(self) -> str:
        """The bus's name, as --drive has it."""
        return self.kind.name

    @property
    def configured(self) -> bool:
        """Has anybody said where the drive is? If not, the embedded simulator is meant."""
        return self.line.configured

    @property
    def nothing_there(self) -> str:
        """Why the embedded simulator runs although nobody asked for it."""
        return self.line.nothing_there

    def rows(self) -> Iterator[tuple[str, str, str]]:
        """(option, value, source) to print and to log."""
        return self.line.rows()


def connection_of(cli: Mapping[str, Any], rig: Rig | None, options: RunOptions) -> tuple[RunOptions, Connection]:
    """The options with drive and profile decided, and the way to the drive.

    UsageError for options of another bus, DataFileError for a profile that can't be used.
    """
    options = choose_drive(cli, rig, options)
    kind = bus_kind(options.drive)
    for other in bus_kinds():
        flag = None if other.name == kind.name else other.asked_for(cli)
        if flag is not None:
            raise UsageError(
                f"belongs to {other.title}", where=flag,
                next_step=f"A {kind.title} drive is named by {kind.named_by}; for {other.title} say "
                f"--drive {other.name}",
            )
    profile = load_profile(options.profile, kind.name)
    found = Connection(kind, profile, kind.line(cli, rig, profile))
    _refuse_another_bus(found, rig, options)
    return options, found


def _refuse_another_bus(found: Connection, rig: Rig | None, options: RunOptions) -> None:
    """A rig.yaml that says where a drive is, but on another bus: nobody meant the simulator. Raises DataFileError."""
    if rig is None or found.configured or options.simulate:
        return
    kind = found.kind
    other = next((one for one in bus_kinds() if one.name != kind.name and one.placed_in(rig)), None)
    if other is None:
        return
    missing = f"{kind.section}: ({kind.place_keys})" if kind.section else kind.named_by
    raise DataFileError((Problem(
        rig.file or "rig.yaml", rig.line(other.section),
        f"{other.section}: says where a drive is, but the drive is on {kind.name} ({options.source('drive')}), and"
        f" nothing says where; give {missing}, name the other drive, or take the simulated one with --simulate",
    ),))


def choose_drive(cli: Mapping[str, Any], rig: Rig | None, options: RunOptions) -> RunOptions:
    """Who doesn't name the bus has named it by the profile, or by saying where the drive is."""
    if not options.given("drive"):
        if options.given("profile"):
            profile = load_profile(options.profile)
            options = options.replaced(drive=Setting(profile.bus, f"profile {profile.name}", Origin.PROFILE))
        elif (setting := _bus_by_place(cli, rig)) is not None:
            options = options.replaced(drive=setting)
    if not options.given("profile") and (named := bus_kind(options.drive).default_profile) != options.profile:
        options = options.replaced(profile=Setting(named, "default", Origin.BUILT_IN))
    return options


def _bus_by_place(cli: Mapping[str, Any], rig: Rig | None) -> Setting | None:
    """The bus on which the command line, or else rig.yaml, has the drive; None for the usual one."""
    others = [kind for kind in bus_kinds() if kind.name != DEFAULT_BUS]
    for kind in others:
        if (flag := kind.asked_for(cli)) is not None:
            return Setting.by_flag(kind.name, flag)
    if rig is None or bus_kind(DEFAULT_BUS).placed_in(rig):
        return None
    return next((Setting.by_rig(kind.name, rig, kind.section) for kind in others if kind.placed_in(rig)), None)


def simulated_connection(options: RunOptions) -> Connection:
    """The way to an embedded drive on the bus of the options."""
    kind = bus_kind(options.drive)
    return Connection(kind, load_profile(options.profile, kind.name), kind.nowhere)


@dataclass(frozen=True)
class PeerPlan:
    """What will be opened. ``seed`` and ``plant`` are the embedded simulator's, None without it."""

    embedded: bool
    stepped: bool
    seed: int | None
    plant: Any
    faults: tuple[Any, ...] = ()       # scripted faults of the embedded simulator (`sim_bus.fault_script`)
    never_came: list[str] = field(default_factory=list)    # those of them whose moment the run did not reach
    left_in: Path | None = None        # where it is written down what a run changes in a drive; None: beside the log

    @property
    def epoch_ns(self) -> int:
        """Wall clock at control time zero, for the log's time stamps; in stepped time the clock runs ahead of it."""
        return time.time_ns()


def one_host(name: str) -> str:
    """The host's first address, so that its name and its number are one; the name where nobody knows it."""
    try:
        found = sorted({str(one[4][0]) for one in socket.getaddrinfo(name, None, type=socket.SOCK_STREAM)})
    except (OSError, UnicodeError):
        return name.lower()
    return "127.0.0.1" if "127.0.0.1" in found else found[0]
