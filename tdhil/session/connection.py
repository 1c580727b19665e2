"""The connection to the drive: bus, profile, address on the bus, and the source of each value.

No code here or above names a bus. `BusKind` is the interface of a bus, and `tdhil.config.registry.BUSES` lists them.
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
from tdhil.errors import MessageCode, UsageError

if TYPE_CHECKING:
    from drivers import Clock, Drive, FrameTap, Target
    from sim_bus import KnownFault
    from tdhil.config import DriveData, Rig


@dataclass(frozen=True)
class LineConfig(ABC):
    """The address of a drive: every value with its source. The options are those of its bus."""

    nothing_there: ClassVar[str]       # why the embedded simulator runs although it was not requested
    simulated_text: ClassVar[str]      # the simulated equipment, in words
    row_name: ClassVar[str] = "bus"    # label in front of each row

    settings: Mapping[str, Setting] = field(default_factory=lambda: MappingProxyType({}))

    @property
    @abstractmethod
    def configured(self) -> bool:
        """Return whether an address of the drive is given. If not, the embedded simulator is meant."""

    def value(self, name: str, default: Any = None) -> Any:
        """Return the value of an option; ``default`` if it is not given."""
        return self.settings[name].value if name in self.settings else default

    def source(self, name: str) -> str:
        """Return the source of an option's value, in words; '' if it is not given."""
        return self.settings[name].source if name in self.settings else ""

    def origin(self, name: str) -> Origin | None:
        """Return the kind of source; None if the option is not given."""
        return self.settings[name].origin if name in self.settings else None

    def rows(self) -> Iterator[tuple[str, str, str]]:
        """Yield (option, value, source) to print."""
        for name, setting in self.settings.items():
            yield name, str(setting.value), setting.source


class BusKind(ABC):
    """A bus as a run uses it: its options, the address that they give, and how to open it.

    `tdhil.config.registry.BUSES` names one object for each bus. Every ``--help`` imports its module, so a library of
    the bus is imported only where it is used.
    """

    name: ClassVar[str]                # as in BUSES, --drive, and `bus:` of a profile
    title: ClassVar[str]               # as it is written in texts
    named_by: ClassVar[str]            # options that name a drive on it, in words
    section: ClassVar[str] = ""        # its section in rig.yaml; '' if it has none
    place_keys: ClassVar[str] = ""     # keys of that section that give a drive's address
    flags: ClassVar[Mapping[str, str]] = MappingProxyType({})
    """Options of the command line that no other bus has: name in the namespace → flag."""
    default_profile: ClassVar[str]     # profile if none is named
    steps_over_a_wire: ClassVar[bool] = False     # True if it can step a simulator in another process

    @property
    def frame_channel(self) -> int:
        """Return the log's channel for its raw frames (`tdhil.recording.CHANNELS`)."""
        from tdhil.recording import CAN

        return CAN

    @abstractmethod
    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Add its options in their own group."""

    @abstractmethod
    def line(self, cli: Mapping[str, Any], rig: Rig | None, profile: Profile) -> LineConfig:
        """Return the drive's address from all sources. Raises UsageError and DataFileError for unusable values."""

    @property
    @abstractmethod
    def nowhere(self) -> LineConfig:
        """Return an empty address: an embedded simulator is meant."""

    @abstractmethod
    def open(self, plan: PeerPlan, options: RunOptions, connection: Connection, data: DriveData, clock: Clock,
             tap: FrameTap, trace: Path | None) -> AbstractContextManager[Drive]:
        """Open the drive, real or simulated. It is closed afterwards, with all that was opened for it."""

    @abstractmethod
    def open_target(self, options: RunOptions, connection: Connection, clock: Clock) -> AbstractContextManager[Target]:
        """Open only what ``tdhil stop`` needs of the drive. It is closed afterwards."""

    def address(self, options: RunOptions, connection: Connection) -> str | None:
        """Return the drive's address as one text, the same for every program that means this drive. `hold` locks it.

        None if other processes can't reach the drive. By default the text contains all given values of the address.
        """
        return " ".join((self.name, *(f"{name} {value}" for name, value, _ in connection.line.rows())))

    @abstractmethod
    def parse_faults(self, texts: Sequence[str]) -> tuple[Any, ...]:
        """Return the faults of the embedded simulator that ``--fault`` requests. Raises UsageError."""

    @abstractmethod
    def faults(self) -> tuple[KnownFault, ...]:
        """Return the faults that ``--fault`` accepts for the embedded simulator."""

    @abstractmethod
    def fault_listing(self) -> str:
        """Return the text that ``--fault list`` prints."""

    def asked_for(self, cli: Mapping[str, Any]) -> str | None:
        """Return the given flag that belongs only to this bus; None if there is none."""
        return next((flag for name, flag in self.flags.items() if cli.get(name) is not None), None)

    def placed_in(self, rig: Rig) -> bool:
        """Return whether rig.yaml gives the address of a drive on this bus."""
        return False


def bus_kind(name: str) -> BusKind:
    """Return the bus of that name. Raises KeyError if there is none."""
    found: BusKind = load(BUSES, name)
    return found


def bus_kinds() -> tuple[BusKind, ...]:
    """Return all buses in their order."""
    return tuple(bus_kind(name) for name in BUSES)


@dataclass(frozen=True)
class Connection:
    """The bus, the drive's profile, and the drive's address on the bus."""

    kind: BusKind
    profile: Profile
    line: LineConfig

    @property
    def drive(self) -> str:
        """Return the bus's name, as in --drive."""
        return self.kind.name

    @property
    def configured(self) -> bool:
        """Return whether an address of the drive is given. If not, the embedded simulator is meant."""
        return self.line.configured

    @property
    def nothing_there(self) -> str:
        """Return why the embedded simulator runs although it was not requested."""
        return self.line.nothing_there

    def rows(self) -> Iterator[tuple[str, str, str]]:
        """Yield (option, value, source) to print and to log."""
        return self.line.rows()


def connection_of(cli: Mapping[str, Any], rig: Rig | None, options: RunOptions) -> tuple[RunOptions, Connection]:
    """Return the options with drive and profile decided, and the connection to the drive.

    Raises UsageError for options of another bus, DataFileError for an unusable profile.
    """
    options = choose_drive(cli, rig, options)
    kind = bus_kind(options.drive)
    for other in bus_kinds():
        flag = None if other.name == kind.name else other.asked_for(cli)
        if flag is not None:
            raise UsageError(
                f"belongs to {other.title}, but the drive is on {kind.title}", where=flag,
                next_step=f"Name a {kind.title} drive with {kind.named_by}. For {other.title} add "
                f"--drive {other.name}",
                entry=MessageCode.OPTION_OF_ANOTHER_BUS,
            )
    profile = load_profile(options.profile, kind.name)
    found = Connection(kind, profile, kind.line(cli, rig, profile))
    _refuse_another_bus(found, rig, options)
    return options, found


def _refuse_another_bus(found: Connection, rig: Rig | None, options: RunOptions) -> None:
    """Raise DataFileError if rig.yaml gives a drive's address on another bus: the simulator was not meant."""
    if rig is None or found.configured or options.simulate:
        return
    kind = found.kind
    other = next((one for one in bus_kinds() if one.name != kind.name and one.placed_in(rig)), None)
    if other is None:
        return
    missing = f"{kind.section}: ({kind.place_keys})" if kind.section else kind.named_by
    raise DataFileError((Problem(
        rig.file or "rig.yaml", rig.line(other.section),
        f"{other.section}: gives a drive's address, but the drive is on {kind.name} ({options.source('drive')}), and"
        f" its address is missing; give {missing}, name the other drive, or use the simulated one with --simulate",
    ),), entry=MessageCode.OPTION_OF_ANOTHER_BUS)


def choose_drive(cli: Mapping[str, Any], rig: Rig | None, options: RunOptions) -> RunOptions:
    """Return the options with the bus. If it is not named, it follows from the profile or the given address."""
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
    """Return the bus of the address on the command line, or else in rig.yaml; None for the default bus."""
    others = [kind for kind in bus_kinds() if kind.name != DEFAULT_BUS]
    for kind in others:
        if (flag := kind.asked_for(cli)) is not None:
            return Setting.by_flag(kind.name, flag)
    if rig is None or bus_kind(DEFAULT_BUS).placed_in(rig):
        return None
    return next((Setting.by_rig(kind.name, rig, kind.section) for kind in others if kind.placed_in(rig)), None)


def simulated_connection(options: RunOptions) -> Connection:
    """Return the connection to an embedded drive on the bus of the options."""
    kind = bus_kind(options.drive)
    return Connection(kind, load_profile(options.profile, kind.name), kind.nowhere)


@dataclass(frozen=True)
class PeerPlan:
    """The peer to open. ``seed`` and ``plant`` belong to the embedded simulator, None without it."""

    embedded: bool
    stepped: bool
    seed: int | None
    plant: Any
    faults: tuple[Any, ...] = ()       # scripted faults of the embedded simulator (`sim_bus.fault_script`)
    never_came: list[str] = field(default_factory=list)    # those that the run ended too early to trigger
    left_in: Path | None = None        # folder of the undo journal of the drive's settings; None: beside the log

    @property
    def epoch_ns(self) -> int:
        """Return the wall clock at control time zero, for the log. In stepped time the control time runs ahead."""
        return time.time_ns()


def one_host(name: str) -> str:
    """Return the host's first address, so that name and number give the same text; the name if it is unknown."""
    try:
        found = sorted({str(one[4][0]) for one in socket.getaddrinfo(name, None, type=socket.SOCK_STREAM)})
    except (OSError, UnicodeError):
        return name.lower()
    return "127.0.0.1" if "127.0.0.1" in found else found[0]
