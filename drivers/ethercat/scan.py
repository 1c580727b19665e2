"""The slaves of a segment. No object is written, and a segment that another master drives keeps its AL states."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace

from drivers.cia402 import Description, describe
from drivers.clock import MonotonicClock
from drivers.errors import CommunicationLost, ObjectRefused, PreflightRefused
from drivers.ethercat.mailbox import CoeObjects, Mailbox
from drivers.ethercat.raw import RawSegment, refuse_driven
from drivers.ethercat.segment import open_segment
from drivers.ethercat.station import ALIAS, INIT, Station, not_answered


@dataclass(frozen=True, kw_only=True)
class FoundSlave(Description):
    """A slave that answered. ``device_type`` (1000h) is None without a mailbox, and the description is empty."""

    position: int
    alias: int
    state: str
    device_type: int | None = None


@contextmanager
def stations_at(interface: str) -> Iterator[tuple[Sequence[Station], str]]:
    """Open all slaves, in PRE-OP unless another master drives one of them. Yield them, with a text about such a drive.

    The text is empty if no other master drives a slave. Raises CommunicationLost if no slave answers.
    """
    with closing(RawSegment(interface)) as look:
        stations = look.stations()
        if not stations:
            raise not_answered("no EtherCAT slave answers", interface)
        try:
            refuse_driven(look)
        except PreflightRefused as error:
            yield stations, f"{error.where}: {error.what}"
            return
    with closing(open_segment(interface)) as segment:
        yield segment.stations, ""


def objects_of(station: Station) -> CoeObjects:
    """Return the object dictionary of a slave."""
    return CoeObjects(Mailbox(station, MonotonicClock()))


def found_slave(position: int, station: Station, driven: bool = False) -> FoundSlave:
    """Return the description that a slave reports. Reads only; the mailbox of a ``driven`` slave is not used."""
    state = station.al_status()
    found = FoundSlave(position=position, alias=station.number(ALIAS), state=state.text)
    if not driven and state.state != INIT:
        objects = objects_of(station)
        with suppress(CommunicationLost, ObjectRefused):
            return replace(found, device_type=objects.read(0x1000), **vars(describe(objects)))
    return found
