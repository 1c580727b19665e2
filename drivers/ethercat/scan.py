"""The slaves of a segment. No object is written, and a segment that another master drives keeps its AL states."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass

from drivers.clock import MonotonicClock
from drivers.errors import CommunicationLost, ObjectRefused, PreflightRefused
from drivers.ethercat.mailbox import CoeObjects, Mailbox
from drivers.ethercat.raw import RawSegment, RawStation, refuse_driven
from drivers.ethercat.segment import open_segment
from drivers.ethercat.station import ALIAS, INIT, Station, not_answered
from profiles import MARKER_INDEX, MARKER_TEXT, visible


@dataclass(frozen=True)
class FoundSlave:
    """A slave that answered. ``device_type`` (1000h) and ``identity`` (1018h) are None without a mailbox."""

    position: int
    alias: int
    state: str
    device_type: int | None = None
    identity: tuple[int | None, ...] = (None,) * 4
    title: str = ""
    simulated: bool = False


@contextmanager
def stations_at(interface: str) -> Iterator[tuple[Sequence[Station], str]]:
    """Open all slaves, in PRE-OP unless another master drives one of them. Yield them, with a text about such a drive.

    The text is empty if no other master drives a slave. Raises CommunicationLost if no slave answers.
    """
    look = RawSegment(interface)
    try:
        count, driven = look.count(), ""
        if not count:
            raise not_answered("no EtherCAT slave answers", interface)
        try:
            refuse_driven(look)
        except PreflightRefused as error:
            driven = f"{error.where}: {error.what}"
            yield [RawStation(look, position) for position in range(count)], driven
            return
    finally:
        look.close()
    segment = open_segment(interface)
    try:
        yield segment.stations, ""
    finally:
        segment.close()


def objects_of(station: Station) -> CoeObjects:
    """Return the object dictionary of a slave."""
    return CoeObjects(Mailbox(station, MonotonicClock()))


def found_slave(position: int, station: Station, driven: bool = False) -> FoundSlave:
    """Return the description that a slave reports. Reads only; the mailbox of a ``driven`` slave is not used."""
    state, alias = station.al_status(), station.number(ALIAS)
    known = FoundSlave(position, alias, state.text)
    if driven or state.state == INIT:
        return known
    objects = objects_of(station)
    with suppress(CommunicationLost, ObjectRefused):
        device_type = objects.read(0x1000)
        identity = tuple(objects.read_if_there(0x1018, sub) for sub in (1, 2, 3, 4))
        marked = _text(objects, MARKER_INDEX, 1) == MARKER_TEXT
        return FoundSlave(position, alias, state.text, device_type, identity, _text(objects, 0x1008), marked)
    return known


def _text(objects: CoeObjects, index: int, sub: int = 0) -> str:
    try:
        return visible(objects.read_bytes(index, sub).decode("ascii", "replace").rstrip("\0 "))
    except ObjectRefused:
        return ""
