"""What the adapter says of the bus: SocketCAN's error frames, and a transmit queue that is full.

An error frame's identifier holds classes, its second byte the controller's state (Linux, `linux/can/error.h`). Other
interfaces send error frames without either: those are counted only.
"""

from __future__ import annotations

import errno
from enum import Enum

CONTROLLER, BUS_OFF = 0x04, 0x40
_PASSIVE = 0x10 | 0x20
"""Receiver or transmitter error-passive: more than 127 errors, CiA 301 and ISO 11898-1."""
_FULL = ("buffer full", "queue full", "no buffer space")


class Condition(Enum):
    """What one error frame means for the run."""

    ERROR = "an error on the bus"
    PASSIVE = "the adapter is error-passive"
    OFF = "the adapter is bus-off"


def condition(identifier: int, data: bytes) -> Condition:
    """Of one error frame."""
    if identifier & BUS_OFF:
        return Condition.OFF
    if identifier & CONTROLLER and len(data) > 1 and data[1] & _PASSIVE:
        return Condition.PASSIVE
    return Condition.ERROR


def queue_is_full(error: BaseException) -> bool:
    """Did a frame not go out because those before it are still waiting?"""
    numbers = getattr(error, "error_code", None), getattr(error, "errno", None)
    return errno.ENOBUFS in numbers or any(text in str(error).lower() for text in _FULL)
