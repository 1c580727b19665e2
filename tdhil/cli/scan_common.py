"""The interface of a bus for scan, doctor and rig new; and a drive that a scan found."""

from __future__ import annotations

import argparse
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, cast

from tdhil.config import BUSES, imported

if TYPE_CHECKING:
    from profiles import Profile
    from tdhil.cli.doctor_finding import DoctorFinding
    from tdhil.config import Rig, RunOptions
    from tdhil.session import Connection, PeerPlan


@dataclass(frozen=True)
class FoundDrive:
    """A drive that a scan found. ``address``: node or unit number. ``line``: how a Modbus line was set when it
    answered.
    """

    bus: str                            # as in BUSES
    address: int
    title: str
    identity: str
    simulated: bool
    profile: str | None = None
    why: str = ""                       # why this profile, or why none
    seen: str = ""                      # what it sent without a request
    line: dict[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Return its name for display."""
        return f"{bus_commands(self.bus).address} {self.address}"


class ValueSeen(Protocol):
    """A value of the drive with its meaning, to compare with the drive's panel."""

    def cells(self) -> tuple[str, str, str, str]:
        """Return address, counts, value and meaning."""
        ...

    def plain(self) -> dict[str, Any]:
        """Return it as in the JSON document."""
        ...


class BusCommands(ABC):
    """Scan, doctor and rig new on a bus, found by `tdhil.config.registry.BUSES`. None of it writes to a drive.

    Every ``--help`` imports its module, so a library of the bus is imported only where it is used.
    """

    address: ClassVar[str]              # name of a drive's address: node, unit
    address_flag: ClassVar[str]         # option of that address
    to_fill_in: ClassVar[str]           # in words, the keys of rig.yaml with a drive's address

    @abstractmethod
    def scan(
        self, plan: PeerPlan, connection: Connection, options: RunOptions, asked: argparse.Namespace
    ) -> tuple[tuple[FoundDrive, ...], list[str]]:
        """Return the drives that answer, and remarks. Raises CommunicationLost without an answer."""

    @abstractmethod
    def findings(
        self, plan: PeerPlan, connection: Connection, options: RunOptions, rig: Rig | None, seen: list[ValueSeen]
    ) -> Iterator[DoctorFinding]:
        """Yield doctor's findings on bus and drive; ``seen`` receives values to compare."""

    def add_scan_arguments(self, scan: argparse._ArgumentGroup) -> None:
        """Add further options of a scan of this bus."""
        return

    @abstractmethod
    def wanted(self, connection: Connection, options: RunOptions) -> int | None:
        """Return the requested address."""

    @abstractmethod
    def section(self, found: FoundDrive, connection: Connection) -> Mapping[str, Any]:
        """Return the bus's section of a rig.yaml for that drive; empty if there is none."""

    @abstractmethod
    def blank(self, profile: Profile) -> tuple[str, ...]:
        """Return commented lines of a rig.yaml for the address of a drive with that profile."""

    def keys(self, found: FoundDrive) -> Mapping[str, Any]:
        """Return further keys of rig.yaml for that drive, beside the section."""
        return {}


def bus_commands(name: str) -> BusCommands:
    """Return the commands of a bus. Raises KeyError for an unknown name."""
    return cast(BusCommands, imported(BUSES[name].commands))
