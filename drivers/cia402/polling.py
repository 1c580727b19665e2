"""Status, speed and torque read as objects (6041h, 606Ch, 6077h), for a drive without cyclic feedback.

The controlword (6040h) is written as an object too, and only towards standstill, because the drive may no longer accept
a cyclic setpoint.
"""

from __future__ import annotations

from contextlib import suppress
from typing import NamedTuple

from drivers.cia402.objects import Objects, name
from drivers.cia402.process_data import VELOCITY_ACTUAL, VL_ACTUAL, decode_value
from drivers.cia402.state_machine import State, controlword_towards
from drivers.drive import PowerRequest
from drivers.errors import CommunicationLost, ObjectRefused
from profiles.cia402 import Cia402Profile, ObjectType

ANSWER_S = 0.1
"""Wall time for one answer, s. Each request is sent once; the caller polls again."""
WATCHDOG_SHARE = 0.15
"""Longest wait for an answer, as a share of the watchdog's time. The watchdog is fed in between."""
_I16: ObjectType = "i16"
_AT_REST = {
    PowerRequest.QUICK_STOP: tuple(state for state in State if state not in (State.OPERATION_ENABLED, State.UNKNOWN)),
    PowerRequest.OFF: (State.NOT_READY, State.SWITCH_ON_DISABLED, State.FAULT_REACTION_ACTIVE, State.FAULT),
}
"""States in which a drive needs no further controlword for this request."""


class Looked(NamedTuple):
    """Values of the drive's objects in counts. ``torque``: None if the drive did not report it."""

    status: int
    speed: int
    torque: float | None


def answer_time_s(watchdog_s: float) -> float:
    """Return the wall time for one answer while a shaft may turn, s, for a watchdog of this time (0: none is armed)."""
    return min(ANSWER_S, WATCHDOG_SHARE * watchdog_s) if watchdog_s else ANSWER_S


def poll(objects: Objects, profile: Cia402Profile, watchdog_s: float) -> Looked | None:
    """Read the three objects in well under the watchdog's time; None without status or speed."""
    with objects.answered_within(answer_time_s(watchdog_s)):
        try:
            status = objects.read(0x6041)
            speed = objects.read((VL_ACTUAL if profile.speed.vl else VELOCITY_ACTUAL)[0], 0, signed=True)
        except (CommunicationLost, ObjectRefused):
            return None
        return Looked(status, speed, reported_torque(objects, profile))


def reported_torque(objects: Objects, profile: Cia402Profile) -> float | None:
    """Return the torque in counts; None if the drive does not report it."""
    actual = profile.torque.actual
    index, sub, kind = (0x6077, 0, _I16) if actual is None else (actual.index, actual.sub, actual.type)
    try:
        return decode_value(kind, objects.read_bytes(index, sub), name(index, sub))
    except (CommunicationLost, ObjectRefused):
        return None


def push(
    objects: Objects, state: State, wish: PowerRequest, watchdog_s: float, offset: tuple[int, int, int] | None = None,
    *, removes_torque: bool = False,
) -> bool:
    """Write the controlword towards ``wish`` if the drive is not in that state; never one that enables.

    ``removes_torque``: the power stage is switched off at once. A torque ``offset`` in use is cleared first. Return
    whether the controlword was needed.
    """
    if wish is PowerRequest.ENABLED or state in _AT_REST[wish]:
        return False
    with objects.answered_within(answer_time_s(watchdog_s)):
        if offset is not None:
            with suppress(CommunicationLost, ObjectRefused):
                objects.write(offset[0], offset[1], 0, offset[2])
        with suppress(CommunicationLost, ObjectRefused):       # the next poll shows the result
            objects.write(0x6040, 0, controlword_towards(state, wish, removes_torque=removes_torque), 16)
    return True
