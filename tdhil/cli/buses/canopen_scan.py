"""The nodes of a CAN bus: all receive a request for the device type (1000h) at once, those that answer one for 1018h.

Reads only. The 127 requests take 0.2 s. Everything received meanwhile (heartbeats, boot-ups, error frames) counts.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING

from drivers import CommunicationLost, MonotonicClock, ObjectRefused
from drivers.canopen import CanLink, SdoObjects
from profiles import MARKER_INDEX, MARKER_TEXT, MessageCode, load_profile, profile_names, visible
from profiles.canopen import CanopenProfile
from tdhil.cli.scan_common import FoundDrive

if TYPE_CHECKING:
    import can

ASK_DEVICE_TYPE = bytes((0x40, 0x00, 0x10, 0x00, 0, 0, 0, 0))
"""SDO: initiate upload of 1000h (CiA 301)."""
PACE_S = 0.0015
"""Interval between two requests, s: one frame at 125 kbit/s, so that no transmit queue overflows."""
FULL_TRIES, FULL_PAUSE_S = 20, 0.01
"""Time for a full transmit queue to empty, s, if another node acknowledges the frames."""
_STATES = {0: "boot-up", 4: "stopped", 5: "operational", 127: "pre-operational"}
_CIA402 = 402


@dataclass
class Heard:
    """Everything received during the scan."""

    device_types: dict[int, int] = field(default_factory=dict)     # node → 1000h
    states: dict[int, str] = field(default_factory=dict)           # node → its NMT state, from heartbeats
    frames: int = 0
    error_frames: int = 0


def ask_all(bus: can.BusABC, nodes: Iterable[int], wait_s: float) -> tuple[CanLink, Heard]:
    """Ask, then listen for ``wait_s`` of wall time. Raises CommunicationLost if the bus takes no frames."""
    heard = Heard()
    link = CanLink(bus, MonotonicClock())
    for node in range(1, 128):
        link.handlers[0x580 + node] = partial(_answered, heard, node)
        link.handlers[0x700 + node] = partial(_beat, heard, node)
    for node in nodes:
        _send(link, 0x600 + node, heard)
        _listen(link, PACE_S, heard)
    _listen(link, wait_s, heard)
    heard.error_frames = link.error_frames
    return link, heard


def identify_all(link: CanLink, heard: Heard) -> tuple[FoundDrive, ...]:
    """Return name and profile of every node that answered."""
    profiles = [profile for name in profile_names() if isinstance(profile := load_profile(name), CanopenProfile)]
    return tuple(_identify(link, node, heard, profiles) for node in sorted(heard.device_types))


def match(device_type: int, identity: tuple[int | None, int | None, int | None],
          profiles: Iterable[CanopenProfile]) -> tuple[str | None, str]:
    """Return (profile, reason): the one whose identity (vendor, product, revision of 1018h) fits best."""
    best, most = None, 0
    for profile in profiles:
        wanted = (profile.identity.vendor, profile.identity.product, profile.identity.revision)
        asked = [(want, have) for want, have in zip(wanted, identity, strict=True) if want is not None]
        if len(asked) > most and all(want == have for want, have in asked):
            best, most = profile.name, len(asked)
    if best is not None:
        return best, ("vendor", "vendor and product", "vendor, product and revision")[most - 1]
    if device_type & 0xFFFF == _CIA402:
        return "generic/cia402", "a CiA 402 drive without a profile of its own: check every unit"
    return None, f"not a CiA 402 drive (device type {device_type:08X}h)"


def _identify(link: CanLink, node: int, heard: Heard, profiles: list[CanopenProfile]) -> FoundDrive:
    objects = SdoObjects(link, node)
    values: list[int | None] = []
    title, simulated = "", False
    try:
        values += [objects.read_if_there(0x1018, sub) for sub in (1, 2, 3, 4)]
        title = _text(objects, 0x1008)
        simulated = _text(objects, MARKER_INDEX, 1) == MARKER_TEXT
    except CommunicationLost:
        values += [None] * (4 - len(values))           # it answered once and then no more: show what is known
    vendor, product, revision, serial = values
    profile, why = match(heard.device_types[node], (vendor, product, revision), profiles)
    parts = (("vendor", vendor), ("product", product), ("revision", revision), ("serial", serial))
    identity = ", ".join(f"{part} {value:X}h" for part, value in parts if value is not None)
    return FoundDrive("canopen", node, title, identity or "not reported (1018h)", simulated, profile, why,
                      heard.states.get(node, ""))


def _text(objects: SdoObjects, index: int, sub: int = 0) -> str:
    try:
        return visible(objects.read_bytes(index, sub).decode("ascii", "replace").rstrip("\0 "))
    except ObjectRefused:
        return ""


def _send(link: CanLink, identifier: int, heard: Heard) -> None:
    for attempt in range(FULL_TRIES):
        try:
            link.send(identifier, ASK_DEVICE_TYPE)
        except CommunicationLost as error:
            if attempt + 1 == FULL_TRIES:
                raise CommunicationLost(
                f"{error.what}: no other node acknowledges the frames", where=error.where,
                next_step="Check that a drive is powered and connected, the bit rate of the bus (-b), and termination",
                entry=MessageCode.BUS_FAILED,
                ) from error
            with contextlib.suppress(CommunicationLost):
                _listen(link, FULL_PAUSE_S, heard)
        else:
            return


def _listen(link: CanLink, seconds: float, heard: Heard) -> None:
    end_s = time.monotonic() + seconds
    while (left_s := end_s - time.monotonic()) > 0.0:
        if link.receive(left_s) is not None:
            heard.frames += 1


def _answered(heard: Heard, node: int, data: bytes) -> None:
    """Note an answer of an SDO server: the node exists; one that refuses 1000h has type 0."""
    if len(data) == 8 and data[1:4] == ASK_DEVICE_TYPE[1:4]:
        heard.device_types[node] = int.from_bytes(data[4:8], "little") if data[0] & 0xE0 == 0x40 else 0


def _beat(heard: Heard, node: int, data: bytes) -> None:
    if len(data) == 1:
        heard.states[node] = _STATES.get(data[0] & 0x7F, f"state {data[0]:02X}h")
