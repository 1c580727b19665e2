"""The nodes of a CAN bus: all receive a request for the device type (1000h) at once.

Reads only. The 127 requests take 0.2 s. Everything received meanwhile (heartbeats, boot-ups, error frames) counts.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING

from drivers.canopen.bus import CanLink
from drivers.clock import MonotonicClock
from drivers.errors import CommunicationLost
from profiles import MessageCode

if TYPE_CHECKING:
    import can

ASK_DEVICE_TYPE = bytes((0x40, 0x00, 0x10, 0x00, 0, 0, 0, 0))
"""SDO: initiate upload of 1000h (CiA 301)."""
PACE_S = 0.0015
"""Interval between two requests, s: one frame at 125 kbit/s, so that no transmit queue overflows."""
FULL_TRIES, FULL_PAUSE_S = 20, 0.01
"""Attempts to send a frame while the transmit queue is full, and pause between them, s. The queue empties in this time
if another node acknowledges the frames."""
_STATES = {0: "boot-up", 4: "stopped", 5: "operational", 127: "pre-operational"}
@dataclass
class Heard:
    """Everything received during the scan."""

    device_types: dict[int, int] = field(default_factory=dict)     # node → 1000h
    states: dict[int, str] = field(default_factory=dict)           # node → its NMT state, from heartbeats
    frames: int = 0
    error_frames: int = 0


def ask_all(bus: can.BusABC, nodes: Iterable[int], wait_s: float) -> tuple[CanLink, Heard]:
    """Send the requests, then listen for ``wait_s`` of wall time. Raises CommunicationLost if the bus accepts no
    frames.
    """
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
    """Record an answer of an SDO server: the node exists. The type is 0 if the node refuses 1000h."""
    if len(data) == 8 and data[1:4] == ASK_DEVICE_TYPE[1:4]:
        heard.device_types[node] = int.from_bytes(data[4:8], "little") if data[0] & 0xE0 == 0x40 else 0


def _beat(heard: Heard, node: int, data: bytes) -> None:
    if len(data) == 1:
        heard.states[node] = _STATES.get(data[0] & 0x7F, f"state {data[0]:02X}h")
