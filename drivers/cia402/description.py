"""Description that a drive gives of itself, for a scan on any bus. Nothing is written."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

from drivers.cia402.objects import Objects
from drivers.errors import CommunicationLost, ObjectRefused
from profiles import MARKER_INDEX, MARKER_TEXT, visible


@dataclass(frozen=True, kw_only=True)
class Description:
    """Vendor, product, revision and serial number (1018h; None: not reported), name, and the simulator's marker."""

    identity: tuple[int | None, ...] = (None,) * 4
    title: str = ""
    simulated: bool = False


def describe(objects: Objects) -> Description:
    """Return the description. A drive that stops answering leaves the rest of it empty."""
    identity: list[int | None] = []
    title, simulated = "", False
    with suppress(CommunicationLost):
        identity += [objects.read_if_there(0x1018, sub) for sub in (1, 2, 3, 4)]
        title = text_if_there(objects, 0x1008) or ""
        simulated = text_if_there(objects, MARKER_INDEX, 1) == MARKER_TEXT
    return Description(identity=tuple(identity) or (None,) * 4, title=title, simulated=simulated)


def text_if_there(objects: Objects, index: int, sub: int = 0) -> str | None:
    """Return a text (VISIBLE_STRING) as one line for display, or None if the drive does not have the object."""
    try:
        return visible(objects.read_bytes(index, sub).decode("ascii", "replace").rstrip("\0 "))
    except ObjectRefused:
        return None
