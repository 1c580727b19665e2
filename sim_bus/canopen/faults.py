"""Scripted faults of one simulated drive: each fault begins and ends on time, and frames pass through active faults.

All times are plant time: in stepped time a script repeats to the last frame. If a SYNC to the drive is lost in stepped
time, time still advances. From the first cycle on, the host is informed of the end of each cycle
(`profiles.simulator_marker.CYCLE_ID`). So a frame that a fault adds after the feedback still belongs to its cycle.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from profiles import CYCLE_ID, CYCLE_OVER, CYCLES_END, LAST_CYCLE_OVER
from sim_bus.canopen.node import SYNC, Cia402Node
from sim_bus.canopen.sender import Sender
from sim_bus.drive_faults import FaultSchedule, InjectedFault, of_bus, of_drive
from sim_bus.fault_script import (
    FaultKind,
    Kinds,
    Passing,
    Scripted,
    object_place,
    plain,
    seconds,
    share,
)
from sim_bus.sdo_server import Meddling

# ---------------------------------------------------------------------------------------------------------------------
# Effects of a scripted fault: it changes frames on their way in or out, or changes the drive itself.


Frame = tuple[int, bytes | bytearray]
Frames = Iterable[Frame]


@dataclass(frozen=True)
class Scene:
    """Place of a fault. ``put`` sends a frame past all faults, like another station on the bus."""

    node: Cia402Node
    put: Callable[[int, bytes], None]
    rng: np.random.Generator

    def foreign(self, can_id: int, data: bytes) -> None:
        """Send a frame of a third party: all nodes on the bus receive it, the drive among them."""
        self.put(can_id, data)
        self.node.application.foreign = True
        try:
            self.node.on_frame(can_id, data)
        finally:
            self.node.application.foreign = False


class Misbehaviour(Passing):
    """A fault without effect; a subclass overrides the methods that it needs. `begin` is called first."""

    scene: Scene

    def outgoing(self, can_id: int, data: bytes) -> Frames:
        """Return the frames that replace a frame sent by the drive."""
        return ((can_id, data),)

    def incoming(self, can_id: int, data: bytes | bytearray) -> Frames:
        """Return the frames that replace a frame sent to the drive."""
        return ((can_id, data),)


# ---------------------------------------------------------------------------------------------------------------------
# Faults of the drive itself and of its load.


class Restart(Misbehaviour):
    """Restart of the drive: torque off, defaults, boot-up message."""

    def begin(self) -> None:
        node = self.scene.node
        node.on_frame(0x000, bytes((0x81, node.id)))


class ForeignNmt(Misbehaviour):
    """NMT command of a third party: 2 stop, 128 pre-operational (CiA 301)."""

    def __init__(self, command: int) -> None:
        self._command = command

    def begin(self) -> None:
        self.scene.foreign(0x000, bytes((self._command, self.scene.node.id)))


class OfDrive(Misbehaviour):
    """Fault that a drive may have on any bus."""

    def __init__(self, fault: InjectedFault) -> None:
        self._fault = fault

    def begin(self) -> None:
        self._fault.begin(self.scene.node)

    def end(self) -> None:
        self._fault.end(self.scene.node)


# ---------------------------------------------------------------------------------------------------------------------
# Faults of the bus: frames that are lost, doubled, late, old, or foreign.


SYNC_ID = 0x080
_FIRST_TPDO, _SECOND_TPDO, _HEARTBEAT, _ANSWER, _REQUEST = 0x180, 0x280, 0x700, 0x580, 0x600
_SWITCH_ON_DISABLED = b"\x40\x02"
_AT_REST = b"\x37\x16"        # operation enabled, target reached, speed zero


class Dead(Misbehaviour):
    """Loss of all frames in both directions: a cable is cut, an adapter is pulled."""

    def outgoing(self, can_id: int, data: bytes) -> Frames:
        return ()

    def incoming(self, can_id: int, data: bytes | bytearray) -> Frames:
        return ()


class Lossy(Misbehaviour):
    """Loss of a share of all frames, in both directions."""

    def __init__(self, share: float) -> None:
        self._share = share

    def outgoing(self, can_id: int, data: bytes) -> Frames:
        return () if self.scene.rng.random() < self._share else ((can_id, data),)

    def incoming(self, can_id: int, data: bytes | bytearray) -> Frames:
        return () if self.scene.rng.random() < self._share else ((can_id, data),)


class Without(Misbehaviour):
    """Missing frames: the drive no longer sends frames of these kinds (identifier minus node-ID)."""

    def __init__(self, *kinds: int) -> None:
        self._kinds = kinds

    def outgoing(self, can_id: int, data: bytes) -> Frames:
        return () if can_id - self.scene.node.id in self._kinds else ((can_id, data),)


class Doubled(Misbehaviour):
    """Doubled TPDOs: a share of them comes twice."""

    def __init__(self, share: float) -> None:
        self._share = share

    def outgoing(self, can_id: int, data: bytes) -> Frames:
        twice = can_id == _FIRST_TPDO + self.scene.node.id and self.scene.rng.random() < self._share
        return ((can_id, data),) * (1 + twice)


class Reordered(Misbehaviour):
    """Delayed TPDO1: a share of them comes after that of the next SYNC."""

    def __init__(self, share: float) -> None:
        self._share = share
        self._held: list[Frame] = []

    def end(self) -> None:
        self._held.clear()

    def outgoing(self, can_id: int, data: bytes) -> Frames:
        if can_id != _FIRST_TPDO + self.scene.node.id:
            return ((can_id, data),)
        if self._held:
            held, self._held = self._held, []
            return ((can_id, data), *held)
        if self.scene.rng.random() < self._share:
            self._held.append((can_id, data))
            return ()
        return ((can_id, data),)


class FrozenTpdos(Misbehaviour):
    """Frozen TPDOs: they continue with their last content, like a gateway that repeats its process image."""

    def __init__(self) -> None:
        self._kept: dict[int, bytes] = {}

    def outgoing(self, can_id: int, data: bytes) -> Frames:
        if can_id - self.scene.node.id not in (_FIRST_TPDO, _SECOND_TPDO):
            return ((can_id, data),)
        return ((can_id, self._kept.setdefault(can_id, data)),)


class Replayed(Misbehaviour):
    """Replay of a recording of this drive, enabled and at standstill: old TPDOs precede each of the drive's own."""

    def __init__(self, before: int) -> None:
        self._before = before

    def outgoing(self, can_id: int, data: bytes) -> Frames:
        if can_id != _FIRST_TPDO + self.scene.node.id:
            return ((can_id, data),)
        old = _AT_REST + bytes(max(0, len(data) - 2))
        return (*((can_id, old),) * self._before, (can_id, data))


class SecondNode(Misbehaviour):
    """Second drive with the same node-ID: it answers too, and reports that it is switched off."""

    def begin(self) -> None:
        if self.scene.node.cycled:
            self.scene.put(_HEARTBEAT + self.scene.node.id, b"\0")     # a drive that was just switched on

    def outgoing(self, can_id: int, data: bytes) -> Frames:
        kind = can_id - self.scene.node.id
        if kind == _FIRST_TPDO:
            return (can_id, data), (can_id, _SWITCH_ON_DISABLED + bytes(max(0, len(data) - 2)))
        if kind in (_ANSWER, _HEARTBEAT):
            return (can_id, data), (can_id, data)
        return ((can_id, data),)


class SecondMaster(Misbehaviour):
    """Another host that operates the drive: it enables the drive before our host; later it sends its own SYNC and
    setpoints.
    """

    def begin(self) -> None:
        node = self.scene.node
        if not node.cycled:
            for word in (0x06, 0x07, 0x0F):
                node.application.write_controlword(word)

    def incoming(self, can_id: int, data: bytes | bytearray) -> Frames:
        node = self.scene.node
        if can_id == SYNC_ID and node.cycled:
            self.scene.put(SYNC_ID, b"")
            self.scene.foreign(0x200 + node.id, bytes.fromhex("0f00") + bytes(6))
        return ((can_id, data),)


class ForeignHeartbeat(Misbehaviour):
    """Periodic heartbeat of another node with the host's number 127."""

    def __init__(self, every_s: float) -> None:
        self._every_us = round(1e6 * every_s)
        self._next_us = 0

    def incoming(self, can_id: int, data: bytes | bytearray) -> Frames:
        now_us = self.scene.node.time_us
        if now_us >= self._next_us:
            self._next_us = now_us + self._every_us
            self.scene.foreign(_HEARTBEAT + 127, b"\x05")
        return ((can_id, data),)


class ToolWrites(Misbehaviour):
    """A single write of a tool to one object by SDO; all nodes on the bus receive it."""

    def __init__(self, index: int, sub: int, value: int, size: int) -> None:
        self._request = bytes((0x23 | (4 - size) << 2,)) + index.to_bytes(2, "little") + bytes((sub,)) + (
            value.to_bytes(4, "little"))

    def begin(self) -> None:
        self.scene.foreign(_REQUEST + self.scene.node.id, self._request)


class SettingChanged(Misbehaviour):
    """Change of one object at the drive's own panel: no frame on the bus shows it."""

    def __init__(self, index: int, sub: int, value: int) -> None:
        self._key, self._value = index << 8 | sub, value

    def begin(self) -> None:
        self.scene.node.store.write(self._key, self._value)


class ForeignSetpoints(Misbehaviour):
    """Another master that sends enable operation and a speed of 500 counts in RPDO4, at each SYNC.

    ``again``: it also switches that RPDO on again, by SDO, whenever the RPDO is off.
    """

    def __init__(self, again: bool) -> None:
        self._again = again

    def begin(self) -> None:
        self.scene.node.store.write(0x1403 << 8 | 2, 1)        # synchronous: acts in addition to the host's

    def incoming(self, can_id: int, data: bytes | bytearray) -> Frames:
        node = self.scene.node
        if can_id == SYNC_ID and node.cycled:
            if self._again and int(node.store.number(0x1403 << 8 | 1)) >> 31:
                switch_on = bytes.fromhex("23031401") + (0x500 + node.id).to_bytes(4, "little")
                self.scene.foreign(_REQUEST + node.id, switch_on)
            self.scene.foreign(0x500 + node.id, bytes.fromhex("0f00f4010000"))
        return ((can_id, data),)


class SdoMaster(Misbehaviour):
    """Another master that writes enable operation and a speed of 500 counts by SDO, after each SYNC."""

    def incoming(self, can_id: int, data: bytes | bytearray) -> Frames:
        node = self.scene.node
        if can_id != SYNC_ID or not node.cycled:
            return ((can_id, data),)
        wishes = [(_REQUEST + node.id, bytes.fromhex(one)) for one in ("23ff6000f4010000", "2b4060000f000000")]
        for wish in wishes:
            self.scene.put(*wish)
        return ((can_id, data), *wishes)


class Answers(Misbehaviour):
    """Base of the faults that change SDO transfers. ``index`` and ``sub`` name the object."""

    def __init__(self, index: int, sub: int) -> None:
        self._object = index.to_bytes(2, "little") + bytes((sub,))

    def _asked(self, can_id: int, data: bytes | bytearray, *commands: int) -> bool:
        """Return whether a transfer of the object begins (command specifier 1 download, 2 upload; CiA 301)."""
        requested = can_id == _REQUEST + self.scene.node.id and len(data) == 8
        return requested and data[0] >> 5 in commands and bytes(data[1:4]) == self._object

    def _answer(self, first: int, rest: bytes = bytes(4)) -> None:
        self.scene.put(_ANSWER + self.scene.node.id, bytes((first,)) + self._object + rest)


class Aborted(Answers):
    """Abort of every transfer of the object: 08000020h, data can't be transferred or stored."""

    def incoming(self, can_id: int, data: bytes | bytearray) -> Frames:
        if not self._asked(can_id, data, 1, 2):
            return ((can_id, data),)
        self._answer(0x80, (0x08000020).to_bytes(4, "little"))
        return ()


class Unanswered(Answers):
    """Missing answers to all requests for the object."""

    def incoming(self, can_id: int, data: bytes | bytearray) -> Frames:
        return () if self._asked(can_id, data, 1, 2) else ((can_id, data),)


class NotKept(Answers):
    """Write without effect: the drive confirms it, and the object keeps its value."""

    def incoming(self, can_id: int, data: bytes | bytearray) -> Frames:
        if not self._asked(can_id, data, 1):
            return ((can_id, data),)
        self._answer(0x60)
        return ()


class Otherwise(Answers):
    """Wrong value of an object when it is read: one bit of its lowest byte is changed."""

    def outgoing(self, can_id: int, data: bytes) -> Frames:
        upload = can_id == _ANSWER + self.scene.node.id and data[0] >> 5 == 2 and data[0] & 2
        if upload and data[1:4] == self._object:
            data = data[:4] + bytes((data[4] ^ 0x04,)) + data[5:]
        return ((can_id, data),)


# ---------------------------------------------------------------------------------------------------------------------
# Table of the faults on CANopen: name, row of the fault table, effect, meaning of the value.


def _frames(text: str) -> int:
    if not (text.isdecimal() and 1 <= int(text) <= 100):
        raise ValueError("a number of frames, 1 to 100")
    return int(text)


def _again(text: str) -> bool:
    if text not in ("once", "again"):
        raise ValueError("once or again")
    return text == "again"


def _written(text: str) -> tuple[int, int, int, int]:
    """Return object, value and its size in bytes from a text such as 6072h=100 or 1016h:1=0 (CiA 301 and 402)."""
    where, _, value = text.partition("=")
    index, sub = object_place(where)
    if not re.fullmatch(r"[0-9]{1,10}|[0-9A-Fa-f]{1,8}h", value):
        raise ValueError("an object and what is written to it, such as 6072h=100")
    number = int(value[:-1], 16) if value.endswith("h") else int(value)
    size = 4 if index in _LONG or 0x1400 <= index < 0x1C00 else 1 if index in _SHORT else 2
    if number >> 8 * size:
        raise ValueError(f"a value of at most {size} bytes")
    return index, sub, number, size


TRANSFERS: dict[Meddling, type[Answers]] = {
    Meddling.ABORTED: Aborted, Meddling.UNANSWERED: Unanswered, Meddling.NOT_KEPT: NotKept,
    Meddling.OTHERWISE: Otherwise,
}
"""Fault of the transfers of an object, by its effect."""

_LONG, _SHORT = {0x1006, 0x1016, 0x6080, 0x6085, 0x60FF}, {0x100D, 0x6060}

KINDS: Kinds[Misbehaviour] = Kinds({
    **of_bus(
        dead=Dead, lossy=Lossy, loss="5%", restart=Restart, restarts="boot-up message",
        transfers=lambda how, index, sub: TRANSFERS[how](index, sub),
    ),
    "duplicate-frames": FaultKind(18, "this share of the feedback frames is sent twice",
                                  lambda v: Doubled(share(v)), "10%", "SHARE"),
    "reordered-frames": FaultKind(18, "this share of the feedback frames arrives after those of the next cycle",
                                  lambda v: Reordered(share(v)), "10%", "SHARE"),
    "frozen-feedback": FaultKind(19, "the feedback repeats its last values", plain(FrozenTpdos)),
    "feedback-lost": FaultKind(19, "the drive stops sending TPDOs; its heartbeat continues",
                               plain(lambda: Without(0x180, 0x280))),
    "heartbeat-lost": FaultKind(20, "the drive stops sending its heartbeat", plain(lambda: Without(0x700))),
    "foreign-nmt-stop": FaultKind(22, "another CANopen master sends NMT stop", plain(lambda: ForeignNmt(2))),
    "foreign-nmt-preop": FaultKind(22, "another CANopen master sends NMT pre-operational",
                                   plain(lambda: ForeignNmt(128))),
    "second-master": FaultKind(
        26, "another master: it has enabled the drive before the run, or sends setpoints during the run",
        plain(SecondMaster)),
    "duplicate-node": FaultKind(26, "a second drive has the same node ID", plain(SecondNode)),
    "replayed-feedback": FaultKind(
        26, "before each feedback frame of the drive, this number of frames from standstill is sent",
        lambda v: Replayed(_frames(v)), "1", "FRAMES"),
    "foreign-heartbeat": FaultKind(56, "another node sends heartbeats with the node ID of the host, with this period",
                                   lambda v: ForeignHeartbeat(seconds(v)), "1s", "TIME"),
    "tool-writes": FaultKind(57, "another tool writes an object by SDO, once",
                             lambda v: ToolWrites(*_written(v)), "1016h:1=0", "OBJECT=VALUE"),
    "setting-changed": FaultKind(58, "an object is changed at the drive's panel",
                                 lambda v: SettingChanged(*_written(v)[:3]), "6007h=0", "OBJECT=VALUE"),
    "foreign-setpoints": FaultKind(
        59, "another master sends setpoints in RPDO4; with again, it also enables RPDO4 repeatedly",
        lambda v: ForeignSetpoints(_again(v)), "once", "once|again"),
    "sdo-master": FaultKind(60, "another master writes controlword and speed by SDO, in each cycle",
                            plain(SdoMaster)),
    "watchdog-not-armed": FaultKind(50, "the drive confirms the write to 1016h:1, and keeps the old value",
                                    plain(lambda: NotKept(0x1016, 1))),
})
KINDS.update(of_drive(OfDrive))
make, parse_all, listed, listing = KINDS.make, KINDS.parse_all, KINDS.listed, KINDS.listing


# ---------------------------------------------------------------------------------------------------------------------

class Faults(FaultSchedule[Misbehaviour]):
    """Script of one drive. `attach` activates it; then `came` gets the frames."""

    def __init__(self, script: tuple[Scripted, ...], seed: int = 0) -> None:
        super().__init__(script, make, seed)
        self._ends_cycles = False          # True after the host was informed

    def attach(self, node: Cia402Node, sender: Sender) -> None:
        """Apply the faults to this node from now on."""
        self._node = node
        self._put: Callable[[int, bytes], None] = sender.put
        scene = Scene(node, sender.put, self.rng)
        for fault in self.cast.all:
            fault.scene = scene
        sender.script = self._outgoing
        self.happen_to(node)

    def came(self, can_id: int, data: bytes | bytearray) -> None:
        """Take a frame from the bus, on its way to the node."""
        node = self._node
        if can_id == SYNC and node.stepped and not self._ends_cycles and self._more:
            self._ends_cycles = True
            self._put(CYCLE_ID, CYCLES_END)
        frames: list[Frame] = [(can_id, data)]
        for fault in tuple(self.cast.active):
            frames = [after for before in frames for after in fault.incoming(*before)]
        for frame in frames:
            node.on_frame(*frame)
        if can_id != SYNC or not node.stepped:
            return
        if not any(one == SYNC for one, _ in frames):
            node.pass_cycle()
        if self._ends_cycles:
            self._ends_cycles = self._more
            self._put(CYCLE_ID, CYCLE_OVER if self._more else LAST_CYCLE_OVER)

    @property
    def _more(self) -> bool:
        """True if a fault is active or still to come."""
        return bool(self.cast.active or self.cast.waiting)

    def _outgoing(self, can_id: int, data: bytes) -> list[Frame]:
        frames: list[Frame] = [(can_id, data)]
        for fault in tuple(self.cast.active):
            frames = [after for one, body in frames for after in fault.outgoing(one, bytes(body))]
        return frames
