"""What the commands that only look, and write a rig.yaml to start from, ask of a bus; and a drive that a scan found."""

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
    """``address``: node or unit number. ``line``: how a Modbus line was set when it answered."""

    bus: str                            # as in BUSES
    address: int
    title: str
    identity: str
    simulated: bool
    profile: str | None = None
    why: str = ""                       # why this profile, or why none
    seen: str = ""                      # what it sent by itself
    line: dict[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """As people call it."""
        return f"{bus_commands(self.bus).address} {self.address}"


class ValueSeen(Protocol):
    """A value of the drive's beside what it is taken for: people compare it with the drive's panel."""

    def cells(self) -> tuple[str, str, str, str]:
        """Address, counts, value, meaning."""
        ...

    def plain(self) -> dict[str, Any]:
        """As the JSON document has it."""
        ...


class BusCommands(ABC):
    """What scan, doctor and rig new do on a bus, found by `tdhil.config.registry.BUSES`. None of it writes to a drive.

    Its module is imported for every ``--help``: what loads a library of the bus is imported where it is used.
    """

    address: ClassVar[str]              # what tells drives apart: node, unit
    address_flag: ClassVar[str]         # … and its option
    to_fill_in: ClassVar[str]           # in words, what of rig.yaml says where a drive is

    @abstractmethod
    def scan(
        self, plan: PeerPlan, connection: Connection, options: RunOptions, asked: argparse.Namespace
    ) -> tuple[tuple[FoundDrive, ...], list[str]]:
        """Who answers, and remarks. Raises CommunicationLost, with the likely causes, where nobody does."""

    @abstractmethod
    def findings(
        self, plan: PeerPlan, connection: Connection, options: RunOptions, rig: Rig | None, seen: list[ValueSeen]
    ) -> Iterator[DoctorFinding]:
        """What doctor has to say of the bus and of the drive; ``seen`` is filled with values to compare."""

    def add_scan_arguments(self, scan: argparse._ArgumentGroup) -> None:
        """What a scan of this bus can be told besides."""
        return

    @abstractmethod
    def wanted(self, connection: Connection, options: RunOptions) -> int | None:
        """The address that was asked for by name."""

    @abstractmethod
    def section(self, found: FoundDrive, connection: Connection) -> Mapping[str, Any]:
        """The bus's section of a rig.yaml for that drive; empty where nothing is to be said."""

    @abstractmethod
    def blank(self, profile: Profile) -> tuple[str, ...]:
        """Lines of a rig.yaml that say where a drive with that profile is, behind '#'."""

    def keys(self, found: FoundDrive) -> Mapping[str, Any]:
        """What else rig.yaml has to say for that drive, beside the section."""
        return {}


def bus_commands(name: str) -> BusCommands:
    """Of the bus of that name. KeyError where there is none."""
    return cast(BusCommands, imported(BUSES[name].commands))
