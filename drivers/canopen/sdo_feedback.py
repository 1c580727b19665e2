"""One look at a drive whose cyclic feedback is not to be had: status, speed and torque by SDO (6041h, 606Ch, 6077h).

SDO is served in pre-operational too, after a restart or a foreign NMT command; in NMT state stopped it is not, and such
a node is put into pre-operational first, in which nothing is enabled (CiA 301, NMT state machine). What is asked for by
the controlword goes the same way (6040h), and only towards rest: an RPDO may not be taken any more.
"""

from __future__ import annotations

from typing import NamedTuple

from drivers.canopen.pdo import VELOCITY_ACTUAL, VL_ACTUAL, decode_value
from drivers.canopen.sdo import Objects, name
from drivers.canopen.state_machine import State, controlword_towards
from drivers.drive import PowerRequest
from drivers.errors import CommunicationLost, ObjectRefused
from profiles import MARKER_INDEX
from profiles.canopen import CanopenProfile, ObjectType

ANSWER_S = 0.1
"""Wall time for one answer, asked for once: whoever looks does so again."""
WATCHDOG_SHARE = 0.15
"""An answer is waited for no longer than this share of the watchdog's time, which goes on being fed in between."""
_I16: ObjectType = "i16"
_AT_REST = {
    PowerRequest.QUICK_STOP: tuple(state for state in State if state not in (State.OPERATION_ENABLED, State.UNKNOWN)),
    PowerRequest.OFF: (State.NOT_READY, State.SWITCH_ON_DISABLED, State.FAULT_REACTION_ACTIVE, State.FAULT),
}
"""States in which a drive that was asked for this needs no other word."""


class Looked(NamedTuple):
    """As the drive's objects hold them, in counts. ``torque``: None where the drive did not give it."""

    status: int
    speed: int
    torque: float | None


def poll(objects: Objects, profile: CanopenProfile, watchdog_s: float) -> Looked | None:
    """The three objects one after the other, in well under the watchdog's time; None without status or speed."""
    with objects.answered_within(min(ANSWER_S, WATCHDOG_SHARE * watchdog_s) if watchdog_s else ANSWER_S):
        try:
            status = objects.read(0x6041)
            speed = objects.read((VL_ACTUAL if profile.speed.vl else VELOCITY_ACTUAL)[0], 0, signed=True)
        except (CommunicationLost, ObjectRefused):
            return None
        return Looked(status, speed, reported_torque(objects, profile))


def reported_torque(objects: Objects, profile: CanopenProfile) -> float | None:
    """In counts; None where the drive doesn't give it."""
    actual = profile.torque.actual
    index, sub, kind = (0x6077, 0, _I16) if actual is None else (actual.index, actual.sub, actual.type)
    try:
        return decode_value(kind, objects.read_bytes(index, sub), name(index, sub))
    except (CommunicationLost, ObjectRefused):
        return None


def keep_stepping(objects: Objects, profile: CanopenProfile, period_s: float) -> None:
    """A simulated drive that restarted knows no cycle any more, and its time stands still (1006h, or the marker's)."""
    index, sub = (0x1006, 0) if profile.cyclic.has_period else (MARKER_INDEX, 3)
    wanted_us = round(period_s * 1e6)
    with objects.answered_within(ANSWER_S):
        try:
            if objects.read(index, sub) != wanted_us:
                objects.write(index, sub, wanted_us, 32)
        except (CommunicationLost, ObjectRefused):
            return


def push(
    objects: Objects, state: State, wish: PowerRequest, watchdog_s: float, offset: tuple[int, int, int] | None = None
) -> None:
    """The controlword towards ``wish`` by SDO, where the drive isn't there; never one that enables.

    A torque ``offset`` that is in use is taken away first.
    """
    if wish is PowerRequest.ENABLED or state in _AT_REST[wish]:
        return
    with objects.answered_within(min(ANSWER_S, WATCHDOG_SHARE * watchdog_s) if watchdog_s else ANSWER_S):
        try:
            if offset is not None:
                objects.write(offset[0], offset[1], 0, offset[2])
            objects.write(0x6040, 0, controlword_towards(state, wish), 16)
        except (CommunicationLost, ObjectRefused):
            return                     # the next look sees what became of it
