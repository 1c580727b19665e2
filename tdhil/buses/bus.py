"""The interface of a bus: everything that tdhil needs of a bus, above its driver.

A bus is one object of `Bus`, in a module of its own. `tdhil.config.registry.BUSES` names the objects, and no other code
names a bus. Every ``--help`` of a command that talks to a drive imports these modules. So a module of a bus imports the
libraries of the bus inside its functions.
"""

from __future__ import annotations

import argparse
import socket
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Protocol

from profiles import DataModel, Profile
from tdhil.buses.doctor_finding import DoctorFinding
from tdhil.config import BUSES, Origin, RunOptions, Setting, load

if TYPE_CHECKING:
    from drivers import Clock, Drive, FrameTap, Target
    from sim_bus import KnownFault
    from tdhil.config import DriveData, Rig


# ---------------------------------------------------------------------------------------------------------------------
# Address of a drive, and the objects that are opened there.


@dataclass(frozen=True)
class Line:
    """The address of a drive: every value with its source. The options are those of its bus."""

    settings: Mapping[str, Setting] = field(default_factory=lambda: MappingProxyType({}))

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
        """Yield (option, value, source) to print and to log."""
        for name, setting in self.settings.items():
            yield name, str(setting.value), setting.source


@dataclass(frozen=True)
class Connection:
    """The bus, the drive's profile, and the drive's address on the bus."""

    bus: Bus
    profile: Profile
    line: Line

    @property
    def drive(self) -> str:
        """Return the bus's name, as in --drive."""
        return self.bus.name

    @property
    def configured(self) -> bool:
        """Return whether an address of the drive is given. Without one the embedded simulator runs."""
        return any(name in self.line.settings for name in self.bus.place)


@dataclass(frozen=True)
class PeerPlan:
    """The peer to open. ``seed`` and ``plant`` belong to the embedded simulator, None without it."""

    embedded: bool
    stepped: bool
    seed: int | None
    plant: Any
    faults: tuple[Any, ...] = ()       # scripted faults of the embedded simulator (`sim_bus.fault_script`)
    never_came: list[str] = field(default_factory=list)    # faults that the run ended too early to trigger
    left_in: Path | None = None        # folder of the undo journal of the drive's settings; None: beside the log

    @property
    def epoch_ns(self) -> int:
        """Return the wall clock at control time zero, for the log. In stepped time the control time runs ahead."""
        return time.time_ns()


@dataclass(frozen=True)
class Opening:
    """Everything that the opening of a drive for a run depends on."""

    plan: PeerPlan
    options: RunOptions
    connection: Connection
    data: DriveData        # facts of the bench that the drive does not report
    clock: Clock
    tap: FrameTap          # receives each raw frame, for the log
    trace: Path | None     # file of the simulated shaft's true motion


# ---------------------------------------------------------------------------------------------------------------------
# What scan, doctor and profiles show of a drive.


@dataclass(frozen=True)
class FoundDrive:
    """A drive that a scan found. ``address``: its number on the bus. ``line``: settings of the line when it answered,
    if a scan tries several settings.
    """

    bus: str                            # as in BUSES
    address: int
    title: str
    identity: str
    simulated: bool
    profile: str | None = None
    why: str = ""                       # reason for this profile, or for none
    seen: str = ""                      # frames that it sent without a request
    line: dict[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Return its name for display."""
        return f"{bus_named(self.bus).address_word} {self.address}"


class ValueSeen(Protocol):
    """A value of the drive with its meaning, to compare with the drive's panel."""

    def cells(self) -> tuple[str, str, str, str]:
        """Return address, counts, value and meaning."""
        ...

    def plain(self) -> dict[str, Any]:
        """Return the value as in the JSON document."""
        ...


@dataclass(frozen=True)
class ProfileTable:
    """A table of a profile's page. ``rows`` have a cell for each heading. ``remarks`` are lines below it.

    Without rows only the remarks are shown.
    """

    title: str = ""
    headings: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()
    remarks: tuple[str, ...] = ()


# ---------------------------------------------------------------------------------------------------------------------
# The bus itself.


def whole_address(options: RunOptions, connection: Connection) -> str | None:
    """Return all given values of the address as one text."""
    return " ".join((connection.drive, *(f"{name} {value}" for name, value, _ in connection.line.rows())))


def _no_keys(found: FoundDrive) -> Mapping[str, Any]:
    return {}


def _no_section(found: FoundDrive, connection: Connection) -> Mapping[str, Any]:
    return {}


def _no_tables(profile: Any) -> Iterable[ProfileTable]:
    return ()


def _no_facts(profile: Any) -> Sequence[tuple[str, str]]:
    return ()


def _no_arguments(scan: argparse._ArgumentGroup) -> None:
    return None


@dataclass(frozen=True, kw_only=True)
class Bus:
    """A bus above its driver: names, options, section of rig.yaml, opening, simulator, scan, doctor, profile page."""

    # Words.
    name: str                           # as in BUSES, --drive, and `bus:` of a profile
    title: str                          # name in texts
    named_by: str                       # options that name a drive on it, in words
    examples: tuple[str, ...]           # options that name a drive on it, as examples to type
    nothing_there: str                  # why the embedded simulator runs although it was not requested
    simulated_text: str                 # the simulated equipment, in words
    row_name: str = "bus"               # label in front of each row of the address
    address_word: str                   # name of a drive's number on the bus: node, unit
    address_flag: str                   # option of that number
    to_fill_in: str                     # in words, the keys of rig.yaml with a drive's address

    # Options and the address.
    flags: Mapping[str, str]
    """Options of the command line that no other bus has: name in the namespace → flag."""
    common_flags: frozenset[str] = frozenset()      # flags that the short ``--help`` shows
    also: frozenset[str] = frozenset()  # options of another bus that this bus reads too (names in the namespace)
    place: tuple[str, ...]              # settings of which one must be given to reach a drive
    default_profile: str                # profile if none is named
    add_arguments: Callable[[argparse.ArgumentParser], None]
    """Add its options in their own group."""
    line: Callable[[Mapping[str, Any], Rig | None, Any], Line]
    """Return the drive's address from command line, rig and profile. Raises UsageError and DataFileError."""
    line_type: type[Line] = Line
    address: Callable[[RunOptions, Connection], str | None] = whole_address
    """Return the drive's address as one text, the same for every program that means this drive. `hold` locks it. None
    if other processes can't reach the drive."""

    # Its section of rig.yaml; '' and None if it has none.
    section: str = ""
    section_model: type[DataModel] | None = None
    place_keys: str = ""                # keys of that section that give a drive's address, in words
    rig_section: Callable[[FoundDrive, Connection], Mapping[str, Any]] = _no_section
    """Return the content of the section for a drive that a scan found; empty if there is none."""
    rig_keys: Callable[[FoundDrive], Mapping[str, Any]] = _no_keys
    """Return further keys of rig.yaml for that drive, beside the section."""
    rig_blank: Callable[[Any], tuple[str, ...]]
    """Return commented lines of a rig.yaml for the address of a drive with that profile."""

    # Opening.
    open: Callable[[Opening], AbstractContextManager[Drive]]
    """Open the drive, real or simulated. It is closed afterwards, with all that was opened for it."""
    open_target: Callable[[RunOptions, Connection, Clock], AbstractContextManager[Target]]
    """Open only what ``tdhil stop`` needs of the drive. It is closed afterwards."""
    steps_over_a_wire: bool = False     # True if it can step a simulator in another process
    frame_topic: str = "/frames"        # topic of its raw frames in the log (`tdhil.recording.CHANNELS`)

    # Faults of the embedded simulator.
    parse_faults: Callable[[Sequence[str]], tuple[Any, ...]]
    """Return the faults that ``--fault`` requests. Raises UsageError."""
    faults: Callable[[], tuple[KnownFault, ...]]
    """Return the faults that ``--fault`` accepts."""
    fault_listing: Callable[[int], str]
    """Return the text that ``--fault list`` prints, wrapped at this many columns."""

    # Scan and doctor. Neither writes to a drive.
    scan: Callable[[PeerPlan, Connection, RunOptions, argparse.Namespace], tuple[tuple[FoundDrive, ...], list[str]]]
    """Return the drives that answer, and remarks. Raises CommunicationLost without an answer."""
    add_scan_arguments: Callable[[argparse._ArgumentGroup], None] = _no_arguments
    """Add further options of a scan of this bus."""
    wanted: Callable[[Connection, RunOptions], int | None]
    """Return the requested number of the drive; None for any."""
    findings: Callable[[PeerPlan, Connection, RunOptions, Rig | None, list[ValueSeen]], Iterator[DoctorFinding]]
    """Yield doctor's findings on bus and drive; the list receives values to compare."""
    libraries: Mapping[str, tuple[int, ...]] = field(default_factory=lambda: MappingProxyType({}))
    """Libraries on the package index, with the oldest supported version."""
    variables: tuple[str, ...] = ()     # environment variables that change its address

    # The page of a profile.
    profile_facts: Callable[[Any], Sequence[tuple[str, str]]] = _no_facts
    """Return (name, text) of the facts at the top of a profile's page."""
    profile_tables: Callable[[Any], Iterable[ProfileTable]] = _no_tables
    """Return the tables of objects or registers."""
    profile_sections: tuple[str, ...] | None = None
    """Entries of a profile that its page shows one by one; None: all but the parameters."""

    def asked_for(self, cli: Mapping[str, Any], besides: frozenset[str] = frozenset()) -> str | None:
        """Return the given flag that belongs only to this bus, except those in ``besides``; None if there is none."""
        return next((flag for name, flag in self.flags.items() if cli.get(name) is not None and name not in besides),
                    None)

    def section_of(self, rig: Rig) -> Any:
        """Return its section of rig.yaml; an empty one if the file has none. None if the bus has no section."""
        found = getattr(rig, self.section, None) if self.section else None
        return self.section_model() if found is None and self.section_model is not None else found

    def placed_in(self, rig: Rig) -> bool:
        """Return whether rig.yaml gives the address of a drive on this bus."""
        section = self.section_of(rig)
        return section is not None and any(getattr(section, name) for name in self.place)


def bus_named(name: str) -> Bus:
    """Return the bus of that name. Raises KeyError if there is none."""
    found: Bus = load(BUSES, name)
    return found


def all_buses() -> tuple[Bus, ...]:
    """Return all buses in their order."""
    return tuple(bus_named(name) for name in BUSES)


def keys_by_flag() -> dict[str, str]:
    """Return the key of rig.yaml for each option of a bus. Short flags of python-can have the key without a section."""
    keys = {flag: f"{bus.section}.{name}" for bus in all_buses() for name, flag in bus.flags.items()}
    return {"-i": "interface", "-c": "channel", "-b": "bitrate", **keys}


def examples() -> str:
    """Return the options that name a drive on each bus, as examples to type."""
    *first, last = (one for bus in all_buses() for one in bus.examples)
    return f"{', '.join(first)} or {last}" if first else last


def one_host(name: str) -> str:
    """Return the host's first address, so that name and number give the same text; the name if it is unknown."""
    try:
        found = sorted({str(one[4][0]) for one in socket.getaddrinfo(name, None, type=socket.SOCK_STREAM)})
    except (OSError, UnicodeError):
        return name.lower()
    return "127.0.0.1" if "127.0.0.1" in found else found[0]
